//! Publishing a transaction, and taking back what nobody sees any more.
//!
//! Copy-on-write from the bricks up to the root: new versions, copies of the leaf pages that name them, a copy of the root page that
//! names those, then the head. Until the head is stored nothing that a reader can reach has changed. Cost: the
//! root page (4 bytes a leaf), 256 bytes a leaf touched, two records an entry; no allocation once warm.

use crate::{
    Writer,
    bell::ring,
    fault::{Broken, Point, broken, point},
    protocol::{Pinned, pinned, publish},
    transaction::{Edit, Version},
    writer::{Change, KINDS, LEAVES, ROOTS, Retired},
};
use maille_contract::index::{ABSENT, LEAF_LEN, NEVER};
use std::sync::atomic::Ordering::{Relaxed, Release};

impl Writer {
    /// Makes edits (in order of entries) visible at once and gives their epoch; `None` when slots or pages are missing, and
    /// then nothing has changed.
    pub(crate) fn publish(&mut self, edits: &mut Vec<Edit>) -> Option<u64> {
        let mut wanted = [0usize; KINDS];
        let mut last_leaf = usize::MAX;
        for edit in edits.iter() {
            wanted[edit.channel] += usize::from(matches!(edit.version, Version::Heap(_)));
            wanted[LEAVES] += usize::from(edit.entry / LEAF_LEN != last_leaf);
            last_leaf = edit.entry / LEAF_LEN;
        }
        wanted[ROOTS] = 1;
        let missing = |writer: &Self| (0..KINDS).any(|kind| writer.free[kind].len() < wanted[kind]);
        if missing(self) {
            self.reclaim();
            if missing(self) {
                return None;
            }
        }
        let epoch = self.epoch() + 1;
        for edit in edits.iter_mut() {
            if let Version::Heap(words) = &edit.version {
                let slot = self.free[edit.channel].pop().expect("counted above");
                let bytes = self.slot_bytes_mut(edit.channel, slot);
                bytes.copy_from_slice(&bytemuck::cast_slice(words)[..bytes.len()]);
                edit.version = Version::Slot(slot);
            }
        }
        point(Point::SlotsTaken);
        let new_root = self.write_pages(edits);
        for change in &self.changes {
            let record = &self.records(change.kind)[change.new as usize];
            record.born.store(epoch, Relaxed);
            point(Point::RecordBorn);
            // a record is read after this process's death only: the order of these two stores is the program's
            record.superseded.store(NEVER, Release);
        }
        let hidden = broken(Broken::PublishBeforeWrite).then(|| self.hide(edits));
        point(Point::BeforeHead);
        publish(self.index.head(), epoch, new_root);
        point(Point::AfterHead);
        ring(self.index.bell());
        for (slot, bytes) in hidden.into_iter().flatten() {
            // at the pace of somebody who computes what he writes, not of a copy
            for (to, from) in self.slot_bytes_mut(0, slot).iter_mut().zip(bytes) {
                *to = std::hint::black_box(from);
            }
        }
        self.retire(epoch);
        edits.clear();
        self.note_spare();
        Some(epoch)
    }

    /// Writes a new root page and the leaf pages under it, and lists what changes; the new root's number.
    fn write_pages(&mut self, edits: &[Edit]) -> u32 {
        let old_root = self.root_page();
        let new_root = self.free[ROOTS].pop().expect("counted by the caller");
        let index = &self.index;
        let root = index.root(new_root as usize);
        for (to, from) in root.iter().zip(index.root(old_root)) {
            to.store(from.load(Relaxed), Relaxed);
        }
        point(Point::RootCopied);
        self.changes.clear();
        self.changes.push(Change { kind: ROOTS, new: new_root, old: old_root as u32 });
        for of_leaf in edits.chunk_by(|a, b| a.entry / LEAF_LEN == b.entry / LEAF_LEN) {
            let word = &root[of_leaf[0].entry / LEAF_LEN];
            let (old, new) = (word.load(Relaxed), self.free[LEAVES].pop().expect("counted by the caller"));
            let leaf = index.leaf(new as usize);
            for (to, from) in leaf.iter().zip(index.leaf(old as usize)) {
                to.store(from.load(Relaxed), Relaxed);
            }
            word.store(new, Relaxed);
            point(Point::LeafCopied);
            self.changes.push(Change { kind: LEAVES, new, old });
            for edit in of_leaf {
                let Version::Slot(slot) = edit.version else { unreachable!("slots were given to all by the caller") };
                let word = &leaf[edit.entry % LEAF_LEN];
                self.changes.push(Change { kind: edit.channel, new: slot, old: word.load(Relaxed) });
                word.store(slot, Relaxed);
            }
        }
        new_root
    }

    /// Says of everything that the last commit superseded that it did.
    fn retire(&mut self, epoch: u64) {
        let changes = std::mem::take(&mut self.changes);
        for &Change { kind, old, .. } in &changes {
            // rest bricks are never used again: they are the volume that the mapper samples
            let is_rest = kind == 0 && (old as usize) < self.layout.count();
            if old != ABSENT && !is_rest {
                let record = &self.records(kind)[old as usize];
                record.superseded.store(epoch, Relaxed);
                let born = record.born.load(Relaxed);
                self.retired.push(Retired { kind, number: old, born, superseded: epoch });
                point(Point::Superseding);
            }
        }
        self.changes = changes;
        point(Point::Superseded);
    }

    /// Frees what no pin shows any more. [`Writer::begin`] and a commit that finds too few slots do so by themselves.
    pub fn reclaim(&mut self) {
        let seen = if broken(Broken::ReclaimEarly) { Pinned::NONE } else { pinned(&self.control.pins, self.index.head()) };
        point(Point::PinsRead);
        let mut retired = std::mem::take(&mut self.retired);
        retired.retain(|r| {
            let keep = seen.sees(r.born, r.superseded);
            if !keep {
                self.records(r.kind)[r.number as usize].superseded.store(0, Relaxed);
                self.free[r.kind].push(r.number);
                point(Point::Reclaiming);
            }
            keep
        });
        self.retired = retired;
    }

    /// Gives back what an edit held.
    pub(crate) fn release(&mut self, edit: Edit) {
        if let Version::Slot(slot) = edit.version {
            self.free[edit.channel].push(slot);
        }
    }

    /// [`Broken::PublishBeforeWrite`]: takes the bricks' contents out again, as if they were still to be written.
    fn hide(&mut self, edits: &[Edit]) -> Vec<(u32, Vec<u8>)> {
        let slots = edits.iter().filter_map(|e| match e.version {
            Version::Slot(slot) if e.channel == 0 => Some(slot),
            _ => None,
        });
        slots
            .map(|slot| {
                let bytes = self.slot_bytes_mut(0, slot);
                let written = bytes.to_vec();
                bytes.fill(0);
                (slot, written)
            })
            .collect()
    }
}
