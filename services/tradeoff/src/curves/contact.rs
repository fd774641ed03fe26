//! Touch: how many balls stand for a tool, how stiff the coupling may be, and how often the loop runs.
//!
//! All in one tick of `maille-contact`, friction off, on surfaces by formula. *Balls*: a shaft of 2 mm and 20 mm length, lying across a ridge of tissue (a
//! cylinder of 3 mm), moved along the ridge's width; its true depth is that of a capsule on a cylinder. *Coupling* and *rate*: a
//! simulated hand presses a rigid wall with 1 N; the wall's truth is that nothing goes in.

use super::mean_and_worst;
use crate::{
    TradeoffError,
    clock::spent,
    curve::{Context, Curve, KnobOf, Setting, Subject, Theory},
};
use maille_contact::{
    AnalyticSurface, ContactNode, Coupling, Device as _, DevicePose, Grip, HapticConfig, HapticCore, Limits, Material, SimulatedHand,
    Surface, TickInputs, TickOutputs, TissueTable, ToolShape,
};
use maille_volume::VolumeSample;

pub(super) static CURVES: &[Curve] = &[
    Curve {
        name: "contact.balls",
        engine: "contact",
        knob: KnobOf::Engine(None),
        title: "balls that stand for a shaft of 20 mm: proxies held at once",
        error: "mean difference of the depth in a ridge from that of the true capsule",
        unit: "mm",
        truth: "capsule on a cylinder, by formula",
        timed: "one tick",
        theory: Theory::Monotone,
        bench: balls,
    },
    Curve {
        name: "haptic.contact_stiffness_n_per_mm",
        engine: "contact",
        knob: KnobOf::Registry("haptic.contact_stiffness_n_per_mm"),
        title: "stiffness of the coupling between proxy and device, under the passive bound of a device of 3 N·s/m: 6 N/mm at 1 kHz",
        error: "depth of the tip in a rigid wall that a hand presses with 1 N, at rest",
        unit: "mm",
        truth: "a rigid wall: nothing goes in",
        timed: "one tick, the simulated hand included",
        theory: Theory::Not(
            "the error falls as 1/stiffness, and what is paid for it is not time but the distance to the bound beyond which the device is not passive \
             (Colgate & Schenkel: b > K·T/2 + |B|; a gain asked for beyond it is lowered to 95 % of it). A tick has two costs, by where the ball's centre \
             lies and not by stiffness: 1 N through 0.5 N/mm or less brings it a radius (2 mm) deep, into the wall; through more it stays in the air, \
             from where a tick looks in 26 directions whether another wall has come nearer than the one that is touched (35 samples of tissue a tick against 4)",
        ),
        bench: stiffness,
    },
    Curve {
        name: "contact.rate",
        engine: "contact",
        knob: KnobOf::Engine(Some([1000.0; 3])),
        title: "ticks a second [Hz], each with the stiffest coupling that is passive at that rate (95 % of 2b/T)",
        error: "depth of the tip in a rigid wall that a hand presses with 1 N, at rest",
        unit: "mm",
        truth: "a rigid wall: nothing goes in",
        timed: "the ticks of a tenth of a second, the simulated hand included",
        theory: Theory::Monotone,
        bench: rate,
    },
];

/// No friction, no damping, limits out of the way: what is left is the law.
fn config(radius_mm: f64, stiffness: f64, coupling: Coupling, period_s: f64) -> HapticConfig {
    let material = Material {
        stiffness_n_per_mm: stiffness,
        stiffening_n_per_mm2: 0.0,
        damping_n_s_per_mm: 0.0,
        friction_static: 0.0,
        friction_kinetic: 0.0,
    };
    HapticConfig {
        tissue: TissueTable::uniform(material),
        limits: Limits { max_force_n: 50.0, max_slew_n_per_s: 1e5, ramp_s: 1e-3, fade_s: 0.1 },
        friction: false,
        period_s,
        ..HapticConfig::new(radius_mm, coupling)
    }
}

fn gains(result: Result<Coupling, maille_contact::CouplingError>) -> Result<Coupling, TradeoffError> {
    result.map_err(|e| TradeoffError::Bench("contact", e.to_string()))
}

/// A core with a clock of its own.
struct Loop {
    core: HapticCore,
    now_ns: u64,
    period_ns: u64,
}

impl Loop {
    fn new(config: HapticConfig) -> Self {
        Self { core: HapticCore::new(config), now_ns: 0, period_ns: (config.period_s * 1e9).round() as u64 }
    }

    fn tick(&mut self, tissue: &impl Surface, pose: DevicePose) -> TickOutputs {
        self.now_ns += self.period_ns;
        let tissue = Some(tissue);
        self.core.tick(&TickInputs { now_ns: self.now_ns, pose, pose_age_s: 0.0, tissue, epoch: 0, tissue_age_s: 0.0, release: false })
    }
}

/// Radius of the shaft and of the ridge, length of the shaft [mm].
const SHAFT: f64 = 2.0;
const RIDGE: f64 = 3.0;
const LENGTH: f64 = 20.0;

/// The ridge: a cylinder along y, its top at z = 0; 100 HU a millimetre of depth.
fn ridge() -> AnalyticSurface<impl Fn([f64; 3]) -> VolumeSample> {
    let field = |[x, _, z]: [f64; 3]| {
        let (dx, dz) = (x, z + RIDGE);
        let r = (dx * dx + dz * dz).sqrt().max(1e-9);
        VolumeSample { value: 100.0 * (RIDGE - r), gradient: [-100.0 * dx / r, 0.0, -100.0 * dz / r] }
    };
    AnalyticSurface { field, threshold: 0.0, resolution_mm: 0.5 }
}

fn balls(_: &Context) -> Result<Vec<Subject>, TradeoffError> {
    // places of the shaft's tip along its own length while its middle part crosses the ridge, and how deep it is
    const DEPTH: f64 = 0.5;
    let places: Vec<f64> = (0..97).map(|n| 5.0 + 10.0 * f64::from(n) / 96.0).collect();
    let mut settings = Vec::new();
    for count in [3usize, 5, 7, 9, 11, 16] {
        let nodes: Vec<ContactNode> = (0..count)
            .map(|n| ContactNode { offset_mm: [0.0, 0.0, -LENGTH * n as f64 / (count - 1) as f64], radius_mm: SHAFT, share: 1.0 })
            .collect();
        let shape = ToolShape::new(&nodes);
        if shape.nodes().len() < count {
            continue;
        }
        let coupling = gains(Coupling::new(2.0, 0.0, 0.005, 1e-3))?;
        let mut own = HapticConfig { shape, ..config(SHAFT, 0.5, coupling, 1e-3) };
        own.radius_mm = SHAFT;
        // the shaft lies along x: its tip is at +x
        let pose = |at: f64, z: f64| DevicePose { position_mm: [at, 0.0, z], direction: [1.0, 0.0, 0.0], velocity_mm_s: None, valid: true };
        let tissue = ridge();
        let mut found = Vec::new();
        for &at in &places {
            let mut haptic = Loop::new(own);
            let mut out = haptic.tick(&tissue, pose(at, SHAFT + 3.0));
            for n in 0..120 {
                out = haptic.tick(&tissue, pose(at, SHAFT + 3.0 - (3.0 + DEPTH) * f64::from((n + 1).min(100)) / 100.0));
            }
            found.push((out.penetration_mm - DEPTH).abs());
        }
        let errors = mean_and_worst(found.into_iter());
        let (mut haptic, own_places) = (Loop::new(own), places.clone());
        for n in 0..=100 {
            haptic.tick(&tissue, pose(10.0, SHAFT + 3.0 - (3.0 + DEPTH) * f64::from(n) / 100.0));
        }
        let run = move || {
            let tissue = ridge();
            let ticks = 2 * own_places.len();
            // there and back, sliding in contact
            spent(|| {
                own_places
                    .iter()
                    .chain(own_places.iter().rev())
                    .map(|&at| haptic.tick(&tissue, pose(at, SHAFT - DEPTH)).penetration_mm)
                    .sum::<f64>()
            }) / ticks as f64
        };
        settings.push(Setting::new("", count as f64, errors, run));
    }
    Ok(vec![Subject { name: "a shaft across a ridge".into(), settings }])
}

/// A rigid wall at z = 0.
fn wall() -> AnalyticSurface<impl Fn([f64; 3]) -> VolumeSample> {
    AnalyticSurface {
        field: |[_, _, z]: [f64; 3]| VolumeSample { value: -100.0 * z, gradient: [0.0, 0.0, -100.0] },
        threshold: 0.0,
        resolution_mm: 0.5,
    }
}

/// Force of the hand [N], damping of its device [N·s/mm], radius of the tip [mm].
const PRESS_N: f64 = 1.0;
const DEVICE_DAMPING: f64 = Grip::FULL.device_damping_n_s_per_mm;
const TIP: f64 = 2.0;

/// A hand that presses on the wall through a coupling.
struct Pressing {
    haptic: Loop,
    hand: SimulatedHand,
}

impl Pressing {
    fn new(coupling: Coupling, period_s: f64) -> Self {
        // the wall is as stiff as the coupling lets it be
        let haptic = Loop::new(config(TIP, 1e6, coupling, period_s));
        let mut hand = SimulatedHand::new(Grip::FULL, [0.0, 0.0, TIP + 2.0], [0.0, 0.0, -1.0]);
        // so far beyond the wall that the grip's spring presses as asked where the coupling's comes to rest
        let depth = PRESS_N / coupling.stiffness_n_per_mm();
        hand.set_target([0.0, 0.0, TIP - depth - PRESS_N / Grip::FULL.stiffness_n_per_mm]);
        Self { haptic, hand }
    }

    /// Depth of the tip after a tick [mm].
    fn tick(&mut self, tissue: &impl Surface) -> f64 {
        let pose = self.hand.read(self.haptic.now_ns);
        let out = self.haptic.tick(tissue, pose);
        self.hand.write(out.force_n);
        out.penetration_mm
    }

    /// Mean and largest depth over the last half of two seconds [mm].
    fn errors(&mut self, rate_hz: f64) -> [f64; 2] {
        let tissue = wall();
        let ticks = (2.0 * rate_hz) as usize;
        let depths: Vec<f64> = (0..ticks).map(|_| self.tick(&tissue)).collect();
        mean_and_worst(depths[ticks / 2..].iter().copied())
    }
}

fn stiffness(_: &Context) -> Result<Vec<Subject>, TradeoffError> {
    let bound = Coupling::passive_stiffness(0.0, DEVICE_DAMPING, 1e-3);
    let mut settings = Vec::new();
    for k in [0.1, 0.25, 0.5, 1.0, 2.0, 4.0, 5.0f64] {
        let (coupling, lowered) =
            Coupling::lowered(k, 0.0, DEVICE_DAMPING, 1e-3).map_err(|e| TradeoffError::Bench("contact", e.to_string()))?;
        let mut pressing = Pressing::new(coupling, 1e-3);
        let errors = pressing.errors(1000.0);
        let run = move || {
            let tissue = wall();
            spent(|| (0..200).map(|_| pressing.tick(&tissue)).sum::<f64>()) / 200.0
        };
        let share = if lowered { "lowered".into() } else { format!("{:.0} % of the bound", 100.0 * k / bound) };
        settings.push(Setting::new("", k, errors, run).called(format!("{k} ({share})")));
    }
    Ok(vec![Subject { name: "a hand of full grip on a rigid wall".into(), settings }])
}

fn rate(_: &Context) -> Result<Vec<Subject>, TradeoffError> {
    let mut settings = Vec::new();
    for hz in [250.0, 500.0, 1000.0, 2000.0, 4000.0f64] {
        let period = 1.0 / hz;
        let stiffest = 0.95 * Coupling::passive_stiffness(0.0, DEVICE_DAMPING, period);
        let mut pressing = Pressing::new(gains(Coupling::new(stiffest, 0.0, DEVICE_DAMPING, period))?, period);
        let errors = pressing.errors(hz);
        let run = move || {
            let tissue = wall();
            spent(|| (0..(0.1 * hz) as usize).map(|_| pressing.tick(&tissue)).sum::<f64>())
        };
        settings.push(Setting::new("", hz, errors, run).called(format!("{hz} Hz")));
    }
    Ok(vec![Subject { name: "a hand of full grip on a rigid wall".into(), settings }])
}
