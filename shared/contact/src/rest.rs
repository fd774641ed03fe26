//! A tip at rest, and what it is allowed at its port so that a force is held for as long as the hand stays.
//!
//! A wall that is sampled, late and read in steps gives out energy for ever, though the hand never feels it: under a tremor of speed v some
//! K (T/2 + t_d) v², which the device's own damping b takes as long as b > K (T/2 + t_d) [Colgate & Schenkel 1997]; and in the limit cycle of
//! the quantisation, whose amplitude an encoder step bounds [Diolaiti et al. 2006; Abbott & Okamura 2005], a relay's power, below b (ω Δ)². A balance that
//! is charged for either runs dry within a minute or two, and a resting tool sinks. So, while the readings of an eighth to a quarter of a second lie
//! within [`REST_MM`] of each other, the balance is given
//!
//! - 1.25 b v², v from the longest window and at most [`TREMOR_MM_S`];
//! - while they lie within [`CHATTER_STEPS`] steps: what the balance lost, beyond the elastic energy, since that began, at most b (ω Δ)².
//!
//! Faster motion, and a buzz that grows beyond a step, are charged as ever: in taps nothing is allowed. A balance that is overdrawn is given at most
//! [`RETURN_MJ_S`]: a force that was lowered comes back by `restore`. Nothing is allowed on a device whose damping is not known.
//!
//! Units: mm, s, mJ = N·mm, N·s/mm. Cost: constant. Allocation: none. Not here: the balance (`passivity`).

use crate::V3;

/// Range of the readings of a tip that rests [mm].
pub(crate) const REST_MM: f64 = 0.3;
/// Ticks of a block of readings.
const BLOCK: usize = 128;
/// Fastest tremor that is counted [mm/s]: 0.13 mm at 10 Hz.
const TREMOR_MM_S: f64 = 8.0;
/// Part of the device's damping that is counted: a window's velocity is below the true one, and the observer's doubt grows.
const MARGIN: f64 = 1.25;
/// Range of the readings, in encoder steps, of a tip that does no more than chatter.
const CHATTER_STEPS: f64 = 2.0;
/// Angular frequency of the fastest chatter that is allowed [1/s]: 25 Hz.
const CHATTER_PER_S: f64 = 157.0;
/// Rate at which an overdrawn balance is levelled [mJ/s].
const RETURN_MJ_S: f64 = 0.05;

/// What the balance is while the tip rests.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Balance {
    /// stored for certain [mJ]
    pub certain_mj: f64,
    /// of it in the contact's springs [mJ]
    pub elastic_mj: f64,
    /// the device's own damping [N·s/mm]
    pub damping_n_s_per_mm: f64,
    /// encoder step [mm]
    pub quantum_mm: f64,
    /// speed of the tip over the longest window [mm/s]
    pub speed_mm_s: f64,
}

/// The last readings' boxes, of this block of ticks and of the one before, and what is held meanwhile.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Rest {
    now: Option<(V3, V3)>,
    before: Option<(V3, V3)>,
    ticks: usize,
    range_mm: f64,
    /// balance beyond the elastic energy when the chatter began [mJ]
    held_mj: Option<f64>,
}

impl Rest {
    pub fn new() -> Self {
        Self { now: None, before: None, ticks: 0, range_mm: f64::INFINITY, held_mj: None }
    }

    /// Takes a reading.
    pub fn push(&mut self, position: V3) {
        if self.ticks == BLOCK {
            (self.before, self.now, self.ticks) = (self.now, None, 0);
        }
        self.ticks += 1;
        let (low, high) = self.now.map_or((position, position), |(low, high)| (low.inf(&position), high.sup(&position)));
        self.now = Some((low, high));
        self.range_mm = self.before.map_or(f64::INFINITY, |before| (high.sup(&before.1) - low.inf(&before.0)).max());
        if !self.is_still() {
            self.held_mj = None;
        }
    }

    /// Whether the tip rests.
    pub fn is_still(&self) -> bool {
        self.range_mm <= REST_MM
    }

    /// What the balance is given for the last `dt_s` [mJ].
    pub fn allowed(&mut self, is: &Balance, dt_s: f64) -> f64 {
        if !self.is_still() || is.damping_n_s_per_mm <= 0.0 {
            return 0.0;
        }
        let mut allowed = MARGIN * is.damping_n_s_per_mm * is.speed_mm_s.min(TREMOR_MM_S).powi(2) * dt_s;
        let overdrawn = is.certain_mj < 0.0;
        if self.range_mm <= (CHATTER_STEPS + 0.01) * is.quantum_mm {
            let over = is.certain_mj - is.elastic_mj;
            let held = self.held_mj.get_or_insert(over);
            if overdrawn {
                *held += RETURN_MJ_S * dt_s;
            }
            let most = is.damping_n_s_per_mm * (CHATTER_PER_S * is.quantum_mm).powi(2) * dt_s;
            allowed = allowed.max((*held - over).clamp(0.0, most));
        } else {
            self.held_mj = None;
        }
        if overdrawn { allowed.min(RETURN_MJ_S * dt_s) } else { allowed }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const AT_REST: Balance = Balance { certain_mj: 2.0, elastic_mj: 1.0, damping_n_s_per_mm: 0.003, quantum_mm: 0.05, speed_mm_s: 0.0 };

    fn at(x: f64) -> V3 {
        V3::new(1.0, x, -3.0)
    }

    #[test]
    fn a_tip_rests_after_a_block_and_a_move_is_remembered_for_one() {
        let mut rest = Rest::new();
        for n in 0..1000 {
            rest.push(at(if n % 2 == 0 { 0.05 } else { 0.1 }));
            assert_eq!(rest.is_still(), n >= BLOCK, "{n}");
        }
        rest.push(at(2.0));
        for n in 0..2 * BLOCK {
            rest.push(at(0.1));
            assert!(!rest.is_still() || n >= BLOCK, "{n}");
        }
        assert!(rest.is_still());
    }

    #[test]
    fn nothing_is_allowed_in_motion_nor_without_a_known_damping_and_chatter_gives_back_no_more_than_was_lost() {
        let mut rest = Rest::new();
        let mut given = 0.0;
        for n in 0..1000 {
            rest.push(at(f64::from(n) * 0.01));
            given += rest.allowed(&Balance { speed_mm_s: 10.0, ..AT_REST }, 1e-3);
        }
        assert_eq!(given, 0.0, "at 10 mm/s");
        let mut rest = Rest::new();
        let mut certain_mj = 2.0;
        for n in 0..20_000 {
            rest.push(at(if n % 40 < 20 { 0.05 } else { 0.1 }));
            assert_eq!(rest.allowed(&Balance { damping_n_s_per_mm: 0.0, ..AT_REST }, 1e-3), 0.0);
            // a leak of 0.05 mJ/s
            certain_mj += rest.allowed(&Balance { certain_mj, ..AT_REST }, 1e-3) - 5e-5;
            assert!((1.98..=2.0).contains(&certain_mj), "{n}: {certain_mj}");
        }
        // one of 10 mJ/s, of an active wall, is not made good
        for _ in 0..5_000 {
            rest.push(at(0.05));
            certain_mj += rest.allowed(&Balance { certain_mj, ..AT_REST }, 1e-3) - 1e-2;
        }
        assert!(certain_mj < -40.0, "{certain_mj}");
    }
}
