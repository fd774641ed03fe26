//! Charts as inline SVG: error over time, and bars. Colours come from the page's style, so that light and dark both read well.

use crate::{
    curve::number,
    measure::{MeasuredSubject, Point},
};
use std::fmt::Write as _;

/// Text that HTML and SVG take as text.
pub(crate) fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

/// An axis: numbers to pixels.
struct Axis {
    low: f64,
    high: f64,
    log: bool,
    pixels: [f64; 2],
}

impl Axis {
    /// An axis that shows these numbers; logarithmic where they span more than a factor of six and all are above nought.
    fn new(values: impl Iterator<Item = f64> + Clone, pixels: [f64; 2]) -> Self {
        let known = values.filter(|v| v.is_finite());
        let (low, high) = known.clone().fold((f64::INFINITY, f64::NEG_INFINITY), |m, v| (m.0.min(v), m.1.max(v)));
        let (low, high) = if low.is_finite() { (low, high) } else { (0.0, 1.0) };
        let log = low > 0.0 && high > 6.0 * low;
        if log {
            let room = (high / low).powf(0.08);
            return Self { low: low / room, high: high * room, log, pixels };
        }
        // numbers that are nearly the same get an axis that says so
        let span = (high - low).max(0.1 * high.abs()).max(1e-12);
        let low = if low >= 0.0 && low < 0.5 * high { 0.0 } else { low - 0.15 * span };
        Self { low, high: high + 0.12 * span, log, pixels }
    }

    fn at(&self, value: f64) -> f64 {
        let share =
            if self.log { (value / self.low).ln() / (self.high / self.low).ln() } else { (value - self.low) / (self.high - self.low) };
        self.pixels[0] + share.clamp(-0.02, 1.02) * (self.pixels[1] - self.pixels[0])
    }

    /// Where lines stand: 1, 2 and 5 times powers of ten, fewer where they would crowd.
    fn ticks(&self) -> Vec<f64> {
        let inside = |v: &f64| (self.low..=self.high).contains(v);
        if self.log {
            let (from, to) = (self.low.log10().floor() as i32, self.high.log10().ceil() as i32);
            let decades = (self.high / self.low).log10();
            let steps: &[f64] = if decades > 3.5 {
                &[1.0]
            } else if decades > 1.6 {
                &[1.0, 3.0]
            } else {
                &[1.0, 2.0, 5.0]
            };
            return (from..=to).flat_map(|e| steps.iter().map(move |s| s * 10f64.powi(e))).filter(inside).collect();
        }
        let rough = (self.high - self.low) / 5.0;
        let power = 10f64.powf(rough.log10().floor());
        let step = power * [1.0, 2.0, 5.0, 10.0].into_iter().find(|s| s * power >= rough).unwrap_or(10.0);
        let first = (self.low / step).ceil() as i64;
        (first..)
            .map(|n| n as f64 * step)
            .take_while(|v| *v <= self.high * (1.0 + 1e-9))
            .map(|v| if v.abs() < 1e-12 { 0.0 } else { v })
            .collect()
    }
}

const WIDTH: f64 = 560.0;
const HEIGHT: f64 = 360.0;
const LEFT: f64 = 66.0;
const RIGHT: f64 = 18.0;
const TOP: f64 = 30.0;
const BOTTOM: f64 = 48.0;

/// A box on the page that text may not cover.
type Area = [f64; 4];

fn overlaps(a: &Area, b: &Area) -> bool {
    a[0] < b[2] && b[0] < a[2] && a[1] < b[3] && b[1] < a[3]
}

/// Width of small text [px], about.
fn width_of(text: &str) -> f64 {
    6.1 * text.chars().count() as f64
}

/// Error over time: a line a series, the front, the settings of draft, balanced and reference.
pub(crate) fn scatter(subject: &MeasuredSubject, unit: &str) -> String {
    let points = &subject.points;
    // a logarithmic axis has no place for nought: such points stand on its lower end
    let least = points.iter().map(|p| p.error).filter(|e| *e > 0.0).fold(f64::INFINITY, f64::min);
    let positive = |e: f64| if e > 0.0 || !least.is_finite() { e } else { least };
    let x = Axis::new(points.iter().map(|p| p.ratio.median), [LEFT, WIDTH - RIGHT]);
    let y = Axis::new(points.iter().map(|p| positive(p.error)), [HEIGHT - BOTTOM, TOP]);
    let place = |p: &Point| (x.at(p.ratio.median), y.at(positive(p.error)));
    let mut lines: Vec<&str> = Vec::new();
    for p in points.iter().filter(|p| p.error.is_finite()) {
        if !lines.contains(&p.line) {
            lines.push(p.line);
        }
    }
    let colour = |line: &str| 1 + lines.iter().position(|l| *l == line).unwrap_or(0) % 4;

    let mut out =
        format!("<svg viewBox=\"0 0 {WIDTH} {HEIGHT}\" role=\"img\" aria-label=\"error over time, {}\">", escaped(&subject.subject));
    grid(&mut out, &x, &y);
    let middle = (LEFT + WIDTH - RIGHT) / 2.0;
    let _ = write!(out, "<text class=\"axis\" x=\"{middle}\" y=\"{}\" text-anchor=\"middle\">time, over reference's</text>", HEIGHT - 10.0);
    let _ = write!(out, "<text class=\"axis\" x=\"{LEFT}\" y=\"{}\">error [{}]</text>", TOP - 14.0, escaped(unit));

    // the front: nothing measured lies below and left of it
    let mut on: Vec<&Point> = points.iter().filter(|p| p.front).collect();
    on.sort_by(|a, b| a.ratio.median.total_cmp(&b.ratio.median));
    if let Some(first) = on.first() {
        let mut path = format!("M{:.1},{TOP:.1}V{:.1}", place(first).0, place(first).1);
        on.iter().skip(1).for_each(|p| {
            let _ = write!(path, "H{:.1}V{:.1}", place(p).0, place(p).1);
        });
        let _ = write!(out, "<path class=\"front\" d=\"{path}H{:.1}\"/>", WIDTH - RIGHT);
    }
    let mut taken: Vec<Area> = Vec::new();
    for line in &lines {
        let own: Vec<&Point> = points.iter().filter(|p| p.line == *line && p.error.is_finite()).collect();
        let path: Vec<String> = own.iter().map(|p| format!("{:.1},{:.1}", place(p).0, place(p).1)).collect();
        let _ = write!(out, "<polyline class=\"line s{}\" points=\"{}\"/>", colour(line), path.join(" "));
    }
    for p in points.iter().filter(|p| p.error.is_finite()) {
        let (px, py) = place(p);
        taken.push([px - 6.0, py - 6.0, px + 6.0, py + 6.0]);
        let (q1, q3) = (x.at(p.ratio.q1), x.at(p.ratio.q3));
        let s = colour(p.line);
        let told = format!("{} {}: error {} {unit}, time × {}", p.line, p.label, number(p.error), number(p.ratio.median));
        let _ = write!(out, "<g><title>{}</title><path class=\"spread s{s}\" d=\"M{q1:.1},{py:.1}H{q3:.1}\"/>", escaped(told.trim()));
        if !p.accuracy.is_empty() {
            let _ = write!(out, "<circle class=\"mark\" cx=\"{px:.1}\" cy=\"{py:.1}\" r=\"8\"/>");
        }
        let kind = if p.front { "on" } else { "off" };
        let _ = write!(out, "<circle class=\"{kind} s{s}\" cx=\"{px:.1}\" cy=\"{py:.1}\" r=\"4\"/></g>");
    }
    legend(&mut out, &lines, &mut taken);
    // marked settings first: they must be named; where there is no room for another's name the table has it
    let mut order: Vec<&Point> = points.iter().filter(|p| p.error.is_finite()).collect();
    order.sort_by_key(|p| (p.accuracy.is_empty(), !p.front));
    for p in order {
        let words = if p.accuracy.is_empty() { String::new() } else { format!(" {}", p.accuracy.join(", ")) };
        let text = format!("{}{words}", p.label);
        let (px, py) = place(p);
        let w = width_of(&text);
        let choices = [
            (9.0, -5.0),
            (9.0, 14.0),
            (-9.0 - w, -5.0),
            (-9.0 - w, 14.0),
            (-w / 2.0, -12.0),
            (-w / 2.0, 21.0),
            (12.0, 4.0),
            (-12.0 - w, 4.0),
        ];
        let area = |(dx, dy): (f64, f64)| [px + dx, py + dy - 10.0, px + dx + w, py + dy + 2.0];
        let free = |a: &Area| {
            a[0] > LEFT && a[2] < WIDTH - 2.0 && a[1] > TOP - 8.0 && a[3] < HEIGHT - BOTTOM && !taken.iter().any(|t| overlaps(a, t))
        };
        if let Some(choice) = choices.into_iter().find(|c| free(&area(*c))) {
            let a = area(choice);
            taken.push(a);
            // where lines cross, a name has its line's colour
            let tint = if lines.len() > 1 { format!(" t{}", colour(p.line)) } else { String::new() };
            let class = if p.accuracy.is_empty() { "label" } else { "label marked" };
            let _ = write!(out, "<text class=\"{class}{tint}\" x=\"{:.1}\" y=\"{:.1}\">{}</text>", a[0], a[3] - 2.0, escaped(&text));
        }
    }
    out + "</svg>"
}

fn grid(out: &mut String, x: &Axis, y: &Axis) {
    for v in y.ticks() {
        let at = y.at(v);
        let _ = write!(out, "<path class=\"grid\" d=\"M{LEFT},{at:.1}H{}\"/>", WIDTH - RIGHT);
        let _ = write!(out, "<text class=\"tick\" x=\"{}\" y=\"{:.1}\" text-anchor=\"end\">{}</text>", LEFT - 6.0, at + 4.0, number(v));
    }
    for v in x.ticks() {
        let at = x.at(v);
        let _ = write!(out, "<path class=\"grid\" d=\"M{at:.1},{TOP}V{}\"/>", HEIGHT - BOTTOM);
        let _ =
            write!(out, "<text class=\"tick\" x=\"{at:.1}\" y=\"{}\" text-anchor=\"middle\">{}</text>", HEIGHT - BOTTOM + 16.0, number(v));
    }
}

/// Names of the lines, at the top right, where there is more than one.
fn legend(out: &mut String, lines: &[&str], taken: &mut Vec<Area>) {
    if lines.len() < 2 {
        return;
    }
    let mut right = WIDTH - RIGHT;
    for (n, line) in lines.iter().enumerate().rev() {
        let w = width_of(line);
        let _ = write!(
            out,
            "<circle class=\"on s{}\" cx=\"{:.1}\" cy=\"{}\" r=\"4\"/><text class=\"label\" x=\"{:.1}\" y=\"{}\">{}</text>",
            1 + n % 4,
            right - w - 8.0,
            TOP - 18.0,
            right - w,
            TOP - 14.0,
            escaped(line)
        );
        taken.push([right - w - 14.0, TOP - 26.0, right, TOP - 10.0]);
        right -= w + 26.0;
    }
}

/// Bars from nought, one a row, a lighter part up to a second number: p50 and p99.
pub(crate) fn bars(title: &str, unit: &str, rows: &[(String, f64, Option<f64>)]) -> String {
    const ROW: f64 = 24.0;
    const NAMES: f64 = 128.0;
    let height = 34.0 + ROW * rows.len() as f64 + 8.0;
    let all = rows.iter().flat_map(|(_, a, b)| [*a, b.unwrap_or(*a)]).filter(|v| v.is_finite());
    let (low, high) = all.fold((0.0f64, 0.0f64), |m, v| (m.0.min(v), m.1.max(v)));
    let (low, high) = if high > low { (low, high) } else { (0.0, 1.0) };
    let words = |(_, value, upper): &(String, f64, Option<f64>)| {
        upper.map_or(number(*value), |u| format!("{}, p99 {}", number(*value), number(u))).replace('-', "−")
    };
    let room = rows.iter().map(|r| width_of(&words(r))).fold(40.0, f64::max);
    let (from, to) = (NAMES + 6.0, WIDTH - room - 8.0);
    let at = |v: f64| from + (v - low) / (high - low) * (to - from);
    let mut out = format!("<svg viewBox=\"0 0 {WIDTH} {height}\" role=\"img\" aria-label=\"{}\">", escaped(title));
    let _ = write!(out, "<text class=\"axis\" x=\"0\" y=\"14\">{} [{}]</text>", escaped(title), escaped(unit));
    let _ = write!(out, "<path class=\"grid\" d=\"M{:.1},24V{height}\"/>", at(0.0));
    for (n, row) in rows.iter().enumerate() {
        let (name, value, upper) = row;
        let y = 30.0 + ROW * n as f64;
        let _ = write!(out, "<text class=\"tick\" x=\"{NAMES}\" y=\"{}\" text-anchor=\"end\">{}</text>", y + 13.0, escaped(name));
        let mut bar = |v: f64, class: &str, thick: f64| {
            let (a, b) = (at(0.0).min(at(v)), at(0.0).max(at(v)));
            let _ = write!(
                out,
                "<rect class=\"{class}\" x=\"{a:.1}\" y=\"{:.1}\" width=\"{:.1}\" height=\"{thick}\"/>",
                y + (18.0 - thick) / 2.0,
                (b - a).max(1.0)
            );
        };
        if let Some(upper) = upper {
            bar(*upper, "bar light", 8.0);
        }
        bar(*value, "bar", 16.0);
        let text = words(row);
        let end = at(upper.unwrap_or(*value).max(*value).max(0.0));
        let _ = write!(out, "<text class=\"label\" x=\"{:.1}\" y=\"{}\">{text}</text>", end + 5.0, y + 13.0);
    }
    out + "</svg>"
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ticks_are_round_and_inside_and_few() {
        for values in [[0.0, 1.0], [0.3, 0.35], [1e-4, 2.0], [3.0, 40.0], [5.0, 5.0], [-2.0, 7.0]] {
            let axis = Axis::new(values.iter().copied(), [0.0, 100.0]);
            let ticks = axis.ticks();
            assert!((2..=12).contains(&ticks.len()), "{values:?}: {ticks:?}");
            assert!(ticks.iter().all(|t| (axis.low..=axis.high * 1.0001).contains(t)), "{values:?}: {ticks:?}");
            assert!(values.iter().all(|v| (0.0..=100.0).contains(&axis.at(*v))));
        }
    }

    #[test]
    fn text_cannot_become_markup() {
        assert_eq!(escaped("a<b> & \"c\""), "a&lt;b&gt; &amp; &quot;c&quot;");
    }
}
