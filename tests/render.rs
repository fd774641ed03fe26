//! `maille render` as a person uses it: files in, a PNG out, exit status as the contract says.

use std::{
    fs,
    path::{Path, PathBuf},
    process::{Command, Output},
};

/// A directory of this test's own, removed at the end.
struct Folder(PathBuf);

impl Folder {
    fn new(name: &str) -> Self {
        let path = std::env::temp_dir().join(format!("maille-render-{name}-{}", std::process::id()));
        fs::create_dir_all(&path).unwrap();
        Self(path)
    }

    fn path(&self, name: &str) -> PathBuf {
        self.0.join(name)
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        let _ = fs::remove_dir_all(&self.0);
    }
}

fn maille(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_maille")).arg("render").args(arguments).output().unwrap()
}

/// Renders, and reads the picture back: width, height, RGB.
fn picture(volume: &Path, out: &Path, arguments: &[&str]) -> (usize, usize, Vec<u8>) {
    let mut all = vec![volume.to_str().unwrap(), "-o", out.to_str().unwrap()];
    all.extend(arguments);
    let output = maille(&all);
    assert!(output.status.success(), "{arguments:?}: {}", String::from_utf8_lossy(&output.stderr));
    assert!(output.stdout.is_empty(), "standard output is for results");
    let mut reader = png::Decoder::new(std::io::BufReader::new(fs::File::open(out).unwrap())).read_info().unwrap();
    let mut pixels = vec![0; reader.output_buffer_size().unwrap()];
    let info = reader.next_frame(&mut pixels).unwrap();
    assert_eq!(info.color_type, png::ColorType::Rgb);
    (info.width as usize, info.height as usize, pixels)
}

/// A raw NRRD of 64³ voxels of 1 mm around the origin, from a function of position.
fn write_nrrd(path: &Path, hu: impl Fn([f64; 3]) -> f64) {
    let mut bytes = b"NRRD0004\ntype: int16\ndimension: 3\nspace: left-posterior-superior\nsizes: 64 64 64\n\
        space directions: (1,0,0) (0,1,0) (0,0,1)\nendian: little\nencoding: raw\nspace origin: (-31.5,-31.5,-31.5)\n\n"
        .to_vec();
    for n in 0..64 * 64 * 64 {
        let x = [n % 64, n / 64 % 64, n / 4096].map(|i| i as f64 - 31.5);
        bytes.extend((hu(x).clamp(-1000.0, 3000.0) as i16).to_le_bytes());
    }
    fs::write(path, bytes).unwrap();
}

fn ball(x: [f64; 3], center: [f64; 3], radius: f64) -> f64 {
    (radius - (0..3).map(|c| (x[c] - center[c]).powi(2)).sum::<f64>().sqrt()) * 500.0
}

#[test]
fn a_ball_has_the_silhouette_that_perspective_gives_it() {
    let folder = Folder::new("ball");
    let volume = folder.path("ball.nrrd");
    write_nrrd(&volume, |x| ball(x, [0.0; 3], 20.0).clamp(-1000.0, 1000.0));
    let view = ["--eye=0,-200,0", "--target", "0,0,0", "--up=0,0,1", "--fov", "20", "--size", "240x200", "--iso", "0"];
    let (width, height, rgb) = picture(&volume, &folder.path("ball.png"), &view);
    assert_eq!((width, height), (240, 200));
    let seen = rgb.chunks(3).filter(|p| p[0] > 12).count() as f64;
    let radius = 100.0 * (20f64 / 200.0).asin().tan() / 10f64.to_radians().tan();
    let measured = (seen / std::f64::consts::PI).sqrt();
    // the border pixels' share: half a pixel
    assert!((measured - radius).abs() < 0.6, "{measured} pixels, {radius} expected");
}

#[test]
fn the_nearer_of_two_balls_hides_the_other() {
    let folder = Folder::new("order");
    let volume = folder.path("two.nrrd");
    // one far below the background, one far above it: no shell of the one has the colour of the other
    write_nrrd(&volume, |x| {
        let near = ball(x, [0.0, -18.0, 0.0], 8.0).clamp(0.0, 1000.0);
        let far = ball(x, [0.0, 18.0, 0.0], 8.0).clamp(0.0, 1000.0);
        far - near
    });
    let transfer = folder.path("tf.toml");
    fs::write(&transfer, "color = [[-1, 1, 0, 0], [1, 0, 1, 0]]\nopacity = [[-500, 1], [-300, 0], [300, 0], [500, 1]]\n").unwrap();
    let red = |eye: &str| {
        let arguments = [eye, "--target=0,0,0", "--no-shade", "--size=41x41", "--transfer", transfer.to_str().unwrap()];
        let (_, _, rgb) = picture(&volume, &folder.path("two.png"), &arguments);
        let at = 3 * (20 * 41 + 20);
        rgb[at] > 200 && rgb[at + 1] < 50
    };
    assert!(red("--eye=0,-200,0"));
    assert!(!red("--eye=0,200,0"), "from behind, the other one is in front");
}

#[test]
fn the_step_hardly_changes_a_smooth_picture() {
    let folder = Folder::new("step");
    let volume = folder.path("fog.nrrd");
    write_nrrd(&volume, |x| (ball(x, [0.0; 3], 25.0) * 0.1).clamp(-1000.0, 150.0));
    let transfer = folder.path("fog.json");
    fs::write(&transfer, r#"{"color": [[-500,1,0.8,0.6]], "opacity": [[-400,0],[200,0.05]]}"#).unwrap();
    let steps: Vec<_> = ["1mm", "0.5vox", "0.25mm"]
        .iter()
        .map(|step| {
            let arguments = ["--no-shade", "--size=80x60", "--step", step, "--transfer", transfer.to_str().unwrap()];
            picture(&volume, &folder.path("fog.png"), &arguments).2
        })
        .collect();
    assert!(steps[2].iter().any(|&v| v > 100));
    for coarse in &steps[..2] {
        let worst = coarse.iter().zip(&steps[2]).map(|(a, b)| a.abs_diff(*b)).max().unwrap();
        // half a step of fog of 0.05 at the volume's border is 0.025 of full scale
        assert!(worst <= 7, "{worst}");
    }
}

#[test]
fn every_view_shows_something() {
    let folder = Folder::new("views");
    let volume = folder.path("ball.nrrd");
    write_nrrd(&volume, |x| ball(x, [0.0; 3], 20.0).clamp(-1000.0, 300.0));
    for view in ["3d", "axial", "coronal", "sagittal", "xray"] {
        let (width, height, rgb) = picture(&volume, &folder.path("view.png"), &["--view", view, "--size", "90x70"]);
        assert_eq!(rgb.len(), 3 * width * height);
        let bright = rgb.chunks(3).filter(|p| p[0] > 40).count();
        assert!(bright > 200 && bright < 90 * 70, "{view}: {bright}");
    }
    // a probe on the ball, with a little gel
    let probe = ["--view=ultrasound", "--eye=0,-22,0", "--target=0,0,0", "--depth=40", "--size=90x70"];
    let (_, _, rgb) = picture(&volume, &folder.path("view.png"), &probe);
    let bright = rgb.chunks(3).filter(|p| p[0] > 40).count();
    assert!(bright > 200 && bright < 90 * 70, "ultrasound: {bright}");
    let (_, _, rgb) = picture(&volume, &folder.path("view.png"), &["--view=axial", "--at=-30", "--size=50x50"]);
    assert!(rgb.iter().all(|&v| v < 40), "below the ball there is air");
}

#[test]
fn a_scene_renders_with_its_own_patient_and_camera() {
    let folder = Folder::new("scene");
    let scene = folder.path("scene.toml");
    fs::write(&scene, "[volume]\nphantom = \"head\"\nsize = 48\n\n[rendering]\nsize = [64, 48]\n").unwrap();
    let (width, height, rgb) = picture(&scene, &folder.path("scene.png"), &[]);
    assert_eq!((width, height), (64, 48));
    assert!(rgb.chunks(3).filter(|p| p[0] > 20).count() > 100);
}

#[test]
fn a_scene_renders_with_its_organs_one_of_them_alone_and_its_meshes() {
    let folder = Folder::new("organs");
    write_nrrd(&folder.path("v.nrrd"), |x| {
        let [a, b] = [ball(x, [-12.0, 0.0, 0.0], 10.0), ball(x, [14.0, 0.0, 0.0], 8.0)];
        a.max(b).clamp(-1000.0, 1000.0)
    });
    let drawn = |name: &str, alone: &str, rows: &str, view: &[&str]| {
        let scene = folder.path(&format!("{name}.toml"));
        let head = "[volume]\nfile = \"v.nrrd\"\n[rendering]\nsize = [96, 64]\nsection_size = [64, 64]\nfrom = [0.0, -1.0, 0.0]\n";
        fs::write(&scene, format!("{head}{alone}{rows}")).unwrap();
        picture(&scene, &folder.path(&format!("{name}.png")), view).2
    };
    let organ = "[[organ]]\nname = \"left\"\nhu = [[0.0, 3000.0]]\nseed_mm = [14.0, 0.0, 0.0]\n";
    let mesh = "[[mesh]]\norgan = \"left\"\ncolor = [0.0, 1.0, 0.0]\n";
    // pixels that are not background, in each half: seen from the front the patient's left is at the right
    let halves = |rgb: &[u8]| {
        let mut seen = [0; 2];
        for (n, p) in rgb.chunks(3).enumerate() {
            seen[usize::from(n % 96 >= 48)] += usize::from(p.iter().zip(&rgb[..3]).any(|(a, b)| a.abs_diff(*b) > 2));
        }
        seen
    };
    let green = |rgb: &[u8]| rgb.chunks(3).filter(|p| p[1] > 60 && p[0] < 20 && p[2] < 20).count();
    let bare = drawn("bare", "", "", &[]);
    let alone = drawn("alone", "alone = \"left\"\n", organ, &[]);
    let meshed = drawn("mesh", "", &format!("{organ}{mesh}"), &[]);
    let ([right, left], [hidden, shown]) = (halves(&bare), halves(&alone));
    assert!(right > 100 && left > 100 && hidden == 0 && 10 * shown > 8 * left, "{right} {left} {hidden} {shown}");
    assert!(green(&bare) == 0 && green(&meshed) > left / 3, "{} of {left}", green(&meshed));
    // sections: coloured, and outlined
    let axial = ["--view", "axial"];
    let grey = |rgb: &[u8]| rgb.chunks(3).filter(|p| p[0] == p[1] && p[1] == p[2]).count();
    let [bare, labelled, outlined] = [("bare", "".into()), ("labels", organ.to_owned()), ("mesh", format!("{organ}{mesh}"))]
        .map(|(name, rows)| drawn(name, "", &rows, &axial));
    assert!(grey(&bare) == 64 * 64 && grey(&labelled) + 100 < grey(&bare), "{}", grey(&labelled));
    assert!(green(&outlined) > 20 && green(&labelled) < green(&outlined));
}

#[test]
fn what_cannot_be_done_is_one_sentence_and_status_1() {
    let folder = Folder::new("refused");
    let (out, text) = (folder.path("out.png"), folder.path("text.nrrd"));
    let out = out.to_str().unwrap();
    fs::write(&text, "not a volume").unwrap();
    let good = folder.path("good.nrrd");
    write_nrrd(&good, |_| 0.0);
    let good = good.to_str().unwrap();
    for arguments in [
        vec!["/no/such/volume.nrrd", "-o", out],
        vec![text.to_str().unwrap(), "-o", out],
        vec![good, "-o", "/no/such/folder/out.png"],
        vec![good, "-o", out, "--transfer", "no-such-preset"],
    ] {
        let output = maille(&arguments);
        let error = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(1), "{arguments:?}: {error}");
        assert!(error.trim().lines().count() == 1 && !error.contains("panicked"), "{arguments:?}: {error}");
    }
}

#[test]
fn the_gpu_draws_what_the_cpu_draws_and_without_one_it_is_said() {
    let folder = Folder::new("gpu");
    let (volume, out) = (folder.path("ball.nrrd"), folder.path("out.png"));
    write_nrrd(&volume, |x| ball(x, [0.0; 3], 20.0).clamp(-1000.0, 1000.0));
    let asked = ["--iso=0", "--size=60x48", "--backend=gpu"];
    let mut command = Command::new(env!("CARGO_BIN_EXE_maille"));
    command.arg("render").arg(&volume).arg("-o").arg(&out).args(asked);
    let without = command.env("VK_DRIVER_FILES", "/no/such/driver").env("VK_ICD_FILENAMES", "/no/such/driver").output().unwrap();
    let error = String::from_utf8_lossy(&without.stderr);
    assert_eq!(without.status.code(), Some(1), "{error}");
    assert!(error.contains("no GPU that Vulkan knows") && error.trim().lines().count() == 1, "{error}");
    let with = maille(&[&[volume.to_str().unwrap(), "-o", out.to_str().unwrap()], &asked[..]].concat());
    let error = String::from_utf8_lossy(&with.stderr);
    if !with.status.success() && error.contains("no GPU that Vulkan knows") {
        assert!(std::env::var_os("CI").is_none(), "CI needs a Vulkan driver (mesa-vulkan-drivers): {error}");
        eprintln!("SKIPPED: {error}");
        return;
    }
    let (_, _, gpu) = picture(&volume, &out, &asked);
    let (_, _, cpu) = picture(&volume, &out, &asked[..2]);
    let far = cpu.iter().zip(&gpu).filter(|(a, b)| a.abs_diff(**b) > 2).count();
    assert!(far * 200 <= cpu.len() && cpu.iter().any(|&v| v > 20), "{far} of {} bytes differ", cpu.len());
    let probe = ["--view=ultrasound", "--eye=0,-22,0", "--target=0,0,0", "--depth=40", "--size=90x70"];
    let (_, _, gpu) = picture(&volume, &out, &[&probe[..], &["--backend=gpu"]].concat());
    let (_, _, cpu) = picture(&volume, &out, &probe);
    let far = cpu.iter().zip(&gpu).filter(|(a, b)| a.abs_diff(**b) > 2).count();
    assert!(far * 1000 <= cpu.len() && cpu.iter().any(|&v| v > 20), "ultrasound: {far} of {} bytes differ", cpu.len());
}

#[test]
fn wrong_numbers_are_wrong_use_status_2() {
    let folder = Folder::new("usage");
    let volume = folder.path("ball.nrrd");
    write_nrrd(&volume, |_| 0.0);
    let out = folder.path("out.png");
    for wrong in [
        "--eye=nan,0,0",
        "--eye=1,2",
        "--target=inf,0,0",
        "--fov=180",
        "--fov=-3",
        "--step=0",
        "--step=1foot",
        "--size=0x10",
        "--size=big",
        "--iso=nan",
        "--view=inside-out",
    ] {
        let output = maille(&[volume.to_str().unwrap(), "-o", out.to_str().unwrap(), wrong]);
        assert_eq!(output.status.code(), Some(2), "{wrong}: {}", String::from_utf8_lossy(&output.stderr));
        assert!(!out.exists());
    }
    let same = ["--eye=1,2,3", "--target=1,2,3"];
    let output = maille(&[volume.to_str().unwrap(), "-o", out.to_str().unwrap(), same[0], same[1]]);
    assert_eq!(output.status.code(), Some(2));
}

#[test]
fn a_mesh_of_a_surface_is_seen_where_the_surface_is_and_outlined_in_sections() {
    let folder = Folder::new("mesh");
    let (volume, air) = (folder.path("ball.nrrd"), folder.path("air.nrrd"));
    write_nrrd(&volume, |x| ball(x, [5.0, 0.0, 0.0], 15.0).clamp(-1000.0, 1000.0));
    write_nrrd(&air, |_| -1000.0);
    let view = ["--eye=0,-200,0", "--target", "0,0,0", "--up=0,0,1", "--fov", "20", "--size", "160x120"];
    let (_, _, surface) = picture(&volume, &folder.path("iso.png"), &[&view[..], &["--iso", "0"]].concat());
    let silhouette = |rgb: &[u8]| rgb.chunks(3).map(|p| p.iter().any(|&v| v > 12)).collect::<Vec<_>>();
    for ending in ["stl", "ply", "obj"] {
        let mesh = folder.path(&format!("ball.{ending}"));
        let args = ["surface", volume.to_str().unwrap(), "--iso", "0", "-o", mesh.to_str().unwrap()];
        assert!(Command::new(env!("CARGO_BIN_EXE_maille")).args(args).status().unwrap().success());
        let with = ["--mesh", mesh.to_str().unwrap()];
        let (_, _, drawn) = picture(&air, &folder.path("mesh.png"), &[&view[..], &with].concat());
        let (a, b) = (silhouette(&surface), silhouette(&drawn));
        let (both, either) = a.iter().zip(&b).fold((0, 0), |(n, m), (a, b)| (n + usize::from(*a && *b), m + usize::from(*a || *b)));
        assert!(both * 100 >= either * 97 && both > 500, "{ending}: {both} of {either}");
        // the circle of 15 mm around (5, 0), on black, one pixel a millimetre
        let (width, _, section) =
            picture(&air, &folder.path("cut.png"), &[&["--view", "axial", "--at", "0", "--size", "64x64"], &with[..]].concat());
        let lit: Vec<f64> =
            (0..64 * 64).filter(|n| section[3 * n] > 100).map(|n| ((n % width) as f64 - 36.5).hypot((n / width) as f64 - 31.5)).collect();
        assert!(lit.len() > 60 && lit.iter().all(|r| (r - 15.0).abs() < 1.8), "{ending}: {lit:?}");
    }
    let broken = folder.path("broken.stl");
    fs::write(&broken, "solid nothing").unwrap();
    let output = maille(&[air.to_str().unwrap(), "-o", "/dev/null", "--mesh", broken.to_str().unwrap()]);
    assert_eq!(output.status.code(), Some(1));
    assert!(String::from_utf8_lossy(&output.stderr).contains("broken.stl"));
}

/// A raw NRRD of vectors on 17³ nodes of 4 mm over the same box, from a function of position.
fn write_field(path: &Path, mm: impl Fn([f64; 3]) -> [f32; 3]) {
    let mut bytes =
        b"NRRD0004\ntype: float\ndimension: 4\nspace: left-posterior-superior\nsizes: 3 17 17 17\nkinds: vector domain domain domain\n\
        space directions: none (4,0,0) (0,4,0) (0,0,4)\nendian: little\nencoding: raw\nspace origin: (-32,-32,-32)\n\n"
            .to_vec();
    for n in 0..17 * 17 * 17 {
        let x = [n % 17, n / 17 % 17, n / 289].map(|i| 4.0 * i as f64 - 32.0);
        mm(x).iter().for_each(|c| bytes.extend(c.to_le_bytes()));
    }
    fs::write(path, bytes).unwrap();
}

/// Mean difference of the bytes.
fn apart(a: &[u8], b: &[u8]) -> f64 {
    a.iter().zip(b).map(|(a, b)| f64::from(a.abs_diff(*b))).sum::<f64>() / a.len() as f64
}

#[test]
fn a_moved_patient_is_drawn_where_it_is_by_rays_and_by_resampling_in_all_views() {
    let folder = Folder::new("warp");
    let [rest, moved, field] = ["rest.nrrd", "moved.nrrd", "field.nrrd"].map(|name| folder.path(name));
    write_nrrd(&rest, |x| ball(x, [-4.0, 2.0, 0.0], 14.0));
    write_nrrd(&moved, |x| ball(x, [4.0, 2.0, -5.0], 14.0));
    write_field(&field, |_| [8.0, 0.0, -5.0]);
    let field = field.to_str().unwrap();
    for view in [&["--view", "axial"][..], &["--view", "sagittal"], &["--view", "xray"], &["--iso", "0"], &[]] {
        let options = [&["--size", "120x96", "--threads", "2"][..], view].concat();
        let there = picture(&moved, &folder.path("there.png"), &options).2;
        let still = picture(&rest, &folder.path("still.png"), &options).2;
        let through =
            |scheme| picture(&rest, &folder.path("warped.png"), &[&options[..], &["--warp", field, "--warp-scheme", scheme]].concat()).2;
        for scheme in ["lattice", "resample"] {
            let off = apart(&through(scheme), &there);
            println!("{view:?} {scheme}: {off:.3} of 255 from the patient who lies there; unmoved {:.3}", apart(&still, &there));
            assert!(off < 0.6 && 6.0 * off < apart(&still, &there), "{view:?} {scheme}");
        }
    }
    let output = maille(&[rest.to_str().unwrap(), "-o", folder.path("no.png").to_str().unwrap(), "--warp", rest.to_str().unwrap()]);
    assert_eq!(output.status.code(), Some(1), "a volume is no field");
}

#[test]
fn an_overlay_colours_what_moves_by_its_direction_in_sections_and_in_3d() {
    let folder = Folder::new("overlay");
    let [volume, field] = ["ball.nrrd", "field.nrrd"].map(|name| folder.path(name));
    write_nrrd(&volume, |x| ball(x, [0.0; 3], 20.0));
    // up on the patient's left, down on the right
    write_field(&field, |x| [0.0, 0.0, 12.0 * (x[0] / 8.0).clamp(-1.0, 1.0) as f32]);
    let field = field.to_str().unwrap();
    for view in [&["--view", "coronal"][..], &["--iso", "0"]] {
        let options = [&["--size", "100x100"][..], view].concat();
        let plain = picture(&volume, &folder.path("plain.png"), &options).2;
        let (_, _, pixels) = picture(&volume, &folder.path("tinted.png"), &[&options[..], &["--overlay", field]].concat());
        let at = |x: usize| [0, 1, 2].map(|c| pixels[3 * (50 * 100 + x) + c]);
        // seen from the front, the patient's left is the picture's right
        let near = |a: [u8; 3], b: [u8; 3]| a.iter().zip(b).all(|(a, b)| a.abs_diff(b) <= 3);
        assert!(near(at(65), [128, 255, 0]) && near(at(35), [128, 0, 255]), "{view:?}: {:?} {:?}", at(65), at(35));
        let middle = 3 * (50 * 100 + 50);
        assert!(apart(&pixels[middle..middle + 3], &plain[middle..middle + 3]) < 40.0, "where little moves little is coloured");
    }
}
