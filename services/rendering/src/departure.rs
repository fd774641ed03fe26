//! A stop that is heard in the midst of a frame.
//!
//! The loop hears a stop between frames; a frame at full size through a patient who breathes, on a machine that others use too, or the search for a lattice
//! before the first one, may take seconds. So a thread of its own listens, and ends the process when the loop has not by [`GRACE`]. Nothing is lost by that: rendering
//! only reads the store, whose pins are let go of when their process is gone, and its pictures are nobody's after a stop.
//!
//! Cost: twenty looks a second at one word of shared memory.

use maille_contract::{Role, ServiceState};
use maille_transport::{ControlMap, Domain, TransportError, monotonic_ns};
use std::{
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering::Relaxed},
    },
    thread,
    time::Duration,
};

/// How long the loop has to end in order: less than half of what the supervisor waits before it kills.
const GRACE: Duration = Duration::from_millis(400);
/// From one look to the next.
const LOOK: Duration = Duration::from_millis(50);

/// Listens until it is dropped.
pub(crate) struct Departure(Arc<AtomicBool>);

impl Departure {
    /// Begins to listen; this process ends when the run does, whatever its loop is at.
    pub fn listen(domain: &Domain) -> Result<Self, TransportError> {
        let (control, over) = (ControlMap::open(domain)?, Arc::new(AtomicBool::new(false)));
        let ended = Arc::clone(&over);
        let listen = move || {
            let mut asked_ns = None;
            while !ended.load(Relaxed) {
                let now = monotonic_ns();
                if control.should_end(now) {
                    let since = now - *asked_ns.get_or_insert(now);
                    if since > GRACE.as_nanos() as u64 {
                        control.service(Role::Rendering).set_state(ServiceState::Ended);
                        std::process::exit(0);
                    }
                } else {
                    asked_ns = None;
                }
                thread::sleep(LOOK);
            }
        };
        // without the thread a stop is heard between frames, as ever
        drop(thread::Builder::new().name("departure".into()).spawn(listen));
        Ok(Self(over))
    }
}

impl Drop for Departure {
    fn drop(&mut self) {
        self.0.store(true, Relaxed);
    }
}
