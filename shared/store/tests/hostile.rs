//! Shared memory is an allegation: whatever stands in it, opening answers with a sentence, and reading with a value or a panic that names
//! the damage. Never a fault, never a reference outside the mapping, never a wait.

use maille_contract::{
    Role,
    index::{ABSENT, IndexHeader, IndexLayout},
    segment_header::{BODY_OFFSET, checksum},
};
use maille_store::{Cuts, Labels, Plastic, Reader, StoreError, StoreKeeper, StoreSizes, Writer};
use maille_transport::{ControlMap, Domain};
use maille_volume::{BrickSource, Grid, Rescale, Volume};
use std::{
    fs::{File, OpenOptions},
    mem::offset_of,
    os::unix::fs::FileExt,
    panic::{AssertUnwindSafe, catch_unwind},
    path::PathBuf,
};

const SIZES: StoreSizes =
    StoreSizes { spare_slots: 40, displacement_slots: 40, plastic_slots: 40, cut_slots: 40, label_slots: 40, octree_slots: 0 };
const BRICKS: u32 = 27;

fn volume() -> Volume {
    let grid = Grid::axis_aligned([48; 3], [1.0; 3]);
    let voxels = vec![40; grid.voxel_count()];
    Volume::new(grid, Rescale { slope: 1.0, intercept: 0.0 }, voxels)
}

struct World {
    domain: Domain,
    _control: ControlMap,
    _keeper: StoreKeeper,
}

impl World {
    fn new() -> Self {
        let domain = Domain::fresh().unwrap();
        let control = ControlMap::create(&domain).unwrap();
        let keeper = StoreKeeper::create(&domain, &volume(), SIZES, |_| {}).unwrap();
        let world = Self { domain, _control: control, _keeper: keeper };
        let mut writer = Writer::open(&world.domain).unwrap();
        for id in 0..6 {
            let mut t = writer.begin();
            t.brick_mut(id).voxels.fill(7);
            t.displacement_mut(id).fill(0.5);
            t.channel_mut::<Plastic>(id).fill(0.25);
            t.channel_mut::<Cuts>(id).fill(1);
            t.channel_mut::<Labels>(id).fill(2);
            t.state_mut()[0] = id as u8;
            t.commit();
        }
        world
    }

    fn file(&self, segment: &str) -> File {
        let path = PathBuf::from("/dev/shm").join(self.domain.segment_name(segment));
        OpenOptions::new().read(true).write(true).open(path).unwrap()
    }

    fn word(&self, at: usize) -> u64 {
        let mut bytes = [0; 8];
        self.file("index").read_exact_at(&mut bytes, (BODY_OFFSET + at) as u64).unwrap();
        u64::from_ne_bytes(bytes)
    }

    fn write(&self, at: usize, word: u64) {
        self.file("index").write_all_at(&word.to_ne_bytes(), (BODY_OFFSET + at) as u64).unwrap();
    }

    /// Makes the checksum agree with the layout: who damages on purpose can do that as well.
    fn sum_again(&self) {
        let mut bytes = vec![0; size_of::<IndexLayout>()];
        self.file("index").read_exact_at(&mut bytes, (BODY_OFFSET + LAYOUT) as u64).unwrap();
        self.write(offset_of!(IndexHeader, checksum), checksum(&bytes));
    }

    /// What reader and writer say when they open; neither panics.
    fn refusals(&self) -> [Option<String>; 2] {
        let reader = catch_unwind(AssertUnwindSafe(|| Reader::open(&self.domain, Role::Haptic).err())).expect("a reader opens or refuses");
        let writer = catch_unwind(AssertUnwindSafe(|| Writer::open(&self.domain).err())).expect("a writer opens or refuses");
        [reader, writer].map(|error| error.map(|e| e.to_string()))
    }
}

impl Drop for World {
    fn drop(&mut self) {
        self.domain.remove().unwrap();
    }
}

const LAYOUT: usize = offset_of!(IndexHeader, layout);
const HEAD: usize = offset_of!(IndexHeader, head);
/// Where the root pages begin.
const ROOTS: usize = size_of::<IndexHeader>();

#[test]
fn another_magic_number_another_version_or_an_unfinished_store_is_refused() {
    for (magic, sentence) in
        [(0, "still being made"), (u64::from_le_bytes(*b"mailidx1"), "another version"), (u64::MAX, "another magic number")]
    {
        let world = World::new();
        world.write(0, magic);
        for said in world.refusals() {
            assert!(said.as_ref().is_some_and(|s| s.contains(sentence)), "{magic:#x}: {said:?}");
        }
    }
}

#[test]
fn every_segment_cut_short_is_refused_by_its_name() {
    for segment in ["index", "rest", "versions", "displacement", "plastic", "cuts", "labels", "state"] {
        let world = World::new();
        let file = world.file(segment);
        let length = file.metadata().unwrap().len();
        for shorter in [length - 1, length / 2, 4095, 64, 1] {
            file.set_len(shorter).unwrap();
            for said in world.refusals() {
                let said = said.unwrap_or_else(|| panic!("{segment} of {shorter} bytes instead of {length} was opened"));
                assert!(said.contains(segment) && (said.contains("truncated") || said.contains("index")), "{segment}: {said}");
            }
        }
        std::fs::remove_file(PathBuf::from("/dev/shm").join(world.domain.segment_name(segment))).unwrap();
        assert!(world.refusals().iter().all(|said| said.as_ref().is_some_and(|s| s.contains(segment))), "{segment} is missing");
    }
}

#[test]
fn sizes_that_overflow_or_disagree_are_refused_even_with_a_right_checksum() {
    let channel = |n: usize, field: usize| offset_of!(IndexLayout, channels) + 24 * n + 8 * field;
    let mut damages: Vec<(usize, u64)> = Vec::new();
    for at in [offset_of!(IndexLayout, size), offset_of!(IndexLayout, size) + 16] {
        damages.extend([0, 49, 1 << 20, 1 << 40, u64::MAX, u64::MAX / 48].map(|v| (at, v)));
    }
    for n in 0..6 {
        damages.extend([1, 26, 28, 1 << 33, u64::MAX].map(|v| (channel(n, 0), if n == 2 && v == 1 { 2 } else { v })));
        damages.extend([u64::from(ABSENT), 1 << 40, u64::MAX, u64::MAX / 16 + 2].map(|v| (channel(n, 1), v)));
        damages.extend([0, 1, 4095, u64::MAX].map(|v| (channel(n, 2), v)));
    }
    damages.extend([0, 1, 1 << 31, u64::MAX].map(|v| (offset_of!(IndexLayout, root_len), v)));
    damages.extend([0, 1 << 16, 1 << 40, u64::MAX].map(|v| (offset_of!(IndexLayout, root_count), v)));
    damages.extend([0, 1 << 31, 1 << 60, u64::MAX].map(|v| (offset_of!(IndexLayout, leaf_count), v)));
    damages.extend([0, 8, 32].map(|v| (offset_of!(IndexLayout, brick), v)));
    damages.extend([f64::NAN, f64::INFINITY, 0.0, -1.0].map(|v| (offset_of!(IndexLayout, spacing), v.to_bits())));
    damages.push((offset_of!(IndexLayout, origin), f64::NAN.to_bits()));
    damages.push((offset_of!(IndexLayout, direction), f64::NAN.to_bits()));
    damages.extend([f64::NAN, f64::INFINITY].map(|v| (offset_of!(IndexLayout, rescale), v.to_bits())));
    let world = World::new();
    assert_eq!(world.refusals(), [None, None]);
    for &(at, value) in &damages {
        let right = world.word(LAYOUT + at);
        world.write(LAYOUT + at, value);
        assert!(world.refusals().iter().all(|s| s.as_ref().is_some_and(|s| s.contains("checksum"))), "word {at} = {value:#x}");
        world.sum_again();
        let said = world.refusals();
        assert!(said.iter().all(Option::is_some), "word {at} = {value:#x} was taken: {said:?}");
        world.write(LAYOUT + at, right);
        world.sum_again();
    }
    assert_eq!(world.refusals(), [None, None], "and mended it opens again");
    println!("{} damaged layouts refused", damages.len());
}

/// Reads everything that a snapshot can give.
fn read_all(reader: &Reader) -> u64 {
    let snapshot = reader.snapshot();
    let mut sum = snapshot.epoch() ^ u64::from(snapshot.state()[0]);
    for id in 0..BRICKS {
        let brick = snapshot.brick(id);
        sum = sum.wrapping_mul(31) ^ brick.voxels[0] as u64 ^ brick.voxels[6858] as u64 ^ snapshot.stamp(id);
        sum ^= snapshot.displacement(id).map_or(0, |d| u64::from(d[0].to_bits() ^ d[12287].to_bits()));
        sum ^= snapshot.channel::<Plastic>(id).map_or(0, |d| u64::from(d[12287].to_bits()));
        sum ^= snapshot.channel::<Cuts>(id).map_or(0, |c| u64::from(c[4095]));
        sum ^= snapshot.channel::<Labels>(id).map_or(0, |c| u64::from(c[4095]));
    }
    sum
}

fn quietly<T>(f: impl FnOnce() -> T) -> T {
    let hook = std::panic::take_hook();
    std::panic::set_hook(Box::new(|_| {}));
    let result = f();
    std::panic::set_hook(hook);
    result
}

/// What a panic says.
fn words(payload: &(dyn std::any::Any + Send)) -> String {
    payload.downcast_ref::<String>().cloned().or_else(|| payload.downcast_ref::<&str>().map(|s| (*s).into())).unwrap_or_default()
}

#[test]
fn indices_damaged_while_processes_run_are_found_before_they_are_used() {
    let world = World::new();
    let (reader, mut writer) = (Reader::open(&world.domain, Role::Haptic).unwrap(), Writer::open(&world.domain).unwrap());
    let truth = read_all(&reader);
    let words_of_pages = (world.file("index").metadata().unwrap().len() as usize - BODY_OFFSET - ROOTS) / 4;
    let mut random = 1u64;
    let mut next = move || {
        random = random.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let z = (random ^ (random >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z ^ (z >> 27)
    };
    // the head itself: a root that is not there
    for root in [64, 65_535] {
        let head = world.word(HEAD);
        world.write(HEAD, head & !0xFFFF | root);
        let said = quietly(|| catch_unwind(AssertUnwindSafe(|| read_all(&reader)))).expect_err("no such root");
        assert!(words(&*said).contains(&format!("root page {root}: the index is damaged")), "{}", words(&*said));
        assert!(world.refusals()[1].as_ref().is_some_and(|s| s.contains("root pages")), "a writer refuses it");
        world.write(HEAD, head);
    }
    // pages: the ones in use first, then anything
    let head_root = (world.word(HEAD) & 0xFFFF) as usize;
    let root_len = world.word(LAYOUT + offset_of!(IndexLayout, root_len)) as usize;
    let (mut found, mut harmless) = (0, 0);
    for round in 0..3000 {
        let at = if round % 2 == 0 { head_root * root_len + next() as usize % root_len } else { next() as usize % words_of_pages };
        let at = ROOTS + at * 4;
        let mut right = [0; 4];
        world.file("index").read_exact_at(&mut right, (BODY_OFFSET + at) as u64).unwrap();
        let wrong = match next() % 4 {
            0 => u32::MAX - 1,
            1 => (next() % 4096) as u32,
            2 => u32::from_ne_bytes(right) ^ 1 << (next() % 32),
            _ => next() as u32,
        };
        world.file("index").write_all_at(&wrong.to_ne_bytes(), (BODY_OFFSET + at) as u64).unwrap();
        match quietly(|| catch_unwind(AssertUnwindSafe(|| read_all(&reader)))) {
            Ok(_) => harmless += 1,
            Err(payload) => {
                assert!(words(&*payload).contains("the index is damaged"), "{}", words(&*payload));
                found += 1;
            }
        }
        // a writer that starts refuses, or finds pages that could be
        quietly(|| world.refusals());
        world.file("index").write_all_at(&right, (BODY_OFFSET + at) as u64).unwrap();
    }
    println!("{found} damaged indices found by a reader, {harmless} pointed nowhere wrong or were not in use");
    assert!(found > 100 && harmless > 100);
    // nothing was written by all this; records are a writer's own, which it rebuilds
    assert_eq!(read_all(&reader), truth);
    let mut t = writer.begin();
    t.brick_mut(0).voxels[0] = 1;
    t.commit();
    drop(writer);
    Writer::open(&world.domain).unwrap().audit().unwrap();
}

#[test]
fn too_little_shared_memory_is_an_error_at_creation_that_says_how_much_is_needed() {
    let domain = Domain::fresh().unwrap();
    // 2^32 - 3 bricks of 13.6 KiB: no machine has that
    let slots = ABSENT as usize - 100;
    let error = StoreKeeper::create(&domain, &volume(), StoreSizes { spare_slots: slots, ..SIZES }, |_| {}).err().unwrap();
    let StoreError::Room { needed_mib, free_mib } = error else { panic!("{error}") };
    assert!(needed_mib as usize > slots / 100 && free_mib < needed_mib, "{needed_mib} {free_mib}");
    assert!(error.to_string().contains("/dev/shm has not enough room") && error.to_string().contains(&needed_mib.to_string()));
    for segment in ["index", "rest", "versions"] {
        assert!(!PathBuf::from("/dev/shm").join(domain.segment_name(segment)).exists(), "{segment} was begun all the same");
    }
    for slots in [ABSENT as usize, 1 << 60, usize::MAX] {
        for sizes in [StoreSizes { spare_slots: slots, ..SIZES }, StoreSizes { cut_slots: slots, ..SIZES }] {
            let error = StoreKeeper::create(&domain, &volume(), sizes, |_| {}).err().unwrap().to_string();
            assert!(error.contains("slots"), "{error}");
        }
    }
    domain.remove().unwrap();
}
