//! Passivity observer and controller on the device port.
//!
//! **Observer.** E = −Σ F_k·(x_{k+1} − x_k), the energy [mJ = N·mm] that went from the hand into the virtual side; exact for a force held
//! between ticks [Hannaford & Ryu 2002]. The positions seen are late by d ticks, so each is paired with the force of its own interval, and
//! rounded, q = x − e with |e| ≤ Δ/2 by axis. Summed by parts,
//!
//! E = −Σ F_k·(q_{k+1} − q_k) + Σ (F_k − F_{k−1})·e_k − F_{n−1}·e_n ,
//!
//! where e is known to ±Δ/2 only, and better after a step of one Δ: the border between both readings has then just been crossed, and dead
//! reckoning goes on from there. The middle term is taken at the best guess of e, less a doubt: the least of all the largest errors, and four standard
//! deviations plus three tenths of all the largest errors (rounding in a repeated motion may repeat). So rounding does not pass for stored
//! energy: measured, the observer is hardly ever over the truth by more than 0.05 mJ, and never by 0.1 mJ (`tests/passivity.rs`).
//!
//! **Controller.** The force is held for a tick, and d ticks of motion are not seen yet. What F_{n−d} … F_n may give out until t_{n+1} is
//! foreseen with the least mass m of device and hand: the velocity (`velocity`, and half of its largest error) goes on, quickened by the
//! forces themselves over m and by the hand. F_n = λ F_wanted with the largest λ ≤ 1 for which this does not exceed what is stored
//! [the force is bounded by energy beforehand, as in Kim & Ryu's energy-bounding algorithm; here against the observed balance, without counting on the
//! device's own damping]. A force that only takes energy is not lowered, and F_n = 0 is always open. Slow leaks, of a tool that rests, are
//! made good by Hannaford and Ryu's damper, −α v with α rising to α_max as the balance falls.
//! Without Coulomb friction of K·Δ/2 in the device a light hand that rests on a stiff wall keeps a limit cycle alive [Abbott & Okamura 2005]; the
//! controller then lets the wall give way rather than feed it, unless the device's own damping is known: then a tip at rest is allowed what that
//! damping takes, and a chatter of an encoder step (`rest`). Where taps, a fast landing or a fade have left the balance overdrawn under a tip that now
//! rests, the force comes back by a slow rise whose work is granted within a purse (`restore`): the two are what a resting hand may get beyond
//! the millijoule that holds for taps.
//!
//! **Reference.** What counts as stored is at most the elastic energy that the contact reports plus a reserve, so an hour of dissipation
//! does not license minutes of buzzing [a bounded reference for the energy: Ryu et al. 2005]. Work done by tissue that moves by itself is granted
//! within a credit (`grant`).
//!
//! **Slow devices.** A device that is read and given its command every h ticks holds that command for h: a new reading's way is paired with the command
//! that stood when the reading before it was taken, readings that are seen again say nothing, and what is foreseen is h ticks long
//! ([`Passivity::seen`]). A pace that changes while a force is given is believed little by little: what is foreseen of a device that answers late for some exchanges must not let go
//! of a tip that rests, and what it really gives out meanwhile is seen in the balance.
//!
//! **Torque** does its work on the turns, paired and foreseen alike (with an inertia of that mass at [`GYRATION_MM`] from the handle), and is lowered
//! by the same λ: one balance for both.
//!
//! Units: mm, N, N·mm, rad, s, kg. Cost: proportional to the delay in ticks, at most 31. Allocation: none. Not here: choosing gains that
//! need no controller (`coupling`).

use crate::{
    V3,
    rest::{Balance, Rest},
    restore::{Restore, Standing},
    velocity::{Estimate, Velocity, WINDOW},
};

/// Most ticks a pose can be late.
pub const MAX_DELAY: usize = 32;
/// Energy the port may give out in advance [mJ]: half of what it shall never exceed.
const ADVANCE_MJ: f64 = 0.5;

/// Part of the largest errors of velocity and acceleration that counts when energy is foreseen: what comes out worse is seen in the balance
/// at the next tick.
const SLACK: f64 = 0.5;
/// Part of the sum of the largest rounding errors that counts as doubt.
const DOUBT: f64 = 0.3;
/// Most work of moving tissue that may be out [mJ]: 1 N over a breath of 10 mm.
const CREDIT_MJ: f64 = 10.0;
/// Ticks after which a force that was lowered counts as steady.
const LOWERED_TICKS: usize = 256;
/// Radius of gyration of device and hand about the handle [mm], at least.
const GYRATION_MM: f64 = 30.0;
/// Largest change of the damper's force [N/s].
const DAMPER_N_PER_S: f64 = 20.0;
/// How quickly a slower pace is believed [ticks a tick]: a force that it does away with falls by 1/30 of itself a tick, 0.1 N of 3 N.
const SLOWER: f64 = 1.0 / 30.0;
/// The same for a quicker one.
const QUICKER: f64 = 0.1;
/// Time in which a lowered force comes back [s].
const SHARE_S: f64 = 0.02;

/// What the controller knows of the device's port.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Port {
    /// how late poses are [ticks], at most 31
    pub delay_ticks: usize,
    /// encoder step at the tip [mm]
    pub quantum_mm: f64,
    /// least mass at the tip, device and hand [kg]
    pub mass_kg: f64,
    /// largest acceleration that the hand adds [mm/s²]
    pub hand_mm_s2: f64,
    /// the device's own damping [N·s/mm]; 0 where nothing is known of it: then a hand at rest is allowed nothing
    pub damping_n_s_per_mm: f64,
    /// time from tick to tick, as planned [s]: how long a force is held, however late the last tick was
    pub period_s: f64,
}

impl Default for Port {
    /// Poses at once and exact; a light desktop device.
    fn default() -> Self {
        Self { delay_ticks: 0, quantum_mm: 0.0, mass_kg: 0.05, hand_mm_s2: 10_000.0, damping_n_s_per_mm: 0.0, period_s: 1e-3 }
    }
}

/// Observer and controller of one port.
#[derive(Clone, Copy, Debug)]
pub struct Passivity {
    port: Port,
    /// lower bound of E [mJ]
    energy_mj: f64,
    last_position: Option<V3>,
    /// e at the last position, by axis, and how far it may be from that [mm]
    rounding: [(f64, f64); 3],
    velocity: Velocity,
    /// forces given, by tick modulo the length [N]
    given: [V3; MAX_DELAY + 2],
    /// torques given, alike [N·mm]
    given_n_mm: [V3; MAX_DELAY + 2],
    /// last turn seen [rad/s]
    spin: V3,
    /// turns under torque so far, as way at [`GYRATION_MM`] [mm]: a tip that stays while the hand turns does not rest
    swung_mm: V3,
    ticks: usize,
    reserve_mj: f64,
    max_damping_n_s_per_mm: f64,
    /// the damper's force [N]
    damper: V3,
    dissipated_mj: f64,
    lowered: u64,
    /// λ of the last tick
    share: f64,
    /// work of tissue granted and not given back [mJ]
    credit_mj: f64,
    /// sum of the largest errors of E by rounding [mJ]
    doubt_mj: f64,
    /// sum of their variances [mJ²]
    doubt_squared: f64,
    rest: Rest,
    restore: Restore,
    /// ticks since the force was lowered
    since_lowered: usize,
    /// age of the last reading [s]
    age_s: f64,
    /// time [s] and ticks since the last new reading
    unread_s: f64,
    unread: usize,
    /// ticks between the last new readings
    paces: [usize; 3],
    /// ticks from one reading to the next, as far as that is believed
    pace: f64,
    /// the reading is a new one
    fresh: bool,
}

impl Passivity {
    /// `reserve_mj`: most energy beyond the elastic one that counts as stored [mJ]; `max_damping_n_s_per_mm`: α_max, which must keep the
    /// coupling's bound; `delay_ticks`: how late poses are, at most 31.
    pub fn new(reserve_mj: f64, max_damping_n_s_per_mm: f64, delay_ticks: usize) -> Self {
        Self::on_port(reserve_mj, max_damping_n_s_per_mm, Port { delay_ticks, ..Port::default() })
    }

    /// The same for a port of which more is known. Numbers out of range are held in range.
    pub fn on_port(reserve_mj: f64, max_damping_n_s_per_mm: f64, port: Port) -> Self {
        let hold = |v: f64, low: f64, high: f64, other: f64| if v.is_finite() { v.clamp(low, high) } else { other };
        let port = Port {
            delay_ticks: port.delay_ticks.min(MAX_DELAY - 1),
            quantum_mm: hold(port.quantum_mm, 0.0, 1.0, 0.0),
            mass_kg: hold(port.mass_kg, 0.01, 10.0, 0.05),
            hand_mm_s2: hold(port.hand_mm_s2, 0.0, 1e6, 1e4),
            damping_n_s_per_mm: hold(port.damping_n_s_per_mm, 0.0, 1.0, 0.0),
            period_s: hold(port.period_s, 1e-5, 0.1, 1e-3),
        };
        Self {
            port,
            energy_mj: 0.0,
            last_position: None,
            rounding: [(0.0, 0.0); 3],
            velocity: Velocity::new(),
            given: [V3::zeros(); MAX_DELAY + 2],
            given_n_mm: [V3::zeros(); MAX_DELAY + 2],
            spin: V3::zeros(),
            swung_mm: V3::zeros(),
            ticks: 0,
            reserve_mj: hold(reserve_mj, 0.0, 1e3, 0.0),
            // a damper that acts late feeds what it should brake: tolerable are gains far below m / t_d
            max_damping_n_s_per_mm: max_damping_n_s_per_mm.clamp(0.0, 0.3 * port.mass_kg / (port.delay_ticks as f64 + 0.5)),
            damper: V3::zeros(),
            dissipated_mj: 0.0,
            lowered: 0,
            share: 1.0,
            credit_mj: 0.0,
            doubt_mj: 0.0,
            doubt_squared: 0.0,
            rest: Rest::new(),
            restore: Restore::new(),
            since_lowered: usize::MAX,
            age_s: 0.0,
            unread_s: port.period_s,
            unread: 1,
            paces: [1; 3],
            pace: 1.0,
            fresh: true,
        }
    }

    /// Energy the virtual side holds at least [mJ]; negative when it may have given out more than it got.
    pub fn energy_mj(&self) -> f64 {
        self.certain_mj()
    }

    /// E less what rounding may have added.
    fn certain_mj(&self) -> f64 {
        self.energy_mj - self.doubt_mj.min(4.0 * self.doubt_squared.sqrt() + DOUBT * self.doubt_mj)
    }

    /// Energy that the controller has asked its damper to take, so far [mJ].
    pub fn dissipated_mj(&self) -> f64 {
        self.dissipated_mj
    }

    /// Ticks whose force was lowered.
    pub fn lowered(&self) -> u64 {
        self.lowered
    }

    /// Forgets motion, keeps the balance; after a jump that was no motion.
    pub fn forget_motion(&mut self) {
        self.last_position = None;
        self.velocity.reset();
        self.rest = Rest::new();
        self.spin = V3::zeros();
    }

    /// Work [mJ] that tissue does on the hand by moving: it may be given out, on credit of [`CREDIT_MJ`] that what the hand gives back
    /// later restores. So breathing tissue is felt, and tissue that is moved to and fro in the wrong moments cannot pump.
    pub fn grant(&mut self, work_mj: f64) {
        let work = work_mj.min(CREDIT_MJ - self.credit_mj);
        if work > 0.0 {
            self.credit_mj += work;
            self.energy_mj += work;
        }
    }

    /// λ of the last tick: what else is given to the device shall be lowered alike.
    pub(crate) fn share(&self) -> f64 {
        self.share
    }

    /// The pose is `age_s` old, `dt_s` after the last tick: to be told before what is seen of it.
    pub(crate) fn seen(&mut self, age_s: f64, dt_s: f64) {
        if self.fresh {
            (self.unread, self.unread_s) = (0, 0.0);
        }
        (self.unread, self.unread_s) = ((self.unread + 1).min(MAX_DELAY), self.unread_s + dt_s);
        // the same reading is older by the time that went by
        self.fresh = age_s < self.age_s + 0.5 * dt_s;
        self.age_s = age_s;
        // a longer silence is a device that was away, not its pace
        if self.fresh && self.unread < MAX_DELAY {
            self.paces = [self.paces[1], self.paces[2], self.unread];
        }
        // the median of three, as one late exchange is no slow device
        let [a, b, c] = self.paces;
        let seen = a.max(b).min(a.min(b).max(c)).clamp(1, MAX_DELAY) as f64;
        // while nothing is given there is nothing to let go of
        let given = self.force_ago(0) != V3::zeros() || self.given_n_mm[self.ago(0)] != V3::zeros();
        self.pace = if given { self.pace + (seen - self.pace).clamp(-QUICKER, SLOWER) } else { seen };
    }

    /// How many ticks ago the command was given that stood over the way that a new reading ends.
    fn stood(&self) -> usize {
        (self.port.delay_ticks + self.unread.max(1) - 1).min(MAX_DELAY)
    }

    /// The device is seen turned by `turn` [rad] since the last tick.
    pub(crate) fn turned(&mut self, turn: V3) {
        let torque = self.given_n_mm[self.ago(self.stood())];
        self.energy_mj -= torque.dot(&turn);
        if torque != V3::zeros() {
            self.swung_mm += turn * GYRATION_MM;
        }
        if self.fresh {
            self.spin = turn / self.unread_s.max(self.port.period_s);
        }
    }

    /// Where stands what was given `ago` ticks before the last.
    fn ago(&self, ago: usize) -> usize {
        let length = self.given.len();
        (self.ticks + 2 * length - 1 - ago) % length
    }

    /// The force given `ago` ticks before the last.
    fn force_ago(&self, ago: usize) -> V3 {
        self.given[self.ago(ago)]
    }

    /// The force to give in place of `wanted`, with the device seen at `position` after `dt_s`, when the contact's springs hold
    /// `elastic_mj`. `wanted_n_mm` is to be lowered by [`share`](Self::share).
    pub(crate) fn control(&mut self, position: V3, wanted: V3, wanted_n_mm: V3, elastic_mj: f64, dt_s: f64) -> V3 {
        let per_mass = 1000.0 / self.port.mass_kg;
        let last = self.force_ago(self.pending(self.pace.ceil() as usize));
        // what lies ahead is a tick as planned: a late one is no reason to fear that the next will be as late, and to let go for that
        let ahead_s = self.port.period_s;
        if self.fresh {
            self.follow(position, self.unread_s);
        }
        let estimate = self.velocity.estimate(self.port.quantum_mm, ahead_s, self.port.hand_mm_s2 + per_mass * last.norm());
        let speed_mm_s = estimate.smooth.norm();
        if self.fresh {
            self.observe(position, &estimate, self.unread_s);
        }
        self.rest.push(position + self.swung_mm);
        if self.rest.is_still() {
            let port = &self.port;
            let (damping_n_s_per_mm, quantum_mm, certain_mj) = (port.damping_n_s_per_mm, port.quantum_mm, self.certain_mj());
            let balance = Balance { certain_mj, elastic_mj, damping_n_s_per_mm, quantum_mm, speed_mm_s };
            self.energy_mj += self.rest.allowed(&balance, dt_s);
        }
        let (wanted, ceiling) = self.restored(wanted, speed_mm_s, dt_s);
        // what is beyond the reference is forgotten
        let surplus = self.certain_mj() - (elastic_mj + self.reserve_mj);
        if surplus > 0.0 {
            self.energy_mj -= surplus;
            self.credit_mj = (self.credit_mj - surplus).max(0.0);
        }
        let deficit = (-2.0 * self.certain_mj() / ADVANCE_MJ).clamp(0.0, 1.0);
        // at most as large as the force itself: touching is no step, and tissue never pulls
        let alpha = (deficit * self.max_damping_n_s_per_mm).min(if speed_mm_s > 0.0 { wanted.norm() / speed_mm_s } else { 0.0 });
        // and it comes and goes gently: a balance that is overdrawn in one tick and not in the next is none that a hand should feel
        let change = -estimate.smooth * alpha - self.damper;
        let most = DAMPER_N_PER_S * self.port.period_s;
        self.damper += change * (most / change.norm().max(most));
        self.damper *= (wanted.norm() / self.damper.norm().max(f64::MIN_POSITIVE)).min(1.0);
        self.dissipated_mj -= self.damper.dot(&estimate.smooth) * dt_s;
        let force = wanted + self.damper;
        let ahead = Ahead { estimate, force, torque: wanted_n_mm, last };
        let (pace, part) = (self.pace.floor() as usize, self.pace.fract());
        let between = |pace: usize, part: f64| if part > 0.0 { part * self.foreseen(&ahead, pace) } else { 0.0 };
        let share = ceiling * (between(pace, 1.0 - part) + between(pace + 1, part));
        // a force once lowered comes back slowly: one that flickers between both would lose each flicker's rounding
        self.share = share.min(if wanted.norm_squared() > 0.0 { self.share + self.port.period_s / SHARE_S } else { 1.0 });
        self.lowered += u64::from(self.share < 1.0);
        self.since_lowered = if self.share < 1.0 { 0 } else { self.since_lowered.saturating_add(1) };
        if ceiling > 0.0 { force * (self.share / ceiling) } else { V3::zeros() }
    }

    /// Ticks whose forces may have acted since the position that is seen.
    fn pending(&self, pace: usize) -> usize {
        (self.port.delay_ticks + pace - 1).min(MAX_DELAY)
    }

    /// The largest λ for which what is foreseen of a device of a pace [ticks] does not exceed what is stored.
    fn foreseen(&self, ahead: &Ahead, pace: usize) -> f64 {
        let Ahead { estimate, force, torque: wanted_n_mm, last } = ahead;
        let (per_mass, ahead_s) = (1000.0 / self.port.mass_kg, self.port.period_s);
        // what the pending forces may have given out since the position that is seen
        let mut stored = self.certain_mj() + ADVANCE_MJ - 0.5 * self.port.quantum_mm * one_norm(last);
        let (mut velocity, mut slack) = (estimate.velocity, SLACK * estimate.error);
        let (mut spin, per_inertia) = (self.spin, per_mass / (GYRATION_MM * GYRATION_MM));
        for ago in (0..self.pending(pace)).rev() {
            let torque = self.given_n_mm[self.ago(ago)];
            let spun = torque * (per_inertia * ahead_s);
            stored -= torque.dot(&(spin + spun * 0.5)) * ahead_s;
            spin += spun;
            let force = self.force_ago(ago);
            let quickened = force * (per_mass * ahead_s);
            slack += SLACK * self.port.hand_mm_s2 * ahead_s;
            stored -= (force.dot(&(velocity + quickened * 0.5)) + force.norm() * slack) * ahead_s;
            velocity += quickened;
        }
        // the command stands until the next exchange
        let ahead_s = ahead_s * pace as f64;
        slack += SLACK * self.port.hand_mm_s2 * ahead_s;
        let out = (force.dot(&velocity) + force.norm() * slack + wanted_n_mm.dot(&spin)) * ahead_s;
        let quickening = 0.5 * (per_mass * force.norm_squared() + per_inertia * wanted_n_mm.norm_squared()) * ahead_s * ahead_s;
        largest_share(quickening, out, stored.max(0.0))
    }

    /// Takes the position into the estimate of the velocity, whose windows are of ticks as planned: the ticks missed before a late one are
    /// filled by a straight line.
    fn follow(&mut self, position: V3, dt_s: f64) {
        let ticks = (dt_s / self.port.period_s).round().clamp(1.0, WINDOW as f64) as usize;
        let from = self.last_position.unwrap_or(position);
        for n in 1..=ticks {
            self.velocity.push(from + (position - from) * (n as f64 / ticks as f64));
        }
    }

    /// What of the force there may be while it is on its way back (`restore`), and as a share.
    fn restored(&mut self, wanted: V3, speed_mm_s: f64, dt_s: f64) -> (V3, f64) {
        let given_n = self.force_ago(0).norm();
        // as the controller foresees it: nothing but the mass holds against the force
        let unseen_n_s = given_n * self.port.delay_ticks as f64 * self.port.period_s;
        let standing = Standing {
            still: self.rest.is_still() && self.given_n_mm[self.ago(0)] == V3::zeros() && self.port.damping_n_s_per_mm > 0.0,
            certain_mj: self.certain_mj(),
            pending_mj: 500.0 / self.port.mass_kg * unseen_n_s * unseen_n_s,
            share: self.share,
            given_n,
            wanted_n: wanted.norm(),
            speed_mm_s,
        };
        self.energy_mj += self.restore.granted(&standing, dt_s);
        match self.restore.ceiling_n() {
            Some(ceiling) if ceiling < standing.wanted_n => (wanted * (ceiling / standing.wanted_n), ceiling / standing.wanted_n),
            _ => (wanted, 1.0),
        }
    }

    /// Takes the work of the interval that the new position ends into the balance.
    fn observe(&mut self, position: V3, estimate: &Estimate, dt_s: f64) {
        let Some(last) = self.last_position.replace(position) else {
            self.rounding = [(0.0, 0.5 * self.port.quantum_mm); 3];
            return;
        };
        let moved = position - last;
        let stood = self.stood();
        let force = self.force_ago(stood);
        let change = force - self.force_ago((stood + self.paces[1]).min(MAX_DELAY + 1));
        self.energy_mj -= force.dot(&moved);
        let quantum = self.port.quantum_mm;
        if quantum > 0.0 {
            // a lowered force changes abruptly, and the tip with it: then, and in motion, only the shortest windows follow
            let quick = !self.rest.is_still() || self.since_lowered < LOWERED_TICKS;
            let way = if quick { estimate.velocity } else { estimate.smooth } * dt_s;
            for c in 0..3 {
                let (e, doubt) = self.rounding[c];
                self.energy_mj += change[c] * e;
                let doubt = change[c].abs() * doubt;
                self.doubt_mj += doubt;
                self.doubt_squared += doubt * doubt / 3.0;
                self.rounding[c] = rounding(self.rounding[c], moved[c] / quantum, way[c], quantum);
            }
        }
    }

    /// Tells the observer what the device was really given.
    pub(crate) fn given(&mut self, force: V3, torque_n_mm: V3) {
        let at = self.ticks % self.given.len();
        self.given[at] = force;
        self.given_n_mm[at] = torque_n_mm;
        self.ticks += 1;
    }
}

/// What the next force is foreseen from.
struct Ahead {
    estimate: Estimate,
    /// to be given [N], [N·mm]
    force: V3,
    torque: V3,
    /// that stood when the position that is seen was taken
    last: V3,
}

fn one_norm(v: &V3) -> f64 {
    v.iter().map(|c| c.abs()).sum()
}

/// Where in its encoder step the position is, as offset and doubt [mm], after the reading went on by `steps` and the tip by about `way`
/// [mm]. One step on: the border between both readings was just crossed; no step: dead reckoning from there.
fn rounding((e, doubt): (f64, f64), steps: f64, way: f64, quantum: f64) -> (f64, f64) {
    let half = 0.5 * quantum;
    let (e, doubt) = match steps.abs() {
        s if s < 0.5 => (e + way, doubt + 1.0 * way.abs() + 0.002 * quantum),
        s if s < 1.5 => ((0.5 * way.abs() - half) * steps.signum(), 0.5 * way.abs() + 0.01 * quantum),
        _ => (0.0, half),
    };
    let (low, high) = ((e - doubt).clamp(-half, half), (e + doubt).clamp(-half, half));
    (0.5 * (low + high), 0.5 * (high - low))
}

/// Largest λ in 0 … 1 with a λ² + b λ ≤ c, for a, c ≥ 0.
fn largest_share(a: f64, b: f64, c: f64) -> f64 {
    if a + b <= c {
        return 1.0;
    }
    let root = if a > 0.0 { (-b + (b * b + 4.0 * a * c).sqrt()) / (2.0 * a) } else { c / b };
    if root.is_finite() { root.clamp(0.0, 1.0) } else { 0.0 }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A mass without damping against a wall one and a half times stiffer than its own damping allows: energy grows without
    /// the controller and does not with it.
    #[test]
    fn the_controller_keeps_a_wall_from_giving_out_energy() {
        let run = |controlled: bool| {
            let (mass, b, k, dt) = (1e-4, 1e-4, 1.5, 1e-3); // kg/1000 so that N = mass · mm/s², N·s/mm, N/mm
            let mut p = Passivity::new(10.0, 9e-2, 0);
            let (mut x, mut v, mut out) = (1.0f64, -50.0f64, 0.0f64);
            let mut worst = 0.0f64;
            for _ in 0..5000 {
                let wanted = V3::new(0.0, 0.0, if x < 0.0 { -k * x } else { 0.0 });
                let f = if controlled {
                    p.control(V3::new(0.0, 0.0, x), wanted, V3::zeros(), 0.5 * k * x.min(0.0).powi(2), dt)
                } else {
                    wanted
                };
                p.given(f, V3::zeros());
                for _ in 0..20 {
                    let hand = -0.5; // a light push towards the wall
                    v += (f.z + hand - b * v) / mass * dt / 20.0;
                    let step = v * dt / 20.0;
                    out += f.z * step;
                    x += step;
                }
                worst = worst.max(out);
                if !x.is_finite() || x.abs() > 1e6 {
                    return f64::INFINITY;
                }
            }
            worst
        };
        let (free, held) = (run(false), run(true));
        assert!(free > 1.0, "without the controller the wall gives out energy: {free} mJ");
        assert!(held < 1.0, "with it, it does not: {held} mJ");
    }
}
