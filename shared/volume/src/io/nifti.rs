//! NIfTI-1 and NIfTI-2: `.nii`, `.nii.gz`, and pairs `.hdr`/`.img`, in either byte order.
//!
//! The header's frame is RAS; x and y are negated here. [NIfTI-1.1 and NIfTI-2 header definitions, nifti.nimh.nih.gov]
//!
//! Of two orientations ITK's choice is taken: `sform` when its code is "scanner" or there is no `qform`, `qform`
//! otherwise; a sheared `sform` gives way to a `qform`. When the two differ a notice tells which was taken. With neither,
//! the axes are taken along x, y, z from the origin, with a notice.
//!
//! Vectors (`intent_code` 1007 with dim\[5\] components) are stored as they are, LPS, as ITK writes them; displacement
//! vectors (1006) are RAS and are converted, as ITK does.
//!
//! Not here: Analyze 7.5 (it states no orientation, and left and right cannot be told), CIFTI, complex numbers.

use super::{
    Notice, Reading,
    error::{Fault, Parsed},
    geometry::{SQUARE, complete_steps, flip_xy, grid_from_steps, skew},
    payload::{self, Kind, Packing},
};
use crate::{Image, Pixels, Rescale};
use std::{
    fs::File,
    io::{self, BufReader, Read, Write},
    path::{Path, PathBuf},
};

const VECTOR: i64 = 1007;
const DISPLACEMENT: i64 = 1006;
/// Codes of an orientation: unknown, scanner.
const UNKNOWN: i64 = 0;
const SCANNER: i64 = 1;

/// The fields of either version that matter here.
struct Header {
    version: u8,
    big_endian: bool,
    /// header and voxels in one file
    single: bool,
    dim: [i64; 8],
    datatype: i64,
    pixdim: [f64; 8],
    vox_offset: f64,
    slope: f64,
    intercept: f64,
    units: i64,
    intent: i64,
    qform_code: i64,
    sform_code: i64,
    /// b, c, d
    quaternion: [f64; 3],
    q_offset: [f64; 3],
    srow: [[f64; 4]; 3],
}

/// Whether bytes begin like a NIfTI or Analyze header.
pub(crate) fn looks_like(head: &[u8]) -> bool {
    let Some(size) = head.first_chunk::<4>() else { return false };
    [348, 540].iter().any(|&n| i32::from_le_bytes(*size) == n || i32::from_be_bytes(*size) == n)
}

/// Reads a file whose (decompressed) content begins with a NIfTI header.
pub(crate) fn read(path: &Path, gzipped: bool) -> Parsed<Reading> {
    let mut stream = open(path, gzipped)?;
    let mut bytes = Vec::new();
    stream.by_ref().take(540).read_to_end(&mut bytes).map_err(|e| Fault::damaged(format!("its header does not decompress ({e})")))?;
    let header = Header::parse(&bytes)?;
    let mut notices = Vec::new();

    let shape = header.shape()?;
    let (kind, channels) = header.kind()?;
    let expected = payload::expected_bytes(&[shape.size[0], shape.size[1], shape.size[2], shape.frames, shape.components, channels], kind)?;
    let grid = header.grid(shape.size, &mut notices)?;

    let offset = header.vox_offset;
    if !(offset.is_finite() && (0.0..9e15).contains(&offset)) {
        return Err(Fault::damaged(format!("its `vox_offset` {offset} means nothing")));
    }
    let (bytes, extra) = if header.single {
        // 0 is what some writers leave for "right after the header and its four bytes of extension flags".
        let begin = if header.version == 1 { 352 } else { 544 };
        let offset = if offset == 0.0 { begin } else { offset as u64 };
        if offset < begin - 4 {
            return Err(Fault::damaged(format!("its voxels would begin at byte {offset}, within the header")));
        }
        // The header was read by up to 540 bytes; a NIfTI-1 file's voxels may begin within them.
        let mut rest = io::Cursor::new(bytes).chain(stream);
        payload::skip(&mut rest, offset)?;
        finish(&mut rest, expected)?
    } else {
        let data = image_beside(path)?;
        let gzipped = data.extension().is_some_and(|e| e == "gz");
        let read = || -> Parsed<(Vec<u8>, bool)> {
            let mut stream = open(&data, gzipped)?;
            payload::skip(&mut *stream, offset as u64)?;
            finish(&mut *stream, expected)
        };
        read().map_err(|fault| Fault::Named(Box::new(fault.at(&data))))?
    };
    if extra {
        notices.push(Notice("bytes after its voxels are ignored".into()));
    }

    let mut pixels = payload::decode(bytes, kind, header.big_endian);
    let components = shape.components * channels;
    if shape.components > 1 {
        // i, j, k, frame, component → component first.
        let sizes = [shape.size[0], shape.size[1], shape.size[2], shape.frames, shape.components];
        pixels = payload::permute(pixels, &sizes, &[4, 0, 1, 2, 3]);
    }
    if header.intent == DISPLACEMENT && components == 3 {
        flip_vectors(&mut pixels);
    }
    // A slope of zero or a NaN says that the stored numbers are the values.
    let rescaled = header.slope != 0.0 && header.slope.is_finite() && header.intercept.is_finite() && channels == 1;
    let rescale = if rescaled { Rescale { slope: header.slope, intercept: header.intercept } } else { Rescale::IDENTITY };
    Ok(Reading { image: Image { grid, components, frames: shape.frames, rescale, pixels }, notices, stored_type: None })
}

fn finish(stream: &mut dyn Read, expected: usize) -> Parsed<(Vec<u8>, bool)> {
    let bytes = payload::take_exactly(stream, expected, false)?;
    let extra = stream.read(&mut [0u8; 1]).unwrap_or(0) > 0;
    Ok((bytes, extra))
}

fn open(path: &Path, gzipped: bool) -> Parsed<Box<dyn Read>> {
    let reader = BufReader::new(File::open(path)?);
    Ok(payload::unpack(reader, if gzipped { Packing::Gzip } else { Packing::Raw }))
}

/// `x.hdr` → `x.img` or `x.img.gz`.
fn image_beside(header: &Path) -> Parsed<PathBuf> {
    let stem = if header.extension().is_some_and(|e| e == "gz") { header.with_extension("") } else { header.to_path_buf() };
    let found = ["img", "img.gz", "IMG"].iter().map(|e| stem.with_extension(e)).find(|p| p.exists());
    found.ok_or_else(|| {
        Fault::unsupported(
            format!("it is only a header, and its voxels in {} are missing", stem.with_extension("img").display()),
            "put the .img beside it",
        )
    })
}

fn flip_vectors(pixels: &mut Pixels) {
    macro_rules! flip {
        ($($v:ident),*) => {
            match pixels {
                $(Pixels::$v(v) => v.chunks_exact_mut(3).for_each(|c| { c[0] = -c[0]; c[1] = -c[1]; }),)*
                _ => {} // unsigned displacements mean nothing; leave them
            }
        };
    }
    flip!(F32, F64);
}

/// Size along space, frames and components.
struct Shape {
    size: [usize; 3],
    frames: usize,
    components: usize,
}

/// Reads numbers at offsets of a header in either byte order.
struct Bytes<'a>(&'a [u8], bool);

impl Bytes<'_> {
    fn at<const N: usize>(&self, offset: usize) -> [u8; N] {
        let mut b: [u8; N] = self.0[offset..offset + N].try_into().expect("the slice has N bytes");
        if self.1 {
            b.reverse();
        }
        b
    }
    fn i16(&self, offset: usize) -> i64 {
        i16::from_le_bytes(self.at(offset)).into()
    }
    fn i32(&self, offset: usize) -> i64 {
        i32::from_le_bytes(self.at(offset)).into()
    }
    fn i64(&self, offset: usize) -> i64 {
        i64::from_le_bytes(self.at(offset))
    }
    fn f32(&self, offset: usize) -> f64 {
        f32::from_le_bytes(self.at(offset)).into()
    }
    fn f64(&self, offset: usize) -> f64 {
        f64::from_le_bytes(self.at(offset))
    }
}

impl Header {
    fn parse(bytes: &[u8]) -> Parsed<Self> {
        let size = bytes.first_chunk::<4>().ok_or_else(|| Fault::damaged("it ends within its header"))?;
        let (little, big) = (i32::from_le_bytes(*size), i32::from_be_bytes(*size));
        let (version, big_endian) = match (little, big) {
            (348, _) => (1, false),
            (_, 348) => (1, true),
            (540, _) => (2, false),
            (_, 540) => (2, true),
            _ => return Err(Fault::damaged("it does not begin with a NIfTI header")),
        };
        if bytes.len() < if version == 1 { 348 } else { 540 } {
            return Err(Fault::damaged("it ends within its header"));
        }
        let b = Bytes(bytes, big_endian);
        let magic = if version == 1 { &bytes[344..348] } else { &bytes[4..8] };
        let single = match (version, magic) {
            (1, b"n+1\0") | (2, b"n+2\0") => true,
            (1, b"ni1\0") | (2, b"ni2\0") => false,
            (1, _) => {
                return Err(Fault::unsupported(
                    "it is an Analyze 7.5 header, which does not say where left and right are",
                    "convert it to NIfTI with the program that made it",
                ));
            }
            _ => return Err(Fault::damaged("its NIfTI-2 signature is wrong")),
        };
        Ok(if version == 1 {
            Self {
                version,
                big_endian,
                single,
                dim: std::array::from_fn(|n| b.i16(40 + 2 * n)),
                datatype: b.i16(70),
                pixdim: std::array::from_fn(|n| b.f32(76 + 4 * n)),
                vox_offset: b.f32(108),
                slope: b.f32(112),
                intercept: b.f32(116),
                units: bytes[123].into(),
                intent: b.i16(68),
                qform_code: b.i16(252),
                sform_code: b.i16(254),
                quaternion: std::array::from_fn(|n| b.f32(256 + 4 * n)),
                q_offset: std::array::from_fn(|n| b.f32(268 + 4 * n)),
                srow: std::array::from_fn(|r| std::array::from_fn(|c| b.f32(280 + 16 * r + 4 * c))),
            }
        } else {
            Self {
                version,
                big_endian,
                single,
                dim: std::array::from_fn(|n| b.i64(16 + 8 * n)),
                datatype: b.i16(12),
                pixdim: std::array::from_fn(|n| b.f64(104 + 8 * n)),
                vox_offset: b.i64(168) as f64,
                slope: b.f64(176),
                intercept: b.f64(184),
                units: b.i32(500),
                intent: b.i32(504),
                qform_code: b.i32(344),
                sform_code: b.i32(348),
                quaternion: std::array::from_fn(|n| b.f64(352 + 8 * n)),
                q_offset: std::array::from_fn(|n| b.f64(376 + 8 * n)),
                srow: std::array::from_fn(|r| std::array::from_fn(|c| b.f64(400 + 32 * r + 8 * c))),
            }
        })
    }

    fn shape(&self) -> Parsed<Shape> {
        let n = self.dim[0];
        if !(1..=7).contains(&n) {
            return Err(Fault::damaged(format!("its number of axes is {n}, not between 1 and 7")));
        }
        if (3000..3100).contains(&self.intent) {
            return Err(Fault::unsupported("it is a CIFTI file, whose voxels lie on no grid", "give a volume"));
        }
        let mut axis = [1usize; 8];
        for a in 1..=n as usize {
            axis[a] = usize::try_from(self.dim[a])
                .ok()
                .filter(|d| *d > 0)
                .ok_or_else(|| Fault::damaged(format!("its axis {a} has {} voxels", self.dim[a])))?;
        }
        if axis[6] > 1 || axis[7] > 1 {
            return Err(Fault::unsupported(format!("it has {n} axes"), "store it with at most five"));
        }
        Ok(Shape { size: [axis[1], axis[2], axis[3]], frames: axis[4], components: axis[5] })
    }

    /// Type of a number, and numbers a voxel beyond those of dim\[5\].
    fn kind(&self) -> Parsed<(Kind, usize)> {
        Ok(match self.datatype {
            2 => (Kind::U8, 1),
            4 => (Kind::I16, 1),
            8 => (Kind::I32, 1),
            16 => (Kind::F32, 1),
            64 => (Kind::F64, 1),
            128 => (Kind::U8, 3),
            256 => (Kind::I8, 1),
            512 => (Kind::U16, 1),
            768 => (Kind::U32, 1),
            1024 => (Kind::I64, 1),
            1280 => (Kind::U64, 1),
            2304 => (Kind::U8, 4),
            other => {
                return Err(Fault::unsupported(format!("its voxels have the type of code {other}"), "store them as integers or floats"));
            }
        })
    }

    /// Columns (i, j, k) and offset of `sform`, RAS.
    fn sform(&self) -> ([[f64; 3]; 3], [f64; 3]) {
        (std::array::from_fn(|c| std::array::from_fn(|r| self.srow[r][c])), std::array::from_fn(|r| self.srow[r][3]))
    }

    /// Columns (i, j, k) and offset of `qform`, RAS.
    fn qform(&self) -> ([[f64; 3]; 3], [f64; 3]) {
        let [b, c, d] = self.quaternion;
        let rest = 1.0 - (b * b + c * c + d * d);
        // Rounding may leave the vector part a little longer than one: then the turn is by 180°, normalised.
        let (a, [b, c, d]) = if rest < 1e-7 {
            let length = (b * b + c * c + d * d).sqrt();
            (0.0, [b / length, c / length, d / length])
        } else {
            (rest.sqrt(), [b, c, d])
        };
        let handed = if self.pixdim[0] < 0.0 { -1.0 } else { 1.0 };
        let step = |n: usize| if self.pixdim[n] == 0.0 { 1.0 } else { self.pixdim[n].abs() };
        let columns = [
            [a * a + b * b - c * c - d * d, 2.0 * (b * c + a * d), 2.0 * (b * d - a * c)].map(|x| x * step(1)),
            [2.0 * (b * c - a * d), a * a + c * c - b * b - d * d, 2.0 * (c * d + a * b)].map(|x| x * step(2)),
            [2.0 * (b * d + a * c), 2.0 * (c * d - a * b), a * a + d * d - c * c - b * b].map(|x| x * step(3) * handed),
        ];
        (columns, self.q_offset)
    }

    fn grid(&self, size: [usize; 3], notices: &mut Vec<Notice>) -> Parsed<crate::Grid> {
        let unit = match self.units & 7 {
            1 => 1000.0,
            3 => 1e-3,
            _ => 1.0,
        };
        let square = |columns: &[[f64; 3]; 3]| skew(columns) <= SQUARE;
        let (q, s) = (self.qform_code > UNKNOWN, self.sform_code > UNKNOWN);
        let sform = self.sform();
        let (columns, offset) = if s && (self.sform_code == SCANNER || !q) && (square(&sform.0) || !q) {
            if q && differ(&sform, &self.qform(), size) {
                notices.push(Notice("its two orientations differ; the sform is taken".into()));
            }
            sform
        } else if q {
            let qform = self.qform();
            if s && differ(&sform, &qform, size) {
                notices.push(Notice("its two orientations differ; the qform is taken".into()));
            }
            qform
        } else {
            notices.push(Notice("it states no orientation; its axes are taken along x, y, z of the patient and its origin as 0".into()));
            let step = |n: usize| if self.pixdim[n] == 0.0 { 1.0 } else { self.pixdim[n].abs() };
            return grid_from_steps(size, [[step(1) * unit, 0.0, 0.0], [0.0, step(2) * unit, 0.0], [0.0, 0.0, step(3) * unit]], [0.0; 3]);
        };
        let columns = columns.map(|c| flip_xy(c.map(|x| x * unit)));
        let offset = flip_xy(offset.map(|x| x * unit));
        // A flat image may leave the columns of its missing axes empty.
        let given = columns.iter().rposition(|c| c.iter().any(|x| *x != 0.0)).map_or(0, |n| n + 1);
        let flat = size.iter().skip(given).all(|&n| n == 1);
        grid_from_steps(size, if flat { complete_steps(&columns[..given])? } else { columns }, offset)
    }
}

/// Whether two orientations put some corner of the volume more than a tenth of a voxel apart.
fn differ(a: &([[f64; 3]; 3], [f64; 3]), b: &([[f64; 3]; 3], [f64; 3]), size: [usize; 3]) -> bool {
    let smallest = a.0.iter().map(|c| super::geometry::norm(*c)).fold(f64::INFINITY, f64::min);
    let corner = |form: &([[f64; 3]; 3], [f64; 3]), n: usize| -> [f64; 3] {
        std::array::from_fn(|r| {
            form.1[r] + (0..3).map(|c| form.0[c][r] * if n >> c & 1 == 1 { (size[c] - 1) as f64 } else { 0.0 }).sum::<f64>()
        })
    };
    !(0..8).all(|n| {
        let (p, q) = (corner(a, n), corner(b, n));
        super::geometry::norm([p[0] - q[0], p[1] - q[1], p[2] - q[2]]) <= 0.1 * smallest
    })
}

/// Why NIfTI-1 cannot hold an image, if it cannot.
pub(crate) fn fault(image: &Image) -> Option<String> {
    let counts = image.grid.size.iter().chain([&image.components, &image.frames]);
    counts.into_iter().find(|&&n| n > i16::MAX as usize).map(|n| format!("NIfTI holds at most 32767 voxels along an axis, not {n}"))
}

/// Writes a single-file NIfTI-1, little-endian, as ITK does: `qform` and `sform` both "scanner", vectors as dim\[5\].
pub(crate) fn write(out: &mut dyn Write, image: &Image, compress: bool) -> io::Result<()> {
    let header = header_bytes(image);
    let n = image.components;
    let planar;
    let pixels = if n > 1 {
        let g = image.grid.size;
        planar = payload::permute(image.pixels.clone(), &[n, g[0], g[1], g[2], image.frames], &[1, 2, 3, 4, 0]);
        &planar
    } else {
        &image.pixels
    };
    if compress {
        let mut packed = flate2::write::GzEncoder::new(out, flate2::Compression::fast());
        packed.write_all(&header)?;
        payload::encode(pixels, &mut packed)?;
        packed.finish()?;
        return Ok(());
    }
    out.write_all(&header)?;
    payload::encode(pixels, out)
}

fn header_bytes(image: &Image) -> Vec<u8> {
    let mut h = vec![0u8; 352];
    let grid = &image.grid;
    let mut put = |offset: usize, bytes: &[u8]| h[offset..offset + bytes.len()].copy_from_slice(bytes);
    let axes: i16 = match (image.components, image.frames) {
        (1, 1) => 3,
        (1, _) => 4,
        _ => 5,
    };
    let dim = [axes as usize, grid.size[0], grid.size[1], grid.size[2], image.frames, image.components, 1, 1];
    let (code, bits): (i16, i16) = match Kind::of(&image.pixels) {
        Kind::U8 => (2, 8),
        Kind::I16 => (4, 16),
        Kind::I32 => (8, 32),
        Kind::F32 => (16, 32),
        Kind::F64 => (64, 64),
        Kind::I8 => (256, 8),
        Kind::U16 => (512, 16),
        Kind::U32 => (768, 32),
        Kind::I64 => (1024, 64),
        Kind::U64 => (1280, 64),
    };
    // Columns of the direction in RAS.
    let columns: [[f64; 3]; 3] = std::array::from_fn(|c| flip_xy(std::array::from_fn(|r| grid.direction[3 * r + c])));
    let origin = flip_xy(grid.origin);
    let (quaternion, handed) = quaternion(columns);
    let pixdim = [handed, grid.spacing[0], grid.spacing[1], grid.spacing[2], 0.0, 0.0, 0.0, 0.0];

    put(0, &348i32.to_le_bytes());
    put(38, b"r");
    for (n, d) in dim.iter().enumerate() {
        put(40 + 2 * n, &(*d as i16).to_le_bytes());
    }
    if image.components > 1 {
        put(68, &(VECTOR as i16).to_le_bytes());
    }
    put(70, &code.to_le_bytes());
    put(72, &bits.to_le_bytes());
    for (n, p) in pixdim.iter().enumerate() {
        put(76 + 4 * n, &(*p as f32).to_le_bytes());
    }
    put(108, &352f32.to_le_bytes());
    put(112, &(image.rescale.slope as f32).to_le_bytes());
    put(116, &(image.rescale.intercept as f32).to_le_bytes());
    put(123, &[2 + 8]); // millimetres, seconds
    put(252, &(SCANNER as i16).to_le_bytes());
    put(254, &(SCANNER as i16).to_le_bytes());
    for n in 0..3 {
        put(256 + 4 * n, &(quaternion[n] as f32).to_le_bytes());
        put(268 + 4 * n, &(origin[n] as f32).to_le_bytes());
        for c in 0..3 {
            put(280 + 16 * n + 4 * c, &((columns[c][n] * grid.spacing[c]) as f32).to_le_bytes());
        }
        put(280 + 16 * n + 12, &(origin[n] as f32).to_le_bytes());
    }
    put(344, b"n+1\0");
    h
}

/// Vector part (b, c, d) of the unit quaternion of a rotation given by its columns, and −1 when the third column had to
/// be turned round to make it one.
fn quaternion(mut columns: [[f64; 3]; 3]) -> ([f64; 3], f64) {
    let m = nalgebra::Matrix3::from_columns(&columns.map(nalgebra::Vector3::from));
    let handed = if m.determinant() < 0.0 { -1.0 } else { 1.0 };
    columns[2] = columns[2].map(|x| x * handed);
    let m = nalgebra::Matrix3::from_columns(&columns.map(nalgebra::Vector3::from));
    let q = nalgebra::UnitQuaternion::from_rotation_matrix(&nalgebra::Rotation3::from_matrix_unchecked(m));
    // NIfTI keeps only b, c, d: the scalar part must not be negative.
    let sign = if q.w < 0.0 { -1.0 } else { 1.0 };
    ([q.i * sign, q.j * sign, q.k * sign], handed)
}
