//! Files cut short, with bytes changed, or with headers that lie: an error or an image, never a panic, and no memory
//! by what a header declares (a lie of terabytes would end the test by itself).

use maille_volume::{Grid, Image, Pixels, Rescale, io};
use std::{
    fs,
    path::{Path, PathBuf},
};

fn scratch(name: &str) -> PathBuf {
    let folder = std::env::temp_dir().join(format!("maille-hostile-{name}-{}", std::process::id()));
    fs::create_dir_all(&folder).unwrap();
    folder
}

fn image() -> Image {
    let mut grid = Grid::axis_aligned([4, 3, 2], [0.5, 0.75, 2.0]);
    grid.origin = [10.0, -20.0, 30.5];
    // A turn by 30° about z.
    let (s, c) = (0.5, 0.75f64.sqrt());
    grid.direction = [c, -s, 0.0, s, c, 0.0, 0.0, 0.0, 1.0];
    Image { grid, components: 1, frames: 1, rescale: Rescale::IDENTITY, pixels: Pixels::I16((0..24).map(|v| v * 37 - 400).collect()) }
}

/// A slice in implicit little endian, written by hand.
fn dicom() -> Vec<u8> {
    let mut bytes = vec![0u8; 128];
    bytes.extend(b"DICM\x02\0\x10\0UI\x12\x001.2.840.10008.1.2\0");
    let mut element = |group: u16, number: u16, value: &[u8]| {
        bytes.extend(group.to_le_bytes());
        bytes.extend(number.to_le_bytes());
        bytes.extend((value.len().next_multiple_of(2) as u32).to_le_bytes());
        bytes.extend(value);
        bytes.extend(std::iter::repeat_n(b' ', value.len() % 2));
    };
    element(0x08, 0x60, b"CT");
    element(0x18, 0x88, b"2.5");
    element(0x20, 0x32, b"1\\2\\3");
    element(0x20, 0x37, b"1\\0\\0\\0\\1\\0");
    element(0x28, 0x02, &[1, 0]);
    element(0x28, 0x04, b"MONOCHROME2");
    element(0x28, 0x10, &[3, 0]);
    element(0x28, 0x11, &[4, 0]);
    element(0x28, 0x30, b"0.75\\0.5");
    element(0x28, 0x100, &[16, 0]);
    element(0x28, 0x101, &[12, 0]);
    element(0x28, 0x102, &[11, 0]);
    element(0x28, 0x103, &[0, 0]);
    element(0x28, 0x1052, b"-1024");
    element(0x28, 0x1053, b"1");
    element(0x7FE0, 0x10, &(0..12u16).flat_map(|v| (v * 100).to_le_bytes()).collect::<Vec<u8>>());
    bytes
}

/// One small good file of each format.
fn good_files(folder: &Path) -> Vec<(PathBuf, Vec<u8>)> {
    let mut files = Vec::new();
    for name in ["a.nrrd", "a.mha", "a.nii", "a.nii.gz"] {
        let path = folder.join(name);
        io::write_image(&path, &image()).unwrap();
        files.push((path.clone(), fs::read(&path).unwrap()));
    }
    for name in ["z.nrrd", "z.mha"] {
        let path = folder.join(name);
        io::write_image_with(&path, &image(), io::WriteOptions { compress: true }).unwrap();
        files.push((path.clone(), fs::read(&path).unwrap()));
    }
    let path = folder.join("a.dcm");
    files.push((path, dicom()));
    files
}

#[test]
fn a_hand_written_slice_reads_as_what_was_written() {
    let folder = scratch("slice");
    let path = folder.join("a.dcm");
    fs::write(&path, dicom()).unwrap();
    let image = io::read_image(&path).unwrap();
    assert_eq!(image.grid.size, [4, 3, 1]);
    assert_eq!(image.grid.spacing, [0.5, 0.75, 2.5]);
    assert_eq!(image.grid.origin, [1.0, 2.0, 3.0]);
    assert_eq!(image.pixels, Pixels::I16((0..12).map(|v| v * 100 - 1024).collect()));
    fs::remove_dir_all(folder).unwrap();
}

#[test]
fn files_cut_short_never_panic_and_never_read_whole() {
    let folder = scratch("cut");
    for (path, bytes) in good_files(&folder) {
        for length in 0..bytes.len() {
            fs::write(&path, &bytes[..length]).unwrap();
            let read = io::read_image(&path);
            // Only the checksum that ends a gzip stream may be cut off unseen; the voxels then are still all there.
            assert!(read.is_err() || length + 8 >= bytes.len(), "{} cut at {length} of {} reads", path.display(), bytes.len());
        }
    }
    fs::remove_dir_all(folder).unwrap();
}

#[test]
fn files_with_changed_bytes_never_panic() {
    let folder = scratch("changed");
    // A fixed seed (xorshift64): the same files on every machine.
    let mut state = 0x9E37_79B9_7F4A_7C15u64;
    let mut next = move || {
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        state
    };
    for (path, bytes) in good_files(&folder) {
        for _ in 0..600 {
            let mut changed = bytes.clone();
            for _ in 0..1 + next() % 6 {
                let at = (next() % changed.len() as u64) as usize;
                changed[at] = match next() % 4 {
                    0 => 0xFF,
                    1 => b'9',
                    2 => changed[at] ^ 1 << (next() % 8),
                    _ => next() as u8,
                };
            }
            fs::write(&path, &changed).unwrap();
            if let Err(error) = io::read_image(&path) {
                assert!(!error.to_string().contains('\n'), "{error}");
            }
        }
    }
    fs::remove_dir_all(folder).unwrap();
}

#[test]
fn a_header_that_lies_about_size_is_refused() {
    let folder = scratch("lies");
    let header = "NRRD0004\ntype: short\ndimension: 3\nsizes: 60000 60000 1000\nendian: little\nencoding: ";
    for encoding in ["raw", "gzip", "bzip2", "ascii", "hex"] {
        let path = folder.join("lie.nrrd");
        fs::write(&path, format!("{header}{encoding}\n\nabc")).unwrap();
        assert!(io::read_image(&path).is_err(), "{encoding}");
    }
    let path = folder.join("lie.mha");
    let text = "NDims = 3\nDimSize = 60000 60000 1000\nElementType = MET_DOUBLE\nElementDataFile = LOCAL\nabc";
    fs::write(&path, text).unwrap();
    assert!(io::read_image(&path).is_err());
    fs::remove_dir_all(folder).unwrap();
}

#[test]
fn a_displacement_field_survives_every_format() {
    let folder = scratch("field");
    let grid = image().grid;
    let vectors: Vec<[f32; 3]> = (0..24).map(|v| [v as f32, -0.5 * v as f32, 0.125]).collect();
    let field = maille_volume::VectorField { grid, vectors };
    for name in ["u.nrrd", "u.mha", "u.mhd", "u.nii", "u.nii.gz"] {
        let path = folder.join(name);
        io::write_vector_field(&path, &field).unwrap();
        let read = io::read_vector_field(&path).unwrap();
        assert_eq!(read.vectors, field.vectors, "{name}");
        for c in 0..3 {
            assert!((read.grid.origin[c] - field.grid.origin[c]).abs() < 1e-5, "{name}");
        }
    }
    fs::remove_dir_all(folder).unwrap();
}
