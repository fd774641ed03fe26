//! Working memory of a push: what the mail holds when it is done, and what it held at most on the way, by the element moved.
//!
//! Counted by an allocator; one test in this file, so that nothing else allocates.

mod common;

use common::{Random, volume};
use maille_chainmail::{ChainMail, Motion, Pin, Tissue};
use maille_volume::BrickSource;
use std::{
    alloc::{GlobalAlloc, Layout, System},
    sync::atomic::{AtomicUsize, Ordering},
};

static HELD: AtomicUsize = AtomicUsize::new(0);
static MOST: AtomicUsize = AtomicUsize::new(0);

/// The system's allocator, with a count of the bytes in use.
struct Counting;

// SAFETY: every call goes to `System` with the arguments it came with; the counters are no part of the memory.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        let now = HELD.fetch_add(layout.size(), Ordering::Relaxed) + layout.size();
        MOST.fetch_max(now, Ordering::Relaxed);
        // SAFETY: the caller upholds `GlobalAlloc::alloc`'s contract, which is `System`'s.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        HELD.fetch_sub(layout.size(), Ordering::Relaxed);
        // SAFETY: the caller upholds `GlobalAlloc::dealloc`'s contract, which is `System`'s.
        unsafe { System.dealloc(pointer, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

/// Bytes held after the last push and at most during the pushes, beyond those before them, by element moved.
fn bytes_an_element(varying: bool, tissue: Tissue, pushes: &[Pin]) -> (f64, f64, u64) {
    let mut random = Random(4);
    let rest = volume([176, 176, 176], [1.0; 3], |_, _, _| if varying { random.within(-1000.0, 600.0) as i16 } else { 40 });
    let mut mail = ChainMail::new(rest.info(), tissue);
    let before = HELD.load(Ordering::Relaxed);
    MOST.store(before, Ordering::Relaxed);
    for pin in pushes {
        mail.push(&rest, &[*pin]);
    }
    let (after, most) = (HELD.load(Ordering::Relaxed), MOST.load(Ordering::Relaxed));
    let region = mail.displaced_region();
    let moved = region.bricks.iter().map(|b| {
        let brick = mail.displacement_brick(b.id).unwrap();
        (0..brick.u[0].len()).filter(|&n| brick.u.iter().any(|plane| plane[n] != 0.0)).count() as u64
    });
    let moved: u64 = moved.sum();
    ((after - before) as f64 / moved as f64, (most - before) as f64 / moved as f64, moved)
}

#[test]
fn a_moved_element_takes_at_most_64_bytes() {
    let one = Tissue { offset: 0.1, density_scaling: false, bone_hu: None, ..Tissue::default() };
    let by = |v: [f32; 3]| Pin { voxel: [88; 3], motion: Motion::By(v) };
    // some 6·10⁵ elements each
    for (name, varying, tissue, pushes) in [
        ("one material, from rest", false, one, vec![by([0.0, 7.6, 0.0])]),
        (
            "varying, oblique, on deformed tissue",
            true,
            Tissue { offset: 0.2, density_scaling: true, ..one },
            vec![by([4.0, 3.0, -5.0]), by([8.0, -14.5, 12.0])],
        ),
    ] {
        let (held, most, moved) = bytes_an_element(varying, tissue, &pushes);
        println!("{name}: {moved} elements moved, {held:.1} bytes each held afterwards, {most:.1} at most on the way");
        assert!(moved > 300_000, "{name}: {moved}");
        assert!(most <= 64.0, "{name}: {most} bytes");
    }
}
