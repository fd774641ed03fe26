//! Hard cases of ChainMail and the mapper.

use crate::{
    Case, Deed, Digest, Invariant, Seen, at_least, at_most, hard_cases,
    made::{BAD, Random, volume, voxels},
};
use maille_chainmail::{
    Capsule, ChainMail, ChangedRegion, LinkModel, Metric, Motion, Pin, PlasticBand, PushOutcome, RelaxOptions, Relaxed, Slender, Tissue,
    elements_in_sphere, enclosing_elements, swept_blade,
};
use maille_mapper::{MapOptions, Mapper};
use maille_volume::{BrickSource, BrickedVolume};

/// What must hold after every push, cut and batch, whatever came before. Links and bounds: a thousandth of the limit is for rounding of f32.
const HOLDS: &[Invariant] = &[
    at_most("link beyond 1.001 of its limit", "mm", 1e-6),
    at_most("element beyond its movement limit", "mm", 1e-6),
    at_most("bone moved", "mm", 0.0),
    at_most("displacements not finite", "", 0.0),
    at_most("mapped value outside the rest's range", "HU", 0.0),
];

/// The same, and what comes to rest after relaxation.
const HOLDS_AND_RETURNS: &[Invariant] = &[
    at_most("link beyond 1.001 of its limit", "mm", 1e-6),
    at_most("element beyond its movement limit", "mm", 1e-6),
    at_most("bone moved", "mm", 0.0),
    at_most("displacements not finite", "", 0.0),
    at_most("mapped value outside the rest's range", "HU", 0.0),
    at_most("displacement left after relaxation", "mm", 1e-3),
];

/// The same, and that a process which starts anew goes on with the same bits.
const HOLDS_AND_RESUMES: &[Invariant] = &[
    at_most("link beyond 1.001 of its limit", "mm", 1e-6),
    at_most("element beyond its movement limit", "mm", 1e-6),
    at_most("bone moved", "mm", 0.0),
    at_most("displacements not finite", "", 0.0),
    at_most("mapped value outside the rest's range", "HU", 0.0),
    at_most("elements that differ after a restart", "", 0.0),
];

/// The same, and that what was carried by whole voxels is seen where it was carried to.
const HOLDS_AND_CARRIES: &[Invariant] = &[
    at_most("link beyond 1.001 of its limit", "mm", 1e-6),
    at_most("element beyond its movement limit", "mm", 1e-6),
    at_most("bone moved", "mm", 0.0),
    at_most("displacements not finite", "", 0.0),
    at_most("mapped value outside the rest's range", "HU", 0.0),
    // values differ by up to 2800 HU from voxel to voxel, and a position is found within a thousandth of one
    at_most("mapped value away from the one that was carried there", "HU", 10.0),
];

/// What each case did at least: pushes that moved what they pinned, elements that lay elsewhere when it was looked at, voxels that were rewritten, links
/// that were cut, elements that went back by themselves.
const fn did(pushes: f64, elements: f64, voxels: f64, links: f64, relaxed: f64) -> [Deed; 5] {
    [
        at_least("pushes that moved what they pinned", "", pushes),
        at_least("elements that lay elsewhere", "", elements),
        at_least("voxels that were rewritten", "", voxels),
        at_least("links that were cut", "", links),
        at_least("elements that relaxation moved", "", relaxed),
    ]
}

/// The same, with something more that is asked of it.
const fn did_and(what: &'static str, least: f64, [a, b, c, d, e]: [Deed; 5]) -> [Deed; 6] {
    [a, b, c, d, e, at_least(what, "", least)]
}

/// A patient, what is done to it, and the worst that was seen.
struct Bench {
    rest: BrickedVolume,
    mail: ChainMail,
    mapper: Mapper,
    deformed: BrickedVolume,
    random: Random,
    worst: [f64; 5],
    /// as [`did`] has them
    did: [f64; 5],
    digest: Digest,
}

impl Bench {
    fn new(rest: BrickedVolume, tissue: Tissue) -> Self {
        Self {
            mail: ChainMail::new(rest.info(), tissue),
            deformed: rest.clone(),
            rest,
            mapper: Mapper::new(),
            random: Random(7),
            // what is left to a limit is shown, too: as what is below 0
            worst: [f64::NEG_INFINITY, f64::NEG_INFINITY, 0.0, 0.0, 0.0],
            did: [0.0; 5],
            digest: Digest::new(),
        }
    }

    fn size(&self) -> [usize; 3] {
        self.mail.layout().size
    }

    fn pins_around(&mut self, center: [usize; 3], radius: f64, by: [f64; 3]) -> Vec<Pin> {
        let grid = &self.rest.info().grid;
        let at = grid.world_from_index(center.map(|v| v as f64));
        let motion = Motion::By(by.map(|v| v as f32));
        elements_in_sphere(grid, at, radius).into_iter().map(|voxel| Pin { voxel, motion }).collect()
    }

    fn push(&mut self, pins: &[Pin]) {
        let outcome = self.push_unmapped(pins);
        let said = outcome.admitted.iter().chain(&outcome.refused_mm);
        self.worst[3] += said.filter(|v| !v.is_finite()).count() as f64;
        self.map(&outcome.region);
    }

    /// A push that nobody looks at; whether it did anything is asked of the elements, not of what it says.
    fn push_unmapped(&mut self, pins: &[Pin]) -> PushOutcome {
        let size = self.size();
        let inside = |pin: &&Pin| (0..3).all(|c| pin.voxel[c] < size[c]);
        let before: Vec<[f32; 3]> = pins.iter().filter(inside).map(|pin| self.mail.displacement(pin.voxel)).collect();
        let outcome = self.mail.push(&self.rest, pins);
        let moved = pins.iter().filter(inside).zip(before).any(|(pin, before)| self.mail.displacement(pin.voxel) != before);
        self.did[0] += f64::from(u8::from(moved));
        outcome
    }

    fn relax(&mut self, options: &RelaxOptions, tools: &[Capsule], stop: &dyn Fn() -> bool) -> Relaxed {
        let relaxed = self.mail.relax_elastic(&self.rest, options, tools, stop);
        self.did[4] += relaxed.moved as f64;
        relaxed
    }

    /// Cuts, and counts links that are cut and were not.
    fn cut(&mut self, with: impl FnOnce(&mut ChainMail, &BrickedVolume) -> ChangedRegion) -> ChangedRegion {
        let links = |mail: &ChainMail| {
            voxels(mail.layout().size).flat_map(|v| (0..3).map(move |axis| (v, axis))).filter(|&(v, axis)| mail.is_cut(v, axis)).count()
        };
        let before = links(&self.mail);
        let region = with(&mut self.mail, &self.rest);
        self.did[3] += links(&self.mail) as f64 - before as f64;
        region
    }

    /// A push of random place and size.
    fn push_anywhere(&mut self, most_mm: f64) {
        let size = self.size();
        let center = size.map(|n| self.random.below(n));
        let by = [0; 3].map(|_| self.random.within(-most_mm, most_mm));
        let radius = self.random.within(0.6, 2.5) * self.rest.info().grid.min_spacing();
        let pins = self.pins_around(center, radius, by);
        self.push(&pins);
    }

    fn map(&mut self, region: &ChangedRegion) {
        self.mapper.remap(&self.rest, &self.mail, region, &mut self.deformed, &MapOptions::default());
    }

    /// Looks at every element and every voxel.
    fn look(&mut self) {
        let size = self.size();
        let infinite = |u: [f32; 3]| u.iter().filter(|v| !v.is_finite()).count() as f64;
        let (mut low, mut high) = (f64::INFINITY, f64::NEG_INFINITY);
        let mut deformed: Vec<f64> = Vec::new();
        let (mut elsewhere, mut rewritten) = (0, 0);
        for v in voxels(size) {
            let u = self.mail.displacement(v);
            self.worst[3] += infinite(u);
            self.digest.floats(u.map(f64::from));
            elsewhere += usize::from(u.iter().any(|c| c.abs() > 0.01));
            let (_, bound) = self.mail.limits(&self.rest, v);
            for c in u {
                let over = f64::from(c.abs()) - 1.001 * f64::from(bound);
                if bound == 0.0 {
                    self.worst[2] = self.worst[2].max(f64::from(c.abs()));
                } else {
                    self.worst[1] = self.worst[1].max(over);
                }
            }
            for axis in 0..3 {
                if v[axis] + 1 == size[axis] {
                    continue;
                }
                let mut next = v;
                next[axis] += 1;
                let other = self.mail.displacement(next);
                for (c, [over, under]) in self.mail.directed_links(&self.rest, v, axis).into_iter().enumerate() {
                    let difference = f64::from(u[c]) - f64::from(other[c]);
                    self.worst[0] = self.worst[0].max(difference - 1.001 * f64::from(over)).max(-difference - 1.001 * f64::from(under));
                }
            }
            let value = f64::from(self.rest.voxel(v[0], v[1], v[2]));
            (low, high) = (low.min(value), high.max(value));
            deformed.push(f64::from(self.deformed.voxel(v[0], v[1], v[2])));
            rewritten += usize::from(deformed.last() != Some(&value));
        }
        // most of each that was ever seen
        self.did[1] = self.did[1].max(elsewhere as f64);
        self.did[2] = self.did[2].max(rewritten as f64);
        // where tissue leaves a gap there is air
        low = low.min(MapOptions::default().void_hu);
        for value in deformed {
            self.worst[4] = self.worst[4].max(low - value).max(value - high);
            self.digest.add(value as i64 as u64);
        }
    }

    fn seen(self, more: &[f64]) -> Seen {
        Seen { worst: self.worst.iter().chain(more).copied().collect(), did: self.did.to_vec(), digest: self.digest.value() }
    }

    /// The same, with one more deed.
    fn seen_and(self, more: &[f64], deed: f64) -> Seen {
        let mut seen = self.seen(more);
        seen.did.push(deed);
        seen
    }

    /// Largest displacement [mm].
    fn largest(&self) -> f64 {
        voxels(self.size()).flat_map(|v| self.mail.displacement(v)).fold(0.0, |m, u| m.max(f64::from(u.abs())))
    }

    /// Does the same to a mail that was restored from what a commit stores, and counts elements that differ.
    fn differs_after_restart(&mut self, then: impl Fn(&mut ChainMail, &BrickedVolume)) -> f64 {
        let mut again = ChainMail::new(self.rest.info(), *self.mail.tissue());
        again.set_link_model(*self.mail.link_model());
        again.set_plasticity(BANDS.to_vec());
        self.mail.set_plasticity(BANDS.to_vec());
        for id in self.mail.loaded_bricks() {
            if let Some(cuts) = self.mail.cut_brick(id) {
                again.restore_cut_brick(id, cuts);
            }
        }
        for id in self.mail.loaded_bricks() {
            again.restore_brick(id, self.mail.displacement_brick(id).expect("it is loaded"));
            if let Some(plastic) = self.mail.plastic_brick(id) {
                again.restore_plastic_brick(id, plastic);
            }
        }
        then(&mut self.mail, &self.rest);
        then(&mut again, &self.rest);
        let bits = |u: [f32; 3]| u.map(f32::to_bits);
        voxels(self.size()).filter(|&v| bits(self.mail.displacement(v)) != bits(again.displacement(v))).count() as f64
    }
}

const SIZE: [usize; 3] = [26, 22, 19];
const BONE: f64 = 2000.0;
const BANDS: [PlasticBand; 2] = [PlasticBand { from_hu: -500.0, fraction: 0.3 }, PlasticBand { from_hu: 500.0, fraction: 0.9 }];

fn tissue(offset: f64) -> Tissue {
    Tissue { offset: offset as f32, bone_hu: Some(BONE), movement_limit_mm: Some(6.0), ..Tissue::default() }
}

/// Densities at random from fat to nearly bone, voxel by voxel, and bone in lumps.
fn mixed(spacing: [f64; 3]) -> BrickedVolume {
    let mut random = Random(11);
    volume(SIZE, spacing, |[i, j, k]| if (i / 4 + j / 5 + k / 3).is_multiple_of(11) { 2500.0 } else { random.within(-900.0, 1900.0) })
}

/// One soft material, told apart voxel by voxel by a few HU, around a ball of bone.
fn ball_of_bone() -> BrickedVolume {
    volume(SIZE, [1.0, 1.2, 1.5], |[i, j, k]| {
        let d = [i as f64 - 13.0, j as f64 - 11.0, k as f64 - 9.0];
        if d.iter().map(|v| v * v).sum::<f64>() < 16.0 { 2500.0 } else { 40.0 + ((7 * i + 5 * j + 3 * k) % 9) as f64 }
    })
}

/// Two layers of tissue with air between, `gap` voxels wide, and air above.
fn walls(gap: usize) -> BrickedVolume {
    volume(SIZE, [1.0; 3], |[i, j, k]| {
        let air = k >= 16 || ((8..8 + gap).contains(&k) && (4..22).contains(&i) && (4..18).contains(&j));
        if air { -1000.0 } else { 40.0 + (i % 3) as f64 }
    })
}

fn stiff_beside_soft() -> Seen {
    let mut bench = Bench::new(mixed([1.0, 0.8, 1.3]), tissue(0.3));
    for n in 0..30 {
        bench.push_anywhere(4.0);
        if n % 10 == 9 {
            bench.look();
        }
    }
    bench.seen(&[])
}

fn bone_inside() -> Seen {
    let mut bench = Bench::new(ball_of_bone(), tissue(0.2));
    for by in [[0.0, 0.0, -9.0], [9.0, 0.0, 0.0], [-5.0, 5.0, 5.0], [0.0, -3.0, 0.0]] {
        for center in [[13, 11, 15], [6, 11, 9], [13, 4, 9], [13, 11, 9]] {
            let pins = bench.pins_around(center, 2.2, by);
            bench.push(&pins);
        }
        bench.look();
    }
    bench.seen(&[])
}

fn spacing_one_to_ten() -> Seen {
    let mut bench = Bench::new(mixed([0.5, 5.0, 1.0]), tissue(0.33));
    for _ in 0..20 {
        bench.push_anywhere(8.0);
    }
    bench.look();
    bench.seen(&[])
}

fn offsets_from_a_hundredth_to_nearly_one() -> Seen {
    let (mut worst, mut did) = ([f64::NEG_INFINITY; 5], [f64::INFINITY; 5]);
    let mut digest = Digest::new();
    for offset in [0.01, 0.1, 0.2, 0.33, 0.5, 0.99] {
        let mut bench = Bench::new(ball_of_bone(), tissue(offset));
        for _ in 0..8 {
            bench.push_anywhere(3.0);
        }
        bench.look();
        (0..5).for_each(|n| worst[n] = worst[n].max(bench.worst[n]));
        // of the offset that did least
        (0..5).for_each(|n| did[n] = did[n].min(bench.did[n]));
        digest.add(bench.digest.value());
    }
    Seen { worst: worst.to_vec(), did: did.to_vec(), digest: digest.value() }
}

fn back_and_forth() -> Seen {
    let rest = volume([13, 13, 13], [1.0; 3], |[i, j, _]| 40.0 + ((i + j) % 2) as f64);
    let mut bench = Bench::new(rest, Tissue { bone_hu: None, ..tissue(0.3) });
    let pin = |by: f32| [Pin { voxel: [6, 6, 6], motion: Motion::By([by, -by, 0.5 * by]) }];
    for n in 0..50_000 {
        // there and back by amounts that floats cannot hold exactly
        let by = 0.1 + 0.3 * (n % 7) as f32 / 7.0;
        bench.push_unmapped(&pin(by));
        bench.push_unmapped(&pin(-by));
    }
    bench.map(&bench.mail.displaced_region());
    bench.look();
    let options = RelaxOptions { sweeps: 64, ..RelaxOptions::default() };
    for _ in 0..200 {
        if bench.relax(&options, &[], &|| false).settled {
            break;
        }
    }
    let left = bench.largest();
    bench.seen(&[left])
}

fn at_the_border() -> Seen {
    let mut bench = Bench::new(ball_of_bone(), tissue(0.3));
    let size = bench.size();
    for n in 0..26usize {
        // all corners, edges and faces
        let corner: [usize; 3] = std::array::from_fn(|c| [0, size[c] / 2, size[c] - 1][n / 3usize.pow(c as u32) % 3]);
        for by in [[4.0, 4.0, 4.0], [-4.0, -4.0, -4.0]] {
            let pins = bench.pins_around(corner, 1.8, by);
            bench.push(&pins);
        }
    }
    bench.look();
    bench.seen(&[])
}

fn on_an_element_and_between_eight() -> Seen {
    let mut bench = Bench::new(mixed([1.0; 3]), tissue(0.25));
    let mut counts = 0.0;
    for at in [[12.0, 10.0, 9.0], [12.5, 10.5, 9.5], [12.0, 10.5, 9.0], [0.0; 3], [25.0, 21.0, 18.0], [11.999_999_999, 10.0, 9.0]] {
        let elements = enclosing_elements(&bench.rest.info().grid, at);
        counts += f64::from(u8::from(elements.is_empty() || elements.len() > 8));
        let pins: Vec<Pin> = elements.into_iter().map(|voxel| Pin { voxel, motion: Motion::By([1.5, -0.5, -1.0]) }).collect();
        bench.push(&pins);
    }
    bench.look();
    bench.worst[3] += counts;
    bench.seen(&[])
}

fn bad_moves() -> Seen {
    let mut bench = Bench::new(mixed([1.0; 3]), tissue(0.3));
    bench.push_anywhere(2.0);
    let good = [13, 11, 9];
    for bad in BAD.iter().map(|&v| v as f32).chain([0.0, -0.0, 1e6, -1e30, f32::MAX, f32::MIN_POSITIVE / 2.0]) {
        for c in 0..3 {
            let mut vector = [0.3f32; 3];
            vector[c] = bad;
            for motion in [Motion::By(vector), Motion::To(vector)] {
                bench.push(&[Pin { voxel: good, motion }]);
                bench.push(&[Pin { voxel: [good[0], 99, good[2]], motion }]);
            }
        }
    }
    bench.push(&[]);
    bench.look();
    bench.seen(&[])
}

/// Nothing moves; the same pushes move the same voxels where they count as soft.
fn all_bone() -> Seen {
    let [bone, soft] = [Some(BONE), None].map(|bone_hu| {
        let mut bench = Bench::new(volume(SIZE, [1.0; 3], |[i, ..]| 2600.0 + (i % 2) as f64), Tissue { bone_hu, ..tissue(0.3) });
        for _ in 0..10 {
            bench.push_anywhere(5.0);
        }
        bench.look();
        bench
    });
    let digest = bone.digest.value();
    Seen { worst: bone.worst.to_vec(), did: soft.did.to_vec(), digest }
}

/// A block of elements goes by whole voxels, and with it what lies in it.
fn a_block_carried_by_whole_voxels() -> Seen {
    let rest = volume(SIZE, [1.0; 3], |[i, j, k]| (((i * 7 + j * 11 + k * 13) % 29) as f64) * 50.0 - 700.0);
    let mut bench = Bench::new(rest, Tissue { bone_hu: None, movement_limit_mm: None, ..tissue(0.99) });
    let (low, high, by) = ([9, 8, 7], [17, 14, 12], [3, -2, 1]);
    let block = |margin: usize| voxels(SIZE).filter(move |v| (0..3).all(|c| (low[c] + margin..=high[c] - margin).contains(&v[c])));
    let motion = Motion::By(by.map(|v| v as f32));
    let pins: Vec<Pin> = block(0).map(|voxel| Pin { voxel, motion }).collect();
    bench.push(&pins);
    bench.look();
    // a voxel within the block, where all around it goes the same way
    let (mut away, mut carried) = (0.0f64, 0);
    for v in block(1) {
        let to = [0, 1, 2].map(|c| v[c].wrapping_add_signed(by[c]));
        let [was, is] = [bench.rest.voxel(v[0], v[1], v[2]), bench.deformed.voxel(to[0], to[1], to[2])].map(f64::from);
        away = away.max((was - is).abs());
        carried += usize::from(is != f64::from(bench.rest.voxel(to[0], to[1], to[2])));
    }
    bench.seen_and(&[away], carried as f64)
}

fn two_tools() -> Seen {
    let mut bench = Bench::new(mixed([1.0; 3]), tissue(0.3));
    for n in 0..12 {
        // towards each other, apart, and one through the other's place
        let by = [[3.0, 0.0, 0.0], [-3.0, 0.0, 0.0], [0.0, 4.0, -2.0]][n % 3];
        let mut pins = bench.pins_around([8 + n / 3, 11, 9], 1.8, by);
        pins.extend(bench.pins_around([14 - n / 4, 11, 9], 1.8, by.map(|v: f64| -v)));
        bench.push(&pins);
    }
    bench.look();
    bench.seen(&[])
}

fn links_of_any_stiffness() -> Seen {
    let rest = mixed([1.0, 1.0, 2.0]);
    let mut bench = Bench::new(rest, Tissue { movement_limit_mm: None, bone_hu: None, ..tissue(0.33) });
    for _ in 0..12 {
        bench.push_anywhere(3.0);
    }
    bench.look();
    let options = RelaxOptions { sweeps: 200, ..RelaxOptions::default() };
    for _ in 0..400 {
        let relaxed = bench.relax(&options, &[], &|| false);
        bench.map(&relaxed.region);
        if relaxed.settled {
            break;
        }
    }
    bench.look();
    let left = bench.largest();
    bench.seen(&[left])
}

fn a_push_in_the_middle_of_relaxation() -> Seen {
    let mut bench = Bench::new(mixed([1.0; 3]), tissue(0.3));
    let tool = Capsule { a: [13.0, 11.0, 9.0], b: [13.0, 11.0, 30.0], radius_mm: 2.5 };
    for n in 0..15u32 {
        bench.push_anywhere(3.0);
        let asked = std::cell::Cell::new(0);
        // stopped at another place each time
        let stop = || {
            asked.set(asked.get() + 1);
            asked.get() > n % 5
        };
        let options = RelaxOptions { tools_hold_hu: Some(-500.0), ..RelaxOptions::default() };
        let relaxed = bench.relax(&options, &[tool], &stop);
        bench.map(&relaxed.region);
        if n % 5 == 4 {
            bench.look();
        }
    }
    bench.seen(&[])
}

fn restart_half_way() -> Seen {
    let mut bench = Bench::new(mixed([1.0; 3]), tissue(0.3));
    bench.mail.set_plasticity(BANDS.to_vec());
    for _ in 0..6 {
        bench.push_anywhere(3.0);
    }
    let blade = swept_blade([[4.0, 10.0, 9.0], [20.0, 10.0, 9.0]], [[4.0, 10.0, 14.0], [20.0, 10.0, 14.0]]);
    let cut = bench.cut(|mail, rest| mail.cut_triangles(rest, &blade));
    bench.map(&cut);
    let differ = bench.differs_after_restart(|mail, rest| {
        let relaxed = mail.relax_elastic(rest, &RelaxOptions { sweeps: 3, ..RelaxOptions::default() }, &[], &|| false);
        assert!(relaxed.moved > 0, "it had somewhere to go");
        mail.push(rest, &[Pin { voxel: [12, 11, 10], motion: Motion::By([0.7, -1.1, 2.0]) }]);
        mail.relax(0.5, 1e-3);
    });
    let relaxed = bench.relax(&RelaxOptions { sweeps: 3, ..RelaxOptions::default() }, &[], &|| false);
    bench.map(&relaxed.region);
    bench.look();
    bench.seen(&[differ])
}

fn plastic_back_and_forth() -> Seen {
    let mut bench = Bench::new(mixed([1.0; 3]), tissue(0.3));
    bench.mail.set_plasticity(BANDS.to_vec());
    for n in 0..400 {
        let by = if n % 2 == 0 { 1.3 } else { -1.3 };
        bench.push_unmapped(&[Pin { voxel: [12, 11, 9], motion: Motion::By([by, 0.3 * by, -by]) }]);
        if n % 40 == 39 {
            bench.relax(&RelaxOptions::default(), &[], &|| false);
        }
    }
    bench.map(&bench.mail.displaced_region());
    bench.look();
    let stays = |id: &u32| bench.mail.plastic_brick(*id).is_some_and(|plastic| plastic.u.iter().any(|c| c.iter().any(|v| v.abs() > 0.01)));
    let bricks = (0..bench.rest.layout().count() as u32).filter(stays).count();
    bench.seen_and(&[], bricks as f64)
}

fn with_shape(rest: BrickedVolume) -> Bench {
    let mut bench = Bench::new(rest, Tissue { threshold_hu: Some(-300.0), ..tissue(0.3) });
    bench.mail.set_link_model(LinkModel { slender: Some(Slender { thickness: 3, offset: 0.33 }), ..LinkModel::default() });
    bench
}

fn threshold_changed() -> Seen {
    let mut bench = with_shape(mixed([1.0; 3]));
    let mut changed = 0;
    for threshold in [-300.0, 200.0, -900.0, 1200.0, -2000.0, 3000.0, 0.0] {
        for _ in 0..3 {
            bench.push_anywhere(3.0);
        }
        let region = bench.mail.set_threshold(&bench.rest, Some(threshold));
        changed += usize::from(!region.is_empty());
        bench.map(&region);
        bench.look();
    }
    bench.seen_and(&[], changed as f64)
}

fn thin_walls() -> Seen {
    let mut bench = with_shape(volume(SIZE, [1.0; 3], |[i, j, k]| {
        // sheets of one and two voxels, and a thread
        let solid = k < 4 || i == 8 || (15..17).contains(&i) || (i == 22 && j == 11);
        if solid { 60.0 } else { -1000.0 }
    }));
    for center in [[8, 11, 12], [15, 11, 12], [22, 11, 14], [16, 3, 17], [8, 20, 6]] {
        for by in [[3.0, 0.0, 0.0], [-6.0, 0.5, 0.0], [0.0, 0.0, -3.0]] {
            let pins = bench.pins_around(center, 1.8, by);
            bench.push(&pins);
        }
        bench.look();
    }
    bench.seen(&[])
}

fn a_void_that_closes() -> Seen {
    let mut bench = with_shape(walls(3));
    for n in 0..8 {
        let pins = bench.pins_around([12, 11, 15], 2.5, [0.0, 0.0, -1.0]);
        bench.push(&pins);
        if n % 4 == 3 {
            bench.look();
        }
    }
    // and opens again
    for _ in 0..4 {
        let pins = bench.pins_around([12, 11, 15], 2.5, [0.0, 0.0, 2.0]);
        bench.push(&pins);
    }
    bench.look();
    bench.seen(&[])
}

/// Cuts with a blade from anywhere to anywhere, among them places that are no places.
fn a_blade_that_jumps() -> Seen {
    let mut bench = Bench::new(mixed([1.0; 3]), tissue(0.3));
    let corners = [[-500.0, 3.0, 2.0], [900.0, 40.0, 9.0], [10.0, 10.0, 10.0], [10.0, 10.0, 10.0]];
    for (n, bad) in BAD.into_iter().chain([4.0, 12.0, 20.0]).enumerate() {
        let mut place = corners;
        place[n % 4][n % 3] = bad;
        let region = bench.cut(|mail, rest| mail.cut_triangles(rest, &swept_blade([place[0], place[1]], [place[2], place[3]])));
        bench.map(&region);
        bench.push_anywhere(4.0);
    }
    bench.look();
    bench.seen(&[])
}

fn cut_again_where_it_was_cut() -> Seen {
    let mut bench = Bench::new(mixed([1.0; 3]), tissue(0.3));
    let blade = swept_blade([[4.0, 11.3, 4.0], [22.0, 11.3, 4.0]], [[4.0, 11.3, 25.0], [22.0, 11.3, 25.0]]);
    for n in 0..6 {
        let region = bench.cut(|mail, rest| mail.cut_triangles(rest, &blade));
        bench.map(&region);
        // only the first cuts anything
        bench.worst[3] += f64::from(u8::from(n > 0 && !region.is_empty()));
        for (center, by) in [([13, 10, 15], [0.0, -2.0, 0.0]), ([13, 13, 15], [0.0, 2.0, 0.0])] {
            let pins = bench.pins_around(center, 1.8, by);
            bench.push(&pins);
        }
        if n == 2 {
            let region = bench.mail.remove_sphere(&bench.rest, [13.0, 11.0, 12.0], 3.0);
            bench.map(&region);
        }
        bench.look();
    }
    bench.seen(&[])
}

fn round_metric() -> Seen {
    let mut bench = Bench::new(mixed([1.0, 1.0, 3.0]), tissue(0.3));
    bench.mail.set_link_model(LinkModel { metric: Metric::Round, ..LinkModel::default() });
    for _ in 0..15 {
        bench.push_anywhere(4.0);
    }
    bench.look();
    bench.seen(&[])
}

const fn case(
    name: &'static str,
    effects: &'static [&'static str],
    invariants: &'static [Invariant],
    deeds: &'static [Deed],
    run: fn() -> Seen,
) -> Case {
    Case { engine: "ChainMail", name, effects, invariants, deeds, run }
}

pub(crate) const CASES: &[Case] = &[
    case("stiff beside soft", &["deformation"], HOLDS, &did(14.0, 1300.0, 1300.0, 0.0, 0.0), stiff_beside_soft),
    case("bone inside", &["deformation"], HOLDS, &did(6.0, 200.0, 150.0, 0.0, 0.0), bone_inside),
    case("spacing 1:10", &["deformation"], HOLDS, &did(10.0, 420.0, 430.0, 0.0, 0.0), spacing_one_to_ten),
    case("offset 0.01 to 0.99", &["deformation"], HOLDS, &did(4.0, 190.0, 0.0, 0.0, 0.0), offsets_from_a_hundredth_to_nearly_one),
    case("10⁵ pushes back and forth", &["deformation"], HOLDS_AND_RETURNS, &did(50000.0, 3.0, 0.0, 0.0, 3.0), back_and_forth),
    case("at the border", &["deformation"], HOLDS, &did(25.0, 120.0, 100.0, 0.0, 0.0), at_the_border),
    case("on an element, between eight", &["deformation"], HOLDS, &did(1.0, 430.0, 440.0, 0.0, 0.0), on_an_element_and_between_eight),
    case("zero-length, huge, NaN and infinite moves", &["deformation"], HOLDS, &did(21.0, 400.0, 410.0, 0.0, 0.0), bad_moves),
    case("all bone", &["deformation"], HOLDS, &did(5.0, 610.0, 9.0, 0.0, 0.0), all_bone),
    case("two tools", &["deformation"], HOLDS, &did(6.0, 220.0, 230.0, 0.0, 0.0), two_tools),
    case("round regions in slices", &["deformation"], HOLDS, &did(8.0, 670.0, 670.0, 0.0, 0.0), round_metric),
    case("links of any stiffness", &["relaxation"], HOLDS_AND_RETURNS, &did(6.0, 500.0, 500.0, 0.0, 510.0), links_of_any_stiffness),
    case("a push in the middle of it", &["relaxation"], HOLDS, &did(8.0, 1200.0, 1200.0, 0.0, 3500.0), a_push_in_the_middle_of_relaxation),
    case(
        "restart half-way",
        &["relaxation", "plasticity", "cutting"],
        HOLDS_AND_RESUMES,
        &did(3.0, 750.0, 790.0, 52.0, 770.0),
        restart_half_way,
    ),
    case(
        "pushed back and forth",
        &["plasticity"],
        HOLDS,
        &did_and("bricks of which a part of the displacement stays", 1.0, did(200.0, 130.0, 130.0, 0.0, 500.0)),
        plastic_back_and_forth,
    ),
    case(
        "a threshold changed while tissue is deformed",
        &["object-shape"],
        HOLDS,
        &did_and("thresholds that changed something", 2.0, did(9.0, 2600.0, 2700.0, 0.0, 0.0)),
        threshold_changed,
    ),
    case("thin walls", &["object-shape"], HOLDS, &did(8.0, 320.0, 300.0, 0.0, 0.0), thin_walls),
    case("a void that closes", &["object-shape"], HOLDS, &did(3.0, 710.0, 320.0, 0.0, 0.0), a_void_that_closes),
    case("a blade that jumps", &["cutting"], HOLDS, &did(5.0, 570.0, 570.0, 1500.0, 0.0), a_blade_that_jumps),
    case(
        "a block carried by whole voxels",
        &["deformation"],
        HOLDS_AND_CARRIES,
        &did_and("voxels compared whose value is another", 70.0, did(1.0, 800.0, 800.0, 0.0, 0.0)),
        a_block_carried_by_whole_voxels,
    ),
    case("cut again where it was cut", &["cutting"], HOLDS, &did(1.0, 48.0, 96.0, 140.0, 0.0), cut_again_where_it_was_cut),
];

hard_cases! {
    stiff_beside_soft => 0,
    bone_inside => 1,
    spacing_one_to_ten => 2,
    offset_from_a_hundredth_to_nearly_one => 3,
    a_hundred_thousand_pushes_back_and_forth => 4,
    at_the_border => 5,
    on_an_element_and_between_eight => 6,
    moves_of_no_length_huge_nan_and_infinite => 7,
    all_bone => 8,
    two_tools => 9,
    round_regions_in_slices => 10,
    relaxation_with_links_of_any_stiffness => 11,
    a_push_in_the_middle_of_relaxation => 12,
    restart_half_way => 13,
    plastic_tissue_pushed_back_and_forth => 14,
    a_threshold_changed_while_tissue_is_deformed => 15,
    thin_walls => 16,
    a_void_that_closes => 17,
    a_blade_that_jumps => 18,
    a_block_carried_by_whole_voxels => 19,
    cut_again_where_it_was_cut => 20,
}
