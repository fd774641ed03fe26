//! ChainMail against elastic tissue: a sphere pressed into a homogeneous and into a two-layer block. Prints a table; with a directory as
//! argument also writes the error maps of the middle section as PNG (white 0, red 25 % of the push and more) and all figures as JSON.
//!
//! `cargo run --release -p maille-elastic --example indentation [DIR]`

use maille_chainmail::Metric;
use maille_elastic::{
    Stopping,
    indentation::{Displacements, Errors, Indentation, Setting},
};
use std::{path::PathBuf, time::Instant};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let directory = std::env::args().nth(1).map(PathBuf::from);
    if let Some(directory) = &directory {
        std::fs::create_dir_all(directory)?;
    }
    let mut all = Vec::new();
    for (name, layer) in [("homogeneous", None), ("two layers", Some((10, 4.0)))] {
        let scene = Indentation { size: [65, 65, 41], radius: 100.0, depth: 1.0, poisson: 0.4, layer };
        let start = Instant::now();
        let solution = scene.elastic(Stopping { tolerance: 1e-6, iterations: 2000 })?;
        let truth = solution.displacement;
        println!(
            "\n{name}: sphere of {} mm pressed {} mm into {:?} elements; elastic solution {} iterations, {:.1} s",
            scene.radius,
            scene.depth,
            scene.size,
            solution.iterations,
            start.elapsed().as_secs_f64()
        );
        let bound = scene.sideways(&truth);
        println!("sideways part of the truth, a lower bound: mean {:.1} % (of what moves {:.1} %)", percent(bound[0]), percent(bound[1]));
        println!(
            "{:44} {:>8} {:>8} {:>8} {:>9} {:>8} {:>9} {:>9}",
            "setting", "mean %", "max %", "moving %", "refused %", "moved", "push ms", "relax ms"
        );
        let base = Setting { offset: 0.2, metric: Metric::Cubic, shear: 1.0, sweeps: 0, anchor: 0.0 };
        let mut settings: Vec<Setting> = [0.3, 0.2, 0.15, 0.12, 0.1].into_iter().map(|offset| Setting { offset, ..base }).collect();
        let shears = [(0.2, 0.5), (0.1, 1.5), (0.07, 1.5), (0.07, 2.0), (0.05, 2.0), (0.04, 3.0), (0.03, 4.0)];
        settings.extend(shears.map(|(offset, shear)| Setting { offset, shear, ..base }));
        settings.extend([0.2, 0.1].map(|offset| Setting { offset, metric: Metric::Round, ..base }));
        settings.extend([4, 16, 64].map(|sweeps| Setting { offset: 0.1, sweeps, ..base }));
        settings.extend([4, 16, 64].map(|sweeps| Setting { offset: 0.04, shear: 3.0, sweeps, ..base }));
        settings.push(Setting { offset: 0.1, sweeps: 16, anchor: 0.01, ..base });
        for setting in settings {
            all.push(row(name, &scene, &truth, &setting, directory.as_ref())?);
        }
    }
    if let Some(directory) = &directory {
        std::fs::write(directory.join("indentation.json"), serde_json::to_string_pretty(&all)?)?;
    }
    Ok(())
}

fn percent(errors: Errors) -> f64 {
    100.0 * errors.mean
}

fn row(
    name: &str,
    scene: &Indentation,
    truth: &Displacements,
    setting: &Setting,
    directory: Option<&PathBuf>,
) -> Result<serde_json::Value, Box<dyn std::error::Error>> {
    let volume = scene.volume();
    // the second run of each is timed: the first reads the tissue
    let mut times = [0.0; 2];
    let mut found = Vec::new();
    for _ in 0..2 {
        let mut mail = scene.mail(&volume, setting);
        scene.press(&volume, &mut mail, &Setting { sweeps: 0, ..*setting });
        mail.relax(0.0, 0.0);
        let start = Instant::now();
        scene.press(&volume, &mut mail, &Setting { sweeps: 0, ..*setting });
        times[0] = 1e3 * start.elapsed().as_secs_f64();
        let start = Instant::now();
        scene.relax(&volume, &mut mail, setting);
        times[1] = 1e3 * start.elapsed().as_secs_f64();
        found = scene.displacements(&mail);
    }
    let map = scene.error_map(&found, truth);
    let [errors, moving] = scene.errors(&map, truth);
    let refused = scene.refused(&map);
    let moved = found.iter().filter(|u| **u != [0.0; 3]).count();
    let label = format!(
        "offset {} {:?} shear {} relaxed {} anchor {}",
        setting.offset, setting.metric, setting.shear, setting.sweeps, setting.anchor
    );
    println!(
        "{label:44} {:8.1} {:8.1} {:8.1} {:9.1} {moved:8} {:9.2} {:9.2}",
        percent(errors),
        100.0 * errors.max,
        percent(moving),
        100.0 * refused,
        times[0],
        times[1]
    );
    if let Some(directory) = directory {
        let file = format!("{name} {label}.png").replace(' ', "_");
        picture(&directory.join(file), scene, &map)?;
    }
    Ok(serde_json::json!({
        "block": name, "offset": setting.offset, "metric": format!("{:?}", setting.metric), "shear": setting.shear,
        "sweeps": setting.sweeps, "anchor": setting.anchor, "mean": errors.mean, "max": errors.max, "mean_moving": moving.mean, "refused": refused,
        "moved": moved, "push_ms": times[0], "relax_ms": times[1],
    }))
}

/// The middle section j, k up, eight pixels an element.
fn picture(path: &std::path::Path, scene: &Indentation, map: &[f64]) -> Result<(), Box<dyn std::error::Error>> {
    let ([nx, ny, nz], zoom) = (scene.size, 8);
    let mut pixels = Vec::with_capacity(3 * nx * nz * zoom * zoom);
    for y in 0..nz * zoom {
        for x in 0..nx * zoom {
            let error = map[((nz - 1 - y / zoom) * ny + ny / 2) * nx + x / zoom];
            let fade = (255.0 * (1.0 - (error / 0.25).min(1.0))) as u8;
            pixels.extend([255, fade, fade]);
        }
    }
    let mut encoder = png::Encoder::new(std::fs::File::create(path)?, (nx * zoom) as u32, (nz * zoom) as u32);
    encoder.set_color(png::ColorType::Rgb);
    encoder.write_header()?.write_image_data(&pixels)?;
    Ok(())
}
