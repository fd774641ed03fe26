//! The way of the tip: way points in millimetres and the smooth motion between them.
//!
//! Each component is a piecewise cubic Hermite curve with the tangents of Fritsch & Butland (SIAM J. Sci. Stat. Comput. 5,
//! 1984): the harmonic mean of the neighbouring slopes where they agree in sign, else zero. So the motion has a
//! continuous velocity, passes every way point at its time, and never overshoots: a tool that holds, holds.
//!
//! Frame: patient, LPS mm; time s from the start. Cost of [`Waypoints::at`]: a binary search and one cubic; no
//! allocation, so the 1 kHz loop may call it. Not here: clocks, and the hand that follows (`tool.hand`).

use maille_volume::Grid;

/// Where the tip's centre is at a time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Waypoint {
    /// [s] from the start of a round
    pub time_s: f64,
    /// [mm, LPS]
    pub position_mm: [f64; 3],
    /// unit vector, shaft to tip
    pub direction: [f64; 3],
}

/// Position, velocity and direction of the tool.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ToolPose {
    /// tip's centre [mm, LPS]
    pub position_mm: [f64; 3],
    /// its velocity [mm/s]
    pub velocity_mm_s: [f64; 3],
    /// unit vector, shaft to tip
    pub direction: [f64; 3],
}

/// Way points with the tangents of the motion between them.
#[derive(Clone, Debug, PartialEq)]
pub struct Waypoints {
    /// in order of time; closed (last at the first's place) when the path loops
    points: Vec<Waypoint>,
    /// velocity at each point [mm/s]
    tangents: Vec<[f64; 3]>,
    looped: bool,
}

impl Waypoints {
    /// The motion through these points; times must increase strictly. A path that loops and does not end where it began
    /// is closed with a way back, ending at `period_s` or, without one, taken at the path's mean speed.
    ///
    /// None when there are no points, or times or positions are unusable.
    pub fn new(mut points: Vec<Waypoint>, looped: bool, period_s: Option<f64>) -> Option<Self> {
        let usable = |p: &Waypoint| p.time_s.is_finite() && p.position_mm.iter().chain(&p.direction).all(|x| x.is_finite());
        if points.is_empty() || !points.iter().all(usable) || points.windows(2).any(|w| w[0].time_s >= w[1].time_s) {
            return None;
        }
        points.iter_mut().for_each(|p| p.direction = unit(p.direction).unwrap_or([0.0, 1.0, 0.0]));
        let (first, last) = (points[0], points[points.len() - 1]);
        let open = distance(first.position_mm, last.position_mm) > 1e-6 || points.len() == 1;
        let end = period_s.map(|p| first.time_s + p).filter(|&end| end > last.time_s);
        if looped && (open || end.is_some()) {
            let length: f64 = points.windows(2).map(|w| distance(w[0].position_mm, w[1].position_mm)).sum();
            let speed = length / (last.time_s - first.time_s).max(1e-3);
            let back = (distance(first.position_mm, last.position_mm) / speed.max(1e-6)).clamp(0.5, 60.0);
            points.push(Waypoint { time_s: end.unwrap_or(last.time_s + back), ..first });
        }
        let tangents = tangents(&points, looped);
        Some(Self { points, tangents, looped })
    }

    /// The way points, the closing one included.
    pub fn points(&self) -> &[Waypoint] {
        &self.points
    }

    /// Whether the motion starts again at its end.
    pub fn is_looped(&self) -> bool {
        self.looped
    }

    /// Time from the first point to the last [s].
    pub fn period_s(&self) -> f64 {
        self.points[self.points.len() - 1].time_s - self.points[0].time_s
    }

    /// The pose at a time [s]: at rest before the first point and, unless the path loops, after the last.
    pub fn at(&self, time_s: f64) -> ToolPose {
        let first = self.points[0].time_s;
        let period = self.period_s();
        let mut t = if time_s.is_finite() { time_s } else { first };
        if self.looped && period > 0.0 && t > first {
            t = first + (t - first) % period;
        }
        let after = self.points.partition_point(|p| p.time_s <= t);
        if after == 0 || after == self.points.len() {
            let p = &self.points[after.saturating_sub(1)];
            return ToolPose { position_mm: p.position_mm, velocity_mm_s: [0.0; 3], direction: p.direction };
        }
        let (a, b) = (&self.points[after - 1], &self.points[after]);
        let (ta, tb) = (&self.tangents[after - 1], &self.tangents[after]);
        let h = b.time_s - a.time_s;
        let s = (t - a.time_s) / h;
        // Hermite basis and its derivative in s
        let (s2, s3) = (s * s, s * s * s);
        let (h00, h10, h01, h11) = (2.0 * s3 - 3.0 * s2 + 1.0, s3 - 2.0 * s2 + s, 3.0 * s2 - 2.0 * s3, s3 - s2);
        let (d00, d10, d01, d11) = (6.0 * (s2 - s), 3.0 * s2 - 4.0 * s + 1.0, 6.0 * (s - s2), 3.0 * s2 - 2.0 * s);
        let blend = |c: usize, w: [f64; 4]| w[0] * a.position_mm[c] + h * w[1] * ta[c] + w[2] * b.position_mm[c] + h * w[3] * tb[c];
        let turned = std::array::from_fn(|c| h00 * a.direction[c] + h01 * b.direction[c]);
        ToolPose {
            position_mm: std::array::from_fn(|c| blend(c, [h00, h10, h01, h11])),
            velocity_mm_s: std::array::from_fn(|c| blend(c, [d00, d10, d01, d11]) / h),
            direction: unit(turned).unwrap_or(a.direction),
        }
    }
}

/// Tangents [mm/s] at the points. At the ends of a path that does not loop the tool is at rest.
fn tangents(points: &[Waypoint], looped: bool) -> Vec<[f64; 3]> {
    let n = points.len();
    let slope = |i: usize, c: usize| {
        let (a, b) = (&points[i], &points[i + 1]);
        (b.position_mm[c] - a.position_mm[c]) / (b.time_s - a.time_s)
    };
    let mean = |a: f64, b: f64| if a * b > 0.0 { 2.0 * a * b / (a + b) } else { 0.0 };
    (0..n)
        .map(|i| {
            std::array::from_fn(|c| match i {
                _ if n < 3 => 0.0,
                0 if looped => mean(slope(n - 2, c), slope(0, c)),
                i if i == n - 1 && looped => mean(slope(n - 2, c), slope(0, c)),
                0 => 0.0,
                i if i == n - 1 => 0.0,
                i => mean(slope(i - 1, c), slope(i, c)),
            })
        })
        .collect()
}

pub(crate) fn distance(a: [f64; 3], b: [f64; 3]) -> f64 {
    (0..3).map(|c| (a[c] - b[c]).powi(2)).sum::<f64>().sqrt()
}

pub(crate) fn unit(v: [f64; 3]) -> Option<[f64; 3]> {
    let length = v.iter().map(|x| x * x).sum::<f64>().sqrt();
    (length.is_finite() && length > 1e-9).then(|| v.map(|x| x / length))
}

/// The volume's box of voxel centres, along the LPS axes [mm].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BoxMm {
    /// smallest coordinates
    pub low: [f64; 3],
    /// largest coordinates
    pub high: [f64; 3],
}

impl BoxMm {
    /// The box that holds all voxel centres of a grid, however its axes lie.
    pub fn of(grid: &Grid) -> Self {
        let (mut low, mut high) = ([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]);
        for corner in 0..8usize {
            let at = grid.world_from_index(std::array::from_fn(|c| if corner >> c & 1 == 1 { (grid.size[c] - 1) as f64 } else { 0.0 }));
            for c in 0..3 {
                low[c] = low[c].min(at[c]);
                high[c] = high[c].max(at[c]);
            }
        }
        Self { low, high }
    }

    /// Position of a fraction along each LPS axis.
    pub fn at(&self, fraction: [f64; 3]) -> [f64; 3] {
        std::array::from_fn(|c| self.low[c] + fraction[c] * (self.high[c] - self.low[c]))
    }

    /// Length of the box's diagonal [mm].
    pub fn diagonal(&self) -> f64 {
        distance(self.low, self.high)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn points(list: &[(f64, [f64; 3])]) -> Vec<Waypoint> {
        list.iter().map(|&(time_s, position_mm)| Waypoint { time_s, position_mm, direction: [0.0, 2.0, 0.0] }).collect()
    }

    fn press() -> Waypoints {
        let list = [(0.0, [1.0, 0.0, 0.0]), (1.0, [1.0, 11.0, 0.0]), (2.0, [1.0, 11.0, 0.0]), (3.0, [1.0, 0.0, 0.0])];
        Waypoints::new(points(&list), true, None).unwrap()
    }

    #[test]
    fn the_motion_passes_every_point_and_never_overshoots() {
        let way = press();
        for p in way.points() {
            assert!(distance(way.at(p.time_s).position_mm, p.position_mm) < 1e-9);
        }
        for n in 0..3000 {
            let pose = way.at(n as f64 * 1e-3);
            assert!((-1e-9..=11.0 + 1e-9).contains(&pose.position_mm[1]));
            assert!((pose.position_mm[0] - 1.0).abs() < 1e-9, "a component that stays, stays");
            assert_eq!(pose.direction, [0.0, 1.0, 0.0]);
        }
        assert_eq!(way.at(1.5).position_mm[1], 11.0, "a tool that holds, holds");
    }

    #[test]
    fn velocity_is_the_derivative_of_position_and_continuous_over_the_seam() {
        let list = [(0.5, [0.0, 0.0, 0.0]), (1.0, [3.0, 1.0, -2.0]), (2.5, [4.0, 5.0, 2.0]), (3.0, [9.0, 6.0, 1.0])];
        let way = Waypoints::new(points(&list), true, None).unwrap();
        let h = 1e-5;
        let end = 0.5 + 2.0 * way.period_s();
        let mut t = 0.6;
        while t < end {
            let (a, b, mid) = (way.at(t - h), way.at(t + h), way.at(t));
            for c in 0..3 {
                // central difference of a cubic: error h²·|x'''|/6, and one jump of x'' at a knot: h·|x''|/2, with |x''| < 200 mm/s²
                let difference = (b.position_mm[c] - a.position_mm[c]) / (2.0 * h);
                assert!((difference - mid.velocity_mm_s[c]).abs() < 200.0 * h, "t = {t}, axis {c}");
            }
            t += 0.0137;
        }
    }

    #[test]
    fn a_path_that_does_not_loop_rests_at_its_ends() {
        let way = Waypoints::new(points(&[(1.0, [0.0; 3]), (2.0, [5.0, 0.0, 0.0])]), false, None).unwrap();
        assert_eq!(way.at(-3.0).position_mm, [0.0; 3]);
        assert_eq!(way.at(99.0).position_mm, [5.0, 0.0, 0.0]);
        assert_eq!(way.at(99.0).velocity_mm_s, [0.0; 3]);
        assert!(way.at(f64::NAN).position_mm.iter().all(|x| x.is_finite()));
    }

    #[test]
    fn points_out_of_order_or_not_finite_make_no_path() {
        assert!(Waypoints::new(vec![], true, None).is_none());
        assert!(Waypoints::new(points(&[(1.0, [0.0; 3]), (1.0, [1.0; 3])]), true, None).is_none());
        assert!(Waypoints::new(points(&[(1.0, [f64::NAN; 3])]), true, None).is_none());
        let alone = Waypoints::new(points(&[(0.0, [1.0; 3])]), true, None).unwrap();
        assert_eq!(alone.at(7.3).position_mm, [1.0; 3], "one point is a place to stay");
    }
}
