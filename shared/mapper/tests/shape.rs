//! Figures 5.11 and 5.12 of Dräger 2005 as voxels show them: an opposite wall that must not move, a thin bump that must not vanish.

use maille_chainmail::{Admission, ChainMail, LinkModel, Motion, Pin, Slender, Tissue};
use maille_mapper::{MapOptions, Mapper};
use maille_volume::{BrickSource, BrickedVolume, Grid, Rescale, Volume};

const AIR: i16 = -1000;
/// Where tissue begins [HU].
const THRESHOLD: i16 = -300;

fn volume(size: [usize; 3], hu: impl Fn(usize, usize, usize) -> i16) -> BrickedVolume {
    let grid = Grid::axis_aligned(size, [1.0; 3]);
    let voxels = voxels(size).map(|[i, j, k]| hu(i, j, k)).collect();
    BrickedVolume::from_volume(&Volume::new(grid, Rescale::IDENTITY, voxels))
}

fn voxels(size: [usize; 3]) -> impl Iterator<Item = [usize; 3]> {
    (0..size[0] * size[1] * size[2]).map(move |n| [n % size[0], n / size[0] % size[1], n / (size[0] * size[1])])
}

/// Tissue that is not the same everywhere, so that a voxel that shows another one is seen.
fn flesh(i: usize, j: usize, k: usize) -> i16 {
    40 + ((i * 7 + j * 5 + k * 3) % 11) as i16
}

fn tissue(threshold_hu: Option<i16>) -> Tissue {
    let threshold_hu = threshold_hu.map(f64::from);
    Tissue { offset: 0.3, density_scaling: false, threshold_hu, bone_hu: None, movement_limit_mm: None, admission: Admission::Scaled }
}

/// A patient that is pushed and looked at.
struct Patient {
    rest: BrickedVolume,
    mail: ChainMail,
    mapper: Mapper,
    now: BrickedVolume,
}

impl Patient {
    fn new(rest: BrickedVolume, tissue: Tissue, links: LinkModel) -> Self {
        let mut mail = ChainMail::new(rest.info(), tissue);
        mail.set_link_model(links);
        Self { now: rest.clone(), rest, mail, mapper: Mapper::new() }
    }

    fn push(&mut self, voxels: &[[usize; 3]], to: [f32; 3]) {
        let pins: Vec<Pin> = voxels.iter().map(|&voxel| Pin { voxel, motion: Motion::To(to) }).collect();
        let outcome = self.mail.push(&self.rest, &pins);
        let report = self.mapper.remap(&self.rest, &self.mail, &outcome.region, &mut self.now, &MapOptions::default());
        assert_eq!(report.failures, 0);
    }

    fn at(&self, [i, j, k]: [usize; 3]) -> i16 {
        self.now.voxel(i, j, k)
    }

    /// Voxels among `of` that no longer show what they show at rest.
    fn changed(&self, of: impl Fn([usize; 3]) -> bool) -> usize {
        voxels(self.mail.layout().size).filter(|&v| of(v) && self.at(v) != self.rest.voxel(v[0], v[1], v[2])).count()
    }
}

#[test]
fn figure_5_11_the_opposite_wall_of_a_narrow_passage_shows_no_change_until_it_is_touched() {
    // four voxels of air between two walls
    let size = [58, 40, 40];
    let passage = || volume(size, |i, j, k| if (28..32).contains(&i) { AIR } else { flesh(i, j, k) });
    let wall: Vec<[usize; 3]> = (0..4).map(|n| [27, 19 + n % 2, 19 + n / 2]).collect();
    let opposite = |v: [usize; 3]| v[0] >= 32;

    // as in the thesis: one object, and the voxels of the opposite wall move
    let mut one = Patient::new(passage(), tissue(None), LinkModel::default());
    one.push(&wall, [3.0, 0.0, 0.0]);
    assert!(one.changed(opposite) > 100, "{}", one.changed(opposite));

    let mut shaped = Patient::new(passage(), tissue(Some(THRESHOLD)), LinkModel::default());
    shaped.push(&wall, [3.0, 0.0, 0.0]);
    assert_eq!(shaped.changed(opposite), 0);
    // the near wall has come three voxels, with its own values, and one of air is left
    let line = |p: &Patient| -> Vec<i16> { (0..58).map(|i| p.at([i, 19, 19])).collect() };
    let now = line(&shaped);
    assert_eq!((now[30], now[31]), (flesh(27, 19, 19), AIR), "{now:?}");
    assert!(now[..30].iter().all(|&v| v >= 40), "no hole where it came from: {now:?}");
    // away from the dent the passage is as wide as it was
    assert_eq!(shaped.changed(|v| v[1] < 5 || v[2] > 35), 0);

    // three more: walls touch, no air between them, and now the opposite wall gives way
    shaped.push(&wall, [6.0, 0.0, 0.0]);
    assert!(line(&shaped).iter().all(|&v| v >= THRESHOLD), "{:?}", line(&shaped));
    assert!(shaped.changed(opposite) > 10);
    // back: the near wall leaves air, the opposite one keeps what it was given, 6 − 4 − 0.3
    shaped.push(&wall, [0.0; 3]);
    let now = line(&shaped);
    assert!(now[28..=32].iter().all(|&v| v == AIR) && now[34..].iter().all(|&v| v >= 40), "{now:?}");
    assert!(now[..28].iter().all(|&v| v >= 40), "{now:?}");
    // and with that put back as well, every voxel is what it was
    let all = shaped.mail.relax(0.0, 0.0);
    shaped.mapper.remap(&shaped.rest, &shaped.mail, &all, &mut shaped.now, &MapOptions::default());
    assert_eq!(shaped.changed(|_| true), 0);
}

#[test]
fn figure_5_12_a_thin_bump_leans_aside_in_the_picture_and_keeps_its_height_and_its_mass() {
    // three by three voxels, nine high, on a thick floor
    let (size, floor, top) = ([48, 48, 48], 22, 31);
    let thin = |i: usize, j: usize| (22..25).contains(&i) && (22..25).contains(&j);
    let bump = || volume(size, |i, j, k| if k < floor || (k < top && thin(i, j)) { flesh(i, j, k) } else { AIR });
    let tip: Vec<[usize; 3]> = (0..8).map(|n| [22 + (n & 1), 22 + (n >> 1 & 1), 29 + (n >> 2)]).collect();
    let push = [2.5, 0.0, 0.0];
    let below = |v: [usize; 3]| v[2] + 1 < floor;

    // as in the thesis: the floor is dragged along
    let mut one = Patient::new(bump(), Tissue { offset: 0.1, ..tissue(None) }, LinkModel::default());
    one.push(&tip, push);
    assert!(one.changed(below) > 10, "{}", one.changed(below));

    // limits up to which the map is one-to-one, as the deformation process has them
    let links = LinkModel { slender: Some(Slender { thickness: 3, offset: 0.33 }), ..LinkModel::default() };
    let mut shaped = Patient::new(bump(), Tissue { offset: 0.1, ..tissue(Some(THRESHOLD)) }, links);
    shaped.push(&tip, push);
    assert_eq!(shaped.changed(below), 0, "the root holds");
    // layer by layer: how much there is, and where
    let layer = |source: &BrickedVolume, k: usize| {
        let (mut mass, mut moment, mut across) = (0.0, 0.0, 0.0);
        for [i, j, _] in voxels([48, 48, 1]) {
            let m = f64::from(source.voxel(i, j, k) - AIR);
            (mass, moment, across) = (mass + m, moment + m * i as f64, across + m * j as f64);
        }
        (mass, moment / mass, across / mass)
    };
    let mut before = 0.0;
    for k in floor..top {
        let (was, now) = (layer(&shaped.rest, k), layer(&shaped.now, k));
        // what is sheared keeps its mass; resampling an edge is the rest
        assert!((now.0 / was.0 - 1.0).abs() < 0.12, "layer {k}: {} of {}", now.0, was.0);
        let (aside, across) = (now.1 - was.1, now.2 - was.2);
        assert!(aside >= before - 0.02 && across.abs() < 0.05, "layer {k} goes {aside} aside, {across} across");
        before = aside;
    }
    assert!((before - 2.5).abs() < 0.25, "the tip goes with the tool: {before}");
    let root = layer(&shaped.now, floor).1 - layer(&shaped.rest, floor).1;
    assert!(root < 0.4, "{root}");
    // it is as high as it was, nothing sank and nothing is torn
    assert!((floor..top).all(|k| (0..48).any(|i| shaped.at([i, 23, k]) >= 30)));
    assert!(voxels(size).all(|v| v[2] < top || shaped.at(v) == AIR));
}
