//! Made volumes whose echoes are known.

use super::*;
use maille_volume::{BrickedVolume, Grid, Rescale, Volume};

/// 64 × 24 × 140 voxels of half a millimetre, by depth and distance from the middle [mm]; depth runs along +z from 0.
fn block(hu: impl Fn(f64, f64) -> f64) -> BrickedVolume {
    let mut grid = Grid::axis_aligned([64, 24, 140], [1.0, 1.0, 0.5]);
    grid.origin = [-31.5, -11.5, 0.25];
    let voxels = (0..grid.voxel_count()).map(|n| hu((n / (64 * 24)) as f64 * 0.5 + 0.25, (n % 64) as f64 - 31.5).round() as i16).collect();
    BrickedVolume::from_volume(&Volume::new(grid, Rescale::IDENTITY, voxels))
}

/// A hardly opened fan on the block's lower face.
fn straight() -> Ultrasound {
    let probe = Probe { radius_mm: 400.0, angle_deg: 2.0, depth_mm: 60.0, ..Probe::convex([0.0; 3], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]) };
    Ultrasound { lines: 48, ..Ultrasound::new(probe) }
}

fn db(amplitude: f64) -> f64 {
    20.0 * amplitude.log10()
}

/// Largest echo between two depths of the middle line, and where it is.
fn peak(e: &Echoes, step: f64, from: f64, to: f64) -> (f64, f64) {
    let line = &e.amplitude[e.lines / 2 * e.samples..][..e.samples];
    let (a, b) = ((from / step) as usize, (to / step) as usize);
    let most = line[a..b].iter().fold(0.0f32, |m, &v| m.max(v));
    let on: Vec<usize> = (a..b).filter(|&n| line[n] > 0.5 * most).collect();
    (f64::from(most), (on.iter().sum::<usize>() as f64 / on.len() as f64 + 0.5) * step)
}

#[test]
fn an_interface_returns_its_reflection_and_lets_the_rest_through() {
    // water, bone from 20 to 24 mm, water, and a wall of fat at 40 mm; no attenuation in water to speak of
    let source = block(|z, _| {
        if (20.0..24.0).contains(&z) {
            1200.0
        } else if z > 40.0 {
            -100.0
        } else {
            0.0
        }
    });
    let (water, bone, fat) = (acoustic(0.0), acoustic(1200.0), acoustic(-100.0));
    let r_bone = (bone.impedance - water.impedance) / (bone.impedance + water.impedance);
    let r_fat = (water.impedance - fat.impedance) / (water.impedance + fat.impedance);
    for step_mm in [0.1, 0.25] {
        let settings = Ultrasound { step_mm, speckle: false, ..straight() };
        let e = echoes(&source, &settings, None).unwrap();
        let (first, at) = peak(&e, step_mm, 15.0, 22.0);
        assert!((at - 20.0).abs() < 0.3, "the front is at {at}");
        // water takes 2 · 0.05 dB/cm/MHz; within the smear of the interface part of it has been lost
        let water_db = 2.0 * 0.05 * 3.5 * 2.0;
        assert!((db(first) + water_db - db(r_bone)).abs() < 1.0, "step {step_mm}: {} dB, {} expected", db(first), db(r_bone) - water_db);
        let (third, at) = peak(&e, step_mm, 35.0, 45.0);
        assert!((at - 40.0).abs() < 0.4, "the wall of fat is at {at}");
        let bone_db = 2.0 * bone.attenuation * 3.5 * 0.4;
        let expected = db(r_fat) + 2.0 * db(1.0 - r_bone * r_bone) - bone_db - 2.0 * 0.05 * 3.5 * 3.6;
        // the edges of the bone are smeared over a voxel: some tenths of a millimetre more or less of its attenuation
        assert!((db(third) - expected).abs() < 3.0, "step {step_mm}: {} dB behind the bone, {expected} expected", db(third));
    }
}

#[test]
fn tissue_fades_by_its_attenuation_and_speckle_is_rayleigh_distributed() {
    let source = block(|_, _| 50.0);
    let e = echoes(&source, &straight(), None).unwrap();
    let band = |from: f64, to: f64| -> Vec<f64> {
        let samples = (from / 0.25) as usize..(to / 0.25) as usize;
        (0..e.lines).flat_map(|l| samples.clone().map(move |n| l * e.samples + n)).map(|n| f64::from(e.amplitude[n])).collect()
    };
    let power = |v: &[f64]| v.iter().map(|a| a * a).sum::<f64>() / v.len() as f64;
    let (near, far) = (band(8.0, 12.0), band(48.0, 52.0));
    let fall = 10.0 * (power(&near) / power(&far)).log10();
    // 4 cm there and back
    let expected = 2.0 * acoustic(50.0).attenuation * 3.5 * 4.0;
    assert!((fall - expected).abs() < 1.5, "{fall} dB, {expected} expected");
    // amplitude over its decay: mean over standard deviation of a Rayleigh distribution is 1.91
    let flat: Vec<f64> = (0..10)
        .flat_map(|n| {
            let part = band(10.0 + f64::from(n), 10.5 + f64::from(n));
            let rms = power(&part).sqrt();
            part.into_iter().map(move |a| a / rms)
        })
        .collect();
    let mean = flat.iter().sum::<f64>() / flat.len() as f64;
    let deviation = (flat.iter().map(|a| (a - mean).powi(2)).sum::<f64>() / flat.len() as f64).sqrt();
    assert!((mean / deviation - 1.91).abs() < 0.25, "{}", mean / deviation);
    // the level itself is the table's
    let level = 10.0 * power(&near).log10();
    let expected = db(acoustic(50.0).scatter) - 2.0 * acoustic(50.0).attenuation * 3.5;
    assert!((level - expected).abs() < 1.5, "{level} dB at 1 cm, {expected} expected");
}

#[test]
fn bone_and_gas_cast_shadows_and_a_probe_in_the_air_sees_nothing() {
    let settings = straight();
    let level = |hu: f64| {
        let source = block(|z, _| if (15.0..19.0).contains(&z) { hu } else { 50.0 });
        let e = echoes(&source, &settings, None).unwrap();
        let mut sum = (0.0, 0.0);
        for l in 8..40 {
            for n in 120..160 {
                sum = (sum.0 + f64::from(e.amplitude[l * e.samples + n]).powi(2), sum.1 + 1.0);
            }
        }
        10.0 * (sum.0 / sum.1 + 1e-30).log10()
    };
    let (open, bone, gas) = (level(50.0), level(1200.0), level(-1000.0));
    assert!(open - bone > 25.0 && open - gas > 60.0, "behind tissue {open}, behind bone {bone}, behind gas {gas} dB");
    // 5 mm of air before the skin are gel, 20 mm are not
    let seen = |gap: f64| {
        let source = block(|z, _| if z < gap { -1000.0 } else { 50.0 });
        peak(&echoes(&source, &settings, None).unwrap(), 0.25, 30.0, 40.0).0
    };
    assert!(db(seen(5.0)) > -60.0 && db(seen(20.0)) < -120.0, "{} and {} dB", db(seen(5.0)), db(seen(20.0)));
}

#[test]
fn a_slanted_interface_returns_less() {
    let echo = |slope: f64| {
        let source = block(move |z, x| if z > 25.0 + slope * x { 1200.0 } else { 0.0 });
        peak(&echoes(&source, &Ultrasound { speckle: false, ..straight() }, None).unwrap(), 0.25, 15.0, 35.0).0
    };
    // cos² of 45 degrees
    let share = echo(1.0) / echo(0.0);
    assert!((0.3..0.65).contains(&share), "{share}");
}

#[test]
fn a_target_is_where_it_is_and_the_same_picture_comes_again() {
    // a bright ball of 3 mm at 30 mm depth, 12 mm to the right
    let source = block(|_, _| 0.0);
    let grid = source.info().grid.clone();
    let target = [12.0, 0.0, 30.0];
    let voxels = (0..grid.voxel_count())
        .map(|n| {
            let x = grid.world_from_index([(n % 64) as f64, (n / 64 % 24) as f64, (n / (64 * 24)) as f64]);
            let d = (0..3).map(|c| (x[c] - target[c]).powi(2)).sum::<f64>().sqrt();
            if d < 3.0 { 700 } else { 0 }
        })
        .collect();
    let source = BrickedVolume::from_volume(&Volume::new(grid, Rescale::IDENTITY, voxels));
    let probe = Probe { radius_mm: 40.0, angle_deg: 40.0, depth_mm: 50.0, ..Probe::convex([0.0; 3], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]) };
    let settings = Ultrasound::new(probe);
    let (mut picture, mut again) = (Picture::new(200, 160), Picture::new(200, 160));
    ultrasound(&source, &settings, None, &mut picture).unwrap();
    rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap().install(|| ultrasound(&source, &settings, None, &mut again)).unwrap();
    assert_eq!(picture, again, "the number of threads changes nothing");
    let fan = Scan::new(&settings, &Plan::new(&settings, &source.info().grid).unwrap(), [200, 160]);
    let (mut sum, mut weight) = ([0.0; 2], 0.0);
    for n in 0..200 * 160 {
        // beyond the first centimetre, where the probe's own face is
        let (x, z) = (fan.left + (n % 200) as f64 * fan.mm_per_pixel, fan.top + (n / 200) as f64 * fan.mm_per_pixel - 40.0);
        let v = (f64::from(picture.rgb[3 * n]) - 150.0).max(0.0);
        (sum, weight) = ([sum[0] + v * x, sum[1] + v * z], weight + v);
    }
    let seen = sum.map(|s| s / weight);
    // its front is brighter than its back
    assert!((seen[0] - 12.0).abs() < 1.5 && (26.0..30.5).contains(&seen[1]), "{seen:?}");
}

#[test]
fn nonsense_is_refused() {
    let source = block(|_, _| 0.0);
    let good = straight();
    let mut picture = Picture::new(8, 8);
    let probes = [
        Probe { direction: [0.0; 3], ..good.probe },
        Probe { across: good.probe.direction, ..good.probe },
        Probe { face: [f64::NAN; 3], ..good.probe },
        Probe { angle_deg: 180.0, ..good.probe },
        Probe { depth_mm: 0.0, ..good.probe },
    ];
    for probe in probes {
        assert!(ultrasound(&source, &Ultrasound { probe, ..good }, None, &mut picture).is_err(), "{probe:?}");
    }
    for bad in [
        Ultrasound { lines: 1, ..good },
        Ultrasound { step_mm: 1e-9, ..good },
        Ultrasound { range_db: f64::NAN, ..good },
        Ultrasound { pulse_mm: 1e300, ..good },
        Ultrasound { interface_mm: 1e300, ..good },
    ] {
        assert!(ultrasound(&source, &bad, None, &mut picture).is_err());
    }
    assert!(ultrasound(&source, &good, None, &mut Picture::new(0, 0)).is_ok());
}
