//! The other process of a [`Pair`](crate::Pair): it answers. Told by lines on standard input: what, how the other side waits, how many bricks.
//!
//! It ends with its input, with its parent, or when nothing has been asked for [`SILENCE_NS`].

use crate::{
    LatencyError, io,
    pair::{SOCKET, put_time, spin},
};
use bytemuck::Zeroable;
use maille_contract::{
    ToolCommand, ToolMove, ToolState,
    names::event,
    probe::{Ping, Pong},
};
use maille_realtime::pin_to_cpu;
use maille_store::{CommitOutcome, Writer};
use maille_transport::{ControlMap, Domain, Listener, Node, Notifier, Publisher, Subscriber, monotonic_ns};
use std::{
    io::{BufRead as _, Write as _},
    os::unix::net::UnixStream,
    time::Duration,
};

/// Before an answer to somebody who sleeps: long enough for the sleep to have begun [ns].
const PAUSE_NS: u64 = 60_000;
/// A parent that asks nothing for so long inside a loop is stuck [ns].
const SILENCE_NS: u64 = 5_000_000_000;

struct Peer {
    control: ControlMap,
    writer: Writer,
    pings: Subscriber<Ping>,
    pongs: Publisher<Pong>,
    poses: Publisher<ToolState>,
    moves: Subscriber<ToolMove>,
    asked: Listener,
    answered: Notifier,
    socket: UnixStream,
    own_cpu: bool,
    seen: u64,
    /// durations of commits [ns]
    commits: Vec<u64>,
}

/// Runs the peer until its standard input ends.
///
/// # Errors
/// When what the parent made cannot be opened, or the parent falls silent.
pub fn peer(domain: &str, cpu: Option<usize>) -> Result<(), LatencyError> {
    let own_cpu = cpu.is_some_and(|cpu| pin_to_cpu(cpu).is_none());
    let domain = Domain::named(domain)?;
    let path = domain.directory().join(SOCKET);
    let socket = UnixStream::connect(&path).map_err(io(format!("{} cannot be connected to", path.display())))?;
    let node = Node::open(&domain, "peer")?;
    let mut peer = Peer {
        control: ControlMap::open(&domain)?,
        writer: Writer::open(&domain)?,
        pings: node.subscriber()?,
        pongs: node.publisher()?,
        poses: node.publisher()?,
        moves: node.subscriber()?,
        asked: node.listener(event::ASKED)?,
        answered: node.notifier(event::ANSWERED)?,
        socket,
        own_cpu,
        seen: 0,
        commits: Vec::new(),
    };
    say("hello")?;
    for line in std::io::stdin().lock().lines() {
        let line = line.map_err(io("the parent cannot be heard"))?;
        let words: Vec<&str> = line.split(' ').collect();
        let [what, waits, bricks] = words[..] else {
            return Err(LatencyError::Helper(format!("does not understand {line:?}")));
        };
        peer.answer(what, waits == "blocking", bricks.parse().unwrap_or(1))?;
    }
    Ok(())
}

fn say(line: &str) -> Result<(), LatencyError> {
    let mut out = std::io::stdout().lock();
    writeln!(out, "{line}").and_then(|()| out.flush()).map_err(io("the parent cannot be told"))
}

impl Peer {
    /// One loop, to its end.
    fn answer(&mut self, what: &str, blocking: bool, bricks: usize) -> Result<(), LatencyError> {
        self.seen = self.control.command.generation();
        self.commits.clear();
        while self.pings.next().is_some() || self.moves.next().is_some() {}
        say("ready")?;
        match what {
            "echo" | "move" => self.exchange(what, blocking)?,
            "churn" => {
                while self.control.command.generation() == self.seen {
                    self.commit(bricks);
                    self.commits.clear();
                }
            }
            _ => {
                while let Some(asked) = self.next_question()? {
                    if blocking {
                        let asleep = monotonic_ns() + PAUSE_NS;
                        while monotonic_ns() < asleep {
                            spin(self.own_cpu);
                        }
                    }
                    self.send(what, asked, bricks)?;
                    if blocking && what != "socket" {
                        self.answered.notify()?;
                    }
                }
            }
        }
        let commits: Vec<String> = self.commits.iter().map(u64::to_string).collect();
        say(format!("done {}", commits.join(" ")).trim_end())
    }

    /// Waits for the next question; `None` when the loop ends.
    fn next_question(&mut self) -> Result<Option<u64>, LatencyError> {
        let patience = monotonic_ns() + SILENCE_NS;
        loop {
            for _ in 0..512 {
                if self.control.command.generation() != self.seen
                    && let Some((question, generation)) = self.control.command.load::<ToolCommand>()
                {
                    self.seen = generation;
                    return Ok((question.taken == 0).then_some(question.stamp.sequence));
                }
                spin(self.own_cpu);
            }
            if monotonic_ns() > patience {
                return Err(LatencyError::Helper("was asked nothing for five seconds".into()));
            }
        }
    }

    fn send(&mut self, what: &str, asked: u64, bricks: usize) -> Result<(), LatencyError> {
        let pong = || Pong { time_ns: monotonic_ns(), sequence: asked, ..Pong::zeroed() };
        let pose = || {
            let mut pose = ToolState::zeroed();
            (pose.stamp.sequence, pose.stamp.time_ns) = (asked, monotonic_ns());
            pose
        };
        match what {
            "pong" => self.pongs.send(&pong())?,
            "socket" => self.socket.write_all(bytemuck::bytes_of(&pong())).map_err(io("the socket cannot be written"))?,
            "pose" => self.poses.send(&pose())?,
            "event" => self.control.tool.store(&pose()),
            "commit" => self.commit(bricks),
            _ => return Err(LatencyError::Helper(format!("does not know `{what}`"))),
        }
        Ok(())
    }

    /// Rewrites bricks, then writes the time into the first, then commits.
    fn commit(&mut self, bricks: usize) {
        let mut transaction = self.writer.begin();
        for id in 0..bricks as u32 {
            let brick = transaction.brick_mut(id);
            brick.voxels[4] = brick.voxels[4].wrapping_add(1);
        }
        let first = transaction.brick_mut(0);
        let began = monotonic_ns();
        put_time(first, began);
        let outcome = transaction.commit();
        let took = monotonic_ns() - began;
        if matches!(outcome, CommitOutcome::Published { entries, .. } if entries >= bricks) {
            self.commits.push(took);
        }
    }

    /// Answers messages until the loop ends.
    fn exchange(&mut self, what: &str, blocking: bool) -> Result<(), LatencyError> {
        let mut patience = monotonic_ns() + SILENCE_NS;
        loop {
            if blocking {
                self.asked.wait(Duration::from_millis(100))?;
            }
            for _ in 0..if blocking { 1 } else { 512 } {
                let answered = match what {
                    "echo" => match self.pings.next() {
                        Some(ping) => {
                            self.pongs.send(&Pong { time_ns: monotonic_ns(), sequence: ping.sequence, ..Pong::zeroed() })?;
                            true
                        }
                        None => false,
                    },
                    _ => {
                        let asked = self.moves.latest().is_some();
                        if asked {
                            self.commit(1);
                        }
                        asked
                    }
                };
                if answered {
                    if blocking {
                        self.answered.notify()?;
                    }
                    patience = monotonic_ns() + SILENCE_NS;
                } else if !blocking {
                    spin(self.own_cpu);
                }
            }
            if self.control.command.generation() != self.seen {
                return Ok(());
            }
            if monotonic_ns() > patience {
                return Err(LatencyError::Helper("was sent nothing for five seconds".into()));
            }
        }
    }
}
