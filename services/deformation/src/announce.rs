//! Telling the others: one message an epoch, with what all the steps did that it is the first to show.
//!
//! A step whose commit was put off is told together with the step that makes it visible, or alone when the store publishes it later
//! without a step ([`maille_store::Writer::publish_deferred`]): every epoch has its message, every moved element is in one.

use crate::step::Done;
use maille_contract::{Commit, control::Counter};
use maille_store::CommitOutcome;
use maille_transport::{Life, Publisher, monotonic_ns};

/// What steps did that nobody has been told of yet.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Untold {
    cause: u64,
    moved_elements: u64,
    bricks: u64,
    step_ns: u64,
    refused_mm: [f64; 3],
}

impl Untold {
    /// Takes a step in: elements and bricks are summed (a brick that two steps rewrote counts twice), of the rest the newest counts.
    fn add(&mut self, done: &Done, step_ns: u64, cause: Option<u64>) {
        self.moved_elements += done.moved_elements;
        self.bricks += done.bricks;
        self.step_ns = step_ns;
        // relaxation answers nobody; its message names the last move that was answered, if there was one since the last message
        self.cause = cause.unwrap_or(self.cause);
        self.refused_mm = if cause.is_some() { done.refused_mm } else { self.refused_mm };
    }
}

/// The sender of [`Commit`]s.
pub(crate) struct Announcer {
    commits: Publisher<Commit>,
    sent: u64,
    untold: Untold,
}

impl Announcer {
    pub fn new(commits: Publisher<Commit>) -> Self {
        Self { commits, sent: 0, untold: Untold::default() }
    }

    /// Records a step that began at `began_ns`, the answer to the move `cause`, and tells of it if it is visible.
    pub fn step(&mut self, life: &mut Life, done: &Done, began_ns: u64, cause: Option<u64>) {
        let step_ns = monotonic_ns() - began_ns;
        life.record(began_ns, step_ns, None);
        life.cell().count(Counter::MovedElements, done.moved_elements);
        life.cell().count(Counter::Failures, done.failures);
        self.untold.add(done, step_ns, cause);
        match done.outcome {
            CommitOutcome::Published { epoch, .. } => self.published(life, epoch),
            CommitOutcome::Deferred => life.cell().count(Counter::Deferred, 1),
            CommitOutcome::Empty => {}
        }
    }

    /// Tells of an epoch that has just become visible.
    pub fn published(&mut self, life: &Life, epoch: u64) {
        life.cell().count(Counter::Commits, 1);
        self.send(life, epoch);
    }

    /// Tells of the epoch that stands when the process starts: its predecessor may have died before it could.
    pub fn standing(&mut self, life: &Life, epoch: u64) {
        self.send(life, epoch);
    }

    fn send(&mut self, life: &Life, epoch: u64) {
        self.sent += 1;
        let stamp = life.stamp(self.sent);
        let Untold { cause, moved_elements, bricks, step_ns, refused_mm } = std::mem::take(&mut self.untold);
        // the epoch itself is in the store; the message is news, and the next one will do
        let _ = self.commits.send(&Commit { stamp, epoch, cause, moved_elements, bricks, step_ns, refused_mm });
        life.cell().count(Counter::Sent, 1);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_step_that_was_put_off_is_told_with_the_one_that_shows_it() {
        let done = |moved_elements, bricks, refused| Done {
            outcome: CommitOutcome::Deferred,
            moved_elements,
            bricks,
            failures: 0,
            refused_mm: [refused; 3],
        };
        let mut untold = Untold::default();
        untold.add(&done(10, 2, 0.5), 100, Some(7));
        untold.add(&done(30, 4, 0.25), 200, Some(8));
        untold.add(&done(0, 1, 0.0), 300, None);
        let all = Untold { cause: 8, moved_elements: 40, bricks: 7, step_ns: 300, refused_mm: [0.25; 3] };
        assert_eq!(untold, all);
    }
}
