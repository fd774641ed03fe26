//! Named shared memory that survives any process: iceoryx2's POSIX shared memory, with the space really reserved.
//!
//! Created by the supervisor with mode 0600 and `fallocate`, so that a full /dev/shm is an error at the start and not a
//! SIGBUS later; opened by everybody else, read-only but where they write. New pages of tmpfs read as zero. The first page says
//! what the segment is ([`SegmentHeader`]); what is given out is the body behind it.

use crate::{Domain, TransportError};
use iceoryx2::prelude::SemanticString;
use iceoryx2_bb_posix::shared_memory::{AccessMode, CreationMode, Permission, SharedMemory, SharedMemoryBuilder};
use iceoryx2_bb_system_types::file_name::FileName;
use maille_contract::{
    ControlBlock,
    control::CONTROL_MAGIC,
    names::segment,
    segment_header::{BODY_OFFSET, SEGMENT_MAGIC, SegmentHeader, checksum, layout_sum},
};
use std::{
    fs::OpenOptions,
    ops::Deref,
    path::Path,
    ptr::NonNull,
    sync::atomic::Ordering::{Acquire, Relaxed, Release},
};

/// How a segment is mapped.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Access {
    /// readers: a store through such a mapping is a fault of the process that tries it
    Read,
    /// the one writer of a segment, and all users of the control block
    ReadWrite,
}

/// A mapped segment. It stays mapped until it is dropped; dropping it removes nothing.
#[derive(Debug)]
pub struct Segment {
    memory: SharedMemory,
    access: Access,
    /// bytes of the body
    len: usize,
}

// SAFETY: a `Segment` gives out only the address and length of a mapping that does not move or end while it lives; what is
// read and written through them is the business of the unsafe code that does it.
#[allow(unsafe_code)]
unsafe impl Send for Segment {}
// SAFETY: as above; no method changes anything.
#[allow(unsafe_code)]
unsafe impl Sync for Segment {}

impl Segment {
    /// Makes a segment of `len` zero bytes, whose layout has the checksum `layout`. Supervisor only.
    ///
    /// # Errors
    /// When it exists already, or /dev/shm has not the room: then the error says how much is missing.
    pub fn create(domain: &Domain, segment: &str, layout: u64, len: usize) -> Result<Self, TransportError> {
        let bytes = len.saturating_add(BODY_OFFSET);
        let name = file_name(domain, segment)?;
        let fail = |reason: String| TransportError::Segment { segment: segment.into(), action: "created", reason };
        let memory = SharedMemoryBuilder::new(&name)
            .creation_mode(CreationMode::CreateExclusive)
            .permission(Permission::OWNER_READ_WRITE)
            .zero_memory(false)
            .has_ownership(false)
            .size(bytes)
            .create()
            .map_err(|e| fail(format!("{e:?}")))?;
        let path = Path::new("/dev/shm").join(domain.segment_name(segment));
        let file = OpenOptions::new().write(true).open(&path).map_err(|source| TransportError::File { path: path.clone(), source })?;
        rustix::fs::fallocate(&file, rustix::fs::FallocateFlags::empty(), 0, bytes as u64).map_err(|e| {
            let _ = std::fs::remove_file(&path);
            if e == rustix::io::Errno::NOSPC {
                TransportError::Full {
                    segment: segment.into(),
                    needed_mib: (bytes as u64).div_ceil(1 << 20),
                    free_mib: free_shm_bytes() >> 20,
                }
            } else {
                fail(e.to_string())
            }
        })?;
        let made = Self { memory, access: Access::ReadWrite, len };
        let header = made.header();
        header.layout.store(layout, Relaxed);
        header.body_bytes.store(len as u64, Relaxed);
        header.checksum.store(header_sum(layout, len as u64), Relaxed);
        // SYNC POINT: the words above ↔ the load of the magic number in `check`
        header.magic.store(SEGMENT_MAGIC, Release);
        Ok(made)
    }

    /// Maps a segment that the supervisor made, if it is one of ours with a layout of this checksum.
    ///
    /// # Errors
    /// When it does not exist, may not be mapped, may be read or written by other users, is cut short, damaged or of another version.
    pub fn open(domain: &Domain, segment: &str, layout: u64, access: Access) -> Result<Self, TransportError> {
        let mode = match access {
            Access::Read => AccessMode::Read,
            Access::ReadWrite => AccessMode::ReadWrite,
        };
        let memory = SharedMemoryBuilder::new(&file_name(domain, segment)?).open_existing(mode).map_err(|e| TransportError::Segment {
            segment: segment.into(),
            action: "opened",
            reason: why(domain, segment).unwrap_or_else(|| format!("{e:?}")),
        })?;
        let mut found = Self { memory, access, len: 0 };
        found.len = found.check(domain, segment, layout).map_err(|reason| TransportError::Layout { segment: segment.into(), reason })?;
        Ok(found)
    }

    /// Bytes of the body of what somebody else made, checked before anything behind its header is used.
    fn check(&self, domain: &Domain, segment: &str, layout: u64) -> Result<usize, String> {
        use std::os::unix::fs::{MetadataExt, PermissionsExt};
        let path = Path::new("/dev/shm").join(domain.segment_name(segment));
        let file = std::fs::symlink_metadata(&path).map_err(|e| e.to_string())?;
        let (mode, owner, us) = (file.permissions().mode() & 0o777, file.uid(), rustix::process::geteuid().as_raw());
        if mode != 0o600 || owner != us {
            return Err(format!("it belongs to user {owner} with mode {mode:o} instead of user {us} with mode 600"));
        }
        let mapped = self.memory.size();
        if mapped < BODY_OFFSET {
            return Err(format!("it has {mapped} bytes and is truncated"));
        }
        let header = self.header();
        let magic = header.magic.load(Acquire);
        if magic != SEGMENT_MAGIC {
            let same_kind = magic.to_le_bytes()[..7] == SEGMENT_MAGIC.to_le_bytes()[..7];
            return Err(if same_kind { "another version of the header" } else { "another magic number, or it is still being made" }.into());
        }
        let (found, bytes) = (header.layout.load(Relaxed), header.body_bytes.load(Relaxed));
        if header.checksum.load(Relaxed) != header_sum(found, bytes) {
            return Err("the checksum of its header is wrong".into());
        }
        if found != layout {
            return Err(format!("its layout has the checksum {found:016x} instead of {layout:016x}"));
        }
        let room = (mapped - BODY_OFFSET) as u64;
        if bytes > room {
            return Err(format!("it is truncated: {room} bytes of {bytes}"));
        }
        Ok(bytes as usize)
    }

    #[allow(unsafe_code)]
    fn header(&self) -> &SegmentHeader {
        // SAFETY: the mapping is page-aligned, has a whole first page (made so, or checked) and lives as long as `self`; a
        // `SegmentHeader` is `repr(C)` and made of atomics only.
        unsafe { self.memory.base_address().cast::<SegmentHeader>().as_ref() }
    }

    /// Bytes of the body.
    pub fn len(&self) -> usize {
        self.len
    }

    /// Whether the body has no bytes.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Address of the body, aligned to 4096 bytes.
    #[allow(unsafe_code)]
    pub fn base(&self) -> NonNull<u8> {
        // SAFETY: the mapping has a first page (made so, or checked when opened) and the body behind it.
        unsafe { self.memory.base_address().add(BODY_OFFSET) }
    }

    /// How it is mapped.
    pub fn access(&self) -> Access {
        self.access
    }

    /// Maps every page now: a page fault in a tick costs more than all its work.
    #[allow(unsafe_code)]
    pub fn prefault(&self) {
        let advice = rustix::mm::Advice::LinuxPopulateRead;
        // SAFETY: address and length are those of a live mapping of ours; populating it changes no byte.
        let done = unsafe { rustix::mm::madvise(self.memory.base_address().as_ptr().cast(), self.memory.size(), advice) };
        // before Linux 5.14 there is no such advice; then pages come as they are touched
        let _ = done;
    }
}

/// Checksum of a header's words.
fn header_sum(layout: u64, body_bytes: u64) -> u64 {
    checksum(&[layout.to_le_bytes(), body_bytes.to_le_bytes()].concat())
}

/// Checksum of the control block's layout; its magic number holds the version.
fn control_layout() -> u64 {
    layout_sum("maille.ControlBlock", &[CONTROL_MAGIC, size_of::<ControlBlock>() as u64])
}

/// In words, what can be seen of a segment that cannot be opened.
fn why(domain: &Domain, segment: &str) -> Option<String> {
    match std::fs::symlink_metadata(Path::new("/dev/shm").join(domain.segment_name(segment))) {
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => Some("it does not exist: the run has ended or lost it".into()),
        Ok(found) if !found.is_file() => Some("something else than a segment lies in its place".into()),
        Ok(found) if found.len() == 0 => Some("it is cut short: it has no bytes".into()),
        _ => None,
    }
}

fn file_name(domain: &Domain, segment: &str) -> Result<FileName, TransportError> {
    let name = domain.segment_name(segment);
    FileName::new(name.as_bytes()).map_err(|e| TransportError::Segment {
        segment: segment.into(),
        action: "named",
        reason: format!("{e:?}"),
    })
}

/// Free bytes in /dev/shm.
pub fn free_shm_bytes() -> u64 {
    rustix::fs::statvfs("/dev/shm").map_or(0, |s| s.f_bavail * s.f_frsize)
}

/// The control block of a domain, mapped read-write.
#[derive(Debug)]
pub struct ControlMap {
    segment: Segment,
}

impl ControlMap {
    /// Makes the control block. Supervisor only.
    ///
    /// # Errors
    /// As [`Segment::create`].
    pub fn create(domain: &Domain) -> Result<Self, TransportError> {
        let map = Self { segment: Segment::create(domain, segment::CONTROL, control_layout(), size_of::<ControlBlock>())? };
        map.segment.prefault();
        map.size_bytes.store(size_of::<ControlBlock>() as u64, Relaxed);
        map.spare_slots_low.store(u64::MAX, Relaxed);
        map.supervisor_heartbeat_ns.store(crate::monotonic_ns(), Relaxed);
        map.magic.store(CONTROL_MAGIC, Release);
        Ok(map)
    }

    /// Maps the control block that the supervisor made.
    ///
    /// # Errors
    /// When there is none, or it is of another version.
    pub fn open(domain: &Domain) -> Result<Self, TransportError> {
        let segment = Segment::open(domain, segment::CONTROL, control_layout(), Access::ReadWrite)?;
        let fail = |reason| Err(TransportError::Layout { segment: segment::CONTROL.into(), reason });
        if segment.len() < size_of::<ControlBlock>() {
            return fail(format!("{} bytes instead of {}", segment.len(), size_of::<ControlBlock>()));
        }
        let map = Self { segment };
        if map.magic.load(Acquire) != CONTROL_MAGIC || map.size_bytes.load(Relaxed) != size_of::<ControlBlock>() as u64 {
            return fail("another magic number or size".into());
        }
        map.segment.prefault();
        Ok(map)
    }
}

impl Deref for ControlMap {
    type Target = ControlBlock;

    #[allow(unsafe_code)]
    fn deref(&self) -> &ControlBlock {
        // SAFETY: the body is aligned to 4096 bytes, at least as long as a `ControlBlock` (checked when opened), read-write and
        // lives as long as `self`; a `ControlBlock` is `repr(C)` and made of atomics only, so that every bit pattern is
        // a value and concurrent writes by other processes are allowed.
        unsafe { self.segment.base().cast::<ControlBlock>().as_ref() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use maille_contract::{Role, RunState, ServiceState};

    #[test]
    fn two_maps_of_a_control_block_are_one() {
        let domain = Domain::fresh().unwrap();
        let a = ControlMap::create(&domain).unwrap();
        let b = ControlMap::open(&domain).unwrap();
        a.set_run_state(RunState::Running);
        b.service(Role::Haptic).set_state(ServiceState::Ready);
        assert_eq!((b.run_state(), a.service(Role::Haptic).state()), (RunState::Running, ServiceState::Ready));
        domain.remove().unwrap();
    }

    #[test]
    fn a_segment_larger_than_shm_is_refused_with_a_sentence_and_leaves_nothing() {
        let domain = Domain::fresh().unwrap();
        let error = Segment::create(&domain, "huge", 0, 1 << 46).unwrap_err().to_string();
        assert!(error.contains("not enough room") || error.contains("could not be created"), "{error}");
        assert!(!Path::new("/dev/shm").join(domain.segment_name("huge")).exists());
        domain.remove().unwrap();
    }

    #[test]
    fn a_segment_that_is_not_what_it_is_taken_for_is_refused_with_a_sentence() {
        use std::os::unix::fs::{FileExt, PermissionsExt};
        let domain = Domain::fresh().unwrap();
        let layout = layout_sum("maille.Test/v1", &[3, 100]);
        let made = Segment::create(&domain, "body", layout, 300).unwrap();
        assert_eq!((made.len(), made.base().as_ptr() as usize % BODY_OFFSET), (300, 0));
        let open = |layout| Segment::open(&domain, "body", layout, Access::Read);
        assert_eq!(open(layout).unwrap().len(), 300);
        let says = |layout| open(layout).unwrap_err().to_string();
        assert!(says(layout_sum("maille.Test/v2", &[3, 100])).contains("its layout has the checksum"));
        assert!(says(layout_sum("maille.Test/v1", &[4, 75])).contains("its layout has the checksum"));

        let path = Path::new("/dev/shm").join(domain.segment_name("body"));
        let mode = |mode| std::fs::set_permissions(&path, std::fs::Permissions::from_mode(mode)).unwrap();
        mode(0o666);
        assert!(says(layout).contains("mode 666 instead of"), "{}", says(layout));
        mode(0o600);
        // every word of the header, changed by one bit, is noticed; put back, it is taken again
        let file = OpenOptions::new().read(true).write(true).open(&path).unwrap();
        for word in 0..4 {
            let mut bytes = [0; 8];
            file.read_exact_at(&mut bytes, word * 8).unwrap();
            bytes[0] ^= 1;
            file.write_all_at(&bytes, word * 8).unwrap();
            assert!(matches!(open(layout), Err(TransportError::Layout { .. })), "word {word}");
            bytes[0] ^= 1;
            file.write_all_at(&bytes, word * 8).unwrap();
        }
        assert_eq!(open(layout).unwrap().len(), 300);
        for length in [4096 + 299, 4096, 100] {
            file.set_len(length).unwrap();
            assert!(says(layout).contains("truncated"), "{length}: {}", says(layout));
        }
        domain.remove().unwrap();
    }

    #[test]
    fn a_block_of_another_version_is_refused() {
        let domain = Domain::fresh().unwrap();
        let a = ControlMap::create(&domain).unwrap();
        a.magic.store(7, Relaxed);
        assert!(matches!(ControlMap::open(&domain), Err(TransportError::Layout { .. })));
        domain.remove().unwrap();
    }
}
