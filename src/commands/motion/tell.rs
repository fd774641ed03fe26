//! What `maille motion fit` says of its fields and of the model.

use super::{Filtered, FitArgs, Fitted, kind_name, places, reference};
use maille_motion::quality::{BoneQuality, LARGE_MM3, LandmarkErrors, Lengths, Quality};
use serde_json::{Value, json};

impl Fitted {
    /// Says it all, as text or as JSON.
    pub(super) fn tell(&self, args: &FitArgs) {
        let folded: Vec<String> = self
            .qualities
            .iter()
            .enumerate()
            .filter(|(_, q)| q.folded > 0)
            .map(|(n, q)| format!("{} of phase {}", q.folded, n + 1))
            .collect();
        if !folded.is_empty() {
            eprintln!(
                "maille: tissue is folded (det J at most 0) in cells: {}; there several rest positions lie behind one place",
                folded.join(", ")
            );
        }
        if args.json { println!("{}", self.to_json(args)) } else { self.print(args) }
    }

    /// Mean RMS of the registered phases [HU].
    fn mean_rms_hu(&self, args: &FitArgs) -> Option<f64> {
        let judged = self.qualities.iter().enumerate().filter(|(n, _)| *n != reference(args)).filter_map(|(_, q)| Some(q.rms_hu?[1]));
        let judged: Vec<f64> = judged.collect();
        (!judged.is_empty()).then(|| judged.iter().sum::<f64>() / judged.len() as f64)
    }

    fn to_json(&self, args: &FitArgs) -> Value {
        let model = &self.model;
        let phases = self.qualities.iter().zip(&self.landmarks).enumerate();
        let phases = phases.map(|(n, (q, l))| describe(n, q, l.as_ref(), self.signals.as_ref().map(|s| &s[n])));
        json!({
            "output": args.output.display().to_string(),
            "kind": kind_name(model.kind()),
            "places": places(model.kind()),
            "phases": phases.collect::<Vec<_>>(),
            "used_phases": self.used.iter().map(|n| n + 1).collect::<Vec<_>>(),
            "reference": args.reference.or(self.images.then_some(1)),
            "mean_rms_hu": self.mean_rms_hu(args),
            "pca": self.filtered.as_ref().map(|Filtered { report, mean_rms_hu, folded }| json!({
                "components": report.components, "kept": report.kept, "shares": report.shares, "removed_mm": report.removed_mm,
                "mean_rms_hu": mean_rms_hu, "folded_cells": folded,
            })),
            "size": model.grid().size,
            "spacing": model.grid().spacing,
            "fields": model.fields().len(),
            "size_bytes": model.size_bytes(),
            "storage_error_mm": model.fields().iter().map(|f| f.error_mm()).fold(0.0, f32::max),
            "coarse_error_mm": self.coarse.map(|e| json!({ "p99": e.p99_mm, "worst": e.worst_mm })),
            "seconds": self.seconds,
        })
    }

    fn print(&self, args: &FitArgs) {
        for (n, (q, landmarks)) in self.qualities.iter().zip(&self.landmarks).enumerate() {
            if n == reference(args) && (self.images || args.reference.is_some()) {
                println!("phase {:2}: reference", n + 1);
                continue;
            }
            let rms = q.rms_hu.map_or(String::new(), |[before, after]| format!("RMS {before:.1} → {after:.1} HU, "));
            println!(
                "phase {:2}: {rms}up to {:.1} mm, det J {:.3} … {:.3}, {} cells folded, {} nodes without inverse, of the others back within {:.3} mm (p95 {:.4})",
                n + 1,
                q.longest_mm,
                q.determinant[0],
                q.determinant[1],
                q.folded,
                q.without_inverse,
                q.way_back_mm.worst,
                q.way_back_mm.p95
            );
            if let Some(worst) = softest(&q.bones) {
                let [x, y, z] = worst.center;
                println!(
                    "          bones of {} ml and more: {}, the softest det J {:.3} … {:.3} (5 to 95 %; {:.1} ml about {x:.0}, {y:.0}, {z:.0} mm)",
                    LARGE_MM3 / 1000.0,
                    q.bones.len(),
                    worst.determinant[0],
                    worst.determinant[1],
                    worst.mm3 / 1000.0
                );
            }
            if let Some(c) = q.consistency_mm {
                println!(
                    "          there and back again, registered both ways: mean {:.2} mm, p95 {:.2}, worst {:.2}",
                    c.mean, c.p95, c.worst
                );
            }
            if let Some(l) = landmarks {
                let outside = if l.outside > 0 { format!(" ({} outside)", l.outside) } else { String::new() };
                let told = |l: &Lengths| format!("{:.2} ± {:.2} mm (p95 {:.2})", l.mean, l.sd, l.p95);
                println!("          {} landmarks{outside}: {} → {}", l.after_mm.count, told(&l.before_mm), told(&l.after_mm));
            }
        }
        if let Some(mean) = self.mean_rms_hu(args) {
            println!("mean RMS {mean:.2} HU");
        }
        if let Some(Filtered { report, mean_rms_hu, folded }) = &self.filtered {
            let rms = mean_rms_hu.map_or(String::new(), |rms| format!(", mean RMS {rms:.2} HU"));
            println!(
                "principal components: {} of {}, {:.1} % of the variance, {:.2} mm (RMS) taken away{rms}, {folded} cells folded",
                report.components,
                report.shares.len(),
                100.0 * report.kept,
                report.removed_mm
            );
        }
        let [x, y, z] = self.model.grid().size;
        println!(
            "{}: {} of phases {:?}, {} fields of {x} × {y} × {z}, {:.1} MiB, {:.1} s",
            args.output.display(),
            kind_name(self.model.kind()),
            self.used.iter().map(|n| n + 1).collect::<Vec<_>>(),
            self.model.fields().len(),
            self.model.size_bytes() as f64 / f64::from(1 << 20),
            self.seconds
        );
    }
}

/// The bone that changes its volume most.
fn softest(bones: &[BoneQuality]) -> Option<&BoneQuality> {
    let off = |b: &BoneQuality| b.determinant.iter().map(|d| (d - 1.0).abs()).fold(0.0, f32::max);
    bones.iter().max_by(|a, b| off(a).total_cmp(&off(b)))
}

fn describe(n: usize, q: &Quality, landmarks: Option<&LandmarkErrors>, signal: Option<&Vec<f64>>) -> Value {
    let told = |l: Lengths| json!({ "count": l.count, "mean": l.mean, "sd": l.sd, "p95": l.p95, "worst": l.worst });
    json!({
        "phase": n + 1,
        "signal": signal,
        "rms_hu": q.rms_hu,
        "determinant": q.determinant,
        "folded_cells": q.folded,
        "without_inverse": q.without_inverse,
        "way_back_mm": told(q.way_back_mm),
        "consistency_mm": q.consistency_mm.map(told),
        "landmarks": landmarks.map(|l| json!({ "outside": l.outside, "before_mm": told(l.before_mm), "after_mm": told(l.after_mm) })),
        "longest_mm": q.longest_mm,
        "bones": q.bones.iter().map(|b| json!({ "mm3": b.mm3, "center": b.center, "determinant": b.determinant })).collect::<Vec<_>>(),
    })
}
