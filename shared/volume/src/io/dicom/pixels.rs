//! Decodes the pixels of one DICOM object.
//!
//! Uncompressed pixels are taken from the file's bytes; compressed ones go through `dicom-pixeldata` after a look at
//! what their own headers say, for a decoder fills what a short stream leaves out with zeros and tells nobody.
//! Stored bits are masked and sign-extended. [DICOM PS3.5, sections 8.1 and 8.2; PS3.3, C.7.6.3.1]

use super::{
    super::{
        error::{Fault, Parsed},
        payload::{self, Kind},
    },
    object::{Object, guarded, parse, root_cause},
    scan::PixelBytes,
};
use crate::Pixels;
use dicom_pixeldata::PixelDecoder;

/// No decoder here makes more bytes of one: RLE at most 64, JPEG of an even picture somewhat below a thousand.
const MOST_EXPANSION: usize = 2000;

impl Object {
    /// All frames: component fastest, then columns, rows, frames.
    pub(super) fn decode(&self, data_set: &[u8]) -> Parsed<Pixels> {
        self.refuse_colours()?;
        let kind = match (self.pixel.element, self.allocated, self.signed) {
            (8, ..) => Kind::F32,
            (9, ..) => Kind::F64,
            (_, 8, false) => Kind::U8,
            (_, 8, true) => Kind::I8,
            (_, 16, false) => Kind::U16,
            (_, 16, true) => Kind::I16,
            (_, 32, false) => Kind::U32,
            (_, 32, true) => Kind::I32,
            (_, _, false) => Kind::U64,
            (_, _, true) => Kind::I64,
        };
        let expected = self.expected_bytes()?;
        let (bytes, big_endian) = match &self.pixel.data {
            PixelBytes::Native(range) => {
                let there = range.len();
                // One byte of padding makes odd lengths even; whole frames too many would be another object.
                if there < expected || there - expected >= (expected / self.planes.len()).max(2) {
                    return Err(Fault::damaged(format!("its header calls for {expected} bytes of pixels, {there} are there")));
                }
                let mut bytes = data_set[range.clone()].to_vec();
                // Bytes written as big-endian words lie swapped in pairs. [PS3.5, section 8.1.2]
                if self.syntax.big_endian && self.allocated == 8 && self.pixel.words {
                    bytes.chunks_exact_mut(2).for_each(|pair| pair.swap(0, 1));
                }
                bytes.truncate(expected);
                (bytes, self.syntax.big_endian)
            }
            PixelBytes::Fragments(fragments) => {
                let packed: usize = fragments.iter().map(|f| f.len()).sum();
                if expected > packed.saturating_mul(MOST_EXPANSION).saturating_add(1 << 16) {
                    return Err(Fault::damaged(format!(
                        "its header calls for {expected} bytes of pixels, too many for {packed} compressed ones"
                    )));
                }
                self.check_streams(fragments.iter().map(|f| &data_set[f.clone()]).collect())?;
                (self.decompress(data_set, expected)?, false)
            }
        };
        let bytes = if self.samples == 3 && self.planar && self.is_native() { self.interleave(bytes) } else { bytes };
        let mut pixels = payload::decode(bytes, kind, big_endian);
        self.mask(&mut pixels);
        if self.samples == 3 && self.photometric == "YBR_FULL" && !self.is_jpeg() {
            to_rgb(&mut pixels)?;
        }
        Ok(pixels)
    }

    fn is_jpeg(&self) -> bool {
        self.transfer_syntax.starts_with("1.2.840.10008.1.2.4.")
    }

    fn refuse_colours(&self) -> Parsed<()> {
        let advice = "convert it to grey or RGB pixels";
        match (self.samples, self.photometric.as_str()) {
            (1, "PALETTE COLOR") => Err(Fault::unsupported("its pixels are indices into a palette of colours", advice)),
            (1, _) => Ok(()),
            (3, "RGB" | "YBR_FULL") => Ok(()),
            (3, "YBR_FULL_422") if !self.is_native() && self.is_jpeg() => Ok(()),
            (samples, photometric) => Err(Fault::unsupported(format!("its pixels have {samples} samples of kind {photometric:?}"), advice)),
        }
    }

    fn decompress(&self, data_set: &[u8], expected: usize) -> Parsed<Vec<u8>> {
        let bytes = guarded("compressed pixels", || {
            let object = parse(&data_set[..self.pixel.end], &self.transfer_syntax)?;
            match object.decode_pixel_data() {
                Ok(decoded) => Ok(decoded.into_data()),
                Err(e) => {
                    let cause = root_cause(&e);
                    let unsupported =
                        ["nsupported", "nknown", "not supported"].iter().any(|w| cause.contains(w) || e.to_string().contains(w));
                    Err(if unsupported {
                        Fault::unsupported(
                            format!("its pixels are compressed as {}, which cannot be decoded", self.transfer_syntax_name()),
                            "convert it to an uncompressed transfer syntax",
                        )
                    } else {
                        Fault::damaged(format!("its compressed pixels cannot be decoded ({cause})"))
                    })
                }
            }
        })?;
        if bytes.len() < expected || bytes.len() > expected + self.planes.len() {
            return Err(Fault::damaged(format!("its header calls for {expected} bytes of pixels, {} were decoded", bytes.len())));
        }
        Ok(bytes)
    }

    fn transfer_syntax_name(&self) -> String {
        let name = match self.transfer_syntax.as_str() {
            "1.2.840.10008.1.2.4.80" | "1.2.840.10008.1.2.4.81" => "JPEG-LS",
            "1.2.840.10008.1.2.4.90" | "1.2.840.10008.1.2.4.91" => "JPEG 2000",
            "1.2.840.10008.1.2.4.92" | "1.2.840.10008.1.2.4.93" => "JPEG 2000 part 2",
            "1.2.840.10008.1.2.4.201" | "1.2.840.10008.1.2.4.202" | "1.2.840.10008.1.2.4.203" => "high-throughput JPEG 2000",
            other => return format!("transfer syntax {other}"),
        };
        name.into()
    }

    /// What JPEG streams say of themselves must agree with the attributes.
    fn check_streams(&self, fragments: Vec<&[u8]>) -> Parsed<()> {
        if !matches!(
            self.transfer_syntax.as_str(),
            "1.2.840.10008.1.2.4.50" | "1.2.840.10008.1.2.4.51" | "1.2.840.10008.1.2.4.57" | "1.2.840.10008.1.2.4.70"
        ) {
            return Ok(());
        }
        let mut streams = 0;
        for fragment in fragments {
            if !fragment.starts_with(&[0xFF, 0xD8]) {
                continue;
            }
            streams += 1;
            let Some(JpegHeader { precision, rows, columns, samples, lossless, rgb }) = frame_header(fragment) else { continue };
            if (rows, columns, samples) != (self.rows, self.columns, self.samples) {
                return Err(Fault::damaged(format!(
                    "its attributes tell of {}x{} pixels of {} samples, its JPEG stream of {columns}x{rows} of {samples}",
                    self.columns, self.rows, self.samples
                )));
            }
            // Without a mark of its own a colour stream decodes as YBR, whatever the attributes say.
            if samples == 3 && !lossless && rgb != (self.photometric == "RGB") {
                return Err(Fault::unsupported(
                    format!("its attributes call its colours {}, its JPEG stream does not", self.photometric),
                    "convert it to an uncompressed transfer syntax",
                ));
            }
            if precision.next_multiple_of(8) != self.allocated {
                return Err(Fault::unsupported(
                    format!("its JPEG stream has {precision} bits a sample, its attributes {}", self.allocated),
                    "convert it to an uncompressed transfer syntax",
                ));
            }
        }
        if streams < self.planes.len() {
            return Err(Fault::damaged(format!("it has {} frames and {streams} JPEG streams", self.planes.len())));
        }
        Ok(())
    }

    /// Plane by plane → sample by sample, in each frame.
    fn interleave(&self, bytes: Vec<u8>) -> Vec<u8> {
        let (size, area) = (self.allocated / 8, self.rows * self.columns);
        let mut out = Vec::with_capacity(bytes.len());
        for frame in bytes.chunks_exact(3 * area * size) {
            for pixel in 0..area {
                for sample in 0..3 {
                    let at = (sample * area + pixel) * size;
                    out.extend_from_slice(&frame[at..at + size]);
                }
            }
        }
        out
    }

    /// Keeps the stored bits only: the others may hold overlays or rubbish.
    fn mask(&self, pixels: &mut Pixels) {
        let (stored, allocated) = (self.stored as u32, self.allocated as u32);
        if stored >= allocated || matches!(self.pixel.element, 8 | 9) {
            return;
        }
        // Left, then right: arithmetic for signed types, which extends the sign.
        let high = (self.high_bit as u32).clamp(stored - 1, allocated - 1);
        let (left, right) = (allocated - 1 - high, allocated - stored);
        macro_rules! mask {
            ($($v:ident),*) => {
                match pixels {
                    $(Pixels::$v(v) => v.iter_mut().for_each(|x| *x = *x << left >> right),)*
                    _ => {}
                }
            };
        }
        mask!(U8, I8, U16, I16, U32, I32, U64, I64);
    }
}

/// What a JPEG stream says of itself.
struct JpegHeader {
    precision: usize,
    rows: usize,
    columns: usize,
    samples: usize,
    lossless: bool,
    /// its colours are marked as RGB, by Adobe's segment or by the names of its components
    rgb: bool,
}

fn frame_header(stream: &[u8]) -> Option<JpegHeader> {
    let mut at = 2;
    let mut adobe_rgb = false;
    loop {
        let &[mark, code, high, low] = stream.get(at..at + 4)?.first_chunk::<4>()?;
        if mark != 0xFF {
            return None;
        }
        if code == 0xFF {
            at += 1;
            continue;
        }
        let length = usize::from(high) << 8 | usize::from(low);
        if code == 0xEE && stream.get(at + 4..at + 9) == Some(b"Adobe") {
            adobe_rgb = stream.get(at + 15) == Some(&0);
        }
        if matches!(code, 0xC0..=0xCF) && !matches!(code, 0xC4 | 0xC8 | 0xCC) {
            let h = stream.get(at + 4..at + 10)?;
            let pair = |n: usize| usize::from(h[n]) << 8 | usize::from(h[n + 1]);
            let name = |n: usize| stream.get(at + 10 + 3 * n).copied();
            let named_rgb = [name(0), name(1), name(2)] == [Some(b'R'), Some(b'G'), Some(b'B')];
            return Some(JpegHeader {
                precision: h[0].into(),
                rows: pair(1),
                columns: pair(3),
                samples: h[5].into(),
                lossless: code == 0xC3,
                rgb: adobe_rgb || named_rgb,
            });
        }
        at += 2 + length;
    }
}

/// Full-range YCbCr → RGB. [DICOM PS3.3, C.7.6.3.1.2]
fn to_rgb(pixels: &mut Pixels) -> Parsed<()> {
    let Pixels::U8(bytes) = pixels else {
        return Err(Fault::unsupported("its colours are YBR of more than 8 bits", "convert it to RGB"));
    };
    for p in bytes.chunks_exact_mut(3) {
        let (y, b, r) = (f64::from(p[0]), f64::from(p[1]) - 128.0, f64::from(p[2]) - 128.0);
        let rgb = [y + 1.402 * r, y - 0.344_136 * b - 0.714_136 * r, y + 1.772 * b];
        p.copy_from_slice(&rgb.map(|x| x.round().clamp(0.0, 255.0) as u8));
    }
    Ok(())
}
