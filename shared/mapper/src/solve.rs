//! The voxels of one brick: pre-image by the inversion kernel, started from the voxel before, then a trilinear rest value.

use crate::{
    MapOptions, MapReport,
    rows::{Box3, Spans},
    search,
    window::Window,
};
use maille_chainmail::{ChainMail, DisplacementBrick};
use maille_displacement::{DisplacementField, Inverter};
use maille_volume::{Brick, BrickId, BrickSource, brick::EDGE};

/// New values of the wanted voxels of one brick.
pub struct Solved {
    /// stored values, EDGE³; only the wanted spans mean something
    pub values: Box<[i16; EDGE * EDGE * EDGE]>,
    pub report: MapReport,
}

/// Box of elements that holds the pre-images of a box of voxels: grown by the displacements found inside, until it holds them.
pub fn preimage_box(mail: &ChainMail, voxels: Box3) -> Box3 {
    let (layout, spacing) = (mail.layout(), mail.spacing());
    let mut reach = [[0.0f32; 2]; 3];
    loop {
        let range = grow(layout.size, voxels, &reach);
        let mut found = reach;
        let bricks = |c: usize| range.low[c] / EDGE..=range.high[c] / EDGE;
        for bk in bricks(2) {
            for bj in bricks(1) {
                for bi in bricks(0) {
                    let Some(brick) = mail.displacement_brick(layout.id([bi, bj, bk])) else { continue };
                    for c in 0..3 {
                        let (low, high) = brick.u[c].iter().fold((0.0f32, 0.0f32), |(l, h), &u| (l.min(u), h.max(u)));
                        found[c] = [found[c][0].min(low / spacing[c]), found[c][1].max(high / spacing[c])];
                    }
                }
            }
        }
        if found == reach {
            return range;
        }
        reach = found;
    }
}

/// X = x − u, one more element on each side for the cell's corners.
fn grow(size: [usize; 3], voxels: Box3, reach: &[[f32; 2]; 3]) -> Box3 {
    let last = |c: usize| size[c] - 1;
    Box3 {
        low: std::array::from_fn(|c| voxels.low[c].saturating_sub(reach[c][1].ceil() as usize + 1)),
        high: std::array::from_fn(|c| (voxels.high[c] + (-reach[c][0]).ceil() as usize + 1).min(last(c))),
    }
}

/// Solves the wanted voxels of a brick.
pub fn brick<S: BrickSource + ?Sized>(
    rest: &S,
    mail: &ChainMail,
    inverter: &Inverter,
    options: &MapOptions,
    window: &mut Window,
    id: BrickId,
    spans: &Spans,
) -> Solved {
    let layout = mail.layout();
    let first = layout.first_voxel(id);
    let mut out = Solved { values: Box::new([0; EDGE * EDGE * EDGE]), report: MapReport::default() };
    let voxels = Box3 { low: first, high: std::array::from_fn(|c| (first[c] + EDGE).min(layout.size[c]) - 1) };
    window.gather(mail, preimage_box(mail, voxels));
    let at_rest = window.at_rest();
    let threshold = mail.tissue().threshold_hu;
    let sampler = RestSampler { rest, size: layout.size };
    let rescale = rest.info().rescale;
    let void = rescale.stored(options.void_hu).round().clamp(f64::from(i16::MIN), f64::from(i16::MAX)) as i16;
    for (row, span) in spans.iter().enumerate().filter(|(_, s)| s[1] > 0) {
        let (j, k) = (first[1] + row % EDGE, first[2] + row / EDGE);
        // the displacement of the voxel before is the next one's first guess
        let mut warm: Option<[f32; 3]> = None;
        for i in span[0] as usize..span[1] as usize {
            let voxel = [first[0] + i, j, k];
            let n = DisplacementBrick::offset(i, row % EDGE, row / EDGE);
            out.report.voxels += 1;
            if at_rest {
                out.values[n] = rest.voxel(voxel[0], voxel[1], voxel[2]);
                continue;
            }
            let target = voxel.map(|v| v as f32);
            let u = warm.unwrap_or_else(|| window.displacement(target));
            let mut found = inverter.invert(window, target, std::array::from_fn(|c| target[c] - u[c]));
            out.report.iterations += u64::from(found.iterations);
            let astray = !found.converged || threshold.is_some_and(|t| !sampler.is_tissue_cell(found.position, t, rescale));
            if astray {
                // void or fold: look for a tissue cell whose image holds the voxel
                out.report.searched += 1;
                let tissue = |position: [f32; 3]| threshold.is_none_or(|t| sampler.is_tissue_cell(position, t, rescale));
                match search::cell(window, target, found.position, inverter.stop(), tissue) {
                    Some(better) => found = better,
                    // a void that nothing entered keeps its value, one that tissue left is void
                    None if threshold.is_some() => {
                        let still = window.displacement(target) == [0.0; 3];
                        out.values[n] = if still { rest.voxel(voxel[0], voxel[1], voxel[2]) } else { void };
                        out.report.voids += u64::from(!still);
                        continue;
                    }
                    None if !found.converged => out.report.failures += 1,
                    None => {}
                }
            }
            warm = Some(std::array::from_fn(|c| target[c] - found.position[c]));
            out.values[n] = match sampler.stored(found.position) {
                Some(value) => value,
                None => {
                    out.report.voids += 1;
                    void
                }
            };
        }
    }
    out
}

/// Trilinear rest values in stored units at continuous indices.
struct RestSampler<'a, S: BrickSource + ?Sized> {
    rest: &'a S,
    size: [usize; 3],
}

impl<'a, S: BrickSource + ?Sized> RestSampler<'a, S> {
    /// Brick, offset of the cell's lower corner and fractions; `None` outside the grid (a hundredth of a voxel is rounding).
    #[inline]
    fn locate(&self, position: [f32; 3]) -> Option<(&'a Brick, usize, [f32; 3])> {
        let (mut base, mut f) = ([0usize; 3], [0.0f32; 3]);
        for c in 0..3 {
            let last = (self.size[c] - 1) as f32;
            if !(position[c] >= -0.01 && position[c] <= last + 0.01) {
                return None;
            }
            let p = position[c].clamp(0.0, last);
            base[c] = (p as usize).min(self.size[c].saturating_sub(2));
            f[c] = p - base[c] as f32;
        }
        let brick = self.rest.brick(self.rest.layout().brick_of(base[0], base[1], base[2]));
        Some((brick, Brick::offset((base[0] % EDGE) as isize, (base[1] % EDGE) as isize, (base[2] % EDGE) as isize), f))
    }

    #[inline]
    fn corners(brick: &Brick, at: usize) -> [f32; 8] {
        use maille_volume::brick::{ROW, SLICE};
        std::array::from_fn(|n| f32::from(brick.voxels[at + (n & 1) + (n >> 1 & 1) * ROW + (n >> 2) * SLICE]))
    }

    #[inline]
    fn stored(&self, position: [f32; 3]) -> Option<i16> {
        let (brick, at, f) = self.locate(position)?;
        let v = Self::corners(brick, at);
        let lerp = |a: f32, b: f32, t: f32| a + (b - a) * t;
        let (a, b) = (lerp(v[0], v[1], f[0]), lerp(v[2], v[3], f[0]));
        let (c, d) = (lerp(v[4], v[5], f[0]), lerp(v[6], v[7], f[0]));
        let value = lerp(lerp(a, b, f[1]), lerp(c, d, f[1]), f[2]);
        // a trilinear value lies between its corners, so that it fits an i16
        Some((value + 0.5).floor() as i16)
    }

    /// Whether the cell around a rest position holds any tissue at its corners.
    fn is_tissue_cell(&self, position: [f32; 3], threshold: f64, rescale: maille_volume::Rescale) -> bool {
        self.locate(position)
            .is_some_and(|(brick, at, _)| Self::corners(brick, at).iter().any(|&v| rescale.value(f64::from(v)) >= threshold))
    }
}
