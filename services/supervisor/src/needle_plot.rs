//! The forces of a needle as a picture beside the report: force over time, its parts, the depth of the path, and where layers gave way. SVG without
//! scripts, so that any browser or viewer shows it.
//!
//! Upper panel: the force on the hand against the insertion with its parts [N]; lower panel: depth of the path [mm]. Vertical lines are punctures, red ones of
//! what is forbidden, each with the phase of the breath. Not here: gathering ([`crate::trace`]).

use crate::needle::NeedleReport;
use std::fmt::Write as _;

const WIDTH: f64 = 1000.0;
const LEFT: f64 = 64.0;
const RIGHT: f64 = 980.0;
/// top and bottom of the panels
const FORCES: [f64; 2] = [110.0, 420.0];
const DEPTH: [f64; 2] = [460.0, 600.0];

/// A round step that makes about `count` of a range.
fn step(range: f64, count: f64) -> f64 {
    let rough = (range / count).max(1e-9);
    let power = 10f64.powf(rough.log10().floor());
    [1.0, 2.0, 5.0, 10.0].into_iter().map(|m| m * power).find(|s| *s >= rough * 0.999).unwrap_or(10.0 * power)
}

/// A panel: values from `low` to `high` over its height.
struct Panel {
    edges: [f64; 2],
    low: f64,
    high: f64,
    /// between lines
    step: f64,
}

impl Panel {
    fn of(edges: [f64; 2], values: impl Iterator<Item = f64>) -> Self {
        let (low, high) = values.fold((0.0f64, 0.0f64), |(l, h), v| (l.min(v), h.max(v)));
        let step = step((high - low).max(1e-3), 5.0);
        Self { edges, low: (low / step).floor() * step, high: ((high / step).ceil() * step).max(step), step }
    }

    fn y(&self, v: f64) -> f64 {
        self.edges[1] - (self.edges[1] - self.edges[0]) * (v - self.low) / (self.high - self.low)
    }

    fn axis(&self, svg: &mut String, name: &str) {
        let step = self.step;
        let mut n = (self.low / step).round();
        while n * step <= self.high + 1e-9 {
            let (v, y) = (n * step, self.y(n * step));
            let colour = if n == 0.0 { "#999" } else { "#e4e4e4" };
            let digits = if step < 1.0 { 1 } else { 0 };
            let _ = writeln!(svg, "<path d='M{LEFT} {y:.1}H{RIGHT}' stroke='{colour}'/>");
            let _ = writeln!(svg, "<text x='{}' y='{:.1}' text-anchor='end'>{v:.digits$}</text>", LEFT - 6.0, y + 4.0);
            n += 1.0;
        }
        let _ = writeln!(svg, "<text x='8' y='{:.1}'>{name}</text>", self.edges[0] - 8.0);
    }
}

fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;")
}

/// The picture.
pub(crate) fn svg(scene: &str, needle: &NeedleReport) -> String {
    let t = &needle.trace;
    let (first, last) = (t.time_s.first().copied().unwrap_or(0.0), t.time_s.last().copied().unwrap_or(1.0));
    let span = (last - first).max(1e-3);
    let x = |time: f64| LEFT + (RIGHT - LEFT) * (time - first) / span;
    let curves = [
        ("force against the insertion", "#1f3f78", 1.8, &t.along_n),
        ("cutting", "#c0392b", 1.0, &t.cutting_n),
        ("friction", "#218c5a", 1.0, &t.friction_n),
        ("across, at the base", "#b07d12", 1.0, &t.base_n),
    ];
    let forces = Panel::of(FORCES, curves.iter().flat_map(|c| c.3.iter().copied()));
    let depth = Panel::of(DEPTH, t.depth_mm.iter().copied());
    let mut svg =
        format!("<svg xmlns='http://www.w3.org/2000/svg' width='{WIDTH}' height='650' font-family='sans-serif' font-size='12'>\n");
    let target = needle.deepest_to_target_mm.map_or(String::new(), |mm| format!("; at the deepest {mm:.1} mm from the target's middle"));
    let _ =
        writeln!(svg, "<rect width='{WIDTH}' height='650' fill='white'/><text x='{LEFT}' y='24' font-size='15'>{}</text>", escaped(scene));
    let _ = writeln!(
        svg,
        "<text x='{LEFT}' y='44' fill='#444'>at most {:.2} N and {:.0} N·mm, {:.1} mm deep{target}</text>",
        needle.peak_force_n, needle.peak_torque_n_mm, needle.deepest_mm
    );
    forces.axis(&mut svg, "force [N]");
    depth.axis(&mut svg, "depth of the path [mm]");
    let seconds = step(span, 10.0);
    let mut n = (first / seconds).ceil();
    while n * seconds <= last {
        let at = x(n * seconds);
        let _ = writeln!(svg, "<path d='M{at:.1} {}V{}M{at:.1} {}V{}' stroke='#e4e4e4'/>", FORCES[0], FORCES[1], DEPTH[0], DEPTH[1]);
        let digits = if seconds < 1.0 { 1 } else { 0 };
        let _ = writeln!(svg, "<text x='{at:.1}' y='{}' text-anchor='middle'>{:.digits$}</text>", DEPTH[1] + 16.0, n * seconds);
        n += 1.0;
    }
    let _ = writeln!(svg, "<text x='{:.1}' y='{}' text-anchor='middle'>time [s]</text>", 0.5 * (LEFT + RIGHT), DEPTH[1] + 36.0);
    for (k, event) in needle.events.iter().filter(|e| e.what == "punctured" && (first..=last).contains(&e.time_s)).enumerate() {
        let (at, colour) = (x(event.time_s), if event.forbidden { "#d11" } else { "#777" });
        let phase = event.breath_phase.map_or(String::new(), |p| format!(" ({p:.2})"));
        let _ = writeln!(svg, "<path d='M{at:.1} {}V{}' stroke='{colour}' stroke-dasharray='3 3'/>", FORCES[0], DEPTH[1]);
        let y = FORCES[0] + 12.0 + 12.0 * (k % 8) as f64;
        let _ = writeln!(svg, "<text x='{:.1}' y='{y}' fill='{colour}' font-size='10'>{}{phase}</text>", at + 3.0, escaped(&event.tissue));
    }
    for (k, (name, colour, width, values)) in curves.iter().enumerate() {
        let _ = writeln!(svg, "<text x='{:.0}' y='70' fill='{colour}'>{name}</text>", LEFT + 200.0 * k as f64);
        line(&mut svg, colour, *width, t.time_s.iter().zip(*values).map(|(time, v)| [x(*time), forces.y(*v)]));
    }
    line(&mut svg, "#1f3f78", 1.4, t.time_s.iter().zip(&t.depth_mm).map(|(time, v)| [x(*time), depth.y(*v)]));
    svg.push_str("</svg>\n");
    svg
}

fn line(svg: &mut String, colour: &str, width: f64, points: impl Iterator<Item = [f64; 2]>) {
    let points: Vec<String> = points.map(|[x, y]| format!("{x:.1},{y:.1}")).collect();
    let _ = writeln!(svg, "<polyline fill='none' stroke='{colour}' stroke-width='{width}' points='{}'/>", points.join(" "));
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn steps_are_round_and_cover_the_range() {
        for range in [0.03, 0.7, 1.0, 3.3, 9.9, 27.0, 640.0] {
            let s = step(range, 5.0);
            assert!(range / s <= 5.01 && range / s > 1.9, "{range}: {s}");
        }
        assert_eq!((step(27.0, 10.0), step(3.3, 5.0)), (5.0, 1.0));
        let panel = Panel::of([0.0, 100.0], [0.2, -0.4, 3.1].into_iter());
        assert!(
            (panel.low / panel.step).fract().abs() < 1e-9
                && panel.low <= -0.4
                && panel.high >= 3.1
                && panel.y(panel.low) == 100.0
                && panel.y(panel.high) == 0.0
        );
    }
}
