//! A word for each role, by which tests tell running services where to die.

use super::Memory;
use crate::StoreError;
use maille_contract::Role;
use maille_transport::{Access, Domain, Segment};
use std::sync::atomic::AtomicU64;

const SEGMENT: &str = "fault";
const WORDS: usize = Role::ALL.len();

pub(crate) struct FaultMap(Memory);

impl FaultMap {
    pub fn create(domain: &Domain) -> Result<Self, StoreError> {
        Ok(Self(Segment::create(domain, SEGMENT, WORDS as u64, WORDS * size_of::<AtomicU64>())?.into()))
    }

    pub fn open(domain: &Domain) -> Result<Self, StoreError> {
        Ok(Self(Segment::open(domain, SEGMENT, WORDS as u64, Access::ReadWrite)?.into()))
    }

    #[inline(always)]
    pub fn word(&self, role: Role) -> &AtomicU64 {
        // SAFETY: `AtomicU64` is an atomic.
        let words = unsafe { self.0.atomics::<AtomicU64>(0, WORDS) };
        &words[role as usize]
    }
}
