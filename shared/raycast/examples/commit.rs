//! What a commit of 64 changed bricks adds to the frame after it: the map of empty space brought up to date, bricks that no cache holds any more, and the frame.
//!
//! ```text
//! cargo run --release -p maille-raycast --example commit -- VOLUME
//! ```
//! Frames with and without a commit before them in turns, of two voxel contents in turns, so that both kinds draw the same two pictures; processor time of two
//! threads, halved (the medians of many, and the median of the neighbours' differences). What writes the bricks is another process's work, and not counted.

mod clock;

use clock::{median, now};
use maille_raycast::{Camera, Picture, Preset, Settings, Skip, Step, render};
use maille_volume::{Brick, BrickSource as _, BrickedVolume, io::read_volume};
use std::path::Path;

const SIZE: [usize; 2] = [1224, 1014];
const ROUNDS: usize = 20;

fn main() {
    let file = std::env::args().nth(1).expect("a volume");
    let mut bricks = BrickedVolume::from_volume(&read_volume(Path::new(&file)).expect("a readable volume").0);
    let settings = Settings { step: Step::Millimetres(1.0), ..Settings::volume(Preset::Ct.transfer()) };
    let camera = Camera::around(bricks.info());
    let counts = bricks.layout().counts;
    let pool = rayon::ThreadPoolBuilder::new().num_threads(2).build().expect("threads");
    let mut picture = Picture::new(SIZE[0], SIZE[1]);
    let side = counts.map(|c| c.min(4));
    // where the camera sees them: the half of the volume that is nearer to it, in the middle
    for (place, nearer, taken) in [("moved in the middle", 2, false), ("moved at the face", 8, false), ("emptied at the face", 8, true)] {
        let low: [usize; 3] = std::array::from_fn(|c| if c == 1 { (counts[c] - side[c]) / nearer } else { (counts[c] - side[c]) / 2 });
        let ids: Vec<u32> = (0..side.iter().product())
            .map(|n| bricks.layout().id([low[0] + n % side[0], low[1] + n / side[0] % side[1], low[2] + n / (side[0] * side[1])]))
            .collect();
        // all voxels a voxel further on, or all air
        let rest: Vec<Brick> = ids.iter().map(|&id| *bricks.brick(id)).collect();
        let pushed: Vec<Brick> = rest
            .iter()
            .map(|brick| {
                let mut brick = *brick;
                if taken {
                    brick.voxels.fill(-1000);
                }
                brick.voxels.rotate_left(1);
                brick.summarise();
                brick
            })
            .collect();
        let mut skip = Skip::new(&bricks, &settings);
        let mut times = [Vec::new(), Vec::new(), Vec::new()];
        let mut cells = 0;
        for round in 0..2 * ROUNDS {
            let contents = if round % 2 == 0 { &pushed } else { &rest };
            for (&id, brick) in ids.iter().zip(contents) {
                *bricks.brick_mut(id) = *brick;
            }
            // the frame that shows the commit, then the same picture once more
            let mut frame = |bricks: &BrickedVolume| {
                let start = now();
                let found = pool.install(|| {
                    let found = skip.update(bricks, &settings);
                    render(bricks, &skip, &camera, &settings, &mut picture).expect("a sound camera");
                    found
                });
                (now() - start, found)
            };
            let (with, found) = frame(&bricks);
            let (without, none) = frame(&bricks);
            assert!(found.bricks_read == ids.len() && none.bricks_read == 0);
            cells += found.cells_changed;
            if round > 1 {
                times[0].push(with);
                times[1].push(without);
                times[2].push(with - without);
            }
        }
        let [with, without, more] = times.map(median);
        println!(
            "64 bricks {place}, {} cells changed sides: the next frame {with:.1} ms, the one after it {without:.1} ms; {:+.1} % (median of differences {more:+.2} ms)",
            cells / (2 * ROUNDS),
            100.0 * more / without
        );
    }
}
