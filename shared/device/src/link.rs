//! The thread of a device, and the device as the tick sees it.
//!
//! The thread opens the device, exchanges (a report against a command) as fast as the device does, and when that fails closes it,
//! tells so, and looks again every [`RETRY`]. Reports and commands pass through latest-value cells: the tick's calls are loads and
//! stores, never waits.
//!
//! Safe side (`guard`): a command older than [`SILENT_NS`] counts as zero force (the tick hangs or died); forces that are not finite or beyond the
//! profile are held; after a reconnection the force rises again over [`RISE_NS`]; on drop the device's force fades to zero before it is closed.

use crate::{DeviceError, Mounting, guard::Guard, mounting};
use bytemuck::{Pod, Zeroable};
use maille_contact::{Device, DevicePose, DeviceProfile, DeviceStatus};
use maille_contract::cell::LatestCell;
use maille_realtime::{enter_realtime, monotonic_ns};
use std::{
    cell::RefCell,
    sync::{
        Arc,
        atomic::{AtomicBool, AtomicU64, Ordering::Relaxed},
        mpsc::{Receiver, RecvTimeoutError, sync_channel},
    },
    thread::{self, JoinHandle},
    time::{Duration, Instant},
};

/// A tick that has not written for this long has gone [ns].
pub const SILENT_NS: u64 = 20_000_000;
/// An exchange that ends so long after the one before is late: a device at 1 kHz has missed a turn [ns].
pub const LATE_NS: u64 = 2_000_000;
/// Pause between two attempts to find a device.
pub const RETRY: Duration = Duration::from_millis(100);
/// Longest wait for the thread of a device that is let go: two exchanges of the slowest kind. A library or a name server that hangs does not keep the
/// process, whose end closes what is open.
const LET_GO: Duration = Duration::from_millis(500);
/// Sentences that wait for somebody to take them; more are left out.
const UNHEARD: usize = 32;
/// A device that is there and has not ended an exchange for this long is said to be stuck.
const STUCK: Duration = Duration::from_secs(1);
/// Most sentences in a second about whether a device is ready.
const OFTEN: u32 = 4;
/// Exchanges without an orientation, from a device that told one, after which that is said.
const UNTURNED: u32 = 1_000;
/// Rise of the force after a device came (back) [ns].
pub const RISE_NS: u64 = 500_000_000;

/// What a device says, in its own frame.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
pub struct Report {
    /// tip [mm]
    pub position_mm: [f64; 3],
    /// of the tip [mm/s]
    pub velocity_mm_s: [f64; 3],
    /// of the tool (x, y, z, w); zero where the device tells none, no numbers where what it tells is none
    pub orientation: [f64; 4],
    /// one bit each
    pub buttons: u64,
    /// 1: ready to give force
    pub ready: u64,
    /// 1: `velocity_mm_s` is the device's own
    pub has_velocity: u64,
    /// when it was taken [ns, CLOCK_MONOTONIC]
    pub taken_ns: u64,
    /// what the device warns of, in its maker's code; 0: nothing
    pub warning: u64,
    /// part of the command that was not given to it, 0 to 1: the driver held it back
    pub withheld: f64,
}

impl Report {
    /// Whether it says how the tool is turned.
    fn is_turned(&self) -> bool {
        self.orientation.iter().map(|c| c * c).sum::<f64>() > 1e-6
    }
}

fn finite(values: &[f64]) -> bool {
    values.iter().all(|v| v.is_finite())
}

/// What a device shall do, in its own frame.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
pub struct Command {
    /// [N]
    pub force_n: [f64; 3],
    /// [N·mm]
    pub torque_n_mm: [f64; 3],
    /// when it was given [ns, CLOCK_MONOTONIC]
    pub given_ns: u64,
    /// pads to a multiple of eight words
    pub reserved: u64,
}

/// The side of a device that may block. All calls come from one thread.
pub trait Driver: Send + 'static {
    /// Finds the device and makes it ready.
    ///
    /// # Errors
    /// When it is not there.
    fn open(&mut self) -> Result<(), DeviceError>;
    /// One exchange: gives the command, waits for the next report (a millisecond, as long as the device takes). The command is asked for when it
    /// goes out: one that was taken before a wait may be stale after it.
    ///
    /// # Errors
    /// When the device has gone.
    fn exchange(&mut self, command: &dyn Fn() -> Command) -> Result<Report, DeviceError>;
    /// Lets go; also after a failed exchange.
    fn close(&mut self);
}

const REPORT_WORDS: usize = size_of::<Report>() / 8;
const COMMAND_WORDS: usize = size_of::<Command>() / 8;

struct Shared {
    report: LatestCell<REPORT_WORDS>,
    command: LatestCell<COMMAND_WORDS>,
    stop: AtomicBool,
    connected: AtomicBool,
    /// times it was opened, and when it was last [ns]
    opened: AtomicU64,
    opened_ns: AtomicU64,
    /// exchanges so far, and those that came late
    exchanges: AtomicU64,
    late: AtomicU64,
    /// part of the force that is given on the way back from a silence, and by a driver that holds some of it back, as the bits of an f64
    share: AtomicU64,
}

/// A real device as the tick sees it.
pub struct RemoteDevice {
    shared: Arc<Shared>,
    profile: DeviceProfile,
    mounting: Mounting,
    last: Report,
    seen: bool,
    status: DeviceStatus,
    thread: Option<JoinHandle<()>>,
}

impl RemoteDevice {
    /// Starts the thread of a device.
    ///
    /// # Errors
    /// When the thread cannot be started.
    pub fn start(driver: impl Driver, profile: DeviceProfile, mounting: Mounting) -> Result<Self, DeviceError> {
        Self::start_telling(driver, profile, mounting, 0, |_| ())
    }

    /// The same with SCHED_FIFO of `priority` for the thread (0: none), where that is allowed: who asks for it for the tick is told when it is not. `tell`
    /// gets one sentence when the device is not there, is lost, is not ready, and when it is back. It is called on a thread of its own: a terminal that takes no
    /// more lines, or has gone, must keep nobody who holds a force.
    ///
    /// # Errors
    /// When the thread cannot be started.
    pub fn start_telling(
        driver: impl Driver,
        profile: DeviceProfile,
        mounting: Mounting,
        priority: i32,
        tell: impl Fn(&str) + Send + 'static,
    ) -> Result<Self, DeviceError> {
        let shared = Arc::new(Shared {
            report: LatestCell::zeroed(),
            command: LatestCell::zeroed(),
            stop: AtomicBool::new(false),
            connected: AtomicBool::new(false),
            opened: AtomicU64::new(0),
            opened_ns: AtomicU64::new(0),
            exchanges: AtomicU64::new(0),
            late: AtomicU64::new(0),
            share: AtomicU64::new(1f64.to_bits()),
        });
        let for_thread = Arc::clone(&shared);
        let (sender, sentences) = sync_channel::<String>(UNHEARD);
        let for_word = Arc::clone(&shared);
        thread::Builder::new().name("device's word".into()).spawn(move || say(&sentences, &for_word, profile.name, &tell))?;
        let serve = move || {
            // a command that waits for a time slice is felt as a tick that came late
            drop(enter_realtime(priority, None));
            serve(driver, &for_thread, &profile, &|sentence| drop(sender.try_send(sentence.to_owned())));
        };
        let thread = thread::Builder::new().name("device".into()).spawn(serve)?;
        Ok(Self { shared, profile, mounting, last: Report::zeroed(), seen: false, status: DeviceStatus::Unplugged, thread: Some(thread) })
    }

    /// Times the device was opened: more than one after it was unplugged.
    pub fn opened(&self) -> u64 {
        self.shared.opened.load(Relaxed)
    }

    /// Exchanges with the device so far.
    pub fn exchanges(&self) -> u64 {
        self.shared.exchanges.load(Relaxed)
    }

    /// Exchanges that ended more than [`LATE_NS`] after the one before.
    pub fn late(&self) -> u64 {
        self.shared.late.load(Relaxed)
    }
}

impl Device for RemoteDevice {
    fn read(&mut self, _now_ns: u64) -> DevicePose {
        // a place that is none is no place: the last one stays, and is not vouched for
        let mut sound = true;
        if let Some((report, _)) = self.shared.report.load::<Report>() {
            let (placed, turned) = (finite(&report.position_mm), finite(&report.orientation));
            sound = placed && turned;
            let position_mm = if placed { report.position_mm } else { self.last.position_mm };
            // a report that says nothing of it, or nothing that makes sense, is no turn of the tool
            let orientation = if turned && report.is_turned() { report.orientation } else { self.last.orientation };
            (self.last, self.seen) = (Report { position_mm, orientation, ..report }, true);
        }
        self.status = match (self.seen && self.shared.connected.load(Relaxed), self.last.ready == 1) {
            (false, _) => DeviceStatus::Unplugged,
            (true, false) => DeviceStatus::NotReady,
            (true, true) => DeviceStatus::Connected,
        };
        let direction = match self.orientation() {
            // a tool points along its own z
            Some(q) => mounting::matrix(q).map(|row| row[2]),
            None => self.mounting.turn([0.0, 0.0, -1.0]),
        };
        DevicePose {
            position_mm: self.mounting.place(self.last.position_mm),
            direction,
            // in the patient's millimetres, as the position
            velocity_mm_s: (self.last.has_velocity == 1)
                .then(|| self.mounting.turn(self.last.velocity_mm_s).map(|v| v * self.mounting.scale)),
            valid: sound && self.status == DeviceStatus::Connected,
        }
    }

    fn write(&mut self, force_n: [f64; 3]) {
        self.write_wrench(force_n, [0.0; 3]);
    }

    fn write_wrench(&mut self, force_n: [f64; 3], torque_n_mm: [f64; 3]) {
        let command = Command {
            force_n: self.mounting.turn_back(force_n),
            torque_n_mm: self.mounting.turn_back(torque_n_mm).map(|t| t / self.mounting.scale),
            given_ns: monotonic_ns(),
            reserved: 0,
        };
        self.shared.command.store(&command);
    }

    fn orientation(&self) -> Option<[f64; 4]> {
        self.last
            .is_turned()
            .then(|| mounting::quaternion(mounting::product(self.mounting.rotation, mounting::matrix(self.last.orientation))))
    }

    fn buttons(&self) -> u32 {
        self.last.buttons as u32
    }

    fn pose_age_s(&self) -> f64 {
        if self.seen { monotonic_ns().saturating_sub(self.last.taken_ns) as f64 * 1e-9 } else { f64::INFINITY }
    }

    fn gives(&self) -> f64 {
        let share = f64::from_bits(self.shared.share.load(Relaxed));
        if self.shared.connected.load(Relaxed) { share * risen(self.shared.opened_ns.load(Relaxed), monotonic_ns()) } else { 0.0 }
    }

    fn status(&self) -> DeviceStatus {
        self.status
    }

    fn profile(&self) -> Option<DeviceProfile> {
        Some(self.profile)
    }
}

impl Drop for RemoteDevice {
    fn drop(&mut self) {
        self.shared.stop.store(true, Relaxed);
        if let Some(thread) = self.thread.take() {
            thread.thread().unpark();
            let until = Instant::now() + LET_GO;
            while !thread.is_finished() && Instant::now() < until {
                thread::sleep(Duration::from_millis(1));
            }
            if thread.is_finished() {
                // one that panicked has let go of its device already
                let _ = thread.join();
            }
        }
    }
}

/// Passes on what the device's thread has to say, and says that it is stuck where it cannot: a call into a library that does not return.
fn say(sentences: &Receiver<String>, shared: &Shared, name: &str, tell: &dyn Fn(&str)) {
    let (mut seen, mut since, mut stuck) = (0, Instant::now(), false);
    loop {
        match sentences.recv_timeout(STUCK / 4) {
            Ok(sentence) => tell(&sentence),
            Err(RecvTimeoutError::Disconnected) => return,
            Err(RecvTimeoutError::Timeout) => {}
        }
        let exchanges = shared.exchanges.load(Relaxed);
        if exchanges != seen || !shared.connected.load(Relaxed) {
            if std::mem::take(&mut stuck) && exchanges != seen {
                tell(&format!("the device ({name}) answers again"));
            }
            (seen, since) = (exchanges, Instant::now());
        } else if !stuck && since.elapsed() > STUCK {
            stuck = true;
            shared.late.fetch_add(1, Relaxed);
            tell(&format!(
                "the device ({name}) has not answered for a second: its library or service holds the call, and the device may keep its last force; \
                 switch it off, and on again"
            ));
        }
    }
}

/// Closes the device however the thread ends.
struct Opened<'a, D: Driver>(&'a mut D, &'a Shared);

impl<D: Driver> Drop for Opened<'_, D> {
    fn drop(&mut self) {
        self.1.connected.store(false, Relaxed);
        self.0.close();
    }
}

/// What was said last of a device, so that nothing is said twice.
struct Said {
    last: Word,
    /// since when sentences are counted [ns], and how many there were
    since_ns: u64,
    count: u32,
}

#[derive(Clone, Copy, PartialEq)]
enum Word {
    Nothing,
    Away,
    NotReady,
    Ready,
}

impl Said {
    /// The device cannot be had. A service that answers without its device is tried ten times a second: said once.
    fn away(&mut self, error: &DeviceError, tell: &dyn Fn(&str)) {
        if self.last != Word::Away {
            tell(&format!("{error}; it is looked for ten times a second, and the force is zero meanwhile"));
            self.last = Word::Away;
        }
    }

    /// The device has spoken. One that changes its mind again and again is heard [`OFTEN`] times a second.
    fn heard(&mut self, ready: bool, name: &str, tell: &dyn Fn(&str)) {
        let word = if ready { Word::Ready } else { Word::NotReady };
        if word == self.last {
            return;
        }
        let now = monotonic_ns();
        if now > self.since_ns + 1_000_000_000 {
            (self.since_ns, self.count) = (now, 0);
        }
        self.count += 1;
        if self.count > OFTEN {
            return;
        }
        match (self.last, ready) {
            (Word::Away, true) => tell(&format!("the device ({name}) is there; its force rises over 0.5 s")),
            (Word::NotReady, true) => tell(&format!("the device ({name}) is ready")),
            (_, false) => tell(&format!(
                "the device ({name}) is there but not ready: home or calibrate it, switch its power on; the force is zero meanwhile"
            )),
            (Word::Nothing | Word::Ready, true) => {}
        }
        self.last = word;
    }
}

fn serve(mut driver: impl Driver, shared: &Shared, profile: &DeviceProfile, tell: &dyn Fn(&str)) {
    let (mut said, mut warned) = (Said { last: Word::Nothing, since_ns: 0, count: 0 }, Vec::new());
    let (mut turned, mut unturned) = (false, 0);
    while !shared.stop.load(Relaxed) {
        if let Err(error) = driver.open() {
            said.away(&error, tell);
            driver.close();
            thread::park_timeout(RETRY);
            continue;
        }
        shared.opened.fetch_add(1, Relaxed);
        let began = monotonic_ns();
        shared.opened_ns.store(began, Relaxed);
        let (mut last_ns, guard) = (None, RefCell::new(Guard::new(profile, began)));
        let opened = Opened(&mut driver, shared);
        while !shared.stop.load(Relaxed) {
            let command = || guard.borrow_mut().pass(shared.command.load::<Command>().map(|(command, _)| command), monotonic_ns());
            let mut report = match opened.0.exchange(&command) {
                Ok(report) => report,
                Err(error) => {
                    // who is leaving has no more to say of it
                    if !shared.stop.load(Relaxed) {
                        said.away(&error, tell);
                    }
                    break;
                }
            };
            report.taken_ns = monotonic_ns();
            shared.report.store(&report);
            shared.connected.store(true, Relaxed);
            said.heard(report.ready == 1, profile.name, tell);
            if report.is_turned() {
                (turned, unturned) = (true, 0);
            } else if turned {
                unturned += 1;
                if unturned == UNTURNED {
                    let name = profile.name;
                    tell(&format!("the device ({name}) does not tell any more how its handle is turned; the tool stays as it was"));
                }
            }
            if report.warning != 0 && !warned.contains(&report.warning) {
                let (name, code) = (profile.name, report.warning);
                tell(&format!(
                    "the device ({name}) warns ({code:#06x}: warm motors, or too large a force or too fast a hand for it); its force is lowered"
                ));
                warned.push(report.warning);
            }
            shared.exchanges.fetch_add(1, Relaxed);
            let given = guard.borrow().share() * (1.0 - report.withheld.clamp(0.0, 1.0));
            shared.share.store(given.to_bits(), Relaxed);
            let late = last_ns.replace(report.taken_ns).is_some_and(|last| report.taken_ns - last > LATE_NS);
            shared.late.fetch_add(u64::from(late), Relaxed);
        }
        if shared.stop.load(Relaxed) {
            // whoever ends in order has let go before; who panics has not, and a device that keeps its last force must not keep this one
            let until = Instant::now() + LET_GO / 2;
            while guard.borrow().gives()
                && Instant::now() < until
                && opened.0.exchange(&|| guard.borrow_mut().pass(None, monotonic_ns())).is_ok()
            {}
            let _ = opened.0.exchange(&Command::zeroed);
        }
        drop(opened);
        if !shared.stop.load(Relaxed) {
            thread::park_timeout(RETRY);
        }
    }
}

/// What part of its force a device gives that was opened then.
pub(crate) fn risen(opened_ns: u64, now_ns: u64) -> f64 {
    (now_ns.saturating_sub(opened_ns) as f64 / RISE_NS as f64).min(1.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::profiles::TOUCH;

    /// A device that is absent, comes, is not ready, is, goes and comes again, each for some exchanges.
    struct Unsteady {
        exchanges: u64,
        opens: u64,
    }

    impl Driver for Unsteady {
        fn open(&mut self) -> Result<(), DeviceError> {
            self.opens += 1;
            if self.opens <= 2 { Err(DeviceError::NotThere { device: "the toy", reason: "no cable".into() }) } else { Ok(()) }
        }

        fn exchange(&mut self, _: &dyn Fn() -> Command) -> Result<Report, DeviceError> {
            thread::sleep(Duration::from_millis(1));
            self.exchanges += 1;
            match self.exchanges {
                1..=10 => Ok(Report::zeroed()),
                21..=23 => Err(DeviceError::Lost { device: "the toy", reason: "unplugged".into() }),
                _ => Ok(Report { ready: 1, ..Report::zeroed() }),
            }
        }

        fn close(&mut self) {}
    }

    /// A device whose eleventh exchange takes a while.
    struct Stuck(u64);

    impl Driver for Stuck {
        fn open(&mut self) -> Result<(), DeviceError> {
            Ok(())
        }

        fn exchange(&mut self, _: &dyn Fn() -> Command) -> Result<Report, DeviceError> {
            self.0 += 1;
            thread::sleep(if self.0 == 11 { STUCK * 2 } else { Duration::from_millis(1) });
            Ok(Report { ready: 1, withheld: 0.75, ..Report::zeroed() })
        }

        fn close(&mut self) {}
    }

    #[test]
    fn a_call_that_does_not_return_is_told_and_counted_and_what_a_driver_holds_back_too() {
        let (sender, told) = std::sync::mpsc::channel();
        let tell = move |sentence: &str| drop(sender.send(sentence.to_owned()));
        let device = RemoteDevice::start_telling(Stuck(0), TOUCH, Mounting::default(), 0, tell).unwrap();
        let wait = Duration::from_secs(20);
        assert!(told.recv_timeout(wait).unwrap().contains("has not answered for a second"));
        assert!(device.exchanges() == 10 && device.late() > 0, "{} {}", device.exchanges(), device.late());
        assert!(told.recv_timeout(wait).unwrap().contains("answers again"));
        assert!(device.gives() > 0.0 && device.gives() <= 0.25, "{}", device.gives());
        drop(device);
        assert_eq!(told.iter().count(), 0);
    }

    #[test]
    fn each_thing_that_happens_to_a_device_is_told_once() {
        let (sender, told) = std::sync::mpsc::channel();
        let tell = move |sentence: &str| drop(sender.send(sentence.to_owned()));
        let device = RemoteDevice::start_telling(Unsteady { exchanges: 0, opens: 0 }, TOUCH, Mounting::default(), 0, tell).unwrap();
        while device.exchanges() < 40 {
            thread::sleep(Duration::from_millis(5));
        }
        drop(device);
        let told: Vec<String> = told.into_iter().collect();
        let parts =
            ["the toy is not there: no cable", "not ready", "is ready", "the toy stopped answering: unplugged", "is there; its force"];
        assert_eq!(told.len(), parts.len(), "{told:?}");
        assert!(told.iter().zip(parts).all(|(sentence, part)| sentence.contains(part)), "{told:?}");
    }
}
