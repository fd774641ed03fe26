//! The way back of a force that the balance has cut, for a hand that has come to rest.
//!
//! Taps, a landing while the force still rises from zero, or a fade in contact leave the balance overdrawn and the tip sunk in: the spring was loaded
//! while little or no force was given, so no work went in, and to lift the hand to where wall and grip hold each other takes work that nobody paid.
//! Levelled by what the device's damping takes (`rest`), that would last minutes. So it is granted, as the work of tissue that moves is, by declaration:
//!
//! - the tip must have rested ([`RESTED_S`] more than `rest` needs), on a device whose damping is known, with its force lowered meanwhile;
//! - the force then rises from where it is by [`RISE_N_PER_S`], however deep the tip lies: below the wall's own force it is one that does not depend
//!   on motion, and so feeds no oscillation. Meanwhile the balance is kept at [`LEVEL_MJ`] and what poses not seen yet may cost;
//! - under a whole force at rest it is kept there too, by [`KEEP_MJ_S`] at most: a tip that has begun to sink sinks on;
//! - the rise ends when the wall's own force has come below it, and at once when the tip is faster than [`FASTEST_MM_S`] or sinks all the same;
//! - all grants come from a purse of [`PURSE_MJ`] that fills by [`REFILL_MJ_S`]: over t seconds no more than PURSE + REFILL·t, whatever the
//!   poses do, stale and good by turns too. While it is empty the force is held where it is;
//! - a return after which the force is lowered again (an active wall) doubles the pause before the next, from [`LEAST_PAUSE_S`] to
//!   [`MOST_PAUSE_S`]; two seconds at rest with the whole force forgive it.
//!
//! A proxy that began anew after each fade would need none of this, but leave the hand buried, without a wall to rest on.
//! The lift to a force F against a grip of k N/mm takes F²/2k: 3.4 mJ for 1.8 N and a full grip (0.5 N/mm), 5 mJ for 0.7 N and a light one (0.05).
//! Units: N, s, mm/s, mJ. Cost: constant. Allocation: none. Not here: the balance (`passivity`).

/// Rise of the force [N/s]: a light hand is lifted at 10 mm/s.
const RISE_N_PER_S: f64 = 0.5;
/// What the balance is kept at meanwhile [mJ]: a tremor's swing, with encoder and delay.
const LEVEL_MJ: f64 = 1.0;
/// Most that it is kept at, when poses are late [mJ].
const MOST_LEVEL_MJ: f64 = 3.0;
/// Faster than this the tip is not lifted but thrown, or buzzes [mm/s].
const FASTEST_MM_S: f64 = 40.0;
/// Most that is granted at once [mJ].
const PURSE_MJ: f64 = 12.0;
/// And again [mJ/s].
const REFILL_MJ_S: f64 = 0.1;
/// Pauses between returns that did not last [s].
const LEAST_PAUSE_S: f64 = 2.0;
/// See [`LEAST_PAUSE_S`].
const MOST_PAUSE_S: f64 = 64.0;
/// How long a tip must have counted as resting [s].
const RESTED_S: f64 = 0.4;
/// Rest with the whole force that forgives a pause [s].
const FORGIVE_S: f64 = 2.0;
/// Time constant of the means of force, share and speed [s].
const MEAN_S: f64 = 0.05;
/// Mean share below which a force counts as lowered. The limits before let a force that was cut rise by a tick's slew only, so the share is near one
/// however much was cut.
const LOWERED: f64 = 0.995;
/// Rate at which the balance under a whole force is kept up [mJ/s].
const KEEP_MJ_S: f64 = 0.2;
/// Time for which the wall's own force must stay below the ceiling [s].
const SETTLED_S: f64 = 0.1;

/// What a tick tells.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Standing {
    /// the tip rests, on a device of known damping
    pub still: bool,
    /// stored for certain [mJ]
    pub certain_mj: f64,
    /// what the force may have on its way, in poses not seen yet [mJ]
    pub pending_mj: f64,
    /// share of the force given at the last tick
    pub share: f64,
    /// force given at the last tick [N]
    pub given_n: f64,
    /// the wall's own force [N]
    pub wanted_n: f64,
    /// [mm/s]
    pub speed_mm_s: f64,
}

/// Whether the force is on its way back, and what that may cost.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Restore {
    ceiling_n: Option<f64>,
    purse_mj: f64,
    share: f64,
    given_n: f64,
    speed_mm_s: f64,
    /// time until the next return may begin [s]
    wait_s: f64,
    pause_s: f64,
    /// since when the tip rests [s]
    rested_s: f64,
    /// since when the tip rests with the whole force [s]
    whole_s: f64,
    settled_s: f64,
}

impl Restore {
    pub fn new() -> Self {
        Self {
            ceiling_n: None,
            purse_mj: PURSE_MJ,
            share: 1.0,
            given_n: 0.0,
            speed_mm_s: 0.0,
            wait_s: 0.0,
            pause_s: 0.0,
            rested_s: 0.0,
            whole_s: 0.0,
            settled_s: 0.0,
        }
    }

    /// Largest force for now [N], while it is on its way back.
    pub fn ceiling_n(&self) -> Option<f64> {
        self.ceiling_n
    }

    /// What the balance is given for the last `dt_s` [mJ].
    pub fn granted(&mut self, is: &Standing, dt_s: f64) -> f64 {
        let part = dt_s / (dt_s + MEAN_S);
        self.share += (is.share - self.share) * part;
        self.given_n += (is.given_n - self.given_n) * part;
        self.speed_mm_s += (is.speed_mm_s - self.speed_mm_s) * part;
        self.purse_mj = (self.purse_mj + REFILL_MJ_S * dt_s).min(PURSE_MJ);
        self.wait_s = (self.wait_s - dt_s).max(0.0);
        self.rested_s = if is.still { self.rested_s + dt_s } else { 0.0 };
        self.whole_s = if is.still && is.share >= 1.0 && is.wanted_n > 0.0 { self.whole_s + dt_s } else { 0.0 };
        if self.whole_s > FORGIVE_S {
            self.pause_s = 0.0;
        }
        let level_mj = (LEVEL_MJ + is.pending_mj).min(MOST_LEVEL_MJ);
        let Some(ceiling_n) = self.ceiling_n.as_mut() else {
            // a lift that runs out of its purse half way would only let the hand sink again
            let lowered = self.share < LOWERED && is.wanted_n > self.given_n;
            if self.rested_s > RESTED_S && lowered && self.wait_s == 0.0 && self.purse_mj > 0.5 * PURSE_MJ {
                self.pause_s = (2.0 * self.pause_s).clamp(LEAST_PAUSE_S, MOST_PAUSE_S);
                (self.ceiling_n, self.settled_s) = (Some(self.given_n), 0.0);
            }
            // before the force must be lowered: what sinks goes on sinking
            let keep = self.rested_s > RESTED_S && self.share >= LOWERED && is.wanted_n > 0.0 && self.purse_mj > 0.25 * PURSE_MJ;
            let grant = if keep { (level_mj - is.certain_mj).clamp(0.0, KEEP_MJ_S * dt_s) } else { 0.0 };
            self.purse_mj -= grant;
            return grant;
        };
        // an empty purse: the force is held, and rises as the purse fills
        *ceiling_n += if self.purse_mj > 0.0 { RISE_N_PER_S * dt_s } else { 0.0 };
        let lost = self.given_n < 0.5 * *ceiling_n && is.wanted_n > *ceiling_n && *ceiling_n > 0.1;
        let below = is.wanted_n <= *ceiling_n;
        self.settled_s = if below { self.settled_s + dt_s } else { 0.0 };
        let grant = if below { 0.0 } else { (level_mj - is.certain_mj).clamp(0.0, self.purse_mj) };
        self.purse_mj -= grant;
        if self.settled_s > SETTLED_S || self.speed_mm_s > FASTEST_MM_S || lost {
            (self.ceiling_n, self.wait_s) = (None, self.pause_s);
        }
        grant
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const LOWERED_AT_REST: Standing =
        Standing { still: true, certain_mj: -0.5, pending_mj: 0.0, share: 0.1, given_n: 0.1, wanted_n: 1.0, speed_mm_s: 0.0 };

    #[test]
    fn the_force_rises_evenly_from_where_it_is_and_the_ceiling_ends_when_the_wall_is_below_it() {
        let mut restore = Restore::new();
        let mut last = None::<f64>;
        let mut ended = None;
        for n in 0..4000 {
            let given_n = restore.ceiling_n().unwrap_or(0.1);
            restore.granted(&Standing { certain_mj: 3.0, given_n, ..LOWERED_AT_REST }, 1e-3);
            match (last, restore.ceiling_n()) {
                (Some(a), Some(b)) => assert!((b - a - RISE_N_PER_S * 1e-3).abs() < 1e-12),
                (Some(_), None) => ended = ended.or(Some(n)),
                _ => {}
            }
            last = restore.ceiling_n();
            if ended.is_some() {
                break;
            }
        }
        assert!(ended.is_some_and(|n| (1500..2500).contains(&n)), "{ended:?}");
    }

    #[test]
    fn grants_are_bounded_by_purse_and_refill_whatever_happens_and_none_is_given_in_motion() {
        let (mut restore, mut moving) = (Restore::new(), Restore::new());
        let (mut given, mut seconds) = (0.0, 0.0);
        for n in 0..200_000 {
            // whatever is granted is lost at once; the tip rests and is thrown by turns
            let speed_mm_s = if n % 1400 < 300 { 100.0 } else { 0.0 };
            let given_n = restore.ceiling_n().unwrap_or(0.1).min(0.9);
            let is = Standing { speed_mm_s, given_n, still: n % 1400 > 400, certain_mj: -1e3, ..LOWERED_AT_REST };
            given += restore.granted(&is, 1e-3);
            seconds += 1e-3;
            assert!(given <= PURSE_MJ + REFILL_MJ_S * seconds + 1e-9);
            assert_eq!(moving.granted(&Standing { still: false, ..is }, 1e-3), 0.0);
        }
        assert!(given > PURSE_MJ, "{given}");
    }
}
