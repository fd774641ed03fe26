//! A store under the twin: in place nothing of the voxels is uploaded; elsewhere what moves is what changed; an epoch is held until the
//! device has answered; without a device, or when it is lost, the CPU has the same frame.

mod common;

use common::{World, body, difference, gpu, gpu_of};
use maille_raycast::{Camera, Extras, Picture, Preset, Probe, Settings, Skip, Ultrasound, render, ultrasound};
use maille_raycast_gpu::{Choice, Gpu, GpuError, Placement, Renderer};
use maille_volume::{BrickLayout, BrickSource, Volume, brick::Brick};
use std::sync::Arc;

const SIZE: [usize; 2] = [72, 60];
const BRICK: u64 = size_of::<Brick>() as u64;

/// What lies in the store.
fn volume() -> Volume {
    body([70, 52, 49], [1.0; 3]).to_volume()
}

fn settings() -> Settings {
    Settings { adaptive: None, ..Settings::volume(Preset::SoftTissue.transfer()) }
}

/// Draws the newest epoch on both and compares.
fn both(world: &World, renderer: &mut Renderer) -> Picture {
    let snapshot = world.reader.snapshot();
    let skip = Skip::new(&snapshot, &settings());
    let camera = Camera::around(snapshot.info());
    let (mut cpu, mut gpu) = (Picture::new(SIZE[0], SIZE[1]), Picture::new(SIZE[0], SIZE[1]));
    render(&snapshot, &skip, &camera, &settings(), &mut cpu).unwrap();
    renderer.begin(&Extras::default(), snapshot, &skip, &camera, &settings(), &gpu).unwrap().finish(&mut gpu).unwrap();
    let (share, worst) = difference(&cpu, &gpu);
    // one in a thousand pixels, and of few pixels at least a handful
    assert!(share < 0.002, "{share} of pixels, at most {worst}");
    gpu
}

#[test]
fn in_place_nothing_is_uploaded_and_commits_are_seen() {
    let Some(gpu) = gpu() else { return };
    let mut world = World::new(&volume());
    let mut renderer = Renderer::for_store(gpu, &world.reader, Placement::InPlace).unwrap();
    if let Some(notice) = renderer.notice() {
        assert!(!renderer.gpu().is_software(), "{notice}");
        eprintln!("SKIPPED: {notice}");
        return;
    }
    let before = both(&world, &mut renderer);
    let first = renderer.traffic();
    assert_eq!((first.uploaded, first.fetched, first.changed), (0, 0, world.count()));
    for (n, bricks) in [&[20u32, 21, 26][..], &[20, 40], &[20]].into_iter().enumerate() {
        world.change(bricks);
        let earlier = renderer.traffic();
        let after = both(&world, &mut renderer);
        let now = renderer.traffic();
        assert_eq!((now.uploaded, now.fetched), (0, 0));
        assert_eq!(now.changed - earlier.changed, bricks.len() as u64, "commit {n}");
        assert!(n > 0 || difference(&before, &after).0 > 0.01, "the commit is not to be seen");
    }
    assert!(world.free());
}

/// A probe on the skin.
fn probe(source: &impl BrickSource) -> Ultrasound {
    let centre = source.info().grid.center();
    let face = std::array::from_fn(|c| centre[c] - [14.0, 15.0, -10.0][c]);
    Ultrasound::new(Probe { depth_mm: 50.0, ..Probe::convex(face, [14.0, 15.0, -10.0], [1.0, -1.0, 0.3]) })
}

#[test]
fn an_ultrasound_fan_reads_voxels_in_place_and_sees_commits() {
    let Some(gpu) = gpu() else { return };
    let mut world = World::new(&volume());
    let mut renderer = Renderer::for_store(gpu, &world.reader, Placement::Auto).unwrap();
    let in_place = renderer.placement() == Placement::InPlace;
    let mut draw = |world: &World| {
        let snapshot = world.reader.snapshot();
        let (mut cpu, mut gpu) = (Picture::new(SIZE[0], SIZE[1]), Picture::new(SIZE[0], SIZE[1]));
        ultrasound(&snapshot, &probe(&snapshot), None, &mut cpu).unwrap();
        let report = renderer.ultrasound(&snapshot, &probe(&snapshot), None, &mut gpu).unwrap();
        let (share, worst) = difference(&cpu, &gpu);
        assert!(share <= 0.001, "{share} of pixels, at most {worst}");
        (gpu, report)
    };
    let (before, first) = draw(&world);
    let (same, second) = draw(&world);
    assert!(first.built && !second.built && same == before);
    assert_eq!((second.traffic.changed, second.traffic.uploaded, second.traffic.other), (0, 0, 0), "nothing changed and nothing is sent");
    world.change(&[20, 21, 26]);
    let (after, third) = draw(&world);
    assert!(difference(&before, &after).0 > 0.01, "the commit is not to be seen");
    assert_eq!(third.traffic.changed, 3);
    if in_place {
        assert_eq!([first, second, third].map(|r| (r.traffic.uploaded, r.traffic.fetched)), [(0, 0); 3]);
    }
    assert!(world.free());
    // its buffers come back when they are asked for again
    renderer.forget_ultrasound();
    let snapshot = world.reader.snapshot();
    let mut again = Picture::new(SIZE[0], SIZE[1]);
    renderer.ultrasound(&snapshot, &probe(&snapshot), None, &mut again).unwrap();
    assert_eq!(again, after);
    renderer.gpu().give_up();
    let untouched = again.clone();
    let lost = renderer.ultrasound(&snapshot, &probe(&snapshot), None, &mut again);
    assert!(matches!(lost, Err(GpuError::Lost(_))), "{lost:?}");
    assert_eq!(again, untouched);
}

#[test]
fn resident_bricks_are_fetched_by_the_device_and_only_changed_ones() {
    let Some(gpu) = gpu() else { return };
    let mut world = World::new(&volume());
    let mut renderer = Renderer::for_store(gpu, &world.reader, Placement::Resident).unwrap();
    if renderer.placement() != Placement::Resident {
        eprintln!("SKIPPED: {}", renderer.notice().unwrap_or_default());
        return;
    }
    both(&world, &mut renderer);
    assert_eq!((renderer.traffic().uploaded, renderer.traffic().fetched), (0, world.count() * BRICK));
    let fetched = renderer.traffic().fetched;
    both(&world, &mut renderer);
    assert_eq!(renderer.traffic().fetched, fetched, "nothing changed");
    world.change(&[20, 21, 40]);
    both(&world, &mut renderer);
    assert_eq!((renderer.traffic().uploaded, renderer.traffic().fetched - fetched), (0, 3 * BRICK));
}

#[test]
fn without_the_extension_changed_bricks_are_uploaded_and_it_is_said() {
    let Some(gpu) = gpu_of(&Choice { without_import: true, ..Choice::any() }) else { return };
    let mut world = World::new(&volume());
    assert!(!gpu.can_import());
    let mut renderer = Renderer::for_store(gpu, &world.reader, Placement::Auto).unwrap();
    assert!(renderer.notice().unwrap().contains("uploaded"));
    both(&world, &mut renderer);
    assert_eq!((renderer.traffic().uploaded, renderer.traffic().fetched), (world.count() * BRICK, 0));
    world.change(&[20, 21, 40]);
    both(&world, &mut renderer);
    assert_eq!(renderer.traffic().uploaded, (world.count() + 3) * BRICK);
}

#[test]
fn voxels_in_many_small_buffers_are_the_same_voxels() {
    for placement in [Placement::InPlace, Placement::Resident, Placement::Uploaded] {
        let Some(gpu) = gpu_of(&Choice { buffer_bytes: Some(64 * BRICK), ..Choice::any() }) else { return };
        let mut world = World::new(&volume());
        assert!(world.count() > 64, "more than one buffer");
        let mut renderer = Renderer::for_store(gpu, &world.reader, placement).unwrap();
        both(&world, &mut renderer);
        world.change(&[20, 70]);
        both(&world, &mut renderer);
    }
}

#[test]
fn an_epoch_is_pinned_until_the_device_has_answered() {
    let Some(gpu) = gpu() else { return };
    let mut world = World::new(&volume());
    let mut renderer = Renderer::for_store(gpu, &world.reader, Placement::InPlace).unwrap();
    let before = both(&world, &mut renderer);
    assert!(world.free());
    let reader = Arc::clone(&world.reader);
    let snapshot = reader.snapshot();
    let skip = Skip::new(&snapshot, &settings());
    let camera = Camera::around(snapshot.info());
    let mut picture = Picture::new(SIZE[0], SIZE[1]);
    let pending = renderer.begin(&Extras::default(), snapshot, &skip, &camera, &settings(), &picture).unwrap();
    assert!(!world.free(), "the epoch is let go while the device may read it");
    for _ in 0..6 {
        world.change(&[20, 21]);
    }
    pending.finish(&mut picture).unwrap();
    assert!(world.free());
    assert_eq!(picture, before, "a frame shows one epoch, whatever is committed meanwhile");
    // one that nobody waits for lets go as well, after the answer
    drop(renderer.begin(&Extras::default(), reader.snapshot(), &skip, &camera, &settings(), &picture).unwrap());
    assert!(world.free());
    both(&world, &mut renderer);
}

#[test]
fn a_mapping_lives_as_long_as_the_renderer_that_reads_it() {
    let Some(gpu) = gpu() else { return };
    let world = World::new(&volume());
    let mut renderer = Renderer::for_store(gpu, &world.reader, Placement::InPlace).unwrap();
    both(&world, &mut renderer);
    let alone = Arc::strong_count(&world.reader);
    assert!(alone > 1 || renderer.placement() != Placement::InPlace);
    drop(renderer);
    assert_eq!(Arc::strong_count(&world.reader), 1, "buffers are gone and with them what kept the mapping");
}

#[test]
fn without_a_device_there_is_an_error_and_the_cpu_has_the_frame() {
    let missing = Gpu::open(&Choice { name: Some("a device that nobody makes".into()), ..Choice::any() });
    assert!(matches!(missing, Err(GpuError::NoAdapter(_))));
    let Some(gpu) = gpu() else { return };
    let world = World::new(&volume());
    let mut renderer = Renderer::for_store(gpu, &world.reader, Placement::Auto).unwrap();
    both(&world, &mut renderer);
    renderer.gpu().give_up();
    let snapshot = world.reader.snapshot();
    let skip = Skip::new(&snapshot, &settings());
    let camera = Camera::around(snapshot.info());
    let mut picture = Picture::new(SIZE[0], SIZE[1]);
    let untouched = picture.clone();
    let lost = renderer.render(&Extras::default(), &snapshot, &skip, &camera, &settings(), &mut picture);
    assert!(matches!(lost, Err(GpuError::Lost(_))), "{lost:?}");
    assert_eq!(picture, untouched);
    render(&snapshot, &skip, &camera, &settings(), &mut picture).unwrap();
    assert!(picture.rgb.iter().any(|&v| v > 20));
}

#[test]
fn a_volume_that_is_too_large_for_the_device_is_refused() {
    let Some(gpu) = gpu_of(&Choice { buffer_bytes: Some(64 * BRICK), ..Choice::any() }) else { return };
    let refused = Renderer::for_volume(gpu, &BrickLayout::new([2048; 3]));
    assert!(matches!(refused, Err(GpuError::Unsupported(_) | GpuError::OutOfMemory(_))));
}
