//! Hard cases of the volumetric implicit function, and of incisions into it.

use crate::{
    Case, Deed, Digest, Invariant, Seen, at_least, at_most, hard_cases,
    made::{Random, volume},
};
use maille_vif::{
    BRICK_LEAVES_BYTES, Incision, KeptOctree, LocalSurface, Neighbourhood, Octree, Options, Spline, Tolerance, Tool, Voxels, Window, carve,
};
use maille_volume::{BrickId, BrickSource, BrickedVolume};

/// The bound on a leaf's error is ε₀ itself: what is measured is by how much it is passed. Values of the spline are sums of 64 coefficients in
/// f32, of some thousand HU each.
const HOLDS: &[Invariant] = &[
    at_most("a leaf's RMS error above what was asked", "HU", 1e-9),
    at_most("values, gradients, normals not finite", "", 0.0),
    at_most("values beyond those of the coefficients", "HU", 0.02),
    at_most("length of a normal, from 1", "", 1e-9),
    at_most("surfaces found where there is none", "", 0.0),
    at_most("places where what was refitted or reloaded is not a fresh one", "", 0.0),
];

#[derive(Default)]
struct Bench {
    worst: [f64; 6],
    /// finite values read from octrees, surfaces found, incisions that took something away, bytes refused or read
    did: [f64; 4],
    digest: Option<Digest>,
}

/// What each case did at least, of the four of [`Bench`].
const fn did(read: f64, found: f64, carved: f64, opened: f64) -> [Deed; 4] {
    [
        at_least("values that octrees gave", "", read),
        at_least("surfaces that were found", "", found),
        at_least("incisions that took something away", "", carved),
        at_least("damaged bytes that were refused, or read", "", opened),
    ]
}

impl Bench {
    fn worse(&mut self, n: usize, value: f64) {
        self.worst[n] = if value <= self.worst[n] { self.worst[n] } else { value };
    }

    fn digest(&mut self) -> &mut Digest {
        self.digest.get_or_insert_with(Digest::new)
    }

    /// The octree of a volume within tolerances, ε₀ = 0 among them, and its error measured voxel by voxel.
    fn fit(&mut self, bricks: &BrickedVolume) {
        for rms in [0.0, 10.0, 1e6] {
            let octree = Octree::build(bricks, options(rms)).expect("a volume that can be fitted");
            let measured = octree.measure(bricks);
            self.worse(0, measured.worst_rms - rms);
            self.digest().floats([measured.worst_rms, measured.rms, octree.size().bytes() as f64]);
            let bytes = octree.to_bytes();
            let kept = KeptOctree::open(&bytes, bricks.info()).expect("as it was written");
            let live = kept.live(|_| None);
            for at in places(bricks) {
                if let Some(value) = octree.value(at) {
                    self.did[0] += f64::from(u8::from(value.is_finite()));
                    self.worst[1] += f64::from(u8::from(!value.is_finite()));
                }
                self.worst[5] += f64::from(u8::from(live.jet(at) != octree.jet(at)));
            }
        }
    }

    /// Values and the local surface at 300 HU all over a volume; `none` where it has no such surface.
    fn touch(&mut self, bricks: &BrickedVolume, none: bool) {
        for window in [Window::One, Window::Five, Window::Nine] {
            for at in places(bricks) {
                let mut spline = Spline::default();
                spline.load_around(&Voxels(bricks), window, at, [4.0; 3]);
                let [low, high] = spline.range();
                let (value, gradient) = spline.sample(at).expect("loaded around it");
                self.worst[1] += [value, gradient.x, gradient.y, gradient.z].iter().filter(|v| !v.is_finite()).count() as f64;
                self.worse(2, (low - value).max(value - high));
                self.digest().floats([value, gradient.x, gradient.y, gradient.z]);
                let Ok(surface) = LocalSurface::find(&spline, &bricks.info().grid, 300.0, at, 1.5) else { continue };
                self.did[1] += 1.0;
                self.worst[1] += surface.point.iter().chain(&surface.normal).filter(|v| !v.is_finite()).count() as f64;
                self.worse(3, (surface.normal.iter().map(|v| v * v).sum::<f64>().sqrt() - 1.0).abs());
                self.worst[4] += f64::from(u8::from(none));
                self.digest().floats(surface.point.into_iter().chain(surface.normal));
            }
        }
    }

    fn seen(mut self) -> Seen {
        let digest = self.digest().value();
        Seen { worst: self.worst.to_vec(), did: self.did.to_vec(), digest }
    }
}

fn options(rms: f64) -> Options {
    Options { tolerance: Tolerance::Rms(rms), ..Options::default() }
}

/// Continuous indices all over a volume, its border and beyond it.
fn places(bricks: &BrickedVolume) -> impl Iterator<Item = [f64; 3]> + use<> {
    let size = bricks.info().grid.size;
    let mut random = Random(11);
    (0..60).map(move |n| size.map(|s| if n < 8 { random.below(2) as f64 * (s - 1) as f64 } else { random.within(-1.0, s as f64) }))
}

fn constant_values() -> Seen {
    let mut bench = Bench::default();
    for hu in [-1024.0, 0.0, 3071.0] {
        let bricks = volume([40; 3], [1.0; 3], |_| hu);
        bench.fit(&bricks);
        bench.touch(&bricks, true);
    }
    bench.seen()
}

fn a_step() -> Seen {
    let mut bench = Bench::default();
    for axis in 0..3 {
        let bricks = volume([40; 3], [1.0, 1.0, 2.0], |v| if v[axis] < 20 { -1000.0 } else { 2000.0 });
        bench.fit(&bricks);
        bench.touch(&bricks, false);
    }
    bench.seen()
}

fn sheets_of_one_voxel() -> Seen {
    let mut bench = Bench::default();
    for axis in 0..3 {
        let bricks = volume([36; 3], [1.0; 3], |v| if v[axis] % 6 == 3 { 1500.0 } else { -1000.0 });
        bench.fit(&bricks);
        bench.touch(&bricks, false);
    }
    bench.seen()
}

fn odd_sizes() -> Seen {
    let mut bench = Bench::default();
    let mut random = Random(5);
    for size in [[1, 1, 1], [2, 3, 1], [17, 33, 5], [65, 9, 31]] {
        let bricks = volume(size, [0.3, 1.0, 5.0], |v| random.within(-1000.0, 1000.0) + 20.0 * v[0] as f64);
        bench.fit(&bricks);
        bench.touch(&bricks, false);
    }
    bench.seen()
}

/// Cuts of all sizes where a tool stands; the function around it and the octree follow, and are what they would be built afresh.
fn cuts(bench: &mut Bench, centers: &[[f64; 3]], window: Window) {
    let mut random = Random(23);
    let mut bricks = volume([50, 41, 37], [1.0, 1.0, 1.5], |v| 400.0 + 10.0 * v[2] as f64 + random.within(-40.0, 40.0));
    let original: Vec<i16> = stored(&bricks);
    let mut octree = Octree::build(&bricks, options(10.0)).expect("a volume that can be fitted");
    let mut near = Neighbourhood::new(&bricks, window, 4.0).expect("four bricks are enough");
    let mut carved = Vec::new();
    for (epoch, &center) in (1u64..).zip(centers) {
        near.follow(&Voxels(&bricks), &bricks, epoch, center);
        let tool = if epoch % 2 == 0 { Tool::Ball { radius_mm: 3.2 } } else { Tool::Box([4; 3]) };
        let Some(incision) = Incision::new(&bricks.info().grid, tool, center) else { continue };
        let (low, high) = incision.bounds();
        let before = stored(&bricks);
        carved.push(carve(&mut bricks, &incision, -1000.0));
        bench.did[2] += f64::from(u8::from(before != stored(&bricks)));
        octree.refit(&bricks, low, high);
        // bricks on the heap have no versions of their own: a tool elsewhere and back is what makes it look again
        near.follow(&Voxels(&bricks), &bricks, epoch, center.map(|v| v + 20.0));
        near.follow(&Voxels(&bricks), &bricks, epoch + 1, center);
        let mut fresh = Neighbourhood::new(&bricks, window, 4.0).expect("as before");
        fresh.follow(&Voxels(&bricks), &bricks, epoch, center);
        for at in [center, center.map(|v| v + 0.7), center.map(|v| v - 1.2)] {
            let (a, b) = (near.spline().value(at), fresh.spline().value(at));
            bench.worst[5] += f64::from(u8::from(a.map(f64::to_bits) != b.map(f64::to_bits)));
            bench.worst[1] += f64::from(u8::from(!a.is_some_and(f64::is_finite)));
            bench.digest().floats(a);
        }
    }
    let fresh = Octree::build(&bricks, options(10.0)).expect("as before");
    bench.worst[5] += f64::from(u8::from(octree != fresh));
    bench.worse(0, octree.measure(&bricks).worst_rms - 10.0);
    bench.did[0] += centers.iter().filter(|&&at| octree.value(at).is_some_and(f64::is_finite)).count() as f64;
    carved.into_iter().rev().for_each(|c| c.undo(&mut bricks));
    bench.worst[5] += stored(&bricks).iter().zip(&original).filter(|(a, b)| a != b).count() as f64;
}

fn stored(bricks: &BrickedVolume) -> Vec<i16> {
    (0..bricks.layout().count()).flat_map(|id| bricks.brick(id as BrickId).voxels).collect()
}

fn commits_under_the_tip() -> Seen {
    let mut bench = Bench::default();
    for window in [Window::One, Window::Five, Window::Nine] {
        cuts(&mut bench, &[[20.0, 20.0, 18.0], [21.5, 20.0, 18.0], [23.0, 21.0, 17.0], [24.2, 22.0, 16.5]], window);
    }
    bench.seen()
}

fn at_the_border() -> Seen {
    let mut bench = Bench::default();
    // the last two meet no voxel, and nothing happens
    let centers = [[0.0, 0.0, 0.0], [49.0, 40.0, 36.0], [-1.0, 20.0, 18.0], [25.0, 42.0, 18.0], [-30.0, 0.0, 0.0], [25.0, 20.0, 90.0]];
    cuts(&mut bench, &centers, Window::Five);
    bench.seen()
}

fn the_same_place_again() -> Seen {
    let mut bench = Bench::default();
    cuts(&mut bench, &[[15.7, 16.2, 16.0]; 6], Window::Five);
    bench.seen()
}

/// An octree's region that another program has written into: refused, or read without harm; leaves of a brick that are none are not taken.
fn damaged_bytes() -> Seen {
    let mut bench = Bench::default();
    let mut random = Random(23);
    let bricks = volume([70, 40, 35], [1.0; 3], |v| 300.0 * (v[0] as f64 * 0.3).sin() + 10.0 * v[1] as f64);
    let octree = Octree::build(&bricks, options(10.0)).expect("a volume that can be fitted");
    let bytes = octree.to_bytes();
    for round in 0..200 {
        let mut wrong = bytes.clone();
        for _ in 0..3 {
            // the head and the tables are the small part: there every other time
            let at = random.below(if round % 2 == 0 { 2000.min(wrong.len()) } else { wrong.len() });
            wrong[at] = random.below(256) as u8;
        }
        if let Ok(kept) = KeptOctree::open(&wrong, bricks.info()) {
            let live = kept.live(|_| None);
            let read = places(&bricks).filter(|&at| live.jet(at).is_some()).count();
            bench.digest().add(read as u64);
            bench.did[3] += f64::from(u8::from(read > 0));
        } else {
            bench.did[3] += 1.0;
        }
    }
    let kept = KeptOctree::open(&bytes, bricks.info()).expect("as it was written");
    let rubbish: Box<[u8; BRICK_LEAVES_BYTES]> = Box::new(std::array::from_fn(|n| if n == 0 { 1 } else { 0xff }));
    let live = kept.live(|_| Some(&*rubbish));
    for at in places(&bricks) {
        bench.did[0] += f64::from(u8::from(octree.jet(at).is_some()));
        bench.worst[5] += f64::from(u8::from(live.jet(at) != octree.jet(at)));
    }
    bench.seen()
}

const fn case(name: &'static str, effects: &'static [&'static str], deeds: &'static [Deed], run: fn() -> Seen) -> Case {
    Case { engine: "surface", name, effects, invariants: HOLDS, deeds, run }
}

pub(crate) const CASES: &[Case] = &[
    case("constant values", &["smooth-surface", "octree"], &did(400.0, 0.0, 0.0, 0.0), constant_values),
    case("a step", &["smooth-surface"], &did(400.0, 15.0, 0.0, 0.0), a_step),
    case("sheets of one voxel", &["smooth-surface"], &did(400.0, 15.0, 0.0, 0.0), sheets_of_one_voxel),
    case("odd sizes", &["smooth-surface", "octree"], &did(400.0, 15.0, 0.0, 0.0), odd_sizes),
    case("commits under the tip", &["smooth-surface"], &did(9.0, 0.0, 9.0, 0.0), commits_under_the_tip),
    case("at the border", &["incision"], &did(2.0, 0.0, 2.0, 0.0), at_the_border),
    case("the same place again", &["incision"], &did(4.0, 0.0, 1.0, 0.0), the_same_place_again),
    case("damaged bytes", &["octree"], &did(40.0, 0.0, 0.0, 150.0), damaged_bytes),
];

hard_cases! {
    constant_values => 0,
    a_step => 1,
    sheets_of_one_voxel => 2,
    odd_sizes => 3,
    commits_under_the_tip => 4,
    at_the_border => 5,
    the_same_place_again => 6,
    damaged_bytes => 7,
}
