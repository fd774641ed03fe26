//! Reading and writing files: NRRD, MetaImage, NIfTI-1/-2 and (reading only) DICOM.
//!
//! Every reader gives an [`Image`] in LPS millimetres, whatever frame its format uses: NRRD's `space` and NIfTI's RAS
//! are converted here and nowhere else. Formats are told by content, the extension only breaks ties.
//!
//! Invariants: a file that cannot be read right is refused with one sentence, never guessed at; memory follows the
//! bytes that are there, not what a header declares; no input panics; a notice tells of everything that was changed
//! on the way (resampled, quantised, orientation missing).
//!
//! Not here: DICOM writing, lossy compression, pixel types other than those of [`Pixels`](crate::Pixels).

#![expect(clippy::needless_range_loop, reason = "r, c and n are indices into matrices and vectors side by side")]

mod dicom;
mod error;
mod geometry;
mod metaimage;
mod nifti;
mod nrrd;
mod outputs;
mod payload;

pub use error::{ReadError, WriteError};
pub use outputs::{OutputError, check_outputs};

use crate::{Image, Pixels, Rescale, VectorField, Volume};
use error::{Fault, Parsed};
use std::{
    fmt, fs,
    io::{self, Read as _, Write},
    path::Path,
};

/// A sentence that the person should see: something about the file was changed or is missing.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Notice(pub String);

impl fmt::Display for Notice {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

/// What to read where a file or directory holds more than one volume.
#[derive(Clone, Debug, Default)]
pub struct ReadOptions {
    /// SeriesInstanceUID to take from a directory of DICOM files (its end suffices when it is unique)
    pub series: Option<String>,
    /// frame to take from a 4-D file, counted from 0; all when absent
    pub frame: Option<usize>,
}

/// An image and what should be said about it.
#[derive(Clone, Debug)]
pub struct Reading {
    /// grid and pixels
    pub image: Image,
    /// what was changed or is missing
    pub notices: Vec<Notice>,
    /// name of the type the file stores, where rescaling made it another (`int16` slices with a fractional slope)
    pub stored_type: Option<&'static str>,
}

/// Reads an image of any format; a directory is a DICOM series.
///
/// # Errors
/// One sentence that names the file, the fault and what to do.
pub fn read_image(path: &Path) -> Result<Image, ReadError> {
    read(path, &ReadOptions::default()).map(|r| r.image)
}

/// Reads a scalar volume as the simulation holds it, with notices (quantised, resampled …).
///
/// # Errors
/// As [`read_image`], and when the image is not one scalar volume.
pub fn read_volume(path: &Path) -> Result<(Volume, Vec<Notice>), ReadError> {
    let Reading { image, mut notices, .. } = read(path, &ReadOptions::default())?;
    let unsupported = |fault: String| ReadError::Unsupported {
        path: path.to_path_buf(),
        fault,
        advice: "take a single scalar volume out of it, for example with `maille import --frame`".into(),
    };
    let volume = Volume::from_image(&image).map_err(unsupported)?;
    if volume.quantisation_error > 0.0 {
        notices.push(Notice(format!(
            "{}: {} voxels are held as 16-bit numbers; the largest difference from the file is {:.3e}",
            path.display(),
            image.pixels.type_name(),
            volume.quantisation_error
        )));
    }
    Ok((volume, notices))
}

/// Reads a displacement field: three components a voxel, LPS millimetres, as ITK writes them.
///
/// # Errors
/// As [`read_image`], and when the image has not three components.
pub fn read_vector_field(path: &Path) -> Result<VectorField, ReadError> {
    VectorField::from_image(&read_image(path)?).map_err(|fault| ReadError::Unsupported {
        path: path.to_path_buf(),
        fault,
        advice: "give a field with one vector of three numbers a voxel".into(),
    })
}

/// Reads an image of any format, with a choice of series and frame and with notices.
///
/// # Errors
/// One sentence that names the file, the fault and what to do.
pub fn read(path: &Path, options: &ReadOptions) -> Result<Reading, ReadError> {
    let metadata = fs::metadata(path).map_err(|source| ReadError::Io { path: path.to_path_buf(), source })?;
    let mut reading = if metadata.is_dir() {
        dicom::read_directory(path, options.series.as_deref())?
    } else {
        read_file(path).map_err(|fault| fault.at(path))?
    };
    check(&reading.image).map_err(|fault| fault.at(path))?;
    if let Some(frame) = options.frame {
        take_frame(&mut reading.image, frame).map_err(|fault| fault.at(path))?;
    }
    settle(&mut reading);
    Ok(reading)
}

/// Reads one file; its first bytes tell the format.
fn read_file(path: &Path) -> Parsed<Reading> {
    let mut head = Vec::new();
    fs::File::open(path)?.take(4096).read_to_end(&mut head)?;
    let extension = path.extension().and_then(|e| e.to_str()).unwrap_or("").to_ascii_lowercase();
    if head.is_empty() {
        return Err(Fault::NotAVolume("it is empty".into()));
    }
    if head.starts_with(b"NRRD") {
        return nrrd::read(path);
    }
    if head.starts_with(&[0x1f, 0x8b]) {
        let mut unpacked = Vec::new();
        // A truncated stream still gives its beginning; whether all is well is the reader's to find.
        let _ = flate2::read::MultiGzDecoder::new(&head[..]).take(540).read_to_end(&mut unpacked);
        if nifti::looks_like(&unpacked) {
            return nifti::read(path, true);
        }
        return Err(Fault::NotAVolume("it is compressed, and what is inside is no NIfTI file; unpack it with gunzip first".into()));
    }
    // A DICOM preamble may hold anything, the beginning of an Analyze header among it.
    if nifti::looks_like(&head) && head.get(128..132) != Some(b"DICM") {
        return nifti::read(path, false);
    }
    if extension == "img" && path.with_extension("hdr").exists() {
        return nifti::read(&path.with_extension("hdr"), false);
    }
    if matches!(extension.as_str(), "mha" | "mhd") || metaimage::looks_like(&head) {
        return metaimage::read(path);
    }
    if dicom::looks_like(&head) || extension == "dcm" {
        return dicom::read_one(path);
    }
    let fault = match () {
        () if head.starts_with(b"BZh") => "it is compressed with bzip2; unpack it with bunzip2 first",
        () if head.starts_with(b"PK") => "it is an archive; unpack it first",
        () if head.starts_with(b"{") => "it is JSON, perhaps the index of a vtk.js data set, whose orientation no two programs agree on",
        () if head.starts_with(b"<?xml") || head.starts_with(b"<VTKFile") => "it is XML, perhaps a VTK file",
        () if head.iter().take(512).all(|b| b.is_ascii_graphic() || b.is_ascii_whitespace()) => "it is text",
        () => "its first bytes are those of no known format",
    };
    Err(Fault::NotAVolume(fault.into()))
}

/// What every image must satisfy, whichever reader made it.
fn check(image: &Image) -> Parsed<()> {
    if let Some(fault) = image.grid.fault() {
        return Err(Fault::unsupported(fault, "check its header"));
    }
    let count = image.grid.voxel_count().checked_mul(image.components).and_then(|n| n.checked_mul(image.frames));
    if count != Some(image.pixels.len()) {
        return Err(Fault::damaged(format!("it holds {} numbers where its header calls for {count:?}", image.pixels.len())));
    }
    Ok(())
}

/// Keeps one frame of a 4-D image.
fn take_frame(image: &mut Image, frame: usize) -> Parsed<()> {
    if frame >= image.frames {
        return Err(Fault::unsupported(format!("it has no frame {frame}"), format!("choose one of 0 to {}", image.frames - 1)));
    }
    let length = image.grid.voxel_count() * image.components;
    let range = frame * length..(frame + 1) * length;
    macro_rules! cut {
        ($($v:ident),*) => { match &mut image.pixels { $(Pixels::$v(v) => *v = v[range].to_vec(),)* } };
    }
    cut!(U8, I8, U16, I16, U32, I32, U64, I64, F32, F64);
    image.frames = 1;
    Ok(())
}

/// Turns a whole-numbered rescale into values where an integer type holds them: the file's own, or the smallest wider one.
fn settle(reading: &mut Reading) {
    let image = &mut reading.image;
    let Rescale { slope, intercept } = image.rescale;
    let whole = |x: f64| x.fract() == 0.0 && x.abs() < 1e15;
    if image.rescale == Rescale::IDENTITY {
        return;
    }
    let stored = image.pixels.type_name();
    reading.stored_type = Some(stored);
    if !(image.pixels.is_integer() && whole(slope) && whole(intercept)) {
        return;
    }
    let Some((min, max)) = image.pixels.finite_range() else { return };
    let (a, b) = (image.rescale.value(min), image.rescale.value(max));
    let (min, max) = (a.min(b), a.max(b));
    // Beyond 2^53 the product would be rounded.
    if min.abs().max(max.abs()) > 9e15 {
        return;
    }
    macro_rules! values {
        ($v:ident, $t:ty) => {
            if min >= <$t>::MIN as f64 && max <= <$t>::MAX as f64 {
                let values = image.pixels.iter_f64().map(|x| (slope * x + intercept) as $t).collect();
                image.pixels = Pixels::$v(values);
                image.rescale = Rescale::IDENTITY;
                if image.pixels.type_name() == stored {
                    reading.stored_type = None;
                }
                return;
            }
        };
    }
    match &image.pixels {
        Pixels::U8(_) => values!(U8, u8),
        Pixels::I8(_) => values!(I8, i8),
        Pixels::U16(_) => values!(U16, u16),
        Pixels::U32(_) => values!(U32, u32),
        Pixels::U64(_) => values!(U64, u64),
        _ => {}
    }
    values!(I16, i16);
    values!(I32, i32);
    values!(I64, i64);
}

/// Name of the type of an image's values: that of its pixels, or a float where a fractional rescale makes them so.
pub fn value_type_name(image: &Image) -> &'static str {
    match &image.pixels {
        p if image.rescale == Rescale::IDENTITY => p.type_name(),
        Pixels::F64(_) => "float64",
        _ => "float32",
    }
}

/// The image with its values in its pixels and no rescale: floats where the rescale is fractional.
fn plain(image: &Image) -> std::borrow::Cow<'_, Image> {
    if image.rescale == Rescale::IDENTITY {
        return std::borrow::Cow::Borrowed(image);
    }
    let mut reading = Reading { image: image.clone(), notices: Vec::new(), stored_type: None };
    settle(&mut reading);
    let mut image = reading.image;
    if image.rescale != Rescale::IDENTITY {
        let values = image.pixels.iter_f64().map(|x| image.rescale.value(x));
        image.pixels = match &image.pixels {
            Pixels::F64(_) => Pixels::F64(values.collect()),
            _ => Pixels::F32(values.map(|x| x as f32).collect()),
        };
        image.rescale = Rescale::IDENTITY;
    }
    std::borrow::Cow::Owned(image)
}

/// How to write.
#[derive(Clone, Copy, Debug, Default)]
pub struct WriteOptions {
    /// compress the voxels (gzip in NRRD, zlib in MetaImage); `.nii.gz` always is
    pub compress: bool,
}

/// Writes an image; the extension names the format: `.nrrd`, `.mha`, `.mhd` (with a `.raw` beside it), `.nii`, `.nii.gz`.
///
/// The file appears under its name only when it is complete.
///
/// # Errors
/// One sentence that names the file, the fault and what to do.
pub fn write_image(path: &Path, image: &Image) -> Result<(), WriteError> {
    write_image_with(path, image, WriteOptions::default())
}

/// As [`write_image`], with options.
///
/// # Errors
/// As [`write_image`].
pub fn write_image_with(path: &Path, image: &Image, options: WriteOptions) -> Result<(), WriteError> {
    let name = path.file_name().map(|n| n.to_string_lossy().to_lowercase()).unwrap_or_default();
    let compress = options.compress;
    let failed = |source| WriteError::Io { path: path.to_path_buf(), source };
    let format = ["nrrd", "mha", "mhd", "nii", "nii.gz"].into_iter().find(|e| name.ends_with(&format!(".{e}")));
    match format {
        Some("nrrd") => replace(path, |out| nrrd::write(out, &plain(image), compress)).map_err(failed),
        Some("mha") => replace(path, |out| metaimage::write(out, metaimage::Data::Local, &plain(image), compress)).map_err(failed),
        Some("mhd") => {
            let data = path.with_extension(if compress { "zraw" } else { "raw" });
            let data_name = data.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
            let image = plain(image);
            // The voxels first: a header that is there always has its data.
            let mut header = Vec::new();
            replace(&data, |out| metaimage::write(&mut header, metaimage::Data::Beside(&data_name, out), &image, compress))
                .map_err(|source| WriteError::Io { path: data.clone(), source })?;
            replace(path, |out| out.write_all(&header)).map_err(failed)
        }
        Some("nii" | "nii.gz") => {
            if let Some(fault) = nifti::fault(image) {
                return Err(WriteError::Unsupported { path: path.to_path_buf(), fault, advice: "write .nrrd instead".into() });
            }
            // NIfTI-1 keeps a rescale in single precision: only one that fits is kept.
            let fits = |x: f64| f64::from(x as f32) == x && x.is_finite();
            let keeps = fits(image.rescale.slope) && fits(image.rescale.intercept) && image.rescale.slope != 0.0;
            let image = if keeps { std::borrow::Cow::Borrowed(image) } else { plain(image) };
            replace(path, |out| nifti::write(out, &image, name.ends_with("gz"))).map_err(failed)
        }
        _ => Err(WriteError::Extension { path: path.to_path_buf() }),
    }
}

/// Writes a file under a temporary name beside its own, then renames it.
fn replace(path: &Path, write: impl FnOnce(&mut dyn Write) -> io::Result<()>) -> io::Result<()> {
    let name = path.file_name().ok_or_else(|| io::Error::new(io::ErrorKind::InvalidInput, "it has no file name"))?;
    let mut temporary = std::ffi::OsString::from(".");
    temporary.push(name);
    temporary.push(format!(".{}", std::process::id()));
    let temporary = path.with_file_name(temporary);
    let attempt = || -> io::Result<()> {
        let mut out = io::BufWriter::with_capacity(1 << 20, fs::File::create(&temporary)?);
        write(&mut out)?;
        out.into_inner().map_err(io::IntoInnerError::into_error)?;
        fs::rename(&temporary, path)
    };
    let outcome = attempt();
    if outcome.is_err() {
        let _ = fs::remove_file(&temporary);
    }
    outcome
}

/// Writes a scalar volume.
///
/// # Errors
/// As [`write_image`].
pub fn write_volume(path: &Path, volume: &Volume) -> Result<(), WriteError> {
    write_image(path, &volume.to_image())
}

/// Writes a displacement field, LPS millimetres, in ITK's vector layout.
///
/// # Errors
/// As [`write_image`].
pub fn write_vector_field(path: &Path, field: &VectorField) -> Result<(), WriteError> {
    write_image(path, &field.to_image())
}
