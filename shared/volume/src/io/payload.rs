//! Voxel bytes: decompression, text, byte order, and the order of axes.
//!
//! Invariant: nothing here allocates by what a header declares. Buffers grow with the bytes that arrive and stop at
//! the number expected, so that a lie in a header costs no more memory than the file can pay for.

use super::error::{Fault, Parsed};
use crate::Pixels;
use bzip2::read::MultiBzDecoder;
use flate2::read::{MultiGzDecoder, ZlibDecoder};
use std::io::{self, Read};

/// A number's type in a file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Kind {
    U8,
    I8,
    U16,
    I16,
    U32,
    I32,
    U64,
    I64,
    F32,
    F64,
}

impl Kind {
    pub(crate) fn size_bytes(self) -> usize {
        match self {
            Self::U8 | Self::I8 => 1,
            Self::U16 | Self::I16 => 2,
            Self::U32 | Self::I32 | Self::F32 => 4,
            Self::U64 | Self::I64 | Self::F64 => 8,
        }
    }

    pub(crate) fn of(pixels: &Pixels) -> Self {
        match pixels {
            Pixels::U8(_) => Self::U8,
            Pixels::I8(_) => Self::I8,
            Pixels::U16(_) => Self::U16,
            Pixels::I16(_) => Self::I16,
            Pixels::U32(_) => Self::U32,
            Pixels::I32(_) => Self::I32,
            Pixels::U64(_) => Self::U64,
            Pixels::I64(_) => Self::I64,
            Pixels::F32(_) => Self::F32,
            Pixels::F64(_) => Self::F64,
        }
    }
}

/// How the bytes are packed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Packing {
    Raw,
    Gzip,
    Zlib,
    Bzip2,
}

/// Unpacks a stream.
pub(crate) fn unpack<'a>(reader: impl Read + 'a, packing: Packing) -> Box<dyn Read + 'a> {
    match packing {
        Packing::Raw => Box::new(reader),
        Packing::Gzip => Box::new(MultiGzDecoder::new(reader)),
        Packing::Zlib => Box::new(ZlibDecoder::new(reader)),
        Packing::Bzip2 => Box::new(MultiBzDecoder::new(reader)),
    }
}

/// Number of numbers and of bytes that sizes call for, refused beyond 2³² voxels' worth (DESIGN D11).
pub(crate) fn expected_bytes(sizes: &[usize], kind: Kind) -> Parsed<usize> {
    let numbers = sizes.iter().try_fold(1usize, |n, &s| n.checked_mul(s)).filter(|&n| n <= 1 << 40);
    match numbers.and_then(|n| n.checked_mul(kind.size_bytes())) {
        None => Err(Fault::unsupported(format!("its size {sizes:?} is beyond any memory"), "check the header")),
        Some(0) => Err(Fault::damaged(format!("its size {sizes:?} has a zero"))),
        Some(bytes) => Ok(bytes),
    }
}

/// A decoder's complaint is about the content, not about the device the file lies on.
fn content_fault(error: io::Error) -> Fault {
    match error.kind() {
        io::ErrorKind::InvalidData | io::ErrorKind::InvalidInput | io::ErrorKind::UnexpectedEof | io::ErrorKind::Other => {
            Fault::damaged(format!("its data do not decompress ({error})"))
        }
        _ => Fault::Io(error),
    }
}

/// Skips bytes of a stream.
pub(crate) fn skip(reader: &mut dyn Read, count: u64) -> Parsed<()> {
    let skipped = io::copy(&mut reader.take(count), &mut io::sink()).map_err(content_fault)?;
    if skipped < count {
        return Err(Fault::damaged(format!("it ends {} bytes before its voxels begin", count - skipped)));
    }
    Ok(())
}

/// Exactly `expected` bytes of a stream, which must be all there is when `to_the_end`.
pub(crate) fn take_exactly(reader: &mut dyn Read, expected: usize, to_the_end: bool) -> Parsed<Vec<u8>> {
    let mut bytes = Vec::new();
    Read::take(&mut *reader, expected as u64).read_to_end(&mut bytes).map_err(content_fault)?;
    if bytes.len() < expected {
        return Err(Fault::damaged(format!("its header calls for {expected} bytes of voxels, only {} are there", bytes.len())));
    }
    if to_the_end {
        let extra = io::copy(&mut Read::take(&mut *reader, 1 << 20), &mut io::sink()).map_err(content_fault)?;
        // One line end after the voxels is what an editor or a text-mode writer leaves; more is another geometry.
        if extra > 2 {
            let more = if extra >= 1 << 20 { "over a million".into() } else { extra.to_string() };
            return Err(Fault::damaged(format!("its header calls for {expected} bytes of voxels, {more} more are there")));
        }
    }
    Ok(bytes)
}

/// The last `expected` bytes of a stream, holding at most about twice as many.
pub(crate) fn take_last(reader: &mut dyn Read, expected: usize) -> Parsed<Vec<u8>> {
    let mut bytes = Vec::new();
    let mut chunk = vec![0u8; 1 << 16];
    loop {
        let n = match reader.read(&mut chunk) {
            Ok(0) => break,
            Ok(n) => n,
            Err(e) if e.kind() == io::ErrorKind::Interrupted => continue,
            Err(e) => return Err(content_fault(e)),
        };
        bytes.extend_from_slice(&chunk[..n]);
        if bytes.len() > 2 * expected + (1 << 20) {
            bytes.drain(..bytes.len() - expected);
        }
    }
    if bytes.len() < expected {
        return Err(Fault::damaged(format!("its header calls for {expected} bytes of voxels, only {} are there", bytes.len())));
    }
    bytes.drain(..bytes.len() - expected);
    Ok(bytes)
}

/// Numbers from bytes.
pub(crate) fn decode(bytes: Vec<u8>, kind: Kind, big_endian: bool) -> Pixels {
    macro_rules! numbers {
        ($t:ty) => {
            bytes
                .chunks_exact(size_of::<$t>())
                .map(|c| {
                    let c = c.try_into().expect("chunks are exact");
                    if big_endian { <$t>::from_be_bytes(c) } else { <$t>::from_le_bytes(c) }
                })
                .collect()
        };
    }
    match kind {
        Kind::U8 => Pixels::U8(bytes),
        Kind::I8 => Pixels::I8(bytes.into_iter().map(|b| b as i8).collect()),
        Kind::U16 => Pixels::U16(numbers!(u16)),
        Kind::I16 => Pixels::I16(numbers!(i16)),
        Kind::U32 => Pixels::U32(numbers!(u32)),
        Kind::I32 => Pixels::I32(numbers!(i32)),
        Kind::U64 => Pixels::U64(numbers!(u64)),
        Kind::I64 => Pixels::I64(numbers!(i64)),
        Kind::F32 => Pixels::F32(numbers!(f32)),
        Kind::F64 => Pixels::F64(numbers!(f64)),
    }
}

/// Little-endian bytes of the numbers, a piece at a time, to a writer.
pub(crate) fn encode(pixels: &Pixels, out: &mut dyn io::Write) -> io::Result<()> {
    macro_rules! numbers {
        ($v:expr) => {
            for part in $v.chunks(1 << 16) {
                let bytes: Vec<u8> = part.iter().flat_map(|x| x.to_le_bytes()).collect();
                out.write_all(&bytes)?;
            }
        };
    }
    match pixels {
        Pixels::U8(v) => out.write_all(v)?,
        Pixels::I8(v) => numbers!(v),
        Pixels::U16(v) => numbers!(v),
        Pixels::I16(v) => numbers!(v),
        Pixels::U32(v) => numbers!(v),
        Pixels::I32(v) => numbers!(v),
        Pixels::U64(v) => numbers!(v),
        Pixels::I64(v) => numbers!(v),
        Pixels::F32(v) => numbers!(v),
        Pixels::F64(v) => numbers!(v),
    }
    Ok(())
}

/// Exactly `expected` numbers written as text, separated by white space or commas.
pub(crate) fn parse_text(text: &[u8], kind: Kind, expected: usize) -> Parsed<Pixels> {
    macro_rules! numbers {
        ($variant:ident, $t:ty) => {{
            let mut numbers: Vec<$t> = Vec::new();
            for word in text.split(|b| b.is_ascii_whitespace() || *b == b',').filter(|w| !w.is_empty()) {
                if numbers.len() == expected {
                    return Err(Fault::damaged(format!("its header calls for {expected} numbers, more are there")));
                }
                let number = std::str::from_utf8(word).ok().and_then(|w| w.parse::<$t>().ok());
                numbers.push(number.ok_or_else(|| {
                    let word = String::from_utf8_lossy(&word[..word.len().min(24)]).into_owned();
                    Fault::damaged(format!("{word:?}, its number {}, is no {}", numbers.len() + 1, stringify!($t)))
                })?);
            }
            if numbers.len() < expected {
                return Err(Fault::damaged(format!("its header calls for {expected} numbers, only {} are there", numbers.len())));
            }
            Ok(Pixels::$variant(numbers))
        }};
    }
    match kind {
        Kind::U8 => numbers!(U8, u8),
        Kind::I8 => numbers!(I8, i8),
        Kind::U16 => numbers!(U16, u16),
        Kind::I16 => numbers!(I16, i16),
        Kind::U32 => numbers!(U32, u32),
        Kind::I32 => numbers!(I32, i32),
        Kind::U64 => numbers!(U64, u64),
        Kind::I64 => numbers!(I64, i64),
        Kind::F32 => numbers!(F32, f32),
        Kind::F64 => numbers!(F64, f64),
    }
}

/// Re-orders axes: `order[t]` is the axis of the file (fastest first) that becomes axis t.
pub(crate) fn permute(pixels: Pixels, sizes: &[usize], order: &[usize]) -> Pixels {
    if order.iter().enumerate().all(|(t, &s)| t == s) {
        return pixels;
    }
    let mut stride = vec![1usize; sizes.len()];
    for axis in 1..sizes.len() {
        stride[axis] = stride[axis - 1] * sizes[axis - 1];
    }
    let count = sizes.iter().product();
    // Walks the target in order and carries the source offset along like an odometer.
    let gather = |push: &mut dyn FnMut(usize)| {
        let mut index = vec![0usize; order.len()];
        let mut offset = 0usize;
        for _ in 0..count {
            push(offset);
            for (t, &axis) in order.iter().enumerate() {
                index[t] += 1;
                offset += stride[axis];
                if index[t] < sizes[axis] {
                    break;
                }
                offset -= stride[axis] * sizes[axis];
                index[t] = 0;
            }
        }
    };
    macro_rules! gathered {
        ($v:expr) => {{
            let mut out = Vec::with_capacity($v.len());
            gather(&mut |offset| out.push($v[offset]));
            out
        }};
    }
    match pixels {
        Pixels::U8(v) => Pixels::U8(gathered!(v)),
        Pixels::I8(v) => Pixels::I8(gathered!(v)),
        Pixels::U16(v) => Pixels::U16(gathered!(v)),
        Pixels::I16(v) => Pixels::I16(gathered!(v)),
        Pixels::U32(v) => Pixels::U32(gathered!(v)),
        Pixels::I32(v) => Pixels::I32(gathered!(v)),
        Pixels::U64(v) => Pixels::U64(gathered!(v)),
        Pixels::I64(v) => Pixels::I64(gathered!(v)),
        Pixels::F32(v) => Pixels::F32(gathered!(v)),
        Pixels::F64(v) => Pixels::F64(gathered!(v)),
    }
}
