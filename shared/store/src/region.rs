//! Read-only regions: named bytes that never change after loading (breathing fields, rest labels), each with a typed header.
//!
//! The keeper makes a region and fills it before it is sealed; everybody else maps it read-only. What a region holds is said by its
//! **kind**, a name with a version ("maille.DisplacementField/v1"), which stands for the type of the header and of the body. It is in no
//! transaction and has no epochs. Cost: its bytes, once, in a segment `region-NAME` of its own; none that nobody makes.
//!
//! Not here: what the bytes mean (whoever defines the kind; if two processes see them, the contract).

use crate::{StoreError, StoreKeeper, raw::RegionMap};
use bytemuck::Pod;
use maille_contract::index::{REGION_HEADER_OFFSET, REGION_KIND_BYTES, REGION_MAGIC, RegionHeader};
use maille_contract::{
    names::segment,
    segment_header::{BODY_OFFSET, checksum},
};
use maille_transport::Domain;
use std::sync::atomic::Ordering::{Acquire, Relaxed, Release};

/// Alignment of a body: a cache line, and more than any vector needs.
const ALIGN: usize = 64;
/// Longest name, so that a segment's file name stays short.
const NAME_BYTES: usize = 32;

/// A region, mapped.
pub struct Region<H: Pod> {
    map: RegionMap,
    header: H,
    body: std::ops::Range<usize>,
}

impl<H: Pod> Region<H> {
    /// Bytes of the segment of a region whose body has so many, for the plan.
    pub const fn segment_bytes(body_bytes: usize) -> usize {
        BODY_OFFSET + body_offset::<H>() + body_bytes
    }

    /// Maps a region read-only.
    ///
    /// # Errors
    /// When there is none of that name, or it is truncated, damaged or of another kind.
    pub fn open(domain: &Domain, name: &str, kind: &str) -> Result<Self, StoreError> {
        let map = RegionMap::open(domain, &segment_name(name, kind)?)?;
        Self::take(map, name, kind)
    }

    /// Checks what somebody else made, before anything in it is used.
    fn take(map: RegionMap, name: &str, kind: &str) -> Result<Self, StoreError> {
        let fail = |reason: String| StoreError::Region { name: name.into(), reason };
        if map.len() < REGION_HEADER_OFFSET {
            return Err(fail(format!("it has {} bytes and is truncated", map.len())));
        }
        let found = map.header();
        if found.magic.load(Acquire) != REGION_MAGIC {
            return Err(fail("another magic number, another version of the layout, or it is still being made".into()));
        }
        let (words, numbers) = read(found);
        if words != kind_words(kind) {
            let name = kind_text(&words);
            return Err(fail(format!("it holds {name:?}, not {kind:?}")));
        }
        let [header_bytes, body_offset, body_bytes] = numbers;
        if header_bytes != size_of::<H>() as u64 || body_offset != self::body_offset::<H>() as u64 {
            return Err(fail(format!("its header has {header_bytes} bytes instead of {}", size_of::<H>())));
        }
        let end = body_offset.checked_add(body_bytes).filter(|&end| end <= map.len() as u64);
        let Some(end) = end else {
            return Err(fail(format!("{body_bytes} bytes do not fit into a segment of {}: it is truncated or damaged", map.len())));
        };
        let header: H = bytemuck::pod_read_unaligned(map.values(REGION_HEADER_OFFSET..REGION_HEADER_OFFSET + size_of::<H>()));
        if found.checksum.load(Relaxed) != sum(&words, numbers, &header) {
            return Err(fail("the checksum of its header is wrong".into()));
        }
        map.prefault();
        Ok(Self { body: body_offset as usize..end as usize, header, map })
    }

    /// The header, as its maker wrote it.
    pub fn header(&self) -> &H {
        &self.header
    }

    /// The body, in place.
    ///
    /// # Panics
    /// When it is not a whole number of `T`, or `T` wants more than 64 bytes of alignment.
    pub fn body<T: Pod>(&self) -> &[T] {
        assert!(self.body.len().is_multiple_of(size_of::<T>()), "{} bytes are no whole number of {}", self.body.len(), size_of::<T>());
        self.map.values(self.body.clone())
    }
}

impl StoreKeeper {
    /// Makes a region of `body_bytes`, lets `fill` write its body (zeros so far), and seals it. It lasts as long as the domain.
    ///
    /// # Errors
    /// When name or kind cannot be used, the region exists, or shared memory cannot be had; the error says how much is needed.
    pub fn add_region<H: Pod>(
        &mut self,
        domain: &Domain,
        name: &str,
        kind: &str,
        header: &H,
        body_bytes: usize,
        fill: impl FnOnce(&mut [u8]),
    ) -> Result<(), StoreError> {
        let bytes = body_offset::<H>() + body_bytes;
        let map = RegionMap::create(domain, &segment_name(name, kind)?, bytes)?;
        self.regions.push(make(map, kind, header, body_bytes, fill));
        Ok(())
    }
}

/// Fills a region that is long enough and all zeros.
fn make<H: Pod>(mut map: RegionMap, kind: &str, header: &H, body_bytes: usize, fill: impl FnOnce(&mut [u8])) -> RegionMap {
    let offset = body_offset::<H>();
    fill(map.values_mut(offset..offset + body_bytes));
    map.values_mut(REGION_HEADER_OFFSET..REGION_HEADER_OFFSET + size_of::<H>()).copy_from_slice(bytemuck::bytes_of(header));
    let (words, numbers) = (kind_words(kind), [size_of::<H>(), offset, body_bytes].map(|n| n as u64));
    let made = map.header();
    made.kind.iter().zip(words).for_each(|(to, word)| to.store(word, Relaxed));
    [&made.header_bytes, &made.body_offset, &made.body_bytes].into_iter().zip(numbers).for_each(|(to, n)| to.store(n, Relaxed));
    made.checksum.store(sum(&words, numbers, header), Relaxed);
    // SYNC POINT: everything above ↔ the load of the magic number in `take`
    made.magic.store(REGION_MAGIC, Release);
    map
}

const fn body_offset<H>() -> usize {
    (REGION_HEADER_OFFSET + size_of::<H>()).next_multiple_of(ALIGN)
}

type KindWords = [u64; REGION_KIND_BYTES / 8];

fn read(header: &RegionHeader) -> (KindWords, [u64; 3]) {
    let words = std::array::from_fn(|n| header.kind[n].load(Relaxed));
    (words, [&header.header_bytes, &header.body_offset, &header.body_bytes].map(|n| n.load(Relaxed)))
}

fn kind_words(kind: &str) -> KindWords {
    let mut bytes = [0u8; REGION_KIND_BYTES];
    bytes[..kind.len()].copy_from_slice(kind.as_bytes());
    bytemuck::cast(bytes)
}

fn kind_text(words: &KindWords) -> String {
    String::from_utf8_lossy(bytemuck::bytes_of(words)).trim_end_matches('\0').into()
}

fn sum<H: Pod>(kind: &KindWords, numbers: [u64; 3], header: &H) -> u64 {
    checksum(&[bytemuck::bytes_of(kind), bytemuck::bytes_of(&numbers), bytemuck::bytes_of(header)].concat())
}

fn segment_name(name: &str, kind: &str) -> Result<String, StoreError> {
    let fail = |reason: &str| Err(StoreError::Region { name: name.into(), reason: reason.into() });
    let sound = |b: u8| b.is_ascii_lowercase() || b.is_ascii_digit() || b == b'-';
    if name.is_empty() || name.len() > NAME_BYTES || !name.bytes().all(sound) {
        return fail("a name has 1 to 32 small letters, digits and -");
    }
    if kind.is_empty() || kind.len() > REGION_KIND_BYTES || kind.contains('\0') {
        return fail("a kind has 1 to 64 bytes, none of them zero");
    }
    Ok(format!("{}{name}", segment::REGION))
}
