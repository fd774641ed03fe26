//! A made run: a head of three ellipsoids, a tool that presses into its side, four services. Nothing but arithmetic; used by
//! the server's tests and by `examples/mock.rs`.

use maille_breathing::Signal;
use maille_console::feed::{Facts, Feed, ServiceStatus, default_view};
use maille_contract::{
    BreathState, Commit, FrameHeader, Stamp, ToolCommand, ToolState, ViewState,
    messages::{TOOL_IN_CONTACT, TOOL_TAKEN_OVER, ViewRect},
};
use std::{
    sync::{
        Arc, Mutex,
        atomic::{AtomicBool, AtomicU64, Ordering::Relaxed},
    },
    time::Instant,
};

const LOW: [f64; 3] = [-90.0, -110.0, -20.0];
const HIGH: [f64; 3] = [90.0, 110.0, 220.0];
const CENTER: [f64; 3] = [0.0, 0.0, 100.0];
const FRAME_NS: u64 = 33_000_000;
const STATE_NS: u64 = 5_000_000;
const TIP_RADIUS: f64 = 4.0;

/// What a test may look at and change while the console runs.
#[derive(Default)]
pub struct Shared {
    /// the last view that was sent
    pub view: Mutex<Option<ViewState>>,
    /// all commands that were sent
    pub commands: Mutex<Vec<ToolCommand>>,
    /// all commands to the breath that were sent
    pub breaths: Mutex<Vec<BreathState>>,
    /// frames taken
    pub frames: AtomicU64,
    /// requests refused, as last told
    pub refused: AtomicU64,
    /// rendering makes no frames and beats no more
    pub rendering_dead: AtomicBool,
    /// ends the console
    pub end: AtomicBool,
}

/// The made run.
pub struct Mock {
    shared: Arc<Shared>,
    facts: Facts,
    signal: Signal,
    start: Instant,
    size: [u32; 4],
    next_frame_ns: u64,
    next_state_ns: u64,
    sequence: u64,
    view: ViewState,
    held: Option<[f64; 3]>,
    /// the deepest dent so far: centre of a hollow sphere
    dent: Option<[f64; 3]>,
}

impl Mock {
    /// A run whose 3D view is `width` pixels wide and whose sections are half as wide.
    pub fn new(shared: Arc<Shared>, width: u32) -> Self {
        let facts = Facts {
            scene: "mock head".into(),
            description: "ellipsoids, for looking at the page".into(),
            domain: "maille_mock".into(),
            low_mm: LOW,
            high_mm: HIGH,
            size: [181, 221, 241],
            spacing_mm: [1.0; 3],
            max_force_n: 3.3,
            endoscope_fov_deg: 90.0,
            transfer: "ct".into(),
            transfer_points: Vec::new(),
            panels: vec!["3d", "axial", "coronal", "sagittal", "force", "threshold", "incision", "breathing"],
            has_tool: true,
            incises: true,
            organs: vec!["skull".into(), "brain".into()],
            breathing: Some("synthetic".into()),
        };
        let mut view = default_view(LOW, HIGH);
        view.eye_mm = [260.0, -600.0, 220.0];
        Self {
            shared,
            facts,
            signal: Signal::new(&Default::default(), None).unwrap(),
            start: Instant::now(),
            size: [width, width * 3 / 4, width / 2, width * 3 / 8],
            next_frame_ns: 0,
            next_state_ns: 0,
            sequence: 0,
            view,
            held: None,
            dent: None,
        }
    }

    fn tip(&self) -> [f64; 3] {
        if let Some(held) = self.held {
            return held;
        }
        let s = self.start.elapsed().as_secs_f64();
        [25.0 * (0.4 * s).sin() - 30.0, -108.0 + 20.0 * (0.8 * s).sin(), 95.0 + 12.0 * (0.5 * s).cos()]
    }

    /// HU at a position: skin, skull, brain, air outside and in the dent.
    fn hu(&self, p: [f64; 3]) -> f64 {
        let r = radius(p);
        let dented = self.dent.is_some_and(|d| distance(p, d) < 14.0);
        match r {
            r if r > 1.0 || (dented && r > 0.93) => -1000.0,
            r if r > 0.93 => 20.0,
            r if r > 0.86 => 900.0 + 200.0 * (0.7 * p[2]).sin(),
            _ => 35.0 + 12.0 * (0.2 * p[0]).sin() * (0.2 * p[1]).cos() * (0.2 * p[2]).sin(),
        }
    }

    fn draw_section(&self, axes: [[f64; 3]; 2], normal: usize, out: &mut [u8], [width, height]: [u32; 2]) {
        let extent = |d: [f64; 3]| (0..3).map(|c| (d[c] * (HIGH[c] - LOW[c])).abs()).sum::<f64>();
        let mm = (extent(axes[0]) / f64::from(width - 1)).max(extent(axes[1]) / f64::from(height - 1));
        let at = if self.view.sections_follow_tool != 0 { self.tip() } else { self.view.sections_mm };
        for (n, pixel) in out.chunks_exact_mut(3).enumerate() {
            let u = (f64::from(n as u32 % width) - f64::from(width - 1) / 2.0) * mm;
            let v = (f64::from(n as u32 / width) - f64::from(height - 1) / 2.0) * mm;
            let mut p: [f64; 3] = std::array::from_fn(|c| CENTER[c] + u * axes[0][c] + v * axes[1][c]);
            p[normal] = at[normal];
            let inside = (0..3).all(|c| p[c] >= LOW[c] && p[c] <= HIGH[c]);
            let grey = (self.hu(p) - self.view.window_center_hu) / self.view.window_width_hu + 0.5;
            pixel.fill(if inside { (grey * 255.0).clamp(0.0, 255.0) as u8 } else { 0 });
        }
    }

    fn draw_3d(&self, out: &mut [u8], [width, height]: [u32; 2]) {
        let v = &self.view;
        let forward = unit(std::array::from_fn(|c| v.target_mm[c] - v.eye_mm[c]));
        let right = unit(cross(forward, v.up));
        let up = cross(right, forward);
        let focal = f64::from(height) / 2.0 / (v.fov_deg.to_radians() / 2.0).tan();
        // what begins at the threshold: all, then bone only
        let shell = if v.threshold_hu < 20.0 { 1.0 } else { 0.93 };
        let colour = if v.threshold_hu < 20.0 { [235.0, 190.0, 165.0] } else { [245.0, 240.0, 225.0] };
        for (n, pixel) in out.chunks_exact_mut(3).enumerate() {
            let x = f64::from(n as u32 % width) - f64::from(width - 1) / 2.0;
            let y = f64::from(n as u32 / width) - f64::from(height - 1) / 2.0;
            let ray = unit(std::array::from_fn(|c| forward[c] * focal + right[c] * x - up[c] * y));
            let Some(p) = hit(v.eye_mm, ray, shell) else {
                pixel.copy_from_slice(&[8, 10, 12]);
                continue;
            };
            let mut normal = unit(std::array::from_fn(|c| (p[c] - CENTER[c]) / AXES[c].powi(2)));
            if let Some(d) = self.dent.filter(|&d| distance(p, d) < 14.0) {
                normal = unit(std::array::from_fn(|c| normal[c] + 0.12 * (d[c] - p[c])));
            }
            let light = (0.15 + 0.85 * (-dot(normal, ray)).max(0.0)) * (1.0 - 0.06 * (0.25 * p[2]).sin());
            for (byte, tint) in pixel.iter_mut().zip(colour) {
                *byte = (light * tint).clamp(0.0, 255.0) as u8;
            }
        }
    }
}

const AXES: [f64; 3] = [72.0, 95.0, 108.0];

fn radius(p: [f64; 3]) -> f64 {
    (0..3).map(|c| ((p[c] - CENTER[c]) / AXES[c]).powi(2)).sum::<f64>().sqrt()
}

/// Where a ray meets the ellipsoid of a relative size.
fn hit(eye: [f64; 3], ray: [f64; 3], size: f64) -> Option<[f64; 3]> {
    let o: [f64; 3] = std::array::from_fn(|c| (eye[c] - CENTER[c]) / (AXES[c] * size));
    let d: [f64; 3] = std::array::from_fn(|c| ray[c] / (AXES[c] * size));
    let (a, b, c) = (dot(d, d), dot(o, d), dot(o, o) - 1.0);
    let root = b * b - a * c;
    let t = (-b - root.max(0.0).sqrt()) / a;
    (root >= 0.0 && t > 0.0).then(|| std::array::from_fn(|c| eye[c] + t * ray[c]))
}

fn dot(a: [f64; 3], b: [f64; 3]) -> f64 {
    (0..3).map(|c| a[c] * b[c]).sum()
}

fn distance(a: [f64; 3], b: [f64; 3]) -> f64 {
    (0..3).map(|c| (a[c] - b[c]).powi(2)).sum::<f64>().sqrt()
}

fn unit(a: [f64; 3]) -> [f64; 3] {
    let n = dot(a, a).sqrt();
    a.map(|v| v / n)
}

fn cross(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

impl Feed for Mock {
    fn facts(&self) -> &Facts {
        &self.facts
    }

    fn first_view(&self) -> ViewState {
        self.view
    }

    fn incarnation(&self) -> u64 {
        1
    }

    fn now_ns(&self) -> u64 {
        self.start.elapsed().as_nanos() as u64
    }

    fn time_ns(&self) -> u64 {
        self.now_ns()
    }

    fn frame(&mut self, show: &mut dyn FnMut(&FrameHeader, &[u8])) -> bool {
        let now = self.now_ns();
        if now < self.next_frame_ns || self.shared.rendering_dead.load(Relaxed) {
            return false;
        }
        self.next_frame_ns = now + FRAME_NS;
        let [w, h, sw, sh] = self.size;
        let (big, small) = ((w * h * 3) as usize, (sw * sh * 3) as usize);
        let mut payload = vec![0; big + 3 * small];
        let (three, sections) = payload.split_at_mut(big);
        self.draw_3d(three, [w, h]);
        let planes =
            [([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], 2), ([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0]], 1), ([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0]], 0)];
        for ((axes, normal), out) in planes.into_iter().zip(sections.chunks_exact_mut(small)) {
            self.draw_section(axes, normal, out, [sw, sh]);
        }
        let rect = |n: usize| ViewRect { offset: (big + n * small) as u64, width: sw, height: sh };
        let frames = self.shared.frames.fetch_add(1, Relaxed);
        let header = FrameHeader {
            stamp: Stamp { time_ns: now, sequence: frames, incarnation: 1 },
            epoch: now / 100_000_000,
            view_sequence: self.view.stamp.sequence,
            render_ns: self.now_ns() - now,
            shown_ns: now,
            views: [ViewRect { offset: 0, width: w, height: h }, rect(0), rect(1), rect(2), ViewRect::default(), ViewRect::default()],
        };
        show(&header, &payload);
        true
    }

    fn tool_state(&mut self) -> Option<ToolState> {
        let now = self.now_ns();
        if now < self.next_state_ns {
            return None;
        }
        self.next_state_ns = (self.next_state_ns + STATE_NS).max(now.saturating_sub(10 * STATE_NS));
        self.sequence += 1;
        let tip = self.tip();
        let direction = unit([0.3, 0.9, 0.05]);
        let depth = ((1.0 - radius(tip)) * 90.0 + TIP_RADIUS).max(0.0);
        let force = (0.35 * depth).min(3.3);
        if depth > 0.0 {
            self.dent = Some(tip);
        }
        let flags = if depth > 0.0 { TOOL_IN_CONTACT } else { 0 } | if self.held.is_some() { TOOL_TAKEN_OVER } else { 0 };
        Some(ToolState {
            stamp: Stamp { time_ns: self.next_state_ns, sequence: self.sequence, incarnation: 1 },
            tip_mm: tip,
            proxy_mm: tip,
            direction,
            force_n: direction.map(|d| -d * force),
            penetration_mm: depth,
            radius_mm: TIP_RADIUS,
            flags,
            epoch: 0,
            tip_reference_mm: tip,
            direction_reference: direction,
        })
    }

    fn commit(&mut self) -> Option<Commit> {
        None
    }

    fn services(&mut self) -> Vec<ServiceStatus> {
        let ms = self.now_ns() / 1_000_000;
        let dead = self.shared.rendering_dead.load(Relaxed);
        let base = ServiceStatus { state: "ready", beat_age_ms: 10.0, ..Default::default() };
        vec![
            ServiceStatus { role: "haptic", pid: 4101, iterations: ms, p50_us: 11.0, p99_us: 38.0, max_us: 91.0, ..base },
            ServiceStatus {
                role: "deformation",
                pid: 4102,
                commits: ms * 6 / 100,
                iterations: ms / 10,
                p50_us: 610.0,
                p99_us: 2200.0,
                ..base
            },
            ServiceStatus {
                role: "rendering",
                pid: 4103,
                restarts: 1,
                state: if dead { "stopped" } else { "ready" },
                iterations: self.shared.frames.load(Relaxed),
                p50_us: 21_000.0,
                p99_us: 34_000.0,
                ..base
            },
            ServiceStatus { role: "console", pid: 4104, ..base },
        ]
    }

    fn send_view(&mut self, view: &ViewState) {
        self.view = *view;
        *self.shared.view.lock().unwrap() = Some(*view);
    }

    fn send_command(&mut self, command: &ToolCommand) {
        self.held = (command.taken != 0).then_some(command.target_mm);
        self.shared.commands.lock().unwrap().push(*command);
    }

    fn breath(&mut self) -> Option<&mut Signal> {
        Some(&mut self.signal)
    }

    fn send_breath(&mut self, state: &BreathState) {
        self.shared.breaths.lock().unwrap().push(*state);
    }

    fn beat(&mut self, _frames: u64, refused: u64) {
        self.shared.refused.store(refused, Relaxed);
    }

    fn should_end(&self) -> bool {
        self.shared.end.load(Relaxed)
    }
}
