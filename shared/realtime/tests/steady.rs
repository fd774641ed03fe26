//! The allocation guard, with the allocator installed.

use maille_realtime::{CountingAllocator, Period, assert_steady, guard_installed, monotonic_ns, steady};

#[global_allocator]
static ALLOCATOR: CountingAllocator = CountingAllocator;

#[test]
fn every_call_to_the_allocator_is_counted() {
    assert!(guard_installed());
    let (mut list, calls) = steady(|| Vec::<u64>::with_capacity(4));
    assert_eq!(calls, 1);
    let (_, calls) = steady(|| list.extend(0..4));
    assert_eq!(calls, 0, "room was there");
    let (_, calls) = steady(|| list.push(4));
    assert_eq!(calls, 1, "growing");
    let (_, calls) = steady(|| drop(list));
    assert_eq!(calls, 1, "freeing");
}

#[test]
fn other_threads_do_not_count() {
    let (stop, stopped) = std::sync::mpsc::channel::<()>();
    let busy = std::thread::spawn(move || {
        while stopped.try_recv() == Err(std::sync::mpsc::TryRecvError::Empty) {
            std::hint::black_box(vec![0u8; 100]);
        }
    });
    let until = monotonic_ns() + 5_000_000;
    assert_steady(|| while monotonic_ns() < until {});
    drop(stop);
    busy.join().unwrap();
}

#[test]
fn a_periodic_loop_allocates_nothing() {
    let mut period = Period::new(1000.0);
    let mut latest = 0;
    assert_steady(|| {
        for _ in 0..20 {
            latest = period.wait().scheduled_ns;
        }
    });
    assert!(latest > 0 && period.ticks() >= 20);
}

#[test]
#[should_panic(expected = "called the allocator")]
fn an_allocation_in_a_steady_section_is_fatal_in_tests() {
    assert_steady(|| std::hint::black_box(Box::new(1)));
}
