//! A hundred incisions a second, sustained, in a whole run: a tool goes to and fro below the surface of a head, 200 mm/s fast, and each of its moves takes a box
//! of 4×4×4 voxels away while it is felt and seen. The patient is a piece of the head in voxels of half a millimetre: in larger ones a box is wider than the
//! way of the tool between two moves, and most moves would find nothing left.
//!
//! What is judged are counts, order and bits: every move that haptic told was taken by the deformation, epochs rise and reach the picture in order, a frame that
//! began after a commit shows it, the octree that followed commit by commit is that of a fresh build, so is the one that the run keeps in its region and the
//! leaves that its commits brought, and one undo brings every bit back. Times and rates are
//! printed and not judged. `MAILLE_INCISIONS_SECONDS` says how long (4), `MAILLE_INCISIONS_VOLUME` in which head (the made one), `MAILLE_INCISIONS_NO_OCTREE` that
//! the voxels' own smooth function is felt and no octree kept.

#[path = "neurosurgery/operate.rs"]
#[allow(dead_code)] // shared with tests that ask for more
mod operate;

use maille_contract::{
    Commit, OctreeHeader, Role,
    control::Counter,
    messages::TOOL_IN_CONTACT,
    octree::{OCTREE_KIND, OCTREE_REGION},
};
use maille_phantom::{Kind, Phantom};
use maille_scene::{BoxMm, Scene};
use maille_store::{OctreeLeaves, Region};
use maille_transport::Node;
use maille_vif::{BRICK_LEAVES_BYTES, KeptOctree, LiveOctree, Octree, Options};
use maille_volume::{
    BrickSource, BrickedVolume, Grid, Rescale, Sampler, Volume,
    brick::EDGE,
    io::{read_volume, write_volume},
};
use operate::{
    Living, scene,
    support::{Scratch, eventually, report},
};
use std::{fmt::Write as _, path::Path, time::Duration};

/// Size of the made head [voxels].
const SIZE: usize = 192;
/// How fast the tool goes [mm/s], half the length of its rows and how far apart they lie [mm].
const SPEED: f64 = 200.0;
const HALF: f64 = 26.0;
const PITCH: f64 = 2.0;
/// Half the edge of the piece and its voxels [mm].
const PIECE: f64 = 44.0;
const VOXEL: f64 = 0.5;
/// When it begins [s].
const BEGIN_S: f64 = 2.0;

fn add(a: [f64; 3], b: [f64; 3], s: f64) -> [f64; 3] {
    std::array::from_fn(|c| a[c] + s * b[c])
}

fn unit(v: [f64; 3]) -> [f64; 3] {
    let length = v.iter().map(|x| x * x).sum::<f64>().sqrt();
    v.map(|x| x / length)
}

fn cross(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    std::array::from_fn(|c| a[(c + 1) % 3] * b[(c + 2) % 3] - a[(c + 2) % 3] * b[(c + 1) % 3])
}

/// The first tissue on the way from a point along a direction.
fn met(sampler: &Sampler<'_, BrickedVolume>, threshold_hu: f64, from: [f64; 3], along: [f64; 3]) -> Option<[f64; 3]> {
    let tissue = |s: f64| sampler.value(add(from, along, s)).is_some_and(|v| v >= threshold_hu);
    (0..600).map(|n| f64::from(n) * 0.25).find(|&s| tissue(s)).map(|s| add(from, along, s))
}

/// The piece of a volume around a place, in finer voxels.
fn piece(bricks: &BrickedVolume, around: [f64; 3]) -> Volume {
    let (sampler, size) = (Sampler::new(bricks), [(2.0 * PIECE / VOXEL) as usize; 3]);
    let mut grid = Grid::axis_aligned(size, [VOXEL; 3]);
    grid.origin = around.map(|v| v - PIECE);
    let voxels = (0..grid.voxel_count())
        .map(|n| {
            let at = grid.world_from_index([n % size[0], n / size[0] % size[1], n / (size[0] * size[1])].map(|v| v as f64));
            sampler.value(at).unwrap_or(-1000.0).round() as i16
        })
        .collect();
    Volume::new(grid, Rescale::IDENTITY, voxels)
}

/// Way points that go over the surface that is met from a point along a direction, row by row and deeper each time round, for so long.
fn rows(bricks: &BrickedVolume, from: [f64; 3], along: [f64; 3], radius_mm: f64, threshold_hu: f64, seconds: f64) -> String {
    let sampler = Sampler::new(bricks);
    let side = unit(cross(along, [0.0, 0.0, 1.0]));
    let up = cross(side, along);
    let mut text = String::new();
    let mut point = |time_s: f64, at: [f64; 3]| {
        writeln!(text, "[[tool.path]]\ntime_s = {time_s:.4}\nmm = {at:.3?}\ndirection = {along:.4?}").expect("a string takes all");
    };
    point(0.0, from);
    let (mut time_s, mut row, mut deeper) = (BEGIN_S, 0, 0.0);
    let (count, steps) = ((2.0 * HALF / PITCH) as i32, (2.0 * HALF / PITCH) as i32);
    while time_s < BEGIN_S + seconds {
        let v = PITCH * f64::from(row) - HALF;
        for n in 0..=steps {
            let u = if row % 2 == 0 { PITCH * f64::from(n) - HALF } else { HALF - PITCH * f64::from(n) };
            // where the ray meets nothing the tool stays where it was
            if let Some(met) = met(&sampler, threshold_hu, add(add(from, side, u), up, v), along) {
                // the tip's front this far below
                point(time_s, add(met, along, 2.0 + deeper - radius_mm));
                time_s += PITCH / SPEED;
            }
        }
        row += 1;
        if row > count {
            (row, deeper) = (0, deeper + 2.0);
        }
    }
    point(time_s + 1.0, from);
    text
}

/// A frame as it came: epoch, when it was begun and when it was done [ns].
struct Seen {
    epoch: u64,
    begun_ns: u64,
    done_ns: u64,
}

fn quantile(sorted: &[f64], q: f64) -> f64 {
    sorted[((sorted.len() - 1) as f64 * q) as usize]
}

/// The octree followed to the epoch of a snapshot: bricks whose version is newer than `shown` are fitted again.
fn follow(octree: &mut Octree, living: &Living, shown: &mut u64) -> usize {
    let snapshot = living.reader.snapshot();
    let (layout, mut bricks) = (*snapshot.layout(), 0);
    for id in 0..layout.count() as u32 {
        if snapshot.stamp(id) > *shown {
            let low = layout.first_voxel(id);
            let high = std::array::from_fn(|c| (low[c] + EDGE - 1).min(layout.size[c] - 1));
            octree.refit(&snapshot, low, high);
            bricks += 1;
        }
    }
    *shown = snapshot.epoch();
    bricks
}

/// The octree's region of a run that has one.
fn rest_octree_region(living: &Living) -> Option<Region<OctreeHeader>> {
    Region::open(&living.domain, OCTREE_REGION, OCTREE_KIND).ok()
}

fn open_octree<'a>(region: &'a Region<OctreeHeader>, living: &Living) -> KeptOctree<'a> {
    KeptOctree::open(&region.body::<u8>()[..region.header().bytes as usize], living.reader.info()).expect("it is the octree of this volume")
}

/// Compares leaves block by block, bit for bit; how many were compared. A leaf larger than a brick goes on to stand for what of it no commit has touched, where
/// a fresh build may have others: such blocks are left out unless `all` are asked for.
fn compare<'l>(live: &LiveOctree<'l, impl Fn(u32) -> Option<&'l [u8; BRICK_LEAVES_BYTES]>>, fresh: &Octree, all: bool) -> usize {
    let (size, mut count) = (fresh.info().grid.size, 0);
    for k in (0..size[2]).step_by(8) {
        for j in (0..size[1]).step_by(8) {
            for i in (0..size[0]).step_by(8) {
                let (own, built) = (live.leaf([i, j, k]), fresh.leaf([i, j, k]));
                if all || (own.0 <= EDGE && built.0 <= EDGE) {
                    assert!(own == built, "the leaf of the block at {:?} is not that of a fresh build", [i, j, k]);
                    count += 1;
                }
            }
        }
    }
    count
}

#[test]
fn a_hundred_incisions_a_second_are_all_taken_felt_seen_in_order_and_taken_back_bit_for_bit() {
    let seconds = std::env::var("MAILLE_INCISIONS_SECONDS").ok().and_then(|s| s.parse().ok()).unwrap_or(4.0);
    let file = std::env::var("MAILLE_INCISIONS_VOLUME").ok();
    let shipped = scene(SIZE, 5.0);
    let parsed = Scene::parse("shipped", &shipped).expect("the shipped scene is right");
    let tool = parsed.tool.as_ref().expect("it has a tool");
    let (volume, approach) = match &file {
        Some(file) => (read_volume(Path::new(file)).expect("a volume").0, tool.elsewhere.clone().expect("an approach elsewhere")),
        None => (Phantom::new(Kind::Head, 1).volume([SIZE; 3]), tool.approach.clone().expect("an approach")),
    };
    let (threshold_hu, bounds) = (parsed.deformation.threshold_hu, BoxMm::of(&volume.info.grid));
    let along = unit(add(bounds.at(approach.toward), bounds.at(approach.from), -1.0));
    let bricks = BrickedVolume::from_volume(&volume);
    let middle = met(&Sampler::new(&bricks), threshold_hu, bounds.at(approach.from), along).expect("the approach meets tissue");
    let from = add(middle, along, -0.5 * PIECE);
    let path = rows(&bricks, from, along, tool.radius_mm, threshold_hu, seconds);
    let scratch = Scratch::new("incisions");
    let (patient, json) = (scratch.file("piece.nrrd"), scratch.file("run.json"));
    write_volume(&patient, &piece(&bricks, middle)).expect("the piece is written");
    drop((volume, bricks));
    // way points in the place of both approaches
    let (head, rest) = shipped.split_once("# the made head is whole").expect("the scene's tool");
    let (_, rest) = rest.split_once("[incision]").expect("the scene's incision");
    let tool = "[tool]\nkind = \"incision\"\nradius_mm = 1.5\nloop = false\n";
    let head = head.replace(&format!("phantom = \"head\"\nsize = {SIZE}"), &format!("file = {patient:?}"));
    let rest = rest.replace("look_at = [0.40, 0.25, 0.68]\ndistance = 0.35", "look_at = [0.5, 0.5, 0.5]\ndistance = 0.6");
    // the haptic surface can be another, to see what its ticks take
    let surface = std::env::var("MAILLE_INCISIONS_SURFACE").unwrap_or("smooth".into());
    let rest = rest.replace("surface = \"smooth\"", &format!("surface = {surface:?}"));
    // so can the function be the voxels' own
    let rest = if std::env::var_os("MAILLE_INCISIONS_NO_OCTREE").is_some() { rest.replace("octree = true\n", "") } else { rest };
    let text = format!("{head}{tool}{path}[incision]{rest}");

    let living = Living::start(&scratch, &text, &["--report", json.to_str().expect("a path")]);
    let node = Node::open(&living.domain, "looks").expect("a node");
    let (frames, commits) = (node.frame_subscriber().expect("frames"), node.subscriber::<Commit>().expect("commits"));
    let rest = living.reader.rest();
    let mut octree = Octree::build(&rest, Options::default()).expect("the options are right");
    let (mut followed, mut refit_s, mut refitted) = (1u64, 0.0, 0);

    let (mut told, mut seen): (Vec<Commit>, Vec<Seen>) = (Vec::new(), Vec::new());
    let (mut looked, mut touched, mut next_look) = (0u64, 0u64, 0);
    let mut last_cut_s = living.now_s();
    while living.now_s() < BEGIN_S + 1.0 || living.now_s() - last_cut_s < 2.0 {
        while let Some(commit) = commits.next() {
            if commit.moved_elements > 0 {
                last_cut_s = living.now_s();
            }
            told.push(commit);
        }
        if let Some(frame) = frames.latest() {
            let header = frame.header();
            seen.push(Seen {
                epoch: header.epoch,
                begun_ns: header.stamp.time_ns.saturating_sub(header.render_ns),
                done_ns: header.stamp.time_ns,
            });
        }
        let cutting = !told.is_empty() && living.now_s() - last_cut_s < 0.2;
        looked += u64::from(cutting);
        touched += u64::from(cutting && living.tool().flags & TOOL_IN_CONTACT != 0);
        next_look += 1;
        // seldom: this program has no core of its own
        if cutting && next_look % 1024 == 0 {
            let began = std::time::Instant::now();
            refitted += follow(&mut octree, &living, &mut followed);
            refit_s += began.elapsed().as_secs_f64();
        }
        std::thread::sleep(Duration::from_millis(1));
    }

    // every move that was told was taken
    let deformation = living.control.service(Role::Deformation);
    let cuts: Vec<&Commit> = told.iter().filter(|c| c.moved_elements > 0).collect();
    let (first, last) = (cuts[0], cuts[cuts.len() - 1]);
    let span_s = (last.stamp.time_ns - first.stamp.time_ns) as f64 * 1e-9;
    let received = deformation.counter(Counter::Received);
    let moves = told.iter().map(|c| c.cause).max().expect("there are commits");
    let taken: u64 = cuts.iter().map(|c| c.moved_elements).sum();
    println!(
        "{} commits in {span_s:.1} s ({:.1} a second) took {taken} voxels away ({:.1} each); {moves} moves told ({:.1} a second), {received} taken; {:.0} % of the time in contact",
        cuts.len(),
        cuts.len() as f64 / span_s,
        taken as f64 / cuts.len() as f64,
        moves as f64 / span_s,
        100.0 * touched as f64 / looked as f64,
    );
    // moves are superseded only while the process that takes them gets no time for longer than its queue holds: 16 moves, of which a hundred come a second
    let gaps_s: Vec<f64> = told.windows(2).map(|w| (w[1].stamp.time_ns - w[0].stamp.time_ns) as f64 * 1e-9).collect();
    let longest_s = gaps_s.iter().copied().fold(0.0, f64::max);
    let lost: f64 = gaps_s.iter().map(|gap| ((gap - 0.14) * 100.0).max(0.0)).sum();
    println!("longest time between commits {:.0} ms", 1e3 * longest_s);
    assert!(
        received as f64 >= moves as f64 - lost - 2.0,
        "{received} of {moves} moves were taken, {lost:.0} were lost to a machine without time"
    );
    assert!(2 * touched > looked, "the tool does not touch what it cuts");
    assert!(cuts.len() > 5 * seconds as usize, "{} commits in {seconds} s", cuts.len());
    assert_eq!(deformation.counter(Counter::Failures), 0, "the mapper could not invert");

    // epochs rise, in commits and in frames, and a frame that began after a commit shows it
    assert!(told.windows(2).all(|w| w[0].epoch < w[1].epoch), "epochs of commits rise");
    assert!(seen.windows(2).all(|w| w[0].epoch <= w[1].epoch), "epochs of frames do not fall");
    assert!(seen.last().is_some_and(|frame| frame.epoch >= last.epoch), "the last cut is seen");
    let mut latencies = Vec::new();
    for commit in &cuts {
        let shows = seen.iter().position(|frame| frame.epoch >= commit.epoch).expect("it is seen");
        let late = seen.iter().take(shows).find(|frame| frame.begun_ns > commit.stamp.time_ns);
        assert!(late.is_none(), "a frame was begun after epoch {} was there and does not show it", commit.epoch);
        latencies.push(seen[shows].done_ns.saturating_sub(commit.stamp.time_ns) as f64 * 1e-6);
    }
    latencies.sort_by(f64::total_cmp);
    let mut steps: Vec<f64> = cuts.iter().map(|c| c.step_ns as f64 * 1e-6).collect();
    steps.sort_by(f64::total_cmp);
    let mut gaps: Vec<f64> = seen.windows(2).map(|w| (w[1].done_ns - w[0].done_ns) as f64 * 1e-6).collect();
    gaps.sort_by(f64::total_cmp);
    for (what, v) in [("commit → picture done", &latencies), ("step", &steps), ("from frame to frame", &gaps)] {
        println!(
            "{what}: p50 {:.1}, p90 {:.1}, p99 {:.1}, max {:.1} ms",
            quantile(v, 0.5),
            quantile(v, 0.9),
            quantile(v, 0.99),
            quantile(v, 1.0)
        );
    }

    // leaves fitted again are those of a fresh build
    refitted += follow(&mut octree, &living, &mut followed);
    let fresh = Octree::build(&living.reader.snapshot(), Options::default()).expect("the options are right");
    assert!(octree == fresh, "the octree that followed is not that of a fresh build");
    println!("octree: {refitted} bricks fitted again, {:.2} ms each with their chunks", 1e3 * refit_s / refitted.max(1) as f64);

    // and so are those that the run keeps: its region, and what commits brought for the bricks that they rewrote
    let region = rest_octree_region(&living);
    if let Some(region) = &region {
        let (kept, snapshot) = (open_octree(region, &living), living.reader.snapshot());
        let leaves = compare(&kept.live(|id| snapshot.channel::<OctreeLeaves>(id)), &fresh, false);
        let own = (0..snapshot.layout().count() as u32).filter(|&id| snapshot.channel::<OctreeLeaves>(id).is_some()).count();
        println!(
            "kept octree: {:.3} of the voxels' bytes; {own} bricks with leaves of their own; {leaves} blocks in leaves up to a brick, all as in a fresh build",
            region.header().bytes as f64 / (2 * snapshot.info().grid.voxel_count()) as f64
        );
        assert!(own > 0 && leaves > 0);
    }

    // taken back: strokes that were not interrupted for half a second are one
    living.undo(30);
    eventually("all is as at rest", || living.is_at_rest());
    follow(&mut octree, &living, &mut followed);
    assert!(octree == Octree::build(&rest, Options::default()).expect("the options are right"), "and so is the octree");
    if let Some(region) = &region {
        let (kept, snapshot) = (open_octree(region, &living), living.reader.snapshot());
        let at_rest = Octree::build(&rest, Options::default()).expect("the options are right");
        compare(&kept.live(|id| snapshot.channel::<OctreeLeaves>(id)), &at_rest, true);
    }
    drop((frames, commits, node, region));
    living.end();

    let report = report(&json);
    let number = |path: &str| report.pointer(path).and_then(serde_json::Value::as_f64).unwrap_or_else(|| panic!("{path} in {report:#}"));
    println!(
        "tick p50 {:.1}, p99 {:.1}, p99.9 {:.1} µs, {} loads of the smooth function in {} ticks, {} overruns; frames p50 {:.1} ms; fewest spare slots {}",
        number("/services/haptic/tick_us/p50"),
        number("/services/haptic/tick_us/p99"),
        number("/services/haptic/tick_us/p999"),
        number("/services/haptic/smooth/loads"),
        number("/services/haptic/ticks"),
        number("/services/haptic/overruns"),
        number("/services/rendering/frame_ms/p50"),
        number("/store/spare_slots_low"),
    );
    assert_eq!(number("/services/haptic/allocations"), 0.0);
    assert_eq!(number("/services/deformation/restarts"), 0.0);
}
