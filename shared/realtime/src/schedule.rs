//! Asking the system to be punctual: SCHED_FIFO, one CPU, small timer slack, locked pages.
//!
//! Where SCHED_FIFO is refused, the thread asks for the shortest time slice instead, which needs no rights: since Linux 6.12
//! the fair scheduler takes a slice per thread, and one that asks for 0.1 ms preempts those with slices of some milliseconds
//! when it wakes. Older kernels ignore the wish. On two cores with four busy threads it halved the p99 of lateness, 2.0 to 0.9 ms.
//!
//! Each step may be refused (rights, limits, containers); a refusal is a [`Notice`], one sentence that says what follows
//! and what to do, and the thread goes on without. The steps concern the calling thread only, except [`lock_memory`].
//!
//! Pages are locked as they are touched (`MCL_ONFAULT`) and only those of mappings that exist at the call: `MCL_FUTURE`
//! would make every later mapping of a volume fail under the usual RLIMIT_MEMLOCK of 8 MiB, and plain `MCL_CURRENT` would
//! fault in every reserved page. So call it last, when all segments are open.

use libc::{c_int, c_ulong};
use std::fmt;

/// One sentence on what could not be had and what that means.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Notice(pub String);

impl fmt::Display for Notice {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

/// Timer slack asked for [ns]: the smallest the kernel takes. The default of 50 µs is added to every wake-up outside the
/// real-time classes.
const TIMER_SLACK_NS: c_ulong = 1;

/// Time slice asked for where SCHED_FIFO is refused [ns]: the smallest the kernel takes.
const SLICE_NS: u64 = 100_000;

/// Makes the calling thread real-time as far as allowed: SCHED_FIFO at `priority` (at most 99; with 0 or less it stays in its class), pinned to `cpu` if one
/// is given, timer slack 1 ns. Threads it starts later do not inherit the class. Returns what was refused; empty when all was
/// granted.
pub fn enter_realtime(priority: i32, cpu: Option<usize>) -> Vec<Notice> {
    let mut notices = Vec::new();
    let mut tell = |outcome: Result<(), std::io::Error>, what: &str| {
        if let Err(error) = outcome {
            notices.push(Notice(format!("{what} ({error})")));
        }
    };
    if let Some(cpu) = cpu {
        tell(pin(cpu), &format!("the thread could not be pinned to CPU {cpu}, it runs on any; choose a CPU that `nproc` counts"));
    }
    tell(set_timer_slack(), "the timer slack could not be lowered, wake-ups come up to 50 µs late");
    let fifo = if priority > 0 { set_fifo(priority.min(99)) } else { Ok(()) };
    if fifo.is_err() || priority <= 0 {
        // without the class, the next best thing, and no notice of its own: the one on SCHED_FIFO says what to do
        let _ = set_slice(SLICE_NS);
    }
    tell(
        fifo,
        "SCHED_FIFO was refused, the loop runs at ordinary priority and other programs can delay it; \
         allow it with `ulimit -r 80`, an rtprio line in /etc/security/limits.conf, or CAP_SYS_NICE",
    );
    notices
}

/// CPUs that the calling thread may run on, in order.
pub fn allowed_cpus() -> Vec<usize> {
    // SAFETY: cpu_set_t is plain bits; all zeros is the empty set.
    let mut set: libc::cpu_set_t = unsafe { std::mem::zeroed() };
    // SAFETY: the set is valid for the size given and outlives the call; 0 is the calling thread.
    let status = unsafe { libc::sched_getaffinity(0, size_of::<libc::cpu_set_t>(), &mut set) };
    if status < 0 {
        return Vec::new();
    }
    // SAFETY: every number asked for is below CPU_SETSIZE, so the bit lies inside the set.
    (0..libc::CPU_SETSIZE as usize).filter(|&cpu| unsafe { libc::CPU_ISSET(cpu, &set) }).collect()
}

/// Keeps the calling thread on one CPU; its class and priority stay as they are.
pub fn pin_to_cpu(cpu: usize) -> Option<Notice> {
    pin(cpu).err().map(|error| Notice(format!("the thread could not be pinned to CPU {cpu}, it runs on any ({error})")))
}

/// Locks the pages of all present mappings in memory as they are touched. Returns a notice when that is refused.
pub fn lock_memory() -> Option<Notice> {
    // SAFETY: mlockall takes flags only and changes no memory content.
    let status = unsafe { libc::mlockall(libc::MCL_CURRENT | libc::MCL_ONFAULT) };
    checked(status).err().map(|error| {
        Notice(format!(
            "memory could not be locked ({error}), a page fault may delay a tick; raise it with `ulimit -l unlimited` or CAP_IPC_LOCK"
        ))
    })
}

/// Touches 64 KiB of stack so that no tick faults it in.
#[inline(never)]
pub fn prefault_stack() {
    let pages = [0u8; 64 * 1024];
    std::hint::black_box(&pages);
}

/// Whether the calling thread runs under SCHED_FIFO now.
pub fn is_fifo() -> bool {
    // SAFETY: takes a thread id only; 0 is the calling thread.
    let policy = unsafe { libc::sched_getscheduler(0) };
    policy >= 0 && policy & !libc::SCHED_RESET_ON_FORK == libc::SCHED_FIFO
}

fn set_fifo(priority: c_int) -> Result<(), std::io::Error> {
    let parameters = libc::sched_param { sched_priority: priority };
    // SAFETY: `parameters` is a valid sched_param that outlives the call; 0 is the calling thread.
    checked(unsafe { libc::sched_setscheduler(0, libc::SCHED_FIFO | libc::SCHED_RESET_ON_FORK, &parameters) })
}

/// Asks the fair scheduler for a time slice [ns]; class and nice value stay as they are.
fn set_slice(slice_ns: u64) -> Result<(), std::io::Error> {
    let mut attributes = attributes()?;
    attributes.sched_runtime = slice_ns;
    // SAFETY: `attributes` is a valid sched_attr that outlives the call, its size is in it; 0 is the calling thread; no flags.
    checked(unsafe { libc::syscall(libc::SYS_sched_setattr, 0, &raw const attributes, 0) } as c_int)
}

/// Scheduling attributes of the calling thread.
fn attributes() -> Result<libc::sched_attr, std::io::Error> {
    // SAFETY: sched_attr is plain numbers; all zeros is a valid one.
    let mut attributes: libc::sched_attr = unsafe { std::mem::zeroed() };
    let size = size_of::<libc::sched_attr>();
    // SAFETY: the kernel writes at most `size` bytes, which is the size of `attributes`; 0 is the calling thread; no flags.
    checked(unsafe { libc::syscall(libc::SYS_sched_getattr, 0, &raw mut attributes, size, 0) } as c_int)?;
    Ok(attributes)
}

fn set_timer_slack() -> Result<(), std::io::Error> {
    // SAFETY: PR_SET_TIMERSLACK takes one integer and touches no memory of ours.
    checked(unsafe { libc::prctl(libc::PR_SET_TIMERSLACK, TIMER_SLACK_NS, 0, 0, 0) })
}

fn pin(cpu: usize) -> Result<(), std::io::Error> {
    if cpu >= libc::CPU_SETSIZE as usize {
        return Err(std::io::Error::from_raw_os_error(libc::EINVAL));
    }
    // SAFETY: cpu_set_t is plain bits; all zeros is the empty set.
    let mut set: libc::cpu_set_t = unsafe { std::mem::zeroed() };
    // SAFETY: `cpu` is below CPU_SETSIZE, checked above, so the bit lies inside the set.
    unsafe { libc::CPU_SET(cpu, &mut set) };
    // SAFETY: the set is valid for the size given and outlives the call; 0 is the calling thread.
    checked(unsafe { libc::sched_setaffinity(0, size_of::<libc::cpu_set_t>(), &set) })
}

fn checked(status: c_int) -> Result<(), std::io::Error> {
    if status < 0 { Err(std::io::Error::last_os_error()) } else { Ok(()) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_pinned_thread_may_run_on_that_cpu_only() {
        let cpus = allowed_cpus();
        std::thread::spawn(move || {
            let last = *cpus.last().expect("a thread runs somewhere");
            assert_eq!(pin_to_cpu(last), None);
            assert_eq!(allowed_cpus(), [last]);
            assert!(pin_to_cpu(usize::MAX).is_some());
        })
        .join()
        .unwrap();
    }

    /// Whatever the rights of who runs the tests, each refusal is told and nothing is fatal; a CPU that cannot exist is
    /// always refused.
    #[test]
    fn what_is_refused_is_told_in_a_sentence() {
        std::thread::spawn(|| {
            let notices = enter_realtime(1_000, Some(usize::MAX));
            assert!(notices.iter().any(|n| n.0.contains("could not be pinned")));
            assert_eq!(is_fifo(), !notices.iter().any(|n| n.0.contains("SCHED_FIFO")), "granted, or told");
            if let Some(notice) = lock_memory() {
                assert!(notice.to_string().contains("ulimit -l"));
            }
            prefault_stack();
        })
        .join()
        .unwrap();
    }

    /// A kernel before 6.12 keeps no slice for threads of the fair class and reports 0.
    #[test]
    fn where_fifo_is_refused_the_slice_is_the_shortest_and_the_nice_value_stays() {
        std::thread::spawn(|| {
            let before = attributes().expect("attributes can be read");
            enter_realtime(1, None);
            if !is_fifo() {
                let after = attributes().expect("attributes can be read");
                assert!([0, SLICE_NS].contains(&after.sched_runtime), "{} ns", after.sched_runtime);
                assert_eq!((after.sched_policy, after.sched_nice), (before.sched_policy, before.sched_nice));
            }
        })
        .join()
        .unwrap();
    }

    #[test]
    fn the_class_is_not_inherited() {
        std::thread::spawn(|| {
            enter_realtime(1, None);
            assert!(!std::thread::spawn(is_fifo).join().unwrap());
        })
        .join()
        .unwrap();
    }
}
