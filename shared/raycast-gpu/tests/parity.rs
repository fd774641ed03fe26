//! The contract of the twins: in every view at most one pixel in a thousand differs by more than 2/255 from the CPU's, and of voxels that lie
//! in a store nothing is uploaded, whatever is drawn. (The CPU has the same volume on the heap.)
//!
//! Why not none: f32 sums in another order, and `exp2` of another library, put a sample that lies on the edge of a table's entry or of
//! a surface on the other side of it. The reference is the scalar kernel; where it refuses (warp, labels) the portable packets, whose
//! weights have 14 bits.

mod common;

use common::{World, body, difference, gpu, info, sliding, warp};
use maille_raycast::{
    Camera, Capsule, Extras, Geometry, Kernel, Labels, Light, Mode, Overlay, Picture, Plane, Preset, Probe, Section, Settings, Shading,
    Skip, SlabMode, Step, Transfer, Ultrasound, Warp, render_extra, section_with, ultrasound,
};
use maille_raycast_gpu::{GpuError, Placement, Renderer, Traffic};
use maille_volume::{BrickSource, BrickedVolume};

/// Pixels that may differ.
const SHARE: f64 = 0.001;
const SIZE: [usize; 2] = [120, 90];

struct Bench {
    source: BrickedVolume,
    // what reads it goes first
    renderer: Renderer,
    world: World,
    /// all that was moved until the last picture
    moved: Traffic,
    failures: Vec<String>,
}

impl Bench {
    fn new(size: [usize; 3], spacing: [f64; 3]) -> Option<Self> {
        let gpu = gpu()?;
        let source = body(size, spacing);
        let world = World::new(&source.to_volume());
        let renderer = Renderer::for_store(gpu, &world.reader, Placement::InPlace).unwrap();
        if let Some(notice) = renderer.notice() {
            assert!(!renderer.gpu().is_software(), "{notice}");
            eprintln!("SKIPPED: nothing is in place here: {notice}");
        }
        Some(Self { source, renderer, world, moved: Traffic::default(), failures: Vec::new() })
    }

    fn judge(&mut self, name: &str, cpu: &Picture, gpu: &Picture, dark: bool) {
        let (share, worst) = difference(cpu, gpu);
        let shown = cpu.rgb.iter().filter(|&&v| v > 20).count();
        let (now, before) = (self.renderer.traffic(), std::mem::replace(&mut self.moved, self.renderer.traffic()));
        println!(
            "{name}: {:.0} of {} pixels differ by more than 2 ({:.3} %), at most {worst}; {shown} bytes above 20; {} bytes of voxels uploaded, {} of all else",
            share * (cpu.rgb.len() / 3) as f64,
            cpu.rgb.len() / 3,
            share * 100.0,
            now.uploaded - before.uploaded,
            now.other - before.other
        );
        if self.renderer.placement() == Placement::InPlace && (now.uploaded, now.fetched) != (0, 0) {
            self.failures.push(format!("{name}: {now:?} in place"));
        }
        if share > SHARE || (shown == 0) != dark {
            self.failures.push(format!("{name}: {share} of pixels, at most {worst}; {shown} bytes shown"));
        }
    }

    fn ray(&mut self, name: &str, camera: &Camera, settings: &Settings, extras: &Extras<'_>, dark: bool) {
        let skip = Skip::new(&self.source, settings);
        let kernel = if extras.warp.is_some() || extras.labels.is_some() { Kernel::Portable } else { Kernel::Scalar };
        let mut cpu = Picture::with_depth(SIZE[0], SIZE[1]);
        render_extra(&Extras { kernel, ..*extras }, &self.source, &skip, camera, settings, &mut cpu).unwrap();
        let mut gpu = Picture::with_depth(SIZE[0], SIZE[1]);
        let snapshot = self.world.reader.snapshot();
        let skip = Skip::new(&snapshot, settings);
        self.renderer.render(extras, &snapshot, &skip, camera, settings, &mut gpu).unwrap();
        drop(snapshot);
        self.judge(name, &cpu, &gpu, dark);
        // depths: the same where both see something, but for those samples on an edge
        let depths = cpu.depth.as_ref().unwrap().iter().zip(gpu.depth.as_ref().unwrap());
        let far = depths.filter(|(a, b)| !(a == b || (**a - **b).abs() < 0.02)).count();
        if far as f64 > 2.0 * SHARE * (SIZE[0] * SIZE[1]) as f64 {
            self.failures.push(format!("{name}: {far} depths differ"));
        }
    }

    fn flat(&mut self, name: &str, section: &Section, overlay: &Overlay<'_>) {
        let mut cpu = Picture::new(SIZE[0], SIZE[1]);
        section_with(&self.source, section, overlay, &mut cpu);
        let mut gpu = Picture::new(SIZE[0], SIZE[1]);
        self.renderer.section_with(&self.world.reader.snapshot(), section, overlay, &mut gpu).unwrap();
        self.judge(name, &cpu, &gpu, false);
    }

    fn echoes(&mut self, name: &str, settings: &Ultrasound, warp: Option<&Warp>, size: [usize; 2], dark: bool) {
        let (mut cpu, mut gpu) = (Picture::with_depth(size[0], size[1]), Picture::with_depth(size[0], size[1]));
        ultrasound(&self.source, settings, warp, &mut cpu).unwrap();
        self.renderer.ultrasound(&self.world.reader.snapshot(), settings, warp, &mut gpu).unwrap();
        self.judge(name, &cpu, &gpu, dark);
        if cpu.depth != gpu.depth {
            self.failures.push(format!("{name}: depths differ"));
        }
    }

    /// A probe that looks at the middle of the body from somewhere on the way there, 0 far outside and 1 in the middle.
    fn probe(&self, from: [f64; 3], share: f64) -> Ultrasound {
        let c = self.source.info().grid.center();
        let face = std::array::from_fn(|n| c[n] + (1.0 - share) * from[n]);
        let probe = Probe::convex(face, from.map(|v| -v), [0.3, 1.0, -0.2]);
        Ultrasound::new(Probe { depth_mm: 45.0, radius_mm: 40.0, ..probe })
    }

    fn outside(&self) -> Camera {
        let c = self.source.info().grid.center();
        Camera { eye: [c[0] + 95.3, c[1] - 81.7, c[2] + 55.1], target: c, up: [0.0, 0.0, 1.0], fov_deg: 21.0 }
    }

    fn inside(&self) -> Camera {
        let grid = &self.source.info().grid;
        let eye = grid.world_from_index(std::array::from_fn(|c| grid.size[c] as f64 * [0.31, 0.42, 0.55][c]));
        Camera { eye, target: grid.center(), up: [0.2, 0.1, 1.0], fov_deg: 100.0 }
    }

    fn end(self) {
        assert!(self.failures.is_empty(), "{} on {}", self.failures.join("\n"), self.renderer.gpu().name());
    }
}

fn even(settings: Settings) -> Settings {
    Settings { adaptive: None, ..settings }
}

fn tissue() -> Settings {
    even(Settings::volume(Preset::SoftTissue.transfer()))
}

fn flat_transfer(opacity: f64) -> Transfer {
    Transfer { color: vec![[0.0, 0.9, 0.5, 0.2]], opacity: vec![[0.0, opacity]], shading: Some(Shading::default()) }
}

fn scope() -> Settings {
    let mut settings = tissue();
    settings.shading = Some(Shading { light: Light::AtEye { half_distance_mm: 30.0 }, power: 7, ambient_light: 1.0, ..Shading::default() });
    settings
}

#[test]
fn views_of_a_volume_are_those_of_the_cpu() {
    let Some(mut bench) = Bench::new([52, 45, 49], [1.0, 1.1, 0.9]) else { return };
    let (out, inner) = (bench.outside(), bench.inside());
    let none = Extras::default();
    bench.ray("volume", &out, &tissue(), &none, false);
    bench.ray("volume from within tissue", &inner, &tissue(), &none, false);
    bench.ray("volume without light", &out, &Settings { shading: None, ..tissue() }, &none, false);
    bench.ray(
        "volume, fine steps",
        &out,
        &Settings { step: Step::Millimetres(0.37), background: [0.3, 0.4, 0.5], ..tissue() },
        &none,
        false,
    );
    bench.ray("surface", &out, &Settings::isosurface(150.0), &none, false);
    bench.ray("surface from within tissue", &inner, &Settings::isosurface(150.0), &none, false);
    bench.ray("both", &out, &even(Settings::both(Preset::SoftTissue.transfer(), 500.0)), &none, false);
    bench.ray("x-ray", &out, &Settings::xray(), &none, false);
    bench.ray("endoscope with barrel distortion", &inner, &scope(), &Extras { barrel: 0.3, ..none }, false);
    bench.ray("empty transfer function", &out, &even(Settings::volume(flat_transfer(0.0))), &none, true);
    bench.ray("opaque transfer function", &out, &even(Settings::volume(flat_transfer(1.0))), &none, false);
    bench.ray("opaque from within", &inner, &even(Settings::volume(flat_transfer(1.0))), &none, false);
    let c = bench.source.info().grid.center();
    let capsules = [Capsule { a: [c[0] + 40.0, c[1] - 40.0, c[2] + 5.0], b: c, radius: 3.0, color: [0.4, 0.6, 0.9] }];
    let geometry = Geometry { capsules: &capsules, meshes: &[] };
    let solid = Extras { geometry: Some(&geometry), ..none };
    bench.ray("a needle in tissue", &out, &tissue(), &solid, false);
    bench.ray("a needle beside a surface", &out, &Settings::isosurface(500.0), &solid, false);
    let labels = organs(&bench.source);
    bench.ray("labels", &out, &tissue(), &Extras { labels: Some(&labels), ..none }, false);
    bench.end();
}

#[test]
fn views_through_a_warp_are_those_of_the_cpu() {
    let Some(mut bench) = Bench::new([52, 45, 49], [1.0, 1.1, 0.9]) else { return };
    let (out, inner) = (bench.outside(), bench.inside());
    let moved: Warp = warp(&info(&bench.source));
    let extras = Extras { warp: Some(&moved), ..Extras::default() };
    bench.ray("warped volume", &out, &tissue(), &extras, false);
    bench.ray("warped volume from within tissue", &inner, &tissue(), &extras, false);
    bench.ray("warped surface", &out, &Settings::isosurface(150.0), &extras, false);
    bench.ray("warped both", &out, &even(Settings::both(Preset::SoftTissue.transfer(), 500.0)), &extras, false);
    bench.ray("warped x-ray", &out, &Settings::xray(), &extras, false);
    bench.ray("warped endoscope", &inner, &scope(), &Extras { barrel: 0.3, ..extras }, false);
    let labels = organs(&bench.source);
    let steep: Warp = sliding(&info(&bench.source));
    let found = Extras { warp: Some(&steep), ..Extras::default() };
    bench.ray("sliding surface, one by one", &out, &Settings::isosurface(150.0), &found, false);
    bench.ray("sliding volume, one by one", &out, &tissue(), &found, false);
    bench.ray("warped labels", &out, &tissue(), &Extras { labels: Some(&labels), ..extras }, false);
    bench.end();
}

/// On the curved skin, with some millimetres of gel.
const ON_SKIN: [f64; 3] = [12.0, -17.0, 8.0];

#[test]
fn ultrasound_is_that_of_the_cpu() {
    let Some(mut bench) = Bench::new([52, 45, 49], [1.0, 1.1, 0.9]) else { return };
    let skin = bench.probe(ON_SKIN, 0.0);
    bench.echoes("ultrasound: bone and gas under curved skin", &skin, None, SIZE, false);
    bench.echoes("ultrasound of interfaces alone", &Ultrasound { speckle: false, ..skin }, None, SIZE, false);
    bench.echoes("ultrasound: from within tissue", &bench.probe([-3.0, 14.0, 9.0], 0.3), None, SIZE, false);
    bench.echoes("ultrasound: on bone", &bench.probe(ON_SKIN, 0.45), None, SIZE, false);
    bench.echoes("ultrasound: in gas", &bench.probe(ON_SKIN, 1.0), None, SIZE, false);
    // of air there is the line where the probe ends
    bench.echoes("ultrasound: in the air", &bench.probe([90.0, 20.0, -40.0], 0.0), None, SIZE, false);
    bench.echoes("ultrasound: far away", &bench.probe([1e6, 1e8, -1e12], 0.0), None, SIZE, false);
    let fine = Ultrasound { lines: 777, step_mm: 0.07, pulse_mm: 0.4, beam: [0.9, 0.03], gain: [40.0, 1.1], range_db: 45.0, ..skin };
    bench.echoes("ultrasound: many fine samples", &fine, None, [301, 203], false);
    let coarse = Ultrasound { lines: 2, step_mm: 1.3, ..skin };
    bench.echoes("ultrasound: two coarse lines", &coarse, None, SIZE, false);
    let flat = Probe { radius_mm: 1e5, angle_deg: 0.02, ..skin.probe };
    bench.echoes("ultrasound: a flat face", &Ultrasound { probe: flat, ..skin }, None, SIZE, false);
    let wide = Probe { radius_mm: 4.0, angle_deg: 175.0, depth_mm: 30.0, ..skin.probe };
    bench.echoes("ultrasound: a wide fan", &Ultrasound { probe: wide, ..skin }, None, [331, 97], false);
    let once = Probe { depth_mm: 0.3, ..bench.probe([-3.0, 14.0, 9.0], 0.3).probe };
    bench.echoes("ultrasound: one sample a line", &Ultrasound { probe: once, ..skin }, None, SIZE, true);
    bench.end();
}

#[test]
fn ultrasound_through_a_warp_is_that_of_the_cpu() {
    let Some(mut bench) = Bench::new([52, 45, 49], [1.0, 1.1, 0.9]) else { return };
    let (moved, steep): (Warp, Warp) = (warp(&info(&bench.source)), sliding(&info(&bench.source)));
    let (skin, inner) = (bench.probe(ON_SKIN, 0.0), bench.probe([-3.0, 14.0, 9.0], 0.3));
    bench.echoes("warped ultrasound", &skin, Some(&moved), SIZE, false);
    bench.echoes("warped ultrasound from within tissue", &inner, Some(&moved), SIZE, false);
    bench.echoes("warped ultrasound of interfaces alone", &Ultrasound { speckle: false, ..skin }, Some(&moved), SIZE, false);
    bench.echoes("sliding ultrasound, one by one", &skin, Some(&steep), SIZE, false);
    bench.echoes("warped ultrasound in the air", &bench.probe([90.0, 20.0, -40.0], 0.0), Some(&moved), SIZE, false);
    bench.end();
}

#[test]
fn flat_and_thick_voxels_are_drawn_alike() {
    let Some(mut bench) = Bench::new([60, 55, 13], [0.8, 0.8, 4.0]) else { return };
    let (out, inner) = (bench.outside(), bench.inside());
    let moved: Warp = warp(&info(&bench.source));
    let none = Extras::default();
    let warped = Extras { warp: Some(&moved), ..none };
    bench.ray("spacing 1:5", &out, &tissue(), &none, false);
    bench.ray("spacing 1:5 from within", &inner, &Settings::isosurface(100.0), &none, false);
    bench.ray("spacing 1:5, warped", &out, &tissue(), &warped, false);
    let probe = bench.probe([-11.0, -16.0, 9.0], 0.0);
    bench.echoes("ultrasound, spacing 1:5", &probe, None, SIZE, false);
    bench.echoes("ultrasound, spacing 1:5, warped", &probe, Some(&moved), SIZE, false);
    bench.end();
}

#[test]
fn sections_are_those_of_the_cpu() {
    let Some(mut bench) = Bench::new([52, 45, 49], [1.0, 1.1, 0.9]) else { return };
    let moved: Warp = warp(&info(&bench.source));
    let labels = organs(&bench.source);
    let info = info(&bench.source);
    let oblique = Plane::Oblique { right: [0.8, 0.6, 0.0], down: [0.0, 0.0, -1.0] };
    let whole = |plane| Section { level: 20.0, window: 700.0, ..Section::whole(&info, plane, None, SIZE[0], SIZE[1]) };
    let plain = Overlay::default();
    bench.flat("axial", &whole(Plane::Axial), &plain);
    bench.flat("coronal", &whole(Plane::Coronal), &plain);
    bench.flat("oblique", &whole(oblique), &plain);
    bench.flat("mean of a slab", &Section { slab_mm: 7.0, ..whole(Plane::Sagittal) }, &plain);
    bench.flat("largest of a slab", &Section { slab_mm: 7.0, slab_mode: SlabMode::Maximum, ..whole(Plane::Axial) }, &plain);
    bench.flat("labels in a section", &whole(Plane::Axial), &Overlay { labels: Some(&labels), ..plain });
    bench.flat("warped section", &whole(Plane::Coronal), &Overlay { warp: Some(&moved), ..plain });
    let steep: Warp = sliding(&info);
    bench.flat("sliding section, one by one", &whole(Plane::Coronal), &Overlay { warp: Some(&steep), ..plain });
    let shown = Overlay { warp: Some(&moved), labels: Some(&labels), displacement_mm: Some(6.0), ..plain };
    bench.flat("displacement and labels in a slab", &Section { slab_mm: 4.0, ..whole(Plane::Coronal) }, &shown);
    let c = info.grid.center();
    let capsules = [Capsule { a: [c[0] - 20.0, c[1], c[2]], b: [c[0] + 20.0, c[1] + 3.0, c[2]], radius: 4.0, color: [0.4, 0.6, 0.9] }];
    let geometry = Geometry { capsules: &capsules, meshes: &[] };
    bench.flat("outlines", &whole(Plane::Axial), &Overlay { geometry: Some(&geometry), ..plain });
    bench.end();
}

#[test]
fn pieces_of_ray_by_weight_are_drawn_alike_but_for_the_last_bit_of_a_weight() {
    let Some(gpu) = gpu() else { return };
    let source = body([52, 45, 49], [1.0, 1.1, 0.9]);
    let mut renderer = Renderer::for_volume(gpu, source.layout()).unwrap();
    let c = source.info().grid.center();
    let camera = Camera { eye: [c[0] + 95.3, c[1] - 81.7, c[2] + 55.1], target: c, up: [0.0, 0.0, 1.0], fov_deg: 21.0 };
    let settings = Settings::volume(Preset::Ct.transfer());
    let skip = Skip::new(&source, &settings);
    let (mut cpu, mut gpu) = (Picture::new(SIZE[0], SIZE[1]), Picture::new(SIZE[0], SIZE[1]));
    let extras = Extras { kernel: Kernel::Scalar, ..Extras::default() };
    render_extra(&extras, &source, &skip, &camera, &settings, &mut cpu).unwrap();
    renderer.render(&extras, &source, &skip, &camera, &settings, &mut gpu).unwrap();
    let (share, worst) = difference(&cpu, &gpu);
    println!("pieces by weight: {:.3} % of pixels, at most {worst}", 100.0 * share);
    // whether a piece is halved hangs on one comparison; packets and single rays of the CPU are allowed one byte in a hundred
    assert!(share < 0.01, "{share}");
}

/// Three organs in slabs.
fn organs(source: &BrickedVolume) -> Labels {
    let size = source.info().grid.size;
    let count = size.iter().product::<usize>();
    let voxels = (0..count).map(|n| if n / size[0] % size[1] < 20 { (n % size[0] / 17) as u8 } else { 0 }).collect();
    let mut labels = Labels::new(size, voxels).unwrap();
    labels.opacity[2] = 0.2;
    labels
}

#[test]
fn what_the_cpu_refuses_is_refused_in_its_words() {
    let Some(mut bench) = Bench::new([20, 20, 20], [1.0; 3]) else { return };
    let settings = Settings { step: Step::Millimetres(-1.0), ..tissue() };
    let skip = Skip::new(&bench.source, &tissue());
    let mut picture = Picture::new(8, 8);
    let refused =
        bench.renderer.render(&Extras::default(), &bench.source, &skip, &Camera::around(bench.source.info()), &settings, &mut picture);
    assert!(refused.unwrap_err().to_string().contains("step of -1 mm"));
    let stale = Settings { mode: Mode::Xray { water_per_mm: 0.01 }, ..tissue() };
    let refused =
        bench.renderer.render(&Extras::default(), &bench.source, &skip, &Camera::around(bench.source.info()), &stale, &mut picture);
    assert!(refused.is_err());
    let fan = bench.probe(ON_SKIN, 0.0);
    let sideways = Ultrasound { probe: Probe { across: fan.probe.direction, ..fan.probe }, ..fan };
    let alien = warp(&info(&body([24, 20, 20], [1.0; 3])));
    for (bad, warp) in [(sideways, None), (Ultrasound { lines: 1, ..fan }, None), (fan, Some(&alien))] {
        let untouched = picture.clone();
        let by_gpu = bench.renderer.ultrasound(&bench.source, &bad, warp, &mut picture).unwrap_err();
        let by_cpu = ultrasound(&bench.source, &bad, warp, &mut picture).unwrap_err();
        assert!(matches!(by_gpu, GpuError::Render(_)), "{by_gpu:?}");
        assert_eq!((by_gpu.to_string(), &picture), (by_cpu, &untouched));
    }
    // what the CPU could draw, though nobody would wait for it
    let vast = Ultrasound { lines: 4096, step_mm: 45.0 / 16000.0, ..fan };
    let refused = bench.renderer.ultrasound(&bench.source, &vast, None, &mut picture);
    assert!(matches!(refused, Err(GpuError::Unsupported(_))), "{refused:?}");
    bench.echoes("ultrasound after refusals", &fan, None, [1, 1], true);
    let narrow = Ultrasound { probe: Probe { angle_deg: 0.5, ..fan.probe }, ..fan };
    bench.echoes("ultrasound in a picture of a column", &narrow, None, [1, 97], false);
    assert!(bench.renderer.ultrasound(&bench.source, &fan, None, &mut Picture::new(0, 7)).is_ok(), "as the CPU has it");
    bench.end();
}
