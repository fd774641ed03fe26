//! What the governor looks at: time that loops spend, turns that they miss, and whose doing that is.

use maille_contract::{
    ControlBlock, Role, ServiceState,
    control::Counter,
    histogram::{BUCKETS, lower},
};
use maille_governor::{Load, Loop, Shares};
use std::{collections::VecDeque, sync::atomic::Ordering::Relaxed};

/// Share of the period at the floor that a turn may take: the rest is for what is not counted in it.
pub(super) const PLANNED: f64 = 0.9;
/// How much of a new look enters a load.
const FOLLOW: f64 = 0.5;
/// A loop that has not turned for so long, and looks whether it has to, rests: it has all the room there is [ns].
const RESTS_NS: u64 = 1_000_000_000;
/// A loop whose heart did not beat for so long is in a turn, starved or dead [ns].
const BEATS_NS: u64 = 200_000_000;
/// Share of missed ticks above which the haptic loop presses others.
pub(super) const MISSED: f64 = 0.005;
/// Looks over which ticks and frames are counted: a second.
const COUNTED_LOOKS: usize = 10;
/// Looks of those in which some must have been missed: a loop that stood still once is not one that cannot keep up.
const OFTEN: usize = 3;
/// Rungs that rendering gives for the haptic loop before it is asked whether that helps.
pub(super) const GIVEN: u32 = 3;
/// Share of the misses at which it does.
const HELPED: f64 = 0.7;
/// For so long rendering is not asked again where it did not [ns].
const ABSOLVED_NS: u64 = 20_000_000_000;

/// Time that a loop of one service spends on its turns.
pub(super) struct Busy {
    of: Loop,
    role: Role,
    /// time that there is for a turn [ns]
    there_is_ns: f64,
    counts: Vec<u64>,
    /// time in the parts on which knobs act, where that is counted
    parts_ns: [u64; 2],
    /// and their shares
    shares: Shares,
    /// and when it was last seen
    load: Option<(f64, u64)>,
}

impl Busy {
    pub(super) fn new(of: Loop, role: Role, floor_hz: f64) -> Self {
        Self {
            of,
            role,
            there_is_ns: PLANNED * 1e9 / floor_hz,
            counts: vec![0; BUCKETS],
            parts_ns: [0; 2],
            shares: Shares::ALL,
            load: None,
        }
    }

    pub(super) fn look(&mut self, control: &ControlBlock, now_ns: u64) {
        let counts = control.service(self.role).duration.counts();
        let (mut turns, mut spent_ns) = (0u64, 0.0);
        for (bucket, (now, before)) in counts.iter().zip(&self.counts).enumerate() {
            let new = now.saturating_sub(*before);
            turns += new;
            spent_ns += new as f64 * lower(bucket) as f64;
        }
        self.counts = counts;
        let parts_ns = [Counter::ViewNs, Counter::WarpNs].map(|part| control.service(self.role).counter(part));
        let new: [f64; 2] = std::array::from_fn(|n| parts_ns[n].saturating_sub(self.parts_ns[n]) as f64);
        self.parts_ns = parts_ns;
        if turns > 0 {
            if new[0] > 0.0 {
                // the bounds of a histogram are not exact
                let all = spent_ns.max(new[0] + new[1]);
                let shares = Shares { view: new[0] / all, warp: new[1] / all };
                let follow = |old: f64, new: f64| old + FOLLOW * (new - old);
                self.shares = match self.load {
                    Some(_) => Shares { view: follow(self.shares.view, shares.view), warp: follow(self.shares.warp, shares.warp) },
                    None => shares,
                };
            }
            let seen = spent_ns / turns as f64 / self.there_is_ns;
            self.load = Some((self.load.map_or(seen, |(load, _)| load + FOLLOW * (seen - load)), now_ns));
        }
    }

    /// The load now; none before the first turn, and of a loop of which nothing is heard.
    pub(super) fn load(&self, control: &ControlBlock, now_ns: u64) -> Option<Load> {
        let (load, at_ns) = self.load?;
        let turned = now_ns.saturating_sub(at_ns) < RESTS_NS;
        let cell = control.service(self.role);
        let beats = cell.state() == ServiceState::Ready && now_ns.saturating_sub(cell.heartbeat_ns.load(Relaxed)) < BEATS_NS;
        let load = match (turned, beats) {
            (true, _) => load,
            (false, true) => 0.0,
            (false, false) => return None,
        };
        Some(Load { of: self.of, load, shares: self.shares })
    }
}

/// Share of a loop's turns that were missed over the last second, or the last half if no more was seen; nothing where they were missed at once.
pub(super) struct Turns {
    of: Role,
    counts: VecDeque<[u64; 2]>,
}

impl Turns {
    pub(super) fn new(of: Role) -> Self {
        Self { of, counts: VecDeque::new() }
    }

    pub(super) fn missed(&mut self, control: &ControlBlock) -> Option<f64> {
        let cell = control.service(self.of);
        let now = [cell.counter(Counter::Iterations), cell.counter(Counter::Overruns)];
        self.counts.push_back(now);
        if self.counts.len() > COUNTED_LOOKS {
            self.counts.pop_front();
        }
        let [turned, missed] = self.counts.front().map_or([0; 2], |then| [0, 1].map(|n| now[n].saturating_sub(then[n])));
        let often = self.counts.iter().zip(self.counts.iter().skip(1)).filter(|(then, now)| now[1] > then[1]).count() >= OFTEN;
        let share = if often { missed as f64 / (turned + missed) as f64 } else { 0.0 };
        (self.counts.len() > COUNTED_LOOKS / 2).then_some(share)
    }

    /// What was done counts no more: what is missed from now on is another setting's.
    pub(super) fn forget(&mut self) {
        self.counts.clear();
    }
}

/// Whether the haptic loop's misses are rendering's doing: what other programs take, no knob gives back.
#[derive(Default)]
pub(super) struct Blame {
    /// share missed when rendering first gave way, and rungs given since
    since: Option<(f64, u32)>,
    absolved_until_ns: u64,
}

impl Blame {
    /// Whether misses press rendering.
    pub(super) fn stands(&mut self, missed: Option<f64>, now_ns: u64) -> bool {
        let Some(missed) = missed else { return false };
        if missed <= MISSED {
            self.since = None;
        }
        if self.since.is_some_and(|(first, given)| given >= GIVEN && missed > HELPED * first) {
            (self.since, self.absolved_until_ns) = (None, now_ns + ABSOLVED_NS);
        }
        missed > MISSED && now_ns >= self.absolved_until_ns
    }

    pub(super) fn gave(&mut self, missed: f64) {
        let (first, given) = self.since.unwrap_or((missed, 0));
        self.since = Some((first, given + 1));
    }
}
