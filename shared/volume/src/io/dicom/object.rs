//! One DICOM file: its attributes, the plane of each frame, and its pixels.
//!
//! Planes come from the functional groups of enhanced objects, from the grid of a dose, or from the plain attributes.
//! [DICOM PS3.3, C.7.6.2, C.7.6.16, C.8.8.3]

use super::{
    super::error::{Fault, Parsed},
    scan::{PixelBytes, PixelElement, Syntax, scan, without_unknown_sequences},
};
use crate::io::geometry::{SQUARE, cross, dot, norm};
use dicom_object::{DefaultDicomObject, InMemDicomObject, OpenFileOptions, Tag, file::ReadPreamble};
use std::{
    cell::Cell,
    fs,
    io::Read,
    panic::{self, AssertUnwindSafe, catch_unwind},
    path::{Path, PathBuf},
    sync::Once,
};

const DEFLATED: &str = "1.2.840.10008.1.2.1.99";
const BIG_ENDIAN: &str = "1.2.840.10008.1.2.2";
const IMPLICIT: &str = "1.2.840.10008.1.2";
const EXPLICIT: &str = "1.2.840.10008.1.2.1";

/// Where one frame lies; `None` where the file does not say.
#[derive(Clone, Debug)]
pub(super) struct Plane {
    /// centre of the first pixel [mm, LPS]
    pub position: Option<[f64; 3]>,
    /// direction along a row (index i), and along a column (index j)
    pub axes: Option<[[f64; 3]; 2]>,
    /// distance of pixels along i and j [mm]
    pub spacing: Option<[f64; 2]>,
    /// thickness of the slice [mm]
    pub thickness: Option<f64>,
    pub slope: f64,
    pub intercept: f64,
}

/// One file, its pixels not yet decoded.
pub(super) struct Object {
    pub path: PathBuf,
    pub series: String,
    /// modality, description: for a person to tell series apart
    pub label: String,
    pub columns: usize,
    pub rows: usize,
    pub samples: usize,
    pub allocated: usize,
    pub stored: usize,
    pub signed: bool,
    pub photometric: String,
    pub planar: bool,
    pub padding: Option<f64>,
    /// distance of frames or slices where only that is stated [mm]
    pub between: Option<f64>,
    /// the frames are moments, not slices
    pub cine: bool,
    pub planes: Vec<Plane>,
    pub dose_scaling: Option<f64>,
    pub high_bit: usize,
    /// spacing was taken from the detector, not from the patient
    pub detector_spacing: bool,
    pub transfer_syntax: String,
    pub syntax: Syntax,
    pub pixel: PixelElement,
}

/// A file's data set, inflated where it was deflated.
pub(super) struct DataSet {
    pub bytes: Vec<u8>,
    pub syntax: Syntax,
    pub transfer_syntax: String,
}

/// Whether bytes begin like a DICOM file, with or without the preamble.
pub(crate) fn looks_like(head: &[u8]) -> bool {
    head.get(128..132) == Some(b"DICM") || bare_syntax(head).is_some()
}

/// The syntax of a data set without preamble, guessed from its first element, which lies in group 2 or 8.
fn bare_syntax(head: &[u8]) -> Option<Syntax> {
    let big_endian = match head.get(..2)? {
        [2 | 8, 0] => false,
        [0, 8] => true,
        _ => return None,
    };
    let element = head.get(2..4)?;
    let explicit = head.get(4..6)?.iter().all(u8::is_ascii_uppercase);
    let length = head.get(if explicit { 6..8 } else { 4..8 })?;
    // A first element is short; anything else is some other file that happens to begin so.
    let low = if big_endian { *length.last()? } else { length[0] };
    let rest: u32 = length.iter().map(|b| u32::from(*b)).sum();
    (element[usize::from(!big_endian)] == 0 && rest == u32::from(low) && (explicit || low.is_multiple_of(2)))
        .then_some(Syntax { explicit, big_endian })
}

/// Reads a file and finds its data set.
pub(super) fn data_set(path: &Path) -> Parsed<DataSet> {
    let bytes = fs::read(path)?;
    let mut at = if bytes.get(128..132) == Some(b"DICM") { 132 } else { 0 };
    // The meta group, always explicit little endian: only the transfer syntax matters.
    let mut transfer_syntax = String::new();
    while bytes.get(at..at + 2) == Some(&[2, 0]) {
        let explicit = bytes.get(at + 4..at + 6).is_some_and(|vr| vr.iter().all(u8::is_ascii_uppercase));
        let long = explicit && matches!(bytes.get(at + 4..at + 6), Some(b"OB" | b"UN" | b"OW" | b"UT" | b"SQ"));
        let length = |at: usize, n: usize| bytes.get(at..at + n).map(|b| b.iter().rev().fold(0usize, |v, &x| v << 8 | usize::from(x)));
        let (length, value) = match (explicit, long) {
            (true, false) => (length(at + 6, 2), at + 8),
            (true, true) => (length(at + 8, 4), at + 12),
            (false, _) => (length(at + 4, 4), at + 8),
        };
        let end = length
            .map(|n| value + n)
            .filter(|&end| end <= bytes.len())
            .ok_or_else(|| Fault::damaged("it ends within its meta information"))?;
        if bytes[at + 2..at + 4] == [0x10, 0] {
            transfer_syntax = String::from_utf8_lossy(&bytes[value..end]).trim_end_matches(['\0', ' ']).to_string();
        }
        at = end;
    }
    let mut bytes = bytes;
    bytes.drain(..at);
    if transfer_syntax == DEFLATED {
        let mut inflated = Vec::new();
        flate2::read::DeflateDecoder::new(&bytes[..])
            .read_to_end(&mut inflated)
            .map_err(|e| Fault::damaged(format!("it does not inflate ({e})")))?;
        bytes = inflated;
    }
    let syntax = match transfer_syntax.as_str() {
        IMPLICIT => Syntax { explicit: false, big_endian: false },
        BIG_ENDIAN => Syntax { explicit: true, big_endian: true },
        "" => bare_syntax(&bytes).ok_or_else(|| Fault::NotAVolume("it names no transfer syntax and does not begin like DICOM".into()))?,
        _ => Syntax { explicit: true, big_endian: false },
    };
    if transfer_syntax.is_empty() {
        transfer_syntax = match (syntax.explicit, syntax.big_endian) {
            (true, true) => BIG_ENDIAN,
            (true, false) => EXPLICIT,
            _ => IMPLICIT,
        }
        .into();
    }
    if let Some(known) = without_unknown_sequences(&bytes, syntax)? {
        bytes = known;
    }
    Ok(DataSet { bytes, syntax, transfer_syntax })
}

thread_local! {
    /// a panic on this thread is being turned into a fault: it has nothing to say on standard error
    static GUARDED: Cell<bool> = const { Cell::new(false) };
}

/// Runs a piece of the DICOM crates; a panic of theirs on hostile bytes becomes a fault here, says nothing, and takes nothing
/// down. The program's own panic hook stays in charge of all other panics.
pub(super) fn guarded<T>(what: &str, run: impl FnOnce() -> Parsed<T>) -> Parsed<T> {
    static HOOK: Once = Once::new();
    HOOK.call_once(|| {
        let others = panic::take_hook();
        panic::set_hook(Box::new(move |info| {
            if !GUARDED.get() {
                others(info)
            }
        }));
    });
    GUARDED.set(true);
    let outcome = catch_unwind(AssertUnwindSafe(run));
    GUARDED.set(false);
    outcome.unwrap_or_else(|_| Err(Fault::damaged(format!("its {what} make no sense"))))
}

/// Hands a data set to `dicom-object` as a file with a meta group of our own, for those that came without one.
///
/// The data set must have been scanned: see [`scan`].
pub(super) fn parse(data_set: &[u8], transfer_syntax: &str) -> Parsed<DefaultDicomObject> {
    let mut meta = Vec::new();
    let mut element = |number: u16, vr: &[u8; 2], value: &[u8]| {
        meta.extend(2u16.to_le_bytes());
        meta.extend(number.to_le_bytes());
        meta.extend(vr);
        if vr == b"OB" {
            meta.extend([0, 0]);
            meta.extend((value.len() as u32).to_le_bytes());
        } else {
            meta.extend((value.len().next_multiple_of(2) as u16).to_le_bytes());
        }
        meta.extend(value);
        meta.extend(std::iter::repeat_n(0u8, value.len() % 2));
    };
    element(0x01, b"OB", &[0, 1]);
    element(0x02, b"UI", b"1.2.840.10008.5.1.4.1.1.7");
    element(0x03, b"UI", b"2.25.1");
    element(0x10, b"UI", transfer_syntax.as_bytes());
    element(0x12, b"UI", b"2.25.2");
    let mut head = Vec::from(*b"DICM\x02\0\0\0UL\x04\0");
    head.extend((meta.len() as u32).to_le_bytes());
    head.extend(meta);
    OpenFileOptions::new()
        .read_preamble(ReadPreamble::Never)
        .from_reader(head.chain(data_set))
        .map_err(|e| Fault::damaged(format!("its attributes cannot be read ({})", root_cause(&e))))
}

/// Attributes of a data set or of an item in it.
#[derive(Clone, Copy)]
struct Attributes<'a>(&'a InMemDicomObject);

impl<'a> Attributes<'a> {
    fn floats(self, group: u16, element: u16) -> Option<Vec<f64>> {
        let v = self.0.get(Tag(group, element))?.to_multi_float64().ok()?;
        (!v.is_empty() && v.iter().all(|x| x.is_finite())).then_some(v)
    }
    fn float(self, group: u16, element: u16) -> Option<f64> {
        self.floats(group, element).map(|v| v[0])
    }
    fn vector<const N: usize>(self, group: u16, element: u16) -> Option<[f64; N]> {
        self.floats(group, element)?.try_into().ok()
    }
    fn whole(self, group: u16, element: u16) -> Option<usize> {
        self.0.get(Tag(group, element))?.to_int().ok()
    }
    fn text(self, group: u16, element: u16) -> String {
        let text = self.0.get(Tag(group, element)).and_then(|e| e.to_str().ok());
        text.map(|t| t.trim_matches([' ', '\0']).to_string()).unwrap_or_default()
    }
    fn items(self, group: u16, element: u16) -> impl Iterator<Item = Self> {
        self.0.get(Tag(group, element)).and_then(|e| e.items()).unwrap_or_default().iter().map(Attributes)
    }
    fn item(self, group: u16, element: u16) -> Option<Self> {
        self.items(group, element).next()
    }
}

impl Object {
    /// Reads a file's attributes.
    pub(super) fn open(path: &Path) -> Parsed<(Self, DataSet)> {
        let data_set = data_set(path)?;
        let object = guarded("attributes", || Self::parse(path, &data_set))?;
        Ok((object, data_set))
    }

    fn parse(path: &Path, set: &DataSet) -> Parsed<Self> {
        let pixel = scan(&set.bytes, set.syntax)?;
        // Elements are sorted by tag: all that describes the pixels lies before them.
        let described = &set.bytes[..pixel.as_ref().map_or(set.bytes.len(), |p| p.begin)];
        let uid = match (set.syntax.explicit, set.syntax.big_endian) {
            (true, true) => BIG_ENDIAN,
            (true, false) => EXPLICIT,
            _ => IMPLICIT,
        };
        let dataset = parse(described, uid)?;
        Self::describe(path, Attributes(&dataset), set, pixel)
    }

    fn describe(path: &Path, a: Attributes<'_>, set: &DataSet, pixel: Option<PixelElement>) -> Parsed<Self> {
        let (modality, class) = (a.text(8, 0x60), a.text(8, 0x16));
        if class == "1.2.840.10008.5.1.4.1.1.66.4" || class == "1.2.840.10008.5.1.4.1.1.66.7" {
            return Err(Fault::NotAVolume("it is a DICOM segmentation, not an image".into()));
        }
        let Some(pixel) = pixel else {
            let what = match modality.as_str() {
                "" => "a DICOM object".into(),
                m => format!("a DICOM object of modality {m}"),
            };
            return Err(Fault::NotAVolume(format!("it is {what} without an image in it")));
        };
        let need = |name: &str, group: u16, element: u16| {
            a.whole(group, element).ok_or_else(|| Fault::damaged(format!("it does not state its number of {name}")))
        };
        let rows = need("rows", 0x28, 0x10)?;
        let columns = need("columns", 0x28, 0x11)?;
        if rows == 0 || columns == 0 {
            return Err(Fault::damaged(format!("its image has {columns} by {rows} pixels")));
        }
        let allocated = match pixel.element {
            8 => 32,
            9 => 64,
            _ => need("bits", 0x28, 0x100)?,
        };
        if !matches!(allocated, 8 | 16 | 32 | 64) {
            return Err(Fault::unsupported(format!("its pixels have {allocated} bits"), "convert it to 8 or 16 bits"));
        }
        let frames = match a.0.get(Tag(0x28, 8)) {
            None => 1,
            Some(_) => a.text(0x28, 8).trim().parse().ok().filter(|n| (1..=1 << 20).contains(n)).ok_or_else(|| {
                Fault::damaged(format!("its number of frames {:?} is no number", a.text(0x28, 8).chars().take(20).collect::<String>()))
            })?,
        };
        let shared = a.item(0x5200, 0x9229);
        let per_frame: Vec<Attributes<'_>> = a.items(0x5200, 0x9230).collect();
        let offsets = a.floats(0x3004, 0x000C).filter(|o| o.len() == frames);
        let (mut planes, mut detector_spacing) = (Vec::new(), false);
        for frame in 0..frames {
            let group = |group: u16, element: u16| {
                per_frame.get(frame).and_then(|f| f.item(group, element)).or_else(|| shared.and_then(|s| s.item(group, element)))
            };
            let measures = group(0x28, 0x9110).unwrap_or(a);
            let values = group(0x28, 0x9145).unwrap_or(a);
            let orientation = group(0x20, 0x9116).unwrap_or(a).vector::<6>(0x20, 0x37);
            let axes = orientation.map(|o| [[o[0], o[1], o[2]], [o[3], o[4], o[5]]]);
            if let Some([r, c]) = axes
                && ((norm(r) - 1.0).abs() > SQUARE || (norm(c) - 1.0).abs() > SQUARE || dot(r, c).abs() > SQUARE)
            {
                return Err(Fault::damaged(format!("its orientation {r:?}, {c:?} is not made of two unit vectors at right angles")));
            }
            let mut position = group(0x20, 0x9113).unwrap_or(a).vector::<3>(0x20, 0x32);
            if let (Some(p), Some([r, c]), Some(offsets)) = (&mut position, axes, &offsets) {
                let normal = cross(r, c);
                // Offsets count from the first frame; some writers give absolute heights, whose first is not 0.
                let offset = offsets[frame] - offsets[0];
                *p = std::array::from_fn(|n| p[n] + offset * normal[n]);
            } else if frames > 1 && per_frame.is_empty() && frame > 0 {
                position = None;
            }
            let patient = measures.vector::<2>(0x28, 0x30).or_else(|| a.vector::<2>(0x28, 0x30));
            let detector = a.vector::<2>(0x18, 0x1164).or_else(|| a.vector::<2>(0x18, 0x2010));
            detector_spacing |= patient.is_none() && detector.is_some();
            planes.push(Plane {
                position,
                axes,
                // The file states the distance of rows first.
                spacing: patient.or(detector).filter(|s| s.iter().all(|x| *x > 0.0)).map(|[row, column]| [column, row]),
                thickness: measures.float(0x18, 0x50).or_else(|| a.float(0x18, 0x50)).filter(|t| *t > 0.0),
                slope: values.float(0x28, 0x1053).filter(|s| *s != 0.0).unwrap_or(1.0),
                intercept: values.float(0x28, 0x1052).unwrap_or(0.0),
            });
        }
        let series = a.text(0x20, 0x0E);
        let description: String = a.text(8, 0x103E).chars().filter(|c| !c.is_control()).take(40).collect();
        Ok(Self {
            path: path.to_path_buf(),
            label: [modality.as_str(), description.as_str()].iter().filter(|t| !t.is_empty()).copied().collect::<Vec<_>>().join(", "),
            series: if series.is_empty() { "(no SeriesInstanceUID)".into() } else { series },
            columns,
            rows,
            samples: a.whole(0x28, 2).unwrap_or(1),
            allocated,
            stored: a.whole(0x28, 0x101).filter(|s| (1..=allocated).contains(s)).unwrap_or(allocated),
            high_bit: a.whole(0x28, 0x102).unwrap_or(0),
            signed: a.whole(0x28, 0x103) == Some(1),
            photometric: a.text(0x28, 4),
            planar: a.whole(0x28, 6) == Some(1),
            padding: a.float(0x28, 0x120),
            between: a.float(0x18, 0x88).filter(|s| *s > 0.0),
            cine: frames > 1 && (a.float(0x18, 0x1063).is_some() || a.floats(0x18, 0x1065).is_some() || modality == "US"),
            planes,
            dose_scaling: a.float(0x3004, 0x000E),
            detector_spacing,
            transfer_syntax: set.transfer_syntax.clone(),
            syntax: set.syntax,
            pixel,
        })
    }

    /// Number of bytes all frames take when decoded.
    pub(super) fn expected_bytes(&self) -> Parsed<usize> {
        [self.rows, self.columns, self.samples, self.planes.len(), self.allocated / 8]
            .iter()
            .try_fold(1usize, |n, &f| n.checked_mul(f))
            .filter(|n| *n > 0)
            .ok_or_else(|| Fault::damaged("its size makes no sense"))
    }

    /// Whether the pixels lie in the file as they are.
    pub(super) fn is_native(&self) -> bool {
        matches!(self.pixel.data, PixelBytes::Native(_))
    }
}

/// The innermost reason of an error: what a person can use of a chain.
pub(super) fn root_cause(error: &dyn std::error::Error) -> String {
    let mut cause = error;
    while let Some(inner) = cause.source() {
        cause = inner;
    }
    cause.to_string().replace('\n', " ")
}
