//! A matrix of three columns from a MATLAB file of version 5 ("MAT-File Format", MathWorks, chapter 1).
//!
//! 128 bytes of header (the last two tell the order of bytes), then elements: type and size, 8 bytes or 4 (small), then the data, padded to 8. An array is an
//! element of elements: flags (class), dimensions, name, numbers by columns; it may lie compressed (zlib) in another. Real numbers of any type are
//! read; everything else in the file is passed over.

use flate2::read::ZlibDecoder;
use std::io::Read as _;

const INT32: u32 = 5;
const MATRIX: u32 = 14;
const COMPRESSED: u32 = 15;
/// More than this in one array is no list of landmarks.
const MOST_BYTES: u64 = 64 << 20;

/// The rows of a variable, or of the only one with three columns.
pub(super) fn rows_of_three(bytes: &[u8], variable: Option<&str>) -> Result<Vec<[f64; 3]>, String> {
    let little = match bytes.get(126..128) {
        Some(b"IM") => true,
        Some(b"MI") => false,
        _ => return Err("its header is cut off or says no order of bytes".into()),
    };
    let mut matrices = Vec::new();
    let mut rest = &bytes[128..];
    while !rest.is_empty() {
        let (kind, data, after) = element(rest, little).ok_or("it is cut off in the midst of an element")?;
        match kind {
            COMPRESSED => {
                let mut inflated = Vec::new();
                ZlibDecoder::new(data)
                    .take(MOST_BYTES)
                    .read_to_end(&mut inflated)
                    .map_err(|e| format!("a compressed part is broken: {e}"))?;
                let (kind, data, _) = element(&inflated, little).ok_or("a compressed part is cut off")?;
                matrices.extend((kind == MATRIX).then(|| matrix(data, little)).flatten());
            }
            MATRIX => matrices.extend(matrix(data, little)),
            _ => {}
        }
        rest = after;
    }
    let names: Vec<&str> = matrices.iter().map(|(name, _)| name.as_str()).collect();
    let names = names.join(", ");
    let mut fitting = matrices.iter().filter(|(name, _)| variable.is_none_or(|v| v == name));
    match (fitting.next(), fitting.next()) {
        (Some((_, rows)), None) => Ok(rows.clone()),
        (Some(_), Some(_)) => Err(format!("it has several lists of three columns: name one (FILE:NAME) of {names}")),
        (None, _) if matrices.is_empty() => Err("it has no variable of three columns of numbers".into()),
        (None, _) => Err(format!("it has no variable `{}` of three columns, but {names}", variable.unwrap_or_default())),
    }
}

/// Type and data of the first element, and what follows it.
fn element(bytes: &[u8], little: bool) -> Option<(u32, &[u8], &[u8])> {
    let word = |at: usize| Some(number(bytes.get(at..at + 4)?, little) as u32);
    let first = word(0)?;
    if first >> 16 != 0 {
        // small: type and size in one word, up to four bytes in the next
        let size = (first >> 16) as usize;
        return Some((first & 0xffff, bytes.get(4..4 + size.min(4))?, bytes.get(8..)?));
    }
    let size = word(4)? as usize;
    // compressed elements are not padded
    let end = if first == COMPRESSED { 8usize.checked_add(size)? } else { 8usize.checked_add(size)?.checked_next_multiple_of(8)? };
    Some((first, bytes.get(8..8usize.checked_add(size)?)?, bytes.get(end.min(bytes.len())..)?))
}

fn number(bytes: &[u8], little: bool) -> u64 {
    let join = |sum: u64, b: &u8| sum << 8 | u64::from(*b);
    if little { bytes.iter().rev().fold(0, join) } else { bytes.iter().fold(0, join) }
}

/// Name and rows of a real matrix of three columns.
fn matrix(data: &[u8], little: bool) -> Option<(String, Vec<[f64; 3]>)> {
    let (_, _flags, rest) = element(data, little)?;
    let (kind, dimensions, rest) = element(rest, little)?;
    let dimensions: Vec<usize> = dimensions.chunks_exact(4).map(|d| number(d, little) as usize).collect();
    let &[rows, 3] = dimensions.as_slice() else { return None };
    let (_, name, rest) = element(rest, little)?;
    let (of, data, _) = element(rest, little)?;
    let width = match of {
        1 | 2 => 1,
        3 | 4 => 2,
        5..=7 => 4,
        9 | 12 | 13 => 8,
        _ => return None,
    };
    let value = |bytes: &[u8]| {
        let bits = number(bytes, little);
        match of {
            1 => f64::from(bits as u8 as i8),
            3 => f64::from(bits as u16 as i16),
            5 => f64::from(bits as u32 as i32),
            7 => f64::from(f32::from_bits(bits as u32)),
            9 => f64::from_bits(bits),
            12 => bits as i64 as f64,
            _ => bits as f64,
        }
    };
    let values: Vec<f64> = data.chunks_exact(width).map(value).collect();
    if kind != INT32 || values.len() != rows.checked_mul(3)? {
        return None;
    }
    let name = String::from_utf8_lossy(name).into_owned();
    Some((name, (0..rows).map(|r| std::array::from_fn(|c| values[c * rows + r])).collect()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use flate2::{Compression, write::ZlibEncoder};
    use std::io::Write as _;

    fn part(kind: u32, data: &[u8]) -> Vec<u8> {
        let mut out = [kind.to_le_bytes(), (data.len() as u32).to_le_bytes()].concat();
        out.extend(data);
        if kind != COMPRESSED {
            out.resize(out.len().next_multiple_of(8), 0);
        }
        out
    }

    /// A matrix of bytes, by columns; names of up to four letters are small elements.
    fn array(name: &str, rows: u32, columns: u32, values: &[u8]) -> Vec<u8> {
        let mut small = (1u32 | (name.len() as u32) << 16).to_le_bytes().to_vec();
        small.extend(name.bytes());
        small.resize(8, 0);
        let dimensions = [rows.to_le_bytes(), columns.to_le_bytes()].concat();
        part(MATRIX, &[part(6, &[9, 0, 0, 0, 0, 0, 0, 0]), part(INT32, &dimensions), small, part(2, values)].concat())
    }

    fn file(parts: &[Vec<u8>]) -> Vec<u8> {
        let mut out = b"MATLAB 5.0 MAT-file, made by a test".to_vec();
        out.resize(126, b' ');
        out.extend(b"IM");
        out.extend(parts.concat());
        out
    }

    #[test]
    fn rows_come_from_columns_packed_or_not_and_nothing_cut_off_is_believed() {
        let (one, other) = (array("ee", 2, 3, &[1, 2, 3, 4, 5, 6]), array("ei", 2, 3, &[7, 8, 9, 10, 11, 12]));
        let flags = array("no", 2, 1, &[0, 1]);
        let mut zlib = ZlibEncoder::new(Vec::new(), Compression::default());
        zlib.write_all(&other).unwrap();
        let whole = file(&[one, flags, part(COMPRESSED, &zlib.finish().unwrap())]);
        assert_eq!(rows_of_three(&whole, Some("ee")).unwrap(), [[1.0, 3.0, 5.0], [2.0, 4.0, 6.0]]);
        assert_eq!(rows_of_three(&whole, Some("ei")).unwrap(), [[7.0, 9.0, 11.0], [8.0, 10.0, 12.0]]);
        let says = |variable, what: &str| {
            let fault = rows_of_three(&whole, variable).unwrap_err();
            assert!(fault.contains(what), "{fault}");
        };
        says(None, "several lists of three columns: name one (FILE:NAME) of ee, ei");
        says(Some("no"), "no variable `no` of three columns, but ee, ei");
        for cut in 0..whole.len() {
            // refused or, where a whole element is missing, without it; never something else
            if let Ok(rows) = rows_of_three(&whole[..cut], Some("ei")) {
                panic!("{cut}: {rows:?}");
            }
        }
    }
}
