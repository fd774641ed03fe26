//! Recovery: what a new writer makes of what its predecessor left. No file, no log: the head's root says what is alive, the records say
//! which epochs may still show the rest, and everything else is free.
//!
//! Cost: one look at every page word and record (0.1 ms at 32 768 slots).

use crate::{
    StoreError, Writer,
    fault::{Broken, Point, broken, point},
    protocol::{Fate, fate, root_of},
    writer::{KINDS, LEAVES, ROOTS, Retired, kind_name},
};
use maille_contract::index::{ABSENT, LEAF_LEN, NEVER};
use std::sync::atomic::Ordering::Relaxed;

impl Writer {
    /// How many of each kind there are.
    pub(crate) fn totals(&self) -> [usize; KINDS] {
        let l = &self.index.layout;
        std::array::from_fn(|kind| match kind {
            LEAVES => l.leaf_count as usize,
            ROOTS => l.root_count as usize,
            channel => l.channels[channel].slot_count as usize,
        })
    }

    /// Marks what the head's root reaches, and the rest bricks.
    ///
    /// # Errors
    /// When a page names something that does not exist, or two pages name the same: the index is damaged.
    pub(crate) fn reached(&self) -> Result<[Vec<bool>; KINDS], StoreError> {
        let mut live = self.totals().map(|n| vec![false; n]);
        live[0][..self.layout.count()].fill(true);
        let mut mark = |kind: usize, number: usize| match live[kind].get_mut(number) {
            Some(mark) if !*mark || (kind == 0 && number < self.layout.count()) => {
                *mark = true;
                Ok(())
            }
            found => {
                let what = if found.is_some() { "named twice" } else { "named, but there is none" };
                Err(StoreError::Index { reason: format!("number {number} of the {} is {what}", kind_name(kind)) })
            }
        };
        let root = root_of(self.index.head().load(Relaxed));
        mark(ROOTS, root)?;
        for (n, leaf) in self.index.root(root).iter().enumerate() {
            let leaf = leaf.load(Relaxed) as usize;
            mark(LEAVES, leaf)?;
            for (m, word) in self.index.leaf(leaf).iter().enumerate() {
                let slot = word.load(Relaxed);
                if slot != ABSENT {
                    mark(self.channel_of(n * LEAF_LEN + m), slot as usize)?;
                }
            }
        }
        Ok(live)
    }

    /// Rebuilds the free lists and the retired versions. Interrupted anywhere, it can be done again.
    pub(crate) fn recover(&mut self) -> Result<(), StoreError> {
        let epoch = self.epoch();
        let live = self.reached()?;
        let (mut free, mut retired) = (<[Vec<u32>; KINDS]>::default(), Vec::new());
        for (kind, live) in live.iter().enumerate() {
            for (number, record) in self.records(kind).iter().enumerate().rev() {
                let born = record.born.load(Relaxed);
                match fate(live[number], born, record.superseded.load(Relaxed), epoch) {
                    Fate::Live => record.superseded.store(NEVER, Relaxed),
                    Fate::Retired { superseded } if !broken(Broken::RecoverForgetsPins) => {
                        record.superseded.store(superseded, Relaxed);
                        retired.push(Retired { kind, number: number as u32, born, superseded });
                    }
                    Fate::Free | Fate::Retired { .. } => {
                        record.superseded.store(0, Relaxed);
                        free[kind].push(number as u32);
                    }
                }
                point(Point::Recovering);
            }
        }
        (self.free, self.retired) = (free, retired);
        self.reclaim();
        self.note_spare();
        point(Point::Recovered);
        Ok(())
    }
}
