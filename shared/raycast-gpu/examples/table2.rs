//! Table 2 of Fortmeier et al. 2015, row by row, on the GPU of this machine: time and memory of a frame without motion, with key frames and
//! with surrogate fields, for 256³ and 512×512×460 voxels at 1224×1014, in place and resident; then what commits move.
//!
//! The patient and its breathing are made; fields have the paper's sizes and numbers. A frame's time is the wall's: collapse and inversion of the
//! field on the CPU, what is sent, drawing and reading back (the picture comes back as bytes; the paper's stays on the device).
//! The paper's image memory is 4 + 5 bytes a voxel; ours is in bricks of 16 bits.
//!
//! ```text
//! cargo run --release -p maille-raycast-gpu --example table2 [-- --quick] [--software] [--frames N]
//! ```
//! `--software` allows a Vulkan that runs on the CPU, whose times say nothing of a GPU; `--quick` takes small volumes and one field size.

use maille_contract::Role;
use maille_phantom::{Kind, Phantom};
use maille_raycast::{Camera, Extras, Motion, Picture, Preset, Settings, Skip, Warp, WarpOptions};
use maille_raycast_gpu::{Choice, Gpu, Placement, Renderer};
use maille_store::{Reader, StoreKeeper, StoreSizes, Writer};
use maille_transport::{ControlMap, Domain};
use maille_volume::{BrickSource, Grid, VectorField, Volume, brick::Brick};
use std::{process::ExitCode, sync::Arc, time::Instant};

/// Spare slots of the store: the largest commit measured, twice.
const SPARE: usize = 2048;

struct Options {
    quick: bool,
    software: bool,
    frames: usize,
}

fn main() -> ExitCode {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let given = |name: &str| arguments.iter().any(|a| a == name);
    let frames = arguments.iter().position(|a| a == "--frames").and_then(|n| arguments.get(n + 1)?.parse().ok());
    let options = Options { quick: given("--quick"), software: given("--software"), frames: frames.unwrap_or(30) };
    match run(&options) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("table2: {error}");
            ExitCode::FAILURE
        }
    }
}

fn run(options: &Options) -> Result<(), Box<dyn std::error::Error>> {
    let choice = Choice { software: options.software, ..Choice::default() };
    let gpu =
        Gpu::open(&choice).map_err(|e| format!("{e}; figures of table 2 are a real GPU's (--software tries the command without one)"))?;
    if gpu.is_software() {
        println!("!! {} IS NO GPU: THESE TIMES SAY NOTHING ABOUT TABLE 2 !!", gpu.name());
    }
    println!("{}", gpu.name());
    drop(gpu);
    let [small, large] = if options.quick { [[64; 3], [96, 96, 80]] } else { [[256; 3], [512, 512, 460]] };
    let edges: &[usize] = if options.quick { &[32] } else { &[64, 128, 256] };
    println!("| placement | motion | image | image MiB | field | N | field MiB | frame ms (median) | stdev | sent MiB a frame |");
    println!("|---|---|---|---|---|---|---|---|---|---|");
    for size in [small, large] {
        let patient = Patient::new(size)?;
        for placement in [Placement::InPlace, Placement::Resident] {
            let mut renderer = Renderer::for_store(Gpu::open(&choice)?, &patient.reader, placement)?;
            if let Some(notice) = renderer.notice() {
                println!("!! {notice}");
            }
            let placement = renderer.placement();
            patient.row(&mut renderer, options, placement, None)?;
            for (model, bases) in [("key frame", [14, 14, 4]), ("surrogate", [3, 3, 3])] {
                for (&edge, &count) in edges.iter().zip(&bases) {
                    patient.row(&mut renderer, options, placement, Some((model, edge, count)))?;
                }
            }
            patient.commits(&mut renderer, options)?;
        }
    }
    Ok(())
}

/// A made patient in a store.
struct Patient {
    domain: Domain,
    _control: ControlMap,
    _keeper: StoreKeeper,
    reader: Arc<Reader>,
    image_bytes: usize,
}

impl Drop for Patient {
    fn drop(&mut self) {
        if let Err(error) = self.domain.remove() {
            eprintln!("table2: {error}");
        }
    }
}

impl Patient {
    fn new(size: [usize; 3]) -> Result<Self, Box<dyn std::error::Error>> {
        let volume: Volume = Phantom::new(Kind::Torso, 1).volume(size);
        let domain = Domain::fresh()?;
        let control = ControlMap::create(&domain)?;
        let keeper = StoreKeeper::create(&domain, &volume, StoreSizes { spare_slots: SPARE, ..StoreSizes::default() }, |_| {})?;
        let reader = Arc::new(Reader::open(&domain, Role::Rendering)?);
        reader.prefault();
        let image_bytes = reader.rest().layout().count() * size_of::<Brick>();
        Ok(Self { domain, _control: control, _keeper: keeper, reader, image_bytes })
    }

    /// Breathing along the body, a little across: `count` fields of edge³ nodes whose sum under the coefficients is one breath.
    fn motion(&self, edge: usize, count: usize) -> Result<Motion, Box<dyn std::error::Error>> {
        let whole = &self.reader.info().grid;
        let mut grid: Grid = whole.clone();
        grid.size = [edge; 3];
        grid.spacing = std::array::from_fn(|c| whole.spacing[c] * (whole.size[c] - 1) as f64 / (edge - 1) as f64);
        let fields: Vec<VectorField> = (0..count)
            .map(|n| {
                let mut field = VectorField::zeros(grid.clone());
                let phase = n as f64 / count as f64 * std::f64::consts::PI;
                for (at, v) in field.vectors.iter_mut().enumerate() {
                    let t = [at % edge, at / edge % edge, at / (edge * edge)].map(|i| i as f64 / (edge - 1) as f64 * std::f64::consts::PI);
                    let inner = t.iter().map(|t| t.sin()).product::<f64>();
                    *v = [2.0 * phase.cos() * inner, -4.0 * inner, 15.0 * phase.sin() * inner].map(|c| c as f32);
                }
                field
            })
            .collect();
        Ok(Motion::new(&fields)?)
    }

    fn row(
        &self,
        renderer: &mut Renderer,
        options: &Options,
        placement: Placement,
        motion: Option<(&str, usize, usize)>,
    ) -> Result<(), Box<dyn std::error::Error>> {
        let info = self.reader.info();
        let settings = Settings::volume(Preset::Ct.transfer());
        let mut scene = Scene::new(&self.reader, settings, options);
        let fields = motion.map(|(_, edge, count)| self.motion(edge, count)).transpose()?;
        let mut warp = Warp::new(info, WarpOptions::default());
        let (mut times, mut sent) = (Vec::new(), 0);
        for frame in 0..options.frames + 2 {
            let before = renderer.traffic();
            let start = Instant::now();
            if let (Some(fields), Some((model, _, count))) = (&fields, motion) {
                // one breath over the frames: two neighbouring key frames, or signal and its derivative
                let tau = frame as f32 / options.frames as f32;
                let mut coefficients = vec![0.0; count];
                if model == "key frame" {
                    let at = tau.fract() * (count - 1) as f32;
                    coefficients[at as usize] = 1.0 - at.fract();
                    coefficients[(at as usize + 1).min(count - 1)] += at.fract();
                } else {
                    let (sine, cosine) = (std::f32::consts::TAU * tau).sin_cos();
                    coefficients = vec![0.2, 0.4 * sine, 0.2 * cosine];
                }
                warp.update(info, fields, &coefficients)?;
            }
            scene.draw(&self.reader, renderer, fields.is_some().then_some(&warp))?;
            // the first frames build shaders and move everything
            if frame >= 2 {
                times.push(start.elapsed().as_secs_f64() * 1e3);
                let now = renderer.traffic();
                sent += now.uploaded + now.fetched + now.other - before.uploaded - before.fetched - before.other;
            }
        }
        let mib = |bytes: usize| bytes as f64 / f64::from(1 << 20);
        let (median, deviation) = statistics(&mut times);
        let (model, edge, count) = motion.unwrap_or(("none", 0, 0));
        let size = info.grid.size.map(|s| s.to_string()).join("×");
        println!(
            "| {placement:?} | {model} | {size} | {:.0} | {edge}³ | {count} | {:.0} | {median:.2} | {deviation:.2} | {:.2} |",
            mib(self.image_bytes),
            mib(fields.map_or(0, |f| f.size_bytes())),
            mib(sent as usize) / times.len() as f64,
        );
        Ok(())
    }

    /// Bytes that a frame moves after commits of more and more bricks.
    fn commits(&self, renderer: &mut Renderer, options: &Options) -> Result<(), Box<dyn std::error::Error>> {
        let mut writer = Writer::open(&self.domain)?;
        let count = self.reader.rest().layout().count() as u32;
        let mut scene = Scene::new(&self.reader, Settings::volume(Preset::Ct.transfer()), options);
        for bricks in [0, 1, 16, 64, 512] {
            let bricks = bricks.min(count / 2);
            let mut transaction = writer.begin();
            for n in 0..bricks {
                let brick = transaction.brick_mut(count / 4 + n);
                brick.voxels.iter_mut().for_each(|v| *v += 1);
                brick.summarise();
            }
            transaction.commit();
            let before = renderer.traffic();
            let start = Instant::now();
            scene.draw(&self.reader, renderer, None)?;
            let (ms, now) = (start.elapsed().as_secs_f64() * 1e3, renderer.traffic());
            println!(
                "  {bricks} bricks committed: uploaded {} KiB, fetched {} KiB, maps and index {} KiB, frame {ms:.2} ms",
                (now.uploaded - before.uploaded) >> 10,
                (now.fetched - before.fetched) >> 10,
                (now.other - before.other) >> 10,
            );
        }
        Ok(())
    }
}

/// One view.
struct Scene {
    settings: Settings,
    skip: Skip,
    camera: Camera,
    picture: Picture,
}

impl Scene {
    fn new(reader: &Reader, settings: Settings, options: &Options) -> Self {
        let snapshot = reader.snapshot();
        let [width, height] = if options.quick { [160, 132] } else { [1224, 1014] };
        let skip = Skip::new(&snapshot, &settings);
        Self { camera: Camera::around(snapshot.info()), settings, skip, picture: Picture::new(width, height) }
    }

    fn draw(&mut self, reader: &Reader, renderer: &mut Renderer, warp: Option<&Warp>) -> Result<(), Box<dyn std::error::Error>> {
        let snapshot = reader.snapshot();
        self.skip.update(&snapshot, &self.settings);
        let extras = Extras { warp, ..Extras::default() };
        renderer.begin(&extras, snapshot, &self.skip, &self.camera, &self.settings, &self.picture)?.finish(&mut self.picture)?;
        Ok(())
    }
}

fn statistics(times: &mut [f64]) -> (f64, f64) {
    times.sort_by(f64::total_cmp);
    let mean = times.iter().sum::<f64>() / times.len() as f64;
    let variance = times.iter().map(|t| (t - mean).powi(2)).sum::<f64>() / times.len() as f64;
    (times[times.len() / 2], variance.sqrt())
}
