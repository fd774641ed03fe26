//! Domains: one fresh name, directory and lock a run.
//!
//! The lock is an advisory lock on `/dev/shm/<domain>.lock`, held by the supervisor's open file: the kernel drops it however
//! the supervisor dies, so a domain whose lock can be had is dead, and one whose lock is held is never cleaned away.

use crate::{ControlMap, TransportError};
use maille_contract::control::SUPERVISOR_SILENT_NS;
use rustix::fs::{FlockOperation, flock};
use std::{
    fs::{self, File},
    io,
    path::{Path, PathBuf},
};

const SHM: &str = "/dev/shm";
const PREFIX: &str = "maille_";
const DIGITS: usize = 8;

/// One run of the simulation.
#[derive(Debug)]
pub struct Domain {
    name: String,
    directory: PathBuf,
    /// held by the run's supervisor only
    lock: Option<File>,
}

fn valid(name: &str) -> bool {
    name.strip_prefix(PREFIX).is_some_and(|id| id.len() == DIGITS && id.bytes().all(|b| b.is_ascii_hexdigit() && !b.is_ascii_uppercase()))
}

fn file_error(path: &Path) -> impl FnOnce(io::Error) -> TransportError + '_ {
    move |source| TransportError::File { path: path.to_path_buf(), source }
}

impl Domain {
    /// Makes a new domain: lock first, under another name until it is held, then the directory and iceoryx2's configuration.
    ///
    /// # Errors
    /// When /dev/shm cannot be written.
    pub fn fresh() -> Result<Self, TransportError> {
        for attempt in 0u32.. {
            let seed =
                crate::monotonic_ns() ^ (u64::from(std::process::id()) << 32) ^ u64::from(attempt).wrapping_mul(0x9E37_79B9_7F4A_7C15);
            let mixed = (seed ^ (seed >> 29)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
            let name = format!("{PREFIX}{:08x}", (mixed >> 32) as u32);
            let (lock_path, making) = (lock_path(&name), Path::new(SHM).join(format!(".{name}.making")));
            if lock_path.exists() || Path::new(SHM).join(&name).exists() {
                continue;
            }
            let lock = File::create_new(&making).map_err(file_error(&making))?;
            flock(&lock, FlockOperation::NonBlockingLockExclusive).map_err(|e| file_error(&making)(e.into()))?;
            fs::rename(&making, &lock_path).map_err(file_error(&lock_path))?;
            let domain = Self { directory: Path::new(SHM).join(&name), name, lock: Some(lock) };
            domain.make_directory()?;
            return Ok(domain);
        }
        unreachable!("the loop has no end but its return")
    }

    fn make_directory(&self) -> Result<(), TransportError> {
        use std::os::unix::fs::DirBuilderExt;
        fs::DirBuilder::new().mode(0o700).create(&self.directory).map_err(file_error(&self.directory))?;
        let path = self.config_path();
        let text = format!(
            "[global]\nroot-path = '{}'\nprefix = '{}_'\n\n[global.node]\ncleanup-dead-nodes-on-creation = false\n\
             cleanup-dead-nodes-on-destruction = false\n\n[global.service]\ncleanup-dead-nodes-on-open = false\n",
            self.directory.display(),
            self.name
        );
        fs::write(&path, text).map_err(file_error(&path))
    }

    /// A domain by name, which must exist.
    ///
    /// # Errors
    /// When the name is none, or nothing of that name exists.
    pub fn named(name: &str) -> Result<Self, TransportError> {
        if !valid(name) {
            return Err(TransportError::Name { name: name.into() });
        }
        let directory = Path::new(SHM).join(name);
        if !directory.is_dir() {
            return Err(TransportError::NoDomain { name: name.into() });
        }
        Ok(Self { name: name.into(), directory, lock: None })
    }

    /// Removes the locks of runs that died between making their lock and giving it its name. A run does that in well under a second, so one
    /// that is ten seconds old and held by nobody is left over. Returns how many there were.
    pub fn remove_unfinished() -> usize {
        let unfinished = |file: &str| {
            let name = file.strip_prefix('.').and_then(|f| f.strip_suffix(".making"));
            name.is_some_and(valid)
        };
        let entries = fs::read_dir(SHM).into_iter().flatten().flatten().filter(|entry| entry.file_name().to_str().is_some_and(unfinished));
        let left_over = |path: &Path| {
            let file = File::open(path).ok()?;
            let age = file.metadata().ok()?.modified().ok()?.elapsed().ok()?;
            let held = flock(&file, FlockOperation::NonBlockingLockShared).is_err();
            (!held && age.as_secs() >= 10 && fs::remove_file(path).is_ok()).then_some(())
        };
        entries.filter_map(|entry| left_over(&entry.path())).count()
    }

    /// All domains that left anything in /dev/shm, dead or alive, sorted by name.
    pub fn list() -> Vec<Self> {
        let mut names: Vec<String> = fs::read_dir(SHM)
            .into_iter()
            .flatten()
            .flatten()
            .filter_map(|entry| entry.file_name().into_string().ok())
            .filter_map(|file| file.get(..PREFIX.len() + DIGITS).filter(|n| valid(n)).map(str::to_owned))
            .collect();
        names.sort();
        names.dedup();
        names.into_iter().map(|name| Self { directory: Path::new(SHM).join(&name), name, lock: None }).collect()
    }

    /// Name: `maille_` and eight digits.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Directory on tmpfs that lives as long as the run.
    pub fn directory(&self) -> &Path {
        &self.directory
    }

    pub(crate) fn config_path(&self) -> PathBuf {
        self.directory.join("iceoryx2.toml")
    }

    /// File name in /dev/shm of one of the domain's segments.
    pub fn segment_name(&self, segment: &str) -> String {
        format!("{}_{segment}", self.name)
    }

    /// Whether some supervisor holds the domain's lock: this one, or another process. Where somebody has taken the lock's file away, the
    /// supervisor's beat is asked.
    pub fn is_alive(&self) -> bool {
        if self.lock.is_some() {
            return true;
        }
        match File::open(lock_path(&self.name)) {
            Ok(file) => matches!(flock(&file, FlockOperation::NonBlockingLockShared), Err(rustix::io::Errno::WOULDBLOCK)),
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => self.beats(),
            Err(_) => false,
        }
    }

    /// Whether a supervisor has beaten a moment ago.
    fn beats(&self) -> bool {
        ControlMap::open(self).is_ok_and(|control| {
            let beat = control.supervisor_heartbeat_ns.load(std::sync::atomic::Ordering::Relaxed);
            beat != 0 && crate::monotonic_ns().saturating_sub(beat) < SUPERVISOR_SILENT_NS
        })
    }

    /// Removes everything of the domain from /dev/shm and says how many files went. The lock goes last.
    ///
    /// # Errors
    /// When another process holds the lock.
    pub fn remove(&self) -> Result<usize, TransportError> {
        if self.lock.is_none() && self.is_alive() {
            return Err(TransportError::InUse { name: self.name.clone() });
        }
        let mut removed = 0;
        let is_ours = |file: &str| file.strip_prefix(&self.name).is_some_and(|rest| rest.starts_with('_'));
        for entry in fs::read_dir(SHM).into_iter().flatten().flatten() {
            if entry.file_name().to_str().is_some_and(is_ours) && fs::remove_file(entry.path()).is_ok() {
                removed += 1;
            }
        }
        removed += count_files(&self.directory);
        let _ = fs::remove_dir_all(&self.directory);
        removed += usize::from(fs::remove_file(lock_path(&self.name)).is_ok());
        Ok(removed)
    }
}

fn lock_path(name: &str) -> PathBuf {
    Path::new(SHM).join(format!("{name}.lock"))
}

fn count_files(directory: &Path) -> usize {
    fs::read_dir(directory)
        .into_iter()
        .flatten()
        .flatten()
        .map(|entry| if entry.file_type().is_ok_and(|t| t.is_dir()) { count_files(&entry.path()) } else { 1 })
        .sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_lock_of_a_run_that_died_while_making_it_is_removed_once_it_is_old_and_never_while_it_is_held() {
        let old = std::time::SystemTime::now() - std::time::Duration::from_secs(60);
        let make = |name: &str| {
            let path = Path::new(SHM).join(format!(".{name}.making"));
            (File::create(&path).unwrap(), path)
        };
        let digits = std::process::id() % 0x1000_0000;
        let [(young, a), (held, b), (left, c)] = [1, 2, 3].map(|n| make(&format!("maille_{n:x}{digits:07x}")));
        held.set_modified(old).unwrap();
        left.set_modified(old).unwrap();
        flock(&held, FlockOperation::NonBlockingLockExclusive).unwrap();
        Domain::remove_unfinished();
        assert_eq!([&a, &b, &c].map(|p| p.exists()), [true, true, false]);
        drop((young, held));
        [a, b].iter().for_each(|p| fs::remove_file(p).unwrap());
    }

    #[test]
    fn a_domain_lives_while_its_lock_is_held_and_leaves_nothing() {
        let domain = Domain::fresh().unwrap();
        let other = Domain::named(domain.name()).unwrap();
        assert!(domain.is_alive() && other.is_alive());
        assert!(matches!(other.remove(), Err(TransportError::InUse { .. })));
        assert!(Domain::list().iter().any(|d| d.name() == domain.name()));
        let name = domain.name().to_owned();
        fs::write(Path::new(SHM).join(format!("{name}_segment")), b"x").unwrap();
        let Domain { lock, .. } = domain;
        drop(lock);
        assert!(!other.is_alive());
        assert!(other.remove().unwrap() >= 3);
        assert!(!Domain::list().iter().any(|d| d.name() == name));
    }

    #[test]
    fn only_names_of_domains_are_taken() {
        for name in ["", "maille_", "maille_../../ab", "maille_0123ABCD", "maille_0123abcde", "other_0123abcd"] {
            assert!(matches!(Domain::named(name), Err(TransportError::Name { .. })), "{name}");
        }
        assert!(matches!(Domain::named("maille_00000000"), Err(TransportError::NoDomain { .. })));
    }
}
