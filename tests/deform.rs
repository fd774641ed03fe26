//! `maille deform` on the real head, checked from the files it writes by code that shares nothing with the program: a small
//! NRRD reader, the definition of a link, and the definition of bone.
//!
//! Real data from `MAILLE_DATA` (default `../shared/data`); without it the tests say so and pass, except where `CI` is set.

use std::{
    path::{Path, PathBuf},
    process::{Command, Output},
};

const BONE_HU: i16 = 300;

/// The head, or why there is none.
fn head() -> Option<PathBuf> {
    let data = std::env::var_os("MAILLE_DATA")
        .map_or_else(|| PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/../shared/data")), PathBuf::from);
    let head = data.join("ct_head_invesalius/cranium_lps.nrrd");
    if head.exists() {
        return Some(head);
    }
    assert!(std::env::var_os("CI").is_none(), "CI must have {}", head.display());
    eprintln!("SKIPPED: {} is not there (set MAILLE_DATA)", head.display());
    None
}

/// Attached NRRD, raw or gzip by way of the system's `gzip`, read as little-endian bytes.
struct Nrrd {
    header: String,
    sizes: Vec<usize>,
    bytes: Vec<u8>,
}

impl Nrrd {
    fn read(path: &Path) -> Self {
        let file = std::fs::read(path).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
        let end = file.windows(2).position(|w| w == b"\n\n").expect("an NRRD header ends in an empty line");
        let header = String::from_utf8(file[..end].to_vec()).expect("an NRRD header is text");
        let mut this = Self { header, sizes: Vec::new(), bytes: file[end + 2..].to_vec() };
        this.sizes = this.field("sizes").split_whitespace().map(|n| n.parse().unwrap()).collect();
        if this.field("encoding").starts_with("gz") {
            this.bytes = gunzip(&this.bytes);
        }
        this
    }
    fn field(&self, name: &str) -> &str {
        let line =
            self.header.lines().find(|l| l.starts_with(&format!("{name}:"))).unwrap_or_else(|| panic!("no {name} in {}", self.header));
        line.split_once(':').unwrap().1.trim()
    }
    fn shorts(&self) -> Vec<i16> {
        self.bytes.chunks_exact(2).map(|b| i16::from_le_bytes([b[0], b[1]])).collect()
    }
    fn floats(&self) -> Vec<f32> {
        self.bytes.chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect()
    }
}

fn gunzip(bytes: &[u8]) -> Vec<u8> {
    use std::io::Write;
    let mut child = Command::new("gzip")
        .arg("-dc")
        .stdin(std::process::Stdio::piped())
        .stdout(std::process::Stdio::piped())
        .spawn()
        .expect("gzip is part of every Linux system");
    let mut input = child.stdin.take().unwrap();
    let bytes = bytes.to_vec();
    let writer = std::thread::spawn(move || input.write_all(&bytes));
    let out = child.wait_with_output().unwrap();
    writer.join().unwrap().unwrap();
    out.stdout
}

fn maille(args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_maille")).args(args).output().expect("the program starts")
}

/// A directory that goes when the test ends.
struct Scratch(PathBuf);

impl Scratch {
    fn new(name: &str) -> Self {
        let path = std::env::temp_dir().join(format!("maille-test-{name}-{}", std::process::id()));
        std::fs::create_dir_all(&path).unwrap();
        Self(path)
    }
    fn file(&self, name: &str) -> String {
        self.0.join(name).to_str().unwrap().to_owned()
    }
}

impl Drop for Scratch {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

/// Runs a push on the head and checks links, bone and untouched voxels from the files; the number of displaced elements.
fn push_and_check(head: &Path, name: &str, push: &[&str], extra: &[&str]) -> (usize, serde_json::Value) {
    let scratch = Scratch::new(name);
    let [out, displacement, limits, links] = ["out.nrrd", "u.nrrd", "l.nrrd", "k.nrrd"].map(|n| scratch.file(n));
    let mut args = vec!["deform", head.to_str().unwrap(), "-o", &out, "--offset", "0.2", "--json"];
    args.extend(["--displacement", &displacement, "--limits", &limits, "--links", &links]);
    for p in push {
        args.extend(["--push", p]);
    }
    args.extend(extra);
    let output = maille(&args);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let json: serde_json::Value = serde_json::from_slice(&output.stdout).expect("one JSON object on standard output");

    let (rest, deformed) = (Nrrd::read(head), Nrrd::read(Path::new(&out)));
    let (u, w, k) = (Nrrd::read(Path::new(&displacement)), Nrrd::read(Path::new(&limits)), Nrrd::read(Path::new(&links)));
    assert_eq!(rest.sizes, deformed.sizes);
    assert_eq!(u.sizes, [3, rest.sizes[0], rest.sizes[1], rest.sizes[2]]);
    let size = &rest.sizes;
    let (before, after, u, w, k) = (rest.shorts(), deformed.shorts(), u.floats(), w.floats(), k.bytes);
    // the head's axes are the patient's: no rotation between LPS and the grid
    let at = |n: usize, c: usize| u[3 * n + c];
    let strides = [1, size[0], size[0] * size[1]];
    let mut displaced = vec![false; before.len()];
    let mut checked = 0;
    for n in 0..before.len() {
        let here = [n % size[0], n / size[0] % size[1], n / strides[2]];
        for axis in 0..3 {
            let linked = k[n] >> axis & 1 == 1;
            if here[axis] + 1 == size[axis] {
                assert!(!linked, "a link leads out of the volume");
                continue;
            }
            if !linked {
                continue;
            }
            let limit = w[3 * n + axis];
            assert!(limit > 0.0 && limit.is_finite());
            for c in 0..3 {
                let difference = (f64::from(at(n, c)) - f64::from(at(n + strides[axis], c))).abs();
                assert!(difference <= f64::from(limit) * 1.001 + 1e-6, "{here:?} axis {axis}: {difference} > {limit}");
                checked += 1;
            }
        }
        displaced[n] = (0..3).any(|c| at(n, c) != 0.0);
        if before[n] >= BONE_HU {
            assert_eq!([at(n, 0), at(n, 1), at(n, 2)], [0.0; 3], "bone at {here:?} moved");
        }
    }
    assert!(checked > 1_000_000);
    // a voxel may change where one of the cells around it has a displaced corner, and nowhere else
    let mut changed = 0;
    for n in 0..before.len() {
        if before[n] == after[n] {
            continue;
        }
        changed += 1;
        let here = [n % size[0], n / size[0] % size[1], n / strides[2]];
        let near = (0..27).any(|m: usize| {
            let v: [usize; 3] = std::array::from_fn(|c| (here[c] + m / 3usize.pow(c as u32) % 3).saturating_sub(1).min(size[c] - 1));
            displaced[v[0] + v[1] * strides[1] + v[2] * strides[2]]
        });
        assert!(near, "{here:?} changed although nothing around it moved");
    }
    let displaced = displaced.iter().filter(|&&d| d).count();
    assert_eq!(json["elements_displaced"], displaced);
    assert!(displaced > 1000 && changed > 100, "{displaced} displaced, {changed} voxels changed");
    (displaced, json)
}

/// Middle of the brain, 42 mm from bone: 6 mm are admissible with offset 0.2.
const BRAIN: &str = "120.6,119.6,102:0,6,0";
/// Soft tissue under the skin at the side, 22 mm from bone: 6 mm are not.
const SIDE: &str = "36.4,155,40.5:6,0,0";
/// The brain again, where it is by then, back and across.
const ACROSS: &str = "120.6,125.6,102:-3,-5,2";

#[test]
fn the_real_head_keeps_every_link_its_bone_and_its_far_voxels() {
    let Some(head) = head() else { return };
    let (_, json) = push_and_check(&head, "one", &[BRAIN], &[]);
    assert_eq!(json["pushes"].as_array().unwrap().len(), 1);
    assert_eq!(json["map"]["failures"], 0);
    assert!((json["pushes"][0]["admitted_mm"][1].as_f64().unwrap() - 6.0).abs() < 1e-3, "{json}");
    let (_, json) = push_and_check(&head, "three", &[BRAIN, SIDE, ACROSS], &["--refusal", "components"]);
    let side = json["pushes"][1]["admitted_mm"][0].as_f64().unwrap();
    assert!(side > 1.0 && side < 5.0, "bone refuses a part: {json}");
}

#[test]
fn links_only_through_tissue_hold_as_well() {
    let Some(head) = head() else { return };
    push_and_check(&head, "tissue", &[BRAIN], &["--threshold", "-300"]);
}

#[test]
fn a_push_into_bone_is_refused_and_exits_with_0() {
    let Some(head) = head() else { return };
    let scratch = Scratch::new("bone");
    let out = scratch.file("out.nrrd");
    // outside the head's volume: nothing to push
    let output = maille(&["deform", head.to_str().unwrap(), "--push", "-500,0,0:0,-6,0", "-o", &out, "--json"]);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let json: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(json["pushes"][0]["refused_mm"], serde_json::json!([0.0, -6.0, 0.0]));
    assert_eq!(Nrrd::read(Path::new(&out)).shorts(), Nrrd::read(&head).shorts());
}

#[test]
fn wrong_use_exits_with_2_and_a_missing_file_with_1() {
    for push in ["1,2,3:NaN,0,0", "1,2,3:inf,0,0", "1,2,3", "a,b,c:1,2,3"] {
        assert_eq!(maille(&["deform", "nowhere.nrrd", "--push", push, "-o", "x.nrrd"]).status.code(), Some(2), "{push}");
    }
    let offset = maille(&["deform", "nowhere.nrrd", "--push", "1,2,3:0,1,0", "-o", "x.nrrd", "--offset", "-1"]);
    assert_eq!(offset.status.code(), Some(2));
    let missing = maille(&["deform", "nowhere.nrrd", "--push", "1,2,3:0,1,0", "-o", "x.nrrd"]);
    assert_eq!(missing.status.code(), Some(1));
    assert!(String::from_utf8_lossy(&missing.stderr).contains("nowhere.nrrd"));
}
