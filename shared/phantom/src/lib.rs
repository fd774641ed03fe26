//! Made patients: a head and a torso whose tissue is known at every point by formula.
//!
//! A phantom is an ordered list of parts, each a solid given by a signed distance f(x) [mm] (negative inside) and a
//! [`Label`]. Where solids overlap the later one wins, so label(x) is the last part with f(x) < 0 and density(x) is that
//! label's HU: the truth for tests. A voxel is this truth seen through a scanner: each part covers the share
//! α = clamp(½ − f/w, 0, 1) of what lies below it (w = about one voxel: partial volume), and a texture is added, bounded by
//! the label's amplitude ([`Label::texture`]): a smooth part fixed in space and white noise fixed to the voxel.
//!
//! Frame: LPS millimetres, +x to the patient's left, +y posterior, +z superior; the origin is the middle of the phantom. The
//! extent is the same at every size, so that spacing follows from size.
//!
//! Invariants: the same kind, seed and size give the same bits, on any number of threads; the seed moves the texture and
//! some anatomy (septum, turbinates, vessels, lesion), never the extent.
//!
//! Cost: 256³ in well under 2 s on 2 cores. Blocks of 8³ voxels are sorted first into parts that fill them, touch them or
//! miss them; most blocks hold one tissue. How the torso moves as it breathes is a formula too ([`breathing`]). Not here: anything of a real patient.

#![forbid(unsafe_code)]

pub mod breathing;
mod head;
mod label;
mod part;
mod raster;
mod shape;
mod texture;
mod torso;

pub use label::Label;

use maille_volume::{Grid, Rescale, Volume};
use nalgebra::Vector3;
use part::{At, Part};
use std::{fmt, str::FromStr};

/// Which patient.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Kind {
    /// a head down to the neck
    Head,
    /// a chest and upper belly, arms left out
    Torso,
}

/// A made patient.
pub struct Phantom {
    kind: Kind,
    seed: u64,
    extent: [f64; 3],
    parts: Vec<Part>,
    landmarks: Landmarks,
}

/// Places a scene wants to go to. Positions in LPS millimetres.
#[derive(Clone, Debug, Default)]
struct Landmarks {
    nostril: Option<[f64; 3]>,
    nasal_path: Vec<[f64; 3]>,
    nasal_clearance: f64,
    lesion: Option<([f64; 3], f64)>,
    skin_entry: [f64; 3],
    needle_target: [f64; 3],
    /// points outside from which a straight way to `needle_target` may be tried, best first
    ways: Vec<[f64; 3]>,
}

impl Phantom {
    /// Builds the list of parts; some hundred solids, no voxels yet.
    pub fn new(kind: Kind, seed: u64) -> Self {
        let (extent, parts, mut landmarks) = match kind {
            Kind::Head => head::build(seed),
            Kind::Torso => torso::build(seed),
        };
        let mut phantom = Self { kind, seed, extent, parts, landmarks: Landmarks::default() };
        let target = landmarks.needle_target;
        let way = landmarks.ways.iter().find(|&&from| phantom.is_soft_way(from, target)).or(landmarks.ways.first());
        landmarks.skin_entry = phantom.skin_on_the_way(*way.expect("every phantom has a way in"), target);
        phantom.landmarks = landmarks;
        phantom
    }

    /// Which patient this is.
    pub fn kind(&self) -> Kind {
        self.kind
    }

    /// The seed it was made from.
    pub fn seed(&self) -> u64 {
        self.seed
    }

    /// Size of the box of voxels [mm], outer faces included; centred on the origin.
    pub fn extent_mm(&self) -> [f64; 3] {
        self.extent
    }

    /// The tissue at a position [mm].
    pub fn label(&self, world: [f64; 3]) -> Label {
        let at = At::new(Vector3::from(world));
        self.parts.iter().rev().find(|part| part.contains(&at)).map_or(Label::Air, |part| part.label)
    }

    /// The ideal density [HU] at a position [mm]: that of the tissue, without texture and without partial volume.
    pub fn density(&self, world: [f64; 3]) -> f64 {
        self.label(world).hu()
    }

    /// The grid of a volume of `size` voxels: they fill the extent.
    ///
    /// # Panics
    /// When a size is zero.
    pub fn grid(&self, size: [usize; 3]) -> Grid {
        assert!(!size.contains(&0), "a phantom needs at least one voxel along each axis, not {size:?}");
        let spacing: [f64; 3] = std::array::from_fn(|c| self.extent[c] / size[c] as f64);
        let mut grid = Grid::axis_aligned(size, spacing);
        grid.origin = std::array::from_fn(|c| 0.5 * (spacing[c] - self.extent[c]));
        grid
    }

    /// The phantom as a scanner would give it: HU with partial volume and texture.
    pub fn volume(&self, size: [usize; 3]) -> Volume {
        let grid = self.grid(size);
        let voxels = raster::densities(&self.parts, &grid, self.seed);
        Volume::new(grid, Rescale::IDENTITY, voxels)
    }

    /// The label at each voxel's centre, as [`Label::number`], i fastest.
    pub fn labels(&self, size: [usize; 3]) -> Vec<u8> {
        raster::labels(&self.parts, &self.grid(size))
    }

    /// The middle of the left nostril's opening [mm]; a head has one.
    pub fn nostril(&self) -> Option<[f64; 3]> {
        self.landmarks.nostril
    }

    /// A way through air [mm], from outside the left nostril through the nasal cavity to the sphenoid's ostium; empty for
    /// a torso. No tissue lies nearer to it than [`Self::nasal_clearance_mm`].
    pub fn nasal_path(&self) -> &[[f64; 3]] {
        &self.landmarks.nasal_path
    }

    /// How far tissue keeps from the nasal path [mm], its end at the ostium apart.
    pub fn nasal_clearance_mm(&self) -> f64 {
        self.landmarks.nasal_clearance
    }

    /// Centre [mm] and radius [mm] of the lesion in the liver; a torso has one.
    pub fn lesion(&self) -> Option<([f64; 3], f64)> {
        self.landmarks.lesion
    }

    /// A point of the skin [mm] from which a straight needle reaches [`Self::needle_target`] (torso: through soft tissue
    /// only), or from which skin may be pressed (head: the cheek).
    pub fn skin_entry(&self) -> [f64; 3] {
        self.landmarks.skin_entry
    }

    /// What a needle from [`Self::skin_entry`] aims at [mm]: the lesion (torso), or a point deep in the cheek (head).
    pub fn needle_target(&self) -> [f64; 3] {
        self.landmarks.needle_target
    }

    /// Whether a needle 3 mm thick meets neither bone nor lung, gas, vessel or duct on a straight way.
    fn is_soft_way(&self, from: [f64; 3], to: [f64; 3]) -> bool {
        let (a, b) = (Vector3::from(from), Vector3::from(to));
        let along = (b - a).normalize();
        let across = along.cross(&Vector3::z()).normalize();
        let rays = [Vector3::zeros(), across, -across, along.cross(&across), across.cross(&along)].map(|side| a + 1.5 * side);
        rays.iter().all(|start| {
            let mut inside = false;
            (0..(b - a).norm() as usize).all(|s| {
                let label = self.label((start + along * s as f64).into());
                inside |= label != Label::Air;
                let forbidden = label.is_rigid()
                    || matches!(label, Label::Lung | Label::Vessel | Label::LiverVessel | Label::BileDuct | Label::Cartilage);
                !(forbidden || inside && label == Label::Air)
            })
        })
    }

    /// First point that is not air from `outside` to `inside`, to a hundredth of a millimetre.
    fn skin_on_the_way(&self, outside: [f64; 3], inside: [f64; 3]) -> [f64; 3] {
        let (a, b) = (Vector3::from(outside), Vector3::from(inside));
        let length = (b - a).norm();
        let point = |s: f64| (a + (b - a) * (s / length)).into();
        let first = (0..length as usize).map(|s| s as f64).find(|&s| self.label(point(s)) != Label::Air).unwrap_or(length);
        let (mut low, mut high) = (first - 1.0, first);
        while high - low > 0.01 {
            let middle = 0.5 * (low + high);
            if self.label(point(middle)) == Label::Air { low = middle } else { high = middle }
        }
        point(high)
    }
}

impl FromStr for Kind {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match text {
            "head" => Ok(Self::Head),
            "torso" => Ok(Self::Torso),
            other => Err(format!("there is no phantom {other:?}; write \"head\" or \"torso\"")),
        }
    }
}

impl fmt::Display for Kind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Head => "head",
            Self::Torso => "torso",
        })
    }
}

impl fmt::Debug for Phantom {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Phantom({} seed {}, {} parts)", self.kind, self.seed, self.parts.len())
    }
}
