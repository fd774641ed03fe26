//! Every file of the shared real data, walked: those whose geometry is published or was verified with independent
//! readers (SimpleITK, nibabel, pynrrd) must agree with it; those no reader can get right must be refused in one
//! sentence; none may panic.

use maille_volume::io::{self, ReadOptions};
use std::{
    fs,
    path::{Path, PathBuf},
};

/// Where the data lie; `None`, said loudly, where they do not. On CI they must be there.
fn data() -> Option<PathBuf> {
    let default = concat!(env!("CARGO_MANIFEST_DIR"), "/../../../shared/data");
    let path = PathBuf::from(std::env::var("MAILLE_DATA").unwrap_or_else(|_| default.into()));
    if path.join("MANIFEST.md").exists() {
        return Some(path);
    }
    assert!(std::env::var_os("CI").is_none(), "CI must have the real data; {} is missing", path.display());
    println!("SKIPPED: no real data at {} (set MAILLE_DATA)", path.display());
    None
}

/// What independent readers say of a file.
struct Published {
    path: &'static str,
    size: [usize; 3],
    spacing: [f64; 3],
    origin: [f64; 3],
    direction: [f64; 9],
    type_name: &'static str,
    components: usize,
    frames: usize,
    /// minimum, maximum and mean of the rescaled values
    values: [f64; 3],
}

const I: [f64; 9] = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0];
const RAS: [f64; 9] = [-1.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0, 1.0];
const LAS: [f64; 9] = [1.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0, 1.0];

#[allow(clippy::too_many_arguments)] // a row of a table
const fn row(
    path: &'static str,
    size: [usize; 3],
    spacing: [f64; 3],
    origin: [f64; 3],
    direction: [f64; 9],
    type_name: &'static str,
    components: usize,
    frames: usize,
    values: [f64; 3],
) -> Published {
    Published { path, size, spacing, origin, direction, type_name, components, frames, values }
}

#[rustfmt::skip]
const PUBLISHED: &[Published] = &[
    row("ct_head_invesalius/cranium_lps.nrrd", [256, 256, 108], [0.9570312, 0.9570312, 1.5], [0.0; 3], I, "int16", 1, 1, [-1024.0, 2986.0, -585.9552803039551]),
    row("ct_thorax_lidc0314/lidc0314_half.nrrd", [256, 256, 137], [1.5625, 1.5625, 2.0], [-200.609375, -58.609375, -679.300049], I, "int16", 1, 1, [-1000.0, 1851.0, -619.988794591305]),
    row("ct_thorax_lidc0314/dicom_24slices/000013.dcm", [512, 512, 1], [0.78125, 0.78125, 1.0], [-201.0, -59.0, -647.800049], I, "int16", 1, 1, [-1000.0, 1586.0, -608.2364959716797]),
    row("ct_abdomen_totalsegmentator/example_ct.nii.gz", [122, 101, 112], [3.0; 3], [177.95633, -11.319, 94.30176], RAS, "int32", 1, 1, [-1207.0, 3382.0, -360.0203852864795]),
    row("ct_abdomen_totalsegmentator/example_seg_labels.nii.gz", [122, 101, 112], [3.0; 3], [177.95633, -11.319, 94.30176], RAS, "uint8", 1, 1, [0.0, 59.0, 5.808590036404109]),
    row("ct_vtkjs/LIDC2_lps.nrrd", [256, 256, 133], [1.40625, 1.40625, 2.5], [0.0; 3], I, "uint8", 1, 1, [0.0, 255.0, 7.054514261116659]),
    row("4dct_tcia_118/phase01.mha", [120, 119, 107], [1.0; 3], [0.0; 3], I, "int16", 1, 1, [-1000.0, 1418.0, -209.8198473782036]),
    row("4dct_tcia_118/phase10.mha", [120, 119, 107], [1.0; 3], [0.0; 3], I, "int16", 1, 1, [-1000.0, 1498.0, -223.78482682792745]),
    row("4dct_tcia_118/original_multiframe_image1.dcm", [120, 119, 107], [1.0; 3], [0.0; 3], I, "uint16", 1, 1, [0.0, 2418.0, 790.1801526217964]),
    row("ct_lung_elastix/3DCT_lung.mha", [115, 157, 129], [1.366, 1.366, 2.5], [-153.827, -150.352, -1434.5], I, "int16", 1, 1, [-1255.0, 1474.0, -351.72059190372227]),
    row("ct_lung_elastix/3DCT_lung_baseline_small.mha", [57, 78, 64], [2.732, 2.732, 5.0], [-152.461, -148.986, -1432.0], I, "int16", 1, 1, [-1130.0, 1379.0, -349.9505138045434]),
    row("ct_lung_elastix/derived_displacement_baseline_to_followup.mha", [57, 78, 64], [2.732, 2.732, 5.0], [-152.461, -148.986, -1432.0], I, "float32", 3, 1, [-20.496564865112305, 51.35210037231445, 8.513230804890672]),
    row("mr_head_ch2/ch2.nii.gz", [181, 217, 181], [1.0; 3], [90.0, 125.0, -71.0], RAS, "uint8", 1, 1, [0.0, 254.0, 44.61177355282364]),
    row("importer/nibabel/anatomical.nii", [33, 41, 25], [2.0; 3], [-32.0, 40.0, -16.0], LAS, "int16", 1, 1, [-610.0, 30393.0, 8401.066725794532]),
    row("importer/nibabel/functional.nii", [17, 21, 3], [4.0, 4.0, 8.0], [-32.0, 40.0, 0.0], LAS, "float32", 1, 20, [629.826171875, 5571.6220703125, 3637.4085152676794]),
    row("importer/nibabel/standard.nii.gz", [4, 5, 7], [1.0, 3.0, 2.0], [0.0; 3], RAS, "uint8", 1, 1, [0.0, 255.0, 54.642857142857146]),
    row("importer/nibabel/reoriented_anat_moved.nii", [21, 26, 22], [4.0; 3], [35.2979, 47.97758, -27.59941], RAS, "float32", 1, 1, [0.0, 21199.935546875, 2725.588532230912]),
    row("importer/nibabel/0.dcm", [256, 256, 1], [1.796875, 1.796875, 3.0], [-805.0, -825.019119, -75.097641], [1.0, 0.0, 0.0, 0.0, 0.999986, 0.005236, 0.0, -0.005236, 0.999986], "uint16", 1, 1, [0.0, 4095.0, 2047.5]),
    row("importer/pydicom/CT_small.dcm", [128, 128, 1], [0.661468, 0.661468, 5.0], [-158.135803, -179.035797, -75.699997], I, "int16", 1, 1, [-896.0, 1167.0, -119.0738525390625]),
    // JPEG 2000
    row("importer/pydicom/693_J2KI.dcm", [512, 512, 1], [0.478516, 0.478516, 20.0], [-122.5, -112.4, 47.0], I, "int16", 1, 1, [-3995.0, 1812.0, -1032.3228454589844]),
    row("importer/pydicom/JPEG2000.dcm", [256, 1024, 1], [2.26, 2.26, 1.0], [0.0; 3], I, "int16", 1, 1, [-30.0, 245.0, 13.458160400390625]),
    row("importer/pydicom/MR_small_jp2klossless.dcm", [64, 64, 1], [0.3125, 0.3125, 1.0], [-83.9063, -91.2, 6.6406], I, "int16", 1, 1, [127.0, 2145.0, 518.88134765625]),
    row("importer/pydicom/rtdose.dcm", [10, 10, 15], [10.0, 10.0, 5.0], [189.43125, 199.43125, -761.87], I, "uint32", 1, 1, [795_000.0, 1_254_000.0, 1_013_273.3333333334]),
    // SimpleITK 2.5 swaps the bytes of this one; it holds what rtdose.dcm holds.
    row("importer/pydicom/rtdose_expb.dcm", [10, 10, 15], [10.0, 10.0, 5.0], [189.43125, 199.43125, -761.87], I, "uint32", 1, 1, [795_000.0, 1_254_000.0, 1_013_273.3333333334]),
    row("importer/pynrrd/BallBinary30x30x30.nhdr", [30; 3], [1.0; 3], [0.0; 3], I, "int16", 1, 1, [0.0, 257.0, 136.38133333333334]),
    row("importer/pynrrd/BallBinary30x30x30.nrrd", [30; 3], [1.0; 3], [0.0; 3], I, "int16", 1, 1, [0.0, 257.0, 136.38133333333334]),
    row("importer/pynrrd/BallBinary30x30x30.nii.gz", [30; 3], [1.0; 3], [0.0; 3], I, "int16", 1, 1, [0.0, 257.0, 136.38133333333334]),
    row("importer/pynrrd/BallBinary30x30x30_bz2.nrrd", [30; 3], [1.0; 3], [0.0; 3], I, "int16", 1, 1, [0.0, 257.0, 136.38133333333334]),
    row("importer/pynrrd/BallBinary30x30x30_gz.nrrd", [30; 3], [1.0; 3], [0.0; 3], I, "int16", 1, 1, [0.0, 257.0, 136.38133333333334]),
    row("importer/pynrrd/BallBinary30x30x30_gz_byteskip_minus_one.nrrd", [30; 3], [1.0; 3], [0.0; 3], I, "int16", 1, 1, [0.0, 257.0, 136.38133333333334]),
    row("importer/pynrrd/BallBinary30x30x30_gz_lineskip.nrrd", [30; 3], [1.0; 3], [0.0; 3], I, "int16", 1, 1, [0.0, 257.0, 136.38133333333334]),
    row("importer/pynrrd/BallBinary30x30x30_byteskip_minus_one.nhdr", [30; 3], [1.0; 3], [0.0; 3], I, "int16", 1, 1, [0.0, 257.0, 136.38133333333334]),
    row("importer/pynrrd/BallBinary30x30x30_byteskip_minus_one_nifti.nhdr", [30; 3], [1.0; 3], [0.0; 3], I, "int16", 1, 1, [0.0, 257.0, 136.38133333333334]),
    row("importer/pynrrd/test2d_ascii.nrrd", [3, 9, 1], [1.0458, 2.0, 1.0], [0.0; 3], I, "uint16", 1, 1, [1.0, 27.0, 14.0]),
];

/// Files that must be refused: damaged, without an image, or not to be read right.
const REFUSED: &[&str] = &[
    "importer/pynrrd/BallBinary30x30x30_byteskip_minus_five.nhdr",
    // Its data begin with the header of another format, which SimpleITK reads as voxels.
    "importer/pynrrd/BallBinary30x30x30_nifti.nhdr",
    "importer/pynrrd/BallBinary30x30x30.raw",
    "importer/nibabel/analyze.hdr",
    "importer/nibabel/nifti1.hdr",
    "importer/nibabel/nifti2.hdr",
    "importer/nibabel/row_major.dconn.nii",
    "importer/pydicom/MR_truncated.dcm",
    "importer/pydicom/badVR.dcm",
    "importer/pydicom/rtplan.dcm",
    "importer/pydicom/rtplan_truncated.dcm",
    "importer/pydicom/rtstruct.dcm",
    "importer/pydicom/test-SR.dcm",
    "importer/pydicom/reportsi.dcm",
    "importer/pydicom/waveform_ecg.dcm",
    "importer/pydicom/zipMR.gz",
    "ct_vtkjs/LIDC2.vti/index.json",
    "ct_vtkjs/headsq.vti/index.json",
    "MANIFEST.md",
    // Several series of unlike images in one directory.
    "importer/pydicom",
    "importer/pynrrd",
];

fn close(ours: &[f64], theirs: &[f64], tolerance: f64) -> bool {
    ours.iter().zip(theirs).all(|(a, b)| (a - b).abs() <= tolerance * b.abs().max(1.0))
}

#[test]
fn files_agree_with_their_published_geometry_and_values() {
    let Some(data) = data() else { return };
    for p in PUBLISHED {
        let reading = io::read(&data.join(p.path), &ReadOptions::default()).unwrap_or_else(|e| panic!("{e}"));
        let image = &reading.image;
        let g = &image.grid;
        assert_eq!((g.size, image.components, image.frames), (p.size, p.components, p.frames), "{}", p.path);
        assert_eq!(io::value_type_name(image), p.type_name, "{}", p.path);
        // The table has five decimals where a header is single precision; real disagreements are voxels, or signs.
        assert!(close(&g.spacing, &p.spacing, 1e-6), "{}: spacing {:?}", p.path, g.spacing);
        assert!(close(&g.origin, &p.origin, 1e-6), "{}: origin {:?}", p.path, g.origin);
        assert!(close(&g.direction, &p.direction, 1e-5), "{}: direction {:?}", p.path, g.direction);
        let (min, max) = image.pixels.finite_range().expect("finite values");
        let mean = image.pixels.iter_f64().sum::<f64>() / image.pixels.len() as f64;
        let ours = [min, max, mean].map(|v| image.rescale.value(v));
        // A reader that rescales in single precision leaves 6e-8.
        assert!(close(&ours, &p.values, 1e-6), "{}: values {ours:?}", p.path);
    }
}

#[test]
fn what_cannot_be_read_right_is_refused_in_one_sentence_that_names_the_file() {
    let Some(data) = data() else { return };
    for path in REFUSED {
        let error = io::read(&data.join(path), &ReadOptions::default()).map(|_| ()).expect_err(path).to_string();
        assert!(!error.contains('\n'), "{error:?}");
        assert!(error.contains("importer/") || error.contains(path), "{error:?} does not name {path}");
    }
}

#[test]
fn no_file_panics_and_every_readable_one_survives_import_and_reimport() {
    let Some(data) = data() else { return };
    let scratch = std::env::temp_dir().join(format!("maille-real-files-{}", std::process::id()));
    fs::create_dir_all(&scratch).unwrap();
    let mut read = 0;
    for file in walk(&data) {
        let Ok(reading) = io::read(&file, &ReadOptions::default()) else { continue };
        read += 1;
        for extension in ["nrrd", "mha", "nii"] {
            let (one, two) = (scratch.join(format!("one.{extension}")), scratch.join(format!("two.{extension}")));
            io::write_image(&one, &reading.image).unwrap_or_else(|e| panic!("{e}"));
            let again = io::read(&one, &ReadOptions::default()).unwrap_or_else(|e| panic!("{}: {e}", file.display()));
            io::write_image(&two, &again.image).unwrap();
            assert!(fs::read(&one).unwrap() == fs::read(&two).unwrap(), "{} changes when {extension} is imported again", file.display());
            assert_eq!(io::value_type_name(&again.image), io::value_type_name(&reading.image), "{}", file.display());
            if reading.image.rescale == again.image.rescale && !reading.image.pixels.iter_f64().any(f64::is_nan) {
                assert!(again.image.pixels == reading.image.pixels, "{}: {extension} changes values", file.display());
            }
            // NIfTI keeps geometry in single precision.
            let tolerance = if extension == "nii" { 1e-5 } else { 1e-12 };
            let (a, b) = (&again.image.grid, &reading.image.grid);
            assert_eq!(a.size, b.size);
            assert!(close(&a.spacing, &b.spacing, tolerance) && close(&a.origin, &b.origin, tolerance), "{}", file.display());
            assert!(close(&a.direction, &b.direction, tolerance.max(1e-9)), "{}", file.display());
        }
    }
    fs::remove_dir_all(&scratch).unwrap();
    assert!(read > 80, "only {read} files were readable");
}

fn walk(folder: &Path) -> Vec<PathBuf> {
    let mut files = Vec::new();
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() { files.extend(walk(&path)) } else { files.push(path) }
    }
    files
}

#[test]
fn a_series_is_ordered_by_position() {
    let Some(data) = data() else { return };
    let image = io::read_image(&data.join("ct_thorax_lidc0314/dicom_24slices")).unwrap();
    assert_eq!(image.grid.size, [512, 512, 24]);
    assert!(close(&image.grid.spacing, &[0.78125, 0.78125, 1.0], 1e-9));
    // Lowest slice by position, 000189.dcm, not the first by name.
    assert!(close(&image.grid.origin, &[-201.0, -59.0, -659.800049], 1e-9));
    let slice = io::read_image(&data.join("ct_thorax_lidc0314/dicom_24slices/000013.dcm")).unwrap();
    let k = 12; // −647.8 − (−659.8)
    let area = 512 * 512;
    let (all, one): (Vec<f64>, Vec<f64>) = (image.pixels.iter_f64().skip(k * area).take(area).collect(), slice.pixels.iter_f64().collect());
    assert!(all == one);
}

#[test]
fn a_tilted_uneven_series_is_resampled_where_its_slices_lie() {
    let Some(data) = data() else { return };
    let folder = data.join("dicom_ge_head_gantry_tilt/series");
    let reading = io::read(&folder, &ReadOptions::default()).unwrap();
    assert!(reading.notices.iter().any(|n| n.0.contains("resampled") && n.0.contains("18.5")), "{:?}", reading.notices);
    // At a pixel of an original slice the resampled volume has that slice's value, wherever a layer runs through it:
    // the first slice is the first layer.
    let (volume, slice) = (reading.image, io::read_image(&folder.join("01.dcm")).unwrap());
    let value = |image: &maille_volume::Image, world: [f64; 3]| {
        let n = image.grid.index_from_world(world).map(|x| x.round() as usize);
        image.pixels.iter_f64().nth(image.grid.offset(n[0], n[1], n[2])).unwrap()
    };
    for (i, j) in [(256, 256), (200, 300), (310, 220)] {
        let world = slice.grid.world_from_index([f64::from(i), f64::from(j), 0.0]);
        assert_eq!(value(&volume, world), value(&slice, world), "at {world:?}");
    }
}
