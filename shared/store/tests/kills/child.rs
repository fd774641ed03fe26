//! The processes that are killed: a writer at full speed, and readers. They tell their parent what they do in records of fixed size
//! through a pipe, which outlives them.

use crate::tissue::{self, Random, State, Wrong};
use maille_store::{CommitOutcome, Reader, Snapshot, Writer};
use maille_transport::{Domain, monotonic_ns};
use std::{
    collections::VecDeque,
    io::{Read, Write as _},
    process::exit,
    time::Duration,
};

/// Status of a child that found something wrong and said so.
pub const FOUND: i32 = 3;

/// What a child says.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Said {
    /// the writer has recovered: epoch, transaction
    Opened(u64, u64),
    /// the writer is about to commit: transaction
    Commits(u64),
    /// the writer has committed: transaction, epoch, time taken [ns]
    Published(u64, u64, u64),
    /// the commit was put off: transaction, time taken [ns]
    PutOff(u64, u64),
    /// a reader has found a snapshot right: epoch, epoch of the oldest that it still holds
    Right(u64, u64),
    /// something is wrong
    Wrong(Wrong),
    /// slots are used twice or not at all
    Miscounted,
}

const RECORD: usize = 32;

impl Said {
    fn words(self) -> [u64; 4] {
        match self {
            Self::Opened(a, b) => [1, a, b, 0],
            Self::Commits(a) => [2, a, 0, 0],
            Self::Published(a, b, c) => [3, a, b, c],
            Self::PutOff(a, b) => [4, a, b, 0],
            Self::Right(a, b) => [5, a, b, 0],
            Self::Wrong(wrong) => [6, wrong as u64, 0, 0],
            Self::Miscounted => [7, 0, 0, 0],
        }
    }

    /// The next record of a pipe; `None` at its end.
    pub fn read(from: &mut impl Read) -> Option<Self> {
        let mut bytes = [0u8; RECORD];
        from.read_exact(&mut bytes).ok()?;
        let [kind, a, b, c]: [u64; 4] = bytemuck::pod_read_unaligned(&bytes);
        Some(match kind {
            1 => Self::Opened(a, b),
            2 => Self::Commits(a),
            3 => Self::Published(a, b, c),
            4 => Self::PutOff(a, b),
            5 => Self::Right(a, b),
            6 => Self::Wrong(if a == Wrong::Torn as u64 { Wrong::Torn } else { Wrong::Mixed }),
            7 => Self::Miscounted,
            _ => panic!("a record of kind {kind}"),
        })
    }
}

fn say(said: Said) {
    // one write of less than PIPE_BUF: whole or not at all
    if std::io::stdout().write_all(bytemuck::bytes_of(&said.words())).and_then(|()| std::io::stdout().flush()).is_err() {
        exit(0);
    }
}

fn found(said: Said, text: &str) -> ! {
    eprintln!("found: {text}");
    say(said);
    exit(FOUND)
}

/// `writer DOMAIN SEED`, or `reader` or `hunter DOMAIN SEED FIRST_PIN`.
pub fn main(arguments: &[String]) -> ! {
    // standard output is line-buffered: records hold no line ends on purpose, so `say` flushes
    let domain = Domain::named(&arguments[1]).expect("the parent's domain");
    let seed: u64 = arguments[2].parse().expect("a seed");
    match arguments[0].as_str() {
        "writer" => write(&domain, seed),
        "reader" => read(&domain, seed, arguments[3].parse().expect("a pin")),
        "hunter" => hunt(&domain, arguments[3].parse().expect("a pin")),
        other => panic!("no child {other:?}"),
    }
}

fn audit(writer: &Writer) {
    if let Err(text) = writer.audit() {
        found(Said::Miscounted, &text);
    }
}

fn write(domain: &Domain, seed: u64) -> ! {
    let mut writer = Writer::open(domain).expect("the store opens");
    audit(&writer);
    let mut done = State::of(writer.state()).transaction;
    say(Said::Opened(writer.epoch(), done));
    loop {
        loop {
            if let Some(epoch) = writer.publish_deferred() {
                say(Said::Published(done, epoch, 0));
            }
            if writer.has_room() {
                break;
            }
            std::thread::sleep(Duration::from_micros(100));
        }
        let number = done + 1;
        let epoch = writer.epoch() + 1;
        // now and then one that is dropped, and one that changes a brick twice
        let mut t = writer.begin();
        if number.is_multiple_of(17) {
            t.brick_mut(3).voxels.fill(-1);
            drop(t);
            t = writer.begin();
        }
        tissue::change(&mut t, seed, number, epoch);
        say(Said::Commits(number));
        let began = monotonic_ns();
        let outcome = t.commit();
        let took = monotonic_ns() - began;
        match outcome {
            CommitOutcome::Published { epoch: made, .. } => {
                if made != epoch {
                    // only a protocol that is broken on purpose makes several epochs in one commit
                    eprintln!("transaction {number} was to make epoch {epoch} and made {made}");
                }
                say(Said::Published(number, made, took));
            }
            CommitOutcome::Deferred => say(Said::PutOff(number, took)),
            CommitOutcome::Empty => panic!("a transaction that changes something"),
        }
        done = number;
        if number.is_multiple_of(64) {
            audit(&writer);
        }
    }
}

fn read(domain: &Domain, seed: u64, first_pin: usize) -> ! {
    let reader = Reader::open_with_pins(domain, first_pin..first_pin + crate::PINS_EACH).expect("the store opens");
    let mut random = Random(seed);
    let mut held: VecDeque<Snapshot<'_>> = VecDeque::new();
    let rest = reader.rest();
    let look = |snapshot: &Snapshot<'_>| {
        if let Err((wrong, text)) = tissue::check(snapshot, &rest) {
            found(Said::Wrong(wrong), &text);
        }
    };
    let mut last = 0;
    loop {
        let snapshot = reader.snapshot();
        if snapshot.epoch() < last {
            found(Said::Wrong(Wrong::Mixed), &format!("epoch {} after epoch {last}", snapshot.epoch()));
        }
        last = snapshot.epoch();
        look(&snapshot);
        held.push_back(snapshot);
        say(Said::Right(last, held[0].epoch()));
        std::thread::sleep(Duration::from_micros(random.below(2_000)));
        // an old one shows what it showed, until it is let go
        while held.len() == crate::PINS_EACH || (!held.is_empty() && random.below(2) == 0) {
            look(&held[0]);
            held.pop_front();
        }
    }
}

/// A reader that waits for each epoch and looks at once at what has just been written.
fn hunt(domain: &Domain, first_pin: usize) -> ! {
    let reader = Reader::open_with_pins(domain, first_pin..first_pin + crate::PINS_EACH).expect("the store opens");
    let rest = reader.rest();
    let (mut seen, mut looks) = (reader.epoch(), 0u64);
    loop {
        let mut turns = 0u32;
        while reader.epoch() == seen {
            std::hint::spin_loop();
            turns += 1;
            if turns.is_multiple_of(1 << 14) {
                std::thread::yield_now();
            }
        }
        let snapshot = reader.snapshot();
        seen = snapshot.epoch();
        if let Err((wrong, text)) = tissue::check_newest(&snapshot, &rest) {
            found(Said::Wrong(wrong), &text);
        }
        looks += 1;
        // a full look now and then, so that it counts among the readers
        if looks.is_multiple_of(64) {
            if let Err((wrong, text)) = tissue::check(&snapshot, &rest) {
                found(Said::Wrong(wrong), &text);
            }
            say(Said::Right(seen, seen));
        }
    }
}
