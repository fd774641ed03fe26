//! Before and after a push: the picture changes where the tissue moved, and nowhere else. On the real head, from the
//! program's own files, with a projection that shares nothing with the program.

use std::{
    fs::File,
    path::{Path, PathBuf},
    process::Command,
};

const SIZE: [usize; 2] = [612, 507];
const EYE: [f64; 3] = [122.0, -400.0, 80.0];
const TARGET: [f64; 3] = [122.0, 122.0, 80.0];
const FOV_DEG: f64 = 30.0;

fn maille(args: &[&str]) {
    let output = Command::new(env!("CARGO_BIN_EXE_maille")).args(args).output().expect("the program starts");
    assert!(output.status.success(), "maille {args:?}: {}", String::from_utf8_lossy(&output.stderr));
}

fn rgb(path: &Path) -> Vec<u8> {
    let decoder = png::Decoder::new(std::io::BufReader::new(File::open(path).unwrap()));
    let mut reader = decoder.read_info().unwrap();
    let mut bytes = vec![0; reader.output_buffer_size().unwrap()];
    let info = reader.next_frame(&mut bytes).unwrap();
    assert_eq!((info.width as usize, info.height as usize, info.color_type), (SIZE[0], SIZE[1], png::ColorType::Rgb));
    bytes
}

/// Column and row where a point is seen; the camera looks along +y with +z up, so that +x is to the right.
fn seen_at(p: [f64; 3]) -> [f64; 2] {
    let scale = SIZE[1] as f64 / 2.0 / (FOV_DEG.to_radians() / 2.0).tan() / (p[1] - EYE[1]);
    [SIZE[0] as f64 / 2.0 + (p[0] - EYE[0]) * scale, SIZE[1] as f64 / 2.0 - (p[2] - EYE[2]) * scale]
}

fn read(path: &Path) -> maille_volume::Volume {
    maille_volume::io::read_volume(path).unwrap().0
}

#[test]
fn a_push_changes_the_picture_at_the_dent_and_nowhere_else() {
    let Some(head) = maille_testkit::real_data("ct_head_invesalius/cranium_lps.nrrd") else { return };
    let scratch = std::env::temp_dir().join(format!("maille-pictures-{}", std::process::id()));
    std::fs::create_dir_all(&scratch).unwrap();
    let file = |name: &str| -> PathBuf { scratch.join(name) };
    let text = |path: &Path| path.to_str().unwrap().to_owned();
    let before = read(&head);

    // under the nose, the first skin on the way from the front
    let (grid, [i, k]) = (before.info.grid.clone(), [126, 11]);
    let j = (0..grid.size[1]).find(|&j| before.value(i, j, k) > -300.0).expect("the face is hit");
    let skin = grid.world_from_index([i as f64, j as f64, k as f64]);
    let deformed = file("deformed.nrrd");
    let push = format!("{:.3},{:.3},{:.3}:0,6,0", skin[0], skin[1] + 1.0, skin[2]);
    maille(&["deform", &text(&head), "--push", &push, "--offset", "0.3", "-o", &text(&deformed)]);
    let after = read(&deformed);

    let (eye, target, fov) = (EYE.map(|v| v.to_string()).join(","), TARGET.map(|v| v.to_string()).join(","), FOV_DEG.to_string());
    for transfer in ["ct", "skin"] {
        let picture = |volume: &Path, name: &str| {
            let (out, size) = (file(name), format!("{}x{}", SIZE[0], SIZE[1]));
            let camera = ["--eye", &eye, "--target", &target, "--up", "0,0,1", "--fov", &fov];
            let what = ["--size", &size, "--transfer", transfer, "-o", &text(&out)];
            maille(&[&["render", &text(volume)][..], &camera, &what].concat());
            rgb(&out)
        };
        let (was, is) = (picture(&head, "before.png"), picture(&deformed, "after.png"));

        // a changed voxel is seen through the cells and gradients around it: two voxels on every side
        let mut dent = vec![false; SIZE[0] * SIZE[1]];
        let mut changed = 0;
        for n in (0..grid.voxel_count()).filter(|&n| before.voxels[n] != after.voxels[n]) {
            let at = [n % grid.size[0], n / grid.size[0] % grid.size[1], n / (grid.size[0] * grid.size[1])];
            let (mut low, mut high) = ([f64::INFINITY; 2], [f64::NEG_INFINITY; 2]);
            for corner in 0..8 {
                let index = std::array::from_fn(|c| at[c] as f64 + if corner >> c & 1 == 1 { 2.0 } else { -2.0 });
                let p = seen_at(grid.world_from_index(index));
                for c in 0..2 {
                    (low[c], high[c]) = (low[c].min(p[c]), high[c].max(p[c]));
                }
            }
            for y in low[1].floor().max(0.0) as usize..(high[1].ceil() as usize).min(SIZE[1]) {
                dent[y * SIZE[0] + low[0] as usize..y * SIZE[0] + (high[0].ceil() as usize).min(SIZE[0])].fill(true);
            }
            changed += 1;
        }
        assert!(changed > 500, "tissue has moved: {changed} voxels");
        let area = dent.iter().filter(|&&d| d).count();
        assert!(area < SIZE[0] * SIZE[1] / 10, "the dent is a small part of the picture: {area} pixels");
        let (mut inside, mut outside) = (0, 0);
        for (n, (a, b)) in was.chunks_exact(3).zip(is.chunks_exact(3)).enumerate() {
            let difference = (0..3).map(|c| a[c].abs_diff(b[c])).max().unwrap();
            let worst = if dent[n] { &mut inside } else { &mut outside };
            *worst = difference.max(*worst);
        }
        println!("{transfer}: {changed} voxels changed, {area} pixels of dent, worst inside {inside}/255, outside {outside}/255");
        assert!(inside > 10, "{transfer}: the dent is seen: {inside}/255");
        assert!(outside <= 1, "{transfer}: nothing else changes: {outside}/255");
    }
    std::fs::remove_dir_all(&scratch).unwrap();
}
