//! The first page of every segment: what it is, of which version, and how large, so that no process uses one that is not what it takes it for.
//!
//! Whoever makes a segment writes its header last of all and `magic` last in it; whoever opens one compares everything before anything behind it
//! is touched. The body begins on the second page, so that it keeps a page's alignment.

use core::sync::atomic::AtomicU64;

/// "mailseg" and the version of this header.
pub const SEGMENT_MAGIC: u64 = u64::from_le_bytes(*b"mailseg1");
/// Where the body begins [bytes]. A whole page where pages have 4 KiB; more than any vector or cache line wants everywhere.
pub const BODY_OFFSET: usize = 4096;

/// Header of a segment; atomics only, since it lies in memory that others map.
#[repr(C)]
#[derive(Debug, Default)]
pub struct SegmentHeader {
    /// [`SEGMENT_MAGIC`], written last
    pub magic: AtomicU64,
    /// [`layout_sum`] of what the body holds
    pub layout: AtomicU64,
    /// bytes of the body
    pub body_bytes: AtomicU64,
    /// [`checksum`] of `layout` and `body_bytes`
    pub checksum: AtomicU64,
}

/// FNV-1a, 64 bits: finds damage and other versions, not malice.
pub fn checksum(bytes: &[u8]) -> u64 {
    bytes.iter().fold(0xCBF2_9CE4_8422_2325, |h, &b| (h ^ u64::from(b)).wrapping_mul(0x0100_0000_01B3))
}

/// Checksum of a layout: a name that stands for a type, and the numbers (versions, counts, sizes) on which meaning and place of its bytes depend.
pub fn layout_sum(kind: &str, numbers: &[u64]) -> u64 {
    let mut bytes = kind.as_bytes().to_vec();
    bytes.push(0);
    numbers.iter().for_each(|n| bytes.extend(n.to_le_bytes()));
    checksum(&bytes)
}
