//! From what a scene says of the tool's way to way points in millimetres on a given volume, and of the camera likewise.
//!
//! An approach looks along its line, from air, for the first place where the value rises above the threshold and stays there
//! for [`SOLID_MM`] (so that a speck of noise or a sheet over the patient is no surface), by steps of [`STEP_MM`]
//! and bisection. Numerics only: the caller brings the box and the sampler (HU at a patient position, none outside).

use crate::{
    error::SceneError,
    path::{BoxMm, Waypoint, Waypoints, distance, unit},
    scene::Scene,
    sections::Rendering,
    tool::{Approach, PathPoint},
};

/// Step of the search for the surface [mm]: below any CT's voxel, so that nothing of a voxel's size is stepped over.
const STEP_MM: f64 = 0.25;
/// A surface has at least so much tissue behind it [mm].
const SOLID_MM: f64 = 2.0;

/// Where the 3D view is seen from.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct View {
    /// [mm, LPS]
    pub eye: [f64; 3],
    /// [mm, LPS]
    pub target: [f64; 3],
    /// unit vector
    pub up: [f64; 3],
    /// vertical angle [degrees]
    pub fov_deg: f64,
}

impl Rendering {
    /// The free camera on a volume's box: as given, or on the direction `from` at the distance that shows the box.
    pub fn view(&self, box_mm: &BoxMm) -> View {
        let target = self.target.unwrap_or_else(|| box_mm.at(self.look_at));
        let away = unit(self.from).unwrap_or([0.0, -1.0, 0.0]);
        // the sphere around the box fills the vertical angle at distance 1
        let far = self.distance * box_mm.diagonal() / 2.0 / (self.fov_deg.to_radians() / 2.0).sin();
        let eye = self.eye.unwrap_or_else(|| std::array::from_fn(|c| target[c] + far * away[c]));
        View { eye, target, up: unit(self.up).unwrap_or([0.0, 0.0, 1.0]), fov_deg: self.fov_deg }
    }
}

impl Scene {
    /// The tool's way on this volume [mm]; none when the scene has no tool. `sample` gives the value (HU) at a patient
    /// position at rest, none outside the volume.
    pub fn resolve_path(&self, box_mm: &BoxMm, sample: impl Fn([f64; 3]) -> Option<f64>) -> Result<Option<Waypoints>, SceneError> {
        let Some(tool) = &self.tool else { return Ok(None) };
        if let Some(at) = self
            .needle
            .target_mm
            .filter(|at| self.has_effect("needle") && (0..3).any(|c| !(box_mm.low[c]..=box_mm.high[c]).contains(&at[c])))
        {
            let help = Some("give a point of the patient at rest, LPS mm; `maille info` tells where the volume lies".into());
            return Err(SceneError::sentence(format!("needle.target_mm {at:?} lies outside the volume"), help));
        }
        let (points, looped) = match &tool.approach {
            Some(approach) if tool.path.is_empty() => (self.approach_points(approach, tool.radius_mm, box_mm, &sample)?, tool.looped),
            _ => (given_points(&tool.path, box_mm), tool.looped),
        };
        match Waypoints::new(points, looped, tool.period_s) {
            Some(way) => Ok(Some(way)),
            None => Err(SceneError::sentence("the tool's way points are empty, out of order or not finite", None)),
        }
    }

    /// Writes a resolved way into the scene, so that whoever is handed the scene's text needs no voxels to follow it (and
    /// a process that restarts does not search again on tissue that has moved).
    pub fn fix_path(&mut self, way: &Waypoints) {
        if let Some(tool) = &mut self.tool {
            let point =
                |p: &Waypoint| PathPoint { time_s: p.time_s, mm: Some(p.position_mm), fraction: None, direction: Some(p.direction) };
            tool.path = way.points().iter().map(point).collect();
            (tool.looped, tool.period_s, tool.approach, tool.elsewhere) = (way.is_looped(), None, None, None);
        }
    }

    fn approach_points(
        &self,
        approach: &Approach,
        radius_mm: f64,
        box_mm: &BoxMm,
        sample: &impl Fn([f64; 3]) -> Option<f64>,
    ) -> Result<Vec<Waypoint>, SceneError> {
        let (from, toward) = (box_mm.at(approach.from), box_mm.at(approach.toward));
        let refuse = |what: &str| {
            let text = |p: [f64; 3]| format!("({:.1}, {:.1}, {:.1})", p[0], p[1], p[2]);
            Err(SceneError::sentence(
                format!("the approach from {} to {} mm {what}", text(from), text(toward)),
                Some("change `from` and `toward` in [tool.approach], or threshold_hu in [deformation]".into()),
            ))
        };
        let Some(direction) = unit(std::array::from_fn(|c| toward[c] - from[c])) else { return refuse("has no length") };
        let threshold = self.deformation.threshold_hu;
        let length = distance(from, toward);
        let sideways = perpendicular(direction);
        let offsets: &[f64] = if approach.lateral_mm > 0.0 { &[0.0, 1.0, -1.0] } else { &[0.0] };
        let mut points = Vec::new();
        for (n, &side) in offsets.iter().enumerate() {
            let start: [f64; 3] = std::array::from_fn(|c| from[c] + side * approach.lateral_mm * sideways[c]);
            let Some(surface) = first_surface(start, direction, length, threshold, sample) else {
                if n > 0 {
                    continue;
                }
                return refuse(&format!("meets no surface at {threshold} HU coming from air"));
            };
            // the tip's front is one radius before its centre
            let centre = |front: f64| std::array::from_fn(|c| start[c] + (surface + front - radius_mm) * direction[c]);
            // a place where no surface was found leaves no gap in time
            let round = (points.len() / 4) as f64;
            for (part, front) in [(0.0, -approach.hover_mm), (0.35, approach.press_mm), (0.6, approach.press_mm), (0.9, -approach.hover_mm)]
            {
                points.push(Waypoint { time_s: (round + part) * approach.period_s, position_mm: centre(front), direction });
            }
        }
        // rest until the period is over, then begin again at the first place
        points.push(Waypoint { time_s: (points.len() / 4) as f64 * approach.period_s, ..points[0] });
        Ok(points)
    }
}

/// Given way points in mm; directions that are not given are the path's first move.
fn given_points(path: &[PathPoint], box_mm: &BoxMm) -> Vec<Waypoint> {
    let at = |p: &PathPoint| p.mm.unwrap_or_else(|| box_mm.at(p.fraction.unwrap_or([0.5; 3])));
    let places: Vec<[f64; 3]> = path.iter().map(at).collect();
    let onward = places.windows(2).find_map(|w| unit(std::array::from_fn(|c| w[1][c] - w[0][c]))).unwrap_or([0.0, 1.0, 0.0]);
    let point = |(p, &position_mm): (&PathPoint, _)| Waypoint { time_s: p.time_s, position_mm, direction: p.direction.unwrap_or(onward) };
    path.iter().zip(&places).map(point).collect()
}

/// Distance from `from` along `direction` to the first surface entered from air, if there is one within `length`.
fn first_surface(
    from: [f64; 3],
    direction: [f64; 3],
    length: f64,
    threshold: f64,
    sample: &impl Fn([f64; 3]) -> Option<f64>,
) -> Option<f64> {
    let inside = |s: f64| sample(std::array::from_fn(|c| from[c] + s * direction[c])).is_some_and(|v| v >= threshold);
    let steps = (length / STEP_MM).ceil() as usize;
    let mut was_air = false;
    for n in 0..=steps {
        let s = n as f64 * STEP_MM;
        if !inside(s) {
            was_air = true;
        } else if was_air && (1..=(SOLID_MM / STEP_MM) as usize).all(|k| inside(s + k as f64 * STEP_MM)) {
            let (mut air, mut tissue) = (s - STEP_MM, s);
            for _ in 0..20 {
                let middle = (air + tissue) / 2.0;
                if inside(middle) { tissue = middle } else { air = middle }
            }
            return Some(tissue);
        }
    }
    None
}

/// A unit vector across a direction: to the patient's left where that is possible.
fn perpendicular(d: [f64; 3]) -> [f64; 3] {
    let along = |axis: [f64; 3]| {
        let dot: f64 = (0..3).map(|c| axis[c] * d[c]).sum();
        unit(std::array::from_fn(|c| axis[c] - dot * d[c]))
    };
    if d[0].abs() < 0.9 { along([1.0, 0.0, 0.0]) } else { along([0.0, 0.0, 1.0]) }.unwrap_or([0.0, 0.0, 1.0])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tool::Tool;

    const BOX: BoxMm = BoxMm { low: [-100.0, -120.0, 0.0], high: [100.0, 120.0, 150.0] };

    /// A ball of water with a speck of noise before it.
    fn ball(at: [f64; 3]) -> Option<f64> {
        if (at[1] + 100.0).abs() < 0.5 {
            return Some(40.0);
        }
        (0..3)
            .all(|c| (BOX.low[c]..=BOX.high[c]).contains(&at[c]))
            .then(|| if distance(at, [0.0, 0.0, 75.0]) < 80.0 { 40.0 } else { -1000.0 })
    }

    fn scene(approach: Approach) -> Scene {
        Scene { tool: Some(Tool { approach: Some(approach), ..Tool::default() }), ..Scene::default() }
    }

    #[test]
    fn an_approach_hovers_and_presses_at_the_surface_it_finds() {
        for lateral_mm in [0.0, 12.0] {
            let approach = Approach { press_mm: 7.0, hover_mm: 5.0, period_s: 2.0, lateral_mm, ..Approach::default() };
            let way = scene(approach).resolve_path(&BOX, ball).unwrap().unwrap();
            let fronts: Vec<f64> = way
                .points()
                .iter()
                .map(|p| {
                    let front: [f64; 3] = std::array::from_fn(|c| p.position_mm[c] + 2.0 * p.direction[c]);
                    // depth along the approach, +y, below the ball's surface at this x
                    front[1] + (80f64.powi(2) - front[0].powi(2)).sqrt()
                })
                .collect();
            for (n, front) in fronts.iter().enumerate() {
                let expected = if matches!(n % 4, 1 | 2) { 7.0 } else { -5.0 };
                // bisection from 0.25 mm, twenty times
                assert!((front - expected).abs() < 1e-5, "point {n}: {front} instead of {expected}");
            }
            assert_eq!(way.period_s(), if lateral_mm > 0.0 { 6.0 } else { 2.0 });
            assert_eq!(way.at(0.0).position_mm, way.at(way.period_s()).position_mm);
        }
    }

    #[test]
    fn an_approach_that_meets_nothing_says_so() {
        let past = Approach { from: [0.0, 0.0, 0.0], toward: [0.0, 1.0, 0.0], ..Approach::default() };
        let error = scene(past).resolve_path(&BOX, |at| ball(at).map(|_| -1000.0)).unwrap_err();
        assert!(error.to_string().contains("meets no surface"), "{error}");
        assert!(error.advice().is_some());
    }

    #[test]
    fn a_fixed_path_is_the_same_motion_without_the_voxels() {
        let mut scene = scene(Approach { lateral_mm: 8.0, ..Approach::default() });
        let way = scene.resolve_path(&BOX, ball).unwrap().unwrap();
        scene.fix_path(&way);
        let read = Scene::parse("handed over", &scene.to_toml()).unwrap();
        let again = read.resolve_path(&BOX, |_| panic!("no voxel is needed")).unwrap().unwrap();
        for n in 0..500 {
            let t = n as f64 * 0.03;
            assert!(distance(way.at(t).position_mm, again.at(t).position_mm) < 1e-9, "t = {t}");
        }
    }

    #[test]
    fn the_camera_frames_the_box_or_stands_where_it_is_told() {
        let view = Rendering { from: [0.0, -1.0, 0.0], distance: 1.0, ..Rendering::default() }.view(&BOX);
        assert_eq!(view.target, [0.0, 0.0, 75.0]);
        // the sphere around the box touches the cone of view
        let far = distance(view.eye, view.target);
        assert!((far * 15f64.to_radians().sin() - BOX.diagonal() / 2.0).abs() < 1e-9);
        let told = Rendering { eye: Some([1.0, 2.0, 3.0]), ..Rendering::default() }.view(&BOX);
        assert_eq!(told.eye, [1.0, 2.0, 3.0]);
    }
}
