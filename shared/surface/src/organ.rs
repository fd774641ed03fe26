//! Organs: the inside of level sets and ranges, its connected parts, one of them alone.
//!
//! "The inside of level surfaces of the implicit representation" is one tissue [Shimizu & Nakamura, section 4.2]: voxels whose value lies in one of
//! some ranges. Of these, the part connected with a seed through faces, or all parts larger than islands. What comes out are labels
//! on the volume's grid, and a field whose surface at 0 is the organ's alone, which marching cubes and ray caster take like any volume.
//!
//! Parts are found by rows of runs joined in a forest [Rosenfeld & Pfaltz 1966]: memory and joining go with runs, not voxels.
//! Parts are numbered by their first voxel, so that the result depends on nothing else.
//!
//! Cost: one pass over the voxels in parallel, one over the runs. Not here: what is an organ's range; that is the user's to say.

use maille_volume::{BrickSource, Rescale, Volume};
use rayon::prelude::*;

/// What belongs to an organ.
#[derive(Clone, Debug, PartialEq)]
pub struct Selection {
    /// closed ranges of values [HU]; an end may be infinite
    pub ranges: Vec<[f64; 2]>,
    /// a voxel of the part that is asked for
    pub seed: Option<[usize; 3]>,
    /// parts smaller than this are islands and left out [mm³]
    pub smallest_mm3: f64,
}

/// Why there is no organ.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum SelectionError {
    /// a range that holds nothing
    #[error("the range {low} to {high} HU holds nothing: give the lower end first")]
    Range {
        /// lower end
        low: f64,
        /// upper end
        high: f64,
    },
    /// a seed beyond the border
    #[error("the seed {seed:?} does not lie in a volume of {size:?} voxels")]
    SeedOutside {
        /// the seed
        seed: [usize; 3],
        /// voxels along i, j, k
        size: [usize; 3],
    },
    /// a seed of another tissue
    #[error("the value at the seed {seed:?} is {value} HU, which lies in none of the ranges: choose another seed or a wider range")]
    SeedNotInside {
        /// the seed
        seed: [usize; 3],
        /// value there [HU]
        value: f64,
    },
}

/// Voxels of an organ.
#[derive(Clone, Debug, PartialEq)]
pub struct Organ {
    /// 1 inside, 0 outside, on the volume's grid, i fastest
    pub labels: Vec<u8>,
    /// voxels inside
    pub voxels: usize,
    /// parts kept
    pub parts: usize,
    /// parts left out: islands, and those not connected with the seed
    pub left_out: usize,
}

/// Voxels first ≤ i < end of one row that are inside.
#[derive(Clone, Copy)]
struct Run {
    first: u32,
    end: u32,
}

/// Finds an organ.
///
/// # Errors
/// When a range is empty, or the seed is not inside.
pub fn organ(source: &impl BrickSource, selection: &Selection) -> Result<Organ, SelectionError> {
    let size = source.layout().size;
    let rescale = source.info().rescale;
    if let Some(&[low, high]) = selection.ranges.iter().find(|[low, high]| low.is_nan() || high.is_nan() || low > high) {
        return Err(SelectionError::Range { low, high });
    }
    let inside = |stored: i16| -> bool {
        let v = rescale.value(f64::from(stored));
        selection.ranges.iter().any(|[low, high]| *low <= v && v <= *high)
    };
    if let Some(seed) = selection.seed {
        if (0..3).any(|c| seed[c] >= size[c]) {
            return Err(SelectionError::SeedOutside { seed, size });
        }
        let stored = source.voxel(seed[0], seed[1], seed[2]);
        if !inside(stored) {
            return Err(SelectionError::SeedNotInside { seed, value: rescale.value(f64::from(stored)) });
        }
    }
    let table: Vec<bool> = (i16::MIN..=i16::MAX).map(inside).collect();
    let flat = source.to_volume().voxels;
    // runs of every row, and where each row's begin
    let rows: Vec<Vec<Run>> = flat.par_chunks(size[0]).map(|row| runs(row, &table)).collect();
    let mut start = vec![0usize];
    start.extend(rows.iter().scan(0, |sum, row| {
        *sum += row.len();
        Some(*sum)
    }));
    let mut forest: Vec<u32> = (0..start[rows.len()] as u32).collect();
    for (n, row) in rows.iter().enumerate() {
        let (j, k) = (n % size[1], n / size[1]);
        for before in [(j > 0).then(|| n - 1), (k > 0).then(|| n - size[1])].into_iter().flatten() {
            join(&mut forest, (row, start[n]), (&rows[before], start[before]));
        }
    }
    let mut sizes = vec![0usize; forest.len()];
    for (n, run) in rows.iter().flatten().enumerate() {
        let root = root(&mut forest, n as u32);
        sizes[root as usize] += (run.end - run.first) as usize;
    }
    let wanted = selection.seed.map(|[i, j, k]| {
        let row = k * size[1] + j;
        let run = rows[row].iter().position(|r| (r.first..r.end).contains(&(i as u32))).expect("the seed is inside");
        root(&mut forest, (start[row] + run) as u32)
    });
    let spacing = source.info().grid.spacing;
    let smallest = selection.smallest_mm3 / (spacing[0] * spacing[1] * spacing[2]);
    let keep: Vec<bool> =
        (0..forest.len()).map(|n| sizes[n] > 0 && sizes[n] as f64 >= smallest && wanted.is_none_or(|w| w as usize == n)).collect();
    let mut labels = vec![0u8; flat.len()];
    for (n, row) in rows.iter().enumerate() {
        for (m, run) in row.iter().enumerate() {
            if keep[root(&mut forest, (start[n] + m) as u32) as usize] {
                labels[n * size[0]..][run.first as usize..run.end as usize].fill(1);
            }
        }
    }
    let all = sizes.iter().filter(|n| **n > 0).count();
    let parts = keep.iter().filter(|k| **k).count();
    Ok(Organ { voxels: (0..keep.len()).filter(|n| keep[*n]).map(|n| sizes[n]).sum(), labels, parts, left_out: all - parts })
}

fn runs(row: &[i16], table: &[bool]) -> Vec<Run> {
    let mut out = Vec::new();
    let mut open = None;
    for (i, &v) in row.iter().enumerate() {
        match (table[(i32::from(v) + 32_768) as usize], open) {
            (true, None) => open = Some(i as u32),
            (false, Some(first)) => {
                out.push(Run { first, end: i as u32 });
                open = None;
            }
            _ => {}
        }
    }
    out.extend(open.map(|first| Run { first, end: row.len() as u32 }));
    out
}

/// The root of a run's part; paths are halved on the way.
fn root(forest: &mut [u32], mut n: u32) -> u32 {
    while forest[n as usize] != n {
        forest[n as usize] = forest[forest[n as usize] as usize];
        n = forest[n as usize];
    }
    n
}

/// Joins the runs of two neighbouring rows that share a face; the smaller number stays root.
fn join(forest: &mut [u32], (a, first_a): (&[Run], usize), (b, first_b): (&[Run], usize)) {
    let (mut m, mut n) = (0, 0);
    while m < a.len() && n < b.len() {
        if a[m].first < b[n].end && b[n].first < a[m].end {
            let (p, q) = (root(forest, (first_a + m) as u32), root(forest, (first_b + n) as u32));
            forest[p.max(q) as usize] = p.min(q);
        }
        if a[m].end < b[n].end { m += 1 } else { n += 1 }
    }
}

impl Organ {
    /// The organ alone, as a field on the volume's grid that is at least 0 inside: how far the value lies within the nearest end of its
    /// range, in the volume's own units, held at ±`band`. Near the organ the field is the volume's own, so that its surface at 0 lies where
    /// the volume's level sets lie; other parts of the same tissue are outside.
    ///
    /// # Panics
    /// When the organ is not of this volume.
    pub fn field(&self, source: &impl BrickSource, ranges: &[[f64; 2]], band: f64) -> Volume {
        let info = source.info();
        let flat = source.to_volume().voxels;
        assert_eq!(flat.len(), self.labels.len(), "labels and volume are on one grid");
        // a thousandth of the band at least, so that the isovalue is met to less than noise
        let slope = (band / 32_000.0).max(f64::MIN_POSITIVE);
        let within = |v: f64| ranges.iter().map(|[low, high]| (v - low).min(high - v)).fold(f64::NEG_INFINITY, f64::max);
        let voxels = flat
            .par_iter()
            .zip(&self.labels)
            .map(|(&stored, &label)| {
                let inside = (within(info.rescale.value(f64::from(stored))).clamp(-band, band) / slope) as i16;
                // of another part of the tissue nothing shall be seen, nor of its noise
                if label == 1 {
                    inside.max(0)
                } else if inside >= 0 {
                    -1 - inside
                } else {
                    inside
                }
            })
            .collect();
        Volume::new(info.grid.clone(), Rescale { slope, intercept: 0.0 }, voxels)
    }

    /// The volume with `outside` (HU) wherever the organ is not.
    ///
    /// # Panics
    /// When the organ is not of this volume.
    pub fn alone(&self, source: &impl BrickSource, outside: f64) -> Volume {
        let mut volume = source.to_volume();
        assert_eq!(volume.voxels.len(), self.labels.len(), "labels and volume are on one grid");
        let stored = source.info().rescale.stored(outside).round().clamp(f64::from(i16::MIN), f64::from(i16::MAX)) as i16;
        volume.voxels.par_iter_mut().zip(&self.labels).for_each(|(v, &label)| {
            if label == 0 {
                *v = stored;
            }
        });
        volume
    }

    /// The labels as a volume.
    pub fn to_volume(&self, source: &impl BrickSource) -> Volume {
        Volume::new(source.info().grid.clone(), Rescale::IDENTITY, self.labels.iter().map(|&l| i16::from(l)).collect())
    }
}
