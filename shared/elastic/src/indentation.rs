//! A sphere pressed into a block: ChainMail's displacements beside those of elastic tissue with the same displacements at the contact.
//!
//! The block is fixed at its bottom and its sides and free on top. In the circle where a sphere of radius R pressed by δ touches elastic
//! tissue, r ≤ √(Rδ) [Hertz 1882], elements follow the sphere, δ − (R − √(R² − r²)) down and not sideways; both models are given exactly
//! that. Everything else is their answer. The error of ChainMail is |u − u_elastic| as a part of the push δ, over the elements
//! outside two voxels from the contact.
//!
//! Stiffness: in the elastic block E by layer, in ChainMail the link limits by density, o ∝ 1 − (v/4096)², so that a layer n times as
//! stiff has 1/n of the offset.
//!
//! Units: mm; spacing 1. Frame: the grid's axes, k up. Cost: one elastic solution a block, a push and some sweeps a setting.

use crate::{Block, Boundary, Solution, Stopping, solve};
use maille_chainmail::{Admission, Capsule, ChainMail, Gaps, LinkModel, Metric, Motion, Pin, RelaxOptions, Tissue};
use maille_volume::{BrickedVolume, Grid, Rescale, Volume};

/// What is pressed into what.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Indentation {
    /// elements of tissue along i, j, k, with those that are fixed
    pub size: [usize; 3],
    /// radius R of the sphere [mm]
    pub radius: f64,
    /// how deep it is pressed, δ [mm]
    pub depth: f64,
    /// Poisson's ratio of the elastic block
    pub poisson: f64,
    /// thickness [voxels] of the upper layer, and how many times stiffer what lies below is
    pub layer: Option<(usize, f64)>,
}

/// How ChainMail answers.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Setting {
    /// chain region's offset of the upper layer
    pub offset: f32,
    /// shape of the regions
    pub metric: Metric,
    /// factor of shear on the links
    pub shear: f32,
    /// sweeps of elastic relaxation with the sphere held in place
    pub sweeps: u32,
    /// how strongly rest draws in them
    pub anchor: f32,
}

/// Displacements [mm] of the elements of the block, i fastest.
pub type Displacements = Vec<[f64; 3]>;

/// Errors over a set of elements, as parts of the push.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Errors {
    /// mean of |u − u_elastic| / δ
    pub mean: f64,
    /// the largest
    pub max: f64,
    /// elements counted
    pub count: usize,
}

/// Rows of air above the tissue.
const AIR: usize = 3;
/// Where tissue begins, and bone [HU].
const THRESHOLD_HU: f64 = -500.0;
const BONE_HU: f64 = 3000.0;

impl Indentation {
    /// The elements under the sphere and how far down each goes [mm].
    pub fn contact(&self) -> Vec<([usize; 3], f64)> {
        let [nx, ny, nz] = self.size;
        let center = [(nx / 2) as f64, (ny / 2) as f64];
        let (reach2, radius2) = (self.radius * self.depth, self.radius * self.radius);
        let mut out = Vec::new();
        for j in 0..ny {
            for i in 0..nx {
                let r2 = (i as f64 - center[0]).powi(2) + (j as f64 - center[1]).powi(2);
                if r2 <= reach2.min(radius2) {
                    out.push(([i, j, nz - 1], self.depth - (self.radius - (radius2 - r2).sqrt())));
                }
            }
        }
        out
    }

    fn elements(&self) -> impl Iterator<Item = [usize; 3]> {
        let [nx, ny, nz] = self.size;
        (0..nx * ny * nz).map(move |n| [n % nx, n / nx % ny, n / (nx * ny)])
    }

    /// Whether an element is fixed: bottom and sides.
    fn is_fixed(&self, [i, j, k]: [usize; 3]) -> bool {
        i == 0 || j == 0 || k == 0 || i + 1 == self.size[0] || j + 1 == self.size[1]
    }

    /// How many times stiffer an element is than the upper layer.
    fn stiffness(&self, k: usize) -> f64 {
        self.layer.map_or(1.0, |(thickness, factor)| if k + thickness < self.size[2] { factor } else { 1.0 })
    }

    /// The elastic answer.
    ///
    /// # Errors
    /// When size or Poisson's ratio make no sense.
    pub fn elastic(&self, stopping: Stopping) -> Result<Solution, crate::Fault> {
        let young: Vec<f64> = self.elements().map(|[_, _, k]| self.stiffness(k)).collect();
        let block = Block::from_voxels(self.size, [1.0; 3], self.poisson, &young)?;
        let mut boundary = Boundary::free(&block);
        for at in self.elements().filter(|&at| self.is_fixed(at)) {
            boundary.fix(block.node(at), [0.0; 3]);
        }
        for (at, down) in self.contact() {
            boundary.fix(block.node(at), [0.0, 0.0, -down]);
        }
        Ok(solve(&block, &boundary, stopping))
    }

    /// The block for ChainMail: CT values that stand for its layers, bone where it is fixed, air above.
    pub fn volume(&self) -> BrickedVolume {
        let [nx, ny, nz] = self.size;
        let grid = Grid::axis_aligned([nx, ny, nz + AIR], [1.0; 3]);
        // softness 1 − (v/4096)² of the upper layer at −400 HU; below 1/n of it
        let soft = Tissue::softness(-400.0);
        let hu = |[i, j, k]: [usize; 3]| {
            if k >= nz {
                return -1000.0;
            }
            if self.is_fixed([i, j, k]) {
                return BONE_HU + 50.0;
            }
            4096.0 * (1.0 - soft / self.stiffness(k)).sqrt() - 1000.0
        };
        let voxels = (0..nx * ny * (nz + AIR)).map(|n| hu([n % nx, n / nx % ny, n / (nx * ny)]).round() as i16).collect();
        BrickedVolume::from_volume(&Volume::new(grid, Rescale::IDENTITY, voxels))
    }

    /// A mail on that volume.
    pub fn mail(&self, volume: &BrickedVolume, setting: &Setting) -> ChainMail {
        use maille_volume::BrickSource;
        let tissue = Tissue {
            // density scaling takes some of the upper layer's offset off again
            offset: (f64::from(setting.offset) / Tissue::softness(-400.0)) as f32,
            density_scaling: true,
            threshold_hu: Some(THRESHOLD_HU),
            bone_hu: Some(BONE_HU),
            movement_limit_mm: None,
            admission: Admission::ByComponent,
        };
        let mut mail = ChainMail::new(volume.info(), tissue);
        let mut links = LinkModel { gaps: Gaps::Free, metric: setting.metric, ..LinkModel::default() };
        for axis in &mut links.axes {
            axis.shear = setting.shear;
        }
        mail.set_link_model(links);
        mail
    }

    /// Pushes a mail made by [`Self::mail`], and relaxes it.
    pub fn press(&self, volume: &BrickedVolume, mail: &mut ChainMail, setting: &Setting) {
        let pins: Vec<Pin> =
            self.contact().into_iter().map(|(voxel, down)| Pin { voxel, motion: Motion::To([0.0, 0.0, -down as f32]) }).collect();
        mail.push(volume, &pins);
        self.relax(volume, mail, setting);
    }

    /// The sweeps of a setting, with the sphere held where it is.
    pub fn relax(&self, volume: &BrickedVolume, mail: &mut ChainMail, setting: &Setting) {
        let options =
            RelaxOptions { sweeps: setting.sweeps, anchor: setting.anchor, snap_mm: 0.0, tools_hold_hu: Some(THRESHOLD_HU), first: 0 };
        let center = [(self.size[0] / 2) as f64, (self.size[1] / 2) as f64, (self.size[2] - 1) as f64 - self.depth + self.radius];
        let sphere = Capsule { a: center, b: center, radius_mm: self.radius };
        if setting.sweeps > 0 {
            mail.relax_elastic(volume, &options, &[sphere], &|| false);
        }
    }

    /// Displacements [mm] of the block's elements.
    pub fn displacements(&self, mail: &ChainMail) -> Displacements {
        self.elements().map(|at| mail.displacement(at).map(f64::from)).collect()
    }

    /// |u − truth| / δ of each element, i fastest.
    pub fn error_map(&self, found: &Displacements, truth: &Displacements) -> Vec<f64> {
        let length = |a: &[f64; 3], b: &[f64; 3]| (0..3).map(|c| (a[c] - b[c]).powi(2)).sum::<f64>().sqrt();
        found.iter().zip(truth).map(|(a, b)| length(a, b) / self.depth).collect()
    }

    /// Errors outside two voxels from the contact: of all elements that are not fixed, and of those among them that the elastic block moves by
    /// more than a twentieth of the push, where there is something to be wrong about.
    pub fn errors(&self, map: &[f64], truth: &Displacements) -> [Errors; 2] {
        let contact: Vec<[usize; 3]> = self.contact().into_iter().map(|c| c.0).collect();
        let mut out = [Errors::default(); 2];
        for (n, at) in self.elements().enumerate() {
            let near = contact.iter().any(|p| (0..3).all(|c| p[c].abs_diff(at[c]) <= 2));
            if near || self.is_fixed(at) {
                continue;
            }
            let moves = truth[n].iter().map(|v| v * v).sum::<f64>().sqrt() > 0.05 * self.depth;
            for errors in &mut out[..if moves { 2 } else { 1 }] {
                errors.mean += map[n];
                errors.max = errors.max.max(map[n]);
                errors.count += 1;
            }
        }
        for errors in &mut out {
            errors.mean /= errors.count.max(1) as f64;
        }
        out
    }

    /// The largest error at the contact itself, as a part of the push: what ChainMail refused, where links that end at bone are stretched out
    /// or where the sphere is steeper than links can shear (√(δ/R) at the rim). Only settings for which it is nought answer the question that
    /// the truth answers.
    pub fn refused(&self, map: &[f64]) -> f64 {
        let [nx, ny, _] = self.size;
        self.contact().iter().map(|([i, j, k], _)| map[(k * ny + j) * nx + i]).fold(0.0, f64::max)
    }

    /// The part of the truth that no answer to a push straight down has, since components stand alone in cubic regions: its sideways
    /// displacement. A lower bound of every setting's error.
    pub fn sideways(&self, truth: &Displacements) -> [Errors; 2] {
        let straight: Displacements = truth.iter().map(|u| [0.0, 0.0, u[2]]).collect();
        self.errors(&self.error_map(&straight, truth), truth)
    }
}
