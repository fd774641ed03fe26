//! Counting slots: each must be current, retired, free or part of a commit that was put off, and only one of these.

use crate::{
    Writer,
    transaction::Version,
    writer::{KINDS, kind_name},
};

/// What one kind of slot or page is used for.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Audit {
    /// how many there are
    pub total: usize,
    /// shown by the last commit (rest bricks always)
    pub live: usize,
    /// superseded, and not yet found to be seen by nobody
    pub retired: usize,
    /// to be used next
    pub free: usize,
    /// committed, waiting to be published
    pub put_off: usize,
}

impl Writer {
    /// Counts everything, kind by kind: slots of each channel, leaf pages, root pages. Slow; for tests.
    ///
    /// # Errors
    /// What is used twice or not at all.
    pub fn audit(&self) -> Result<[Audit; KINDS], String> {
        let live = self.reached().map_err(|e| e.to_string())?;
        let mut counts = [Audit::default(); KINDS];
        for kind in 0..KINDS {
            let mut used: Vec<u8> = live[kind].iter().map(|&l| u8::from(l)).collect();
            let retired = self.retired.iter().filter(|r| r.kind == kind).map(|r| r.number);
            let put_off = self.deferred.iter().filter(|e| e.channel == kind).filter_map(|e| match e.version {
                Version::Slot(slot) => Some(slot),
                Version::Heap(_) => None,
            });
            let count = &mut counts[kind];
            (count.total, count.live) = (used.len(), live[kind].iter().filter(|&&l| l).count());
            for number in retired.inspect(|_| count.retired += 1) {
                used[number as usize] += 1;
            }
            for number in put_off.inspect(|_| count.put_off += 1) {
                used[number as usize] += 1;
            }
            for &number in &self.free[kind] {
                count.free += 1;
                used[number as usize] += 1;
            }
            if let Some(number) = used.iter().position(|&n| n != 1) {
                return Err(format!("number {number} of the {} is used {} times; {count:?}", kind_name(kind), used[number]));
            }
        }
        Ok(counts)
    }
}
