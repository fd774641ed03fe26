//! What the supervisor says, said by a thread of its own: a terminal that stands still, or a pipe that nobody reads, must not hold the loop
//! that beats and watches.
//!
//! Lines wait in a bounded queue; when it is full the newest are dropped and counted. Nobody waits for it but [`flush`], for a bounded time.

use std::{
    io::Write as _,
    sync::{
        OnceLock,
        atomic::{AtomicU64, Ordering::Relaxed},
        mpsc::{Receiver, SyncSender, sync_channel},
    },
    thread,
    time::Duration,
};

/// Lines that may wait.
const QUEUE: usize = 1024;

/// Something for the thread to do.
enum Word {
    Out(String),
    Err(String),
    /// everything before this is out
    Flushed(SyncSender<()>),
}

static QUEUED: OnceLock<SyncSender<Word>> = OnceLock::new();
static DROPPED: AtomicU64 = AtomicU64::new(0);

fn queue() -> &'static SyncSender<Word> {
    QUEUED.get_or_init(|| {
        let (sender, words) = sync_channel(QUEUE);
        // without the thread lines are dropped, which is what happens to those that cannot be written
        drop(thread::Builder::new().name("output".into()).spawn(move || write(&words)));
        sender
    })
}

fn write(words: &Receiver<Word>) {
    for word in words {
        let dropped = DROPPED.swap(0, Relaxed);
        if dropped > 0 {
            let _ = writeln!(std::io::stderr(), "maille: {dropped} lines were dropped, nobody read them");
        }
        // a reader that went away is no reason to end a simulation
        match word {
            Word::Out(line) => {
                let mut out = std::io::stdout().lock();
                let _ = writeln!(out, "{line}").and_then(|()| out.flush());
            }
            Word::Err(line) => drop(writeln!(std::io::stderr(), "{line}")),
            Word::Flushed(done) => drop(done.try_send(())),
        }
    }
}

fn put(word: Word) {
    if queue().try_send(word).is_err() {
        DROPPED.fetch_add(1, Relaxed);
    }
}

/// A line for standard output.
pub(crate) fn line(text: std::fmt::Arguments<'_>) {
    put(Word::Out(text.to_string()));
}

/// A line for standard error.
pub(crate) fn error_line(text: std::fmt::Arguments<'_>) {
    put(Word::Err(text.to_string()));
}

/// Waits until everything said so far is out, for at most `longest`.
pub(crate) fn flush(longest: Duration) {
    let (done, out) = sync_channel(1);
    put(Word::Flushed(done));
    let _ = out.recv_timeout(longest);
}
