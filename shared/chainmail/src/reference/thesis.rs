//! The thesis's method as it stands, whole: deformation, cubicles on demand and mapping [Dräger 2005, 3.5 and 3.6].
//!
//! *Deformation*: the eight enclosing elements move; candidates wait by violation; a sponsor along x passes on in x, y and z, one along y in y
//! and z, one along z in z, away from the other seven (the ignore directions of 3.5.3 and figures 3.22 to 3.24), so that every element has one
//! sponsor and is looked at once. A candidate moves the shortest way into the region of its *sponsor* (figure 3.23), shears along z
//! scaled by the z-scale (3.5.4). Bone and the movement limit stop the deformation; it is reverted and tried again with the vector times
//! `step_scale` (3.5.5, 4.6).
//!
//! *Memory*: cubicles of `CUBICLE`³ elements are loaded and linked to their neighbours when a candidate lies in them (3.6.4); beyond the volume they hold
//! elements of value zero.
//!
//! *Mapping*: the voxels of the grid elements in which a moved element lay and lies (figures 3.25 and 3.27), each once (a look-up
//! table). For each: walk from the first element of the cubicle that holds the position at rest to the nearest element (figure 3.18); try the
//! eight cubes at it that have a moved corner, each split into twelve tetrahedra around the mean of its corners, each solved by Gaussian
//! elimination (3.6.3); where none encloses the position, find the nearest by looking at all loaded elements and try again.
//!
//! Written for speed where the thesis leaves a choice: elements lie in one array and know their neighbours by number, the candidate list is
//! a binary heap, the look-up table an array of marks, volumes are dense. What the thesis does, it does; what it does not, it does
//! not. Its weaknesses (violated links, the walk that ends in a local minimum, one pass over all elements then) are its own.
//!
//! Units: voxels inside (z divided by the z-scale, 3.5.4), mm at the border. x and y spacing must be equal, as in the thesis.

use crate::tissue::Tissue;
use maille_volume::{BrickSource, Volume};
use std::collections::{BinaryHeap, HashMap};

/// Elements along the edge of a cubicle; the thesis times 3.
const CUBICLE: usize = 3;
/// No neighbour loaded.
const NONE: u32 = u32::MAX;
/// Rounding in barycentric coordinates: without it voxels on faces between tetrahedra are lost.
const SLACK: f32 = 1e-5;

/// One element of the object (the thesis's ChainMailVoxel).
#[derive(Clone, Copy)]
struct Element {
    /// rest position
    at: [i32; 3],
    /// displacement, and that before the deformation
    u: [f32; 3],
    last: [f32; 3],
    value: f32,
    /// chain region: offset minus adjustment
    region: f32,
    /// movement limit; 0 for bone
    limit: f32,
    /// left, right, and so on along y and z
    neighbours: [u32; 6],
    /// sides (0 … 5) to which nothing is passed on, by axis
    ignore: [u8; 3],
    moved: bool,
}

/// A candidate: violation (ordered bits), order of entry, itself, its sponsor, side of the candidate as seen from the sponsor.
type Candidate = (u32, u32, u32, u32, u8);

/// What a deformation did.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Deformed {
    /// elements moved
    pub moved: usize,
    /// tries, the successful one included; 0: all failed
    pub tries: u32,
    /// elements loaded so far
    pub loaded: usize,
}

/// What mapping did.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Mapped {
    /// voxels calculated
    pub voxels: usize,
    /// tetrahedra solved
    pub eliminations: usize,
    /// positions for which all loaded elements were searched
    pub searches: usize,
    /// positions that no cube with a moved corner encloses: they keep their value
    pub unenclosed: usize,
}

/// The ChainMail object with its volume.
pub struct Thesis {
    rest: Volume,
    /// the volume that is rewritten
    pub volume: Vec<i16>,
    tissue: Tissue,
    z_scale: f32,
    elements: Vec<Element>,
    cubicles: HashMap<[i32; 3], u32>,
    candidates: BinaryHeap<Candidate>,
    moved: Vec<u32>,
    /// deformation in which a voxel was calculated last
    calculated: Vec<u32>,
    deformation: u32,
    max_tries: u32,
    step_scale: f32,
}

impl Thesis {
    /// An empty object over a volume at rest.
    pub fn new<S: BrickSource + ?Sized>(rest: &S, tissue: &Tissue, max_tries: u32, step_scale: f32) -> Self {
        let rest = rest.to_volume();
        let spacing = rest.info.grid.spacing;
        Self {
            volume: rest.voxels.clone(),
            calculated: vec![0; rest.voxels.len()],
            z_scale: (spacing[2] / spacing[0]) as f32,
            rest,
            tissue: *tissue,
            elements: Vec::new(),
            cubicles: HashMap::new(),
            candidates: BinaryHeap::new(),
            moved: Vec::new(),
            deformation: 0,
            max_tries,
            step_scale,
        }
    }

    /// Forgets all elements, as the thesis does when a deformation begins elsewhere, and puts the volume back.
    pub fn clear(&mut self) {
        self.elements.clear();
        self.cubicles.clear();
        self.moved.clear();
        self.volume.copy_from_slice(&self.rest.voxels);
    }

    /// Everything back to rest, but still loaded.
    pub fn reset(&mut self) {
        for element in &mut self.elements {
            (element.u, element.last, element.moved) = ([0.0; 3], [0.0; 3], false);
        }
        self.moved.clear();
        self.volume.copy_from_slice(&self.rest.voxels);
    }

    /// Displacement [mm, along the grid's axes] of an element; zero where none is loaded.
    pub fn displacement(&self, voxel: [usize; 3]) -> [f32; 3] {
        let u = self.find(voxel.map(|v| v as i32)).map_or([0.0; 3], |n| self.elements[n as usize].u);
        std::array::from_fn(|c| u[c] * self.rest.info.grid.spacing[c] as f32)
    }

    /// Moves the eight elements of the cell above `corner` by a vector [mm, along the grid's axes].
    pub fn deform(&mut self, corner: [usize; 3], vector: [f32; 3]) -> Deformed {
        self.deformation += 1;
        let mut path: [f32; 3] = std::array::from_fn(|c| vector[c] / self.rest.info.grid.spacing[c] as f32);
        for n in std::mem::take(&mut self.moved) {
            self.elements[n as usize].moved = false;
        }
        let corner = corner.map(|v| v as i32);
        let cube: [u32; 8] =
            std::array::from_fn(|n| self.load([corner[0] + (n & 1) as i32, corner[1] + (n >> 1 & 1) as i32, corner[2] + (n >> 2) as i32]));
        for tries in 1..=self.max_tries {
            if self.try_deform(&cube, path) {
                return Deformed { moved: self.moved.len(), tries, loaded: self.elements.len() };
            }
            for n in std::mem::take(&mut self.moved) {
                let element = &mut self.elements[n as usize];
                (element.u, element.moved) = (element.last, false);
            }
            path = path.map(|v| v * self.step_scale);
        }
        Deformed { moved: 0, tries: 0, loaded: self.elements.len() }
    }

    /// One try; `false`: bone or a movement limit is violated.
    fn try_deform(&mut self, cube: &[u32; 8], path: [f32; 3]) -> bool {
        self.candidates.clear();
        let mut entered = u32::MAX;
        for (n, &element) in cube.iter().enumerate() {
            // the other initially moved neighbour lies on the opposite side
            self.elements[element as usize].ignore = std::array::from_fn(|axis| (2 * axis + usize::from(n >> axis & 1 == 0)) as u8);
            if !self.shift(element, path) {
                return false;
            }
        }
        for &element in cube {
            for axis in 0..3 {
                self.add_candidate(element, self.elements[element as usize].ignore[axis] ^ 1, &mut entered);
            }
        }
        while let Some((_, _, candidate, sponsor, side)) = self.candidates.pop() {
            let path = self.path(sponsor, candidate, side);
            if path == [0.0; 3] {
                continue;
            }
            self.elements[candidate as usize].ignore = self.elements[sponsor as usize].ignore;
            if !self.shift(candidate, path) {
                return false;
            }
            // along the sponsoring axis onwards, and aside along the later axes
            self.add_candidate(candidate, side, &mut entered);
            for axis in side as usize / 2 + 1..3 {
                self.add_candidate(candidate, self.elements[candidate as usize].ignore[axis] ^ 1, &mut entered);
            }
        }
        true
    }

    /// Moves an element, if bone and movement limit allow it.
    fn shift(&mut self, n: u32, path: [f32; 3]) -> bool {
        let element = &mut self.elements[n as usize];
        if element.limit == 0.0 {
            return false;
        }
        element.last = element.u;
        (0..3).for_each(|c| element.u[c] += path[c]);
        element.moved = true;
        self.moved.push(n);
        let limit = element.limit;
        element.u.iter().all(|u| u.abs() <= limit)
    }

    /// Enters the neighbour on a side as a candidate if it violates the region of its sponsor.
    fn add_candidate(&mut self, sponsor: u32, side: u8, entered: &mut u32) {
        let mut candidate = self.elements[sponsor as usize].neighbours[side as usize];
        if candidate == NONE {
            let mut at = self.elements[sponsor as usize].at;
            at[side as usize / 2] += if side % 2 == 1 { 1 } else { -1 };
            candidate = self.load(at);
        }
        let path = self.path(sponsor, candidate, side);
        let violation = path.iter().fold(0.0f32, |m, v| m.max(v.abs()));
        if violation > 0.0 {
            *entered -= 1;
            self.candidates.push((violation.to_bits(), *entered, candidate, sponsor, side));
        }
    }

    /// The shortest way of a candidate into the region of its sponsor (figure 3.23; the rest distance is taken off on both sides).
    #[inline]
    fn path(&self, sponsor: u32, candidate: u32, side: u8) -> [f32; 3] {
        let (s, c) = (&self.elements[sponsor as usize], &self.elements[candidate as usize]);
        let axis = side as usize / 2;
        std::array::from_fn(|n| {
            let limit = if axis == 2 && n != 2 {
                s.region * self.z_scale
            } else if axis != 2 && n == 2 {
                s.region / self.z_scale
            } else {
                s.region
            };
            let apart = c.u[n] - s.u[n];
            if apart < -limit {
                -limit - apart
            } else if apart > limit {
                limit - apart
            } else {
                0.0
            }
        })
    }

    /// The loaded element at a rest position.
    #[inline]
    fn find(&self, at: [i32; 3]) -> Option<u32> {
        let cubicle = at.map(|v| v.div_euclid(CUBICLE as i32));
        let inside = at.map(|v| v.rem_euclid(CUBICLE as i32) as usize);
        self.cubicles.get(&cubicle).map(|&first| first + ((inside[2] * CUBICLE + inside[1]) * CUBICLE + inside[0]) as u32)
    }

    /// The element at a rest position, its cubicle loaded and connected.
    fn load(&mut self, at: [i32; 3]) -> u32 {
        if let Some(n) = self.find(at) {
            return n;
        }
        let cubicle = at.map(|v| v.div_euclid(CUBICLE as i32));
        let first = self.elements.len() as u32;
        let grid = &self.rest.info.grid;
        for n in 0..CUBICLE * CUBICLE * CUBICLE {
            let inside = [n % CUBICLE, n / CUBICLE % CUBICLE, n / (CUBICLE * CUBICLE)];
            let at: [i32; 3] = std::array::from_fn(|c| cubicle[c] * CUBICLE as i32 + inside[c] as i32);
            let stored = if (0..3).all(|c| (0..grid.size[c] as i32).contains(&at[c])) {
                self.rest.voxels[grid.offset(at[0] as usize, at[1] as usize, at[2] as usize)]
            } else {
                0
            };
            let limits = self.tissue.limits(self.rest.info.rescale.value(f64::from(stored)));
            self.elements.push(Element {
                at,
                u: [0.0; 3],
                last: [0.0; 3],
                value: f32::from(stored),
                region: limits.offset,
                limit: limits.bound,
                neighbours: [NONE; 6],
                ignore: [0; 3],
                moved: false,
            });
        }
        self.cubicles.insert(cubicle, first);
        // links inside, and to the cubicles that are there
        for n in first..first + (CUBICLE * CUBICLE * CUBICLE) as u32 {
            for side in 0..6usize {
                let mut to = self.elements[n as usize].at;
                to[side / 2] += if side % 2 == 1 { 1 } else { -1 };
                if let Some(neighbour) = self.find(to) {
                    self.elements[n as usize].neighbours[side] = neighbour;
                    self.elements[neighbour as usize].neighbours[side ^ 1] = n;
                }
            }
        }
        first + (at.map(|v| v.rem_euclid(CUBICLE as i32) as u32).iter().rev().fold(0, |n, v| n * CUBICLE as u32 + v))
    }

    /// Maps the last deformation into the volume.
    pub fn map(&mut self) -> Mapped {
        let mut out = Mapped::default();
        let size = self.rest.info.grid.size;
        for m in 0..self.moved.len() {
            let element = &self.elements[self.moved[m] as usize];
            let positions = [element.u, element.last].map(|u| -> [i32; 3] { std::array::from_fn(|c| element.at[c] + u[c].floor() as i32) });
            for base in positions {
                for n in 0..8i32 {
                    let voxel = [base[0] + (n & 1), base[1] + (n >> 1 & 1), base[2] + (n >> 2)];
                    if (0..3).any(|c| voxel[c] < 0 || voxel[c] >= size[c] as i32) {
                        continue;
                    }
                    let flat = self.rest.info.grid.offset(voxel[0] as usize, voxel[1] as usize, voxel[2] as usize);
                    if std::mem::replace(&mut self.calculated[flat], self.deformation) == self.deformation {
                        continue;
                    }
                    out.voxels += 1;
                    match self.value(voxel, &mut out) {
                        Some(value) => self.volume[flat] = (value + 0.5).floor().clamp(f32::from(i16::MIN), f32::from(i16::MAX)) as i16,
                        None => out.unenclosed += 1,
                    }
                }
            }
        }
        out
    }

    #[inline]
    fn distance2(&self, n: u32, position: [f32; 3]) -> f32 {
        let e = &self.elements[n as usize];
        // in the frame of the position, where floats are fine
        (0..3).map(|c| (e.at[c] as f32 - position[c] + e.u[c]).powi(2)).sum()
    }

    /// The value at a voxel.
    fn value(&self, voxel: [i32; 3], out: &mut Mapped) -> Option<f32> {
        let position = voxel.map(|v| v as f32);
        // walk from the first element of the cubicle
        let start = self.cubicles.get(&voxel.map(|v| v.div_euclid(CUBICLE as i32)));
        let near = start.map(|&n| self.walk(n, position));
        if let Some(value) = near.and_then(|n| self.try_cubes(n, position, out)) {
            return Some(value);
        }
        // all loaded elements
        out.searches += 1;
        let nearest =
            (0..self.elements.len() as u32).min_by(|&a, &b| self.distance2(a, position).total_cmp(&self.distance2(b, position)))?;
        if near == Some(nearest) { None } else { self.try_cubes(nearest, position, out) }
    }

    fn walk(&self, mut n: u32, position: [f32; 3]) -> u32 {
        let mut best = self.distance2(n, position);
        loop {
            let mut next = NONE;
            for &to in &self.elements[n as usize].neighbours {
                if to != NONE {
                    let d = self.distance2(to, position);
                    if d < best {
                        (best, next) = (d, to);
                    }
                }
            }
            if next == NONE {
                return n;
            }
            n = next;
        }
    }

    /// Tries the eight cubes at an element.
    fn try_cubes(&self, near: u32, position: [f32; 3], out: &mut Mapped) -> Option<f32> {
        for n in 0..8usize {
            let Some(cube) = self.cube(near, n) else { continue };
            if !cube.iter().any(|&e| self.elements[e as usize].moved) {
                continue;
            }
            // corners around the position, and the virtual element in the middle
            let mut p = [[0.0f32; 3]; 9];
            let mut value = [0.0f32; 9];
            for (m, &e) in cube.iter().enumerate() {
                let e = &self.elements[e as usize];
                p[m] = std::array::from_fn(|c| e.at[c] as f32 - position[c] + e.u[c]);
                value[m] = e.value;
                (0..3).for_each(|c| p[8][c] += 0.125 * p[m][c]);
                value[8] += 0.125 * value[m];
            }
            for tetrahedron in &TWELVE {
                out.eliminations += 1;
                let Some(b) = barycentric(tetrahedron.map(|m| p[m])) else { continue };
                if b.iter().all(|v| (-SLACK..=1.0 + SLACK).contains(v)) {
                    return Some((0..4).map(|m| b[m] * value[tetrahedron[m]]).sum());
                }
            }
        }
        None
    }

    /// The eight elements of a cube at an element, towards the sides that the bits of `n` tell; in order of corners.
    #[inline]
    fn cube(&self, near: u32, n: usize) -> Option<[u32; 8]> {
        let mut out = [NONE; 8];
        // the lower corner first
        let mut low = near;
        for axis in 0..3 {
            if n >> axis & 1 == 1 {
                low = self.elements[low as usize].neighbours[2 * axis];
                if low == NONE {
                    return None;
                }
            }
        }
        out[0] = low;
        for m in 1..8usize {
            let axis = m.trailing_zeros() as usize;
            let to = self.elements[out[m & (m - 1)] as usize].neighbours[2 * axis + 1];
            if to == NONE {
                return None;
            }
            out[m] = to;
        }
        Some(out)
    }
}

/// Corner m of a cube is (m & 1, m >> 1 & 1, m >> 2), the middle 8: the twelve of 3.6.3, two to a face.
const TWELVE: [[usize; 4]; 12] = [
    [8, 0, 1, 3],
    [8, 0, 3, 2],
    [8, 0, 4, 6],
    [8, 0, 2, 6],
    [8, 0, 1, 5],
    [8, 0, 4, 5],
    [8, 7, 1, 5],
    [8, 7, 1, 3],
    [8, 7, 3, 2],
    [8, 7, 2, 6],
    [8, 7, 4, 5],
    [8, 7, 4, 6],
];

/// Solves equations 3.1 to 3.4 for the origin by Gaussian elimination with pivots; `None`: the tetrahedron is flat.
#[inline]
fn barycentric(corners: [[f32; 3]; 4]) -> Option<[f32; 4]> {
    let mut m = [[0.0f32; 5]; 4];
    for (n, p) in corners.iter().enumerate() {
        for c in 0..3 {
            m[c][n] = p[c];
        }
        m[3][n] = 1.0;
    }
    m[3][4] = 1.0;
    for column in 0..4 {
        let pivot = (column..4).max_by(|&a, &b| m[a][column].abs().total_cmp(&m[b][column].abs()))?;
        if m[pivot][column].abs() < 1e-9 {
            return None;
        }
        m.swap(column, pivot);
        for row in column + 1..4 {
            let (above, factor) = (m[column], m[row][column] / m[column][column]);
            for (v, a) in m[row][column..].iter_mut().zip(&above[column..]) {
                *v -= factor * a;
            }
        }
    }
    let mut b = [0.0f32; 4];
    for row in (0..4).rev() {
        let rest: f32 = (row + 1..4).map(|c| m[row][c] * b[c]).sum();
        b[row] = (m[row][4] - rest) / m[row][row];
    }
    Some(b)
}
