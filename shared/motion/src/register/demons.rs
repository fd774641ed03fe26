//! The demons and their regularisation; see the module above.

use super::mask::connected;
use super::pyramid::{Lattice, Wanted, double, gradient, halve, smooth, smooth_lines, trilinear};
use crate::resample::jacobian_determinant;
use maille_displacement::in_patient;
use maille_volume::{Grid, ScalarField, VectorField};
use nalgebra::{Matrix3, Vector3};
use rayon::prelude::*;

/// How two images are registered.
#[derive(Clone, Debug, PartialEq)]
pub struct RegisterOptions {
    /// iterations on each level, coarsest first; each level has twice the spacing of the next
    pub iterations: Vec<usize>,
    /// σ of the regularising Gaussian [voxels of the level]
    pub sigma: f32,
    /// κ: twice the longest step [voxels of the level]
    pub kappa: f32,
    /// σ of the Gaussian that stiffens bone [mm]
    pub stiff_mm: f32,
    /// det J below which a cell is smoothed at the end
    pub least_determinant: f32,
}

/// What is known of the reference's anatomy, one truth a voxel.
#[derive(Clone, Copy, Debug, Default)]
pub struct Anatomy<'a> {
    /// inside this, organs slide along what is outside
    pub slides: Option<&'a [bool]>,
    /// bone: moves nearly as a piece, and feels little of its neighbours
    pub stiff: Option<&'a [bool]>,
}

impl Default for RegisterOptions {
    fn default() -> Self {
        Self { iterations: vec![60, 50, 30], sigma: 1.0, kappa: 1.4, stiff_mm: 8.0, least_determinant: 0.1 }
    }
}

/// One level: both images, and what the mask says there.
struct Level {
    lattice: Lattice,
    reference: Vec<f32>,
    phase: Vec<f32>,
    border: Option<Border>,
    bone: Option<Bone>,
}

/// Bone as smoothing sees it, on blocks of two nodes an axis: the stiffness is far wider than those.
struct Bone {
    /// nodes in bone, by slice, within their slice
    nodes: Vec<Vec<u32>>,
    /// the blocks
    blocks: Lattice,
    /// Gaussian of how much bone is in a block, of the stiffness's width
    share: Vec<f32>,
    /// σ [blocks]
    sigma: f32,
    /// those of one bone each
    single: Vec<Piece>,
}

/// A bone by itself: a rib that is seen without its joint, a shoulder blade.
struct Piece {
    /// its nodes
    nodes: Vec<u32>,
    /// their middle [mm from the lattice's first node]
    center: Vector3<f32>,
    /// inverse of the inertia tensor about it, every node of mass 1 [1/mm²]
    per_inertia: Matrix3<f32>,
}

/// A connected piece of bone of this volume is one bone [mm³]: less may be calcium in soft tissue, more are several with joints between them.
const SINGLE_MM3: std::ops::Range<f32> = 3e3..4e4;

/// Iterations from one stiffening of bone to the next.
const STIFFEN: usize = 3;

/// A mask as smoothing sees it.
struct Border {
    /// 1 inside
    inside: Vec<f32>,
    /// its Gaussian
    share: Vec<f32>,
    /// nodes where that sees both sides, with the border's unit normal; by slice, within their slice
    near: Vec<Vec<(u32, [f32; 3])>>,
    /// lines that hold such nodes: of them alone each side's own Gaussian is wanted
    wanted: Wanted,
}

/// A field, one array a component, along the grid's axes [mm].
type Components = [Vec<f32>; 3];

/// Where the points of the reference have gone in the phase [mm, LPS]; by what is known of the reference's `anatomy`.
///
/// `progress` is told (level, iteration, RMS of the difference [HU]).
///
/// # Errors
/// One sentence when the images do not lie on one grid.
pub fn register(
    reference: &ScalarField,
    phase: &ScalarField,
    anatomy: &Anatomy,
    options: &RegisterOptions,
    mut progress: impl FnMut(usize, usize, f32),
) -> Result<VectorField, String> {
    let grid = &reference.grid;
    let masks = [anatomy.slides, anatomy.stiff];
    if phase.grid != *grid || masks.iter().flatten().any(|m| m.len() != grid.voxel_count()) || grid.size.iter().any(|&s| s < 4) {
        return Err(format!(
            "reference, phase and masks must lie on one grid of four nodes or more an axis; the reference has {:?}, the phase {:?}",
            grid.size, phase.grid.size
        ));
    }
    let finest = Lattice { size: grid.size, spacing: grid.spacing.map(|s| s as f32) };
    let inside = masks.map(|mask| mask.map(|m| m.iter().map(|&b| f32::from(u8::from(b))).collect::<Vec<_>>()));
    let mut raw = vec![(finest, reference.values.clone(), phase.values.clone(), inside)];
    for _ in 1..options.iterations.len() {
        let (lattice, r, p, m) = raw.last().expect("there is a level");
        let half = lattice.halved();
        if half == *lattice {
            break;
        }
        raw.push((
            half,
            halve(lattice, r),
            halve(lattice, p),
            m.each_ref().map(|m| m.as_ref().map(|m| halve(lattice, m).into_iter().map(f32::round).collect())),
        ));
    }
    let mut coarser: Option<(Components, Option<Vec<f32>>)> = None;
    let mut held = Vec::new();
    let skipped = options.iterations.len() - raw.len();
    for (n, (lattice, reference, phase, [slides, stiff])) in raw.into_iter().rev().enumerate() {
        let mut field = match &coarser {
            None => std::array::from_fn(|_| vec![0.0; lattice.count()]),
            Some((field, side)) => field.each_ref().map(|f| double_by_side(&lattice, f, side.as_deref(), slides.as_deref())),
        };
        let border = slides.map(|m| Border::new(&lattice, m, options.sigma));
        let bone = stiff.map(|m| Bone::new(&lattice, &m, options.stiff_mm));
        let level = Level { lattice, reference, phase, border, bone };
        level.run(&mut field, options, options.iterations[n + skipped], |iteration, rms| progress(n, iteration, rms));
        held = level.bone.iter().flat_map(|bone| &bone.single).flat_map(|piece| &piece.nodes).copied().collect();
        coarser = Some((field, level.border.map(|b| b.inside)));
    }
    let (field, _) = coarser.expect("there is a level");
    Ok(unfold(grid, field, &held, options.least_determinant))
}

impl Border {
    fn new(lattice: &Lattice, inside: Vec<f32>, sigma: f32) -> Self {
        let mut spare = Vec::new();
        let mut share = inside.clone();
        smooth(lattice, sigma, &mut share, &mut spare);
        let mut soft = inside.clone();
        smooth(lattice, 1.5, &mut soft, &mut spare);
        let ([nx, _, nz], slice) = (lattice.size, lattice.slice());
        let of_slice = |k: usize| -> Vec<(u32, [f32; 3])> {
            let near = (0..slice).filter(|n| share[k * slice + n] > 0.02 && share[k * slice + n] < 0.98);
            near.map(|n| {
                let g = gradient(lattice, &soft, [n % nx, n / nx, k]);
                let length = g.iter().map(|c| c * c).sum::<f32>().sqrt().max(1e-9);
                (n as u32, g.map(|c| c / length))
            })
            .collect()
        };
        let near: Vec<_> = (0..nz).into_par_iter().map(of_slice).collect();
        let wanted = Wanted::new(lattice, sigma, near.iter().map(|slice| slice.iter().map(|(n, _)| *n as usize / nx)));
        Self { near, wanted, inside, share }
    }
}

/// Values at the nodes of a finer lattice; where there is a border, each side's from that side's alone.
fn double_by_side(fine: &Lattice, values: &[f32], coarse_inside: Option<&[f32]>, inside: Option<&[f32]>) -> Vec<f32> {
    let mut whole = double(fine, values);
    if let (Some(coarse_inside), Some(inside)) = (coarse_inside, inside) {
        let part: Vec<f32> = values.iter().zip(coarse_inside).map(|(u, m)| u * m).collect();
        let (part, share) = (double(fine, &part), double(fine, coarse_inside));
        whole.par_iter_mut().zip(part).zip(share).zip(inside).for_each(|(((u, part), share), &inside)| {
            // what is not inside is outside; a side that the coarser lattice does not see keeps the mixture
            let (own, weight) = if inside > 0.5 { (part, share) } else { (*u - part, 1.0 - share) };
            if weight > 0.05 {
                *u = own / weight;
            }
        });
    }
    whole
}

impl Bone {
    fn new(lattice: &Lattice, inside: &[f32], stiff_mm: f32) -> Self {
        let slices = inside.chunks(lattice.slice());
        let nodes = slices.map(|slice| (0..slice.len() as u32).filter(|&n| slice[n as usize] > 0.5).collect()).collect();
        let blocks = Lattice { size: lattice.size.map(|s| s.div_ceil(2)), spacing: lattice.spacing.map(|s| 2.0 * s) };
        let sigma = (stiff_mm / blocks.spacing.iter().copied().fold(f32::INFINITY, f32::min)).max(0.5);
        let mut single = Vec::new();
        connected(lattice.size, inside.iter().map(|v| *v > 0.5), |nodes| single.extend(Piece::new(lattice, nodes)));
        let mut bone = Self { nodes, blocks, share: Vec::new(), sigma, single };
        let (mut share, mut spare) = (Vec::new(), Vec::new());
        bone.gather(lattice, |_| 1.0, &mut share);
        smooth(&blocks, sigma, &mut share, &mut spare);
        bone.share = share;
        bone
    }

    /// Sums over the bone in each block.
    fn gather(&self, lattice: &Lattice, value: impl Fn(usize) -> f32 + Sync, into: &mut Vec<f32>) {
        let ([bx, by, _], [nx, _, _], slice) = (self.blocks.size, lattice.size, lattice.slice());
        into.clear();
        into.resize(self.blocks.count(), 0.0);
        into.par_chunks_mut(bx * by).zip(self.nodes.par_chunks(2)).enumerate().for_each(|(layer, (into, slices))| {
            for (k, nodes) in slices.iter().enumerate() {
                for &n in nodes {
                    let (i, j) = (n as usize % nx, n as usize / nx);
                    into[j / 2 * bx + i / 2] += value((2 * layer + k) * slice + n as usize);
                }
            }
        });
    }

    /// u in bone ← its mean over bone nearby, and in a single bone its rigid part.
    fn stiffen(&self, lattice: &Lattice, field: &mut Components, part: &mut Vec<f32>, spare: &mut Vec<f32>) {
        // before their neighbours have a part in it
        let motions: Vec<_> = self.single.iter().map(|piece| piece.motion(lattice, field)).collect();
        let ([nx, _, _], slice) = (lattice.size, lattice.slice());
        for u in field.iter_mut() {
            self.gather(lattice, |n| u[n], part);
            smooth(&self.blocks, self.sigma, part, spare);
            part.par_iter_mut().zip(&self.share).for_each(|(p, &s)| *p = if s > 0.0 { *p / s } else { 0.0 });
            let part = &*part;
            u.par_chunks_mut(slice).zip(&self.nodes).enumerate().for_each(|(k, (u, nodes))| {
                for &n in nodes {
                    // the middle of a block lies between its nodes
                    let at = [n as usize % nx, n as usize / nx, k].map(|i| 0.5 * i as f32 - 0.25);
                    u[n as usize] = trilinear(&self.blocks, part, at);
                }
            });
        }
        for (piece, motion) in self.single.iter().zip(motions) {
            piece.nodes.iter().for_each(|&n| {
                let u = motion(place(lattice, n as usize));
                (0..3).for_each(|c| field[c][n as usize] = u[c]);
            });
        }
    }
}

impl Piece {
    fn new(lattice: &Lattice, nodes: &[usize]) -> Option<Self> {
        let count = nodes.len() as f32;
        if !SINGLE_MM3.contains(&(count * lattice.spacing.iter().product::<f32>())) {
            return None;
        }
        let center = nodes.iter().map(|&n| place(lattice, n)).sum::<Vector3<f32>>() / count;
        let inertia = nodes.iter().map(|&n| {
            let d = place(lattice, n) - center;
            Matrix3::from_diagonal_element(d.norm_squared()) - d * d.transpose()
        });
        let per_inertia = inertia.sum::<Matrix3<f32>>().try_inverse()?;
        Some(Self { nodes: nodes.iter().map(|&n| n as u32).collect(), center, per_inertia })
    }

    /// The rigid motion nearest to u in it, for small turns: t + ω × (x − c) of least Σ |u − t − ω × (x − c)|², so t is the mean of u and ω its moment about
    /// the middle by the inertia.
    fn motion(&self, lattice: &Lattice, field: &Components) -> impl Fn(Vector3<f32>) -> Vector3<f32> + use<> {
        let u = |n: &u32| Vector3::from(field.each_ref().map(|u| u[*n as usize]));
        let mean = self.nodes.iter().map(u).sum::<Vector3<f32>>() / self.nodes.len() as f32;
        let center = self.center;
        let moment = self.nodes.iter().map(|n| (place(lattice, *n as usize) - center).cross(&u(n))).sum::<Vector3<f32>>();
        let turn = self.per_inertia * moment;
        move |x| mean + turn.cross(&(x - center))
    }
}

/// A node's place [mm from the first].
fn place(lattice: &Lattice, n: usize) -> Vector3<f32> {
    let [nx, ny, _] = lattice.size;
    let at = [n % nx, n / nx % ny, n / (nx * ny)];
    Vector3::from_fn(|c, _| at[c] as f32 * lattice.spacing[c])
}

impl Level {
    fn run(&self, field: &mut Components, options: &RegisterOptions, iterations: usize, mut progress: impl FnMut(usize, f32)) {
        let lattice = &self.lattice;
        let ([nx, ny, _], slice) = (lattice.size, lattice.slice());
        // the reference and the phase as it would see it, together: the force asks for their common gradient
        let mut both = vec![0.0; lattice.count()];
        let (mut sides, mut spare): (Components, _) = (std::array::from_fn(|_| Vec::new()), Vec::new());
        let smallest = lattice.spacing.iter().copied().fold(f32::INFINITY, f32::min);
        let per_kappa2 = 1.0 / (options.kappa * smallest).powi(2);
        let per_mm = lattice.spacing.map(|s| 1.0 / s);
        let last = lattice.size.map(|s| (s - 1) as f32);
        for iteration in 0..iterations {
            let [ux, uy, uz] = &*field;
            both.par_chunks_mut(slice).enumerate().for_each(|(k, out)| {
                for (j, out) in out.chunks_exact_mut(nx).enumerate() {
                    let first = k * slice + j * nx;
                    let row = first..first + nx;
                    let (ux, uy, uz) = (&ux[row.clone()], &uy[row.clone()], &uz[row.clone()]);
                    let reference = &self.reference[row];
                    for i in 0..nx {
                        let index = [i as f32 + ux[i] * per_mm[0], j as f32 + uy[i] * per_mm[1], k as f32 + uz[i] * per_mm[2]];
                        let inside = (0..3).all(|c| index[c] >= 0.0 && index[c] <= last[c]);
                        // what lies outside is as the reference, and forces nothing
                        out[i] = reference[i] + if inside { trilinear(lattice, &self.phase, index) } else { reference[i] };
                    }
                }
            });
            let [ux, uy, uz] = field;
            let squares: f64 = ux
                .par_chunks_mut(slice)
                .zip(uy.par_chunks_mut(slice))
                .zip(uz.par_chunks_mut(slice))
                .enumerate()
                .map(|(k, ((ux, uy), uz))| {
                    let mut squares = 0.0f64;
                    for j in 0..ny {
                        let rows = Around::new(lattice, &both, j, k);
                        let reference = &self.reference[k * slice + j * nx..][..nx];
                        let [ux, uy, uz] = [&mut *ux, &mut *uy, &mut *uz].map(|u| &mut u[j * nx..(j + 1) * nx]);
                        squares += f64::from(rows.push(reference, [ux, uy, uz], per_kappa2));
                    }
                    squares
                })
                .sum();
            progress(iteration, (squares / (nx * ny * lattice.size[2]) as f64).sqrt() as f32);
            self.regularise(field, options.sigma, &mut sides, &mut spare);
            if let Some(bone) = &self.bone
                && (iteration % STIFFEN == 0 || iteration + 1 == iterations)
            {
                bone.stiffen(lattice, field, &mut sides[0], &mut spare);
            }
        }
    }

    /// u ← S(u).
    fn regularise(&self, field: &mut Components, sigma: f32, sides: &mut Components, spare: &mut Vec<f32>) {
        let lattice = &self.lattice;
        if let Some(border) = &self.border {
            for (side, u) in sides.iter_mut().zip(&*field) {
                side.clear();
                side.par_extend(u.par_iter().zip(&border.inside).map(|(u, m)| u * m));
                smooth_lines(lattice, sigma, side, spare, Some(&border.wanted));
            }
        }
        field.iter_mut().for_each(|u| smooth(lattice, sigma, u, spare));
        let Some(border) = &self.border else { return };
        let slice = lattice.slice();
        let [ux, uy, uz] = field;
        let slices = ux.par_chunks_mut(slice).zip(uy.par_chunks_mut(slice)).zip(uz.par_chunks_mut(slice)).zip(&border.near).enumerate();
        slices.for_each(|(k, (((ux, uy), uz), near))| {
            for &(at, [a, b, c]) in near {
                let (at, n) = (at as usize, k * slice + at as usize);
                let whole = [ux[at], uy[at], uz[at]];
                let inner = [sides[0][n], sides[1][n], sides[2][n]];
                // Gaussians are linear: what is not inside is outside
                let own: [f32; 3] = if border.inside[n] > 0.5 {
                    inner.map(|v| v / border.share[n])
                } else {
                    std::array::from_fn(|d| (whole[d] - inner[d]) / (1.0 - border.share[n]))
                };
                let along = (whole[0] - own[0]) * a + (whole[1] - own[1]) * b + (whole[2] - own[2]) * c;
                (ux[at], uy[at], uz[at]) = (own[0] + along * a, own[1] + along * b, own[2] + along * c);
            }
        });
    }
}

/// A row of R + P∘(1 + u) and its four neighbours, with what makes of their differences half a gradient [1/mm].
struct Around<'a> {
    here: &'a [f32],
    /// −j, +j, −k, +k
    beside: [&'a [f32]; 4],
    /// inside the row, at its ends, along j, along k
    per_mm: [f32; 4],
}

impl<'a> Around<'a> {
    fn new(lattice: &Lattice, both: &'a [f32], j: usize, k: usize) -> Self {
        let [nx, ny, nz] = lattice.size;
        let row = |j: usize, k: usize| &both[k * lattice.slice() + j * nx..][..nx];
        let ([a, b], [c, d]) = ([j.saturating_sub(1), (j + 1).min(ny - 1)], [k.saturating_sub(1), (k + 1).min(nz - 1)]);
        let [x, y, z] = lattice.spacing.map(|s| 0.5 / s);
        Self {
            here: row(j, k),
            beside: [row(a, k), row(b, k), row(j, c), row(j, d)],
            per_mm: [0.5 * x, x, y / (b - a) as f32, z / (d - c) as f32],
        }
    }

    /// u ← u + d·J/(|J|² + d²/κ²) in the row; Σ d².
    fn push(&self, reference: &[f32], [ux, uy, uz]: [&mut [f32]; 3], per_kappa2: f32) -> f32 {
        let n = self.here.len();
        let [south, north, below, above] = self.beside.map(|row| &row[..n]);
        let (here, reference) = (&self.here[..n], &reference[..n]);
        let (ux, uy, uz) = (&mut ux[..n], &mut uy[..n], &mut uz[..n]);
        let mut squares = [0.0f32; 8];
        let mut at = |i: usize, low: usize, high: usize, per_mm: f32| {
            // R − P∘(1 + u)
            let d = 2.0 * reference[i] - here[i];
            let x = (here[high] - here[low]) * per_mm;
            let (y, z) = ((north[i] - south[i]) * self.per_mm[2], (above[i] - below[i]) * self.per_mm[3]);
            let scale = d / (x * x + y * y + z * z + d * d * per_kappa2 + 1e-3);
            ux[i] += scale * x;
            uy[i] += scale * y;
            uz[i] += scale * z;
            squares[i % 8] += d * d;
        };
        at(0, 0, 1, self.per_mm[1]);
        for i in 1..n - 1 {
            at(i, i - 1, i + 1, self.per_mm[0]);
        }
        at(n - 1, n - 2, n - 1, self.per_mm[1]);
        squares.iter().sum()
    }
}

/// Smooths around cells that fold, until none does or it has been tried often enough; vectors go to LPS. Nodes that are `held` are left as they are while
/// their neighbours may yet give way: along the pleura, which tears, are the ribs.
fn unfold(grid: &Grid, field: Components, held: &[u32], least: f32) -> VectorField {
    let lattice = Lattice { size: grid.size, spacing: grid.spacing.map(|s| s as f32) };
    let patient = |f: &Components| VectorField {
        grid: grid.clone(),
        vectors: (0..lattice.count())
            .into_par_iter()
            .map(|n| in_patient(grid, [f[0][n], f[1][n], f[2][n]].map(f64::from)).map(|c| c as f32))
            .collect(),
    };
    let (mut field, mut spare) = (field, Vec::new());
    for round in 0..20 {
        let vectors = patient(&field);
        let folded: Vec<bool> = jacobian_determinant(&vectors).values.iter().map(|d| *d < least).collect();
        if !folded.iter().any(|f| *f) {
            return vectors;
        }
        // a cell and what lies within two nodes of it
        let mut near: Vec<f32> = folded.iter().map(|&f| f32::from(u8::from(f))).collect();
        smooth(&lattice, 1.0, &mut near, &mut spare);
        if round < 14 {
            held.iter().for_each(|&n| near[n as usize] = 0.0);
        }
        for u in &mut field {
            let mut smoothed = u.clone();
            smooth(&lattice, 0.8, &mut smoothed, &mut spare);
            u.par_iter_mut().zip(smoothed).zip(&near).for_each(|((u, s), &near)| {
                if near > 0.0 {
                    *u = s;
                }
            });
        }
    }
    patient(&field)
}
