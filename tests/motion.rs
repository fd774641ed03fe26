//! `maille invert` and `maille motion` as commands: from files to files, judged by code that shares nothing with them (an f64 trilinear
//! interpolation here, closed forms of the fields).

use maille_testkit::real_data;
use maille_volume::io::{read_image, read_vector_field, write_image, write_vector_field};
use maille_volume::{Grid, ScalarField, VectorField};
use std::{
    path::{Path, PathBuf},
    process::{Command, Output},
};

/// A directory that goes when the test ends.
struct Scratch(PathBuf);

impl Scratch {
    fn new(name: &str) -> Self {
        let path = std::env::temp_dir().join(format!("maille_motion_{name}_{}", std::process::id()));
        std::fs::create_dir_all(&path).unwrap();
        Self(path)
    }
    fn file(&self, name: &str) -> String {
        self.0.join(name).to_str().unwrap().into()
    }
}

impl Drop for Scratch {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

fn maille(args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_maille")).args(args).output().expect("the program starts")
}

/// Runs what should succeed, and gives its JSON.
fn told(args: &[&str]) -> serde_json::Value {
    let output = maille(args);
    assert!(output.status.success(), "{args:?}: {}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_slice(&output.stdout).unwrap_or_else(|e| panic!("{e}: {}", String::from_utf8_lossy(&output.stdout)))
}

/// Runs what should be refused with this status, in one sentence that says this.
fn refused(args: &[&str], status: i32, says: &str) {
    let output = maille(args);
    let sentence = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(status), "{args:?}: {sentence}");
    assert!(sentence.contains(says), "{args:?} should say `{says}`: {sentence}");
    assert!(!sentence.contains("panicked"), "{sentence}");
    // our own refusals are one line beside that of progress; the command line's parser explains itself at length
    assert!(status == 2 || sentence.lines().filter(|l| !l.contains("registering")).count() == 1, "{sentence}");
}

/// A turned grid of three spacings.
fn turned() -> Grid {
    let mut grid = Grid::axis_aligned([31, 27, 24], [1.5, 1.0, 2.0]);
    let (s, c) = 0.5f64.sin_cos();
    grid.direction = [c, 0.0, s, 0.0, 1.0, 0.0, -s, 0.0, c];
    grid.origin = [-40.0, 7.0, 250.0];
    grid
}

fn field(grid: &Grid, u: impl Fn([f64; 3]) -> [f64; 3]) -> VectorField {
    let [nx, ny, _] = grid.size;
    let at = |n: usize| grid.world_from_index([n % nx, n / nx % ny, n / (nx * ny)].map(|i| i as f64));
    VectorField { grid: grid.clone(), vectors: (0..grid.voxel_count()).map(|n| u(at(n)).map(|c| c as f32)).collect() }
}

/// Trilinear in f64; the border goes on beyond the grid.
fn at(field: &VectorField, world: [f64; 3]) -> [f64; 3] {
    let (grid, index) = (&field.grid, field.grid.index_from_world(world));
    let mut sum = [0.0; 3];
    for corner in 0..8 {
        let (mut weight, mut node) = (1.0, [0; 3]);
        for c in 0..3 {
            let held = index[c].clamp(0.0, (grid.size[c] - 1) as f64);
            let low = held.floor().min((grid.size[c] - 2) as f64);
            let bit = corner >> c & 1;
            weight *= if bit == 1 { held - low } else { 1.0 - (held - low) };
            node[c] = low as usize + bit;
        }
        let v = field.vectors[grid.offset(node[0], node[1], node[2])];
        (0..3).for_each(|c| sum[c] += weight * f64::from(v[c]));
    }
    sum
}

fn length(v: [f64; 3]) -> f64 {
    v.iter().map(|c| c * c).sum::<f64>().sqrt()
}

fn apart(a: [f64; 3], b: [f64; 3]) -> f64 {
    length(std::array::from_fn(|c| a[c] - b[c]))
}

/// What one run of `maille invert` claims, checked node by node: (claimed, within the tolerance, its report).
fn checked_inverse(u: &VectorField, path: &str, scratch: &Scratch, tolerance: f64) -> (usize, VectorField, serde_json::Value) {
    let [inverse, residual, folds] = ["v.nrrd", "r.nrrd", "f.nrrd"].map(|n| scratch.file(n));
    let tolerance_text = tolerance.to_string();
    let report =
        told(&["invert", path, "-o", &inverse, "--tolerance", &tolerance_text, "--residual", &residual, "--folds", &folds, "--json"]);
    let v = read_vector_field(Path::new(&inverse)).unwrap();
    // a header rounds directions in the last digits
    let far = u.grid.size.map(|s| s as f64);
    assert!(v.grid.size == u.grid.size && apart(v.grid.world_from_index(far), u.grid.world_from_index(far)) < 1e-6);
    let residuals: Vec<f64> = read_image(Path::new(&residual)).unwrap().pixels.iter_f64().collect();
    let folded = read_image(Path::new(&folds)).unwrap().pixels.iter_f64().filter(|f| *f == 1.0).count();
    assert_eq!(report["folded_cells"], folded);
    let [nx, ny, _] = u.grid.size;
    let mut claimed = 0;
    for (n, v) in v.vectors.iter().enumerate() {
        // no node is silent: a vector and its residual, or NaN and −1
        assert_eq!(v.iter().all(|c| c.is_nan()), residuals[n] == -1.0);
        if residuals[n] < 0.0 {
            continue;
        }
        claimed += 1;
        let world = u.grid.world_from_index([n % nx, n / nx % ny, n / (nx * ny)].map(|i| i as f64));
        let rest = std::array::from_fn(|c| world[c] + f64::from(v[c]));
        let back = at(u, rest);
        let miss = length(std::array::from_fn(|c| rest[c] + back[c] - world[c]));
        // what it claims bounds the residual: that itself, here and there in f64 (then the rounding of patient coordinates is left), or in f32 with a
        // bound on its rounding, which is a dozen units in the last place of the longest vector and one of the largest index, in mm of the largest spacing
        let over = residuals[n] - miss;
        assert!(miss <= tolerance * 1.000_001 && (-1e-9..=2e-4).contains(&over), "node {n}: {miss} mm, it claims {}", residuals[n]);
        let inside = u.grid.index_from_world(rest);
        assert!((0..3).all(|c| inside[c] > -0.01 && inside[c] < (u.grid.size[c] - 1) as f64 + 0.01), "{inside:?}");
    }
    let count = |key: &str| report[key].as_u64().unwrap() as usize;
    assert_eq!(count("inverted"), claimed);
    assert_eq!(count("inverted") + count("outside") + count("failures"), count("nodes"));
    (claimed, v, report)
}

#[test]
fn an_inverse_brings_back_every_node_that_it_claims() {
    let scratch = Scratch::new("smooth");
    let center = turned().center();
    let u = field(&turned(), |x| {
        let d: [f64; 3] = std::array::from_fn(|c| (x[c] - center[c]) / 12.0);
        let bump = 5.0 * (-d.iter().map(|v| v * v).sum::<f64>()).exp();
        [bump, -0.5 * bump, 0.8 * bump]
    });
    let path = scratch.file("u.mha");
    write_vector_field(Path::new(&path), &u).unwrap();
    for tolerance in [1e-2, 1e-4] {
        let (claimed, _, report) = checked_inverse(&u, &path, &scratch, tolerance);
        // the bump reaches the border, where it uncovers some
        assert!(report["failures"] == 0 && claimed as f64 > 0.85 * u.vectors.len() as f64, "{report}");
    }
}

#[test]
fn the_inverse_of_a_linear_field_is_the_one_of_its_formula() {
    let scratch = Scratch::new("linear");
    let center = turned().center();
    // x = c + F(X − c), F = 1 + A, trilinear on any grid
    let a = Rows([[0.10, 0.05, -0.04], [-0.03, -0.12, 0.02], [0.06, 0.01, 0.08]]);
    let u = field(&turned(), |x| a.times(std::array::from_fn(|c| x[c] - center[c])));
    let path = scratch.file("u.nrrd");
    write_vector_field(Path::new(&path), &u).unwrap();
    let (claimed, v, _) = checked_inverse(&u, &path, &scratch, 1e-4);
    let [nx, ny, _] = u.grid.size;
    let mut worst = 0.0f64;
    for (n, v) in v.vectors.iter().enumerate().filter(|(_, v)| !v[0].is_nan()) {
        let x = u.grid.world_from_index([n % nx, n / nx % ny, n / (nx * ny)].map(|i| i as f64));
        // X − c by a geometric series: 1/F = Σ (−A)^k, ‖A‖ < 0.2, 30 terms leave 1e-20
        let d: [f64; 3] = std::array::from_fn(|c| x[c] - center[c]);
        let (mut rest, mut term) = (d, d);
        for _ in 0..30 {
            term = a.times(term).map(|v| -v);
            rest = std::array::from_fn(|c| rest[c] + term[c]);
        }
        worst = worst.max(length(std::array::from_fn(|c| rest[c] - d[c] - f64::from(v[c]))));
    }
    // the error itself: at most residual/(1 − ‖A‖), and the f32 of the given vectors
    assert!(claimed > u.vectors.len() / 2 && worst <= 1.4e-4, "{claimed} {worst}");
}

/// Nine numbers that multiply a vector.
struct Rows([[f64; 3]; 3]);

impl Rows {
    fn times(&self, v: [f64; 3]) -> [f64; 3] {
        self.0.map(|row| (0..3).map(|c| row[c] * v[c]).sum())
    }
}

#[test]
fn a_fold_is_mapped_and_what_lies_under_it_is_told() {
    let scratch = Scratch::new("fold");
    let grid = Grid::axis_aligned([40, 20, 20], [1.0; 3]);
    // between x = 15 and 25 tissue is turned inside out: du/dx = −2 at the middle
    let u = field(&grid, |[x, _, _]| [-6.4 * ((x - 20.0) / 5.0).tanh(), 0.0, 0.0]);
    let path = scratch.file("u.nrrd");
    write_vector_field(Path::new(&path), &u).unwrap();
    let (claimed, _, report) = checked_inverse(&u, &path, &scratch, 1e-3);
    assert!(report["folded_cells"].as_u64().unwrap() > 0 && report["determinant"][0].as_f64().unwrap() < 0.0, "{report}");
    // what is pulled in from both ends covers the planes 7 to 32 (6.4 mm each), the fold among them: there the branch that is not turned
    assert_eq!((claimed, report["failures"].as_u64()), (26 * 400, Some(0)), "{report}");
}

#[test]
fn a_real_field_of_another_tool_is_inverted_and_no_failure_is_silent() {
    let Some(folder) = real_data("ct_lung_elastix") else { return };
    let scratch = Scratch::new("elastix");
    let path = folder.join("derived_displacement_baseline_to_followup.mha");
    let u = read_vector_field(&path).unwrap();
    let (claimed, _, report) = checked_inverse(&u, path.to_str().unwrap(), &scratch, 1e-3);
    println!("elastix field: {report}");
    // 38 mm in the mean, the shift of the table: what comes from beyond the grid is told as outside
    assert!(claimed > u.vectors.len() / 2, "{report}");
    assert!(report["failures"].as_u64().unwrap() * 100 <= claimed as u64, "{report}");
}

#[test]
fn what_cannot_be_inverted_is_refused_in_one_sentence() {
    let scratch = Scratch::new("hostile");
    let grid = Grid::axis_aligned([8, 7, 6], [1.0; 3]);
    let out = scratch.file("v.nrrd");
    let name = |n: &str| scratch.file(n);
    let scalar = ScalarField { grid: grid.clone(), values: vec![0.0; grid.voxel_count()] };
    write_image(Path::new(&name("scalar.nrrd")), &scalar.to_image()).unwrap();
    refused(&["invert", &name("scalar.nrrd"), "-o", &out], 1, "3 components");

    let mut broken = VectorField::zeros(grid.clone());
    (broken.vectors[9][1], broken.vectors[100][2]) = (f32::NAN, f32::INFINITY);
    write_vector_field(Path::new(&name("nan.nrrd")), &broken).unwrap();
    refused(&["invert", &name("nan.nrrd"), "-o", &out], 1, "2 of its vectors are not finite, the first at voxel [1, 1, 0]");

    let mut two = scalar.to_image();
    (two.components, two.pixels) = (2, maille_volume::Pixels::F32(vec![0.0; 2 * grid.voxel_count()]));
    write_image(Path::new(&name("two.nrrd")), &two).unwrap();
    refused(&["invert", &name("two.nrrd"), "-o", &out], 1, "this has 2");

    write_vector_field(Path::new(&name("flat.mha")), &VectorField::zeros(Grid::axis_aligned([8, 7, 1], [1.0; 3]))).unwrap();
    refused(&["invert", &name("flat.mha"), "-o", &out], 1, "two or more along every axis");
    std::fs::write(name("text.mha"), "no field at all").unwrap();
    refused(&["invert", &name("text.mha"), "-o", &out], 1, "text.mha");
    refused(&["invert", &name("none.mha"), "-o", &out], 1, "none.mha");

    let sound = name("sound.nrrd");
    write_vector_field(Path::new(&sound), &VectorField::zeros(grid)).unwrap();
    refused(&["invert", &sound, "-o", &name("v.txt")], 2, ".nrrd");
    refused(&["invert", &sound, "-o", &sound], 1, "name another file");
    for tolerance in ["0", "-1", "nan", "inf"] {
        refused(&["invert", &sound, "-o", &out, "--tolerance", tolerance], 2, "--tolerance");
    }
    assert!(!Path::new(&out).exists(), "nothing is written by a refusal");
}

/// Lungs that fill and empty: a ball of air in tissue with texture, its lower part pulled down by `depth` mm.
fn breath(depth: f64) -> ScalarField {
    let grid = Grid::axis_aligned([36, 32, 34], [2.0; 3]);
    let center = grid.center();
    let [nx, ny, _] = grid.size;
    let value = |n: usize| {
        let [x, y, z] = [n % nx, n / nx % ny, n / (nx * ny)].map(|i| 2.0 * i as f64);
        // the ball grows along z with the depth
        let stretch = 1.0 + depth / 20.0;
        let r = (((x - center[0]).powi(2) + (y - center[1]).powi(2) + ((z - center[2]) / stretch).powi(2)).sqrt() - 16.0) / 3.0;
        let tissue = 60.0 * ((x * 0.2).sin() + (y * 0.17).cos() + ((z - depth) * 0.21).sin());
        (-850.0 + 880.0 / (1.0 + (-r).exp()) + tissue) as f32
    };
    ScalarField { values: (0..grid.voxel_count()).map(value).collect(), grid }
}

#[test]
fn images_of_a_breath_become_models_that_bring_it_back() {
    let scratch = Scratch::new("fit");
    let depths = [0.0, 3.0, 5.0, 2.0];
    let files: Vec<String> = (0..4).map(|n| scratch.file(&format!("phase{}.mha", n + 1))).collect();
    for (file, depth) in files.iter().zip(depths) {
        write_image(Path::new(file), &breath(depth).to_image()).unwrap();
    }
    let phases: Vec<&str> = files.iter().map(String::as_str).collect();
    let fit = |more: &[&str]| told(&[&["motion", "fit"], &phases[..], more, &["--json"]].concat());

    let full = scratch.file("full.motion");
    let report = fit(&["-o", &full]);
    for phase in report["phases"].as_array().unwrap().iter().skip(1) {
        let rms = |n: usize| phase["rms_hu"][n].as_f64().unwrap();
        assert!(rms(1) < 0.4 * rms(0), "{phase}");
        assert!(phase["folded_cells"] == 0 && phase["without_inverse"] == 0, "{phase}");
    }
    // air follows the depth: phase 3 is the fullest
    let g = |n: usize| report["phases"][n]["signal"][0].as_f64().unwrap();
    assert!(g(0) < g(3) && g(3) < g(1) && g(1) < g(2), "{report}");

    let u = scratch.file("u.nrrd");
    let eval = |model: &str, moment: &[&str]| {
        let report = told(&[&["motion", "eval", model], moment, &["-o", &u, "--json"]].concat());
        (read_vector_field(Path::new(&u)).unwrap(), report)
    };
    let between = |a: &VectorField, b: &VectorField| {
        a.vectors.iter().zip(&b.vectors).map(|(a, b)| apart(a.map(f64::from), b.map(f64::from))).fold(0.0, f64::max)
    };
    let (third, said) = eval(&full, &["--phase", "3"]);
    assert!(said["longest_mm"].as_f64().unwrap() > 2.0, "{said}");
    let (second, _) = eval(&full, &["--phase", "2"]);
    let (middle, _) = eval(&full, &["--tau", "0.375"]);
    let mean = VectorField {
        grid: second.grid.clone(),
        vectors: second.vectors.iter().zip(&third.vectors).map(|(a, b)| std::array::from_fn(|c| 0.5 * (a[c] + b[c]))).collect(),
    };
    assert!(between(&middle, &mean) < 1e-4);
    assert!(eval(&full, &["--tau", "1.375"]).0 == middle, "a cycle comes round");

    // what was fitted on images is fitted on their fields as well, to the storage of both
    let fields: Vec<String> = (2..=4).map(|n| scratch.file(&format!("u{n}.nrrd"))).collect();
    for (n, file) in (2..=4).zip(&fields) {
        told(&["motion", "eval", &full, "--phase", &n.to_string(), "-o", file, "--json"]);
    }
    let again = scratch.file("again.motion");
    let of_fields: Vec<&str> = fields.iter().map(String::as_str).collect();
    told(&[&["motion", "fit"], &of_fields[..], &["-o", &again, "--reference", "1", "--precision", "f32", "--json"]].concat());
    assert!(between(&eval(&again, &["--phase", "3"]).0, &third) < 1e-4);
    assert!(eval(&again, &["--phase", "1"]).1["longest_mm"] == 0.0, "the reference stays where it is");

    // half a cycle from the fields: the branch from phase 3 to phase 1, extrapolated beyond it
    let signals = scratch.file("signals.csv");
    std::fs::write(&signals, "# g, rate\n0, 1\n3, 2\n5, -1\n2, -3\n").unwrap();
    let half = scratch.file("half.motion");
    let with = ["--reference", "1", "--signals", &signals, "--json"];
    let report = told(&[&["motion", "fit"], &of_fields[..], &["-o", &half, "--kind", "half"], &with].concat());
    assert_eq!(report["used_phases"], serde_json::json!([3, 4, 1]));
    let (deeper, _) = eval(&half, &["--tau=-0.2"]);
    let scaled = VectorField { grid: third.grid.clone(), vectors: third.vectors.iter().map(|v| v.map(|c| 1.2 * c)).collect() };
    assert!(between(&deeper, &scaled) < 1e-2);

    // fields of other tools are judged as far as fields can be: against an oracle of their own here
    let worst = |report: &serde_json::Value, n: usize| report["phases"][n]["way_back_mm"]["worst"].as_f64().unwrap();
    assert!(report["phases"][2]["rms_hu"].is_null() && report["phases"][2]["folded_cells"] == 0, "{report}");
    assert!((0..4).all(|n| worst(&report, n) < 0.02) && worst(&report, 2) > 0.0, "{report}");
    assert!((report["phases"][2]["longest_mm"].as_f64().unwrap() - said["longest_mm"].as_f64().unwrap()).abs() < 1e-2);

    // both ways, by a mask that is given, and by landmarks that move as the formula does
    let mask = scratch.file("mask.mha");
    let mut ball = breath(0.0);
    ball.values.iter_mut().for_each(|v| *v = f32::from(u8::from(*v < -400.0)));
    write_image(Path::new(&mask), &ball.to_image()).unwrap();
    // both poles of the ball, which grows by 3/20 along z
    let points = |name: &str, stretch: f64| {
        let center = ball.grid.center();
        let rows: String = (0..20)
            .map(|n| {
                let (sin, cos) = (0.6 * f64::from(n)).sin_cos();
                let (x, y) = (0.3 * f64::from(n) * cos, 0.3 * f64::from(n) * sin);
                let z = (256.0 - x * x - y * y).sqrt() * if n % 2 == 0 { stretch } else { -stretch };
                format!("{} {} {}\n", center[0] + x, center[1] + y, center[2] + z)
            })
            .collect();
        std::fs::write(scratch.file(name), format!("point\n20\n{rows}")).unwrap();
        scratch.file(name)
    };
    let (rest, there) = (points("rest.txt", 1.0), points("there.txt", 1.15));
    let sliding = fit(&["-o", &scratch.file("s.motion"), "--sliding", "--mask", &mask, "--consistency", "--landmarks", "2", &rest, &there]);
    assert_ne!(std::fs::read(scratch.file("s.motion")).unwrap(), std::fs::read(&full).unwrap(), "what slides makes a difference");
    let second = &sliding["phases"][1];
    let number = |key: &str| second.pointer(key).unwrap().as_f64().unwrap();
    // a ball of 32 mm that moves by 3 mm: a voxel of 2 mm is what both ways must agree to
    assert!(number("/consistency_mm/count") > 1000.0 && number("/consistency_mm/p95") < 2.0, "{second}");
    assert!(number("/consistency_mm/mean") > 0.0 && sliding["phases"][0]["consistency_mm"].is_null(), "{second}");
    assert_eq!(second.pointer("/landmarks/after_mm/count").unwrap(), 20);
    assert!(number("/landmarks/after_mm/mean") < 0.5 * number("/landmarks/before_mm/mean"), "{second}");
    assert!(sliding["phases"][2]["landmarks"].is_null());
    let refuse = |status: i32, more: &[&str], says: &str| {
        refused(&[&["motion", "fit"], &phases[..], &["-o", &scratch.file("no.motion")], more].concat(), status, says);
    };
    refuse(2, &["--mask", &mask], "--sliding");
    refuse(2, &["--landmarks", "9", &rest, &there], "1 to 4");
    refuse(2, &["--pca", "0"], "--pca 0");
    refuse(2, &["--pca", "1.5"], "--pca 1.5");
    std::fs::write(scratch.file("bare.txt"), "1 2 3\n").unwrap();
    refuse(1, &["--landmarks", "2", &rest, &scratch.file("bare.txt")], "bare.txt: nothing says what its numbers are");
    let empty = scratch.file("empty.mha");
    write_image(Path::new(&empty), &ScalarField { values: vec![0.0; ball.values.len()], grid: ball.grid.clone() }.to_image()).unwrap();
    refuse(1, &["--sliding", "--mask", &empty], "empty.mha: none of its voxels is above 0");
    write_image(
        Path::new(&empty),
        &ScalarField { values: ball.values.clone(), grid: Grid { origin: [900.0; 3], ..ball.grid.clone() } }.to_image(),
    )
    .unwrap();
    refuse(1, &["--sliding", "--mask", &empty], "it lies elsewhere");

    // two principal components of fields that one depth makes: nearly all there is, told, and what is written is less than all
    let filtered = scratch.file("pca.motion");
    let pca = |keep: &str| fit(&["-o", &filtered, "--pca", keep])["pca"].clone();
    let (two, share) = (pca("2"), pca("0.5"));
    assert!(two["components"] == 2 && two["kept"].as_f64().unwrap() > 0.9 && two["removed_mm"].as_f64().unwrap() > 0.0, "{two}");
    assert!(share["components"] == 1 && share["kept"].as_f64().unwrap() > 0.5 && share["mean_rms_hu"].as_f64().unwrap() > 1.0, "{share}");
    assert!(between(&eval(&filtered, &["--phase", "3"]).0, &third) > 1e-3);

    // signals: linear in them
    let surrogate = scratch.file("surrogate.motion");
    told(&[&["motion", "fit"], &of_fields[..], &["-o", &surrogate, "--kind", "surrogate"], &with].concat());
    let of = |z: &str| eval(&surrogate, &["--signal", z]).0;
    let (a, b, c) = (of("0,0"), of("2,1"), of("4,2"));
    let extrapolated = VectorField {
        grid: a.grid.clone(),
        vectors: a.vectors.iter().zip(&b.vectors).map(|(a, b)| std::array::from_fn(|d| 2.0 * b[d] - a[d])).collect(),
    };
    assert!(between(&c, &extrapolated) < 1e-3 && between(&a, &c) > 0.5);
    refused(&["motion", "eval", &surrogate, "--signal", "1", "-o", &u], 2, "2 signals");
    refused(&["motion", "eval", &surrogate, "--tau", "0.5", "-o", &u], 2, "--signal");
    refused(&["motion", "eval", &full, "--signal", "1,2", "-o", &u], 2, "--tau");
    refused(&["motion", "eval", &full, "--phase", "5", "-o", &u], 2, "1 to 4");
    refused(&["motion", "eval", &full, "--tau", "nan", "-o", &u], 2, "--tau");
    refused(&["motion", "eval", &full, "-o", &u], 2, "--phase");
    refused(&["motion", "eval", &files[0], "--tau", "0", "-o", &u], 1, "motion fit");
    // a model cut off in the middle
    let bytes = std::fs::read(&full).unwrap();
    std::fs::write(scratch.file("cut.motion"), &bytes[..bytes.len() / 2]).unwrap();
    refused(&["motion", "eval", &scratch.file("cut.motion"), "--tau", "0", "-o", &u], 1, "cut.motion");
}

/// What is read stays as it is, whatever is named as output, and by whatever name; nothing is waited for.
#[test]
fn no_output_takes_the_place_of_an_input_or_of_another_output() {
    let scratch = Scratch::new("apart");
    let name = |n: &str| scratch.file(n);
    let files = [name("s1.mha"), name("s2.mha")];
    for (file, depth) in files.iter().zip([0.0, 3.0]) {
        write_image(Path::new(file), &breath(depth).to_image()).unwrap();
    }
    let grid = Grid::axis_aligned([8, 7, 6], [1.0; 3]);
    let field = name("u.nrrd");
    write_vector_field(Path::new(&field), &VectorField::zeros(grid)).unwrap();
    let model = name("m.nrrd");
    told(&["motion", "fit", &field, "-o", &model, "--reference", "1", "--json"]);
    for (file, text) in [("signals.txt", "1, 2\n3, 4\n"), ("points.txt", "point\n1\n5 5 5\n"), ("scene.toml", "name = \"s\"\n")] {
        std::fs::write(name(file), text).unwrap();
    }
    std::fs::hard_link(&files[1], name("hard.mha")).unwrap();
    std::os::unix::fs::symlink(&files[1], name("soft.mha")).unwrap();
    std::fs::create_dir(name("folder")).unwrap();

    let kept: Vec<(PathBuf, Vec<u8>)> = std::fs::read_dir(&scratch.0)
        .unwrap()
        .map(|f| f.unwrap().path())
        .filter(|p| p.is_file())
        .map(|p| (p.clone(), std::fs::read(p).unwrap()))
        .collect();
    let [a, b] = files.each_ref().map(String::as_str);
    let read = "is a file that is to be read; name another file";
    for output in [b.to_owned(), name("hard.mha"), name("soft.mha"), name("folder/../s2.mha")] {
        refused(&["motion", "fit", a, b, "-o", &output], 1, read);
        refused(&["import", b, "-o", &output], 1, read);
    }
    let (signals, points) = (name("signals.txt"), name("points.txt"));
    refused(&["motion", "fit", a, b, "--signals", &signals, "-o", &signals], 1, read);
    refused(&["motion", "fit", a, b, "--sliding", "--mask", &field, "-o", &field], 1, read);
    refused(&["motion", "fit", a, b, "--landmarks", "2", &points, &points, "-o", &points], 1, read);
    refused(&["motion", "eval", &model, "--phase", "2", "-o", &model], 1, read);
    let out = name("v.nrrd");
    refused(&["invert", &field, "-o", &field], 1, read);
    refused(&["invert", &field, "-o", &out, "--residual", &field], 1, read);
    refused(&["invert", &field, "-o", &out, "--residual", &name("folder/../v.nrrd")], 2, "is to be written twice");
    let push = "30,30,30:1,0,0";
    refused(&["deform", a, "--push", push, "-o", a], 1, read);
    refused(&["deform", a, "--push", push, "-o", &out, "--displacement", a], 1, read);
    refused(&["surface", a, "--iso", "-300", "--labels", a], 1, read);
    refused(&["render", a, "-o", a], 1, read);
    refused(&["render", a, "--warp", &field, "-o", &field], 1, read);
    let scene = name("scene.toml");
    refused(&["run", &scene, "--headless", "--duration", "1s", "--report", &scene], 1, read);
    refused(&["run", &scene, "--volume", a, "--headless", "--duration", "1s", "--report", a], 1, read);
    // and what cannot be written is told before the work
    refused(&["motion", "fit", a, b, "-o", &name("nowhere/m")], 1, "nowhere/m cannot be written");
    refused(&["motion", "fit", a, b, "-o", &name("folder")], 1, "folder cannot be written");
    for (path, bytes) in kept {
        assert!(std::fs::read(&path).unwrap() == bytes, "{}", path.display());
    }
    assert!(!Path::new(&out).exists());
}

#[test]
fn phases_that_make_no_motion_are_refused_in_one_sentence() {
    let scratch = Scratch::new("phases");
    let (model, name) = (scratch.file("model"), |n: &str| scratch.file(n));
    let grid = Grid::axis_aligned([10, 9, 8], [2.0; 3]);
    let image = |grid: &Grid| ScalarField { grid: grid.clone(), values: vec![-1000.0; grid.voxel_count()] };
    let write = |file: &str, grid: &Grid| write_image(Path::new(&scratch.file(file)), &image(grid).to_image()).unwrap();
    write("a.mha", &grid);
    write("b.mha", &Grid { size: [10, 9, 7], ..grid.clone() });
    write("c.mha", &Grid { origin: [1.0, 0.0, 0.0], ..grid.clone() });
    let mut broken = image(&grid);
    broken.values[3] = f32::NAN;
    write_image(Path::new(&name("nan.mha")), &broken.to_image()).unwrap();
    let u = VectorField::zeros(grid.clone());
    write_vector_field(Path::new(&name("u.mha")), &u).unwrap();
    let mut wild = u;
    wild.vectors[0][0] = f32::NAN;
    write_vector_field(Path::new(&name("wild.mha")), &wild).unwrap();

    let (a, u) = (name("a.mha"), name("u.mha"));
    let fit = |files: &[&str], status: i32, says: &str| refused(&[&["motion", "fit"], files, &["-o", &model]].concat(), status, says);
    fit(&[&a], 1, "one phase");
    fit(&[&u], 1, "one phase");
    fit(&[&a, &name("b.mha")], 1, "do not lie on one grid");
    fit(&[&a, &name("c.mha")], 1, "do not lie on one grid");
    fit(&[&a, &name("nan.mha")], 1, "not finite");
    fit(&[&a, &u], 1, "image and a displacement field");
    fit(&[&u, &name("wild.mha")], 1, "not finite");
    fit(&[&a, &name("nowhere.mha")], 1, "nowhere.mha");
    fit(&[&a, &a, "--reference", "3"], 2, "--reference 3 of 2");
    fit(&[&a, &a, "--reference", "0"], 2, "from 1");
    fit(&[&a, &a, "--cycle", "-1"], 2, "--cycle");
    fit(&[&u, &u, "--sliding"], 2, "--sliding");
    fit(&[&u, &u, "--consistency"], 2, "--consistency");
    fit(&[&u, &u, "--kind", "surrogate"], 2, "--signals");
    // twice the same image: no breath
    fit(&[&a, &a, "--kind", "half"], 1, "the same in all phases");
    std::fs::write(name("signals.csv"), "1, 2\n3, x\n").unwrap();
    fit(&[&u, &u, "--kind", "surrogate", "--signals", &name("signals.csv")], 1, "line 2");
    std::fs::write(name("signals.csv"), "1, 2\n").unwrap();
    fit(&[&u, &u, "--kind", "surrogate", "--signals", &name("signals.csv")], 1, "1 phases, 2 phases");
    assert!(!Path::new(&model).exists());
}
