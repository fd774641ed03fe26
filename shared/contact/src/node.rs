//! One contact node: a ball of the tool, its proxy, and what the tissue under it has done since they met.
//!
//! **Indentation and give-way.** With d the ball's penetration into the tissue *as committed now*, and m the way that tissue under it
//! has given way since the contact began, the indentation is δ = max(0, d + m) and the normal force f(δ) of `material`.
//! A commit that moves the surface away by Δ lowers d by Δ and raises m by Δ: δ, force and stored energy stay as they were, whatever
//! the rate of commits. So tissue resists by how far it was pushed from where the ball first met it. Withdrawn, the ball leaves a dent: with
//! a gap g between ball and tissue, m fades by exp(−Δg / 1.5 mm) while g grows, so the force ends near the dent that is seen
//! (a dent that springs back in further commits instead lowers m and raises d, and is felt as elastic). Sliding along the
//! surface by t (the ball's own way: its foot may leap) lets m fade by exp(−t/(2r)): elsewhere nothing was pushed yet. A gap above 0.3 mm, which no push leaves, lets m fall by itself: tissue
//! that went away (exhaling) is let go within some 0.1 s. At δ = 0 the contact ends and m is forgotten. What is no
//! pushing is carried in a second term β that goes to 0 within 0.1 s, δ = max(0, d + m + β): a
//! surface that comes towards the ball (relaxing or breathing tissue) beyond where it was met, a new threshold, a foot that
//! jumps to a nearer wall. So all of these are felt, and none as a step. Of β the part that leaps of the foot made is kept apart, λ: no tissue moved there.
//!
//! Energy: along the normal the tissue is a spring in δ; a commit leaves δ unchanged; fading m > 0 only lowers the stored
//! energy. So neither commits nor sliding can feed the hand; β can, as tissue that moves by itself does, by a bounded amount, which is told
//! ([`Felt::granted_mj`]). What λ gives is nobody's work: it is not told, and the passivity controller takes it.
//!
//! **Blend.** What remains of a discontinuity (normal and tangential direction at a commit, a foot that jumps to another wall, a new
//! threshold) is bridged: the difference to the last force is added and taken away linearly within `blend_s`. Where the normal turns by more than
//! [`MAX_TURN`] in a tick (the foot leaps from side to side of a dent as narrow as the ball), what that alone changes is bridged likewise.
//! Units: mm, N, s. Cost: `proxy`'s. Allocation: none.

use crate::{
    V3,
    friction::Friction,
    material::Material,
    proxy::{Contact, Proxy, Touch},
    shape::ContactNode,
    surface::Surface,
    tick::HapticConfig,
};

/// Time constant in which a move of the surface that the tool did not cause comes to be felt [s].
const BIAS_S: f64 = 0.1;
/// Growth of the gap over which a give-way is forgotten [mm].
const GAP_MM: f64 = 1.5;
/// Gap that resampling may leave below a tip that pushed the tissue [mm]: beyond it the tissue went away by itself.
const OWN_GAP_MM: f64 = 0.3;
/// Time constant of the material under the tip [s]: a tip that slides from mucosa to bone feels no step.
const MATERIAL_S: f64 = 0.025;
/// Largest change of a force by that alone, as a part of it or of [`MATERIAL_FORCE_N`] [1/s]: 3 % a tick.
const MATERIAL_PER_S: f64 = 30.0;
const MATERIAL_FORCE_N: f64 = 0.5;
/// Depth over which damping sets in [mm], so that touching is no step.
const DAMPING_DEPTH_MM: f64 = 0.5;
/// The material is read this far below the surface [mm]: at the surface itself every tissue has the threshold's value.
const MATERIAL_DEPTH_MM: f64 = 1.5;
/// Largest component of a force that is believed [N]: a hundred times what devices give.
const MAX_NODE_N: f64 = 1e3;
/// Turn of the normal in a tick that is felt as it is [rad].
const MAX_TURN: f64 = 0.02;
/// What the depth may change in a tick without the ball going there [mm], and as a part of the ball's way: beyond it the foot has leapt.
const LEAP_MM: f64 = 0.02;
const LEAP_SHARE: f64 = 0.2;
/// Largest give-way that is believed [mm].
const MAX_GIVE_WAY_MM: f64 = 60.0;

/// What all nodes of a tick have in common.
#[derive(Clone, Copy)]
pub(crate) struct Circumstances<'a> {
    pub config: &'a HapticConfig,
    /// time since the last tick [s]
    pub dt: f64,
    /// the tool jumped
    pub jumped: bool,
    /// a commit lies between the last tick and this one
    pub committed: bool,
    /// the threshold is another one
    pub other_surface: bool,
    /// value at the surface
    pub threshold: f64,
    /// largest damping of a law of share 1 [N·s/mm]
    pub damping_n_s_per_mm: f64,
}

/// What a node felt.
#[derive(Clone, Copy)]
pub(crate) struct Felt {
    /// on the hand [N]
    pub force: V3,
    /// where it acts [mm]
    pub at: V3,
    /// the contact and its indentation [mm], where there is one
    pub contact: Option<(Contact, f64)>,
    pub buried: bool,
    /// the surface went away inside tissue
    pub lost: bool,
    /// energy in its springs [mJ]
    pub elastic_mj: f64,
    /// work that tissue did by moving by itself [mJ]
    pub granted_mj: f64,
}

/// A difference being taken away.
#[derive(Clone, Copy, Debug)]
struct Bridge {
    /// at its beginning [N]
    difference: V3,
    /// how much is left, 1 → 0
    left: f64,
    /// from 1 to 0 [s]
    duration_s: f64,
}

/// State of one node between ticks.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Node {
    pub proxy: Proxy,
    share: f64,
    friction: Friction,
    /// m [mm]
    give_way: f64,
    /// β without λ [mm]
    bias: f64,
    /// λ [mm]
    leapt: f64,
    /// largest δ of this contact [mm]
    deepest: f64,
    /// largest gap between ball and tissue since they last touched [mm]
    gap: f64,
    last_point: Option<V3>,
    last_normal: V3,
    /// the ball's centre at the last tick
    last_centre: Option<V3>,
    material: Option<Material>,
    /// at the last tick [N]
    last_force: V3,
    bridge: Bridge,
    absurd: bool,
    /// δ at the last tick [mm]; 0 without contact
    indentation_mm: f64,
    /// slope of the tissue's own law there [N/mm]
    slope_n_per_mm: f64,
}

/// A force held to [`MAX_NODE_N`], zero where it is not finite; and whether it had to be.
fn bounded(force: V3) -> (V3, bool) {
    // not by the largest component: a NaN is none
    if !force.iter().all(|c| c.is_finite()) {
        return (V3::zeros(), true);
    }
    let size = force.amax();
    if size <= MAX_NODE_N { (force, false) } else { (force * (MAX_NODE_N / size), true) }
}

impl Node {
    pub fn new(node: &ContactNode) -> Self {
        Self {
            proxy: Proxy::new(node.radius_mm),
            share: node.share,
            friction: Friction::default(),
            give_way: 0.0,
            bias: 0.0,
            leapt: 0.0,
            deepest: 0.0,
            gap: 0.0,
            last_point: None,
            last_normal: V3::zeros(),
            last_centre: None,
            material: None,
            last_force: V3::zeros(),
            bridge: Bridge { difference: V3::zeros(), left: 0.0, duration_s: 1.0 },
            absurd: false,
            indentation_mm: 0.0,
            slope_n_per_mm: 0.0,
        }
    }

    /// What of the coupling's stiffness it called for at the last tick [N/mm], coming in over the first half millimetre.
    pub fn called_for(&self, stiffness_n_per_mm: f64) -> f64 {
        self.share * self.slope_n_per_mm.min(stiffness_n_per_mm) * (self.indentation_mm / DAMPING_DEPTH_MM).min(1.0)
    }

    /// δ⁴ at the last tick: what its part of the coupling goes by where not all can have what they call for.
    pub fn weight(&self) -> f64 {
        self.indentation_mm.powi(4)
    }

    /// Largest slope for this node where `called_for` of all is `called_n_per_mm` and their weights sum to `weights` (`shape`).
    pub fn slope(&self, called_n_per_mm: f64, weights: f64, stiffness_n_per_mm: f64) -> f64 {
        let shared = (2.0 * called_n_per_mm / stiffness_n_per_mm - 1.0).clamp(0.0, 1.0);
        if shared == 0.0 || weights <= 0.0 {
            return stiffness_n_per_mm;
        }
        let own = self.slope_n_per_mm.min(stiffness_n_per_mm);
        own + (self.weight() / weights * stiffness_n_per_mm - own) * shared
    }

    /// Contact and force before limits, with the ball's centre at `x` moving with `velocity`; `search` allows a look around for tissue, `slope`
    /// [N/mm] is the most that its law may have.
    pub fn touch<S: Surface + ?Sized>(
        &mut self,
        tissue: &S,
        (x, velocity): (V3, V3),
        search: bool,
        slope: f64,
        now: &Circumstances<'_>,
    ) -> Felt {
        let radius = self.proxy.radius_mm();
        let was_felt = self.last_point.is_some();
        let came = self.last_centre.replace(x).map_or(V3::zeros(), |last| last - x);
        if now.jumped {
            self.proxy.reset();
            self.end_contact();
        }
        let before = self.proxy.height_over_foot_mm(x.into()).map(|h| radius - h);
        let touch = self.proxy.update_within(tissue, x.into(), search);
        let mut felt = Felt { force: V3::zeros(), at: x, contact: None, buried: false, lost: false, elastic_mj: 0.0, granted_mj: 0.0 };
        let lost = was_felt.then_some(now.config.limits.fade_s.max(now.config.blend_s));
        let Touch::Surface { contact, moved } = touch else {
            felt.buried = touch == Touch::Buried;
            // the surface went away inside tissue, or the ball is free
            felt.lost = felt.buried && was_felt;
            self.end_contact();
            felt.force = self.bridged(V3::zeros(), now.dt, lost);
            return felt;
        };
        let (point, normal) = (V3::from(contact.point_mm), V3::from(contact.normal));
        let d = contact.penetration_mm;
        let blend = (was_felt && (now.committed || now.other_surface || moved)).then_some(now.config.blend_s);
        let bias = self.bias;
        if self.last_point.is_some() {
            let change = before.filter(|_| blend.is_some()).map(|before| before - d);
            // the foot slid further in this tick than the ball's motion explains
            let leap = before.filter(|_| blend.is_none()).map_or(0.0, |before| before - d);
            if leap.abs() > LEAP_MM + LEAP_SHARE * came.norm() {
                self.leapt += leap;
            }
            self.carry(change, now, d, (came - normal * came.dot(&normal)).norm());
        } else if moved || now.committed || now.other_surface || before.is_none() {
            // already pressed where it is found first (or again, after a tick without a foot), or met by tissue that came: felt gradually, but for what
            // the hand's own motion did
            let own = if moved { 0.0 } else { before.unwrap_or_else(|| came.dot(&normal)).max(0.0) };
            *(if now.committed || now.other_surface { &mut self.bias } else { &mut self.leapt }) = -(d - own).max(0.0);
        }
        let delta = (d + self.give_way + self.bias + self.leapt).max(0.0);
        if delta <= 0.0 && d <= 0.0 {
            self.end_contact();
            felt.force = self.bridged(V3::zeros(), now.dt, if now.jumped { lost } else { blend });
            return felt;
        }
        self.last_point = Some(point);
        felt.at = point;
        felt.contact = Some((contact, delta));
        self.indentation_mm = delta;
        let force = self.law(tissue, (point, normal, delta), (x, velocity), slope, now, &mut felt);
        if blend.is_none() {
            felt.granted_mj = (self.bias - bias).max(0.0) * force.dot(&normal).max(0.0);
        }
        let turned = normal - std::mem::replace(&mut self.last_normal, normal);
        if was_felt && blend.is_none() && turned.norm() > MAX_TURN {
            let left = self.bridge.difference * self.bridge.left - turned * force.dot(&normal).max(0.0);
            self.bridge = Bridge { difference: left, left: 1.0, duration_s: now.config.blend_s };
        }
        felt.force = self.bridged(force, now.dt, blend);
        felt
    }

    /// Carries m and β over a tick. A surface that moved changed d by −`change`: that goes to m when a commit did it (β takes what
    /// would make m negative) and to β when not. Sliding, a growing gap and time let them fade.
    fn carry(&mut self, change: Option<f64>, now: &Circumstances<'_>, d: f64, slid: f64) {
        let dt = now.dt;
        match change {
            Some(change) if now.committed && !now.other_surface => {
                self.give_way += change;
                self.bias += self.give_way.min(0.0);
                self.give_way = self.give_way.max(0.0);
            }
            Some(change) if now.other_surface => self.bias += change,
            Some(change) => self.leapt += change,
            None => self.give_way *= (-slid / (2.0 * self.proxy.radius_mm())).exp(),
        }
        let gap = (-d).max(0.0);
        if change.is_some() || gap == 0.0 {
            self.gap = gap;
        } else if gap > self.gap {
            self.give_way *= ((self.gap - gap) / GAP_MM).exp();
            self.gap = gap;
        }
        // tissue that has gone away from the tip was not pushed there: let go within the same time as what comes
        self.give_way = (self.give_way - (gap - OWN_GAP_MM).max(0.0) * dt / BIAS_S).max(0.0);
        for bias in [&mut self.bias, &mut self.leapt] {
            *bias = (*bias * (-dt / BIAS_S).exp()).clamp(-MAX_GIVE_WAY_MM, MAX_GIVE_WAY_MM);
        }
        self.give_way = self.give_way.min(MAX_GIVE_WAY_MM);
    }

    /// Normal force, damping and friction [N]; tells the energy in the springs.
    fn law<S: Surface + ?Sized>(
        &mut self,
        tissue: &S,
        (point, normal, delta): (V3, V3, f64),
        (x, velocity): (V3, V3),
        slope: f64,
        now: &Circumstances<'_>,
        felt: &mut Felt,
    ) -> V3 {
        let value = tissue.value((point - normal * MATERIAL_DEPTH_MM).into()).unwrap_or(now.threshold);
        let here = now.config.tissue.at(value);
        let material = self.material.map_or(here, |last| {
            let share = now.dt / (now.dt + MATERIAL_S);
            // skin that gets thin over bone is ten times as stiff within a millimetre: its force grows by parts of itself
            let (was, is) = (last.normal_force(delta, slope), last.between(&here, share).normal_force(delta, slope));
            let most = MATERIAL_PER_S * was.max(MATERIAL_FORCE_N) * now.dt;
            last.between(&here, share * (most / (is - was).abs().max(most)))
        });
        self.material = Some(material);
        self.slope_n_per_mm = material.stiffness_n_per_mm + 2.0 * material.stiffening_n_per_mm2 * delta;
        let damping = material.damping_n_s_per_mm.min(now.damping_n_s_per_mm) * (delta / DAMPING_DEPTH_MM).min(1.0);
        let elastic = material.normal_force(delta, slope);
        felt.elastic_mj = self.share * material.normal_energy(delta, slope);
        // pressed in: resists; withdrawn: damping may only lower the push, never pull
        let normal_n = (elastic - damping * velocity.dot(&normal)).max(0.0);
        let mut force = normal * normal_n;
        if now.config.friction {
            // tangentially as stiff as along the normal from first touch to where it was pressed deepest, within the coupling: a hand that trembles
            // changes nothing
            self.deepest = self.deepest.max(delta);
            let k = (material.stiffness_n_per_mm + material.stiffening_n_per_mm2 * self.deepest).min(slope);
            let rubbing = self.friction.force(x, normal, normal_n, k, material.friction_static, material.friction_kinetic);
            if k > 0.0 {
                felt.elastic_mj += self.share * 0.5 * rubbing.norm_squared() / k;
            }
            force += rubbing;
        }
        force * self.share
    }

    /// Bridges a discontinuity: continues from the last force and lets the difference go within `over_s`.
    fn bridged(&mut self, force: V3, dt: f64, over_s: Option<f64>) -> V3 {
        // what cannot be a force would live on in the bridge
        let (force, bounded) = bounded(force);
        self.absurd |= bounded;
        if let Some(duration_s) = over_s {
            self.bridge = Bridge { difference: self.last_force - force, left: 1.0, duration_s };
            return self.last_force;
        }
        self.bridge.left = (self.bridge.left - dt / self.bridge.duration_s).max(0.0);
        self.last_force = force + self.bridge.difference * self.bridge.left;
        self.last_force
    }

    /// Whether a force since the last call was none.
    pub fn took_absurd(&mut self) -> bool {
        std::mem::take(&mut self.absurd)
    }

    fn end_contact(&mut self) {
        self.give_way = 0.0;
        (self.bias, self.leapt, self.deepest) = (0.0, 0.0, 0.0);
        self.gap = 0.0;
        self.last_point = None;
        self.material = None;
        (self.indentation_mm, self.slope_n_per_mm) = (0.0, 0.0);
        self.friction.release();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_force_that_can_be_none_is_bounded_counted_and_gone_when_its_bridge_is() {
        let shape = crate::shape::ToolShape::sphere(2.0);
        for absurd in [f64::MAX, -1e300, 1e12, f64::NAN, f64::INFINITY] {
            let mut node = Node::new(&shape.nodes()[0]);
            for over_s in [None, Some(0.02), None] {
                let force = node.bridged(V3::new(absurd, 1.0, 0.0), 1e-3, over_s);
                assert!(force.amax() <= 2.0 * MAX_NODE_N, "{absurd}: {force:?}");
                assert!(node.took_absurd() && !node.took_absurd());
            }
            let mut force = node.bridged(V3::new(0.0, 0.5, 0.0), 1e-3, Some(0.02));
            for _ in 0..21 {
                force = node.bridged(V3::new(0.0, 0.5, 0.0), 1e-3, None);
            }
            assert!((force - V3::new(0.0, 0.5, 0.0)).norm() < 1e-9 && !node.took_absurd(), "{absurd}: {force:?}");
        }
    }
}
