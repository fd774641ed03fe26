//! Breathing under a hand: a slider takes over the level, or another signal's breath is held, slowed or let go on.
//!
//! Everything eases as a critically damped spring, x″ = k²(target − x) − 2k·x′, in closed form, so that level and rate never step:
//!   time of the base signal  s(t) = ∫ v, its speed v eased (0 holds the breath, 1 lets it go on where it was held);
//!   level = (1 − m)·base(s(t)) + m·slider, mix m and slider eased.
//!
//! A [`LiveState`] is plain numbers and says everything from its `since_ns` on; whoever takes the command makes the next state from the last
//! ([`LiveState::after`]) a little ahead of now and publishes both. Every process that holds both computes the same state for the same
//! time, whenever the message arrived before then.
//!
//! Phase while the slider leads: that of expiration at its level, reached along the shorter way round.

use crate::breath::{Breath, Breathing};

/// Something that eases towards a target, C¹.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, bytemuck::Pod, bytemuck::Zeroable)]
pub struct Ease {
    /// value at the beginning
    pub from: f64,
    /// d value/dt at the beginning [1/s]
    pub rate: f64,
    /// where it goes
    pub target: f64,
}

/// How fast things ease [1/s]: nine tenths of the way in 0.5 s.
const K: f64 = 8.0;

impl Ease {
    /// Stays.
    pub const fn at_rest(value: f64) -> Self {
        Self { from: value, rate: 0.0, target: value }
    }

    /// Value, rate and integral after `t` seconds.
    fn after(&self, t: f64) -> (f64, f64, f64) {
        let a = self.from - self.target;
        let b = self.rate + K * a;
        let fade = (-K * t).exp();
        let integral = self.target * t + (a + b / K) / K * (1.0 - fade) - b / K * t * fade;
        (self.target + (a + b * t) * fade, (b - K * (a + b * t)) * fade, integral)
    }

    fn towards(&self, t: f64, target: f64) -> Self {
        let (from, rate, _) = self.after(t);
        Self { from, rate, target }
    }
}

/// How breathing is led from a time on. Plain numbers: it may travel in a message.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, bytemuck::Pod, bytemuck::Zeroable)]
pub struct LiveState {
    /// simulation time from which it holds [ns]
    pub since_ns: u64,
    /// time of the base signal at `since_ns` [ns]
    pub base_ns: u64,
    /// speed of the base signal: 1 as recorded, 0 held
    pub speed: Ease,
    /// 0: the base signal leads; 1: the slider
    pub mix: Ease,
    /// level that the slider asks for
    pub slider: Ease,
}

impl LiveState {
    /// The base signal as it is.
    pub const fn untouched() -> Self {
        Self { since_ns: 0, base_ns: 0, speed: Ease::at_rest(1.0), mix: Ease::at_rest(0.0), slider: Ease::at_rest(0.0) }
    }

    fn elapsed_s(&self, time_ns: u64) -> f64 {
        time_ns.saturating_sub(self.since_ns) as f64 * 1e-9
    }

    /// Time of the base signal [ns].
    fn base_ns(&self, time_ns: u64) -> u64 {
        // at full speed whole nanoseconds are added, so that nothing is lost over days
        if self.speed == Ease::at_rest(1.0) {
            return self.base_ns.saturating_add(time_ns.saturating_sub(self.since_ns));
        }
        let passed = self.speed.after(self.elapsed_s(time_ns)).2.max(0.0) * 1e9;
        self.base_ns.saturating_add(passed.round() as u64)
    }

    /// The state that goes on from this one at `time_ns` with other targets: speed of the base (0 holds the breath), and the slider's
    /// level if it leads.
    pub fn after(&self, time_ns: u64, speed: f64, slider: Option<f64>) -> Self {
        let t = self.elapsed_s(time_ns);
        let bounded = |v: f64, low: f64, high: f64| if v.is_finite() { v.clamp(low, high) } else { low };
        let level = slider.map_or(self.slider.target, |level| bounded(level, -0.5, 1.5));
        let mut next_slider = self.slider.towards(t, level);
        // nobody sees a slider that leads nothing: it begins where it is wanted
        if self.mix == Ease::at_rest(0.0) {
            next_slider = Ease::at_rest(level);
        }
        Self {
            since_ns: time_ns.max(self.since_ns),
            base_ns: self.base_ns(time_ns),
            speed: self.speed.towards(t, bounded(speed, 0.0, 3.0)),
            mix: self.mix.towards(t, if slider.is_some() { 1.0 } else { 0.0 }),
            slider: next_slider,
        }
    }

    fn lead(&self, base: &impl Breathing, time_ns: u64) -> Breath {
        let t = self.elapsed_s(time_ns);
        let below = base.at(self.base_ns(time_ns));
        let (speed, _, _) = self.speed.after(t);
        let (mix, mix_rate, _) = self.mix.after(t);
        let (slider, slider_rate, _) = self.slider.after(t);
        let rate = below.rate * speed;
        let wanted = 0.5 * (1.0 - slider.clamp(0.0, 1.0));
        // the shorter way round, in [−½, ½)
        let way = (wanted - below.phase + 0.5).rem_euclid(1.0) - 0.5;
        Breath {
            level: below.level + mix * (slider - below.level),
            rate: rate + mix * (slider_rate - rate) + mix_rate * (slider - below.level),
            phase: (below.phase + mix * way).rem_euclid(1.0),
        }
    }
}

/// A signal under a hand.
#[derive(Clone, Debug)]
pub struct Live<B> {
    /// what breathes by itself
    pub base: B,
    /// the last command and the one before: the later holds from its own time on
    pub states: [LiveState; 2],
}

impl<B: Breathing> Live<B> {
    /// The base signal, untouched.
    pub fn new(base: B) -> Self {
        Self { base, states: [LiveState::untouched(); 2] }
    }

    /// Goes on from `time_ns` with another speed and slider; commands come in the order of their times.
    pub fn command(&mut self, time_ns: u64, speed: f64, slider: Option<f64>) {
        self.states = [self.states[1], self.states[1].after(time_ns, speed, slider)];
    }
}

impl<B: Breathing> Breathing for Live<B> {
    fn at(&self, time_ns: u64) -> Breath {
        let [before, last] = &self.states;
        let state = if time_ns >= last.since_ns { last } else { before };
        state.lead(&self.base, time_ns)
    }
}

#[cfg(test)]
mod tests {
    use super::super::{BreathStatistics, Synthetic};
    use super::*;

    const MS: u64 = 1_000_000;

    #[test]
    fn holding_and_sliding_never_step_and_rate_is_the_derivative() {
        let mut live = Live::new(Synthetic::new(&BreathStatistics::default(), 2));
        let commands =
            [(3000, 0.0, None), (3200, 1.0, None), (6000, 0.0, None), (9000, 1.0, Some(0.2)), (9100, 1.0, Some(1.3)), (12_000, 1.0, None)];
        let mut last = live.at(0);
        let mut held = Vec::new();
        for ms in 0..16_000u64 {
            for (at, speed, slider) in commands {
                if at == ms {
                    live.command(ms * MS, speed, slider);
                }
            }
            let (now, half, next) = (live.at(ms * MS), live.at(ms * MS + MS / 2), live.at(ms * MS + MS));
            assert!((half.rate - (next.level - now.level) / 1e-3).abs() < 2e-3, "{ms} ms: {now:?} {next:?}");
            assert!((now.level - last.level).abs() < 0.01 && (now.rate - last.rate).abs() < 0.25, "{ms} ms: {last:?} {now:?}");
            let turned = (now.phase - last.phase + 0.5).rem_euclid(1.0) - 0.5;
            assert!(turned.abs() < 0.01, "{ms} ms: phase {} → {}", last.phase, now.phase);
            if (8000..9000).contains(&ms) {
                held.push(now.level);
            }
            last = now;
        }
        assert!(held.iter().all(|l| (l - held[0]).abs() < 1e-4), "a held breath stays");
    }

    #[test]
    fn a_late_message_changes_nothing_before_its_time() {
        let mut ahead = Live::new(Synthetic::new(&BreathStatistics::default(), 2));
        let behind = ahead.clone();
        ahead.command(500 * MS, 0.0, Some(0.7));
        assert!((0..500).all(|ms| ahead.at(ms * MS) == behind.at(ms * MS)));
        assert_eq!(ahead.at(500 * MS).level, behind.at(500 * MS).level);
        // the slider wins in the end
        assert!((ahead.at(9000 * MS).level - 0.7).abs() < 1e-6);
    }
}
