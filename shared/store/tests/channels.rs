//! Channels beside the voxels, and read-only regions: they cost nothing where the plan does not ask for them, share the transaction of
//! the voxels where it does, and are refused when damaged.

use maille_contract::{Role, index::Channel, segment_header::BODY_OFFSET};
use maille_store::{
    CommitOutcome, Cuts, Displacement, Labels, Plastic, Reader, Region, StoreError, StoreKeeper, StorePlan, StoreSizes, Writer,
};
use maille_transport::{ControlMap, Domain, TransportError};
use maille_volume::{BrickSource, Grid, Rescale, Volume};
use std::{os::unix::fs::FileExt, path::PathBuf};

struct World {
    domain: Domain,
    _control: ControlMap,
    keeper: StoreKeeper,
}

impl World {
    fn new(sizes: StoreSizes) -> Self {
        let domain = Domain::fresh().unwrap();
        let control = ControlMap::create(&domain).unwrap();
        let keeper = StoreKeeper::create(&domain, &volume(), sizes, |_| {}).unwrap();
        Self { domain, _control: control, keeper }
    }

    fn path(&self, segment: &str) -> PathBuf {
        PathBuf::from("/dev/shm").join(self.domain.segment_name(segment))
    }
}

impl Drop for World {
    fn drop(&mut self) {
        self.domain.remove().unwrap();
    }
}

fn volume() -> Volume {
    let grid = Grid::axis_aligned([48; 3], [1.0; 3]);
    let voxels = vec![40; grid.voxel_count()];
    Volume::new(grid, Rescale { slope: 1.0, intercept: 0.0 }, voxels)
}

const ALL: StoreSizes =
    StoreSizes { spare_slots: 60, displacement_slots: 60, plastic_slots: 60, cut_slots: 60, label_slots: 60, octree_slots: 60 };

#[test]
fn a_channel_that_is_not_planned_costs_nothing_and_is_not_there() {
    let sizes = StoreSizes { spare_slots: 8, ..StoreSizes::default() };
    let world = World::new(sizes);
    for segment in ["displacement", "plastic", "cuts", "labels", "octree"] {
        assert!(!world.path(segment).exists(), "{segment}");
    }
    let (small, all) = (StorePlan { info: volume().info, sizes }.segments(), StorePlan { info: volume().info, sizes: ALL }.segments());
    assert_eq!(small.iter().map(|s| s.0).collect::<Vec<_>>(), ["index", "rest", "versions", "state"]);
    assert_eq!(all.len(), small.len() + 5);
    for (name, bytes) in small {
        assert_eq!(world.path(name).metadata().unwrap().len(), bytes as u64, "{name}: the plan says what is made");
    }
    let (mut writer, reader) = (Writer::open(&world.domain).unwrap(), Reader::open(&world.domain, Role::Rendering).unwrap());
    assert!(!writer.has_channel(Channel::Plastic) && writer.has_channel(Channel::Voxels));
    assert!(reader.snapshot().channel::<Cuts>(0).is_none() && writer.channel::<Labels>(0).is_none());
    let mut t = writer.begin();
    let asked = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| t.channel_mut::<Plastic>(0)[0] = 1.0));
    assert!(asked.is_err(), "a channel that is not there cannot be written");
}

#[test]
fn all_channels_are_of_one_epoch_and_absent_until_written() {
    let world = World::new(ALL);
    let (mut writer, reader) = (Writer::open(&world.domain).unwrap(), Reader::open(&world.domain, Role::Rendering).unwrap());
    let before = reader.snapshot();
    let mut t = writer.begin();
    t.brick_mut(5).voxels[0] = 7;
    t.channel_mut::<Displacement>(5)[1] = 0.5;
    t.channel_mut::<Plastic>(5)[2] = 0.25;
    t.channel_mut::<Cuts>(5)[3] = 0b101;
    t.channel_mut::<Labels>(26)[4095] = 9;
    assert_eq!(t.commit(), CommitOutcome::Published { epoch: 2, entries: 5 });
    let after = reader.snapshot();
    let seen = |c: &[u8; 4096]| (c[3], c[4095]);
    assert_eq!(after.brick(5).voxels[0], 7);
    assert_eq!((after.displacement(5).unwrap()[1], after.channel::<Plastic>(5).unwrap()[2]), (0.5, 0.25));
    assert_eq!((after.channel::<Cuts>(5).map(seen), after.channel::<Labels>(26).map(seen)), (Some((0b101, 0)), Some((0, 9))));
    assert!(after.channel::<Cuts>(26).is_none() && after.channel::<Labels>(5).is_none(), "only where something was written");
    assert!(before.channel::<Cuts>(5).is_none() && before.channel::<Plastic>(5).is_none(), "a snapshot never changes");
    writer.audit().unwrap();
    // a successor finds them, and a version is a copy of the one before
    let mut writer = Writer::open(&world.domain).unwrap();
    assert_eq!((writer.channel::<Plastic>(5).unwrap()[2], writer.channel::<Cuts>(5).map(seen)), (0.25, Some((0b101, 0))));
    let mut t = writer.begin();
    t.channel_mut::<Cuts>(5)[4095] |= 1;
    t.commit();
    assert_eq!((reader.snapshot().channel::<Cuts>(5).map(seen), after.channel::<Cuts>(5).map(seen)), (Some((5, 1)), Some((5, 0))));
    writer.audit().unwrap();
}

#[test]
fn slots_of_any_channel_running_out_puts_the_whole_commit_off() {
    let world = World::new(StoreSizes { cut_slots: 2, ..ALL });
    let (mut writer, reader) = (Writer::open(&world.domain).unwrap(), Reader::open(&world.domain, Role::Rendering).unwrap());
    let mut cut = |id: u32, value: u8, voxel: i16| {
        let mut t = writer.begin();
        t.channel_mut::<Cuts>(id)[0] = value;
        t.brick_mut(id).voxels[0] = voxel;
        (t.commit(), writer.has_room(), writer.publish_deferred())
    };
    assert!(matches!(cut(1, 1, 1).0, CommitOutcome::Published { .. }));
    let stopped = reader.snapshot();
    assert!(matches!(cut(1, 3, 2).0, CommitOutcome::Published { .. }));
    assert_eq!(cut(1, 7, 3), (CommitOutcome::Deferred, false, None), "no slot of cuts is free, so the voxels wait as well");
    assert_eq!(reader.snapshot().brick(1).voxels[0], 2);
    drop(stopped);
    assert_eq!(writer.publish_deferred(), Some(4));
    assert_eq!((reader.snapshot().channel::<Cuts>(1).unwrap()[0], reader.snapshot().brick(1).voxels[0]), (7, 3));
    assert_eq!(writer.publish_deferred(), None);
    writer.audit().unwrap();
}

/// Header of the test's region.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, bytemuck::Pod, bytemuck::Zeroable)]
struct FieldHeader {
    size: [u64; 3],
    spacing: [f64; 3],
    phases: u64,
}

const KIND: &str = "test.Field/v1";
const HEADER: FieldHeader = FieldHeader { size: [4, 5, 6], spacing: [1.0, 1.0, 2.5], phases: 2 };
const VALUES: usize = 4 * 5 * 6 * 2;

fn with_region() -> World {
    let mut world = World::new(StoreSizes::default());
    let fill = |body: &mut [u8]| bytemuck::cast_slice_mut(body).iter_mut().enumerate().for_each(|(n, v)| *v = n as f32);
    world.keeper.add_region(&world.domain, "breathing-0", KIND, &HEADER, VALUES * 4, fill).unwrap();
    world
}

#[test]
fn a_region_is_read_as_it_was_made_and_in_place() {
    let world = with_region();
    let region = Region::<FieldHeader>::open(&world.domain, "breathing-0", KIND).unwrap();
    assert_eq!(region.header(), &HEADER);
    let values: &[f32] = region.body();
    assert!(values.len() == VALUES && values.iter().enumerate().all(|(n, &v)| v == n as f32));
    assert_eq!(values.as_ptr() as usize % 64, 0);
    assert_eq!(world.path("region-breathing-0").metadata().unwrap().len(), Region::<FieldHeader>::segment_bytes(VALUES * 4) as u64);
    use std::os::unix::fs::PermissionsExt;
    assert_eq!(world.path("region-breathing-0").metadata().unwrap().permissions().mode() & 0o777, 0o600);
    // the pages are mapped read-only: the kernel says so
    let maps = std::fs::read_to_string("/proc/self/maps").unwrap();
    let at = values.as_ptr() as usize;
    let line = maps.lines().find(|l| {
        let (low, high) = l.split_once(' ').unwrap().0.split_once('-').unwrap();
        (usize::from_str_radix(low, 16).unwrap()..usize::from_str_radix(high, 16).unwrap()).contains(&at)
    });
    assert!(line.unwrap().contains(" r--s "), "{line:?}");
}

#[test]
fn a_region_of_another_kind_or_damaged_is_refused_with_a_sentence() {
    let says = |world: &World, kind: &str| match Region::<FieldHeader>::open(&world.domain, "breathing-0", kind) {
        Err(error @ (StoreError::Region { .. } | StoreError::Transport(TransportError::Layout { .. }))) => error.to_string(),
        Err(error) => panic!("{error}"),
        Ok(_) => panic!("it was opened"),
    };
    let world = with_region();
    assert!(says(&world, "test.Field/v2").contains(r#"it holds "test.Field/v1", not "test.Field/v2""#));
    let other = Region::<[u64; 2]>::open(&world.domain, "breathing-0", KIND).err().unwrap().to_string();
    assert!(other.contains("56 bytes instead of 16"), "{other}");
    assert!(Region::<FieldHeader>::open(&world.domain, "none", KIND).is_err());
    for name in ["", "a/b", "..", "A", "ö", &"x".repeat(33)] {
        assert!(matches!(Region::<FieldHeader>::open(&world.domain, name, KIND), Err(StoreError::Region { .. })), "{name}");
    }
    // one field of the header after the other, and what is said of it
    let damages: [(u64, u64, &str); 5] = [
        (0, u64::from_le_bytes(*b"mailreg9"), "magic number"),
        (80, 8, "header has 8 bytes"),
        (88, u64::MAX, "header has"),
        (96, u64::MAX, "truncated or damaged"),
        (128, 99, "checksum"),
    ];
    for (offset, word, sentence) in damages {
        let world = with_region();
        let file = std::fs::OpenOptions::new().write(true).open(world.path("region-breathing-0")).unwrap();
        file.write_all_at(&word.to_le_bytes(), BODY_OFFSET as u64 + offset).unwrap();
        let said = says(&world, KIND);
        assert!(said.contains(sentence), "{offset}: {said}");
    }
    for length in [1, 100, 200, 1000, BODY_OFFSET as u64 + 64, BODY_OFFSET as u64 + 1000] {
        let world = with_region();
        std::fs::OpenOptions::new().write(true).open(world.path("region-breathing-0")).unwrap().set_len(length).unwrap();
        assert!(says(&world, KIND).contains("truncated"), "{length}");
    }
}
