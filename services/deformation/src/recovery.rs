//! A restart changes nothing: the real engine on a real store, dropped or killed at random instants, against one that never was.
//!
//! Two worlds get the same random work: pushes into tissue that keeps a part of them, cuts, steps of relaxation of both kinds, changes of
//! the threshold. In one the process goes on for ever; in
//! the other it is ended and started again, between steps, and in the middle of them at every named point of the store
//! (`fault::die_here`: the stack is unwound, which writes nothing into shared memory). A step whose commit had not become visible is
//! done again by the successor; one that had is not. After every step all voxels, skip cells, displacements, plastic parts, cuts and
//! the state are the same, bit for bit.
//!
//! `MAILLE_RESTARTS=2000 cargo test -p maille-deformation recovery` looks longer; `MAILLE_SEED` gives other work.

use crate::{
    restore::restore,
    step::{Done, Engine},
};
use maille_chainmail::{PlasticBand, RelaxOptions, Triangle, swept_blade};
use maille_contract::{Role, Stamp, ToolMove};
use maille_scene::{EffectSetting, Pins, Scene};
use maille_store::{
    CommitOutcome, Cuts, DISPLACEMENT_LEN, Plastic, Reader, Snapshot, StoreKeeper, StoreSizes, Writer,
    fault::{Died, Point, die_here, live_on},
};
use maille_transport::{ControlMap, Domain, Untimed};
use maille_volume::{Brick, BrickSource, Grid, Rescale, Volume};
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};

/// splitmix64.
struct Random(u64);

impl Random {
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let z = (self.0 ^ (self.0 >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        let z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^ (z >> 31)
    }
    fn below(&mut self, n: u64) -> u64 {
        self.next() % n
    }
    fn within(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * (self.next() >> 11) as f64 / (1u64 << 53) as f64
    }
}

fn number(name: &str, otherwise: u64) -> u64 {
    std::env::var(name).map_or(otherwise, |text| text.parse().unwrap_or_else(|_| panic!("{name} is a number, not {text:?}")))
}

/// Voxels along i, j, k.
const SIZE: [usize; 3] = [48, 40, 44];
/// Spacing [mm].
const SPACING: [f64; 3] = [1.0, 1.0, 1.25];
/// Height of the surface [mm]: tissue below, air above.
const SURFACE_MM: f64 = 36.0;

/// Soft tissue of changing density under air, with bone in it.
fn volume() -> Volume {
    let grid = Grid::axis_aligned(SIZE, SPACING);
    let mut voxels = Vec::with_capacity(grid.voxel_count());
    for k in 0..SIZE[2] {
        for j in 0..SIZE[1] {
            for i in 0..SIZE[0] {
                let (x, y, z) = (i as f64 * SPACING[0], j as f64 * SPACING[1], k as f64 * SPACING[2]);
                let bone = (x - 34.0).powi(2) + (y - 20.0).powi(2) + (z - 20.0).powi(2) < 36.0;
                let soft = 40.0 + 60.0 * (0.4 * x).sin() * (0.3 * y).cos() + 15.0 * (0.7 * z).sin();
                // a surface of some voxels' thickness, as in a CT
                let depth = ((SURFACE_MM - z) / 2.0).clamp(-1.0, 1.0);
                let hu = if bone { 900.0 } else { -460.0 + (soft + 460.0) * depth + if depth < 0.0 { 500.0 * depth } else { 0.0 } };
                voxels.push(hu.round() as i16);
            }
        }
    }
    Volume::new(grid, Rescale { slope: 1.0, intercept: 0.0 }, voxels)
}

/// What a process holds.
struct Process {
    engine: Engine<Untimed>,
    writer: Writer,
    reader: Reader,
}

struct World {
    domain: Domain,
    _control: ControlMap,
    _keeper: StoreKeeper,
    scene: Scene,
    process: Option<Process>,
}

impl World {
    fn new(scene: &Scene) -> Self {
        let volume = volume();
        let domain = Domain::fresh().unwrap();
        let control = ControlMap::create(&domain).unwrap();
        let sizes = StoreSizes::for_volume(27, 27, 3, true);
        let sizes = StoreSizes { plastic_slots: sizes.displacement_slots, cut_slots: sizes.displacement_slots, ..sizes };
        let keeper = StoreKeeper::create(&domain, &volume, sizes, |_| {}).unwrap();
        let mut world = Self { domain, _control: control, _keeper: keeper, scene: scene.clone(), process: None };
        world.start(None);
        world
    }

    /// As `run` starts: opens, restores, and takes the threshold that the page shows.
    fn start(&mut self, shown: Option<f64>) {
        self.process = None;
        let (writer, reader) = (Writer::open(&self.domain).unwrap(), Reader::open(&self.domain, Role::Deformation).unwrap());
        writer.audit().unwrap();
        let mut engine = Engine::new(&self.scene, reader.info(), Untimed);
        engine.mail.set_plasticity(vec![PlasticBand { from_hu: -500.0, fraction: 0.2 }, PlasticBand { from_hu: 60.0, fraction: 0.5 }]);
        restore(&mut engine, &writer);
        let mut process = Process { engine, writer, reader };
        if let Some(threshold_hu) = shown {
            process.show(threshold_hu);
        }
        self.process = Some(process);
    }

    fn process(&mut self) -> &mut Process {
        self.process.as_mut().expect("a process runs")
    }

    fn snapshot(&self) -> Snapshot<'_> {
        self.process.as_ref().expect("a process runs").reader.snapshot()
    }
}

impl Drop for World {
    fn drop(&mut self) {
        self.process = None;
        self.domain.remove().unwrap();
    }
}

/// What a step does.
#[derive(Clone, Copy, Debug)]
enum Work {
    Push(ToolMove),
    /// back to rest, all alike
    Relax,
    /// back to what is plastic, by the energy; a batch is the middle of a relaxation
    Settle,
    Cut([Triangle; 2]),
    /// in a scene with incisions
    Incise(ToolMove),
    /// so many since the run began
    Undo(u64),
}

impl Process {
    /// The page shows another threshold.
    fn show(&mut self, threshold_hu: f64) -> Option<Done> {
        self.engine.set_threshold(threshold_hu, &self.reader, &mut self.writer)
    }

    fn work(&mut self, work: Work, now_ns: u64) -> Option<Done> {
        match work {
            Work::Push(message) => self.engine.press(&message, now_ns, &self.reader, &mut self.writer),
            Work::Incise(message) => self.engine.step(&[message], now_ns, &self.reader, &mut self.writer),
            Work::Undo(undos) => self.engine.undo(undos, &self.reader, &mut self.writer),
            Work::Relax => self.engine.relax(now_ns, 66_000_000, &[], &|| false, &self.reader, &mut self.writer),
            Work::Settle => {
                let options = RelaxOptions { sweeps: 1, ..RelaxOptions::default() };
                let region = self.engine.mail.relax_elastic(&self.reader.rest(), &options, &[], &|| false).region;
                (!region.is_empty()).then(|| self.engine.commit(&region, &self.reader, &mut self.writer))
            }
            Work::Cut(triangles) => {
                let region = self.engine.mail.cut_triangles(&self.reader.rest(), &triangles);
                (!region.is_empty()).then(|| self.engine.commit(&region, &self.reader, &mut self.writer))
            }
        }
    }
}

/// A tip that presses somewhere into the surface, from above and not quite straight.
fn push(random: &mut Random, sequence: u64) -> ToolMove {
    let at = [random.within(6.0, 42.0), random.within(6.0, 34.0)];
    let (depth, radius) = (random.within(0.5, 6.0), random.within(0.5, 3.0));
    let lean = [random.within(-0.3, 0.3), random.within(-0.3, 0.3)];
    let length = (lean[0] * lean[0] + lean[1] * lean[1] + 1.0f64).sqrt();
    let normal = [lean[0] / length, lean[1] / length, 1.0 / length];
    let tip = [at[0], at[1], SURFACE_MM - depth + radius];
    let outside = std::array::from_fn(|c| tip[c] + normal[c] * (depth + 8.0));
    let contact = [at[0], at[1], SURFACE_MM];
    let stamp = Stamp { time_ns: sequence * 16_000_000, sequence, incarnation: 1 };
    ToolMove { stamp, tip_mm: tip, outside_mm: outside, contact_mm: contact, normal, depth_mm: depth, radius_mm: radius }
}

/// A slit of some millimetres from the surface down.
fn slit(random: &mut Random) -> [Triangle; 2] {
    let (from, angle) = ([random.within(6.0, 42.0), random.within(6.0, 34.0)], random.within(0.0, 3.0));
    let to = [from[0] + 7.0 * angle.cos(), from[1] + 7.0 * angle.sin()];
    let deep = SURFACE_MM - random.within(3.0, 8.0);
    let edge = |at: [f64; 2]| [[at[0], at[1], SURFACE_MM + 2.0], [at[0], at[1], deep]];
    swept_blade(edge(from), edge(to))
}

/// The first difference between what two worlds show.
fn difference(a: &Snapshot<'_>, b: &Snapshot<'_>) -> Option<String> {
    if a.epoch() != b.epoch() || a.state() != b.state() {
        let at = (0..a.state().len()).find(|&n| a.state()[n] != b.state()[n]);
        return Some(format!("epochs {} and {}, first byte of the state that differs {at:?}", a.epoch(), b.epoch()));
    }
    let bricks = || 0..a.layout().count() as u32;
    // causes before effects: what the engine holds, then what is drawn
    for id in bricks() {
        let bits = |d: Option<&[f32; DISPLACEMENT_LEN]>| d.map(|d| d.map(f32::to_bits));
        if bits(a.displacement(id)) != bits(b.displacement(id)) {
            return Some(format!("displacement of brick {id}"));
        }
        if bits(a.channel::<Plastic>(id)) != bits(b.channel::<Plastic>(id)) {
            return Some(format!("plastic part of brick {id}"));
        }
        if a.channel::<Cuts>(id) != b.channel::<Cuts>(id) {
            return Some(format!("cuts of brick {id}"));
        }
    }
    for id in bricks() {
        let (x, y) = (a.brick(id), b.brick(id));
        if let Some(n) = (0..x.voxels.len()).find(|&n| x.voxels[n] != y.voxels[n]) {
            return Some(format!("brick {id}, stored voxel {n}: {} and {}", x.voxels[n], y.voxels[n]));
        }
        if x.cells != y.cells {
            return Some(format!("skip cells of brick {id}"));
        }
    }
    None
}

/// What happened.
#[derive(Debug, Default)]
struct Tally {
    commits: u64,
    relaxations: u64,
    cuts: u64,
    undos: u64,
    /// between steps
    restarts: u64,
    /// at a point, before the commit was visible
    deaths_before: u64,
    /// at a point, after it was
    deaths_after: u64,
    /// points at which somebody died
    points: std::collections::BTreeSet<&'static str>,
}

fn run(scene: &Scene, seed: u64, wanted: u64) -> Tally {
    let (mut whole, mut broken) = (World::new(scene), World::new(scene));
    let (mut random, mut tally) = (Random(seed), Tally::default());
    let (in_recovery, in_commit) = Point::OF_WRITER.split_at(2);
    let (mut now_ns, mut sequence, mut shown, mut undos) = (1_000_000_000u64, 0, None, 0);
    let incises = scene.has_effect("incision");
    while tally.restarts + tally.deaths_before + tally.deaths_after < wanted {
        now_ns += 10_000_000 + random.below(50_000_000);
        // the page moves the threshold now and then
        if random.below(12) == 0 {
            shown = Some(random.within(-400.0, -200.0));
            for world in [&mut whole, &mut broken] {
                world.process().show(shown.expect("just set"));
            }
        }
        let work = match random.below(12) {
            0 | 1 => Work::Relax,
            2..=4 => Work::Settle,
            5 if incises => {
                undos += 1;
                Work::Undo(undos)
            }
            5 => Work::Cut(slit(&mut random)),
            6..=8 if incises => {
                sequence += 1;
                now_ns += random.below(2) * 600_000_000;
                Work::Incise(push(&mut random, sequence))
            }
            _ => {
                sequence += 1;
                Work::Push(push(&mut random, sequence))
            }
        };
        let done = whole.process().work(work, now_ns);
        tally.commits += u64::from(done.is_some());
        tally.relaxations += u64::from(done.is_some() && matches!(work, Work::Relax | Work::Settle));
        tally.cuts += u64::from(done.is_some() && matches!(work, Work::Cut(_) | Work::Incise(_)));
        tally.undos += u64::from(done.is_some() && matches!(work, Work::Undo(_)));

        if random.below(5) == 0 {
            broken.start(shown);
            tally.restarts += 1;
        }
        let (point, name) = in_commit[random.below(in_commit.len() as u64) as usize];
        if random.below(2) == 0 {
            // some points are passed once a commit, others once a brick or page
            let often = [Point::BrickCopied, Point::RecordBorn, Point::Superseding, Point::Reclaiming].contains(&point);
            die_here(point, if often { 1 + random.below(6) as u32 } else { 1 });
        }
        let before = broken.process().writer.epoch();
        let outcome = catch_unwind(AssertUnwindSafe(|| broken.process().work(work, now_ns)));
        live_on();
        match outcome {
            Ok(again) => assert_eq!(again.map(|d| d.moved_elements), done.map(|d| d.moved_elements)),
            Err(payload) => {
                let Some(Died(_)) = payload.downcast_ref() else { resume_unwind(payload) };
                tally.points.insert(name);
                // the successor dies as well now and then: while it recovers
                if random.below(2) == 0 {
                    let (point, name) = in_recovery[random.below(2) as usize];
                    die_here(point, if point == Point::Recovering { 1 + random.below(400) as u32 } else { 1 });
                    if catch_unwind(AssertUnwindSafe(|| broken.start(shown))).is_err() {
                        tally.points.insert(name);
                    }
                    live_on();
                }
                broken.start(shown);
                if broken.process().writer.epoch() == before {
                    tally.deaths_before += 1;
                    let again = broken.process().work(work, now_ns);
                    assert!(again.is_some_and(|d| matches!(d.outcome, CommitOutcome::Published { .. })), "what was lost can be done again");
                } else {
                    tally.deaths_after += 1;
                }
            }
        }
        if let Some(difference) = difference(&whole.snapshot(), &broken.snapshot()) {
            panic!("seed {seed}, after {work:?}: {difference}; {tally:?}");
        }
    }
    let world = broken.process();
    world.writer.audit().unwrap();
    tally
}

/// A scene whose tool takes tissue away.
fn incising() -> Scene {
    let mut scene = Scene::builtin_default();
    scene.effects.insert("incision".into(), EffectSetting::Switch(true));
    scene.incision.depth_mm = 0.0;
    scene
}

/// Voxels and skip cells of all bricks.
fn shown(world: &World) -> Vec<Brick> {
    let snapshot = world.snapshot();
    (0..snapshot.layout().count() as u32).map(|id| *snapshot.brick(id)).collect()
}

#[test]
fn strokes_are_taken_back_bit_for_bit_the_last_first_and_the_oldest_stay() {
    for pushes in [0, 4] {
        let mut world = World::new(&incising());
        let (mut random, mut now_ns) = (Random(9), 1_000_000_000u64);
        for n in 0..pushes {
            let message = push(&mut random, 1 + n);
            world.process().work(Work::Push(message), now_ns);
        }
        let mut before = Vec::new();
        // more than can be taken back, some of several boxes
        for n in 0..40u64 {
            now_ns += 1_000_000_000;
            let was = shown(&world);
            let mut taken = 0;
            for part in 0..1 + n % 3 {
                let message = push(&mut random, 100 + 10 * n + part);
                let done = world.process().work(Work::Incise(message), now_ns + part * 100_000_000);
                let done = done.filter(|done| matches!(done.outcome, CommitOutcome::Published { .. }));
                if let Some(done) = done {
                    // 4 voxels lie in two bricks along an axis at most, which their neighbours show in aprons; pressed tissue has more elements to a voxel
                    let most = if pushes == 0 { 64 } else { 512 };
                    assert!((1..=most).contains(&done.moved_elements) && done.bricks <= 27, "{} {}", done.moved_elements, done.bricks);
                    taken += done.moved_elements;
                }
            }
            if taken > 0 {
                before.push(was);
            }
            if n % 7 == 3 {
                world.start(None);
            }
        }
        assert!(before.len() > 32, "{}", before.len());
        for undo in 1..=35 {
            let done = world.process().work(Work::Undo(undo), now_ns).expect("it was asked for");
            assert_eq!(done.moved_elements > 0, undo <= 30, "{undo} with {pushes} pushes");
            if undo <= 30 {
                let was = before.pop().expect("as many as strokes");
                let now = shown(&world);
                let off = was.iter().zip(&now).flat_map(|(a, b)| a.voxels.iter().zip(&b.voxels)).map(|(a, b)| a.abs_diff(*b)).max();
                // displaced tissue is mapped again beside what is still away: within a hundredth of a voxel, at edges of 500 HU a voxel
                assert!(off <= Some(if pushes == 0 { 0 } else { 10 }), "{off:?} HU after undo {undo} with {pushes} pushes");
                assert!(pushes > 0 || was.iter().zip(&now).all(|(a, b)| a.cells == b.cells), "skip cells after undo {undo}");
            }
            if undo % 9 == 4 {
                world.start(None);
            }
        }
        // asked for once, done once, whoever is there
        world.start(None);
        assert!(world.process().work(Work::Undo(35), now_ns).is_none());
    }
}

#[test]
fn an_incision_makes_its_box_void_and_touches_nothing_else() {
    let mut scene = incising();
    let mut world = World::new(&scene);
    let rest = shown(&world);
    let message = |at: [f64; 3], depth_mm: f64| ToolMove {
        stamp: Stamp { time_ns: 1, sequence: 1, incarnation: 1 },
        tip_mm: [at[0], at[1], at[2] + 2.0],
        outside_mm: [at[0], at[1], 60.0],
        contact_mm: at,
        normal: [0.0, 0.0, 1.0],
        depth_mm,
        radius_mm: 2.0,
    };
    // centre of voxels 10..=13, 20..=23, 16..=19
    let at = [11.5, 21.5, 17.5 * SPACING[2]];
    let done = world.process().work(Work::Incise(message(at, 1.0)), 1).expect("tissue is there");
    assert_eq!(done.moved_elements, 64);
    let now = shown(&world);
    let layout = *world.snapshot().layout();
    let mut changed = 0;
    for (id, (a, b)) in rest.iter().zip(&now).enumerate() {
        let first = layout.first_voxel(id as u32);
        for (n, (x, y)) in a.voxels.iter().zip(&b.voxels).enumerate() {
            // stored with an apron of one below
            let (row, slice) = (maille_volume::brick::ROW, maille_volume::brick::SLICE);
            let p = [n % row, n % slice / row, n / slice];
            let voxel: [isize; 3] = std::array::from_fn(|c| (first[c] + p[c]) as isize - 1);
            let inside = (0..3).all(|c| ([10, 20, 16][c]..=[13, 23, 19][c]).contains(&voxel[c]));
            assert_eq!(*y, if inside { -1000 } else { *x }, "voxel {voxel:?} of brick {id}");
            changed += usize::from(inside);
        }
    }
    assert!(changed >= 64);
    let again = world.process().work(Work::Incise(message(at, 1.0)), 2);
    assert!(again.is_none(), "nothing is left there");
    assert!(world.process().work(Work::Incise(message([11.5, 21.5, 42.0 * SPACING[2]], 1.0)), 3).is_none(), "air");
    assert!(world.process().work(Work::Incise(message([-9.0, 21.5, 10.0], 1.0)), 4).is_none(), "outside");
    // the ball of bone around (34, 20, 20) stays where the blade does not go into it
    scene.incision.hardest_hu = 300.0;
    scene.incision.depth_mm = 0.5;
    let mut world = World::new(&scene);
    assert!(world.process().work(Work::Incise(message([34.0, 20.0, 20.0], 1.0)), 1).is_none(), "bone");
    assert!(world.process().work(Work::Incise(message(at, 0.3)), 1).is_none(), "too light");
}

#[test]
fn a_restart_anywhere_changes_no_bit_of_what_follows() {
    let wanted = number("MAILLE_RESTARTS", 80);
    let seed = number("MAILLE_SEED", 1);
    let mut sphere = Scene::builtin_default();
    sphere.deformation.pins = Pins::Sphere;
    let mut shaped = Scene::builtin_default();
    shaped.effects.insert("object-shape".into(), EffectSetting::Switch(true));
    let scenes = [
        ("eight elements", Scene::builtin_default()),
        ("a sphere", sphere),
        ("links through tissue only", shaped),
        ("incisions", incising()),
    ];
    for (n, (name, scene)) in scenes.into_iter().enumerate() {
        let tally = run(&scene, seed + n as u64, wanted);
        println!(
            "{name}: {} commits ({} of relaxation, {} cuts) the same bit for bit through {} restarts between steps, {} deaths before the commit and {} after \
             it, at {} points: {:?}",
            tally.commits,
            tally.relaxations,
            tally.cuts,
            tally.restarts,
            tally.deaths_before,
            tally.deaths_after,
            tally.points.len(),
            tally.points
        );
        assert!(tally.undos > 0 || name != "incisions", "{tally:?}");
        assert!(tally.commits > wanted / 2 && tally.relaxations > wanted / 20 && tally.cuts > 0, "{tally:?}");
        assert!(tally.deaths_before > wanted / 6 && tally.deaths_after > wanted / 12 && tally.points.len() >= 12, "{tally:?}");
    }
}

/// The test itself can fail: a successor that forgets one thing is found.
#[test]
fn a_successor_that_forgets_something_is_found() {
    let scene = Scene::builtin_default();
    let (mut whole, mut broken) = (World::new(&scene), World::new(&scene));
    let mut random = Random(5);
    let step = |world: &mut World, message: ToolMove| world.process().work(Work::Push(message), message.stamp.time_ns).is_some();
    for n in 1..6 {
        let message = push(&mut random, n);
        assert_eq!(step(&mut whole, message), step(&mut broken, message));
    }
    assert_eq!(difference(&whole.snapshot(), &broken.snapshot()), None);
    broken.start(None);
    // as if displacements had not been in the transaction
    broken.process().engine = Engine::new(&scene, &volume().info, Untimed);
    let message = push(&mut random, 7);
    step(&mut whole, message);
    step(&mut broken, message);
    assert!(difference(&whole.snapshot(), &broken.snapshot()).is_some());
}
