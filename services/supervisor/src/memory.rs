//! Memory: what /dev/shm has left, what a process holds for itself, what a domain's segments take.

use crate::SupervisorError;
use std::{collections::BTreeMap, fs, path::Path};

/// Where shared memory lives on Linux.
pub const SHARED_MEMORY: &str = "/dev/shm";
/// Bytes of a mebibyte.
pub const MIB: f64 = 1_048_576.0;
/// Left free beside the segments: iceoryx2's own files, the pools of messages and frames, and somebody else's few
/// files [bytes].
const MARGIN: u64 = 32 << 20;

/// Size and free bytes of the file system of shared memory.
pub fn shared_memory_space() -> std::io::Result<(u64, u64)> {
    let stat = rustix::fs::statvfs(SHARED_MEMORY)?;
    Ok((stat.f_blocks * stat.f_frsize, stat.f_bavail * stat.f_frsize))
}

/// Refuses a run whose segments do not fit, before anything is made: the alternative is a SIGBUS in the middle of it.
pub fn check_space(need: u64) -> Result<(), SupervisorError> {
    let (size, free) = shared_memory_space().map_err(SupervisorError::io(format!("{SHARED_MEMORY} cannot be asked for its size")))?;
    space_for(need, size, free)
}

fn space_for(need: u64, size: u64, free: u64) -> Result<(), SupervisorError> {
    let need = need.saturating_add(MARGIN);
    if free >= need {
        return Ok(());
    }
    let mib = |bytes: u64| bytes.div_ceil(1 << 20);
    // round up to 64 MiB, a number that a person would type
    let size_mib = mib(size - free.min(size) + need).next_multiple_of(64);
    Err(SupervisorError::Space { need_mib: mib(need), free_mib: free >> 20, size_mib })
}

/// `Private_Dirty` of a process [MiB]: pages that it alone has and has written. `None` when it is gone.
pub fn private_mib(pid: u32) -> Option<f64> {
    let rollup = fs::read_to_string(format!("/proc/{pid}/smaps_rollup")).ok()?;
    private_dirty_kib(&rollup).map(|kib| kib as f64 / 1024.0)
}

fn private_dirty_kib(rollup: &str) -> Option<u64> {
    let line = rollup.lines().find_map(|line| line.strip_prefix("Private_Dirty:"))?;
    line.split_whitespace().next()?.parse().ok()
}

/// Bytes of a domain in /dev/shm by segment, our own by their names; what iceoryx2 made for its messages, whose names have
/// endings, counts as `messages`.
pub fn segments(domain: &str) -> BTreeMap<String, u64> {
    let prefix = format!("{domain}_");
    let mut found = BTreeMap::new();
    for entry in fs::read_dir(Path::new(SHARED_MEMORY)).into_iter().flatten().flatten() {
        let name = entry.file_name();
        let Some(segment) = name.to_str().and_then(|name| name.strip_prefix(&prefix)) else { continue };
        let segment = if segment.contains('.') { "messages" } else { segment };
        *found.entry(segment.to_owned()).or_default() += entry.metadata().map_or(0, |m| m.len());
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn too_little_space_is_refused_with_the_size_that_would_do() {
        assert!(space_for(100 << 20, 1 << 30, 200 << 20).is_ok());
        let error = space_for(100 << 20, 64 << 20, 60 << 20).unwrap_err().to_string();
        assert!(error.contains("needs 132 MiB") && error.contains("60 MiB are free") && error.contains("size=192M"), "{error}");
        assert!(space_for(u64::MAX, 1 << 30, 1 << 30).is_err(), "no overflow");
    }

    #[test]
    fn private_dirty_is_read_out_of_the_roll_up() {
        let text = "5555-7fff ---p 00000000 00:00 0 [rollup]\nRss:  2000 kB\nPrivate_Clean:  12 kB\nPrivate_Dirty:     512 kB\n";
        assert_eq!(private_dirty_kib(text), Some(512));
        assert_eq!(private_dirty_kib("Rss: 1 kB"), None);
    }

    #[test]
    fn memory_that_is_written_becomes_private() {
        let before = private_mib(std::process::id()).unwrap();
        let written = std::hint::black_box(vec![1u8; 32 << 20]);
        let after = private_mib(std::process::id()).unwrap();
        assert!(after - before > 28.0, "{before} → {after} MiB with {} bytes written", written.len());
    }
}
