//! The demons and their regularisation; see the module above.

use super::pyramid::{Lattice, double, gradient, halve, smooth, trilinear};
use crate::resample::jacobian_determinant;
use maille_displacement::in_patient;
use maille_volume::{Grid, ScalarField, VectorField};
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
        Self { iterations: vec![60, 50, 30], sigma: 1.0, kappa: 1.4, stiff_mm: 4.0, least_determinant: 0.1 }
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

/// Bone as smoothing sees it.
struct Bone {
    /// 1 in bone
    inside: Vec<f32>,
    /// its Gaussian, of the stiffness's width
    share: Vec<f32>,
    /// σ [nodes]
    sigma: f32,
}

/// Iterations from one stiffening of bone to the next.
const STIFFEN: usize = 3;

/// A mask as smoothing sees it.
struct Border {
    /// 1 inside
    inside: Vec<f32>,
    /// its Gaussian
    share: Vec<f32>,
    /// unit normal, and how much the border is near: 0 … 1
    normal: Vec<[f32; 4]>,
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
    let skipped = options.iterations.len() - raw.len();
    for (n, (lattice, reference, phase, [slides, stiff])) in raw.into_iter().rev().enumerate() {
        let mut field = match &coarser {
            None => std::array::from_fn(|_| vec![0.0; lattice.count()]),
            Some((field, side)) => field.each_ref().map(|f| double_by_side(&lattice, f, side.as_deref(), slides.as_deref())),
        };
        let border = slides.map(|m| Border::new(&lattice, m, options.sigma));
        let bone = stiff.map(|m| Bone::new(&lattice, m, options.stiff_mm));
        let level = Level { lattice, reference, phase, border, bone };
        level.run(&mut field, options, options.iterations[n + skipped], |iteration, rms| progress(n, iteration, rms));
        coarser = Some((field, level.border.map(|b| b.inside)));
    }
    let (field, _) = coarser.expect("there is a level");
    Ok(unfold(grid, field, options.least_determinant))
}

impl Border {
    fn new(lattice: &Lattice, inside: Vec<f32>, sigma: f32) -> Self {
        let mut spare = Vec::new();
        let mut share = inside.clone();
        smooth(lattice, sigma, &mut share, &mut spare);
        let mut soft = inside.clone();
        smooth(lattice, 1.5, &mut soft, &mut spare);
        let [nx, ny, _] = lattice.size;
        let normal = |n: usize| {
            let g = gradient(lattice, &soft, [n % nx, n / nx % ny, n / (nx * ny)]);
            let length = g.iter().map(|c| c * c).sum::<f32>().sqrt().max(1e-9);
            // near is where the Gaussian of S sees both sides
            let near = if share[n] > 0.02 && share[n] < 0.98 { 1.0 } else { 0.0 };
            [g[0] / length, g[1] / length, g[2] / length, near]
        };
        Self { normal: (0..lattice.count()).into_par_iter().map(normal).collect(), inside, share }
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
    fn new(lattice: &Lattice, inside: Vec<f32>, stiff_mm: f32) -> Self {
        let sigma = (stiff_mm / lattice.spacing.iter().copied().fold(f32::INFINITY, f32::min)).max(0.5);
        let mut share = inside.clone();
        smooth(lattice, sigma, &mut share, &mut Vec::new());
        Self { inside, share, sigma }
    }

    /// u in bone ← its mean over bone nearby.
    fn stiffen(&self, lattice: &Lattice, field: &mut Components, part: &mut Vec<f32>, spare: &mut Vec<f32>) {
        for u in field {
            part.clear();
            part.par_extend(u.par_iter().zip(&self.inside).map(|(u, m)| u * m));
            smooth(lattice, self.sigma, part, spare);
            u.par_iter_mut().zip(&*part).zip(&self.inside).zip(&self.share).for_each(|(((u, p), &m), s)| {
                if m > 0.5 {
                    *u = p / s;
                }
            });
        }
    }
}

impl Level {
    fn run(&self, field: &mut Components, options: &RegisterOptions, iterations: usize, mut progress: impl FnMut(usize, f32)) {
        let lattice = &self.lattice;
        let ([nx, ny, _], slice) = (lattice.size, lattice.slice());
        let mut warped = vec![0.0; lattice.count()];
        let (mut sides, mut spare): (Components, _) = (std::array::from_fn(|_| Vec::new()), Vec::new());
        let smallest = lattice.spacing.iter().copied().fold(f32::INFINITY, f32::min);
        let per_kappa2 = 1.0 / (options.kappa * smallest).powi(2);
        for iteration in 0..iterations {
            // the phase as the reference would see it; NaN where it lies outside
            let [ux, uy, uz] = &*field;
            warped.par_chunks_mut(slice).enumerate().for_each(|(k, out)| {
                for (at, out) in out.iter_mut().enumerate() {
                    let (i, j, n) = (at % nx, at / nx, k * slice + at);
                    let index = [
                        i as f32 + ux[n] / lattice.spacing[0],
                        j as f32 + uy[n] / lattice.spacing[1],
                        k as f32 + uz[n] / lattice.spacing[2],
                    ];
                    let outside = (0..3).any(|c| index[c] < 0.0 || index[c] > (lattice.size[c] - 1) as f32);
                    *out = if outside { self.reference[n] } else { trilinear(lattice, &self.phase, index) };
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
                    for at in 0..slice {
                        let n = k * slice + at;
                        let d = self.reference[n] - warped[n];
                        squares += f64::from(d * d);
                        let place = [at % nx, at / nx, k];
                        let (a, b) = (gradient(lattice, &self.reference, place), gradient(lattice, &warped, place));
                        let j: [f32; 3] = std::array::from_fn(|c| 0.5 * (a[c] + b[c]));
                        let scale = d / (j.iter().map(|c| c * c).sum::<f32>() + d * d * per_kappa2 + 1e-3);
                        ux[at] += scale * j[0];
                        uy[at] += scale * j[1];
                        uz[at] += scale * j[2];
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
                smooth(lattice, sigma, side, spare);
            }
        }
        field.iter_mut().for_each(|u| smooth(lattice, sigma, u, spare));
        let Some(border) = &self.border else { return };
        let [ux, uy, uz] = field;
        ux.par_iter_mut().zip(uy).zip(uz).enumerate().for_each(|(n, ((ux, uy), uz))| {
            let [a, b, c, near] = border.normal[n];
            if near == 0.0 {
                return;
            }
            let whole = [*ux, *uy, *uz];
            let inner = [sides[0][n], sides[1][n], sides[2][n]];
            // Gaussians are linear: what is not inside is outside
            let own: [f32; 3] = if border.inside[n] > 0.5 {
                inner.map(|v| v / border.share[n])
            } else {
                std::array::from_fn(|d| (whole[d] - inner[d]) / (1.0 - border.share[n]))
            };
            let along = (whole[0] - own[0]) * a + (whole[1] - own[1]) * b + (whole[2] - own[2]) * c;
            (*ux, *uy, *uz) = (own[0] + along * a, own[1] + along * b, own[2] + along * c);
        });
    }
}

/// Smooths around cells that fold, until none does or it has been tried often enough; vectors go to LPS.
fn unfold(grid: &Grid, field: Components, least: f32) -> VectorField {
    let lattice = Lattice { size: grid.size, spacing: grid.spacing.map(|s| s as f32) };
    let patient = |f: &Components| VectorField {
        grid: grid.clone(),
        vectors: (0..lattice.count())
            .into_par_iter()
            .map(|n| in_patient(grid, [f[0][n], f[1][n], f[2][n]].map(f64::from)).map(|c| c as f32))
            .collect(),
    };
    let (mut field, mut spare) = (field, Vec::new());
    for _ in 0..20 {
        let vectors = patient(&field);
        let folded: Vec<bool> = jacobian_determinant(&vectors).values.iter().map(|d| *d < least).collect();
        if !folded.iter().any(|f| *f) {
            return vectors;
        }
        // a cell and what lies within two nodes of it
        let mut near: Vec<f32> = folded.iter().map(|&f| f32::from(u8::from(f))).collect();
        smooth(&lattice, 1.0, &mut near, &mut spare);
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
