//! The voxels of one brick: pre-images row by row with the inversion kernel, then trilinear rest values.
//!
//! A row starts from the rows solved before it: the displacement of voxel (i, j, k) is guessed as d(j−1, k) + d(j, k−1) −
//! d(j−1, k−1), which is exact wherever d is a sum of a function of j and one of k, as dents of cubic regions are. Rows whose
//! elements are all at rest need no solve: X = x.

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
use maille_volume::{Brick, BrickId, BrickSource, brick::EDGE};
use wide::f32x4;

/// Stored values of a brick's voxels; only those in the wanted spans mean something.
pub type Values = [i16; EDGE * EDGE * EDGE];

/// Working memory of one thread.
pub struct Workspace {
    pub window: Window,
    /// rows to be solved
    open: Box<Spans>,
    /// x − X of the rows solved [voxels]
    found: Box<[[f32x4; EDGE]; ROWS]>,
}

impl Workspace {
    pub fn new() -> Self {
        Self { window: Window::new(), open: Box::new([[0; 2]; ROWS]), found: Box::new([[f32x4::ZERO; EDGE]; ROWS]) }
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

    /// Solves the wanted voxels of a brick.
    pub fn brick(&self, work: &mut Workspace, id: BrickId, spans: &Spans, values: &mut Values) -> MapReport {
        let mut report = MapReport::default();
        let first = self.mail.layout().first_voxel(id);
        let displacement = self.mail.displacement_brick(id).filter(|_| self.mail.displacement_range(id) != [[0.0; 2]; 3]);
        // 1. rest values everywhere; what is left are the rows whose elements moved
        let (rest, values) = (self.rest.brick(id), values.as_chunks_mut::<EDGE>().0);
        let all_linked = self.mail.tissue().threshold_hu.is_none();
        for (row, span) in spans.iter().enumerate().filter(|(_, s)| s[1] > 0) {
            let from = Brick::offset(0, (row % EDGE) as isize, (row / EDGE) as isize);
            values[row].copy_from_slice(&rest.voxels[from..from + EDGE]);
            report.voxels += u64::from(span[1] - span[0]);
        }
        let open = &mut *work.open;
        for (row, span) in spans.iter().enumerate() {
            open[row] = if all_linked { displacement.map_or([0; 2], |d| moved_span(d, row, *span)) } else { *span };
        }
        let Some((low, high)) = bounds(open) else { return report };
        let voxels = Box3 { low: std::array::from_fn(|c| first[c] + low[c]), high: std::array::from_fn(|c| first[c] + high[c]) };
        work.window.gather(self.mail, preimage_box(self.mail, voxels));
        if work.window.at_rest() {
            return report;
        }
        let (window, found) = (&work.window, &mut *work.found);
        let origin = window.low();
        let mut sampler = RestSampler::new(self.rest, origin, window.size());
        let local: [f32; 3] = std::array::from_fn(|c| first[c] as f32 - origin[c] as f32);
        let (mut target, mut position, mut converged) = ([f32x4::ZERO; EDGE], [f32x4::ZERO; EDGE], [false; EDGE]);
        for (row, span) in open.iter().enumerate().filter(|(_, s)| s[1] > 0) {
            let range = span[0] as usize..span[1] as usize;
            let out = &mut values[row];
            // 2. pre-images, in positions relative to the window's first element
            let (j, k) = (row % EDGE, row / EDGE);
            let mut place = f32x4::new([local[0] + range.start as f32, local[1] + j as f32, local[2] + k as f32, 0.0]);
            for x in &mut target[range.clone()] {
                *x = place;
                place += f32x4::new([1.0, 0.0, 0.0, 0.0]);
            }
            let at = |c: usize, v: usize| first[c] + v - origin[c];
            let own = &window.row(at(1, j), at(2, k))[at(0, range.start)..at(0, range.end)];
            guess(open, found, own, row, range.clone(), &target, &mut position);
            report.iterations += u64::from(self.inverter.invert_row(window, &target, range.clone(), &mut position, &mut converged));
            for i in range.clone() {
                found[row][i] = target[i] - position[i];
            }
            // 3. values; the few that did not converge, and all beside voids, one by one
            let easy = all_linked && converged[range.clone()].iter().all(|&c| c);
            for i in range.clone() {
                let voxel = [first[0] + i, first[1] + j, first[2] + k];
                // X = x is the exact pre-image of what did not move; the kernel stops within its tolerance of it
                let still = f32x4::new(own[i - range.start]).simd_eq(f32x4::ZERO).to_bitmask() == 0b1111;
                if still && (all_linked || self.is_tissue(out[i])) {
                    continue;
                }
                let value = if easy {
                    sampler.stored(position[i])
                } else {
                    let hard = Hard { solver: self, window, voxel, target: xyz(target[i]) };
                    hard.value(&mut sampler, xyz(position[i]), converged[i], &mut report)
                };
                report.voids += u64::from(value.is_none());
                out[i] = value.unwrap_or(self.void);
            }
        }
        report
    }

    /// Whether a stored value is one of tissue: a void may be entered by others.
    #[inline]
    fn is_tissue(&self, stored: i16) -> bool {
        self.mail.tissue().threshold_hu.is_none_or(|t| self.rest.info().rescale.value(f64::from(stored)) >= t)
    }
}

/// The part of a span of a brick's row between its first and its last moved element.
#[inline]
fn moved_span(displacement: &DisplacementBrick, row: usize, [from, to]: [u8; 2]) -> [u8; 2] {
    if to == 0 {
        return [0; 2];
    }
    let [x, y, z] = displacement.u.each_ref().map(|plane| plane[row * EDGE..][..EDGE].as_chunks::<4>().0);
    let mut moved = 0u64;
    for part in 0..EDGE / 4 {
        let any = f32x4::new(x[part]) | f32x4::new(y[part]) | f32x4::new(z[part]);
        moved |= u64::from(any.simd_ne(f32x4::ZERO).to_bitmask()) << (4 * part);
    }
    moved &= u64::MAX << from & (u64::MAX >> (64 - u32::from(to)));
    if moved == 0 { [0; 2] } else { [moved.trailing_zeros() as u8, 64 - moved.leading_zeros() as u8] }
}

/// Where a row starts: by the rows before it; where those are not there, by the voxels' own displacements.
#[inline]
fn guess(
    spans: &Spans,
    found: &[[f32x4; EDGE]; ROWS],
    own: &[[f32; 4]],
    row: usize,
    range: std::ops::Range<usize>,
    target: &[f32x4; EDGE],
    position: &mut [f32x4; EDGE],
) {
    let mut common = range.clone();
    if !row.is_multiple_of(EDGE) && row >= EDGE {
        for before in [row - 1, row - EDGE, row - EDGE - 1] {
            common = common.start.max(spans[before][0].into())..common.end.min(spans[before][1].into());
        }
    } else {
        common.end = common.start;
    }
    if common.is_empty() {
        common = range.end..range.end;
    }
    for i in (range.start..common.start).chain(common.end..range.end) {
        position[i] = target[i] - f32x4::new(own[i - range.start]);
    }
    if common.is_empty() {
        return;
    }
    let (below, before, corner) = (&found[row - 1], &found[row - EDGE], &found[row - EDGE - 1]);
    for i in common {
        position[i] = target[i] - (below[i] + before[i] - corner[i]);
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
        sampler.stored(f32x4::new([position[0], position[1], position[2], 0.0]))
    }
}

/// A row's elements are bits of a word.
const _: () = assert!(EDGE <= 64 && EDGE.is_multiple_of(4));

/// Displacements fill a brick as voxels do.
const _: () = assert!(DisplacementBrick::offset(EDGE - 1, EDGE - 1, EDGE - 1) + 1 == EDGE * EDGE * EDGE);
