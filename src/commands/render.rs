//! `maille render`: one picture of a volume, or of a scene at rest, without starting any process.

use super::{Failure, Outcome, invert::read_field, keep_apart};
use clap::{Args as ClapArgs, ValueEnum};
use maille_motion::resample::sample;
use maille_phantom::{Kind, Phantom};
use maille_raycast::{
    Camera, Extras, Geometry, Labels, Light, MeshView, Motion, Overlay, Picture, Plane, Preset, Probe, Section, Settings, Shown, Skip,
    SlabMode, Step, Transfer, Ultrasound, Warp, WarpOptions, overlay_section, overlay_view, render_extra, section_with, ultrasound,
};
use maille_raycast_gpu::{Choice, Gpu, GpuError, Renderer};
use maille_rendering::Meshes;
use maille_scene::{BoxMm, Mode as SceneMode, PhantomKind, Scene, VolumeSource};
use maille_surface::{Mesh, read_mesh};
use maille_volume::{BrickSource as _, BrickedVolume, Sampler, Volume, io};
use rayon::prelude::*;
use std::{
    fs::File,
    io::BufWriter,
    path::{Path, PathBuf},
    time::Instant,
};

/// Render a picture of a scene or a volume into a PNG file
///
/// Positions are patient coordinates (LPS) in millimetres. Lists may begin with a minus sign: --eye=-10,20,30.
#[derive(ClapArgs)]
pub struct Args {
    /// a scene (.toml), or a volume: NRRD, MetaImage, NIfTI, or DICOM (a file or a directory)
    #[arg(value_name = "SCENE|VOLUME")]
    input: PathBuf,
    /// the picture to write
    #[arg(short, long, value_name = "PNG")]
    output: PathBuf,
    /// what to show: the 3D view, a section, a radiograph with the camera of the 3D view, or the fan of an ultrasound probe at the eye
    #[arg(long, value_enum, default_value_t = View::ThreeD)]
    view: View,
    /// pixels across and down [default: the scene's, or 1024x768]
    #[arg(long, value_name = "WxH", value_parser = size)]
    size: Option<[usize; 2]>,
    /// where the eye is [default: in front of the patient]
    #[arg(long, value_name = "X,Y,Z", value_parser = triple, allow_hyphen_values = true)]
    eye: Option<[f64; 3]>,
    /// what the eye looks at [default: the middle of the volume]
    #[arg(long, value_name = "X,Y,Z", value_parser = triple, allow_hyphen_values = true)]
    target: Option<[f64; 3]>,
    /// which way is up in the picture [default: 0,0,1, the head]
    #[arg(long, value_name = "X,Y,Z", value_parser = triple, allow_hyphen_values = true)]
    up: Option<[f64; 3]>,
    /// vertical field of view [default: 30]
    #[arg(long, value_name = "DEG", value_parser = finite, allow_hyphen_values = true)]
    fov: Option<f64>,
    /// transfer function: ct, bone, soft, lung, skin, or a TOML or JSON file [default: the scene's, or ct]
    #[arg(long, value_name = "TF")]
    transfer: Option<String>,
    /// distance between samples along a ray: 0.5mm, or 1vox (smallest spacings) [default: the scene's, or 1vox]
    #[arg(long, value_name = "1mm|1vox", value_parser = step, allow_hyphen_values = true)]
    step: Option<Step>,
    /// show the surface at this value instead of the transfer function
    #[arg(long, value_name = "HU", value_parser = finite, allow_hyphen_values = true)]
    iso: Option<f64>,
    #[command(flatten)]
    more: Box<More>,
    /// colours without light
    #[arg(long)]
    no_shade: bool,
    /// position of a section along its normal [mm, LPS] [default: the middle of the volume]
    #[arg(long, value_name = "MM", value_parser = finite, allow_hyphen_values = true)]
    at: Option<f64>,
    /// grey levels of a section: centre and width [HU] [default: the scene's, or 40,400]
    #[arg(long, value_name = "CENTRE,WIDTH", value_parser = pair, allow_hyphen_values = true)]
    window: Option<[f64; 2]>,
    /// what renders; gpu needs Vulkan
    #[arg(long, value_enum, default_value_t = Backend::Cpu)]
    backend: Backend,
    /// threads [default: all cores]
    #[arg(long, value_name = "N")]
    threads: Option<usize>,
    /// render this many times and print one JSON object with the time of a frame in milliseconds
    #[arg(long, value_name = "N")]
    time: Option<usize>,
}

/// What fewer pictures need.
#[derive(ClapArgs)]
struct More {
    /// with the transfer function, show the opaque surface at this value
    #[arg(long, value_name = "HU", value_parser = finite, allow_hyphen_values = true, conflicts_with = "iso")]
    with_surface: Option<f64>,
    /// a surface seen from nearer than a pixel a voxel is that of the smooth function, as in scenes with `smooth-surface` (not on a GPU)
    #[arg(long)]
    smooth: bool,
    /// samples one step apart, instead of by their weight in the picture
    #[arg(long)]
    even: bool,
    /// a lamp at the eye, as an endoscope has: where half of its light is left
    #[arg(long, value_name = "MM", value_parser = positive)]
    lamp: Option<f64>,
    /// barrel distortion of the lens, 0 for none; 0.3 is much
    #[arg(long, value_name = "K", value_parser = positive)]
    barrel: Option<f64>,
    /// organs on the volume's own grid, in colours: a volume of whole numbers from 0 (nothing) to 255 [default: the scene's]
    #[arg(long, value_name = "VOLUME")]
    labels: Option<PathBuf>,
    /// a mesh among the voxels, in section views its outline: .stl, .ply or .obj, LPS millimetres; may be given several times; beside the scene's
    #[arg(long, value_name = "MESH")]
    mesh: Vec<PathBuf>,
    /// a displacement field, rest → moved in mm, as `maille deform` and `maille motion eval` write it: show the patient as moved by it
    #[arg(long, value_name = "FIELD")]
    warp: Option<PathBuf>,
    /// how the moved patient is drawn: by rays through the field's inverse, or by resampling the whole volume first
    #[arg(long, value_enum, default_value_t = WarpScheme::Lattice, requires = "warp")]
    warp_scheme: WarpScheme,
    /// how far from its place anything of the moved patient may be drawn
    #[arg(long, value_name = "MM", value_parser = positive, default_value_t = 0.05, requires = "warp")]
    warp_tolerance: f64,
    /// a displacement field as colours over what is seen: hue by its direction in the picture, strength by its length
    #[arg(long, value_name = "FIELD")]
    overlay: Option<PathBuf>,
    /// length of a displacement whose colour is opaque
    #[arg(long, value_name = "MM", value_parser = positive, default_value_t = 10.0, requires = "overlay")]
    overlay_mm: f64,
    /// how deep an ultrasound probe looks [default: 120]
    #[arg(long, value_name = "MM", value_parser = positive)]
    depth: Option<f64>,
    /// frequency of an ultrasound probe [default: 3.5]
    #[arg(long, value_name = "MHZ", value_parser = positive)]
    frequency: Option<f64>,
    /// thickness of a section
    #[arg(long, value_name = "MM", value_parser = positive)]
    slab: Option<f64>,
    /// what a thick section shows of the values across it
    #[arg(long, value_enum, default_value_t = Slab::Mean)]
    slab_mode: Slab,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum View {
    #[value(name = "3d")]
    ThreeD,
    Axial,
    Coronal,
    Sagittal,
    Xray,
    Ultrasound,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum WarpScheme {
    Lattice,
    Resample,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Slab {
    Mean,
    Max,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Backend {
    Cpu,
    Gpu,
}

/// Runs the command.
pub fn run(args: &Args) -> Outcome {
    if args.threads == Some(0) || args.time == Some(0) {
        return Err(Failure::Usage("--threads and --time need at least 1".into()));
    }
    let (volume, scene) = load(&args.input, args)?;
    let mut bricks = BrickedVolume::from_volume(&volume);
    drop(volume);
    // what a scene says is found in the patient at rest
    let failed = |e: maille_rendering::RenderingError| Failure::Refused(format!("{}: {e}", args.input.display()));
    let mut organs = None;
    let mut of_scene = Meshes::default();
    // as in a run: a radiograph shows neither, a fan neither
    if let Some(scene) = scene.as_ref().filter(|_| !matches!(args.view, View::Xray | View::Ultrasound)) {
        if args.more.labels.is_none() {
            organs = maille_rendering::organs(scene, &bricks).map_err(failed)?;
        }
        of_scene = Meshes::of(scene, &bricks).map_err(failed)?;
        if scene.organ_alone() > 0 && args.iso.is_some() && args.view == View::ThreeD {
            eprintln!("maille: {}: a surface at one value has no organs, all of it is shown", args.input.display());
        }
    }
    if organs.is_some() && args.more.warp.is_some() && args.more.warp_scheme == WarpScheme::Resample {
        return Err(Failure::Refused("a resampled patient has no organs: leave `--warp-scheme resample` out, or render the volume".into()));
    }
    if let Some(path) = args.more.warp.as_deref().filter(|_| !of_scene.is_empty()) {
        let field = read_field(path)?;
        of_scene.carry(|p| {
            let by = sample(&field, field.grid.index_from_world(p));
            std::array::from_fn(|c| p[c] + f64::from(by[c]))
        });
    }
    // colours are those of the patient at rest, also where that patient is resampled
    let moved = args.more.warp.as_deref().map(|path| warp(path, &bricks, args.more.warp_tolerance)).transpose()?;
    if let (Some(inverse), WarpScheme::Resample) = (&moved, args.more.warp_scheme) {
        bricks = resampled(&bricks, inverse);
    }
    let warp = moved.as_ref().filter(|_| args.more.warp_scheme == WarpScheme::Lattice);
    let colours = args.more.overlay.as_deref().map(motion).transpose()?;
    let moment = colours.as_ref().map(|motion| motion.moment(&[1.0])).transpose().map_err(|e| Failure::Refused(e.to_string()))?;
    let shown = moment.as_ref().map(|field| Shown { field, warp: moved.as_ref(), opaque_mm: args.more.overlay_mm });
    let plane = match args.view {
        View::ThreeD | View::Xray | View::Ultrasound => None,
        View::Axial => Some(Plane::Axial),
        View::Coronal => Some(Plane::Coronal),
        View::Sagittal => Some(Plane::Sagittal),
    };
    let sizes = scene.as_ref().map(|s| if plane.is_some() { s.rendering.section_size } else { s.rendering.size });
    let [width, height] = args.size.or(sizes).unwrap_or([1024, 768]);
    // where a 3D view is coloured it must be known how far away things are
    let depth = shown.is_some() && plane.is_none();
    let mut picture = if depth { Picture::with_depth(width, height) } else { Picture::new(width, height) };
    let of_file = args.more.labels.as_deref().map(|path| labels(path, &bricks)).transpose()?;
    let alone = scene.as_ref().map_or(0, Scene::organ_alone) as usize;
    let labels = of_file.as_ref().or(organs.as_mut().map(|organs| organs.show(alone)));
    let meshes = args.more.mesh.iter().map(|path| mesh(path)).collect::<Result<Vec<_>, _>>()?;
    let mut views = of_scene.views();
    views.extend(meshes.iter().zip(MESH_COLORS.into_iter().cycle()).map(|(m, color)| mesh_view(m, color)));
    let geometry = Geometry { capsules: &[], meshes: &views };
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(args.threads.unwrap_or(0))
        .build()
        .map_err(|e| Failure::Refused(format!("no threads to render with: {e}")))?;
    let frames = args.time.unwrap_or(1);
    let mut gpu = match args.backend {
        Backend::Cpu => None,
        Backend::Gpu => Some(open_gpu(&bricks)?),
    };
    let refused = |e: &dyn std::fmt::Display| Failure::Refused(format!("{}: {e}", args.input.display()));
    let times = match plane {
        Some(plane) => {
            let section_of = section_settings(args, scene.as_ref(), &bricks, plane, [width, height]);
            let overlay = Overlay { warp, labels, geometry: Some(&geometry), ..Overlay::default() };
            let mut outcome = Ok(());
            let times = timed(frames, || match &mut gpu {
                None => pool.install(|| section_with(&bricks, &section_of, &overlay, &mut picture)),
                Some(gpu) => outcome = gpu.section_with(&bricks, &section_of, &overlay, &mut picture).map(drop),
            });
            outcome.map_err(|e| refused(&e))?;
            if let Some(shown) = &shown {
                overlay_section(&mut picture, &section_of, bricks.info(), shown);
            }
            times
        }
        None if args.view == View::Ultrasound => {
            let fan = fan(args, scene.as_ref(), &bricks)?;
            let mut outcome = Ok(());
            let times = timed(frames, || match &mut gpu {
                None => outcome = pool.install(|| ultrasound(&bricks, &fan, warp, &mut picture)).map_err(Failure::Usage),
                Some(gpu) => {
                    outcome = gpu.ultrasound(&bricks, &fan, warp, &mut picture).map(drop).map_err(|e| match e {
                        GpuError::Render(fault) => Failure::Usage(fault.to_string()),
                        other => refused(&other),
                    });
                }
            });
            outcome?;
            times
        }
        None => {
            let settings = settings(args, scene.as_ref())?;
            let camera = camera(args, scene.as_ref(), &bricks)?;
            let skip = pool.install(|| Skip::new(&bricks, &settings));
            let barrel = args.more.barrel.unwrap_or(0.0);
            let zoom = args.more.smooth || scene.as_ref().is_some_and(|scene| scene.has_effect("smooth-surface"));
            if args.more.smooth && gpu.is_some() {
                return Err(Failure::Refused("--smooth is drawn by the processor: leave `--backend gpu` out".into()));
            }
            let extras = Extras { warp, labels, barrel, geometry: Some(&geometry), zoom, ..Extras::default() };
            let mut outcome = Ok(());
            let times = timed(frames, || {
                let drawn = match &mut gpu {
                    None => {
                        pool.install(|| render_extra(&extras, &bricks, &skip, &camera, &settings, &mut picture)).map_err(|e| refused(&e))
                    }
                    Some(gpu) => gpu.render(&extras, &bricks, &skip, &camera, &settings, &mut picture).map(drop).map_err(|e| refused(&e)),
                };
                if drawn.is_err() {
                    outcome = drawn;
                }
            });
            outcome?;
            if let Some(shown) = &shown {
                overlay_view(&mut picture, &camera, barrel, bricks.info(), shown);
            }
            times
        }
    };
    if args.time.is_some() {
        let frame = serde_json::json!({"width": width, "height": height, "frames": frames, "threads": pool.current_num_threads(),
            "median_ms": times[times.len() / 2], "min_ms": times[0]});
        println!("{frame}");
    }
    write_png(&args.output, &picture)
}

/// A GPU with room for the volume. Asked for by name, it is not replaced by the CPU in silence.
fn open_gpu(bricks: &BrickedVolume) -> Result<Renderer, Failure> {
    let refused = |e: GpuError| Failure::Refused(format!("{e}: leave --backend out to render on the CPU"));
    let gpu = Gpu::open(&Choice::any()).map_err(refused)?;
    if gpu.is_software() {
        eprintln!("maille: {} is no GPU but a program on the CPU, and slower than this program's own", gpu.name());
    }
    Renderer::for_volume(gpu, bricks.layout()).map_err(refused)
}

/// The volume, and the scene if it came from one.
fn load(path: &Path, args: &Args) -> Result<(Volume, Option<Scene>), Failure> {
    let more = &args.more;
    let given = [Some(&args.input), more.labels.as_ref(), more.warp.as_ref(), more.overlay.as_ref()];
    let given = || given.into_iter().flatten().chain(&more.mesh).map(PathBuf::as_path);
    let is_scene = path.extension().is_some_and(|e| e.eq_ignore_ascii_case("toml"));
    if !is_scene {
        keep_apart(given(), [args.output.as_path()])?;
        return Ok((read(path)?, None));
    }
    let scene = Scene::load(path).map_err(|e| Failure::Report(e.into()))?;
    keep_apart(given().chain(scene.files()), [args.output.as_path()])?;
    let volume = match scene.volume.source() {
        VolumeSource::File(file) => read(&file)?,
        VolumeSource::Phantom { kind, size, seed } => {
            let kind = match kind {
                PhantomKind::Head => Kind::Head,
                PhantomKind::Torso => Kind::Torso,
            };
            Phantom::new(kind, seed).volume(size)
        }
    };
    Ok((volume, Some(scene)))
}

fn read(path: &Path) -> Result<Volume, Failure> {
    let (volume, notices) = io::read_volume(path).map_err(|e| Failure::Refused(e.to_string()))?;
    for notice in notices {
        eprintln!("maille: {}: {notice}", path.display());
    }
    Ok(volume)
}

/// What the picture shows: the scene's settings, changed by the options that were given.
fn settings(args: &Args, scene: Option<&Scene>) -> Result<Settings, Failure> {
    let rendering = scene.map(|s| &s.rendering);
    let name = args.transfer.as_deref().or(rendering.map(|r| r.transfer.as_str())).unwrap_or("ct");
    let iso = args.iso.or_else(|| {
        let shows_surface = rendering.is_some_and(|r| r.mode == SceneMode::Isosurface) && args.transfer.is_none();
        scene.filter(|_| shows_surface).map(|s| s.deformation.threshold_hu)
    });
    let mut settings = match (args.view, iso) {
        (View::Xray, _) => Settings::xray(),
        (_, Some(threshold)) => Settings::isosurface(threshold),
        _ => match args.more.with_surface {
            Some(threshold) => Settings::both(transfer(name)?, threshold),
            None => Settings::volume(transfer(name)?),
        },
    };
    if args.more.even {
        settings.adaptive = None;
    }
    if let Some(rendering) = rendering {
        settings.step = Step::Voxels(rendering.step);
        settings.opacity_end = rendering.opacity_end;
    }
    if let Some(step) = args.step {
        settings.step = step;
    }
    if args.no_shade || rendering.is_some_and(|r| !r.shading) {
        settings.shading = None;
    }
    if let (Some(half_distance_mm), Some(shading)) = (args.more.lamp, &mut settings.shading) {
        shading.light = Light::AtEye { half_distance_mm };
    }
    Ok(settings)
}

/// Labels from a file on the volume's grid.
fn labels(path: &Path, bricks: &BrickedVolume) -> Result<Labels, Failure> {
    let fault = |text: String| Failure::Refused(format!("{}: {text}", path.display()));
    let volume = read(path)?;
    if volume.info.grid != bricks.info().grid {
        return Err(fault("the labels are not on the volume's grid".into()));
    }
    let rescale = volume.info.rescale;
    let label = |v: &i16| {
        let value = rescale.value(f64::from(*v)).round();
        (0.0..=255.0).contains(&value).then_some(value as u8).ok_or_else(|| fault(format!("{value} is no label from 0 to 255")))
    };
    let voxels = volume.voxels.iter().map(label).collect::<Result<_, _>>()?;
    Labels::new(volume.info.grid.size, voxels).map_err(fault)
}

/// A displacement field from a file.
fn motion(path: &Path) -> Result<Motion, Failure> {
    Motion::single(&read_field(path)?).map_err(|e| Failure::Refused(format!("{}: {e}", path.display())))
}

/// The inverse of a field, on a lattice as fine as the tolerance wants it, down to half of the field's own, or one by one where it has kinks.
fn warp(path: &Path, bricks: &BrickedVolume, tolerance_mm: f64) -> Result<Warp, Failure> {
    let motion = motion(path)?;
    let finest = 0.5 * motion.grid().min_spacing();
    let mut pitch_mm = 8.0f64.max(finest);
    loop {
        let options = WarpOptions { tolerance_mm: tolerance_mm as f32, pitch_mm: pitch_mm as f32, ..WarpOptions::default() };
        let mut warp = Warp::new(bricks.info(), options);
        let report = warp.update(bricks.info(), &motion, &[1.0]).map_err(|e| Failure::Refused(format!("{}: {e}", path.display())))?;
        // places that are found one by one are, whatever the lattice
        let within = f64::from(report.error_mm) <= tolerance_mm || report.rough > 0;
        if within || pitch_mm <= finest {
            if report.unsettled > 0 || !within {
                let worst = if report.rough > 0 { 0.1 * tolerance_mm } else { report.error_mm.into() };
                let lost = report.unsettled;
                eprintln!(
                    "maille: {}: drawn to within {worst:.3} mm, {lost} of {} places without an inverse",
                    path.display(),
                    report.nodes
                );
            }
            return Ok(warp);
        }
        pitch_mm = (0.5 * pitch_mm).max(finest);
    }
}

/// The volume as moved, on its own grid; what comes from outside is its smallest value.
fn resampled(bricks: &BrickedVolume, warp: &Warp) -> BrickedVolume {
    let (info, sampler) = (bricks.info().clone(), Sampler::new(bricks));
    let [nx, ny, _] = info.grid.size;
    let lowest = bricks.to_volume().voxels.iter().copied().min().unwrap_or(0);
    let voxels = (0..info.grid.voxel_count()).into_par_iter().map(|n| {
        let rest = warp.rest_index([n % nx, n / nx % ny, n / (nx * ny)].map(|c| c as f32)).map(f64::from);
        let stored = |hu: f64| ((hu - info.rescale.intercept) / info.rescale.slope).round().clamp(-32768.0, 32767.0) as i16;
        sampler.value(info.grid.world_from_index(rest)).map_or(lowest, stored)
    });
    let voxels = voxels.collect();
    BrickedVolume::from_volume(&Volume::new(info.grid.clone(), info.rescale, voxels))
}

/// Colours of meshes, in turn: organs and instruments as atlases have them.
const MESH_COLORS: [[f32; 3]; 6] =
    [[0.85, 0.35, 0.3], [0.4, 0.65, 0.9], [0.55, 0.8, 0.45], [0.95, 0.8, 0.4], [0.75, 0.5, 0.85], [0.8, 0.8, 0.8]];

fn mesh(path: &Path) -> Result<Mesh, Failure> {
    let fault = |text: String| Failure::Refused(format!("{}: {text}", path.display()));
    let bytes = std::fs::read(path).map_err(|e| fault(format!("cannot be read: {e}")))?;
    let ending = path.extension().and_then(|e| e.to_str()).unwrap_or("");
    read_mesh(&bytes, ending).map_err(|e| fault(e.to_string()))
}

fn mesh_view(mesh: &Mesh, color: [f32; 3]) -> MeshView<'_> {
    MeshView { positions: &mesh.positions, normals: &mesh.normals, triangles: &mesh.triangles, color }
}

/// A preset, or the transfer function in a file.
fn transfer(name: &str) -> Result<Transfer, Failure> {
    if let Some(preset) = Preset::from_name(name) {
        return Ok(preset.transfer());
    }
    let text = std::fs::read_to_string(name).map_err(|e| {
        let presets = Preset::ALL.map(Preset::name).join(", ");
        Failure::Refused(format!("{name} is no preset ({presets}) and cannot be read as a file: {e}"))
    })?;
    Transfer::from_text(&text).map_err(|e| Failure::Refused(format!("{name}: {e}")))
}

/// The camera of the options, over the scene's, over one in front of the patient.
fn camera(args: &Args, scene: Option<&Scene>, bricks: &BrickedVolume) -> Result<Camera, Failure> {
    let info = bricks.info();
    let mut camera = Camera::around(info);
    if let Some(r) = scene.map(|s| &s.rendering) {
        let view = r.view(&BoxMm::of(&info.grid));
        camera = Camera { eye: view.eye, target: view.target, up: view.up, fov_deg: view.fov_deg };
    }
    if let Some(fov) = args.fov {
        let given = Camera { fov_deg: fov, ..camera };
        if let Some(fault) = given.fault() {
            return Err(Failure::Usage(fault));
        }
        // no eye given: stand where the whole volume fits the new angle
        camera = if args.eye.is_none() && scene.is_none() { Camera::in_front(info, fov) } else { given };
    }
    if let Some(target) = args.target {
        if args.eye.is_none() {
            camera.eye = std::array::from_fn(|c| camera.eye[c] + target[c] - camera.target[c]);
        }
        camera.target = target;
    }
    camera.eye = args.eye.unwrap_or(camera.eye);
    match args.up {
        Some(up) => camera.up = up,
        // looking along the body: the patient's front is up
        None if camera.fault().is_some() => camera.up = [0.0, -1.0, 0.0],
        None => {}
    }
    match camera.fault() {
        Some(fault) => Err(Failure::Usage(fault)),
        None => Ok(camera),
    }
}

/// A probe whose face is at the eye and that looks at the target; the picture's right is the camera's.
fn fan(args: &Args, scene: Option<&Scene>, bricks: &BrickedVolume) -> Result<Ultrasound, Failure> {
    let camera = camera(args, scene, bricks)?;
    let [forward, right, _] = camera.frame().map(Into::into);
    let mut probe = Probe::convex(camera.eye, forward, right);
    probe.depth_mm = args.more.depth.unwrap_or(probe.depth_mm);
    probe.frequency_mhz = args.more.frequency.unwrap_or(probe.frequency_mhz);
    Ok(Ultrasound::new(probe))
}

fn section_settings(args: &Args, scene: Option<&Scene>, bricks: &BrickedVolume, plane: Plane, size: [usize; 2]) -> Section {
    let mut section = Section::whole(bricks.info(), plane, args.at, size[0], size[1]);
    if let Some([level, window]) = args.window.or(scene.map(|s| s.rendering.section_window_hu)) {
        (section.level, section.window) = (level, window);
    }
    section.slab_mm = args.more.slab.unwrap_or(0.0);
    section.slab_mode = match args.more.slab_mode {
        Slab::Mean => SlabMode::Mean,
        Slab::Max => SlabMode::Maximum,
    };
    section
}

/// Times of several runs [ms], sorted.
fn timed(frames: usize, mut frame: impl FnMut()) -> Vec<f64> {
    let mut times: Vec<f64> = (0..frames)
        .map(|_| {
            let start = Instant::now();
            frame();
            start.elapsed().as_secs_f64() * 1e3
        })
        .collect();
    times.sort_by(f64::total_cmp);
    times
}

fn write_png(path: &Path, picture: &Picture) -> Outcome {
    let write = || -> Result<(), png::EncodingError> {
        let mut encoder = png::Encoder::new(BufWriter::new(File::create(path)?), picture.width as u32, picture.height as u32);
        encoder.set_color(png::ColorType::Rgb);
        encoder.set_depth(png::BitDepth::Eight);
        let mut writer = encoder.write_header()?;
        writer.write_image_data(&picture.rgb)?;
        writer.finish()
    };
    write().map_err(|e| Failure::Refused(format!("cannot write {}: {e}", path.display())))
}

fn finite(text: &str) -> Result<f64, String> {
    match text.trim().parse::<f64>() {
        Ok(v) if v.is_finite() => Ok(v),
        _ => Err(format!("{text} is not a finite number")),
    }
}

fn positive(text: &str) -> Result<f64, String> {
    finite(text).ok().filter(|v| *v > 0.0).ok_or_else(|| format!("{text} is not a number above 0"))
}

fn list<const N: usize>(text: &str) -> Result<[f64; N], String> {
    let numbers: Vec<f64> = text.split(',').map(finite).collect::<Result<_, _>>()?;
    numbers.try_into().map_err(|v: Vec<f64>| format!("{} numbers, {N} are needed, separated by commas", v.len()))
}

fn triple(text: &str) -> Result<[f64; 3], String> {
    list(text)
}

fn pair(text: &str) -> Result<[f64; 2], String> {
    let [centre, width] = list(text)?;
    if width > 0.0 { Ok([centre, width]) } else { Err(format!("a width of {width} is not positive")) }
}

fn size(text: &str) -> Result<[usize; 2], String> {
    let fault = || format!("{text} is not a size like 800x600, each from 1 to 16384");
    let (w, h) = text.split_once(['x', 'X']).ok_or_else(fault)?;
    let [w, h] = [w, h].map(|n| n.parse::<usize>().ok().filter(|n| (1..=16_384).contains(n)));
    Ok([w.ok_or_else(fault)?, h.ok_or_else(fault)?])
}

fn step(text: &str) -> Result<Step, String> {
    let (number, voxels) = match (text.strip_suffix("mm"), text.strip_suffix("vox")) {
        (Some(n), _) => (n, false),
        (_, Some(n)) => (n, true),
        _ => (text, false),
    };
    let v = finite(number).ok().filter(|v| *v > 0.0).ok_or(format!("{text} is not a step like 0.5mm or 1vox, above 0"))?;
    Ok(if voxels { Step::Voxels(v) } else { Step::Millimetres(v) })
}
