//! The voxels of one brick: pre-images row by row with the inversion kernel, then trilinear rest values.
//!
//! A row starts from the rows solved before it: the displacement of voxel (i, j, k) is guessed as d(j−1, k) + d(j, k−1) −
//! d(j−1, k−1), which is exact wherever d is a sum of a function of j and one of k, as dents of cubic regions are.

use crate::{
    MapOptions, MapReport,
    reach::preimage_box,
    rows::{Box3, ROWS, Spans, bounds},
    sample::RestSampler,
    search,
    window::Window,
};
use maille_chainmail::{ChainMail, DisplacementBrick};
use maille_displacement::{DisplacementField, Inverter, Scheme};
use maille_volume::{BrickId, BrickSource, brick::EDGE};
use wide::f32x4;

/// Stored values of a brick's voxels; only those in the wanted spans mean something.
pub type Values = [i16; EDGE * EDGE * EDGE];

/// Working memory of one thread.
pub struct Workspace {
    pub window: Window,
    /// x − X of the rows solved [voxels]
    found: Box<[[f32x4; EDGE]; ROWS]>,
}

impl Workspace {
    pub fn new() -> Self {
        Self { window: Window::new(), found: Box::new([[f32x4::ZERO; EDGE]; ROWS]) }
    }
}

/// What stays the same for all bricks of one mapping.
pub struct Solver<'a, S: BrickSource + ?Sized> {
    pub rest: &'a S,
    pub mail: &'a ChainMail,
    pub inverter: Inverter,
    /// stored value of what is void
    void: i16,
}

impl<'a, S: BrickSource + ?Sized> Solver<'a, S> {
    pub fn new(rest: &'a S, mail: &'a ChainMail, options: &MapOptions) -> Self {
        let void = rest.info().rescale.stored(options.void_hu).round().clamp(f64::from(i16::MIN), f64::from(i16::MAX)) as i16;
        let inverter = Inverter::for_offset(mail.tissue().offset, options.tolerance).on_spacing(mail.spacing());
        Self { rest, mail, inverter, void }
    }

    /// Rest value of a voxel whose element did not move and is what is there now: all but voids, which tissue may have entered.
    #[inline]
    fn own_value(&self, [i, j, k]: [usize; 3]) -> Option<i16> {
        let stored = self.rest.voxel(i, j, k);
        let tissue = |t: f64| self.rest.info().rescale.value(f64::from(stored)) >= t;
        self.mail.tissue().threshold_hu.is_none_or(tissue).then_some(stored)
    }

    /// Solves the wanted voxels of a brick.
    pub fn brick(&self, work: &mut Workspace, id: BrickId, spans: &Spans, values: &mut Values) -> MapReport {
        let mut report = MapReport::default();
        let Some((low, high)) = bounds(spans) else { return report };
        let first = self.mail.layout().first_voxel(id);
        let voxels = Box3 { low: std::array::from_fn(|c| first[c] + low[c]), high: std::array::from_fn(|c| first[c] + high[c]) };
        work.window.gather(self.mail, preimage_box(self.mail, voxels));
        let origin = work.window.low();
        let mut sampler = RestSampler::new(self.rest, origin, work.window.size());
        let displacement = self.mail.displacement_brick(id);
        for (row, span) in spans.iter().enumerate().filter(|(_, s)| s[1] > 0) {
            let range = span[0] as usize..span[1] as usize;
            report.voxels += range.len() as u64;
            let out: &mut [i16; EDGE] = values.as_chunks_mut().0[row..].first_mut().expect("the row is one of the brick's");
            if work.window.at_rest() {
                for i in range {
                    out[i] = self.rest.voxel(first[0] + i, first[1] + row % EDGE, first[2] + row / EDGE);
                }
                continue;
            }
            // 1. pre-images, in positions relative to the window's first element
            let local = |c: usize, v: usize| (first[c] + v) as f32 - origin[c] as f32;
            let (y, z) = (local(1, row % EDGE), local(2, row / EDGE));
            let target: [f32x4; EDGE] = std::array::from_fn(|i| f32x4::new([local(0, i), y, z, 0.0]));
            let mut position = target;
            guess(spans, &work.found, row, range.clone(), &mut position);
            let mut converged = [false; EDGE];
            report.iterations += u64::from(self.inverter.invert_row(&work.window, &target, range.clone(), &mut position, &mut converged));
            for i in range.clone() {
                work.found[row][i] = target[i] - position[i];
            }
            // 2. values; the few that did not converge, and all beside voids, one by one
            let all = converged[range.clone()].iter().all(|&c| c) && self.mail.tissue().threshold_hu.is_none();
            for i in range {
                let x = xyz(position[i]);
                let voxel = [first[0] + i, first[1] + row % EDGE, first[2] + row / EDGE];
                if at_rest(displacement, row * EDGE + i)
                    && let Some(rest) = self.own_value(voxel)
                {
                    // X = x is the exact pre-image; the kernel stops within its tolerance of it
                    out[i] = rest;
                    continue;
                }
                let value = if all {
                    sampler.stored(x)
                } else {
                    let hard = Hard { solver: self, window: &work.window, voxel, target: xyz(target[i]) };
                    hard.value(&mut sampler, x, converged[i], &mut report)
                };
                report.voids += u64::from(value.is_none());
                out[i] = value.unwrap_or(self.void);
            }
        }
        report
    }
}

/// Whether an element did not move, bit for bit.
#[inline]
fn at_rest(displacement: Option<&DisplacementBrick>, element: usize) -> bool {
    displacement.is_none_or(|d| d.u.iter().all(|plane| plane[element] == 0.0))
}

/// Moves the starts of a row to where the rows before it say.
#[inline]
fn guess(spans: &Spans, found: &[[f32x4; EDGE]; ROWS], row: usize, range: std::ops::Range<usize>, position: &mut [f32x4; EDGE]) {
    let (j, k) = (row % EDGE, row / EDGE);
    let none = [0u8, 0];
    let (below, before) = (if j > 0 { spans[row - 1] } else { none }, if k > 0 { spans[row - EDGE] } else { none });
    let corner = if j > 0 && k > 0 { spans[row - EDGE - 1] } else { none };
    let has = |s: [u8; 2], i: usize| (s[0] as usize..s[1] as usize).contains(&i);
    for i in range {
        let start = &mut position[i];
        match (has(below, i), has(before, i)) {
            (true, true) if has(corner, i) => *start -= found[row - 1][i] + found[row - EDGE][i] - found[row - EDGE - 1][i],
            (true, _) => *start -= found[row - 1][i],
            (_, true) => *start -= found[row - EDGE][i],
            _ => {}
        }
    }
}

#[inline(always)]
fn xyz(v: f32x4) -> [f32; 3] {
    let [x, y, z, _] = v.to_array();
    [x, y, z]
}

/// A voxel that the row's kernel did not settle, or that may lie beside a void.
struct Hard<'a, 's, S: BrickSource + ?Sized> {
    solver: &'a Solver<'s, S>,
    window: &'a Window,
    voxel: [usize; 3],
    target: [f32; 3],
}

impl<S: BrickSource + ?Sized> Hard<'_, '_, S> {
    /// Its value; `None`: void.
    fn value(&self, sampler: &mut RestSampler<S>, mut position: [f32; 3], mut converged: bool, report: &mut MapReport) -> Option<i16> {
        let threshold = self.solver.mail.tissue().threshold_hu;
        if !converged {
            // damped Newton from the voxel's own displacement
            let inverter = Inverter { scheme: Scheme::Newton, ..self.solver.inverter };
            let u = self.window.displacement(self.target);
            let found = inverter.invert(self.window, self.target, std::array::from_fn(|c| self.target[c] - u[c]));
            report.iterations += u64::from(found.iterations);
            (position, converged) = (found.position, found.converged);
        }
        if !converged || threshold.is_some_and(|t| !sampler.is_tissue_cell(position, t)) {
            // void or fold: look for a tissue cell whose image holds the voxel
            report.searched += 1;
            let mut tissue = |p: [f32; 3]| threshold.is_none_or(|t| sampler.is_tissue_cell(p, t));
            match search::cell(self.window, self.target, position, self.solver.inverter.stop(), &mut tissue) {
                Some(better) => position = better.position,
                // a void that nothing entered keeps its value, one that tissue left is void
                None if threshold.is_some() => {
                    let still = self.window.displacement(self.target) == [0.0; 3];
                    return still.then(|| self.solver.rest.voxel(self.voxel[0], self.voxel[1], self.voxel[2]));
                }
                None if !converged => report.failures += 1,
                None => {}
            }
        }
        sampler.stored(position)
    }
}

/// Displacements fill a brick as voxels do.
const _: () = assert!(DisplacementBrick::offset(EDGE - 1, EDGE - 1, EDGE - 1) + 1 == EDGE * EDGE * EDGE);
