//! From a scene file to a [`Scene`]: strict reading, ranges, files, effects; every fault on its line.
//!
//! The text is read twice by the same parser: once into the structs (which refuse unknown keys) and once into a tree that knows where
//! each value stands, so that the structs stay plain data and a fault found later still has its place.

use crate::{
    breathing::Signal,
    error::{Fault, SceneError, Source},
    limits::{LIMITS, range_text},
    mesh, organ, pairs, recording,
    registry::{self, CalledBy, KNOBS},
    scene::{EffectSetting, PhantomKind, Scene, Size},
    sections::{Mode, TouchedSurface},
    suggest,
    tool::{Approach, Device, PROFILES, PathPoint, Shape, ToolKind},
};
use serde::Deserialize;
use std::{
    fs,
    ops::Range,
    path::{Path, PathBuf},
};
use toml::{Spanned, de::DeTable};

/// Transfer functions known by name.
pub const TRANSFER_PRESETS: &[&str] = &["ct", "bone", "soft-tissue", "lung", "skin"];

const BUILTIN: &str = include_str!("../../../config/default.toml");

impl Scene {
    /// Reads a scene file; `file` names in it are looked up beside it, then in the working directory, and must exist.
    pub fn load(path: impl AsRef<Path>) -> Result<Self, SceneError> {
        Self::open(Some(path.as_ref()), None)
    }

    /// The scene that `maille run` shows when none is named.
    pub fn builtin_default() -> Self {
        Self::parse("default.toml", BUILTIN).expect("the built-in scene is read by a test")
    }

    /// A scene file, or the built-in scene, with the volume it is to be run on (`--volume`), ready to use: files found,
    /// way points of `path:FILE` read.
    pub fn open(path: Option<&Path>, volume: Option<&Path>) -> Result<Self, SceneError> {
        Self::open_with(path, volume, None)
    }

    /// The same with a motion model in place of the scene's own (`--motion`), which then need not be there.
    ///
    /// # Errors
    /// As for [`open`](Self::open), and when there is no such model, or the scene does not breathe.
    pub fn open_with(path: Option<&Path>, volume: Option<&Path>, motion: Option<&Path>) -> Result<Self, SceneError> {
        let (name, text, folder) = match path {
            None => ("the built-in scene".to_string(), BUILTIN.to_string(), PathBuf::new()),
            Some(path) => {
                let text = fs::read_to_string(path).map_err(|e| {
                    SceneError::sentence(
                        format!("cannot read the scene {}: {e}", path.display()),
                        (e.kind() == std::io::ErrorKind::InvalidData)
                            .then(|| "a scene is a TOML text file; a volume goes with --volume".into()),
                    )
                })?;
                (path.display().to_string(), text, path.parent().unwrap_or(Path::new("")).to_path_buf())
            }
        };
        let (mut scene, document) = read(&name, &text)?;
        if let Some(volume) = volume {
            if !volume.exists() {
                return Err(SceneError::sentence(format!("there is no volume {}", volume.display()), None));
            }
            scene.replace_volume(volume.to_path_buf());
        } else if let Some(file) = &scene.volume.file {
            scene.volume.file = Some(document.find_file("volume.file", file, &folder, "volume file")?);
        }
        if let Some(labels) = &scene.volume.labels {
            scene.volume.labels = Some(document.find_file("volume.labels", labels, &folder, "label map")?);
        }
        for (n, file) in scene.meshes.iter_mut().enumerate().filter_map(|(n, mesh)| Some((n, mesh.file.as_mut()?))) {
            *file = document.find_file(&format!("mesh.{n}.file"), file, &folder, "mesh")?;
        }
        let transfer = PathBuf::from(&scene.rendering.transfer);
        if !TRANSFER_PRESETS.contains(&scene.rendering.transfer.as_str()) {
            let found = document.find_file("rendering.transfer", &transfer, &folder, "transfer function")?;
            scene.rendering.transfer = found.display().to_string();
        }
        if let Some(model) = motion {
            scene.use_motion(model.to_path_buf())?;
        } else if let Some(model) = &scene.breathing.model {
            scene.breathing.model = Some(document.find_file("breathing.model", model, &folder, "motion model")?);
        }
        if let Signal::Recorded(file) = &scene.breathing.signal {
            scene.breathing.signal = Signal::Recorded(document.find_file("breathing.signal", file, &folder, "trace of breathing")?);
        }
        if let Some(library) = scene.device.library.as_ref().filter(|library| library.components().count() > 1) {
            // a name alone is looked for where the system has its libraries
            scene.device.library = Some(document.find_file("device.library", library, &folder, "library")?);
        }
        if let Some(Device::PathFile(file)) = scene.tool.as_ref().map(|t| &t.device) {
            let found = document.find_file("tool.device", file, &folder, "file of way points")?;
            scene.use_device(Device::PathFile(found))?;
        }
        Ok(scene)
    }

    /// Reads a scene from text, without looking at any file it names; `name` is for messages.
    pub fn parse(name: &str, text: &str) -> Result<Self, SceneError> {
        read(name, text).map(|(scene, _)| scene)
    }

    /// Puts another motion model in, as `--motion` does.
    ///
    /// # Errors
    /// When there is no such file, or the scene does not breathe.
    pub fn use_motion(&mut self, model: PathBuf) -> Result<(), SceneError> {
        if !model.exists() {
            return Err(SceneError::sentence(format!("there is no motion model {}", model.display()), None));
        }
        if !self.has_effect("breathing") {
            let help = Some("set `breathing = true` under [effects]".into());
            return Err(SceneError::sentence("this scene does not call for `breathing`: a motion model would move nothing", help));
        }
        self.breathing.model = Some(model);
        Ok(())
    }

    /// Has the tool's way and the forces kept in a file, as `--record` does.
    ///
    /// # Errors
    /// When the scene has no tool.
    pub fn use_recording(&mut self, file: &Path) -> Result<(), SceneError> {
        if self.tool.is_none() {
            return Err(SceneError::sentence("this scene has no [tool] whose way could be recorded", Some("add a [tool] table".into())));
        }
        let file = toml::Value::String(file.display().to_string());
        self.effects.insert("recording".into(), EffectSetting::Settings([("file".to_owned(), file)].into_iter().collect()));
        Ok(())
    }

    /// Chooses what moves the tool, as `--device` does; reads the way points of `path:FILE`, or of a recording, `path:FILE.csv`.
    pub fn use_device(&mut self, device: Device) -> Result<(), SceneError> {
        let Some(tool) = &mut self.tool else {
            return Err(SceneError::sentence("this scene has no [tool] for a device to move", Some("add a [tool] table".into())));
        };
        if let Device::PathFile(file) = device {
            #[derive(Deserialize)]
            #[serde(deny_unknown_fields)]
            struct PathFile {
                path: Vec<PathPoint>,
                #[serde(rename = "loop", default)]
                looped: bool,
                period_s: Option<f64>,
            }
            let text = fs::read_to_string(&file)
                .map_err(|e| SceneError::sentence(format!("cannot read the way points {}: {e}", file.display()), None))?;
            if file.extension().is_some_and(|e| e == "csv") {
                let moments = recording::read(&text)
                    .map_err(|(line, why)| SceneError::sentence(format!("{}:{line}: {why}", file.display()), None))?;
                if moments.is_empty() {
                    return Err(SceneError::sentence(format!("nothing was recorded in {}", file.display()), None));
                }
                (tool.path, tool.looped, tool.period_s, tool.device) = (recording::way(&moments), false, None, Device::Path);
                return Ok(());
            }
            let document = Document::new(&file.display().to_string(), &text)?;
            let read: PathFile = document.deserialise()?;
            let mut faults = Vec::new();
            check_path(&document, "path", &read.path, &mut faults);
            document.refuse(faults)?;
            (tool.path, tool.looped, tool.period_s, tool.device) = (read.path, read.looped, read.period_s, Device::Path);
        } else {
            tool.device = device;
        }
        Ok(())
    }
}

fn read(name: &str, text: &str) -> Result<(Scene, Document), SceneError> {
    let document = Document::new(name, text)?;
    let mut scene: Scene = document.deserialise()?;
    let accuracy = scene.accuracy.index();
    for knob in KNOBS.iter().filter(|k| document.span(k.name).is_none()) {
        (knob.set)(&mut scene, knob.defaults[accuracy]);
    }
    // a floor that nobody wrote lies below the rate that somebody did
    let (d, r) = (&mut scene.deformation, &mut scene.rendering);
    for (path, floor, rate) in [("deformation.floor_hz", &mut d.floor_hz, d.rate_hz), ("rendering.floor_hz", &mut r.floor_hz, r.rate_hz)] {
        if document.span(path).is_none() {
            *floor = floor.min(rate);
        }
    }
    let mut faults = Vec::new();
    check_numbers(&document, &scene, &mut faults);
    check_tool(&document, &scene, &mut faults);
    check_tissues(&document, &scene, &mut faults);
    for (path, message, label, help) in pairs::faults(&scene, document.span("breathing").is_some()) {
        faults.push(document.fault(&path, message, label, Some(help)));
    }
    check_effects(&document, &scene, &mut faults);
    let is_volume = scene.rendering.mode == Mode::Volume;
    for (path, message) in organ::faults(&scene.organs, scene.rendering.alone.as_deref(), is_volume) {
        faults.push(document.fault(&path, message, "here", None));
    }
    for (path, message) in mesh::faults(&scene.meshes, &scene.organs) {
        faults.push(document.fault(&path, message, "here", None));
    }
    document.refuse(faults)?;
    Ok((scene, document))
}

/// A scene's text and where each of its values stands.
struct Document {
    source: Source,
    /// (path, key or value) → bytes, in file order; `tool.path.2.mm` is the third way point's
    spans: Vec<(String, Range<usize>)>,
}

impl Document {
    fn new(name: &str, text: &str) -> Result<Self, SceneError> {
        let source = Source { name: name.into(), text: text.into() };
        let tree = DeTable::parse(text).map_err(|e| source.error(vec![of_toml(&e)]))?;
        let mut spans = Vec::new();
        collect(&mut spans, "", tree.get_ref());
        Ok(Self { source, spans })
    }

    fn deserialise<T: for<'a> Deserialize<'a>>(&self) -> Result<T, SceneError> {
        toml::from_str(&self.source.text).map_err(|e| self.source.error(vec![of_toml(&e)]))
    }

    fn span(&self, path: &str) -> Option<Range<usize>> {
        self.spans.iter().find(|(p, _)| p == path).map(|(_, span)| span.clone())
    }

    /// A fault at a path, or at the nearest thing above it that stands in the file.
    fn fault(&self, path: &str, message: impl Into<String>, label: impl Into<String>, help: Option<String>) -> Fault {
        let mut at = path;
        let mut span = self.span(at);
        while let (None, Some((above, _))) = (&span, at.rsplit_once('.')) {
            at = above;
            span = self.span(at);
        }
        Fault { message: message.into(), span, label: label.into(), help }
    }

    fn refuse(&self, faults: Vec<Fault>) -> Result<(), SceneError> {
        if faults.is_empty() { Ok(()) } else { Err(self.source.error(faults)) }
    }

    fn find_file(&self, key: &str, file: &Path, folder: &Path, what: &str) -> Result<PathBuf, SceneError> {
        let beside = folder.join(file);
        if beside.exists() {
            return Ok(beside);
        }
        if file.exists() {
            return Ok(file.to_path_buf());
        }
        let mut help = format!("looked for {}", beside.display());
        if beside != file {
            help += &format!(" and {}", file.display());
        }
        let neighbours: Vec<String> = fs::read_dir(beside.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new(".")))
            .map(|entries| entries.flatten().filter_map(|e| e.file_name().into_string().ok()).collect())
            .unwrap_or_default();
        let mut names: Vec<&str> = neighbours.iter().map(String::as_str).collect();
        if key == "rendering.transfer" {
            names.extend(TRANSFER_PRESETS);
            help += &format!("; presets are {}", TRANSFER_PRESETS.join(", "));
        }
        if let Some(near) = file.file_name().and_then(|f| f.to_str()).and_then(|f| suggest::nearest(f, &names)) {
            help += &format!("; did you mean `{near}`?");
        }
        let fault = self.fault(key, format!("there is no {what} {}", file.display()), "no such file", Some(help));
        Err(self.source.error(vec![fault]))
    }
}

fn collect(spans: &mut Vec<(String, Range<usize>)>, above: &str, table: &DeTable<'_>) {
    for (key, value) in table.iter() {
        let path = if above.is_empty() { key.get_ref().to_string() } else { format!("{above}.{}", key.get_ref()) };
        collect_value(spans, path, value);
    }
}

fn collect_value(spans: &mut Vec<(String, Range<usize>)>, path: String, value: &Spanned<toml::de::DeValue<'_>>) {
    spans.push((path.clone(), value.span()));
    if let Some(table) = value.get_ref().as_table() {
        collect(spans, &path, table);
    } else if let Some(array) = value.get_ref().as_array() {
        for (n, item) in array.iter().enumerate() {
            collect_value(spans, format!("{path}.{n}"), item);
        }
    }
}

/// The parser's own fault, in our words: an unknown key or word gets a suggestion instead of a list.
fn of_toml(e: &toml::de::Error) -> Fault {
    let (message, span) = (e.message(), e.span());
    let quoted: Vec<&str> = message.split('`').skip(1).step_by(2).collect();
    for (start, what, label) in
        [("unknown field", "key", "no such key here"), ("unknown variant", "word", "not one of the words allowed here")]
    {
        if message.starts_with(start)
            && let Some((word, candidates)) = quoted.split_first()
        {
            let help = format!("allowed here: {}", candidates.join(", "));
            return Fault { message: suggest::unknown(what, word, candidates), span, label: label.into(), help: Some(help) };
        }
    }
    let message = message.trim().replace('\n', "; ");
    Fault { label: if message.len() < 60 { message.clone() } else { "here".into() }, message, span, help: None }
}

/// NaN is in no range.
fn out_of(value: f64, low: f64, high: f64) -> bool {
    !(low..=high).contains(&value)
}

fn check_range(document: &Document, path: &str, value: f64, [low, high]: [f64; 2], unit: &str, faults: &mut Vec<Fault>) {
    if out_of(value, low, high) {
        let range = range_text(low, high, unit);
        let key = path.rsplit('.').find(|part| part.parse::<usize>().is_err()).unwrap_or(path);
        let help = Some(format!("use a number from {range}"));
        faults.push(document.fault(path, format!("{key} = {value} is out of range"), format!("allowed: {range}"), help));
    }
}

fn check_numbers(document: &Document, scene: &Scene, faults: &mut Vec<Fault>) {
    for limit in LIMITS {
        if let Some(value) = (limit.get)(scene) {
            check_range(document, limit.path, value, [limit.low, limit.high], limit.unit, faults);
        }
    }
    let r = &scene.rendering;
    for (path, size) in [("rendering.size", r.size), ("rendering.section_size", r.section_size)] {
        size.iter().for_each(|&n| check_range(document, path, n as f64, [16.0, 4096.0], "pixels", faults));
    }
    match scene.volume.size {
        Size::Cube(n) => check_range(document, "volume.size", n as f64, [16.0, 2048.0], "voxels", faults),
        Size::Box(size) => {
            (0..3).for_each(|c| check_range(document, &format!("volume.size.{c}"), size[c] as f64, [16.0, 2048.0], "voxels", faults))
        }
    }
    check_range(document, "rendering.section_window_hu.1", r.section_window_hu[1], [1.0, 65536.0], "HU", faults);
    for (path, v) in [("rendering.eye", r.eye), ("rendering.target", r.target), ("rendering.look_at", Some(r.look_at))] {
        check_finite(document, path, v, faults);
    }
    for (path, v) in [("rendering.up", r.up), ("rendering.from", r.from)] {
        check_direction(document, path, Some(v), faults);
    }
    if scene.deformation.bone_hu <= scene.deformation.threshold_hu {
        let help = Some("tissue begins at threshold_hu and ends where bone begins: bone_hu must be the larger".into());
        let message = format!("bone_hu = {} is not above threshold_hu = {}", scene.deformation.bone_hu, scene.deformation.threshold_hu);
        faults.push(document.fault("deformation.bone_hu", message, "below the threshold", help));
    }
    let (d, r) = (&scene.deformation, &scene.rendering);
    for (path, floor, rate) in [("deformation.floor_hz", d.floor_hz, d.rate_hz), ("rendering.floor_hz", r.floor_hz, r.rate_hz)] {
        if floor > rate {
            let help = Some("the floor is the rate below which accuracy is given up: use a number up to rate_hz".into());
            faults.push(document.fault(path, format!("floor_hz = {floor} is above rate_hz = {rate}"), "above the rate", help));
        }
    }
    if let Some(profile) = scene.device.profile.as_ref().filter(|p| !PROFILES.iter().any(|known| known.eq_ignore_ascii_case(p))) {
        let help = Some(format!("profiles are {}", PROFILES.join(", ")));
        faults.push(document.fault("device.profile", suggest::unknown("profile", profile, PROFILES), "no such profile", help));
    }
    if let Some(reason) = scene.device.address.as_deref().and_then(no_address) {
        let help = Some("write the host and the port of the Haply Inverse Service, as `127.0.0.1:10001` or `[::1]:10001`".into());
        faults.push(document.fault("device.address", format!("device.address is no address: {reason}"), "no address", help));
    }
    let no_name = |text: &str| text.trim().is_empty() || text.contains('\0');
    if scene.device.id.as_deref().is_some_and(no_name) {
        let help = Some("write the name that the device was configured with, or leave `id` out for the first there is".into());
        faults.push(document.fault("device.id", "device.id is no name of a device", "no name", help));
    }
    if scene.device.library.as_deref().and_then(Path::to_str).is_some_and(no_name) {
        let help = Some("write the path of the vendor's shared object, or leave `library` out to have the system find it".into());
        faults.push(document.fault("device.library", "device.library is no file name", "no file name", help));
    }
    if let Some(r) = scene.device.rotation {
        let dot = |a: usize, b: usize| (0..3).map(|c| r[a][c] * r[b][c]).sum::<f64>();
        let orthonormal = |a: usize, b: usize| (dot(a, b) - f64::from(u8::from(a == b))).abs() <= 1e-3;
        if !(0..9).all(|n| orthonormal(n / 3, n % 3)) {
            let help =
                Some("its rows are the patient's axes seen by the device: three unit vectors, each at a right angle to the others".into());
            faults.push(document.fault("device.rotation", "device.rotation is no rotation", "rows are not orthonormal", help));
        } else if (0..3).map(|c| r[0][c] * (r[1][(c + 1) % 3] * r[2][(c + 2) % 3] - r[1][(c + 2) % 3] * r[2][(c + 1) % 3])).sum::<f64>()
            < 0.0
        {
            let help = Some(
                "turn the sign of one row: a mirrored hand would push where it wants to pull, and its turns would go the wrong way".into(),
            );
            let message = "device.rotation is a reflection (its determinant is −1), no rotation";
            faults.push(document.fault("device.rotation", message, "mirrors the device", help));
        }
    }
    check_finite(document, "device.origin_mm", scene.device.origin_mm, faults);
    let smooth = scene.has_effect("smooth-surface");
    if scene.haptic.surface.is_some_and(|surface| surface != TouchedSurface::Interpolated) && !smooth {
        let help = Some("set `smooth-surface = true` under [effects], or leave `surface` out".into());
        faults.push(document.fault("haptic.surface", "a smooth surface needs the effect `smooth-surface`", "needs an effect", help));
    }
    if smooth && scene.tool.as_ref().is_some_and(|tool| tool.shape != Shape::Tip || tool.kind == ToolKind::Needle) {
        let help = Some("use `shape = \"tip\"` and no needle, or take `smooth-surface` out".into());
        faults.push(document.fault("effects.smooth-surface", "a smooth surface is felt with one ball only", "of no use here", help));
    }
    if scene.has_effect("octree") && scene.haptic.surface == Some(TouchedSurface::Interpolated) {
        let help = Some("leave `surface` out, or `octree`".into());
        faults.push(document.fault(
            "effects.octree",
            "nobody looks at an octree where the interpolated voxels are felt",
            "of no use here",
            help,
        ));
    }
    scene.incision.voxels.iter().enumerate().for_each(|(c, &n)| {
        check_range(document, &format!("incision.voxels.{c}"), n as f64, [1.0, 64.0], "voxels", faults);
    });
    check_needle(document, scene, faults);
    if scene.has_effect("needle-drag") && scene.has_effect("relaxation") {
        let help = Some("leave `relaxation` out: tissue that a needle drags goes where the needle lets it go".into());
        faults.push(document.fault("effects.relaxation", "`needle-drag` and `relaxation` both move the same tissue", "one too many", help));
    }
    if scene.volume.labels.is_some() && scene.volume.file.is_none() {
        let help = Some("leave it out: a made patient brings its own labels".into());
        faults.push(document.fault("volume.labels", "labels are named for a patient that comes from no file", "no file", help));
    }
    if scene.deformation.sampling_order == 2 {
        let help = Some("use 1 (trilinear) or 3 (tricubic)".into());
        faults.push(document.fault("deformation.sampling_order", "there is no interpolation of order 2", "1 or 3", help));
    }
    if ![16, 32].contains(&scene.breathing.precision_bits) {
        let help = Some("use 16 (steps of one size) or 32 (single precision)".into());
        faults.push(document.fault("breathing.precision_bits", "vectors are kept in 16 or 32 bits", "16 or 32", help));
    }
    let made_torso = scene.volume.file.is_none() && scene.volume.phantom == Some(PhantomKind::Torso);
    if scene.has_effect("breathing") && scene.breathing.model.is_none() && !made_torso {
        let help = Some("give [breathing] model = \"FILE\" (`maille motion fit` writes one), or the volume phantom = \"torso\"".into());
        faults.push(document.fault("effects.breathing", "nothing says how this patient breathes", "needs a model", help));
    }
    if scene.volume.file.is_some() && scene.volume.phantom.is_some() {
        let help = Some("keep `file` for a patient of your own, or `phantom` for a made one".into());
        faults.push(document.fault("volume.phantom", "[volume] names both a file and a phantom", "one of them too many", help));
    }
    if scene.memory.spare_mib.is_some() && scene.memory.spare_slots.is_some() {
        let help = Some("keep one of `spare_mib` and `spare_slots`".into());
        faults.push(document.fault("memory.spare_slots", "[memory] gives the spare slots twice", "one of them too many", help));
    }
}

/// Why a text is not the host and port of a service; none where it may be one. Whether that host exists shows when it is called.
fn no_address(text: &str) -> Option<String> {
    if text.contains("://") {
        return Some("it has a scheme; the host and port alone are wanted".into());
    }
    let Some((host, port)) = text.rsplit_once(':') else { return Some("it has no port".into()) };
    // colons stand in an IPv6 address, which has brackets
    let (bare, bracketed) = match host.strip_prefix('[').and_then(|h| h.strip_suffix(']')) {
        Some(bare) => (bare, true),
        None => (host, false),
    };
    let known = if bracketed {
        bare.parse::<std::net::Ipv6Addr>().is_ok()
    } else {
        !bare.is_empty() && bare.len() <= 253 && bare.chars().all(|c| c.is_ascii_alphanumeric() || "-._".contains(c))
    };
    if !known {
        return Some(format!("`{host}` is no host"));
    }
    match port.parse::<u16>() {
        Ok(1..) => None,
        _ => Some(format!("`{port}` is no port")),
    }
}

fn check_finite(document: &Document, path: &str, v: Option<[f64; 3]>, faults: &mut Vec<Fault>) {
    if v.is_some_and(|v| !v.iter().all(|x| x.is_finite() && x.abs() < 1e6)) {
        faults.push(document.fault(path, format!("{path} is not a point"), "three finite numbers are wanted", None));
    }
}

fn check_direction(document: &Document, path: &str, v: Option<[f64; 3]>, faults: &mut Vec<Fault>) {
    if v.is_some_and(|v| !v.iter().all(|x| x.is_finite()) || v.iter().map(|x| x * x).sum::<f64>() < 1e-12) {
        let help = Some("use three finite numbers that are not all zero".into());
        faults.push(document.fault(path, format!("{path} is no direction"), "zero or not finite", help));
    }
}

fn check_tool(document: &Document, scene: &Scene, faults: &mut Vec<Fault>) {
    let Some(tool) = &scene.tool else { return };
    check_path(document, "tool.path", &tool.path, faults);
    for (key, approach) in [("approach", &tool.approach), ("elsewhere", &tool.elsewhere)] {
        if let Some(approach) = approach {
            check_approach(document, &format!("tool.{key}"), approach, faults);
        }
    }
    if tool.path.is_empty() && tool.approach.is_none() {
        let help = Some("add [[tool.path]] way points, or a [tool.approach] that finds the surface itself".into());
        faults.push(document.fault("tool", "[tool] has no way to go", "neither way points nor an approach", help));
    }
}

fn check_approach(document: &Document, key: &str, a: &Approach, faults: &mut Vec<Fault>) {
    for (field, value, range, unit) in [
        ("press_mm", a.press_mm, [0.1, 50.0], "mm"),
        ("hover_mm", a.hover_mm, [0.0, 100.0], "mm"),
        ("period_s", a.period_s, [0.2, 600.0], "s"),
        ("lateral_mm", a.lateral_mm, [0.0, 50.0], "mm"),
    ] {
        check_range(document, &format!("{key}.{field}"), value, range, unit, faults);
    }
    for (field, at) in [("from", &a.from), ("toward", &a.toward)] {
        (0..3).for_each(|c| check_range(document, &format!("{key}.{field}.{c}"), at[c], [-0.5, 1.5], "of the box", faults));
    }
    if a.from == a.toward {
        faults.push(document.fault(&format!("{key}.toward"), "the approach ends where it starts", "the same point as `from`", None));
    }
}

fn check_path(document: &Document, key: &str, path: &[PathPoint], faults: &mut Vec<Fault>) {
    let mut before = f64::NEG_INFINITY;
    for (n, point) in path.iter().enumerate() {
        let at = |field: &str| format!("{key}.{n}.{field}");
        check_range(document, &at("time_s"), point.time_s, [0.0, 86400.0], "s", faults);
        if point.time_s <= before {
            let message = format!("way point {} is at {} s, not after the one before it ({before} s)", n + 1, point.time_s);
            faults.push(document.fault(&at("time_s"), message, "times must increase", None));
        }
        before = point.time_s;
        if point.mm.is_some() == point.fraction.is_some() {
            let message = format!("way point {} needs exactly one of `mm` and `fraction`", n + 1);
            let help = "`mm` is a patient position (LPS), `fraction` a place in the volume's box";
            faults.push(document.fault(&format!("{key}.{n}"), message, "no place, or two", Some(help.into())));
        }
        check_finite(document, &at("mm"), point.mm, faults);
        if let Some(f) = point.fraction {
            (0..3).for_each(|c| check_range(document, &format!("{key}.{n}.fraction.{c}"), f[c], [-0.5, 1.5], "of the box", faults));
        }
        check_direction(document, &at("direction"), point.direction, faults);
    }
}

fn check_needle(document: &Document, scene: &Scene, faults: &mut Vec<Fault>) {
    check_finite(document, "needle.target_mm", scene.needle.target_mm, faults);
    for (n, row) in scene.needle.tissue.iter().enumerate() {
        let at = |field: &str| format!("needle.tissue.{n}.{field}");
        if row.hu.is_some_and(|[low, high]| !(low.is_finite() && high.is_finite() && low < high)) {
            faults.push(document.fault(&at("hu"), format!("tissue `{}` has no range", row.name), "low must be below high", None));
        }
        if row.labels.is_empty() && row.hu.is_none() {
            let help = Some("add `labels = [...]`, `hu = [low, high]`, or take the row out".into());
            faults.push(document.fault(
                &format!("needle.tissue.{n}"),
                format!("tissue `{}` is nowhere", row.name),
                "neither labels nor hu",
                help,
            ));
        }
        if row.labels.contains(&0) {
            let help = Some("0 is no tissue: what no row fits is as nothing".into());
            faults.push(document.fault(&at("labels"), "label 0 is air", "no tissue", help));
        }
        for (field, value, range, unit) in [
            ("stiffness_n_per_mm", Some(row.stiffness_n_per_mm), [1e-3, 1e3], "N/mm"),
            ("a1_n_per_mm", Some(row.a1_n_per_mm), [1e-3, 1e3], "N/mm"),
            ("a2_n_per_mm2", Some(row.a2_n_per_mm2), [0.0, 1e3], "N/mm²"),
            ("cutting_force_n", Some(row.cutting_force_n).filter(|force| *force != f64::INFINITY), [1e-3, 1e3], "N"),
            ("friction_n", Some(row.friction_n), [0.0, 1e3], "N"),
            ("capsule_n", row.capsule_n, [1e-3, 1e3], "N"),
            ("capsule_mm", Some(row.capsule_mm), [0.0, 100.0], "mm"),
            ("relaxing", Some(row.relaxing), [0.0, 0.95], ""),
            ("relaxation_s", Some(row.relaxation_s), [1e-3, 1e3], "s"),
        ] {
            if let Some(value) = value {
                check_range(document, &at(field), value, range, unit, faults);
            }
        }
    }
    if !(1..=30).contains(&scene.needle.tissue.len()) {
        faults.push(document.fault("needle.tissue", "a needle meets 1 to 30 tissues", "none, or too many", None));
    }
}

fn check_tissues(document: &Document, scene: &Scene, faults: &mut Vec<Fault>) {
    let mut top = f64::NEG_INFINITY;
    for (n, row) in scene.tissues.iter().enumerate() {
        let at = |field: &str| format!("tissue.{n}.{field}");
        let name = &row.name;
        if !row.hu.iter().all(|v| v.is_finite()) || row.hu[0] >= row.hu[1] {
            faults.push(document.fault(&at("hu"), format!("tissue `{name}` has no range"), "low must be below high", None));
        } else if row.hu[0] < top {
            let message = format!("tissue `{name}` begins at {} HU, inside the row before it (up to {top})", row.hu[0]);
            faults.push(document.fault(&at("hu"), message, "rows must ascend and not overlap", None));
        }
        top = row.hu[1];
        check_range(document, &at("stiffness_n_per_mm"), row.stiffness_n_per_mm, [0.0, 50.0], "N/mm", faults);
        check_range(document, &at("stiffening_n_per_mm2"), row.stiffening_n_per_mm2, [0.0, 50.0], "N/mm²", faults);
        check_range(document, &at("damping_n_s_per_mm"), row.damping_n_s_per_mm, [0.0, 1.0], "N·s/mm", faults);
        check_range(document, &at("plastic"), row.plastic, [0.0, 1.0], "", faults);
        check_range(document, &at("friction_kinetic"), row.friction_kinetic, [0.0, 2.0], "", faults);
        check_range(document, &at("friction_static"), row.friction_static, [row.friction_kinetic, 2.0], "", faults);
    }
}

fn check_effects(document: &Document, scene: &Scene, faults: &mut Vec<Fault>) {
    let names: Vec<&str> = registry::effects().filter(|e| e.called_by == CalledBy::Effects).map(|e| e.name).collect();
    for (name, setting) in &scene.effects {
        let path = format!("effects.{name}");
        let Some(effect) = registry::effects().find(|e| e.name == *name && e.called_by == CalledBy::Effects) else {
            let help = Some(format!("effects are {}", names.join(", ")));
            faults.push(document.fault(&path, suggest::unknown("effect", name, &names), "no such effect", help));
            continue;
        };
        if let EffectSetting::Settings(table) = setting {
            let allowed: Vec<&str> = ["enabled"].iter().chain(effect.settings).copied().collect();
            for key in table.keys().filter(|k| !allowed.contains(&k.as_str())) {
                faults.push(document.fault(&format!("{path}.{key}"), suggest::unknown("key", key, &allowed), "no such key here", None));
            }
            if table.get("enabled").is_some_and(|v| v.as_bool().is_none()) {
                faults.push(document.fault(&format!("{path}.enabled"), "`enabled` is true or false", "neither", None));
            }
        }
        if let EffectSetting::Settings(table) = setting
            && table.get("file").is_some_and(|v| v.as_str().is_none_or(str::is_empty))
        {
            faults.push(document.fault(&format!("{path}.file"), "`file` is the name of a file", "no name", None));
        }
        if !setting.is_on() {
            continue;
        }
        for needed in effect.depends_on.iter().filter(|n| !scene.has_effect(n)) {
            let help = match registry::effect(needed).map(|e| e.called_by) {
                Some(CalledBy::Section(section)) => format!("add a [{section}] table, or set `{name} = false`"),
                _ => format!("set `{needed} = true`, or `{name} = false`"),
            };
            faults.push(document.fault(&path, format!("the effect `{name}` needs `{needed}`"), "cannot stand alone", Some(help)));
        }
    }
}
