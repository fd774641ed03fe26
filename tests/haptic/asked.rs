//! A haptic process that is asked to end by a signal lets the hand go first: Ctrl-C where it was started by hand, the end of a session, a shutdown.

use crate::device::{drive, norm, steps};
use crate::support::{Scratch, eventually, signal};
use crate::{STEP_N, ended, pressing, started, tool};
use maille_contact::Grip;
use maille_contract::{Role, ServiceState};
use rustix::process::Signal;
use std::{
    sync::atomic::{AtomicBool, Ordering::Relaxed},
    time::Duration,
};

#[test]
fn a_haptic_process_that_is_asked_to_end_fades_first_and_is_started_again() {
    let scratch = Scratch::new("haptic-asked");
    let (run, domain, control) = started(&scratch, &pressing("external", ""), &[]);
    let way = crate::device::way(&domain);
    let stop = AtomicBool::new(false);
    let signals = [Signal::INT, Signal::TERM, Signal::HUP];
    let felt = std::thread::scope(|scope| {
        let hand = scope.spawn(|| drive(&control, &way, Grip::FULL, &stop));
        let asked = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| {
            for (n, by) in signals.into_iter().enumerate() {
                eventually("the hand presses", || norm(tool(&control).force_n) > 0.3);
                signal(control.service(Role::Haptic).pid.load(Relaxed) as u32, by);
                eventually("it is started again", || {
                    let cell = control.service(Role::Haptic);
                    cell.restarts.load(Relaxed) == n as u64 + 1 && cell.state() == ServiceState::Ready
                });
                // a process that lives for a second is started again at once
                std::thread::sleep(Duration::from_millis(1_500));
            }
        }));
        stop.store(true, Relaxed);
        let felt = hand.join().expect("the device works");
        asked.map(|()| felt).unwrap_or_else(|panic| std::panic::resume_unwind(panic))
    });
    drop(control);
    ended(run, &domain);
    let largest = steps(&felt).map(|(_, step)| step).fold(0.0, f64::max);
    for ended in 1..=signals.len() as u64 {
        let last = felt.iter().rfind(|felt| felt.incarnation == ended).expect("it has said something");
        let most = felt.iter().filter(|felt| felt.incarnation == ended).map(|felt| norm(felt.told_n)).fold(0.0, f64::max);
        println!("incarnation {ended}: at most {most:.2} N, at its end {:.3} N", norm(last.told_n));
        assert!(most > 0.3 && last.told_n == [0.0; 3], "{last:?}");
    }
    assert!(largest <= STEP_N, "{largest} N in one tick");
}
