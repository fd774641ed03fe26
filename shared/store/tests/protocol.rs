//! The store's promises, in one process with real segments: atomic commits, stable snapshots, space, recovery.

use maille_contract::{Role, control::PIN_IDLE, segment_header::BODY_OFFSET};
use maille_store::{CommitOutcome, Reader, StoreKeeper, StoreSizes, Writer};
use maille_transport::{ControlMap, Domain};
use maille_volume::{BrickSource, BrickedVolume, Grid, Rescale, Volume};
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};

struct World {
    domain: Domain,
    control: ControlMap,
    _keeper: StoreKeeper,
    volume: Volume,
}

impl World {
    fn new(size: [usize; 3], sizes: StoreSizes) -> Self {
        let grid = Grid::axis_aligned(size, [1.0, 1.0, 2.0]);
        let voxels = (0..grid.voxel_count()).map(|n| (n % 3001) as i16 - 1000).collect();
        let volume = Volume::new(grid, Rescale { slope: 1.0, intercept: -5.0 }, voxels);
        let domain = Domain::fresh().unwrap();
        let control = ControlMap::create(&domain).unwrap();
        let keeper = StoreKeeper::create(&domain, &volume, sizes, |_| {}).unwrap();
        Self { domain, control, _keeper: keeper, volume }
    }
}

impl Drop for World {
    fn drop(&mut self) {
        self.domain.remove().unwrap();
    }
}

fn sizes(spare: usize) -> StoreSizes {
    StoreSizes { spare_slots: spare, displacement_slots: spare, ..StoreSizes::default() }
}

#[test]
fn the_rest_volume_is_what_was_put_in() {
    let world = World::new([50, 40, 33], sizes(8));
    let reader = Reader::open(&world.domain, Role::Rendering).unwrap();
    assert_eq!(reader.info(), &world.volume.info);
    let snapshot = reader.snapshot();
    assert_eq!(snapshot.to_volume().voxels, world.volume.voxels);
    let heap = BrickedVolume::from_volume(&world.volume);
    for id in 0..snapshot.layout().count() as u32 {
        assert_eq!(snapshot.brick(id).voxels, heap.brick(id).voxels);
        assert_eq!(snapshot.brick(id).cells, heap.brick(id).cells);
        assert!(snapshot.displacement(id).is_none());
        let address = std::ptr::from_ref(snapshot.brick(id)) as usize;
        assert!(reader.voxel_addresses().iter().any(|range| range.contains(&address)), "brick {id} was copied");
    }
    assert_eq!((snapshot.epoch(), snapshot.state()[0]), (1, 0));
}

#[test]
fn a_snapshot_never_changes_and_a_dropped_transaction_leaves_no_trace() {
    let world = World::new([64, 64, 64], sizes(40));
    let mut writer = Writer::open(&world.domain).unwrap();
    let reader = Reader::open(&world.domain, Role::Rendering).unwrap();
    let before = reader.snapshot();
    let spare = writer.spare_slots();
    {
        let mut dropped = writer.begin();
        dropped.brick_mut(3).voxels[0] = 123;
        dropped.state_mut()[7] = 9;
    }
    assert_eq!((writer.spare_slots(), writer.epoch()), (spare, 1));
    let mut transaction = writer.begin();
    transaction.brick_mut(3).voxels.fill(77);
    transaction.displacement_mut(3)[5] = 1.5;
    transaction.state_mut()[0] = 42;
    assert_eq!((transaction.brick(3).voxels[9], transaction.brick(4).voxels), (77, before.brick(4).voxels));
    assert_eq!(transaction.commit(), CommitOutcome::Published { epoch: 2, entries: 3 });
    let after = reader.snapshot();
    assert_eq!((after.brick(3).voxels[9], after.displacement(3).unwrap()[5], after.state()[0], after.epoch()), (77, 1.5, 42, 2));
    assert_ne!(before.brick(3).voxels[9], 77);
    assert!(before.displacement(3).is_none() && before.state()[0] == 0);
    assert_ne!(before.stamp(3), after.stamp(3));
    assert_eq!(before.stamp(4), after.stamp(4));
    assert_eq!(writer.begin().commit(), CommitOutcome::Empty);
}

#[test]
fn when_slots_run_out_the_commit_is_put_off_and_nothing_is_lost() {
    let world = World::new([64, 64, 64], sizes(3));
    let mut writer = Writer::open(&world.domain).unwrap();
    let reader = Reader::open(&world.domain, Role::Rendering).unwrap();
    let mut commit = |brick: u32, value: i16| {
        let mut t = writer.begin();
        t.brick_mut(brick).voxels[0] = value;
        t.commit()
    };
    assert!(matches!(commit(0, 10), CommitOutcome::Published { .. }));
    let stalled = reader.snapshot();
    assert!(matches!(commit(0, 11), CommitOutcome::Published { .. }));
    // the stalled reader costs one version of brick 0, whatever the number of commits
    for n in 0..100 {
        assert!(matches!(commit(0, 100 + n), CommitOutcome::Published { .. }), "commit {n}");
    }
    // bricks 0 (current), 0 (pinned) and 1 take the three slots; the next brick finds none
    assert!(matches!(commit(1, 20), CommitOutcome::Published { .. }));
    assert!(matches!(commit(2, 30), CommitOutcome::Deferred));
    assert_eq!(stalled.brick(0).voxels[0], 10);
    drop(stalled);
    // the slot of the pinned version is free now
    let mut t = writer.begin();
    t.brick_mut(2).voxels[1] = 31;
    let outcome = t.commit();
    let now = reader.snapshot();
    match outcome {
        CommitOutcome::Published { entries, .. } => {
            assert_eq!(entries, 1, "brick 2, both of its changes");
            assert_eq!((now.brick(0).voxels[0], now.brick(1).voxels[0], now.brick(2).voxels[..2].to_vec()), (199, 20, vec![30, 31]));
        }
        other => panic!("{other:?}"),
    }
}

#[test]
fn a_writer_that_asks_for_room_always_gets_visible_again_and_one_that_does_not_loses_nothing() {
    // 64 bricks, room for 70 versions: a backlog of all bricks beside a version of each would never fit
    let world = World::new([64, 64, 64], sizes(70));
    let mut writer = Writer::open(&world.domain).unwrap();
    let reader = Reader::open(&world.domain, Role::Rendering).unwrap();
    let mut truth = [0i16; 64];
    let mut value = 0;
    let mut push = |writer: &mut Writer, truth: &mut [i16; 64]| {
        let mut t = writer.begin();
        for _ in 0..4 {
            value += 1;
            let id = value as usize * 5 % 64;
            t.brick_mut(id as u32).voxels.fill(value);
            truth[id] = value;
        }
        t.commit()
    };
    let shows = |truth: &[i16; 64]| {
        let now = reader.snapshot();
        (0..64).all(|id| truth[id] == 0 || now.brick(id as u32).voxels.iter().all(|&v| v == truth[id]))
    };
    for _ in 0..40 {
        let stopped = reader.snapshot();
        let mut pushes = 0;
        while writer.has_room() && pushes < 100 {
            push(&mut writer, &mut truth);
            pushes += 1;
        }
        drop(stopped);
        assert!(
            (!writer.has_deferred() || writer.publish_deferred().is_some()) && writer.has_room(),
            "what was put off is published once the reader has let go"
        );
        assert!(shows(&truth));
        writer.audit().unwrap();
    }
    // without asking: the backlog may outgrow the store, but it is whole, and the last published state stands
    let stopped = reader.snapshot();
    let before = truth;
    let outcomes: Vec<CommitOutcome> = (0..100).map(|_| push(&mut writer, &mut truth)).collect();
    assert_eq!(outcomes.last(), Some(&CommitOutcome::Deferred));
    assert!((0..64).all(|id| before[id] == 0 || stopped.brick(id as u32).voxels[0] == before[id]));
    let mut t = writer.begin();
    assert!(
        (0..64).all(|id| truth[id] == 0 || t.brick_mut(id as u32).voxels[0] == truth[id]),
        "a transaction starts from all that was committed"
    );
    drop(t);
    writer.audit().unwrap();
}

#[test]
fn a_new_writer_finds_the_last_commit_and_every_slot() {
    let world = World::new([96, 64, 64], sizes(256));
    let mut writer = Writer::open(&world.domain).unwrap();
    let reader = Reader::open(&world.domain, Role::Haptic).unwrap();
    let total = writer.spare_slots();
    for n in 0..20u32 {
        let mut t = writer.begin();
        for id in 0..6 {
            t.brick_mut((n * 5 + id * 3) % 96).voxels.fill(n as i16);
        }
        t.state_mut()[0] = n as u8;
        assert!(matches!(t.commit(), CommitOutcome::Published { .. }));
    }
    let pinned = reader.snapshot();
    let truth = pinned.to_volume().voxels;
    // the writer dies with a transaction half-done
    let mut t = writer.begin();
    t.brick_mut(1).voxels.fill(-7);
    t.displacement_mut(1).fill(2.0);
    std::mem::forget(t);
    drop(writer);
    let mut writer = Writer::open(&world.domain).unwrap();
    let current: std::collections::BTreeSet<u32> = (0..96).filter(|&id| pinned.stamp(id) > 0).collect();
    assert_eq!((writer.epoch(), writer.state()[0]), (21, 19));
    assert_eq!(writer.spare_slots(), total - current.len());
    assert_eq!(reader.snapshot().to_volume().voxels, truth);
    // the pinned state outlives the new writer's commits
    for n in 0..30 {
        let mut t = writer.begin();
        t.brick_mut(n % 7).voxels.fill(-8);
        t.commit();
    }
    assert_eq!(pinned.to_volume().voxels, truth);
    drop(pinned);
    writer.reclaim();
    let shown: usize = { (0..96).filter(|&id| reader.snapshot().stamp(id) > 0).count() };
    assert_eq!(writer.spare_slots(), total - shown, "no slot may leak");
}

#[test]
fn a_dead_readers_pin_holds_its_epoch_until_it_is_released() {
    let world = World::new([64, 64, 64], sizes(6));
    let mut writer = Writer::open(&world.domain).unwrap();
    let reader = Reader::open(&world.domain, Role::Rendering).unwrap();
    std::mem::forget(reader.snapshot());
    for n in 0..50 {
        let mut t = writer.begin();
        t.brick_mut(n % 2).voxels.fill(n as i16);
        t.commit();
    }
    let low = writer.spare_slots();
    for pin in &world.control.pins[Role::Rendering.pins()] {
        pin.word.store(PIN_IDLE, Relaxed);
    }
    writer.reclaim();
    assert!(writer.spare_slots() >= low);
    assert_eq!(writer.spare_slots(), 4);
}

/// Readers on other threads: every snapshot shows one epoch in all bricks, and keeps showing it.
#[test]
fn snapshots_are_of_one_epoch_while_the_writer_commits_at_full_speed() {
    let world = World::new([64, 64, 64], sizes(64 * 6));
    let mut writer = Writer::open(&world.domain).unwrap();
    let stop = AtomicBool::new(false);
    let (mut published, mut deferred) = (0u32, 0u32);
    let mut first = writer.begin();
    for id in 0..64 {
        first.brick_mut(id).voxels.fill(0);
    }
    first.commit();
    std::thread::scope(|scope| {
        for role in [Role::Haptic, Role::Rendering, Role::Console] {
            let (domain, stop) = (&world.domain, &stop);
            scope.spawn(move || {
                let reader = Reader::open(domain, role).unwrap();
                let (mut checked, mut last) = (0u64, 0);
                while !stop.load(Relaxed) {
                    let snapshot = reader.snapshot();
                    assert!(snapshot.epoch() >= last);
                    last = snapshot.epoch();
                    let value = snapshot.brick(0).voxels[0];
                    for id in (0..64).chain([0, 63]) {
                        let brick = snapshot.brick(id);
                        assert!(brick.voxels.iter().all(|&v| v == value), "torn or mixed: brick {id} of epoch {last}");
                    }
                    checked += 1;
                }
                assert!(checked > 0);
            });
        }
        for n in 0..3000u32 {
            let mut t = writer.begin();
            for id in 0..64 {
                t.brick_mut(id).voxels.fill(n as i16);
            }
            match t.commit() {
                CommitOutcome::Published { .. } => published += 1,
                CommitOutcome::Deferred => deferred += 1,
                CommitOutcome::Empty => panic!("64 bricks were changed"),
            }
        }
        stop.store(true, Relaxed);
    });
    println!("{published} commits of 64 bricks, {deferred} put off");
    assert!(published > 2000);
}

#[test]
fn a_damaged_or_truncated_store_is_refused_with_a_sentence() {
    let world = World::new([32, 32, 32], sizes(4));
    let path = std::path::Path::new("/dev/shm").join(world.domain.segment_name("versions"));
    std::fs::OpenOptions::new().write(true).open(&path).unwrap().set_len(4096).unwrap();
    let error = Reader::open(&world.domain, Role::Haptic).err().unwrap().to_string();
    assert!(error.contains("truncated"), "{error}");
    let index = std::path::Path::new("/dev/shm").join(world.domain.segment_name("index"));
    use std::os::unix::fs::FileExt;
    std::fs::OpenOptions::new().write(true).open(&index).unwrap().write_all_at(&[1; 8], BODY_OFFSET as u64 + 24).unwrap();
    let error = Reader::open(&world.domain, Role::Haptic).err().unwrap().to_string();
    assert!(error.contains("checksum"), "{error}");
}

#[test]
fn segments_are_the_owners_alone_and_a_damaged_index_is_refused_not_followed() {
    use std::os::unix::fs::{FileExt, PermissionsExt};
    let world = World::new([32, 32, 32], sizes(4));
    for segment in ["control", "index", "rest", "versions", "displacement", "state"] {
        let path = std::path::Path::new("/dev/shm").join(world.domain.segment_name(segment));
        assert_eq!(path.metadata().unwrap().permissions().mode() & 0o777, 0o600, "{segment}");
    }
    // the first root page, which names leaf pages, follows the header
    let index = std::path::Path::new("/dev/shm").join(world.domain.segment_name("index"));
    let root = (BODY_OFFSET + size_of::<maille_contract::index::IndexHeader>().next_multiple_of(64)) as u64;
    std::fs::OpenOptions::new().write(true).open(&index).unwrap().write_all_at(&9999u32.to_ne_bytes(), root).unwrap();
    let error = Writer::open(&world.domain).err().unwrap().to_string();
    assert!(error.contains("leaf pages") && error.contains("there is none"), "{error}");
}
