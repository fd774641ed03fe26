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
    vector::{Task, Width, widest},
    window::{Wide, Window},
};
use maille_chainmail::{ChainMail, DisplacementBrick};
use maille_displacement::{DisplacementField, Inverter, RowOutcome, Scheme};
use maille_volume::{Brick, BrickId, BrickSource, brick::EDGE};
use wide::f32x4;

/// Stored values of a brick's voxels; only those in the wanted spans mean something.
pub type Values = [i16; EDGE * EDGE * EDGE];

/// Working memory of one thread.
pub struct Workspace {
    pub window: Window,
    /// voxels to be solved (bits of each row)
    open: Box<[u64; ROWS]>,
    /// which elements of them are displaced (bits)
    moved: Box<[u64; ROWS]>,
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
            open: Box::new([0; ROWS]),
            moved: Box::new([0; ROWS]),
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
    fn solve<W: Width>(&self, width: W, work: &mut Workspace, id: BrickId, spans: &Spans, values: &mut Values) -> MapReport {
        let mut report = MapReport::default();
        let first = self.mail.layout().first_voxel(id);
        let displacement = self.mail.displacement_brick(id).filter(|_| self.mail.displacement_range(id) != [[0.0; 2]; 3]);
        // 1. rest values everywhere; what is left are the rows whose elements moved
        let (rest, values) = (self.rest.brick(id), values.as_chunks_mut::<EDGE>().0);
        let voids = self.mail.tissue().threshold_hu.is_some();
        let all_open = voids || self.mail.cut_brick(id).is_some();
        let Some((low, high)) = bounds(spans) else { return report };
        let (open, moved) = (&mut *work.open, &mut *work.moved);
        open.fill(0);
        let (mut any, mut rows) = (0, [[usize::MAX, 0]; 2]);
        for k in low[2]..=high[2] {
            for j in low[1]..=high[1] {
                let row = k * EDGE + j;
                let [from, to] = spans[row];
                if to == 0 {
                    continue;
                }
                report.voxels += u64::from(to - from);
                let start = Brick::offset(0, j as isize, k as isize);
                values[row].copy_from_slice(&rest.voxels[start..start + EDGE]);
                let wanted = bits(from, to);
                moved[row] = displacement.map_or(0, |d| moved_bits(d, row)) & wanted;
                // a void may be entered by others, and tissue at rest be taken out; else from the first to the last that moved
                open[row] = if all_open { wanted } else { filled(moved[row]) };
                any |= open[row];
                if open[row] != 0 {
                    rows = [[rows[0][0].min(j), rows[0][1].max(j)], [rows[1][0].min(k), rows[1][1].max(k)]];
                }
            }
        }
        if any == 0 {
            return report;
        }
        let low = [any.trailing_zeros() as usize, rows[0][0], rows[1][0]];
        let high = [63 - any.leading_zeros() as usize, rows[0][1], rows[1][1]];
        let voxels = Box3 { low: std::array::from_fn(|c| first[c] + low[c]), high: std::array::from_fn(|c| first[c] + high[c]) };
        let range = if self.gaps { preimage_box_beside_gaps(self.mail, voxels, &self.loaded) } else { preimage_box(self.mail, voxels) };
        work.window.gather(width, self.mail, range);
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
        let mut position = [f32x4::ZERO; EDGE];
        for (row, &here) in open.iter().enumerate().filter(|(_, bits)| **bits != 0) {
            let range = here.trailing_zeros() as usize..64 - here.leading_zeros() as usize;
            let out = &mut values[row];
            // 2. pre-images, in positions relative to the window's first element
            let (j, k) = (row % EDGE, row / EDGE);
            let row_start = f32x4::new([local[0], local[1] + j as f32, local[2] + k as f32, 0.0]);
            let at = |c: usize, v: usize| first[c] + v - origin[c];
            let own = &window.row(at(1, j), at(2, k))[at(0, range.start)..at(0, range.end)];
            // where the rows before were solved; all of them are there, whatever they hold
            let (before, guessed) = if j > 0 && k > 0 {
                let rows = [row - 1, row - EDGE, row - EDGE - 1];
                (rows, rows.iter().fold(here, |bits, &r| bits & open[r]))
            } else {
                ([0; 3], 0)
            };
            let (before_found, found) = found.split_at_mut(row);
            let outcome = width.run(Row {
                inverter: &self.inverter,
                window,
                start: row_start,
                range: range.clone(),
                own,
                before: before.map(|r| before_found.get(r).unwrap_or(&REST)),
                guessed,
                position: &mut position,
                found: &mut found[0],
            });
            report.iterations += u64::from(outcome.evaluations);
            // 3. values. X = x is the exact pre-image of what did not move; the kernel stops within its tolerance of it
            if all_linked && linear && outcome.open == 0 {
                report.voids += sampler.linear_row(width, &position, moved[row] as u32, self.void, out);
                continue;
            }
            // the few that did not converge, and what lies beside voids and cuts, are left
            for i in range.clone() {
                if moved[row] >> i & 1 == 0 && pieces.is_tissue([at(0, i), at(1, j), at(2, k)]) {
                    continue;
                }
                let (target, near) = (xyz(row_start + f32x4::new(UNITS[i])), position[i]);
                let near = if outcome.open >> i & 1 == 0 { near } else { self.damped(window, target, &mut report) };
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
    fn folded(&self, first: [usize; 3], open: &[u64; ROWS], window: &Window, pieces: &Pieces) -> u64 {
        let (low, size) = (window.low(), window.size());
        let mut count = 0;
        for (row, bits) in open.iter().enumerate() {
            for i in (0..EDGE).filter(|i| bits >> i & 1 == 1) {
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
    fn run<W: Width>(self, width: W) -> MapReport {
        self.solver.solve(width, self.work, self.id, self.spans, self.values)
    }
}

/// Nothing moved.
static REST: [f32x4; EDGE] = [f32x4::ZERO; EDGE];

/// The pre-images of a row, in positions relative to the window's first element: a function of its own, so that it has the registers.
struct Row<'a> {
    inverter: &'a Inverter,
    window: &'a Window,
    /// position of the brick's voxel at i = 0
    start: f32x4,
    range: std::ops::Range<usize>,
    /// displacements of the elements in the range
    own: &'a [[f32; 4]],
    /// x − X of the rows at (j − 1, k), (j, k − 1), (j − 1, k − 1), and where they have it (bits)
    before: [&'a [f32x4; EDGE]; 3],
    guessed: u64,
    position: &'a mut [f32x4; EDGE],
    /// x − X
    found: &'a mut [f32x4; EDGE],
}

impl Task for Row<'_> {
    type Output = RowOutcome;
    #[inline(always)]
    fn run<W: Width>(self, width: W) -> RowOutcome {
        let Self { inverter, window, start: first, range, own, before: [below, behind, corner], guessed, position, found } = self;
        let target = |i: usize| first + f32x4::new(UNITS[i % EDGE]);
        let (from, own) = (range.start, &own[..range.len()]);
        let start = |i: usize| {
            let guess = below[i % EDGE] + behind[i % EDGE] - corner[i % EDGE];
            let mask = f32x4::splat(f32::from_bits(((guessed >> i & 1) as u32).wrapping_neg()));
            target(i) - mask.bitselect(guess, f32x4::new(own[i - from]))
        };
        let outcome = inverter.invert_row_from(&Wide::new(window, width), target, range.clone(), start, position);
        for i in range {
            found[i % EDGE] = target(i) - position[i % EDGE];
        }
        outcome
    }
}

/// Which elements of a brick's row are displaced.
#[inline(always)]
fn moved_bits(displacement: &DisplacementBrick, row: usize) -> u64 {
    let [x, y, z] = displacement.u.each_ref().map(|plane| plane[row * EDGE..][..EDGE].as_chunks::<4>().0);
    let mut moved = 0u64;
    for part in 0..EDGE / 4 {
        let any = f32x4::new(x[part]) | f32x4::new(y[part]) | f32x4::new(z[part]);
        moved |= u64::from(any.simd_ne(f32x4::ZERO).to_bitmask()) << (4 * part);
    }
    moved
}

/// The bits of a span that is not empty.
#[inline(always)]
fn bits(from: u8, to: u8) -> u64 {
    u64::MAX << from & u64::MAX >> (64 - u32::from(to))
}

/// All bits from the first to the last.
#[inline(always)]
fn filled(set: u64) -> u64 {
    if set == 0 { 0 } else { u64::MAX << set.trailing_zeros() & u64::MAX >> set.leading_zeros() }
}

/// Steps along a row.
static UNITS: [[f32; 4]; EDGE] = {
    let (mut out, mut i) = ([[0.0; 4]; EDGE], 0);
    while i < EDGE {
        out[i][0] = i as f32;
        i += 1;
    }
    out
};

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
