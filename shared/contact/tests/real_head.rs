//! A hand slides over a real head, skin and skull: contact kept, no steps, bounded force. Data: `MAILLE_DATA`, else `../shared/data`.

#![allow(clippy::disallowed_macros)] // a test says what it sees

mod common;

use bytemuck::Zeroable;
use common::*;
use maille_chainmail::{ChainMail, ChangedRegion, Motion, Pin, Tissue, enclosing_elements};
use maille_contact::{
    Coupling, Device, DevicePose, DeviceProfile, Grip, HapticConfig, HapticCore, Isosurface, SimulatedHand, Surface, TickInputs, ToolMove,
    ToolShape,
};
use maille_contract::histogram::SharedHistogram;
use maille_mapper::{MapOptions, remap, rest_position};
use maille_realtime::monotonic_ns;
use maille_volume::{BrickSource, BrickedVolume, io::read_volume};
use std::{path::PathBuf, rc::Rc};

fn head() -> Option<BrickedVolume> {
    let data = std::env::var("MAILLE_DATA").unwrap_or_else(|_| concat!(env!("CARGO_MANIFEST_DIR"), "/../../../shared/data").into());
    let path = PathBuf::from(data).join("ct_head_invesalius/cranium_lps.nrrd");
    if !path.exists() {
        assert!(std::env::var_os("CI").is_none(), "{} is missing, and CI requires it", path.display());
        {
            eprintln!("SKIPPED: {} is missing; set MAILLE_DATA", path.display());
        }
        return None;
    }
    Some(BrickedVolume::from_volume(&read_volume(&path).expect("the head can be read").0))
}

/// How far from a point the surface is, seen from outside along a ray [mm].
fn surface_mm(tissue: &impl Surface, center: V3, outward: V3, threshold: f64) -> f64 {
    let mut r = 140.0;
    while r > 20.0 && !tissue.value((center + outward * r).into()).is_some_and(|v| v >= threshold) {
        r -= 0.5;
    }
    r
}

/// Slides along an arc around the head's middle at 50 mm/s, the hand wanting 12 mm below the surface. Gives the largest step in parts of
/// max(force, 0.5 N), the part of ticks in contact, and prints the time of a tick.
fn slide(volume: &BrickedVolume, threshold: f64, elevation: f64, shape: ToolShape, grip: Grip) -> (f64, f64) {
    let radius_mm = shape.nodes()[0].radius_mm;
    let tissue = Isosurface::new(volume, threshold);
    let center = V3::from(volume.info().grid.center());
    let direction = |angle: f64| V3::new(angle.sin(), -angle.cos(), elevation).normalize();
    let surface = |u: V3| surface_mm(&tissue, center, u, threshold);
    let mut core = HapticCore::new(HapticConfig {
        shape,
        passivity: true,
        ..HapticConfig::new(radius_mm, Coupling::new(2.0, 5e-4, 0.003, 1e-3).unwrap())
    });
    let start = direction(-0.4);
    let from = center + start * (surface(start) + radius_mm + 4.0);
    let mut hand = SimulatedHand::new(grip, from.into(), (-start).into());
    let (mut worst, mut touched, mut last) = (0.0f64, 0u32, None::<V3>);
    let compute = SharedHistogram::zeroed();
    let ticks = 2600u64;
    let mut angle = -0.4;
    for n in 0..ticks {
        let u = direction(angle);
        let r = surface(u);
        if n < 600 {
            hand.set_target((center + u * (r + radius_mm + 4.0 - 16.0 * n as f64 / 600.0)).into());
        } else {
            angle += 0.05 / r;
            hand.set_target((center + u * (r + radius_mm - 12.0)).into());
        }
        let now_ns = n * 1_000_000;
        let pose = hand.read(now_ns);
        let before = monotonic_ns();
        let out =
            core.tick(&TickInputs { now_ns, pose, pose_age_s: 0.0, tissue: Some(&tissue), epoch: 0, tissue_age_s: 0.0, release: false });
        compute.record(monotonic_ns() - before);
        hand.write(out.force_n);
        let f = V3::from(out.force_n);
        assert!(f.norm() <= 3.3 + 1e-9 && f.iter().all(|c| c.is_finite()));
        if n >= 1000 {
            touched += u32::from(out.in_contact);
            if let Some(last) = last {
                worst = worst.max((f - last).norm() / f.norm().max(0.5));
            }
        }
        last = Some(f);
    }
    {
        println!(
            "{} balls, threshold {threshold}: tick {:?} ns, worst step {:.2} %",
            shape.nodes().len(),
            compute.percentiles(),
            worst * 100.0
        );
    }
    (worst, f64::from(touched) / (ticks - 1000) as f64)
}

#[test]
fn sliding_over_skin_and_skull_keeps_contact_and_gives_no_step() {
    let Some(volume) = head() else { return };
    // skin at the nose's height; skull over the forehead, where no orbit opens
    for (threshold, elevation, grip) in
        [(-300.0, 0.35, Grip::LIGHT), (-300.0, 0.35, Grip::FULL), (276.0, 1.2, Grip::LIGHT), (276.0, 1.2, Grip::FULL)]
    {
        let (worst, touched) = slide(&volume, threshold, elevation, ToolShape::sphere(3.0), grip);
        assert!(touched > 0.9, "threshold {threshold}: {:.0} % of ticks in contact", touched * 100.0);
        assert!(worst <= 0.05, "threshold {threshold}: worst step {:.1} %", worst * 100.0);
    }
}

/// A stiff desktop device with a delay of its own: the passivity controller at work.
const DEVICE: DeviceProfile = DeviceProfile {
    name: "test",
    max_force_n: 12.0,
    max_torque_n_mm: 0.0,
    max_stiffness_n_per_mm: 5.0,
    damping_n_s_per_mm: 0.03,
    coulomb_n: 0.1,
    quantum_mm: 0.01,
    mass_kg: 0.1,
    delay_s: 0.002,
    workspace_mm: 75.0,
};

/// Largest step in parts of max(force, 0.5 N), and the part of ticks in contact: a tip that nothing holds back is led along a straight line of 12 mm
/// to and fro at a speed, `depth_mm` below where the surface is in its middle.
fn led(volume: &BrickedVolume, threshold: f64, elevation: f64, along: V3, speed_mm_s: f64, depth_mm: f64) -> (f64, f64) {
    let tissue = Isosurface::new(volume, threshold);
    let center = V3::from(volume.info().grid.center());
    let inward = -V3::new(-0.2, -1.0, elevation).normalize();
    let along = (along - inward * along.dot(&inward)).normalize();
    let r = surface_mm(&tissue, center, -inward, threshold);
    let (config, _) = HapticConfig::on_device(3.0, 2.0, 5e-4, 1e-3, &DEVICE).unwrap();
    let mut driver = Driver::new(config);
    let (mut worst, mut touched, mut last) = (0.0f64, 0, None::<V3>);
    for n in 0..6_000u64 {
        let t = n as f64 * 1e-3;
        let lift = 3.0 + 3.0 - (depth_mm + 3.0) * (t / 1.0).min(1.0);
        let round = 24.0 / speed_mm_s;
        let phase = ((t - 1.5).max(0.0) % round) / round;
        let way = 12.0 * (1.0 - (2.0 * phase - 1.0).abs()) - 6.0;
        let at = center - inward * (r + lift) + along * (way + 6.0);
        let out = driver.tick_pose(&tissue, 0, DevicePose { direction: inward.into(), ..pose(at) });
        let f = V3::from(out.force_n);
        if n >= 1_500 {
            if let Some(last) = last {
                worst = worst.max((f - last).norm() / f.norm().max(0.5));
            }
            touched += u32::from(out.in_contact);
        }
        last = Some(f);
    }
    (worst, f64::from(touched) / 4_500.0)
}

#[test]
fn a_tip_that_is_led_over_skin_and_skull_by_a_device_of_its_own_delay_feels_no_step() {
    let Some(volume) = head() else { return };
    for (threshold, elevation) in [(-300.0, 0.35), (276.0, 1.2)] {
        for along in [V3::x(), V3::z()] {
            for (speed, depth) in [(50.0, 3.0), (50.0, 4.0), (100.0, 3.0)] {
                let (worst, touched) = led(&volume, threshold, elevation, along, speed, depth);
                let what =
                    format!("threshold {threshold}, along {along:?}, {speed} mm/s, {depth} mm deep: {:.1} % at worst", worst * 100.0);
                assert!(touched > 0.95 && worst <= 0.05, "{what}, {:.0} % of ticks in contact", touched * 100.0);
            }
        }
    }
}

/// A shaft of sixteen balls and a probe of nine that slide over skin: bounded work, and the same rule for steps.
#[test]
fn a_shaft_and_a_probe_slide_over_skin_without_a_step() {
    let Some(volume) = head() else { return };
    for shape in [ToolShape::capsule(3.0, 45.0), ToolShape::probe(40.0, 60.0, 8.0)] {
        let (worst, touched) = slide(&volume, -300.0, 0.35, shape, Grip::FULL);
        assert!(touched > 0.9, "{} balls: {:.0} % of ticks in contact", shape.nodes().len(), touched * 100.0);
        assert!(worst <= 0.05, "{} balls: worst step {:.1} %", shape.nodes().len(), worst * 100.0);
    }
}

/// The head after fourteen pushes of ChainMail around a place of its forehead, into the tissue and askew: dents as deep as a tip makes them, and as rough.
fn rewritten(rest: &BrickedVolume, around: V3, seed: u64) -> BrickedVolume {
    let grid = &rest.info().grid;
    let mut mail = ChainMail::new(rest.info(), Tissue { offset: 0.3, bone_hu: Some(300.0), ..Tissue::default() });
    let mut random = Random(seed);
    let mut region = ChangedRegion::default();
    for _ in 0..14 {
        let at = around + V3::new(random.within(-10.0, 10.0), random.within(-1.5, 1.5), random.within(-10.0, 10.0));
        let by = V3::new(random.within(-0.5, 0.5), random.within(1.0, 3.0), random.within(-0.5, 0.5));
        let motion = Motion::By(std::array::from_fn(|c| by[c] as f32));
        let pins: Vec<Pin> = enclosing_elements(grid, at.into()).into_iter().map(|voxel| Pin { voxel, motion }).collect();
        region.merge(&mail.push(rest, &pins).region);
    }
    let mut deformed = rest.clone();
    let report = remap(rest, &mail, &region, &mut deformed, &MapOptions::default());
    assert!(report.voxels > 1000, "{} voxels rewritten", report.voxels);
    deformed
}

/// Slides a tip of 3 mm to and fro by 12 mm at 50 mm/s over the forehead, on a device with passivity on, led or by a light hand; before each tick `rewrite`
/// gets the tick's number and what the tool told last, and gives the epoch of the volume. The largest step in parts of max(force, 0.5 N), and the part
/// of ticks in contact.
fn to_and_fro(along: V3, led: bool, mut rewrite: impl FnMut(u64, &mut Option<ToolMove>) -> (Rc<BrickedVolume>, u64)) -> (f64, f64) {
    let device = DeviceProfile { max_stiffness_n_per_mm: 2.0, damping_n_s_per_mm: 0.003, delay_s: 0.001, coulomb_n: 0.0, ..DEVICE };
    let (config, _) = HapticConfig::on_device(3.0, 2.0, 5e-4, 1e-3, &device).unwrap();
    let from = V3::from(FOREHEAD);
    let mut core = HapticCore::new(config);
    let mut hand = SimulatedHand::new(Grip { stiffness_n_per_mm: 0.05, ..Grip::LIGHT }, from.into(), [0.0, 1.0, 0.0]);
    let (mut worst, mut touched, mut last, mut told) = (0.0f64, 0, V3::zeros(), None);
    for n in 0..6_000u64 {
        let t = n as f64 * 1e-3;
        let way = ((t - 1.5).max(0.0) * 50.0 + 12.0) % 48.0;
        let at = from + V3::y() * (9.0 * t.min(1.0)) + along * (12.0 - (way - 24.0).abs());
        hand.set_target(at.into());
        let now_ns = n * 1_000_000;
        let held = hand.read(now_ns);
        let pose = if led { DevicePose { direction: [0.0, 1.0, 0.0], ..pose(at) } } else { held };
        let (volume, epoch) = rewrite(n, &mut told);
        let tissue = Isosurface::new(&*volume, -300.0);
        let tissue = Some(&tissue);
        let out = core.tick(&TickInputs { now_ns, pose, pose_age_s: 5e-4, tissue, epoch, tissue_age_s: 0.0, release: false });
        told = out.tool_move.or(told);
        hand.write(out.force_n);
        let f = V3::from(out.force_n);
        if n >= 1_600 {
            worst = worst.max((f - last).norm() / f.norm().max(0.5));
            touched += u32::from(out.in_contact);
        }
        last = f;
    }
    let share = f64::from(touched) / 4_400.0;
    println!("along {along:?}, led {led}: {:.1} % at worst, {:.0} % in contact", worst * 100.0, share * 100.0);
    (worst, share)
}

/// Before the forehead [mm, LPS].
const FOREHEAD: [f64; 3] = [122.0, 52.9, 128.4];

/// Over skin that ChainMail has made rough and that is another one 30 or 60 times a second: slips of friction, feet that leap from side to side of a dent,
/// contacts lost and found.
#[test]
fn sliding_over_skin_that_is_rewritten_gives_no_step() {
    let Some(volume) = head() else { return };
    let heads: Vec<_> = (1..5).map(|seed| Rc::new(rewritten(&volume, V3::from(FOREHEAD) + V3::y() * 5.5, seed))).collect();
    for (along, every, led) in [(V3::z(), 33, true), (V3::z(), 16, false), (V3::x(), 16, true), (V3::x(), 33, false)] {
        let (worst, share) = to_and_fro(along, led, |n, _| (Rc::clone(&heads[(n / every) as usize % heads.len()]), n / every));
        assert!(worst <= 0.05 && share > 0.6, "along {along:?}, every {every} ms, led {led}: {worst}, {share}");
    }
}

/// The whole play: skin gives way to the tip (ChainMail, mapper, a commit every 17 ms) and creeps back behind it.
#[test]
fn sliding_over_skin_that_gives_way_gives_no_step() {
    let Some(rest) = head() else { return };
    let grid = rest.info().grid.clone();
    for (along, led) in [(V3::z(), true), (V3::z(), false), (V3::x(), true), (V3::x(), false)] {
        let mut mail = ChainMail::new(rest.info(), Tissue { offset: 0.3, bone_hu: Some(300.0), ..Tissue::default() });
        let (mut now, mut commits) = (Rc::new(rest.clone()), 0);
        let (worst, share) = to_and_fro(along, led, |n, told| {
            if n % 17 == 0 {
                let mut region = mail.relax((-0.017f32 / 0.3).exp(), 0.001);
                if let Some(m) = told.take() {
                    // from where the surface is to the tip's end
                    let by = V3::from(m.tip_mm) - V3::from(m.normal) * m.radius_mm - V3::from(m.contact_mm);
                    let motion = Motion::By(std::array::from_fn(|c| by[c] as f32));
                    let at = rest_position(&mail, &grid, m.contact_mm).expect("a contact has a place at rest");
                    let pins: Vec<Pin> = enclosing_elements(&grid, at).into_iter().map(|voxel| Pin { voxel, motion }).collect();
                    region.merge(&mail.push(&rest, &pins).region);
                }
                if !region.is_empty() {
                    remap(&rest, &mail, &region, Rc::get_mut(&mut now).expect("nobody reads between ticks"), &MapOptions::default());
                    commits += 1;
                }
            }
            (Rc::clone(&now), commits)
        });
        assert!(worst <= 0.05 && share > 0.6 && commits > 200, "along {along:?}, led {led}: {worst}, {share}, {commits} commits");
    }
}

/// In air pockets of the head (nose, sinuses), narrower and wider than the tip, a loosely held tool is pushed about at random: force and
/// slew stay within the limits, and no tip that starts in air is ever treated as buried.
#[test]
fn in_narrow_cavities_the_force_is_bounded_and_no_tip_is_buried() {
    let Some(volume) = head() else { return };
    let tissue = Isosurface::new(&volume, -300.0);
    let center = V3::from(volume.info().grid.center());
    let mut seed = Random(12_345);
    let mut random = move || seed.within(-0.5, 0.5);
    let (mut pockets, mut felt) = (0, 0);
    while pockets < 8 {
        let start = center + V3::new(random() * 50.0, random() * 50.0 - 40.0, random() * 70.0 - 20.0);
        let air = |x: f64| tissue.value((start + V3::x() * x).into()).is_some_and(|v| v < -300.0);
        if !(air(0.0) && air(1.0) && air(-1.0)) || air(8.0) && air(-8.0) {
            continue;
        }
        pockets += 1;
        for radius_mm in [0.8, 3.0] {
            let mut core = HapticCore::new(HapticConfig::new(radius_mm, Coupling::new(2.0, 5e-4, 0.003, 1e-3).unwrap()));
            let mut hand = SimulatedHand::new(Grip::LIGHT, start.into(), [0.0, 0.0, -1.0]);
            let (mut last, mut target) = (V3::zeros(), start);
            for n in 0..1000u64 {
                if n % 200 == 0 {
                    target = start + V3::new(random(), random(), random()) * 20.0;
                }
                let now = V3::from(hand.target_mm());
                hand.set_target((now + (target - now) * 0.01).into());
                let now_ns = n * 1_000_000;
                let pose = hand.read(now_ns);
                let out = core.tick(&TickInputs {
                    now_ns,
                    pose,
                    pose_age_s: 0.0,
                    tissue: Some(&tissue),
                    epoch: 0,
                    tissue_age_s: 0.0,
                    release: false,
                });
                hand.write(out.force_n);
                let f = V3::from(out.force_n);
                assert!(f.norm() <= 3.3 + 1e-9 && (f - last).norm() <= 0.1 + 1e-9, "{n}: {last:?} {f:?}");
                assert!(!out.buried);
                felt += u32::from(out.in_contact);
                last = f;
            }
        }
    }
    assert!(felt > 4000, "the walls are felt: {felt} of 16000 ticks");
}
