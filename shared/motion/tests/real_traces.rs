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

/// Rows of a tracker's table: time and three coordinates, the times as they are written.
fn table(text: &str) -> Vec<(f64, [f64; 3])> {
    let number = |cell: &str| cell.replace(',', ".").parse::<f64>().unwrap();
    let row = |line: &str| {
        let cells: Vec<f64> = line.split(';').map(number).collect();
        (cells[1], [cells[2], cells[3], cells[4]])
    };
    text.lines().skip(1).map(row).collect()
}

/// The axis along which a signal was taken from rows: the signal is linear in them, s = a · x + b, so least squares give a.
fn axis(rows: &[(f64, [f64; 3])], trace: &Trace) -> nalgebra::Vector3<f64> {
    // the trace begins with the first row that it keeps, one of the first two: that at which what is linear is found to be so
    let fit = |first_ms: f64| {
        let of = |t: f64| trace.times_s.iter().position(|s| (s * 1000.0 + first_ms - t).abs() < 0.5).map(|n| trace.values[n]);
        let both: Vec<(nalgebra::Vector3<f64>, f64)> = rows.iter().filter_map(|(t, x)| Some(((*x).into(), of(*t)?))).collect();
        let count = both.len() as f64;
        let mean = both.iter().map(|b| b.0).sum::<nalgebra::Vector3<f64>>() / count;
        let middle = both.iter().map(|b| b.1).sum::<f64>() / count;
        let (mut square, mut right) = (nalgebra::Matrix3::zeros(), nalgebra::Vector3::zeros());
        for (x, s) in &both {
            square += (x - mean) * (x - mean).transpose();
            right += (x - mean) * (s - middle);
        }
        let Some(inverse) = square.try_inverse() else { return (right, f64::INFINITY) };
        let axis = inverse * right;
        (axis, both.iter().map(|(x, s)| (axis.dot(&(x - mean)) - (s - middle)).abs()).fold(0.0, f64::max))
    };
    let found = [fit(rows[0].0), fit(rows[1].0)];
    let (axis, miss) = found[usize::from(found[1].1 < found[0].1)];
    assert!(miss < 1e-6, "{}: {miss}", trace.name);
    axis
}

/// Three rows of each of the recordings lose a coordinate, two or all, or leap: the marker goes along the same line, and what is played is the same.
#[test]
fn a_few_rows_that_are_none_do_not_turn_the_axis_of_a_real_marker() {
    let Some(folder) = real_data("respiration/extmarkers") else { return };
    let mut files: Vec<_> = std::fs::read_dir(folder).unwrap().map(|f| f.unwrap().path()).collect();
    files.retain(|p| p.extension().is_some_and(|e| e == "csv"));
    files.sort();
    assert_eq!(files.len(), 18);
    let zero = |c: usize| {
        move |mut x: [f64; 3]| {
            x[c] = 0.0;
            x
        }
    };
    type Tear = Box<dyn Fn([f64; 3]) -> [f64; 3]>;
    let tears: [(&str, Tear); 6] = [
        ("x lost", Box::new(zero(0))),
        ("y lost", Box::new(zero(1))),
        ("z lost", Box::new(zero(2))),
        ("all lost", Box::new(|_| [0.0; 3])),
        ("x a spike", Box::new(|x| [x[0] + 80.0, x[1], x[2]])),
        ("far away", Box::new(|_| [9999.0; 3])),
    ];
    for path in files {
        let name = path.file_name().unwrap().to_string_lossy().into_owned();
        let text = std::fs::read_to_string(&path).unwrap();
        let rows = table(&text);
        // also where the recorder itself wrote nothing, and the trace leaves rows out
        let rows: Vec<_> = rows.into_iter().enumerate().filter(|(n, (_, x))| *n == 0 || *x != [0.0; 3]).map(|(_, r)| r).collect();
        let read = |rows: &[(f64, [f64; 3])]| {
            let line = |(t, x): &(f64, [f64; 3])| format!("{t};{};{};{}\n", x[0], x[1], x[2]);
            let text = format!("Timestamp;x;y;z\n{}", rows.iter().map(line).collect::<String>());
            Trace::from_csv(&text, &name, &CsvOptions { time_unit_s: Some(1e-3), ..Default::default() }).unwrap()
        };
        let clean = read(&rows);
        let straight = axis(&rows, &clean);
        assert!((straight.norm() - 1.0).abs() < 1e-6, "{name}: {straight}");
        let usual = Recorded::new(&clean, &Conditioning::default()).unwrap();
        for (what, tear) in &tears {
            let mut torn = rows.clone();
            let third = rows.len() / 3;
            for n in [0, third, 2 * third] {
                torn[n].1 = tear(torn[n].1);
            }
            let found = read(&torn);
            let turned = straight.angle(&axis(&torn, &found)).to_degrees();
            let played = *Recorded::new(&found, &Conditioning::default()).unwrap().report();
            println!("{name:34} {what:10} {turned:.2}°, {played}");
            assert!(turned < 3.0, "{name}, {what}: {turned}°");
            // a coordinate that is small anyway may be lost unnoticed, when that moves the marker by less than a breath
            assert!(found.values.len() <= rows.len() - 3 || *what == "y lost", "{name}, {what}: {} of {}", found.values.len(), rows.len());
            let (ends, before) = (played.ends, usual.report().ends);
            let depth = before[1] - before[0];
            assert!((0..2).all(|e| (ends[e] - before[e]).abs() < 0.05 * depth), "{name}, {what}: {ends:?} instead of {before:?}");
        }
    }
}

/// The clock of a real recording is set on by an hour in its middle, or was not set yet at its first row: it plays as it would without.
#[test]
fn a_leap_of_the_clock_leaves_no_patient_motionless() {
    for trace in traces() {
        let whole = Recorded::new(&trace, &Conditioning::default()).unwrap();
        for (from, by) in [(trace.values.len() / 2, 3600.0), (1, 1.6e9)] {
            let set = |(n, (&t, &v)): (usize, (&f64, &f64))| (if n < from { t } else { t + by }, v);
            let leapt = Trace::new("leapt", trace.times_s.iter().zip(&trace.values).enumerate().map(set)).unwrap();
            let recorded = Recorded::new(&leapt, &Conditioning::default()).unwrap();
            let report = recorded.report();
            assert!((report.duration_s - whole.report().duration_s).abs() < 3.0, "{}: {report}", trace.name);
            assert!(report.leaps == 1 && (report.longest_leap_s - by).abs() < 10.0, "{}: {report}", trace.name);
            assert!(report.to_string().contains("one leap of the clock by"), "{report}");
            assert!(report.breaths.abs_diff(whole.report().breaths) <= 1, "{}: {report} instead of {}", trace.name, whole.report());
            let ([step, ..], [clean, ..]) = (steps(&recorded, report.loop_s + 5.0), steps(&whole, whole.report().loop_s));
            assert!(step < 1.5 * clean + 0.002, "{}: {step} against {clean}", trace.name);
        }
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
