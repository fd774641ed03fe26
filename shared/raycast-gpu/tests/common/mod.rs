//! What tests of the twin share: a device or a loud sentence, volumes with something in them, a field.
#![allow(dead_code)] // each test file uses its part

use maille_contract::{Role, control::PIN_IDLE};
use maille_raycast::{Motion, Picture, Warp, WarpOptions};
use maille_raycast_gpu::{Choice, Gpu};
use maille_store::{Reader, StoreKeeper, StoreSizes, Writer};
use maille_transport::{ControlMap, Domain};
use maille_volume::{BrickSource, BrickedVolume, Grid, Rescale, VectorField, Volume, VolumeInfo};
use std::sync::{Arc, atomic::Ordering::Relaxed};

/// Any device, software too; without one a sentence, or under CI a failure.
pub fn gpu() -> Option<Gpu> {
    gpu_of(&Choice::any())
}

pub fn gpu_of(choice: &Choice) -> Option<Gpu> {
    match Gpu::open(choice) {
        Ok(gpu) => Some(gpu),
        Err(error) => {
            assert!(std::env::var_os("CI").is_none(), "{error}; CI needs a Vulkan driver (Mesa's lavapipe: mesa-vulkan-drivers)");
            eprintln!("SKIPPED: {error}");
            None
        }
    }
}

/// A volume of a function of patient position.
pub fn volume(grid: Grid, hu: impl Fn([f64; 3]) -> f64) -> Volume {
    let [nx, ny, nz] = grid.size;
    let mut voxels = Vec::with_capacity(grid.voxel_count());
    for k in 0..nz {
        for j in 0..ny {
            for i in 0..nx {
                voxels.push(hu(grid.world_from_index([i as f64, j as f64, k as f64])).round().clamp(-32768.0, 32767.0) as i16);
            }
        }
    }
    Volume::new(grid, Rescale { slope: 1.0, intercept: -24.0 }, voxels)
}

/// Air, skin, flesh and bone in shells that wave, with some noise, on a grid that lies askew.
pub fn body(size: [usize; 3], spacing: [f64; 3]) -> BrickedVolume {
    let mut grid = Grid::axis_aligned(size, spacing);
    grid.direction = [0.0, -0.6, 0.8, 1.0, 0.0, 0.0, 0.0, 0.8, 0.6];
    grid.origin = [5.0, -7.0, 3.0];
    let centre = grid.center();
    let extent: f64 = (0..3).map(|c| spacing[c] * (size[c] - 1) as f64).fold(f64::INFINITY, f64::min);
    let mut state = 12345u64;
    let mut noise = std::iter::repeat_with(move || {
        state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        (state >> 40) as f64 / (1u64 << 24) as f64 - 0.5
    });
    let mut made = volume(grid, |x| {
        let d: [f64; 3] = std::array::from_fn(|c| (x[c] - centre[c]) / extent * 2.0);
        let r = d.iter().map(|c| c * c).sum::<f64>().sqrt();
        let wave = 0.08 * ((9.0 * d[0]).sin() * (7.0 * d[1]).cos() + (8.0 * d[2]).sin());
        let shell = |at: f64, width: f64| 1.0 / (1.0 + ((r + wave - at) / width).exp());
        -1000.0 + 1050.0 * shell(0.85, 0.04) + 900.0 * shell(0.55, 0.04) - 1500.0 * shell(0.3, 0.05)
    });
    made.voxels.iter_mut().for_each(|v| *v += (30.0 * noise.next().expect("it goes on for ever")) as i16);
    BrickedVolume::from_volume(&made)
}

/// Breathing: millimetres along the body, some across; with room around the body, since a field bends where it ends.
pub fn motion(info: &VolumeInfo) -> Motion {
    let grid = &info.grid;
    let mut own = grid.clone();
    own.size = grid.size.map(|s| s + 24);
    own.origin = grid.world_from_index([-12.0; 3]);
    let mut field = VectorField::zeros(own.clone());
    let [nx, ny, _] = own.size;
    for (n, v) in field.vectors.iter_mut().enumerate() {
        let at = [n % nx, n / nx % ny, n / (nx * ny)].map(|c| (c as f64 - 12.0) / 12.0);
        *v = [1.2 * at[1].sin(), 1.0 * at[2].cos(), 4.0 * (0.6 * at[0]).sin()].map(|c| c as f32);
    }
    Motion::single(&field).expect("one field on its own grid")
}

/// A warp whose lattice suffices.
pub fn warp(info: &VolumeInfo) -> Warp {
    let mut warp = Warp::new(info, WarpOptions { pitch_mm: 4.0, ..WarpOptions::default() });
    let report = warp.update(info, &motion(info), &[1.0]).expect("one coefficient for one field");
    assert!(report.rough == 0, "{report:?}");
    warp
}

/// The same breathing, and halves that slide along each other: a lattice does not suffice there.
pub fn sliding(info: &VolumeInfo) -> Warp {
    let grid = &info.grid;
    let mut coarse = grid.clone();
    coarse.size = grid.size.map(|s| s.div_ceil(2) + 1);
    coarse.spacing = grid.spacing.map(|s| s * 2.0);
    let mut field = VectorField::zeros(coarse.clone());
    let [nx, ny, _] = coarse.size;
    for (n, v) in field.vectors.iter_mut().enumerate() {
        let at = [n % nx, n / nx % ny, n / (nx * ny)].map(|c| c as f64);
        let slide = 4.0 * (1.2 * (at[0] - 0.4 * nx as f64)).tanh();
        *v = [(0.3 * at[1]).sin(), (0.4 * at[2]).cos(), slide].map(|c| c as f32);
    }
    let motion = Motion::single(&field).expect("one field on its own grid");
    let mut warp = Warp::new(info, WarpOptions::default());
    let report = warp.update(info, &motion, &[1.0]).expect("one coefficient for one field");
    assert!(report.rough > 0, "{report:?}");
    warp
}

/// A patient in a store of its own.
pub struct World {
    domain: Domain,
    _control: ControlMap,
    _keeper: StoreKeeper,
    pub writer: Writer,
    pub reader: Arc<Reader>,
}

impl World {
    pub fn new(volume: &Volume) -> Self {
        let domain = Domain::fresh().unwrap();
        let control = ControlMap::create(&domain).unwrap();
        let sizes = StoreSizes { spare_slots: 12, ..StoreSizes::default() };
        let keeper = StoreKeeper::create(&domain, volume, sizes, |_| {}).unwrap();
        let writer = Writer::open(&domain).unwrap();
        let reader = Arc::new(Reader::open(&domain, Role::Rendering).unwrap());
        Self { domain, _control: control, _keeper: keeper, writer, reader }
    }

    /// Fills bricks with bone and publishes them.
    pub fn change(&mut self, bricks: &[u32]) {
        let mut transaction = self.writer.begin();
        for &id in bricks {
            let brick = transaction.brick_mut(id);
            brick.voxels.fill(800);
            brick.summarise();
        }
        transaction.commit();
    }

    pub fn count(&self) -> u64 {
        self.reader.rest().layout().count() as u64
    }

    /// Whether the renderer's role holds no epoch.
    pub fn free(&self) -> bool {
        self.reader.control().pins[Role::Rendering.pins()].iter().all(|pin| pin.word.load(Relaxed) == PIN_IDLE)
    }
}

impl Drop for World {
    fn drop(&mut self) {
        self.domain.remove().unwrap();
    }
}

/// Share of pixels whose colours differ by more than 2/255, and the largest difference.
pub fn difference(a: &Picture, b: &Picture) -> (f64, u8) {
    let pixels = a.rgb.as_chunks::<3>().0.iter().zip(b.rgb.as_chunks::<3>().0);
    let worst: Vec<u8> = pixels.map(|(a, b)| a.iter().zip(b).map(|(a, b)| a.abs_diff(*b)).max().unwrap_or(0)).collect();
    let far = worst.iter().filter(|&&d| d > 2).count();
    (far as f64 / worst.len() as f64, worst.into_iter().max().unwrap_or(0))
}

pub fn info(source: &impl BrickSource) -> VolumeInfo {
    source.info().clone()
}
