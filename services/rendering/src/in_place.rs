//! Nothing is copied: every brick that a frame samples is the one in the mapped segment, and what is drawn are the bytes that lie there.
//!
//! Two ways to the answer. [`Watched`] stands between snapshot and ray caster and compares the address of every brick it hands
//! over with the ranges that the reader has mapped; a source that copies even one brick is found by the same comparison. And bytes
//! changed in the segment behind the protocol's back, under the same epoch and stamps, show in the next frame: so no part of the
//! program keeps voxels of its own.

use crate::{compose::Composer, view::View};
use maille_contract::Role;
use maille_raycast::Quality;
use maille_scene::{BoxMm, Scene};
use maille_store::{Reader, StoreKeeper, StoreSizes, Writer};
use maille_transport::{ControlMap, Domain, Untimed};
use maille_volume::{Brick, BrickId, BrickLayout, BrickSource, Grid, Rescale, Volume, VolumeInfo};
use std::{
    ops::Range,
    sync::{
        Arc,
        atomic::{AtomicU64, AtomicUsize, Ordering::Relaxed},
    },
};

/// A source that notes where its bricks lie.
struct Watched<'a, S> {
    source: &'a S,
    /// what is mapped: rest bricks, versions
    mapped: [Range<usize>; 2],
    /// bricks handed over from each
    inside: [AtomicU64; 2],
    /// bricks handed over that lie elsewhere, or not wholly inside
    outside: AtomicU64,
    low: AtomicUsize,
    high: AtomicUsize,
}

impl<'a, S: BrickSource> Watched<'a, S> {
    fn new(source: &'a S, reader: &Reader) -> Self {
        let (inside, outside) = (Default::default(), AtomicU64::new(0));
        Self { source, mapped: reader.voxel_addresses(), inside, outside, low: AtomicUsize::new(usize::MAX), high: AtomicUsize::new(0) }
    }
}

impl<S: BrickSource> BrickSource for Watched<'_, S> {
    fn info(&self) -> &VolumeInfo {
        self.source.info()
    }
    fn layout(&self) -> &BrickLayout {
        self.source.layout()
    }
    fn brick(&self, id: BrickId) -> &Brick {
        let brick = self.source.brick(id);
        let first = std::ptr::from_ref(brick) as usize;
        let end = first + size_of::<Brick>();
        match self.mapped.iter().position(|m| m.start <= first && end <= m.end) {
            Some(n) => self.inside[n].fetch_add(1, Relaxed),
            None => self.outside.fetch_add(1, Relaxed),
        };
        self.low.fetch_min(first, Relaxed);
        self.high.fetch_max(end, Relaxed);
        brick
    }
    fn stamp(&self, id: BrickId) -> u64 {
        self.source.stamp(id)
    }
}

/// A source that copies one brick: what the test must find.
struct Copies<'a, S> {
    source: &'a S,
    id: BrickId,
    copy: Box<Brick>,
}

impl<S: BrickSource> BrickSource for Copies<'_, S> {
    fn info(&self) -> &VolumeInfo {
        self.source.info()
    }
    fn layout(&self) -> &BrickLayout {
        self.source.layout()
    }
    fn brick(&self, id: BrickId) -> &Brick {
        if id == self.id { &self.copy } else { self.source.brick(id) }
    }
    fn stamp(&self, id: BrickId) -> u64 {
        self.source.stamp(id)
    }
}

/// A patient in a store of its own.
pub(crate) struct World {
    domain: Domain,
    _control: ControlMap,
    _keeper: StoreKeeper,
    pub reader: Arc<Reader>,
    pub scene: Scene,
}

/// A ball of tissue in air.
pub fn ball() -> Volume {
    let grid = Grid::axis_aligned([64; 3], [1.0; 3]);
    let inside = |n: usize| [n % 64, n / 64 % 64, n / 4096].iter().map(|&c| (c as f64 - 31.5).powi(2)).sum::<f64>() < 28.0 * 28.0;
    let voxels = (0..grid.voxel_count()).map(|n| if inside(n) { 60 } else { -1000 }).collect();
    Volume::new(grid, Rescale { slope: 1.0, intercept: 0.0 }, voxels)
}

impl World {
    /// A ball of tissue in air, of which one octant has been rewritten.
    pub fn new() -> Self {
        let volume = ball();
        let domain = Domain::fresh().unwrap();
        let control = ControlMap::create(&domain).unwrap();
        let keeper = StoreKeeper::create(&domain, &volume, StoreSizes::for_volume(64, 16, 3, false), |_| {}).unwrap();
        let mut writer = Writer::open(&domain).unwrap();
        let mut t = writer.begin();
        for id in [0, 1, 4, 5, 16, 17, 20, 21] {
            let brick = t.brick_mut(id);
            brick.voxels.iter_mut().filter(|v| **v > 0).for_each(|v| *v = 300);
            brick.summarise();
        }
        t.commit();
        let reader = Arc::new(Reader::open(&domain, Role::Rendering).unwrap());
        let mut scene = Scene::builtin_default();
        scene.rendering.size = [160, 120];
        scene.rendering.section_size = [64, 64];
        Self { domain, _control: control, _keeper: keeper, reader, scene }
    }

    pub fn view(&self) -> View {
        View::new(&self.scene, &BoxMm::of(&self.reader.info().grid)).unwrap()
    }

    pub fn draw(&self, composer: &mut Composer, source: &impl BrickSource) -> Vec<u8> {
        composer.draw(source, None, &self.view(), None, false, None, &mut Untimed).unwrap();
        let mut pixels = vec![0; composer.bytes()];
        composer.write(&mut pixels, maille_contract::FrameHeader::default());
        pixels
    }
}

impl Drop for World {
    fn drop(&mut self) {
        self.domain.remove().unwrap();
    }
}

#[test]
fn every_brick_that_a_frame_samples_lies_in_the_mapped_segments() {
    let world = World::new();
    let mut composer = Composer::new(&world.scene);
    let snapshot = world.reader.snapshot();
    let watched = Watched::new(&snapshot, &world.reader);
    let plain = world.draw(&mut Composer::new(&world.scene), &snapshot);
    let pixels = world.draw(&mut composer, &watched);
    assert!(pixels == plain && pixels.iter().any(|&p| p != pixels[0]), "something is drawn, and watching changes nothing");
    let [rest, versions] = [0, 1].map(|n| watched.inside[n].load(Relaxed));
    let mapped = world.reader.voxel_addresses();
    println!(
        "bricks handed to the ray caster and the sections: {rest} of the rest segment, {versions} of the versions, {} elsewhere; addresses {:#x} to \
         {:#x}, mapped {:#x?}",
        watched.outside.load(Relaxed),
        watched.low.load(Relaxed),
        watched.high.load(Relaxed),
        mapped
    );
    assert!(rest > 100 && versions > 20, "both segments are looked at: {rest}, {versions}");
    assert_eq!(watched.outside.load(Relaxed), 0, "a brick was copied");
    let ends = [watched.low.load(Relaxed), watched.high.load(Relaxed) - 1];
    assert!(ends.iter().all(|end| mapped.iter().any(|m| m.contains(end))));
}

#[test]
fn a_copy_of_a_single_brick_is_found() {
    let world = World::new();
    let snapshot = world.reader.snapshot();
    for id in [5, 42] {
        let copies = Copies { source: &snapshot, id, copy: Box::new(*snapshot.brick(id)) };
        let watched = Watched::new(&copies, &world.reader);
        world.draw(&mut Composer::new(&world.scene), &watched);
        assert!(watched.outside.load(Relaxed) > 0, "brick {id} was copied and nobody noticed");
    }
}

#[test]
fn what_is_drawn_are_the_bytes_in_the_segment_now() {
    use std::os::unix::fs::FileExt;
    let world = World::new();
    let mut composer = Composer::new(&world.scene);
    let snapshot = world.reader.snapshot();
    let before = world.draw(&mut composer, &snapshot);
    assert!(world.draw(&mut composer, &snapshot) == before, "a still picture stands still");
    // behind the protocol's back: no new version, no new stamp, not even the skip cells
    let [rest, versions] = world.reader.voxel_addresses();
    for (segment, range) in [("rest", rest), ("versions", versions)] {
        let before = world.draw(&mut composer, &snapshot);
        let path = std::path::Path::new("/dev/shm").join(world.domain.segment_name(segment));
        let file = std::fs::OpenOptions::new().read(true).write(true).open(path).unwrap();
        for id in 0..64 {
            let at = std::ptr::from_ref(snapshot.brick(id)) as usize;
            if range.contains(&at) {
                let voxels = snapshot.brick(id).voxels.map(|v| if v > 0 { 1200 } else { v });
                file.write_all_at(bytemuck::cast_slice(&voxels), (maille_contract::segment_header::BODY_OFFSET + at - range.start) as u64)
                    .unwrap();
            }
        }
        assert!(world.draw(&mut composer, &snapshot) != before, "{segment}: the picture is made of other bytes than those that lie there");
    }
}

#[test]
fn a_frame_at_rest_is_whole_whatever_was_drawn_before_and_a_moving_one_is_coarser() {
    let world = World::new();
    let snapshot = world.reader.snapshot();
    let whole = world.draw(&mut Composer::new(&world.scene), &snapshot);
    let mut composer = Composer::new(&world.scene);
    let mut differs = Vec::new();
    for quality in [Quality { scale: 0.8, step: 1.0 }, Quality { scale: 0.5, step: 1.5 }, Quality { scale: 0.25, step: 2.0 }] {
        composer.quality = quality;
        let coarse = world.draw(&mut composer, &snapshot);
        assert_eq!(coarse.len(), whole.len());
        let view = 3 * world.scene.rendering.size.iter().product::<usize>();
        assert!(coarse[view..] == whole[view..], "sections stay as they are");
        let mean = whole.iter().zip(&coarse).map(|(a, b)| f64::from(a.abs_diff(*b))).sum::<f64>() / view as f64;
        differs.push(mean);
        composer.quality = Quality::FULL;
        assert!(world.draw(&mut composer, &snapshot) == whole, "after {quality:?} the picture at rest is another one");
    }
    println!("mean difference of coarser pictures: {differs:.2?} of 255");
    assert!(differs.windows(2).all(|w| 0.0 < w[0] && w[0] < w[1]) && differs[2] < 12.0, "coarser, and still the same patient: {differs:?}");
}
