//! Frames on request, for programs that time this ray caster beside another: reads requests from standard input, answers each with one line.
//!
//! ```text
//! frames VOLUME WxH EYE TARGET UP FOV TRANSFER.json      (lists with commas; two threads)
//! volume STEP_MM N | even STEP_MM N | surface HU STEP_MM N      renders N times; answers {"ms": [wall of each]}
//! picture FILE                                                  writes the last picture as binary PPM; answers {}
//! ```
//! What is timed is the wall's time of `render` alone, with maps of empty space made before. `MAILLE_BRICK_EDGE=128` when building
//! makes bricks so large that a volume of 256³ is nearly a flat array.

use maille_raycast::{Camera, Picture, Settings, Skip, Step, Transfer, render};
use maille_volume::{BrickedVolume, io::read_volume};
use std::{io::BufRead as _, path::Path, time::Instant};

type Fault = Box<dyn std::error::Error>;

fn numbers<const N: usize>(text: &str) -> Result<[f64; N], Fault> {
    let all = text.split(['x', ',']).map(str::parse).collect::<Result<Vec<f64>, _>>()?;
    all.try_into().map_err(|_| format!("{text}: {N} numbers are wanted").into())
}

fn main() -> Result<(), Fault> {
    let given: Vec<String> = std::env::args().skip(1).collect();
    let [volume, size, eye, target, up, fov, transfer] = given.as_slice() else { return Err("see the first lines of this example".into()) };
    let bricks = BrickedVolume::from_volume(&read_volume(Path::new(volume))?.0);
    let camera = Camera { eye: numbers(eye)?, target: numbers(target)?, up: numbers(up)?, fov_deg: fov.parse()? };
    let transfer = Transfer::from_text(&std::fs::read_to_string(transfer)?)?;
    let [width, height] = numbers(size)?.map(|v: f64| v as usize);
    let mut picture = Picture::new(width, height);
    let pool = rayon::ThreadPoolBuilder::new().num_threads(2).build()?;
    for line in std::io::stdin().lock().lines() {
        let line = line?;
        let words: Vec<&str> = line.split_whitespace().collect();
        let step = |mm: &str| -> Result<Step, Fault> { Ok(Step::Millimetres(mm.parse()?)) };
        let (settings, frames): (Settings, usize) = match words.as_slice() {
            ["volume", mm, n] => (Settings { step: step(mm)?, ..Settings::volume(transfer.clone()) }, n.parse()?),
            ["even", mm, n] => (Settings { step: step(mm)?, adaptive: None, ..Settings::volume(transfer.clone()) }, n.parse()?),
            ["surface", hu, mm, n] => (Settings { step: step(mm)?, ..Settings::isosurface(hu.parse()?) }, n.parse()?),
            ["picture", file] => {
                std::fs::write(file, [format!("P6 {width} {height} 255\n").as_bytes(), &picture.rgb].concat())?;
                println!("{{}}");
                continue;
            }
            _ => return Err(format!("{line}: no such request").into()),
        };
        let skip = pool.install(|| Skip::new(&bricks, &settings));
        let mut times = Vec::new();
        for _ in 0..frames {
            let start = Instant::now();
            pool.install(|| render(&bricks, &skip, &camera, &settings, &mut picture))?;
            times.push(format!("{:.3}", start.elapsed().as_secs_f64() * 1e3));
        }
        println!("{{\"ms\": [{}]}}", times.join(", "));
    }
    Ok(())
}
