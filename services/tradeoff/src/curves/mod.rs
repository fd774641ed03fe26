//! All curves, engine by engine. A new engine adds a file here and a line in [`all`].

mod chainmail;
mod contact;
mod displacement;
mod mapper;
mod motion;
mod needle;
mod raycast;
mod ultrasound;
mod vif;
mod warp;

use crate::curve::Curve;

/// Every curve there is, in the order of the report.
pub fn all() -> impl Iterator<Item = &'static Curve> {
    [
        chainmail::CURVES,
        mapper::CURVES,
        displacement::CURVES,
        motion::CURVES,
        raycast::CURVES,
        warp::CURVES,
        ultrasound::CURVES,
        vif::CURVES,
        contact::CURVES,
        needle::CURVES,
    ]
    .into_iter()
    .flatten()
}

/// Mean and largest of errors.
fn mean_and_worst(errors: impl Iterator<Item = f64>) -> [f64; 2] {
    let (mut sum, mut worst, mut count) = (0.0, 0.0f64, 0.0);
    for e in errors {
        (sum, worst, count) = (sum + e, worst.max(e), count + 1.0);
    }
    [sum / f64::max(count, 1.0), worst]
}

/// Root of the mean square, and largest.
fn rms_and_worst(errors: impl Iterator<Item = f64>) -> [f64; 2] {
    let (mut sum, mut worst, mut count) = (0.0, 0.0f64, 0.0);
    for e in errors {
        (sum, worst, count) = (sum + e * e, worst.max(e.abs()), count + 1.0);
    }
    [(sum / f64::max(count, 1.0)).sqrt(), worst]
}

/// Distance of two points.
fn distance(a: [f64; 3], b: [f64; 3]) -> f64 {
    (0..3).map(|c| (a[c] - b[c]).powi(2)).sum::<f64>().sqrt()
}
