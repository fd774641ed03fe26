//! The octree as bytes, and as it is after commits: the same function and the same leaves as the octree itself, bit for bit; damaged bytes are refused.

use maille_vif::{BRICK_LEAVES_BYTES, Function as _, Incision, KeptOctree, Lattice as _, Octree, Options, Refit, Tolerance, Tool, carve};
use maille_volume::{BrickId, BrickSource, BrickedVolume, Grid, Rescale, Volume};
use std::collections::BTreeMap;

fn uniform(state: &mut u64) -> f64 {
    *state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
    (*state >> 11) as f64 / (1u64 << 53) as f64
}

/// Air, a smooth part, a noisy part and an edge, so that leaves of all kinds and sizes are there.
fn volume(size: [usize; 3]) -> BrickedVolume {
    let mut state = 5;
    let grid = Grid::axis_aligned(size, [0.8, 1.0, 1.5]);
    let voxels = (0..grid.voxel_count())
        .map(|n| {
            let [i, j, k] = [n % size[0], n / size[0] % size[1], n / (size[0] * size[1])].map(|v| v as f64);
            let smooth = 200.0 * (0.02 * i).sin() + 0.1 * j * k.sqrt();
            let noise = if i > 90.0 { 300.0 * uniform(&mut state) } else { 0.0 };
            (if i < 40.0 && j < 30.0 { -1000.0 } else { smooth + noise }) as i16
        })
        .collect();
    BrickedVolume::from_volume(&Volume::new(grid, Rescale { slope: 1.0, intercept: -3.0 }, voxels))
}

type Leaves = BTreeMap<BrickId, Box<[u8; BRICK_LEAVES_BYTES]>>;

#[test]
fn bytes_are_the_octree_itself_for_any_size_and_tolerance() {
    for (size, rms) in [([70, 40, 35], 10.0), ([150, 61, 33], 25.0), ([129, 8, 1], 10.0), ([5, 3, 2], 0.0), ([200, 40, 20], 1e4)] {
        let bricks = volume(size);
        let octree = Octree::build(&bricks, Options { tolerance: Tolerance::Rms(rms), ..Options::default() }).unwrap();
        let bytes = octree.to_bytes();
        let kept = KeptOctree::open(&bytes, bricks.info()).unwrap();
        let live = kept.live(|_| None);
        let mut state = 1;
        for _ in 0..2000 {
            let at: [f64; 3] = std::array::from_fn(|c| uniform(&mut state) * (size[c] as f64 + 1.0) - 1.0);
            assert_eq!(live.jet(at), octree.jet(at), "{at:?} of {size:?}");
            assert_eq!(live.value(at), octree.value(at));
        }
        let (mut a, mut b) = (vec![0f32; 12 * 11 * 10], vec![0f32; 12 * 11 * 10]);
        live.fill([-2, -3, -4], [12, 11, 10], &mut a);
        octree.fill([-2, -3, -4], [12, 11, 10], &mut b);
        assert_eq!(a, b);
        assert!(bytes.len() < octree.size().bytes() + 64 * 1024, "{} bytes of {}", bytes.len(), octree.size().bytes());
    }
}

#[test]
fn a_bricks_leaves_are_those_of_a_fresh_build_and_every_one_keeps_the_bound() {
    let size = [150, 61, 37];
    let rest = volume(size);
    let mut now = rest.clone();
    let options = Options::default();
    let bytes = Octree::build(&rest, options).unwrap().to_bytes();
    let kept = KeptOctree::open(&bytes, rest.info()).unwrap();
    let mut refit = Refit::new(rest.info(), options.tolerance).unwrap();
    let mut leaves = Leaves::new();
    let mut carved = Vec::new();
    for (tool, at) in [
        (Tool::Box([4; 3]), [60.0, 16.2, 17.0]),
        (Tool::Ball { radius_mm: 6.0 }, [110.0, 30.0, 20.0]),
        (Tool::Box([9, 4, 2]), [149.0, 60.0, 36.0]),
        (Tool::Box([4; 3]), [10.0, 10.0, 10.0]),
    ] {
        let incision = Incision::new(&now.info().grid, tool, at).unwrap();
        carved.push(carve(&mut now, &incision, 700.0));
        for id in carved[carved.len() - 1].bricks() {
            let out = leaves.entry(id).or_insert_with(|| Box::new([0; BRICK_LEAVES_BYTES]));
            refit.brick(id, now.brick(id), out);
        }
    }
    let fresh = Octree::build(&now, options).unwrap();
    let live = kept.live(|id| leaves.get(&id).map(|l| &**l));
    let (mut same, mut smaller) = (0, 0);
    let mut worst = 0.0f64;
    for k in (0..size[2]).step_by(8) {
        for j in (0..size[1]).step_by(8) {
            for i in (0..size[0]).step_by(8) {
                let (voxel, (edge, bits), (own, own_bits)) = ([i, j, k], fresh.leaf([i, j, k]), live.leaf([i, j, k]));
                // a leaf larger than a brick is split where a commit touched it, and goes on elsewhere: only there is the tree another one
                if edge <= 16 && own <= 16 {
                    assert_eq!((edge, &bits), (own, &own_bits), "{voxel:?}");
                    same += 1;
                } else {
                    smaller += 1;
                }
                let extent: [usize; 3] = std::array::from_fn(|c| (size[c] - voxel[c]).min(8));
                let mut values = vec![0f32; extent.iter().product()];
                live.fill(voxel.map(|v| v as isize), extent, &mut values);
                if own == 8 {
                    let mut squares = 0.0;
                    for (n, v) in values.iter().enumerate() {
                        let at = [i + n % extent[0], j + n / extent[0] % extent[1], k + n / (extent[0] * extent[1])];
                        squares += (f64::from(*v) - f64::from(now.voxel(at[0], at[1], at[2]))).powi(2);
                    }
                    worst = worst.max((squares / values.len() as f64).sqrt());
                }
            }
        }
    }
    println!(
        "{same} blocks with leaves of a fresh build, {smaller} in leaves larger than a brick; worst RMS of a block's own leaf {worst:.2} HU"
    );
    assert!(same > 300, "{same}");
    assert!(worst <= 10.0 * (1.0 + 1e-6), "{worst}");
    // put back: no brick has leaves of its own, and the kept octree stands for all
    while let Some(cut) = carved.pop() {
        cut.undo(&mut now);
    }
    for (&id, out) in &mut leaves {
        assert!(now.brick(id).voxels == rest.brick(id).voxels);
        Refit::none(out);
    }
    let back = kept.live(|id| leaves.get(&id).map(|l| &**l));
    let before = Octree::build(&rest, options).unwrap();
    for k in (0..size[2]).step_by(8) {
        for j in (0..size[1]).step_by(8) {
            for i in (0..size[0]).step_by(8) {
                assert_eq!(back.leaf([i, j, k]), before.leaf([i, j, k]));
            }
        }
    }
}

#[test]
fn damaged_bytes_are_refused_or_read_without_harm() {
    let bricks = volume([140, 40, 35]);
    let octree = Octree::build(&bricks, Options { tolerance: Tolerance::Rms(30.0), ..Options::default() }).unwrap();
    let bytes = octree.to_bytes();
    let mut state = 17;
    let mut refused = 0;
    for round in 0..600 {
        let mut wrong = bytes.clone();
        // the head and the tables are the small part; be there often
        let within = if round % 2 == 0 { 2000.min(wrong.len()) } else { wrong.len() };
        for _ in 0..3 {
            let at = (uniform(&mut state) * within as f64) as usize;
            wrong[at] = (uniform(&mut state) * 256.0) as u8;
        }
        if round % 7 == 0 {
            wrong.truncate((uniform(&mut state) * bytes.len() as f64) as usize);
        }
        let Ok(kept) = KeptOctree::open(&wrong, bricks.info()) else {
            refused += 1;
            continue;
        };
        let live = kept.live(|_| None);
        for n in 0..50 {
            let _ = live.jet([f64::from(n * 37 % 140), f64::from(n * 11 % 40), f64::from(n * 7 % 35)]);
        }
    }
    assert!(refused > 100, "{refused}");
    // leaves of a brick that are rubbish: the kept octree answers
    let kept = KeptOctree::open(&bytes, bricks.info()).unwrap();
    let rubbish: Box<[u8; BRICK_LEAVES_BYTES]> = Box::new(std::array::from_fn(|n| if n == 0 { 1 } else { 0xff }));
    let live = kept.live(|_| Some(&*rubbish));
    assert_eq!(live.jet([50.0, 20.0, 20.0]), octree.jet([50.0, 20.0, 20.0]));
    let other = Volume::new(Grid::axis_aligned([140, 40, 36], [1.0; 3]), Rescale::IDENTITY, vec![0; 140 * 40 * 36]);
    assert!(KeptOctree::open(&bytes, &other.info).is_err());
}
