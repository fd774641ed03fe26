//! Marching cubes [Lorensen & Cline 1987] with shared vertices, on the lattice of voxel centres.
//!
//! A vertex lies on each lattice edge whose ends are on different sides, at t = (iso − a)/(b − a); its normal is −∇f,
//! with ∇f from central differences at the two ends (one-sided at the border), interpolated by the same t. Which
//! vertices make triangles is told by [`crate::table`].
//!
//! A first pass marks inside voxels in bits and counts the vertices of every slice, so that each vertex has its number before it is
//! made: those of slice k come after all of slice k − 1, first the edges in the slice row by row, then the edges that go up
//! from it. A second pass makes chunks of slices in parallel. It finds numbers in two slices of edge indices that follow it
//! upwards (as Flying Edges does for rows [Schroeder, Maynard & Geveci 2015]), and looks only at cells that
//! the bits show to be crossed.
//!
//! Invariants: chunks have a fixed number of slices, so the mesh does not depend on threads. Where a voxel equals the isovalue it
//! is inside and triangles may have no area, but the topology holds.
//!
//! Cost: one pass of the voxels' bandwidth, then in proportion to the surface. Memory: an eighth of a byte a voxel, a few slices of
//! indices a thread, the mesh. Not here: decimation, smoothing.

use crate::{
    inside::{Inside, each, shifted},
    mesh::Mesh,
    table,
};
use maille_volume::{
    BrickSource, Volume, VolumeInfo,
    brick::{Brick, EDGE, ROW, SLICE},
};
use nalgebra::{Matrix3, Vector3};
use rayon::prelude::*;

/// Slices a chunk of parallel work holds.
const CHUNK: usize = 8;

/// What happens where the surface meets the volume's border.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Border {
    /// it ends at the outermost voxel centres
    #[default]
    Open,
    /// outside the volume everything counts as outside, and the surface closes half a voxel beyond the outermost centres
    Closed,
}

/// The isosurface `iso` (HU) of a volume; it ends at the volume's border.
pub fn marching_cubes(volume: &Volume, iso: f64) -> Mesh {
    marching_cubes_with(volume, iso, Border::Open)
}

/// The isosurface of a volume in bricks, read where they lie; bricks that the surface does not pass cost a look at their skip cells.
/// For a closed border the voxels are copied into a flat volume first.
pub fn marching_cubes_bricks(source: &impl BrickSource, iso: f64, border: Border) -> Mesh {
    if border == Border::Closed {
        return marching_cubes_with(&source.to_volume(), iso, border);
    }
    let Some(Level { level, threshold, below }) = Level::new(source.info(), iso) else { return Mesh::default() };
    let size = source.layout().size;
    if size.iter().any(|&n| n < 2) {
        return Mesh::default();
    }
    let inside = Inside::of_bricks(source, threshold, below);
    Extraction { size, voxels: Bricks(source), inside, level, padded: false, place: Place::new(source.info(), 0.0) }.run()
}

/// An isovalue in stored numbers.
struct Level {
    level: f32,
    /// smallest stored number inside, or outside if `below`
    threshold: i32,
    below: bool,
}

impl Level {
    /// `None` for an isovalue that is not finite.
    fn new(info: &VolumeInfo, iso: f64) -> Option<Self> {
        let level = info.rescale.stored(iso);
        // with a falling rescale the bright side is that of small stored numbers
        let below = info.rescale.slope < 0.0;
        let threshold = if below { level.floor() + 1.0 } else { level.ceil() }.clamp(-40_000.0, 40_000.0) as i32;
        level.is_finite().then_some(Self { level: level as f32, threshold, below })
    }
}

/// The isosurface `iso` (HU) of a volume. Empty for an isovalue that is not finite.
///
/// # Panics
/// When the mesh would have 2³² vertices or more.
pub fn marching_cubes_with(volume: &Volume, iso: f64, border: Border) -> Mesh {
    let Some(Level { level, threshold, below }) = Level::new(&volume.info, iso) else { return Mesh::default() };
    let size = volume.info.grid.size;
    let flat = |size: [usize; 3], voxels: &[i16], shift, padded| {
        if size.iter().any(|&n| n < 2) {
            return Mesh::default();
        }
        // the layer around a padded volume is outside whatever the isovalue
        let threshold = if padded { threshold.clamp(-32_767, 32_767) } else { threshold };
        let inside = Inside::new(size, voxels, threshold, below);
        Extraction { size, voxels: Flat { size, voxels }, inside, level, padded, place: Place::new(&volume.info, shift) }.run()
    };
    match border {
        Border::Open => flat(size, &volume.voxels, 0.0, false),
        Border::Closed => {
            let outside = if below { i16::MAX } else { i16::MIN };
            let (size, voxels) = padded(size, &volume.voxels, outside);
            flat(size, &voxels, 1.0, true)
        }
    }
}

/// The volume with a layer of `outside` around it.
fn padded(size: [usize; 3], voxels: &[i16], outside: i16) -> ([usize; 3], Vec<i16>) {
    let wide = size.map(|n| n + 2);
    let mut out = vec![outside; wide[0] * wide[1] * wide[2]];
    for (row, voxels) in voxels.chunks(size[0]).enumerate() {
        let start = ((row / size[1] + 1) * wide[1] + row % size[1] + 1) * wide[0] + 1;
        out[start..start + size[0]].copy_from_slice(voxels);
    }
    (wide, out)
}

/// From the lattice to patient space.
struct Place {
    matrix: Matrix3<f64>,
    origin: Vector3<f64>,
    /// takes −∂f/∂i to the outward normal's direction
    normal: Matrix3<f64>,
    /// the lattice's axes make a left hand: triangles turn round
    mirrored: bool,
}

impl Place {
    fn new(info: &VolumeInfo, shift: f64) -> Self {
        let grid = &info.grid;
        let matrix = grid.world_from_index_matrix();
        let origin = Vector3::from(grid.origin) - matrix * Vector3::repeat(shift);
        let normal = -info.rescale.slope.signum() * grid.index_from_world_matrix().transpose();
        Self { matrix, origin, normal, mirrored: matrix.determinant() < 0.0 }
    }
}

/// Where voxels are fetched at the few places that the surface passes.
trait Fetch: Sync {
    /// What is around the lattice edge from `at` along `axis`.
    fn edge(&self, at: [usize; 3], axis: usize) -> impl Ends;
}

/// Voxels around a lattice edge.
trait Ends {
    /// The voxel at the edge's start (or its end), or `step` (−1, 0, 1) from it along an axis; not asked for beyond the border.
    fn voxel(&self, end: bool, axis: usize, step: isize) -> f32;
}

/// A flat volume.
struct Flat<'a> {
    size: [usize; 3],
    voxels: &'a [i16],
}

/// A volume in bricks.
struct Bricks<'a, S>(&'a S);

/// Voxels in one array with strides; both kinds of volume come to this.
struct Strided<'a> {
    voxels: &'a [i16],
    here: usize,
    along: usize,
    step: [usize; 3],
}

impl Ends for Strided<'_> {
    #[inline(always)]
    fn voxel(&self, end: bool, axis: usize, step: isize) -> f32 {
        let here = if end { self.here + self.along } else { self.here };
        f32::from(self.voxels[here.wrapping_add_signed(step * self.step[axis] as isize)])
    }
}

impl Fetch for Flat<'_> {
    #[inline(always)]
    fn edge(&self, at: [usize; 3], axis: usize) -> impl Ends {
        let [nx, ny, _] = self.size;
        let step = [1, nx, nx * ny];
        Strided { voxels: self.voxels, here: (at[2] * ny + at[1]) * nx + at[0], along: step[axis], step }
    }
}

impl<S: BrickSource> Fetch for Bricks<'_, S> {
    #[inline(always)]
    fn edge(&self, at: [usize; 3], axis: usize) -> impl Ends {
        // the apron holds the neighbours of both ends
        let brick = self.0.brick(self.0.layout().brick_of(at[0], at[1], at[2]));
        let [i, j, k] = at.map(|v| (v % EDGE) as isize);
        let step = [1, ROW, SLICE];
        Strided { voxels: &brick.voxels, here: Brick::offset(i, j, k), along: step[axis], step }
    }
}

struct Extraction<F> {
    size: [usize; 3],
    voxels: F,
    inside: Inside,
    level: f32,
    padded: bool,
    place: Place,
}

/// Numbers of the vertices on lattice edges, of two slices and the layer between them; only crossed edges' are ever read.
struct Numbers {
    /// edges along x and y of the slice below and the slice above
    x: [Vec<u32>; 2],
    y: [Vec<u32>; 2],
    /// edges along z between them
    z: Vec<u32>,
}

/// Where a chunk's vertices go: the part of the mesh that is its own.
struct Out<'o> {
    positions: std::slice::IterMut<'o, [f32; 3]>,
    normals: std::slice::IterMut<'o, [f32; 3]>,
}

impl<F: Fetch> Extraction<F> {
    fn run(&self) -> Mesh {
        let [_, _, nz] = self.size;
        // first pass: the number of the first vertex of every slice
        let counts: Vec<usize> = (0..nz).into_par_iter().map(|k| self.count_slice(k)).collect();
        let mut first = vec![0usize; nz + 1];
        for k in 0..nz {
            first[k + 1] = first[k] + counts[k];
        }
        assert!(first[nz] < u32::MAX as usize, "a mesh numbers its vertices in 32 bits");
        let mut positions = vec![[0f32; 3]; first[nz]];
        let mut normals = vec![[0f32; 3]; first[nz]];
        // cut the mesh into the chunks' own parts
        let mut parts = Vec::new();
        let (mut p, mut n) = (&mut positions[..], &mut normals[..]);
        for k0 in (0..nz).step_by(CHUNK) {
            let count = first[(k0 + CHUNK).min(nz)] - first[k0];
            let (own_p, rest_p) = p.split_at_mut(count);
            let (own_n, rest_n) = n.split_at_mut(count);
            parts.push((k0, own_p, own_n));
            (p, n) = (rest_p, rest_n);
        }
        let chunks: Vec<Vec<[u32; 3]>> = parts
            .into_par_iter()
            .map(|(k0, p, n)| self.chunk(k0, &first, Out { positions: p.iter_mut(), normals: n.iter_mut() }))
            .collect();
        let mut triangles = vec![[0u32; 3]; chunks.iter().map(Vec::len).sum()];
        let mut places = Vec::new();
        let mut rest = &mut triangles[..];
        for chunk in &chunks {
            let (own, after) = rest.split_at_mut(chunk.len());
            places.push((own, chunk));
            rest = after;
        }
        places.into_par_iter().for_each(|(own, chunk)| own.copy_from_slice(chunk));
        Mesh { positions, normals, triangles }
    }

    /// Vertices of slice k and of the layer above it.
    fn count_slice(&self, k: usize) -> usize {
        let [_, ny, nz] = self.size;
        let mut count = 0;
        for j in 0..ny {
            let row = self.inside.row(j, k);
            for word in 0..row.len() {
                count += self.inside.crossings_x(row, word).count_ones();
                if j + 1 < ny {
                    count += (row[word] ^ self.inside.row(j + 1, k)[word]).count_ones();
                }
                if k + 1 < nz {
                    count += (row[word] ^ self.inside.row(j, k + 1)[word]).count_ones();
                }
            }
        }
        count as usize
    }

    /// Makes the vertices of `CHUNK` slices from k0 and the triangles above each.
    fn chunk(&self, k0: usize, first: &[usize], mut out: Out) -> Vec<[u32; 3]> {
        let [nx, ny, nz] = self.size;
        let end = (k0 + CHUNK).min(nz);
        let mut triangles = Vec::new();
        // nothing crosses these slices nor the next: nothing to do
        if first[k0] == first[(end + 1).min(nz)] {
            return triangles;
        }
        let plane = || vec![0u32; nx * ny];
        let mut numbers = Numbers { x: [plane(), plane()], y: [plane(), plane()], z: plane() };
        self.slice(k0, first[k0], &mut numbers, 0, Some(&mut out));
        for k in k0..end {
            if k + 1 == nz {
                break;
            }
            let in_slice = self.layer(k, first, &mut numbers, &mut out);
            let (below, above) = ((k - k0) % 2, (k - k0 + 1) % 2);
            debug_assert!(in_slice <= first[k + 1]);
            self.slice(k + 1, first[k + 1], &mut numbers, above, (k + 1 < end).then_some(&mut out));
            self.triangles(k, &numbers, [below, above], &mut triangles);
        }
        triangles
    }

    /// Numbers the vertices in slice k, and makes them if `out` is given.
    fn slice(&self, k: usize, first: usize, numbers: &mut Numbers, which: usize, mut out: Option<&mut Out>) {
        let [nx, ny, _] = self.size;
        let mut next = first as u32;
        for j in 0..ny {
            let row = self.inside.row(j, k);
            for word in 0..row.len() {
                each(self.inside.crossings_x(row, word), |bit| {
                    let i = word * 64 + bit;
                    numbers.x[which][j * nx + i] = next;
                    next += 1;
                    if let Some(out) = &mut out {
                        self.vertex([i, j, k], 0, out);
                    }
                });
            }
            if j + 1 == ny {
                break;
            }
            let above = self.inside.row(j + 1, k);
            for word in 0..row.len() {
                each(row[word] ^ above[word], |bit| {
                    let i = word * 64 + bit;
                    numbers.y[which][j * nx + i] = next;
                    next += 1;
                    if let Some(out) = &mut out {
                        self.vertex([i, j, k], 1, out);
                    }
                });
            }
        }
    }

    /// Numbers and makes the vertices between slices k and k + 1; returns the number after the last.
    fn layer(&self, k: usize, first: &[usize], numbers: &mut Numbers, out: &mut Out) -> usize {
        let [nx, ny, _] = self.size;
        // they are the last of the slice: count back from the next slice's first
        let rows = |j: usize| self.inside.row(j, k).iter().zip(self.inside.row(j, k + 1)).map(|(a, b)| a ^ b);
        let count: usize = (0..ny).flat_map(rows).map(|word| word.count_ones() as usize).sum();
        let mut next = (first[k + 1] - count) as u32;
        for j in 0..ny {
            for (word, crossed) in rows(j).enumerate() {
                each(crossed, |bit| {
                    let i = word * 64 + bit;
                    numbers.z[j * nx + i] = next;
                    next += 1;
                    self.vertex([i, j, k], 2, out);
                });
            }
        }
        next as usize
    }

    /// Makes the vertex on the lattice edge that goes from voxel `at` along `axis`.
    #[inline]
    fn vertex(&self, at: [usize; 3], axis: usize, out: &mut Out) {
        let mut end = at;
        end[axis] += 1;
        let ends = self.voxels.edge(at, axis);
        let [a, b] = [false, true].map(|e| ends.voxel(e, axis, 0));
        let mut t = (self.level - a) / (b - a);
        let mut gradient: Vector3<f64>;
        if self.padded && (at[axis] == 0 || end[axis] == self.size[axis] - 1) {
            // the edge leaves the volume: half way out, facing out along it
            t = 0.5;
            gradient = Vector3::zeros();
            gradient[axis] = f64::from(b - a);
        } else {
            let [low, high] = [self.gradient(at, &ends, false), self.gradient(end, &ends, true)];
            gradient = Vector3::from_fn(|c, _| f64::from(low[c] + t * (high[c] - low[c])));
            if gradient == Vector3::zeros() {
                gradient[axis] = f64::from(b - a);
            }
        }
        let mut index = Vector3::from(at.map(|n| n as f64));
        index[axis] += f64::from(t);
        let world = self.place.matrix * index + self.place.origin;
        let normal = (self.place.normal * gradient).normalize();
        *out.positions.next().expect("vertices were counted") = world.map(|x| x as f32).into();
        *out.normals.next().expect("vertices were counted") = normal.map(|x| x as f32).into();
    }

    /// Central differences at a voxel, by index; one-sided at the border, and beside padding.
    #[inline]
    fn gradient(&self, at: [usize; 3], ends: &impl Ends, end: bool) -> [f32; 3] {
        let edge = usize::from(self.padded);
        std::array::from_fn(|c| {
            let (low, high) = (-isize::from(at[c] > edge), isize::from(at[c] + 1 + edge < self.size[c]));
            let difference = ends.voxel(end, c, high) - ends.voxel(end, c, low);
            if high - low == 2 { 0.5 * difference } else { difference }
        })
    }

    /// Triangles of the cells between slices k and k + 1.
    fn triangles(&self, k: usize, numbers: &Numbers, which: [usize; 2], out: &mut Vec<[u32; 3]>) {
        let [nx, ny, _] = self.size;
        let cases = table::cases();
        let [below, above] = which;
        for j in 0..ny - 1 {
            let rows = [self.inside.row(j, k), self.inside.row(j + 1, k), self.inside.row(j, k + 1), self.inside.row(j + 1, k + 1)];
            for word in 0..rows[0].len() {
                let here = rows.map(|row| row[word]);
                let next = rows.map(|row| shifted(row, word));
                let any = here.iter().chain(&next).fold(0, |a, b| a | b);
                let all = here.iter().chain(&next).fold(u64::MAX, |a, b| a & b);
                each(any & !all & self.inside.cells(word), |bit| {
                    let mut mask = 0;
                    for n in 0..4 {
                        mask |= (here[n] >> bit & 1) << (2 * n) | (next[n] >> bit & 1) << (2 * n + 1);
                    }
                    let at = j * nx + word * 64 + bit;
                    let number = |edge: u8| match edge {
                        0 => numbers.x[below][at],
                        1 => numbers.x[below][at + nx],
                        2 => numbers.x[above][at],
                        3 => numbers.x[above][at + nx],
                        4 => numbers.y[below][at],
                        5 => numbers.y[below][at + 1],
                        6 => numbers.y[above][at],
                        7 => numbers.y[above][at + 1],
                        8 => numbers.z[at],
                        9 => numbers.z[at + 1],
                        10 => numbers.z[at + nx],
                        _ => numbers.z[at + nx + 1],
                    };
                    for &[a, b, c] in cases[mask as usize].triangles() {
                        let [a, b, c] = [number(a), number(b), number(c)];
                        out.push(if self.place.mirrored { [a, c, b] } else { [a, b, c] });
                    }
                });
            }
        }
    }
}
