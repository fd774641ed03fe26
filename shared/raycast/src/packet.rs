//! Packets of rays on the processor at hand: which [`Lanes`] run, and the entrance to the walk under their instructions.
#![allow(unsafe_code)]

use crate::{
    lanes::Lanes,
    render::{Ends, Stage},
    scalar::Seen,
    walk,
    warp::Tile,
};
use maille_volume::BrickSource;

/// Which vectors a packet runs in.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Width {
    /// plain numbers, on any processor
    Portable,
    /// eight lanes
    Avx2,
    /// sixteen lanes
    Avx512,
}

/// A part of the picture.
#[derive(Clone, Copy, Debug)]
pub struct Area {
    /// its first pixel
    pub first: [usize; 2],
    /// pixels across and down
    pub size: [usize; 2],
    /// no ray sees anything nearer than this [mm]
    pub clear: f32,
}

/// The widest that this processor runs.
pub fn widest() -> Width {
    #[cfg(target_arch = "x86_64")]
    {
        if crate::lanes::avx512::Avx512::detect().is_some() {
            return Width::Avx512;
        }
        if crate::lanes::avx2::Avx2::detect().is_some() {
            return Width::Avx2;
        }
    }
    Width::Portable
}

/// Casts the rays of a tile; a width that this processor has not is taken for [`Width::Portable`].
pub fn cast_tile<S: BrickSource + ?Sized>(
    width: Width,
    stage: &Stage<'_, S>,
    ends: Option<&Ends<'_>>,
    mut warp: Option<&mut Tile<'_>>,
    area: Area,
    put: impl FnMut(Part),
) {
    let Area { first, size, clear } = area;
    #[cfg(target_arch = "x86_64")]
    {
        use crate::lanes::{avx2::Avx2, avx512::Avx512};
        if width == Width::Avx512
            && let Some(lanes) = Avx512::detect()
        {
            return tile(lanes, first, size, put, |l, x, y| {
                // SAFETY: `lanes` is the proof that this processor has the instructions.
                unsafe { cast_avx512(l, stage, ends, warp.as_deref_mut(), clear, x, y) }
            });
        }
        if width == Width::Avx2
            && let Some(lanes) = Avx2::detect()
        {
            return tile(lanes, first, size, put, |l, x, y| {
                // SAFETY: `lanes` is the proof that this processor has the instructions.
                unsafe { cast_avx2(l, stage, ends, warp.as_deref_mut(), clear, x, y) }
            });
        }
    }
    let _ = width;
    tile(crate::lanes::portable::Portable, first, size, put, |l, x, y| walk::cast(l, stage, ends, warp.as_deref_mut(), clear, x, y));
}

fn tile<L: Lanes>(
    lanes: L,
    first: [usize; 2],
    size: [usize; 2],
    mut put: impl FnMut(Part),
    mut cast: impl FnMut(L, usize, usize) -> walk::Packet,
) {
    let end: [usize; 2] = std::array::from_fn(|c| first[c] + size[c]);
    for y in (first[1]..end[1]).step_by(L::DOWN) {
        for x in (first[0]..end[0]).step_by(L::ACROSS) {
            let size = [L::ACROSS.min(end[0] - x), L::DOWN.min(end[1] - y)];
            put(Part { seen: cast(lanes, x, y), across: L::ACROSS, first: [x, y], size });
        }
    }
}

/// What a packet saw, and where in the picture.
pub struct Part {
    seen: walk::Packet,
    /// lanes of a row
    across: usize,
    /// first pixel
    pub first: [usize; 2],
    /// pixels across and down that belong to the tile
    size: [usize; 2],
}

impl Part {
    /// Every pixel by itself.
    pub fn each(&self, put: &mut impl FnMut(usize, usize, Seen)) {
        for row in 0..self.size[1] {
            for x in 0..self.size[0] {
                put(self.first[0] + x, self.first[1] + row, self.seen.lane(row * self.across + x));
            }
        }
    }

    /// Colours before what is behind them, and depth, into rows of `width` pixels that begin at the first pixel: what [`each`](Self::each) with
    /// [`write_pixel`](crate::render::write_pixel) does, for all lanes at once.
    pub fn write(&self, behind: [f32; 3], rgb: &mut [u8], depth: Option<&mut [f32]>, width: usize) {
        let bytes = self.seen.bytes(behind);
        let [columns, rows] = self.size;
        for row in 0..rows {
            let lanes = row * self.across..row * self.across + columns;
            for (pixel, lane) in rgb[3 * row * width..].as_chunks_mut::<3>().0.iter_mut().zip(lanes) {
                *pixel = bytes.map(|channel| channel[lane]);
            }
        }
        if let Some(depth) = depth {
            for row in 0..rows {
                (0..columns).for_each(|x| depth[row * width + x] = self.seen.lane(row * self.across + x).depth);
            }
        }
    }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl")]
fn cast_avx512<S: BrickSource + ?Sized>(
    l: crate::lanes::avx512::Avx512,
    stage: &Stage<'_, S>,
    ends: Option<&Ends<'_>>,
    warp: Option<&mut Tile<'_>>,
    clear: f32,
    x: usize,
    y: usize,
) -> walk::Packet {
    walk::cast(l, stage, ends, warp, clear, x, y)
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
fn cast_avx2<S: BrickSource + ?Sized>(
    l: crate::lanes::avx2::Avx2,
    stage: &Stage<'_, S>,
    ends: Option<&Ends<'_>>,
    warp: Option<&mut Tile<'_>>,
    clear: f32,
    x: usize,
    y: usize,
) -> walk::Packet {
    walk::cast(l, stage, ends, warp, clear, x, y)
}
