//! Figure 5 of Fortmeier et al. 2015 drawn again: force against depth (upper), force against time with and without breathing (lower).
//!
//! `cargo run --release -p maille-needle --example figure5 -- DIR` writes upper.csv, lower.csv, upper.svg and lower.svg into DIR. Δp is 5 mm, which the
//! paper does not give: the plateau's slope is R/Δp = 0.005 N/mm.

#![allow(clippy::disallowed_macros, clippy::disallowed_methods, reason = "tests and examples print what they found and take the time")]

use maille_needle::gauge::MEASURED_16G_N_MM2;
use maille_needle::{Breathing, Gauge, HandlePose, Inputs, Material, MaterialTable, NeedleConfig, NeedleTool, RodParameters};
use std::fmt::Write as _;
use std::path::Path;

const TICK_S: f64 = 1e-3;
const LENGTH_MM: f64 = 150.0;

/// Liver under the diaphragm: little motion at the skin, all of it 120 mm deep, along the needle and a fifth of it across.
struct Breath {
    amplitude_mm: f64,
    time_s: f64,
}

impl Breathing for Breath {
    fn displacement(&self, x: [f64; 3]) -> [f64; 3] {
        let t = (x[2] / 120.0).clamp(0.0, 1.0);
        let u = self.amplitude_mm * (std::f64::consts::PI * self.time_s / 4.0).sin().powi(2) * (0.1 + 0.9 * t * t * (3.0 - 2.0 * t));
        [0.2 * u, 0.1 * u, u]
    }
}

/// Depth of the hand and the force along the insertion, of each tick.
fn run(material: Material, amplitude_mm: f64, seconds: f64, depth: impl Fn(f64) -> f64) -> Vec<[f64; 3]> {
    let gauge = Gauge::of(16).expect("16 is a gauge").with_bending(MEASURED_16G_N_MM2);
    let config = NeedleConfig { max_force_n: 10.0, ..NeedleConfig::new(RodParameters::new(&gauge, LENGTH_MM)) };
    let mut tool = NeedleTool::new(config, MaterialTable::new(&[material]).expect("a table")).expect("a needle");
    (0..(seconds / TICK_S) as usize)
        .map(|n| {
            let t = n as f64 * TICK_S;
            let handle = HandlePose::pointing([0.0, 0.0, depth(t)], [0.0, 0.0, 1.0], LENGTH_MM).expect("a direction");
            let tissue = |x: [f64; 3]| u8::from(x[2] >= 0.0);
            let breathing = Breath { amplitude_mm, time_s: t };
            let out = tool.tick(&Inputs { dt_s: TICK_S, handle, held: true, breathing: &breathing, tissue: &tissue });
            [t, depth(t), -out.force_n[2]]
        })
        .collect()
}

/// Round numbers from low to high, a handful.
fn round_steps(low: f64, high: f64) -> Vec<f64> {
    let rough = (high - low) / 8.0;
    let ten = 10f64.powf(rough.log10().floor());
    let step = [1.0, 2.0, 5.0, 10.0].map(|m| m * ten).into_iter().find(|s| *s >= rough).unwrap_or(10.0 * ten);
    let decimals = 10f64.powf((-step.log10()).ceil().max(0.0));
    ((low / step).ceil() as i64..=(high / step).floor() as i64).map(|n| (n as f64 * step * decimals).round() / decimals).collect()
}

/// Curves as an SVG with axes.
fn plot(path: &Path, title: &str, x_name: &str, curves: &[(&str, &str, Vec<[f64; 2]>)]) -> std::io::Result<()> {
    let all = || curves.iter().flat_map(|c| &c.2);
    let range = |k: usize| all().map(|p| p[k]).fold((f64::MAX, f64::MIN), |(l, h), v| (l.min(v), h.max(v)));
    let ((x0, x1), (y0, y1)) = (range(0), range(1));
    let (y0, y1) = (y0 - 0.1 * (y1 - y0), y1 + 0.1 * (y1 - y0));
    let (px, py) = (|x: f64| 60.0 + 700.0 * (x - x0) / (x1 - x0), |y: f64| 360.0 - 320.0 * (y - y0) / (y1 - y0));
    let mut svg =
        String::from("<svg xmlns='http://www.w3.org/2000/svg' width='800' height='420' font-family='sans-serif' font-size='12'>\n");
    let _ = writeln!(svg, "<rect width='800' height='420' fill='white'/><text x='60' y='24' font-size='15'>{title}</text>");
    for x in round_steps(x0, x1) {
        let _ = writeln!(svg, "<path d='M{0:.1} 40V360' stroke='#ddd'/><text x='{0:.1}' y='376' text-anchor='middle'>{x}</text>", px(x));
    }
    for y in round_steps(y0, y1) {
        let _ = writeln!(
            svg,
            "<path d='M60 {0:.1}H760' stroke='#ddd'/><text x='54' y='{1:.1}' text-anchor='end'>{y}</text>",
            py(y),
            py(y) + 4.0
        );
    }
    let _ = writeln!(svg, "<text x='410' y='400' text-anchor='middle'>{x_name}</text>");
    let _ = writeln!(svg, "<text x='16' y='200' text-anchor='middle' transform='rotate(-90 16 200)'>force [N]</text>");
    for (n, (name, colour, points)) in curves.iter().enumerate() {
        let line: Vec<String> = points.iter().step_by(20).map(|p| format!("{:.1},{:.1}", px(p[0]), py(p[1]))).collect();
        let _ = writeln!(svg, "<polyline fill='none' stroke='{colour}' stroke-width='1.4' points='{}'/>", line.join(" "));
        let _ = writeln!(svg, "<text x='{}' y='24' fill='{colour}'>{name}</text>", 480 + 150 * n);
    }
    svg.push_str("</svg>\n");
    std::fs::write(path, svg)
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let folder = std::env::args().nth(1).ok_or("give a directory for the plots")?;
    let folder = Path::new(&folder);
    std::fs::create_dir_all(folder)?;
    let upper = run(Material::LIVER, 0.0, 18.0, |t| 5.0 * t - 1.0);
    let lower_path = |t: f64| match t {
        t if t < 10.0 => -2.0 + 5.2 * t,
        t if t < 15.0 => 50.0,
        t if t < 19.0 => 50.0 + 5.0 * (t - 15.0),
        t if t < 24.0 => 70.0,
        t => 70.0 - 8.0 * (t - 24.0),
    };
    let still = run(Material::LIVER_TRAINING, 0.0, 34.0, lower_path);
    let breathing = run(Material::LIVER_TRAINING, 10.0, 34.0, lower_path);
    let mut csv = String::from("depth_mm,force_n\n");
    upper.iter().for_each(|p| _ = writeln!(csv, "{},{}", p[1], p[2]));
    std::fs::write(folder.join("upper.csv"), csv)?;
    let mut csv = String::from("time_s,depth_mm,still_n,breathing_n\n");
    still.iter().zip(&breathing).for_each(|(a, b)| _ = writeln!(csv, "{},{},{},{}", a[0], a[1], a[2], b[2]));
    std::fs::write(folder.join("lower.csv"), csv)?;
    let curve = |run: &[[f64; 3]], x: usize| run.iter().map(|p| [p[x], p[2]]).collect();
    plot(&folder.join("upper.svg"), "needle into liver, capsule 2.5 N", "depth of the hand [mm]", &[("", "#1f5fa8", curve(&upper, 1))])?;
    let curves = [("at rest", "#1f5fa8", curve(&still, 0)), ("breathing", "#c0392b", curve(&breathing, 0))];
    plot(&folder.join("lower.svg"), "in, rest, further in, rest, out", "time [s]", &curves)?;
    println!("wrote upper and lower, .csv and .svg, into {}", folder.display());
    Ok(())
}
