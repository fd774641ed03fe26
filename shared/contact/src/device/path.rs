//! A scripted tool: way points in time, looped or held at the end. It feels nothing.

use super::{Device, DevicePose};
use crate::{V3, finite};
use thiserror::Error;

/// One station of a path.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct WayPoint {
    /// when, from the path's start [s]
    pub time_s: f64,
    /// where the tip is [mm]
    pub position_mm: [f64; 3],
    /// where the tool points; made unit
    pub direction: [f64; 3],
}

/// How the tip goes from one way point to the next.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Easing {
    /// at constant speed
    Linear,
    /// as a hand does: at rest at every way point, with the least jerk between [Flash & Hogan 1985]
    #[default]
    MinimumJerk,
}

/// Way points that can be followed.
#[derive(Clone, Debug, PartialEq)]
pub struct Path {
    points: Vec<WayPoint>,
    looped: bool,
    easing: Easing,
}

/// Why way points make no path.
#[derive(Clone, Copy, Debug, Error, PartialEq)]
pub enum PathError {
    /// none at all
    #[error("a path needs at least one way point")]
    Empty,
    /// a number is NaN or infinite
    #[error("way point {0} has a number that is not finite")]
    NotFinite(usize),
    /// time stands still or goes back
    #[error("way point {0} is not later than the one before it")]
    NotLater(usize),
    /// a direction of length zero
    #[error("way point {0} points nowhere: its direction has length zero")]
    NoDirection(usize),
}

impl Path {
    /// A path through `points`, times rising. A looped path goes back to its first point at the last one's time: let both be the same place.
    ///
    /// # Errors
    /// When there is no point, a number is not finite, times do not rise or a direction is zero.
    pub fn new(points: &[WayPoint], looped: bool, easing: Easing) -> Result<Self, PathError> {
        if points.is_empty() {
            return Err(PathError::Empty);
        }
        let mut points = points.to_vec();
        for n in 0..points.len() {
            let p = points[n];
            let direction = finite(p.direction).ok_or(PathError::NotFinite(n))?;
            if finite(p.position_mm).is_none() || !p.time_s.is_finite() {
                return Err(PathError::NotFinite(n));
            }
            if n > 0 && p.time_s <= points[n - 1].time_s {
                return Err(PathError::NotLater(n));
            }
            points[n].direction = direction.try_normalize(1e-9).ok_or(PathError::NoDirection(n))?.into();
        }
        Ok(Self { points, looped, easing })
    }

    /// From the first to the last way point [s].
    pub fn duration_s(&self) -> f64 {
        self.points[self.points.len() - 1].time_s - self.points[0].time_s
    }

    /// Position [mm] and unit direction at `time_s` from the start; before the first way point it waits there.
    pub fn at(&self, time_s: f64) -> ([f64; 3], [f64; 3]) {
        let (first, last) = (&self.points[0], &self.points[self.points.len() - 1]);
        let mut time = time_s;
        if self.looped && self.duration_s() > 0.0 && time > last.time_s {
            time = first.time_s + (time - first.time_s).rem_euclid(self.duration_s());
        }
        if time <= first.time_s || !time.is_finite() {
            return (first.position_mm, first.direction);
        }
        if time >= last.time_s {
            return (last.position_mm, last.direction);
        }
        let n = self.points.partition_point(|p| p.time_s <= time);
        let (a, b) = (&self.points[n - 1], &self.points[n]);
        let t = (time - a.time_s) / (b.time_s - a.time_s);
        let s = match self.easing {
            Easing::Linear => t,
            Easing::MinimumJerk => t * t * t * (10.0 + t * (6.0 * t - 15.0)),
        };
        let mix = |p: [f64; 3], q: [f64; 3]| V3::from(p) * (1.0 - s) + V3::from(q) * s;
        // opposite directions have no middle: keep the first until the second
        let direction = mix(a.direction, b.direction).try_normalize(1e-9).unwrap_or_else(|| V3::from(a.direction));
        (mix(a.position_mm, b.position_mm).into(), direction.into())
    }
}

/// A device that follows a function of time, whatever the force.
pub struct PathDevice<F = Box<dyn FnMut(f64) -> ([f64; 3], [f64; 3]) + Send>> {
    follow: F,
    start_ns: u64,
    last_force_n: [f64; 3],
}

impl PathDevice {
    /// Follows way points from simulation time `start_ns`.
    pub fn new(path: Path, start_ns: u64) -> Self {
        Self::from_fn(Box::new(move |t| path.at(t)), start_ns)
    }
}

impl<F: FnMut(f64) -> ([f64; 3], [f64; 3])> PathDevice<F> {
    /// Follows a closure of the seconds since `start_ns`, which gives position [mm] and direction.
    pub fn from_fn(follow: F, start_ns: u64) -> Self {
        Self { follow, start_ns, last_force_n: [0.0; 3] }
    }

    /// The force last written [N].
    pub fn last_force_n(&self) -> [f64; 3] {
        self.last_force_n
    }
}

impl<F: FnMut(f64) -> ([f64; 3], [f64; 3])> Device for PathDevice<F> {
    fn read(&mut self, now_ns: u64) -> DevicePose {
        let (position_mm, direction) = (self.follow)(now_ns.saturating_sub(self.start_ns) as f64 * 1e-9);
        DevicePose { position_mm, direction, velocity_mm_s: None, valid: true }
    }

    fn write(&mut self, force_n: [f64; 3]) {
        self.last_force_n = force_n;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn point(time_s: f64, z: f64) -> WayPoint {
        WayPoint { time_s, position_mm: [0.0, 0.0, z], direction: [0.0, 0.0, -2.0] }
    }

    #[test]
    fn a_path_meets_its_way_points_and_loops() {
        for easing in [Easing::Linear, Easing::MinimumJerk] {
            let path = Path::new(&[point(0.0, 5.0), point(1.0, -5.0), point(3.0, 5.0)], true, easing).unwrap();
            for (t, z) in [(-1.0, 5.0), (0.0, 5.0), (0.5, 0.0), (1.0, -5.0), (2.0, 0.0), (3.0, 5.0), (4.0, -5.0), (3001.0, -5.0)] {
                let (p, d) = path.at(t);
                assert!((p[2] - z).abs() < 1e-9, "{easing:?} at {t}: {p:?}");
                assert_eq!(d, [0.0, 0.0, -1.0]);
            }
        }
        let held = Path::new(&[point(0.0, 5.0), point(1.0, -5.0)], false, Easing::Linear).unwrap();
        assert_eq!(held.at(10.0).0[2], -5.0);
        assert_eq!(held.at(f64::NAN).0[2], 5.0);
    }

    #[test]
    fn bad_paths_are_refused_with_the_way_point() {
        assert_eq!(Path::new(&[], false, Easing::Linear), Err(PathError::Empty));
        assert_eq!(Path::new(&[point(0.0, 0.0), point(0.0, 1.0)], false, Easing::Linear), Err(PathError::NotLater(1)));
        assert_eq!(Path::new(&[point(0.0, f64::NAN)], false, Easing::Linear), Err(PathError::NotFinite(0)));
        let nowhere = WayPoint { direction: [0.0; 3], ..point(0.0, 0.0) };
        assert_eq!(Path::new(&[nowhere], false, Easing::Linear), Err(PathError::NoDirection(0)));
    }
}
