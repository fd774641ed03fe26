//! The voxels of one brick: pre-images row by row with the inversion kernel, then trilinear rest values.
//!
//! A row starts from the rows solved before it: the displacement of voxel (i, j, k) is guessed as d(j−1, k) + d(j, k−1) −
//! d(j−1, k−1), which is exact wherever d is a sum of a function of j and one of k, as dents of cubic regions are. Rows whose
//! elements are all at rest need no solve: X = x.

use crate::{
    MapOptions, MapReport, Mapping,
    pieces::Pieces,
    reach::{preimage_box, preimage_box_beside_gaps},
    rows::{Box3, ROWS, Spans, bounds},
    sample::{RestSampler, Sampling},
    search::{self, Open, OpenVoxels},
    vector::{Task, widest},
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
    /// tissue and cuts around, where there are any
    pieces: Pieces,
    /// voxels left to the search of cells
    left: OpenVoxels,
}

impl Workspace {
    pub fn new() -> Self {
        Self {
            window: Window::new(),
            open: Box::new([[0; 2]; ROWS]),
            found: Box::new([[f32x4::ZERO; EDGE]; ROWS]),
            pieces: Pieces::default(),
            left: OpenVoxels::new(),
        }
    }
}

/// What stays the same for all bricks of one mapping.
pub struct Solver<'a, S: BrickSource + ?Sized> {
    rest: &'a S,
    mail: &'a ChainMail,
    /// whether voids or cuts take the map apart
    gaps: bool,
    inverter: Inverter,
    options: MapOptions,
    /// beside voids and cuts: bricks that hold displacements
    loaded: Vec<BrickId>,
    /// stored value of what is void
    void: i16,
}

impl<'a, S: BrickSource + ?Sized> Solver<'a, S> {
    pub fn new(rest: &'a S, mail: &'a ChainMail, gaps: bool, options: &MapOptions) -> Self {
        let void = rest.info().rescale.stored(options.void_hu).round().clamp(f64::from(i16::MIN), f64::from(i16::MAX)) as i16;
        let mut inverter = Inverter::for_offset(mail.tissue().offset, options.tolerance).on_spacing(mail.spacing());
        match options.mapping {
            Mapping::FixedPoint => inverter.scheme = Scheme::FixedPoint,
            Mapping::Newton => inverter.scheme = Scheme::Newton,
            _ => {}
        }
        let loaded = if gaps { mail.loaded_bricks() } else { Vec::new() };
        Self { rest, mail, gaps, inverter, options: *options, loaded, void }
    }

    /// Solves the wanted voxels of a brick.
    pub fn brick(&self, work: &mut Workspace, id: BrickId, spans: &Spans, values: &mut Values) -> MapReport {
        widest(Job { solver: self, work, id, spans, values })
    }

    #[inline(always)]
    fn solve(&self, work: &mut Workspace, id: BrickId, spans: &Spans, values: &mut Values) -> MapReport {
        let mut report = MapReport::default();
        let first = self.mail.layout().first_voxel(id);
        let displacement = self.mail.displacement_brick(id).filter(|_| self.mail.displacement_range(id) != [[0.0; 2]; 3]);
        // 1. rest values everywhere; what is left are the rows whose elements moved
        let (rest, values) = (self.rest.brick(id), values.as_chunks_mut::<EDGE>().0);
        let voids = self.mail.tissue().threshold_hu.is_some();
        for (row, span) in spans.iter().enumerate().filter(|(_, s)| s[1] > 0) {
            let from = Brick::offset(0, (row % EDGE) as isize, (row / EDGE) as isize);
            values[row].copy_from_slice(&rest.voxels[from..from + EDGE]);
            report.voxels += u64::from(span[1] - span[0]);
        }
        let all_open = voids || self.mail.cut_brick(id).is_some();
        let open = &mut *work.open;
        for (row, span) in spans.iter().enumerate() {
            // a void may be entered by others, and tissue at rest be taken out
            open[row] = if all_open { *span } else { displacement.map_or([0; 2], |d| moved_span(d, row, *span)) };
        }
        let Some((low, high)) = bounds(open) else { return report };
        let voxels = Box3 { low: std::array::from_fn(|c| first[c] + low[c]), high: std::array::from_fn(|c| first[c] + high[c]) };
        let range = if self.gaps { preimage_box_beside_gaps(self.mail, voxels, &self.loaded) } else { preimage_box(self.mail, voxels) };
        work.window.gather(self.mail, range);
        if work.window.at_rest() && self.mail.cut_brick(id).is_none() {
            return report;
        }
        // far from every void and cut the map is one piece
        let all_linked = !(voids || self.gaps && self.is_cut(range));
        let may_fold = !all_linked || self.mail.tissue().offset >= 1.0 / 3.0;
        let (window, found, pieces, left) = (&work.window, &mut *work.found, &mut work.pieces, &mut work.left);
        if all_linked {
            pieces.all_tissue(window);
        } else {
            pieces.gather(self.rest, self.mail, window);
        }
        let origin = window.low();
        let mut sampler = RestSampler::new(self.rest, origin, window.size(), self.options.sampling);
        let local: [f32; 3] = std::array::from_fn(|c| first[c] as f32 - origin[c] as f32);
        let linear = self.options.sampling == Sampling::Linear;
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
            // 3. values. X = x is the exact pre-image of what did not move; the kernel stops within its tolerance of it
            let still = |i: usize| f32x4::new(own[i - range.start]).simd_eq(f32x4::ZERO).to_bitmask() == 0b1111;
            if all_linked && linear && converged[range.clone()].iter().all(|&c| c) {
                let moved = range.clone().fold(0, |bits, i| bits | u32::from(!still(i)) << i);
                report.voids += sampler.linear_row(&position, moved, self.void, out);
                continue;
            }
            // the few that did not converge, and what lies beside voids and cuts, are left
            for i in range.clone() {
                if still(i) && pieces.is_tissue([at(0, i), at(1, j), at(2, k)]) {
                    continue;
                }
                let (target, near) = (xyz(target[i]), position[i]);
                let near = if converged[i] { near } else { self.damped(window, target, &mut report) };
                if near.to_array()[3] == 0.0 && (all_linked || pieces.is_whole(xyz(near))) {
                    let value = sampler.stored(near);
                    report.voids += u64::from(value.is_none());
                    out[i] = value.unwrap_or(self.void);
                } else {
                    left.add(Open::new([i, j, k], target, xyz(near)));
                }
            }
        }
        // 4. the search
        if may_fold {
            report.folded = self.folded(first, open, window, pieces);
        }
        report.searched = left.all.len() as u64;
        left.search(window, pieces, local, self.inverter.stop());
        for voxel in &left.all {
            let [i, j, k] = voxel.at.map(usize::from);
            let out = &mut values[k * EDGE + j][i];
            let value = match voxel.found() {
                Some(position) => sampler.stored(register(position)),
                // tissue without voids and cuts has no gaps: the best position there is
                None if all_linked => {
                    report.failures += 1;
                    sampler.stored(register(voxel.near))
                }
                // deep in a void nothing changed; what tissue left, or its surface, is void now
                None => {
                    let at = std::array::from_fn(|c| first[c] + [i, j, k][c] - origin[c]);
                    let deep = !pieces.is_near_tissue(at) && !pieces.is_removed(at);
                    deep.then_some(*out)
                }
            };
            report.voids += u64::from(value.is_none());
            *out = value.unwrap_or(self.void);
        }
        left.clear();
        report
    }

    /// Whether a link of the bricks that hold a box of elements, or of those before them, is cut.
    fn is_cut(&self, range: Box3) -> bool {
        let layout = self.mail.layout();
        let bricks = |c: usize| range.low[c].saturating_sub(1) / EDGE..=range.high[c] / EDGE;
        bricks(2).any(|k| bricks(1).any(|j| bricks(0).any(|i| self.mail.cut_brick(layout.id([i, j, k])).is_some())))
    }

    /// Damped Newton from the voxel's own displacement; the fourth lane is not 0 where it did not converge.
    #[cold]
    fn damped(&self, window: &Window, target: [f32; 3], report: &mut MapReport) -> f32x4 {
        let inverter = Inverter { scheme: Scheme::Newton, ..self.inverter };
        let u = window.displacement(target);
        let found = inverter.invert(window, target, std::array::from_fn(|c| target[c] - u[c]));
        report.iterations += u64::from(found.iterations);
        let [x, y, z] = found.position;
        f32x4::new([x, y, z, if found.converged { 0.0 } else { 1.0 }])
    }

    /// Folded cells among those whose lower corner is to be solved.
    fn folded(&self, first: [usize; 3], open: &Spans, window: &Window, pieces: &Pieces) -> u64 {
        let (low, size) = (window.low(), window.size());
        let mut count = 0;
        for (row, span) in open.iter().enumerate() {
            for i in span[0] as usize..span[1] as usize {
                let base: [usize; 3] = std::array::from_fn(|c| first[c] + [i, row % EDGE, row / EDGE][c] - low[c]);
                count += u64::from((0..3).all(|c| base[c] + 2 <= size[c]) && search::is_folded(window, pieces, base));
            }
        }
        count
    }
}

/// A brick to be solved.
struct Job<'a, 'b, S: BrickSource + ?Sized> {
    solver: &'b Solver<'a, S>,
    work: &'b mut Workspace,
    id: BrickId,
    spans: &'b Spans,
    values: &'b mut Values,
}

impl<S: BrickSource + ?Sized> Task for Job<'_, '_, S> {
    type Output = MapReport;
    #[inline(always)]
    fn run(self) -> MapReport {
        self.solver.solve(self.work, self.id, self.spans, self.values)
    }
}

/// The part of a span of a brick's row between its first and its last moved element.
#[inline(always)]
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
#[inline(always)]
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

#[inline(always)]
fn register([x, y, z]: [f32; 3]) -> f32x4 {
    f32x4::new([x, y, z, 0.0])
}

/// A row's elements are bits of a word.
const _: () = assert!(EDGE <= 64 && EDGE.is_multiple_of(4));

/// Displacements fill a brick as voxels do.
const _: () = assert!(DisplacementBrick::offset(EDGE - 1, EDGE - 1, EDGE - 1) + 1 == EDGE * EDGE * EDGE);
