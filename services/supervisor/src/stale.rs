//! What dead runs left: orphans to end and memory to remove.
//!
//! A run is dead when nobody holds its lock ([`Domain::is_alive`]); a living one is never touched. Its orphans are the
//! processes of this program whose command line names exactly that domain. They are stopped through a pidfd that was
//! opened before the command line was read again, so that a reused process id cannot be hit.

use crate::{
    SupervisorError,
    memory::{MIB, SHARED_MEMORY},
};
use maille_transport::Domain;
use rustix::{
    event::{PollFd, PollFlags, Timespec, poll},
    process::{Pid, PidfdFlags, Signal, pidfd_open, pidfd_send_signal},
};
use std::{fmt, fs, path::Path};

/// What was removed of one dead run.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Removed {
    /// its domain
    pub domain: String,
    /// services that were still alive, by role and process id
    pub orphans: Vec<(String, u32)>,
    /// files removed
    pub files: usize,
    /// bytes of them
    pub bytes: u64,
}

impl fmt::Display for Removed {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "removed what the dead run {} left: {} files, {:.1} MiB", self.domain, self.files, self.bytes as f64 / MIB)?;
        self.orphans.iter().try_for_each(|(role, pid)| write!(f, ", {role} (pid {pid}) ended"))
    }
}

/// Ends the orphans of all dead runs and removes their memory. Runs that live are left alone; so is one that is being
/// cleaned by somebody else at the same time.
pub fn clean_dead_runs() -> Result<Vec<Removed>, SupervisorError> {
    let mut removed = Vec::new();
    Domain::remove_unfinished();
    for domain in Domain::list().into_iter().filter(|domain| !domain.is_alive()) {
        let mut orphans = Vec::new();
        for (pid, role) in services_of(domain.name()) {
            if end(pid, domain.name()) {
                orphans.push((role, pid));
            }
        }
        let bytes = bytes_of(domain.name());
        let files = domain.remove()?;
        if files > 0 || !orphans.is_empty() {
            removed.push(Removed { domain: domain.name().to_owned(), orphans, files, bytes });
        }
    }
    Ok(removed)
}

/// Process ids and roles of the services whose command line names the domain.
pub fn services_of(domain: &str) -> Vec<(u32, String)> {
    let Ok(entries) = fs::read_dir("/proc") else { return Vec::new() };
    let pids = entries.flatten().filter_map(|entry| entry.file_name().to_str()?.parse().ok());
    pids.filter(|&pid| pid != std::process::id()).filter_map(|pid| Some((pid, role_in(&read_command_line(pid)?, domain)?))).collect()
}

fn read_command_line(pid: u32) -> Option<Vec<u8>> {
    fs::read(format!("/proc/{pid}/cmdline")).ok()
}

/// The role in a service's command line, if it is one of this domain: `… service ROLE --domain DOMAIN …`.
fn role_in(command_line: &[u8], domain: &str) -> Option<String> {
    let words: Vec<&[u8]> = command_line.split(|&b| b == 0).collect();
    let with_equals = format!("--domain={domain}");
    let role = words.get(2).filter(|_| words[1] == b"service")?;
    let named = words.windows(2).any(|w| w[0] == b"--domain" && w[1] == domain.as_bytes()) || words.contains(&with_equals.as_bytes());
    named.then(|| String::from_utf8_lossy(role).into_owned())
}

/// Kills a service of a dead domain and waits for its end, half a second at most.
fn end(pid: u32, domain: &str) -> bool {
    let Some(id) = i32::try_from(pid).ok().and_then(Pid::from_raw) else { return false };
    let Ok(pidfd) = pidfd_open(id, PidfdFlags::empty()) else { return false };
    // the pidfd stands for whoever has the id now; only if that is still the service may it be killed
    if read_command_line(pid).and_then(|line| role_in(&line, domain)).is_none() {
        return false;
    }
    let killed = pidfd_send_signal(&pidfd, Signal::KILL).is_ok();
    let patience = Timespec { tv_sec: 0, tv_nsec: 500_000_000 };
    let _ = poll(&mut [PollFd::new(&pidfd, PollFlags::IN)], Some(&patience));
    killed
}

fn bytes_of(domain: &str) -> u64 {
    let ours = |name: &str| name.strip_prefix(domain).is_some_and(|rest| rest.starts_with('_'));
    let entries = fs::read_dir(Path::new(SHARED_MEMORY)).into_iter().flatten().flatten();
    entries.filter(|e| e.file_name().to_str().is_some_and(ours)).filter_map(|e| Some(e.metadata().ok()?.len())).sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_services_of_exactly_this_domain_are_orphans() {
        let line = |words: &[&str]| words.join("\0").into_bytes();
        let haptic = line(&["maille-haptic", "service", "haptic", "--domain", "maille_00000001", "--parent", "7", ""]);
        assert_eq!(role_in(&haptic, "maille_00000001").as_deref(), Some("haptic"));
        assert_eq!(role_in(&haptic, "maille_0000000"), None);
        assert_eq!(
            role_in(&line(&["maille", "service", "haptic", "--domain=maille_00000001"]), "maille_00000001").as_deref(),
            Some("haptic")
        );
        for other in [&["grep", "maille_00000001"][..], &["maille", "run"], &["vim", "--domain", "maille_00000001"], &[""]] {
            assert_eq!(role_in(&line(other), "maille_00000001"), None, "{other:?}");
        }
    }

    #[test]
    fn a_living_domain_is_not_cleaned() {
        let domain = Domain::fresh().unwrap();
        let removed = clean_dead_runs().unwrap();
        assert!(removed.iter().all(|r| r.domain != domain.name()));
        assert!(domain.directory().is_dir());
        domain.remove().unwrap();
    }
}
