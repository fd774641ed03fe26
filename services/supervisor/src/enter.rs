//! How a service begins its life: under its own name, in a domain that lives, in a role that is free, and bound to end with
//! its supervisor.
//!
//! A child is killed by the kernel when its supervisor dies: nothing that it holds is worth more than not being left over,
//! and this reaches a stopped process too. Not so the haptic process, whose hand should feel the force fade: it, and
//! whatever a person started, has a thread that waits for the supervisor's death, tells the run to stop, and ends the
//! process when it has had [`FADE_TIME`] for that.

use crate::{SupervisorError, stale};
use maille_contract::{Role, RunState, control::ControlBlock};
use maille_transport::{ControlMap, Domain};
use rustix::{
    event::{PollFd, PollFlags, poll},
    process::{Pid, PidfdFlags, Signal, getppid, pidfd_open, set_parent_process_death_signal},
};
use std::{
    ffi::CString,
    sync::atomic::Ordering::{Relaxed, SeqCst},
    time::Duration,
};

/// How long a process may take to end after its supervisor has died; the haptic process fades its force in that time.
const FADE_TIME: Duration = Duration::from_millis(700);

/// Prepares the calling process to be `role` in `domain`; call it on the main thread before anything else.
///
/// With `parent` the process was started by the supervisor of that process id and dies with it. Without, a person starts it,
/// and it claims the role, which the run must have left free (`maille run --by-hand ROLE`, or a role that is not part of it).
///
/// # Errors
/// One sentence when the supervisor is gone, the domain is not running, or the role is taken.
pub fn enter(role: Role, domain: &str, parent: Option<u32>) -> Result<(), SupervisorError> {
    let name = CString::new(role.process_name()).expect("names of roles hold no zero byte");
    rustix::thread::set_name(&name).map_err(SupervisorError::io("the process cannot be named"))?;
    let domain = Domain::named(domain)?;
    match parent {
        Some(parent) if role == Role::Haptic => {
            let control = ControlMap::open(&domain)?;
            outlive_by_a_fade(control, parent)?;
            still_there(parent)
        }
        Some(parent) => {
            // asked for first and checked second, or a supervisor that dies in between would be missed
            set_parent_process_death_signal(Some(Signal::KILL)).map_err(SupervisorError::io(FOLLOW))?;
            still_there(parent)
        }
        None => {
            if !domain.is_alive() {
                return Err(SupervisorError::Refused(format!("the run of {} is over; `maille clean` removes what it left", domain.name())));
            }
            let control = ControlMap::open(&domain)?;
            claim(&control, role, domain.name())?;
            let supervisor = control.supervisor_pid.load(Relaxed) as u32;
            outlive_by_a_fade(control, supervisor)
        }
    }
}

const FOLLOW: &str = "the end of the supervisor cannot be followed";

fn gone(supervisor: u32) -> SupervisorError {
    SupervisorError::Refused(format!(
        "the supervisor {supervisor} of this service is gone; leave --parent away to start a service by hand in a run that lives"
    ))
}

fn still_there(parent: u32) -> Result<(), SupervisorError> {
    let same = getppid().is_some_and(|id| id.as_raw_nonzero().get().unsigned_abs() == parent);
    if same { Ok(()) } else { Err(gone(parent)) }
}

/// Ends this process soon after the supervisor has died.
fn outlive_by_a_fade(control: ControlMap, supervisor: u32) -> Result<(), SupervisorError> {
    let id = i32::try_from(supervisor).ok().and_then(Pid::from_raw).ok_or_else(|| gone(supervisor))?;
    let pidfd = pidfd_open(id, PidfdFlags::empty()).map_err(|_| gone(supervisor))?;
    let wait = move || {
        while !poll(&mut [PollFd::new(&pidfd, PollFlags::IN)], None).is_ok_and(|ready| ready > 0) {}
        // the heir of the supervisor's word: nobody else is left to say it
        control.set_run_state(RunState::Stopping);
        std::thread::sleep(FADE_TIME);
        std::process::exit(1);
    };
    std::thread::Builder::new().name("maille-parent".into()).spawn(wait).map(drop).map_err(SupervisorError::io(FOLLOW))
}

fn claim(control: &ControlBlock, role: Role, domain: &str) -> Result<(), SupervisorError> {
    if control.run_state() != RunState::Running {
        return Err(SupervisorError::Refused(format!(
            "{domain} is starting or ending; try again when `maille run` has printed its processes"
        )));
    }
    // SYNC POINT: claim ↔ the supervisor's `release` after a confirmed death, which makes it 0 again.
    match control.service(role).pid.compare_exchange(0, std::process::id().into(), SeqCst, Relaxed) {
        Ok(_) => Ok(()),
        Err(pid) => Err(SupervisorError::Refused(format!(
            "the service {0} of {domain} runs already as process {pid}; start the run with `maille run --by-hand {0}` to run it yourself",
            role.word()
        ))),
    }
}

/// Names of the runs that live, with the number of their services, for messages.
pub fn living_runs() -> Vec<(String, usize)> {
    let alive = Domain::list().into_iter().filter(Domain::is_alive);
    alive.map(|domain| (domain.name().to_owned(), stale::services_of(domain.name()).len())).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use maille_transport::TransportError;

    #[test]
    fn a_role_is_claimed_once_and_only_while_the_run_runs() {
        let domain = Domain::fresh().unwrap();
        let control = ControlMap::create(&domain).unwrap();
        let refused = |result: Result<(), SupervisorError>| result.unwrap_err().to_string();
        assert!(refused(claim(&control, Role::Haptic, domain.name())).contains("starting or ending"));
        control.set_run_state(RunState::Running);
        claim(&control, Role::Haptic, domain.name()).unwrap();
        assert!(refused(claim(&control, Role::Haptic, domain.name())).contains("--by-hand haptic"));
        assert_eq!(control.service(Role::Haptic).pid.load(Relaxed), u64::from(std::process::id()));
        drop(control);
        domain.remove().unwrap();
    }

    #[test]
    fn a_domain_that_does_not_run_is_refused() {
        let error = enter(Role::Rendering, "maille_ffffffff", None).unwrap_err();
        assert!(matches!(error, SupervisorError::Transport(TransportError::NoDomain { .. })), "{error}");
    }
}
