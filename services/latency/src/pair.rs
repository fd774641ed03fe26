//! The side that measures: a domain with a small store, one peer, and a closed loop for each way between the two.
//!
//! The loop: ask (a word in shared memory, no system call), the peer answers with the time, the answer is seen, its time is
//! subtracted. The first answers of a loop are not counted: caches and connections are cold.

use crate::{LatencyError, helper::Helper, io};
use bytemuck::Zeroable;
use maille_contract::{
    Commit, ControlBlock, Role, ToolCommand, ToolMove, ToolState,
    histogram::{Percentiles, SharedHistogram},
    names::event,
    probe::{PROBE_BYTES, Ping, Pong},
};
use maille_realtime::{allowed_cpus, pin_to_cpu};
use maille_store::{Reader, StoreKeeper, StoreSizes};
use maille_transport::{ControlMap, Domain, Event, Listener, Node, Notifier, Publisher, Services, Subscriber, Topic, monotonic_ns};
use maille_volume::{Brick, BrickSource, Grid, Rescale, Volume};
use std::{
    io::Read as _,
    os::unix::net::{UnixListener, UnixStream},
    path::Path,
    time::Duration,
};

/// Voxels of the store's volume along an axis: 1728 bricks, as many as the default scene has.
const SIZE: usize = 192;
/// Versions beside the rest bricks: enough for several commits of 64 bricks to be held at once.
const SPARE_SLOTS: usize = 512;
/// Answers that are not counted.
const WARM_UP: u64 = 32;
/// An answer that has not come by then is lost.
const PATIENCE_NS: u64 = 500_000_000;
/// Lost answers after which something is wrong.
const MOST_LOST: u64 = 8;
/// Name of the socket in the domain's directory.
pub(crate) const SOCKET: &str = "latency.sock";

/// How the receiver waits.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Waits {
    /// it spins
    Polled,
    /// it sleeps until it is woken
    Blocking,
}

impl Waits {
    /// Key in the report.
    pub const fn word(self) -> &'static str {
        match self {
            Self::Polled => "polled",
            Self::Blocking => "blocking",
        }
    }
}

/// When a loop ends: at whichever comes first.
#[derive(Clone, Copy, Debug)]
pub struct Limits {
    /// samples
    pub samples: u64,
    /// time
    pub time: Duration,
}

/// Durations [ns].
#[derive(Clone, Debug, Default)]
pub struct Samples(pub Vec<u64>);

impl Samples {
    /// Their percentiles.
    pub fn percentiles(&self) -> Percentiles {
        let histogram = SharedHistogram::zeroed();
        self.0.iter().for_each(|&ns| histogram.record(ns));
        histogram.percentiles()
    }

    /// Their sum.
    pub fn total(&self) -> Duration {
        Duration::from_nanos(self.0.iter().sum())
    }
}

/// What commits took.
#[derive(Clone, Debug, Default)]
pub struct CommitSamples {
    /// from the entry of `commit()`, bricks already written, to a `snapshot()` in the other process that sees it
    pub to_snapshot: Samples,
    /// from there to a voxel of it read in place
    pub to_brick: Samples,
    /// `commit()` itself, where it is called
    pub duration: Samples,
}

/// Removes the domain's files last.
struct Files(Domain);

impl Drop for Files {
    fn drop(&mut self) {
        let _ = self.0.remove();
    }
}

/// Two processes, and every way between them. Fields are dropped in order: peer, ports, memory, files.
pub struct Pair {
    peer: Helper,
    socket: UnixStream,
    pings: Publisher<Ping>,
    pongs: Subscriber<Pong>,
    poses: Subscriber<ToolState>,
    moves: Publisher<ToolMove>,
    ask_event: Notifier,
    answer_event: Listener,
    reader: Reader,
    _commits: Subscriber<Commit>,
    _made: (Topic<Ping>, Topic<Pong>, Event, Event, Services, StoreKeeper),
    control: ControlMap,
    _node: Node,
    _domain: Files,
    cpus: Option<[usize; 2]>,
    asked: u64,
    lost: u64,
}

impl Pair {
    /// Makes the domain and starts the peer. The calling thread is pinned to one CPU, the peer to another, where there are two.
    ///
    /// # Errors
    /// When shared memory or the peer cannot be had.
    pub fn start(program: &Path) -> Result<Self, LatencyError> {
        let domain = Files(Domain::fresh()?);
        let control = ControlMap::create(&domain.0)?;
        let grid = Grid::axis_aligned([SIZE; 3], [1.0; 3]);
        let voxels = (0..grid.voxel_count()).map(|n| (n % 2003) as i16 - 1000).collect();
        let volume = Volume::new(grid, Rescale { slope: 1.0, intercept: 0.0 }, voxels);
        let sizes = StoreSizes { spare_slots: SPARE_SLOTS, ..StoreSizes::default() };
        let store = StoreKeeper::create(&domain.0, &volume, sizes, |_| {})?;
        drop(volume);
        let node = Node::open(&domain.0, "latency")?;
        let made = (
            node.create_topic()?,
            node.create_topic()?,
            node.create_event(event::ASKED)?,
            node.create_event(event::ANSWERED)?,
            node.create_services()?,
            store,
        );
        let path = domain.0.directory().join(SOCKET);
        let listener = UnixListener::bind(&path).map_err(io(format!("{} cannot be made", path.display())))?;

        let cpus = match allowed_cpus().as_slice() {
            [first, .., last] => Some([*last, *first]),
            _ => None,
        };
        let more = cpus.map_or(Vec::new(), |[_, theirs]| vec!["--cpu".to_owned(), theirs.to_string()]);
        let mut peer = Helper::start(program, "peer", domain.0.name(), &more)?;
        // the peer connects before it says so: accepting cannot block
        peer.expect("hello")?;
        let (socket, _) = listener.accept().map_err(io("the helper's socket cannot be accepted"))?;
        let pinned = cpus.filter(|[ours, _]| pin_to_cpu(*ours).is_none());
        Ok(Self {
            socket,
            pings: node.publisher()?,
            pongs: node.subscriber()?,
            poses: node.subscriber()?,
            moves: node.publisher()?,
            ask_event: node.notifier(event::ASKED)?,
            answer_event: node.listener(event::ANSWERED)?,
            reader: Reader::open(&domain.0, Role::Rendering)?,
            _commits: node.subscriber()?,
            peer,
            _made: made,
            control,
            _node: node,
            _domain: domain,
            cpus: pinned,
            asked: 0,
            lost: 0,
        })
    }

    /// CPUs of this thread and of the peer; `None` where there is but one.
    pub fn pinned(&self) -> Option<[usize; 2]> {
        self.cpus
    }

    /// Answers that never came.
    pub fn lost(&self) -> u64 {
        self.lost
    }

    /// 256 bytes through iceoryx2's publish-subscribe, one way. Blocking: an event follows the message.
    pub fn one_way(&mut self, waits: Waits, limits: Limits) -> Result<Samples, LatencyError> {
        self.answers("pong", waits, 1, limits, |pair, asked| {
            let take = || pair.pongs.next().filter(|m| m.sequence == asked).map(|m| m.time_ns);
            let sent = pair.receive(waits, take)?;
            Some(monotonic_ns().saturating_sub(sent))
        })
    }

    /// 256 bytes there and back.
    pub fn round_trip(&mut self, waits: Waits, limits: Limits) -> Result<Samples, LatencyError> {
        self.exchange("echo", waits, limits, |pair, asked| {
            let began = monotonic_ns();
            pair.pings.send(&Ping { time_ns: began, sequence: asked, ..Ping::zeroed() }).ok()?;
            if waits == Waits::Blocking {
                pair.ask_event.notify().ok()?;
            }
            pair.receive(waits, || pair.pongs.next().filter(|m| m.sequence == asked))?;
            Some(monotonic_ns() - began)
        })
    }

    /// The same 256 bytes through a Unix stream socket, one way.
    pub fn socket(&mut self, waits: Waits, limits: Limits) -> Result<Samples, LatencyError> {
        let set = |socket: &UnixStream| {
            socket.set_nonblocking(waits == Waits::Polled)?;
            socket.set_read_timeout(Some(Duration::from_nanos(PATIENCE_NS)))
        };
        set(&self.socket).map_err(io("the socket cannot be set up"))?;
        self.answers("socket", waits, 1, limits, |pair, asked| {
            let mut bytes = [0u8; PROBE_BYTES];
            let mut filled = 0;
            let deadline = monotonic_ns() + PATIENCE_NS;
            while filled < PROBE_BYTES {
                match (&pair.socket).read(&mut bytes[filled..]) {
                    Ok(0) => return None,
                    Ok(n) => filled += n,
                    Err(_) if monotonic_ns() > deadline => return None,
                    Err(_) => pair.spin(),
                }
            }
            let now = monotonic_ns();
            let pong: Pong = bytemuck::pod_read_unaligned(&bytes);
            (pong.sequence == asked).then(|| now.saturating_sub(pong.time_ns))
        })
    }

    /// A pose ([`ToolState`]) from its publisher to its receiver.
    pub fn pose(&mut self, waits: Waits, limits: Limits) -> Result<Samples, LatencyError> {
        self.answers("pose", waits, 1, limits, |pair, asked| {
            let take = || pair.poses.next().filter(|m| m.stamp.sequence == asked).map(|m| m.stamp.time_ns);
            let sent = pair.receive(waits, take)?;
            Some(monotonic_ns().saturating_sub(sent))
        })
    }

    /// From a notification to a listener that it has woken; the time travels in a word of shared memory.
    pub fn event_wake(&mut self, limits: Limits) -> Result<Samples, LatencyError> {
        let waits = Waits::Blocking;
        self.answers("event", waits, 1, limits, |pair, asked| {
            let take = || pair.control.tool.load::<ToolState>().filter(|(m, _)| m.stamp.sequence == asked).map(|(m, _)| m.stamp.time_ns);
            let sent = pair.receive(waits, take)?;
            Some(monotonic_ns().saturating_sub(sent))
        })
    }

    /// From the publishing of a tool move to the commit that answers it seen here. The writer is trivial (it rewrites one brick):
    /// this is the way, not the deformation.
    pub fn tool_move(&mut self, waits: Waits, limits: Limits) -> Result<Samples, LatencyError> {
        self.exchange("move", waits, limits, |pair, asked| {
            let epoch = pair.reader.epoch();
            let mut message = ToolMove::zeroed();
            message.stamp.sequence = asked;
            let began = monotonic_ns();
            pair.moves.send(&message).ok()?;
            if waits == Waits::Blocking {
                pair.ask_event.notify().ok()?;
            }
            let seen = pair.receive(waits, || (pair.reader.epoch() > epoch).then(|| pair.reader.snapshot().epoch()))?;
            let now = monotonic_ns();
            (seen > epoch).then(|| now - began)
        })
    }

    /// Commits of `bricks` bricks in the peer, seen here.
    pub fn commit(&mut self, bricks: usize, waits: Waits, limits: Limits) -> Result<CommitSamples, LatencyError> {
        let mut to_brick = Vec::new();
        let mut counted = 0;
        let (to_snapshot, duration) = {
            let epoch = std::cell::Cell::new(self.reader.epoch());
            self.answers_and_reply("commit", waits, bricks, limits, |pair, _| {
                let snapshot = pair.receive(waits, || (pair.reader.epoch() > epoch.get()).then(|| pair.reader.snapshot()))?;
                let seen = monotonic_ns();
                let committed = time_in(snapshot.brick(0));
                let read = monotonic_ns();
                epoch.set(snapshot.epoch());
                counted += 1;
                if counted > WARM_UP {
                    to_brick.push(read.saturating_sub(committed));
                }
                Some(seen.saturating_sub(committed))
            })?
        };
        Ok(CommitSamples { to_snapshot, to_brick: Samples(to_brick), duration })
    }

    /// `snapshot()` and its release, nobody committing.
    pub fn snapshot(&self, limits: Limits) -> Samples {
        self.timed(limits, || {
            std::hint::black_box(self.take_snapshot());
        })
    }

    /// The same while the peer commits one brick after another.
    ///
    /// # Errors
    /// When the peer fails.
    pub fn snapshot_while_committing(&mut self, limits: Limits) -> Result<Samples, LatencyError> {
        self.begin("churn", Waits::Polled, 1)?;
        let samples = self.snapshot(limits);
        self.end()?;
        Ok(samples)
    }

    /// Reading the clock: what each figure holds once.
    pub fn clock_read(&self, limits: Limits) -> Samples {
        self.timed(limits, || ())
    }

    /// One `snapshot()`, let go at once; its epoch. For timing by somebody else.
    pub fn take_snapshot(&self) -> u64 {
        self.reader.snapshot().epoch()
    }

    fn timed(&self, limits: Limits, mut work: impl FnMut()) -> Samples {
        let end = monotonic_ns() + limits.time.as_nanos() as u64;
        let mut samples = Vec::new();
        for n in 0.. {
            let began = monotonic_ns();
            work();
            let ended = monotonic_ns();
            if n >= WARM_UP {
                samples.push(ended - began);
            }
            if samples.len() as u64 >= limits.samples || ended > end {
                break;
            }
        }
        Samples(samples)
    }

    /// A loop in which the peer answers when it is asked through shared memory.
    fn answers(
        &mut self,
        what: &str,
        waits: Waits,
        bricks: usize,
        limits: Limits,
        once: impl FnMut(&Self, u64) -> Option<u64>,
    ) -> Result<Samples, LatencyError> {
        self.answers_and_reply(what, waits, bricks, limits, once).map(|(samples, _)| samples)
    }

    fn answers_and_reply(
        &mut self,
        what: &str,
        waits: Waits,
        bricks: usize,
        limits: Limits,
        mut once: impl FnMut(&Self, u64) -> Option<u64>,
    ) -> Result<(Samples, Samples), LatencyError> {
        self.looped(what, waits, bricks, limits, |pair, asked| {
            ask(&pair.control, asked, false);
            once(pair, asked)
        })
    }

    /// A loop in which the message itself asks.
    fn exchange(
        &mut self,
        what: &str,
        waits: Waits,
        limits: Limits,
        once: impl FnMut(&Self, u64) -> Option<u64>,
    ) -> Result<Samples, LatencyError> {
        self.looped(what, waits, 1, limits, once).map(|(samples, _)| samples)
    }

    /// The samples, and what the peer says at the end.
    fn looped(
        &mut self,
        what: &str,
        waits: Waits,
        bricks: usize,
        limits: Limits,
        mut once: impl FnMut(&Self, u64) -> Option<u64>,
    ) -> Result<(Samples, Samples), LatencyError> {
        self.begin(what, waits, bricks)?;
        let end = monotonic_ns() + limits.time.as_nanos() as u64;
        let (mut samples, mut answered, mut lost) = (Vec::new(), 0u64, 0);
        while (samples.len() as u64) < limits.samples && (monotonic_ns() < end || samples.is_empty()) {
            self.asked += 1;
            match once(self, self.asked) {
                Some(ns) => {
                    answered += 1;
                    if answered > WARM_UP {
                        samples.push(ns);
                    }
                }
                None => lost += 1,
            }
            if lost > MOST_LOST {
                return Err(LatencyError::Helper(format!("has not answered {lost} times while measuring `{what}`, {}", waits.word())));
            }
        }
        self.lost += lost;
        let reply = self.end()?;
        Ok((Samples(samples), reply))
    }

    fn begin(&mut self, what: &str, waits: Waits, bricks: usize) -> Result<(), LatencyError> {
        while self.pongs.next().is_some() || self.poses.next().is_some() {}
        self.peer.tell(&format!("{what} {} {bricks}", waits.word()))?;
        self.peer.expect("ready").map(drop)
    }

    /// Ends the loop; durations [ns] that the peer took itself.
    fn end(&mut self) -> Result<Samples, LatencyError> {
        ask(&self.control, self.asked, true);
        self.ask_event.notify()?;
        let said = self.peer.expect("done")?;
        Ok(Samples(said.split_whitespace().filter_map(|word| word.parse().ok()).skip(WARM_UP as usize).collect()))
    }

    /// Waits for something to be there.
    fn receive<T>(&self, waits: Waits, mut take: impl FnMut() -> Option<T>) -> Option<T> {
        let deadline = monotonic_ns() + PATIENCE_NS;
        match waits {
            Waits::Polled => loop {
                for _ in 0..512 {
                    if let Some(found) = take() {
                        return Some(found);
                    }
                    self.spin();
                }
                if monotonic_ns() > deadline {
                    return None;
                }
            },
            Waits::Blocking => loop {
                self.answer_event.wait(Duration::from_nanos(PATIENCE_NS)).ok()?;
                if let Some(found) = take() {
                    return Some(found);
                }
                if monotonic_ns() > deadline {
                    return None;
                }
            },
        }
    }

    #[inline]
    fn spin(&self) {
        spin(self.cpus.is_some());
    }
}

/// Waits a moment: with a CPU of one's own by spinning, else by giving way to the other side.
#[inline]
pub(crate) fn spin(own_cpu: bool) {
    if own_cpu { std::hint::spin_loop() } else { std::thread::yield_now() }
}

/// Asks the peer, or ends its loop, through a cell that no simulation uses here.
fn ask(control: &ControlBlock, sequence: u64, stop: bool) {
    let mut command = ToolCommand::zeroed();
    (command.stamp.sequence, command.taken) = (sequence, u64::from(stop));
    control.command.store(&command);
}

/// The time that a commit wrote into its first brick.
fn time_in(brick: &Brick) -> u64 {
    std::array::from_fn::<_, 4, _>(|n| brick.voxels[n] as u16).into_iter().rev().fold(0, |time, word| time << 16 | u64::from(word))
}

/// Writes the time into a brick's first four voxels.
pub(crate) fn put_time(brick: &mut Brick, time_ns: u64) {
    for n in 0..4 {
        brick.voxels[n] = (time_ns >> (16 * n)) as u16 as i16;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_time_put_into_a_brick_is_read_back() {
        let mut brick = Brick::zeroed();
        for time in [0, 1, 0x8000_7FFF_FFFF_0001, u64::MAX, 123_456_789_012_345] {
            put_time(&mut brick, time);
            assert_eq!(time_in(&brick), time);
        }
    }

    #[test]
    fn percentiles_of_samples_are_those_of_the_histogram() {
        let samples = Samples((1..=1000).map(|n| n * 1000).collect());
        let p = samples.percentiles();
        assert!((p.p50 / 500_000.0 - 1.0).abs() < 0.05 && p.max == 1e6 && p.count == 1000, "{p:?}");
        assert_eq!(samples.total(), Duration::from_nanos(500_500_000));
        assert_eq!(Samples::default().percentiles(), Percentiles::default());
    }
}
