//! The real recordings: every one is read, plays for ever without a jump, and can be imitated.

use maille_motion::signal::{BreathStatistics, Conditioning, CsvOptions, Recorded, Synthetic, Trace};
use maille_motion::{Breath, Breathing};
use maille_testkit::real_data;

fn traces() -> Vec<Trace> {
    let Some(folder) = real_data("respiration") else { return vec![] };
    let mut files = vec![folder.join("rpm_siro_PT01.vxp")];
    files.extend(
        std::fs::read_dir(folder.join("extmarkers"))
            .unwrap()
            .map(|f| f.unwrap().path())
            .filter(|p| p.extension().is_some_and(|e| e == "csv")),
    );
    files.sort();
    let read = |p: &std::path::PathBuf| {
        Trace::from_text(&std::fs::read_to_string(p).unwrap(), &p.file_name().unwrap().to_string_lossy(), &CsvOptions::default()).unwrap()
    };
    files.iter().map(read).collect()
}

/// Largest change of level in a millisecond, largest rate and largest change of rate, over a loop and a bit.
fn steps(breathing: &impl Breathing, seconds: f64) -> [f64; 3] {
    let mut last: Option<Breath> = None;
    (0..(1000.0 * seconds) as u64).fold([0.0; 3], |m, ms| {
        let now = breathing.at(ms * 1_000_000);
        let before = last.replace(now).unwrap_or(now);
        [m[0].max((now.level - before.level).abs()), m[1].max(now.rate.abs()), m[2].max((now.rate - before.rate).abs())]
    })
}

#[test]
fn every_real_trace_plays_without_a_jump() {
    for trace in traces() {
        let recorded = Recorded::new(&trace, &Conditioning::default()).unwrap_or_else(|e| panic!("{e}"));
        let report = recorded.report();
        let [step, rate, jerk] = steps(&recorded, report.loop_s + 5.0);
        println!(
            "{:38} {:4} samples, {} rows left out, {:4} irregular, {:2} gaps (longest {:.2} s), {:3} breaths of {:.2} s, loop {:.1} s, step {step:.4}, rate {rate:.2}/s",
            trace.name,
            trace.values.len(),
            report.rows_left_out,
            trace.irregular_rows,
            report.gaps,
            report.longest_gap_s,
            report.breaths,
            report.period_s,
            report.loop_s
        );
        // a millisecond at the highest rate; a jump would be a good part of a breath
        assert!(step <= rate * 1.001e-3 && step < 0.02, "{}: {step} at {rate}/s", trace.name);
        // the filter's acceleration: ω² times a step of the input of one breath
        assert!(jerk < 0.1 * rate.max(1.0), "{}: {jerk}", trace.name);
        assert!((1.5..=12.0).contains(&report.period_s), "{}: {report:?}", trace.name);
    }
}

#[test]
fn a_trace_torn_to_pieces_plays_without_a_jump() {
    for trace in traces() {
        let whole = Recorded::new(&trace, &Conditioning::default()).unwrap();
        // every fifth second is zeros, and a tenth of the other samples is missing
        let rows = trace.times_s.iter().zip(&trace.values).enumerate().filter(|(n, _)| n % 10 != 3);
        let torn = Trace::new("torn", rows.map(|(_, (&t, &v))| (t, if (t as u64).is_multiple_of(5) { 1e4 } else { v }))).unwrap();
        let recorded = Recorded::new(&torn, &Conditioning::default()).unwrap();
        let ([step, ..], [clean, ..]) = (steps(&recorded, recorded.report().loop_s + 5.0), steps(&whole, whole.report().loop_s));
        assert!(torn.outlier_rows > torn.values.len() / 10, "{}: {}", trace.name, torn.outlier_rows);
        // the line over a hole may be steeper than breathing, by how much of a breath the hole hides
        assert!(step < 2.0 * clean + 0.002, "{}: {step} against {clean}", trace.name);
    }
}

#[test]
fn a_breather_fitted_to_a_trace_breathes_like_it() {
    for trace in traces() {
        let recorded = Recorded::new(&trace, &Conditioning::default()).unwrap();
        let statistics = BreathStatistics::fit(&recorded);
        let (period, depth) = Synthetic::new(&statistics, 1).medians();
        println!(
            "{:38} period {:.2} s made {period:.2} s, depth {:.2} made {depth:.2}, {statistics:?}",
            trace.name,
            recorded.report().period_s,
            statistics.depth.median
        );
        assert!((period / recorded.report().period_s - 1.0).abs() < 0.2, "{}", trace.name);
        assert!((depth / statistics.depth.median - 1.0).abs() < 0.1, "{}", trace.name);
    }
}
