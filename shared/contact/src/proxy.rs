//! The proxy (god-object) of a spherical tip: where the tip would be if the tissue were rigid.
//!
//! The tip is a ball of radius r with its centre at the device's position x. The *foot* s is the point of the isosurface
//! nearest to x, followed from tick to tick, so that it stays on the side where the tip came in   [Zilles & Salisbury 1995;
//! on implicit surfaces: Salisbury & Tarr 1997]. With n the outward normal at s,
//!
//! height h = (x − s)·n,   penetration d = r − h,   proxy centre p = s + r n.
//!
//! h may be negative (the centre itself is inside) and d may be negative (no contact yet, the foot is only near). Each step goes
//! along the tangent plane towards x, at most one voxel, and back to the surface along the normal, by a search that
//! brackets the crossing, so that it needs no slope and cannot run away; steps are halved when they do not converge.
//! n comes from the interpolated gradient and is continuous along the surface.
//!
//! In the air the foot is found by 26 probes around the tip, slightly beyond r, every tick; inside, by going back to the
//! last position outside (thesis fig. 3.17). A tip that was pushed through a thin wall is in air again, but of another cavity: as long as
//! tissue lies on the segment from its foot to its centre it is held as if inside, and that air is not outside. A tip whose centre is inside tissue without having come
//! from outside (start, jump, a new threshold) is *buried*: no contact until the centre has been in air.
//!
//! Invariants: bounded work (`limits`); never NaN; a lost foot is reported, not guessed.
//! Cost: 3–10 µs in contact. Allocation: none. Not here: force; several contacts of one tip (the deepest alone counts).

use crate::{
    V3, finite,
    limits::{FOOT_TOLERANCE_MM, MAX_BACK_STEPS, MAX_RELAX_STEPS, MAX_ROOT_STEPS, MAX_SEARCH_STEPS},
    surface::Surface,
};

/// Probes reach this much beyond the tip's radius, as a part of it: between the 26 directions a flat wall must be noticed
/// before the ball touches it (1/cos 27.4° − 1 = 0.126).
const PROBE_MARGIN: f64 = 0.2;

/// A foot once found is followed while the gap to the tip is at most this [mm]: tissue that has given way is felt a little longer than
/// it touches (see `HapticCore`).
const KEEP_GAP_MM: f64 = 4.0;

/// Where a tip touches, or nearly touches, the surface.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Contact {
    /// foot point on the surface [mm]
    pub point_mm: [f64; 3],
    /// outward unit normal there
    pub normal: [f64; 3],
    /// depth of the tip below the surface [mm]; negative: the gap
    pub penetration_mm: f64,
    /// centre of the tip held at the surface [mm]
    pub proxy_mm: [f64; 3],
}

/// What the proxy found.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Touch {
    /// no tissue within reach of the tip
    Free,
    /// a surface at or near the tip; `moved` when it is another place than one tick of motion explains
    Surface {
        /// the contact
        contact: Contact,
        /// the foot jumped to another place of the surface
        moved: bool,
    },
    /// inside tissue without having come from outside: felt as nothing until free
    Buried,
}

#[derive(Clone, Copy, Debug)]
struct Foot {
    point: V3,
    normal: V3,
}

#[derive(Clone, Copy, Debug)]
enum State {
    Free,
    Near(Foot),
    Buried,
}

/// The proxy of one spherical tip.
#[derive(Clone, Copy, Debug)]
pub struct Proxy {
    radius_mm: f64,
    state: State,
    outside: Option<V3>,
}

impl Proxy {
    /// A proxy for a tip of `radius_mm` (held to 0.05 … 50 mm). It starts as if buried, so that tissue around it is not felt before the
    /// centre has been in air.
    pub fn new(radius_mm: f64) -> Self {
        let radius_mm = if radius_mm.is_finite() { radius_mm.clamp(0.05, 50.0) } else { 1.0 };
        Self { radius_mm, state: State::Buried, outside: None }
    }

    /// Radius of the tip [mm].
    pub fn radius_mm(&self) -> f64 {
        self.radius_mm
    }

    /// Last position of the tip's centre outside tissue [mm].
    pub fn outside_mm(&self) -> Option<[f64; 3]> {
        self.outside.map(Into::into)
    }

    /// Forgets where the tip was: after a jump, or when the surface is another one.
    pub fn reset(&mut self) {
        *self = Self::new(self.radius_mm);
    }

    /// As if the tip had been in air at `outside_mm` just now [mm]. Not finite: ignored.
    pub fn resume(&mut self, outside_mm: [f64; 3]) {
        if let Some(outside) = finite(outside_mm) {
            (self.state, self.outside) = (State::Free, Some(outside));
        }
    }

    /// As if the tip had come straight to `at`, against `outward`, from where tissue ends there [mm]. Where it does not end within
    /// [`MAX_BACK_STEPS`] half voxels, nothing changes.
    pub fn resume_along<S: Surface + ?Sized>(&mut self, tissue: &S, at: [f64; 3], outward: [f64; 3]) {
        let (Some(at), Some(outward)) = (finite(at), finite(outward).and_then(|out| out.try_normalize(1e-9))) else { return };
        let step = outward * (0.5 * tissue.resolution_mm());
        let out = (0..=MAX_BACK_STEPS).map(|n| at + step * n as f64).find(|&x| !is_inside(tissue, x));
        if let Some(out) = out {
            self.resume(out.into());
        }
    }

    /// Height of a position over the last foot's tangent plane [mm], if there is a foot.
    pub fn height_over_foot_mm(&self, at: [f64; 3]) -> Option<f64> {
        match self.state {
            State::Near(foot) => Some((V3::from(at) - foot.point).dot(&foot.normal)),
            _ => None,
        }
    }

    /// Moves the tip to `at` [mm]. A position that is not finite leaves everything as it was.
    pub fn update<S: Surface + ?Sized>(&mut self, tissue: &S, at: [f64; 3]) -> Touch {
        self.update_within(tissue, at, true)
    }

    /// The same; without `search` a tip in the air does not look around for tissue (or for a nearer part of it) in this tick.
    pub fn update_within<S: Surface + ?Sized>(&mut self, tissue: &S, at: [f64; 3], search: bool) -> Touch {
        let Some(x) = finite(at) else { return self.touch(V3::zeros(), false) };
        let inside = is_inside(tissue, x);
        let (mut moved, mut beyond) = (false, false);
        match self.state {
            State::Buried => {
                if !inside {
                    self.state = State::Free;
                    self.find_in_air(tissue, x);
                    // a cavity narrower than the tip presses at once: nobody came there by motion
                    moved = matches!(self.state, State::Near(_));
                }
            }
            State::Free => {
                if inside {
                    self.find_from_inside(tissue, x);
                } else if search {
                    self.find_in_air(tissue, x);
                }
            }
            State::Near(foot) => {
                let found = relax(tissue, x, foot);
                self.state = match found {
                    Some(foot) if height(x, &foot) <= self.reach(tissue) + KEEP_GAP_MM => State::Near(foot),
                    _ => State::Free,
                };
                // in the air, but of another cavity: held from behind, as inside
                beyond = !inside && found.is_some_and(|foot| !in_sight(tissue, &foot, x));
                if inside {
                    if found.is_none() {
                        moved = true;
                        self.find_from_inside(tissue, x);
                    }
                } else if search && !beyond {
                    moved |= self.find_nearer(tissue, x);
                }
            }
        }
        if !inside && !beyond && !matches!(self.state, State::Buried) {
            self.outside = Some(x);
        }
        self.touch(x, moved)
    }

    fn touch(&self, x: V3, moved: bool) -> Touch {
        match self.state {
            State::Free => Touch::Free,
            State::Buried => Touch::Buried,
            State::Near(foot) => Touch::Surface {
                contact: Contact {
                    point_mm: foot.point.into(),
                    normal: foot.normal.into(),
                    penetration_mm: self.radius_mm - height(x, &foot),
                    proxy_mm: (foot.point + foot.normal * self.radius_mm).into(),
                },
                moved,
            },
        }
    }

    fn reach<S: Surface + ?Sized>(&self, tissue: &S) -> f64 {
        self.radius_mm * (1.0 + PROBE_MARGIN) + 0.5 * tissue.resolution_mm()
    }

    /// The nearest crossing along 26 directions within `reach`, as a point just outside and a direction outward.
    fn nearest_probe<S: Surface + ?Sized>(&self, tissue: &S, x: V3, reach: f64) -> Option<Foot> {
        let (mut best, mut best_distance) = (None, reach);
        for direction in directions() {
            // only what is nearer than the best so far is of interest
            let end = x + direction * best_distance;
            if is_inside(tissue, end)
                && let Some(foot) = root(tissue, end, -direction, 0.0, best_distance).and_then(|point| foot_at(tissue, point, -direction))
            {
                best_distance = (foot.point - x).norm();
                best = Some(foot);
            }
        }
        best
    }

    fn find_in_air<S: Surface + ?Sized>(&mut self, tissue: &S, x: V3) {
        if let Some(foot) = self.nearest_probe(tissue, x, self.reach(tissue)).and_then(|foot| relax(tissue, x, foot)) {
            self.state = State::Near(foot);
        }
    }

    /// Looks whether another part of the surface is nearer than the foot that is followed. Whether the foot changed.
    fn find_nearer<S: Surface + ?Sized>(&mut self, tissue: &S, x: V3) -> bool {
        let State::Near(foot) = self.state else {
            self.find_in_air(tissue, x);
            return matches!(self.state, State::Near(_));
        };
        // half a tenth of a voxel of hysteresis: two equally near walls must not take turns
        let current = (x - foot.point).norm() - 0.05 * tissue.resolution_mm();
        if current <= 0.0 {
            return false;
        }
        let Some(other) = self.nearest_probe(tissue, x, current).and_then(|foot| relax(tissue, x, foot)) else { return false };
        let nearer = (x - other.point).norm() < current && (other.point - foot.point).norm() > 0.05 * tissue.resolution_mm();
        if nearer {
            self.state = State::Near(other);
        }
        nearer
    }

    /// From a centre inside tissue back to the last position outside, then to the nearest surface point there.
    fn find_from_inside<S: Surface + ?Sized>(&mut self, tissue: &S, x: V3) {
        let found = self.outside.filter(|&out| !is_inside(tissue, out)).and_then(|out| {
            let way = out - x;
            let length = way.norm();
            if length < 1e-9 {
                return None;
            }
            let direction = way / length;
            let step = (0.5 * tissue.resolution_mm()).max(length / MAX_BACK_STEPS as f64);
            let mut at = 0.0;
            while at < length {
                let next = (at + step).min(length);
                if !is_inside(tissue, x + direction * next) {
                    let point = root(tissue, x, direction, at, next)?;
                    return foot_at(tissue, point, direction);
                }
                at = next;
            }
            None
        });
        self.state = match found.and_then(|foot| relax(tissue, x, foot)) {
            Some(foot) => State::Near(foot),
            None => State::Buried,
        };
    }
}

/// 26 unit directions: faces, edges and corners of a cube.
fn directions() -> impl Iterator<Item = V3> {
    (0..27).filter(|n| *n != 13).map(|n| V3::new(f64::from(n % 3 - 1), f64::from(n / 3 % 3 - 1), f64::from(n / 9 - 1)).normalize())
}

fn height(x: V3, foot: &Foot) -> f64 {
    (x - foot.point).dot(&foot.normal)
}

/// value − threshold; `None` outside the volume.
fn level<S: Surface + ?Sized>(tissue: &S, at: V3) -> Option<f64> {
    tissue.value(at.into()).map(|v| v - tissue.threshold()).filter(|l| l.is_finite())
}

fn is_inside<S: Surface + ?Sized>(tissue: &S, at: V3) -> bool {
    level(tissue, at).is_some_and(|l| l >= 0.0)
}

/// Whether no tissue lies between a foot and `x`.
fn in_sight<S: Surface + ?Sized>(tissue: &S, foot: &Foot, x: V3) -> bool {
    let half_voxel = 0.5 * tissue.resolution_mm();
    // from a little above the surface: on it, rounding decides
    let from = foot.point + foot.normal * (0.5 * half_voxel);
    let way = x - from;
    let steps = ((way.norm() / half_voxel).ceil() as usize).clamp(1, MAX_BACK_STEPS);
    (0..steps).all(|n| !is_inside(tissue, from + way * (n as f64 / steps as f64)))
}

/// The surface between `start + direction·a` (inside) and `start + direction·b` (outside). A side out of the volume is no
/// surface.
fn root<S: Surface + ?Sized>(tissue: &S, start: V3, direction: V3, mut a: f64, mut b: f64) -> Option<V3> {
    let (mut low, mut high) = (level(tissue, start + direction * a)?, level(tissue, start + direction * b)?);
    for step in 0..MAX_ROOT_STEPS {
        if b - a <= FOOT_TOLERANCE_MM * 0.01 || low == 0.0 {
            break;
        }
        // regula falsi with a halving every third step: fast where the field is smooth, safe where it is not
        let t = if step % 3 == 2 || high >= low { 0.5 } else { (low / (low - high)).clamp(0.001, 0.999) };
        let middle = a + (b - a) * t;
        let value = level(tissue, start + direction * middle)?;
        if value.abs() <= 1e-9 {
            return Some(start + direction * middle);
        }
        if value >= 0.0 {
            (a, low) = (middle, value);
        } else {
            (b, high) = (middle, value);
        }
    }
    let t = if low > high { (low / (low - high)).clamp(0.0, 1.0) } else { 0.5 };
    Some(start + direction * (a + (b - a) * t))
}

/// The surface point nearest to `from` along ±`normal`, within a bounded search.
fn project<S: Surface + ?Sized>(tissue: &S, from: V3, normal: V3) -> Option<V3> {
    let sample = tissue.sample(from.into())?;
    let here = sample.value - tissue.threshold();
    if here == 0.0 {
        return Some(from);
    }
    let half_voxel = 0.5 * tissue.resolution_mm();
    // outward when inside, inward when outside
    let direction = if here > 0.0 { normal } else { -normal };
    // a first step a little beyond where the slope puts the surface: most searches end there
    let slope = V3::from(sample.gradient).dot(&normal).abs();
    let guess = if slope > 0.0 { 1.2 * here.abs() / slope + FOOT_TOLERANCE_MM } else { half_voxel };
    let (mut at, mut step) = (0.0, guess.min(half_voxel));
    for _ in 0..MAX_SEARCH_STEPS {
        let next = at + step;
        let value = level(tissue, from + direction * next)?;
        if (value >= 0.0) != (here > 0.0) {
            // root() wants inside first
            return if here > 0.0 {
                root(tissue, from, direction, at, next)
            } else {
                root(tissue, from + direction * next, -direction, 0.0, next - at)
            };
        }
        at = next;
        step = half_voxel;
    }
    None
}

/// The foot at a surface point; where the field has no gradient the normal falls back to `hint`.
fn foot_at<S: Surface + ?Sized>(tissue: &S, point: V3, hint: V3) -> Option<Foot> {
    let gradient = finite(tissue.sample(point.into())?.gradient)?;
    let length = gradient.norm();
    let normal = if length > 1e-6 { -gradient / length } else { hint };
    Some(Foot { point, normal })
}

/// Slides a foot along the surface until x − s is along the normal.
fn relax<S: Surface + ?Sized>(tissue: &S, x: V3, start: Foot) -> Option<Foot> {
    let longest = tissue.resolution_mm();
    let mut foot = foot_at(tissue, project(tissue, start.point, start.normal)?, start.normal)?;
    let (mut last, mut factor) = (f64::INFINITY, 1.0);
    for _ in 0..MAX_RELAX_STEPS {
        let to = x - foot.point;
        let tangent = to - foot.normal * to.dot(&foot.normal);
        let length = tangent.norm();
        if length < FOOT_TOLERANCE_MM {
            break;
        }
        // steps limited by the voxel do not tell of convergence
        if length < longest && length > 0.7 * last {
            factor *= 0.5;
        }
        last = length;
        let step = tangent * (factor * (longest / length).min(1.0));
        // where the surface ends (a hole, the volume's border) the foot stays at the edge
        let Some(point) = project(tissue, foot.point + step, foot.normal) else { break };
        foot = foot_at(tissue, point, foot.normal)?;
    }
    Some(foot)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::surface::AnalyticSurface;
    use maille_volume::VolumeSample;

    /// A ball of radius 10 at the origin.
    fn ball() -> AnalyticSurface<impl Fn([f64; 3]) -> VolumeSample> {
        let field = |at: [f64; 3]| {
            let x = V3::from(at);
            let r = x.norm();
            VolumeSample { value: 100.0 * (10.0 - r), gradient: if r > 0.0 { (-100.0 * x / r).into() } else { [0.0; 3] } }
        };
        AnalyticSurface { field, threshold: 0.0, resolution_mm: 1.0 }
    }

    fn contact(touch: Touch) -> Contact {
        match touch {
            Touch::Surface { contact, .. } => contact,
            other => panic!("expected a surface, got {other:?}"),
        }
    }

    #[test]
    fn the_proxy_stays_on_the_surface_while_the_device_goes_deep() {
        let tissue = ball();
        let mut proxy = Proxy::new(2.0);
        assert_eq!(proxy.update(&tissue, [0.0, 0.0, 20.0]), Touch::Free);
        let direction = V3::new(0.3, -0.2, 1.0).normalize();
        for n in 0..190 {
            let x = direction * (20.0 - f64::from(n) * 0.1);
            if let Touch::Surface { contact: c, .. } = proxy.update(&tissue, x.into()) {
                assert!((V3::from(c.normal) - direction).norm() < 1e-4, "{n}");
                assert!((V3::from(c.point_mm).norm() - 10.0).abs() < 1e-6);
                assert!((V3::from(c.proxy_mm).norm() - 12.0).abs() < 1e-6);
                assert!((c.penetration_mm - (12.0 - x.norm())).abs() < 1e-4, "{n}");
            } else {
                assert!(x.norm() > 12.0, "a surface nearer than the radius is felt: {}", x.norm());
            }
        }
    }

    #[test]
    fn a_tip_that_starts_inside_feels_nothing_until_its_centre_was_in_air() {
        let tissue = ball();
        let mut proxy = Proxy::new(1.0);
        for z in [0.0, 5.0, 9.5] {
            assert_eq!(proxy.update(&tissue, [0.0, 0.0, z]), Touch::Buried, "{z}");
        }
        let touch = proxy.update(&tissue, [0.0, 0.0, 10.5]);
        assert!(matches!(touch, Touch::Surface { moved: true, .. }), "a place that no motion explains: {touch:?}");
        assert!((contact(touch).penetration_mm - 0.5).abs() < 1e-6);
        assert!((contact(proxy.update(&tissue, [0.0, 0.0, 9.5])).penetration_mm - 1.5).abs() < 1e-6);
    }

    #[test]
    fn a_fast_tip_is_brought_back_to_where_it_came_in() {
        let tissue = ball();
        let mut proxy = Proxy::new(1.0);
        proxy.update(&tissue, [0.0, 0.0, 14.0]);
        let c = contact(proxy.update(&tissue, [0.0, 0.0, 6.0]));
        assert!((c.point_mm[2] - 10.0).abs() < 1e-6 && (c.penetration_mm - 5.0).abs() < 1e-6, "{c:?}");
    }

    #[test]
    fn fields_without_gradient_and_noise_end_in_bounded_answers() {
        let flat = AnalyticSurface { field: |_| VolumeSample { value: 1.0, gradient: [0.0; 3] }, threshold: 0.0, resolution_mm: 1.0 };
        let mut proxy = Proxy::new(1.0);
        assert_eq!(proxy.update(&flat, [0.0; 3]), Touch::Buried);
        let step = AnalyticSurface {
            field: |at: [f64; 3]| VolumeSample { value: if at[2] < 0.0 { 1.0 } else { -1.0 }, gradient: [0.0; 3] },
            threshold: 0.0,
            resolution_mm: 1.0,
        };
        proxy.update(&step, [0.0, 0.0, 3.0]);
        let c = contact(proxy.update(&step, [0.0, 0.0, 0.5]));
        assert!((c.penetration_mm - 0.5).abs() < 1e-3, "a step without gradient has a surface: {c:?}");
        let noise = AnalyticSurface {
            field: |at: [f64; 3]| {
                let v = (at[0] * 12.9 + at[1] * 78.2 + at[2] * 37.7).sin() * 43758.5;
                VolumeSample { value: v.fract(), gradient: [v.sin(), v.cos(), f64::NAN] }
            },
            threshold: 0.3,
            resolution_mm: 1.0,
        };
        let mut proxy = Proxy::new(1.0);
        for n in 0..500 {
            let t = f64::from(n) * 0.37;
            if let Touch::Surface { contact: c, .. } = proxy.update(&noise, [t.sin() * 5.0, t.cos() * 5.0, t % 3.0]) {
                assert!(c.penetration_mm.is_finite() && finite(c.normal).is_some() && finite(c.point_mm).is_some());
            }
        }
        let before = proxy.outside_mm();
        proxy.update(&noise, [f64::NAN, 0.0, f64::INFINITY]);
        assert_eq!(proxy.outside_mm(), before);
    }
}
