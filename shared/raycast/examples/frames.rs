//! Frames on request, for programs that time this ray caster beside another: reads requests from standard input, answers each with one line.
//!
//! ```text
//! frames VOLUME WxH EYE TARGET UP FOV TRANSFER.json      (lists with commas; two threads)
//! volume STEP_MM N | even STEP_MM N | surface HU STEP_MM N      renders N times; answers {"ms": [wall of each]}
//! commit STEP_MM N                                              64 bricks in the middle change N times; answers {"ms": [the map's update]}
//! picture FILE                                                  writes the last picture as binary PPM; answers {}
//! ```
//! What is timed is the wall's time of `render` alone, with maps of empty space made before. `MAILLE_BRICK_EDGE=128` when building
//! makes bricks so large that a volume of 256³ is nearly a flat array.

use maille_raycast::{Camera, Picture, Settings, Skip, Step, Transfer, render};
use maille_volume::{BrickSource as _, BrickedVolume, io::read_volume};
use std::{io::BufRead as _, path::Path, time::Instant};

type Fault = Box<dyn std::error::Error>;

fn numbers<const N: usize>(text: &str) -> Result<[f64; N], Fault> {
    let all = text.split(['x', ',']).map(str::parse).collect::<Result<Vec<f64>, _>>()?;
    all.try_into().map_err(|_| format!("{text}: {N} numbers are wanted").into())
}

fn main() -> Result<(), Fault> {
    let given: Vec<String> = std::env::args().skip(1).collect();
    let [volume, size, eye, target, up, fov, transfer] = given.as_slice() else { return Err("see the first lines of this example".into()) };
    let mut bricks = BrickedVolume::from_volume(&read_volume(Path::new(volume))?.0);
    let camera = Camera { eye: numbers(eye)?, target: numbers(target)?, up: numbers(up)?, fov_deg: fov.parse()? };
    let transfer = Transfer::from_text(&std::fs::read_to_string(transfer)?)?;
    let [width, height] = numbers(size)?.map(|v: f64| v as usize);
    let mut picture = Picture::new(width, height);
    let pool = rayon::ThreadPoolBuilder::new().num_threads(2).build()?;
    let mut skip: Option<Skip> = None;
    for line in std::io::stdin().lock().lines() {
        let line = line?;
        let words: Vec<&str> = line.split_whitespace().collect();
        let step = |mm: &str| -> Result<Step, Fault> { Ok(Step::Millimetres(mm.parse()?)) };
        let (settings, frames): (Settings, usize) = match words.as_slice() {
            ["volume", mm, n] => (Settings { step: step(mm)?, ..Settings::volume(transfer.clone()) }, n.parse()?),
            ["even", mm, n] => (Settings { step: step(mm)?, adaptive: None, ..Settings::volume(transfer.clone()) }, n.parse()?),
            ["surface", hu, mm, n] => (Settings { step: step(mm)?, ..Settings::isosurface(hu.parse()?) }, n.parse()?),
            ["commit", mm, n] => {
                let settings = Settings { step: step(mm)?, ..Settings::volume(transfer.clone()) };
                let times = commits(&mut bricks, &pool, &settings, n.parse()?);
                println!("{{\"ms\": [{}]}}", times.join(", "));
                continue;
            }
            ["picture", file] => {
                std::fs::write(file, [format!("P6 {width} {height} 255\n").as_bytes(), &picture.rgb].concat())?;
                println!("{{}}");
                continue;
            }
            _ => return Err(format!("{line}: no such request").into()),
        };
        // a map that fits is kept: whoever asks twice times frames alone
        let skip = match &mut skip {
            Some(skip) => {
                pool.install(|| skip.update(&bricks, &settings));
                skip
            }
            empty => empty.insert(pool.install(|| Skip::new(&bricks, &settings))),
        };
        let mut times = Vec::new();
        for _ in 0..frames {
            let start = Instant::now();
            pool.install(|| render(&bricks, skip, &camera, &settings, &mut picture))?;
            times.push(format!("{:.3}", start.elapsed().as_secs_f64() * 1e3));
        }
        println!("{{\"ms\": [{}]}}", times.join(", "));
    }
    Ok(())
}

/// What the map of empty space takes to follow a commit of 64 bricks in which matter comes and goes [ms, each].
fn commits(bricks: &mut BrickedVolume, pool: &rayon::ThreadPool, settings: &Settings, count: usize) -> Vec<String> {
    let mut skip = Skip::new(bricks, settings);
    let counts = bricks.layout().counts;
    let side = counts.map(|c| c.min(4));
    let low: [usize; 3] = std::array::from_fn(|c| (counts[c] - side[c]) / 2);
    let ids: Vec<u32> = (0..side.iter().product())
        .map(|n: usize| bricks.layout().id([low[0] + n % side[0], low[1] + n / side[0] % side[1], low[2] + n / (side[0] * side[1])]))
        .collect();
    let rest: Vec<_> = ids.iter().map(|&id| *bricks.brick(id)).collect();
    let mut times = Vec::new();
    for round in 0..count {
        for (&id, rest) in ids.iter().zip(&rest) {
            let brick = bricks.brick_mut(id);
            *brick = *rest;
            if round % 2 == 0 {
                brick.voxels.iter_mut().for_each(|v| *v = if *v > -500 { -1000 } else { 40 });
                brick.summarise();
            }
        }
        let start = Instant::now();
        pool.install(|| skip.update(bricks, settings));
        times.push(format!("{:.3}", start.elapsed().as_secs_f64() * 1e3));
    }
    times
}
