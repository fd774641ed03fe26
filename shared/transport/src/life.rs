//! A service's life in the control block: who it is, that it lives, when it should end, how long its loop takes.

use crate::{ControlMap, Domain, TransportError, monotonic_ns};
use maille_contract::{ControlBlock, Role, ServiceCell, ServiceState, Stamp, control::Counter};
use std::sync::atomic::Ordering::Relaxed;

/// Iterations in the first second after ready are not recorded: caches, pages and connections are still cold.
pub const WARM_UP_NS: u64 = 1_000_000_000;

/// A service's handle on its own cell. Dropped in order, it says that the service ended as asked.
pub struct Life {
    control: ControlMap,
    role: Role,
    incarnation: u64,
    ready_ns: u64,
    last_ns: u64,
}

impl Life {
    /// Takes the role's cell. The supervisor has counted the incarnation; a service started by hand counts as the first.
    ///
    /// # Errors
    /// When the domain has no control block of this version.
    pub fn begin(domain: &Domain, role: Role) -> Result<Self, TransportError> {
        let control = ControlMap::open(domain)?;
        let cell = control.service(role);
        cell.pid.store(u64::from(std::process::id()), Relaxed);
        cell.heartbeat_ns.store(monotonic_ns(), Relaxed);
        cell.set_state(ServiceState::Starting);
        if cell.incarnation.load(Relaxed) == 0 {
            cell.incarnation.store(1, Relaxed);
        }
        let incarnation = cell.incarnation.load(Relaxed);
        Ok(Self { control, role, incarnation, ready_ns: u64::MAX, last_ns: 0 })
    }

    /// Says that the loop begins.
    pub fn ready(&mut self) {
        let now = monotonic_ns();
        (self.ready_ns, self.last_ns) = (now, now);
        self.cell().ready_ns.store(now, Relaxed);
        self.cell().heartbeat_ns.store(now, Relaxed);
        self.cell().set_state(ServiceState::Ready);
    }

    /// The control block.
    pub fn control(&self) -> &ControlBlock {
        &self.control
    }

    /// The service's own cell.
    pub fn cell(&self) -> &ServiceCell {
        self.control.service(self.role)
    }

    /// How many times the role was started.
    pub fn incarnation(&self) -> u64 {
        self.incarnation
    }

    /// Beats, and says whether the service should go on. Call it at least every 50 ms.
    #[inline]
    pub fn beat(&self, now_ns: u64) -> bool {
        self.cell().heartbeat_ns.store(now_ns, Relaxed);
        !self.control.should_end(now_ns)
    }

    /// Records one iteration that began at `began_ns` [CLOCK_MONOTONIC] and took `duration_ns`; nothing while warming up.
    /// Allocates nothing. Returns whether it was recorded.
    #[inline]
    pub fn record(&mut self, began_ns: u64, duration_ns: u64, lateness_ns: Option<u64>) -> bool {
        let since_last = began_ns.saturating_sub(self.last_ns);
        self.last_ns = began_ns;
        if began_ns < self.ready_ns.saturating_add(WARM_UP_NS) {
            return false;
        }
        let cell = self.cell();
        cell.count(Counter::Iterations, 1);
        cell.count(Counter::RecordedNs, since_last);
        cell.duration.record(duration_ns);
        if let Some(lateness) = lateness_ns {
            cell.lateness.record(lateness);
        }
        true
    }

    /// Stamp of a message sent now.
    pub fn stamp(&self, sequence: u64) -> Stamp {
        Stamp { time_ns: self.control.time_ns(monotonic_ns()), sequence, incarnation: self.incarnation }
    }
}

impl Drop for Life {
    fn drop(&mut self) {
        if !std::thread::panicking() {
            self.cell().set_state(ServiceState::Ended);
        }
    }
}
