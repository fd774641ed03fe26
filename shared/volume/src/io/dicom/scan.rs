//! Walks the elements of a DICOM file without storing any, to find its pixels and to check every length.
//!
//! `dicom-object` sets memory aside by the length an element states, up to 4 GiB, before it reads. So no byte goes to it
//! before this walk has seen that every stated length lies within the file. [DICOM PS3.5, section 7]
//!
//! Invariant: the walk allocates nothing but the list of fragments, and ends after at most one step a byte.

use super::super::error::{Fault, Parsed};
use std::ops::Range;

/// Deepest nesting of sequences followed; real objects stay below ten.
const DEPTH: usize = 32;
const UNDEFINED: u32 = u32::MAX;
const ITEM: (u16, u16) = (0xFFFE, 0xE000);
const ITEM_END: (u16, u16) = (0xFFFE, 0xE00D);
const SEQUENCE_END: (u16, u16) = (0xFFFE, 0xE0DD);

/// How elements are written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Syntax {
    pub explicit: bool,
    pub big_endian: bool,
}

/// Where the pixels lie.
#[derive(Debug)]
pub(super) struct PixelElement {
    /// 0x0008 float, 0x0009 double, 0x0010 integers
    pub element: u16,
    /// whether it is written as 16-bit words, whatever the pixels are
    pub words: bool,
    /// first byte of the element itself: all other elements lie before it
    pub begin: usize,
    /// one past its last byte
    pub end: usize,
    pub data: PixelBytes,
}

#[derive(Debug)]
pub(super) enum PixelBytes {
    Native(Range<usize>),
    /// the fragments after the offset table
    Fragments(Vec<Range<usize>>),
}

struct Element {
    tag: (u16, u16),
    sequence: bool,
    unknown: bool,
    words: bool,
    length: u32,
    /// first byte of the value
    value: usize,
}

/// Walks a data set and returns its pixels, if it has any.
pub(super) fn scan(bytes: &[u8], syntax: Syntax) -> Parsed<Option<PixelElement>> {
    let mut at = 0;
    while bytes.len() - at >= 8 {
        let begin = at;
        let element = header(bytes, at, syntax)?;
        if element.tag.0 == 0x7FE0 && matches!(element.tag.1, 0x0008..=0x0010) {
            let (data, end) = if element.length == UNDEFINED {
                let (fragments, end) = fragments(bytes, element.value, syntax)?;
                (PixelBytes::Fragments(fragments), end)
            } else {
                let range = value(bytes, &element, bytes.len())?;
                let end = range.end;
                (PixelBytes::Native(range), end)
            };
            return Ok(Some(PixelElement { element: element.tag.1, words: element.words, begin, end, data }));
        }
        at = walk(bytes, &element, bytes.len(), syntax, 0, &mut false)?;
    }
    Ok(None)
}

/// The data set without its elements that hold a sequence of unknown type (UN) and undefined length, or `None` when there is
/// none. `dicom-object` reads what such a sequence holds by other rules than the standard's, so a length in it that this
/// walk has checked is not the one that it would believe. No element that makes a volume is of that kind.
pub(super) fn without_unknown_sequences(bytes: &[u8], syntax: Syntax) -> Parsed<Option<Vec<u8>>> {
    let (mut at, mut kept, mut copied) = (0, Vec::new(), 0);
    while bytes.len() - at >= 8 {
        let element = header(bytes, at, syntax)?;
        if element.tag.0 == 0x7FE0 {
            break;
        }
        let mut found = false;
        let next = walk(bytes, &element, bytes.len(), syntax, 0, &mut found)?;
        if found {
            kept.extend_from_slice(&bytes[copied..at]);
            copied = next;
        }
        at = next;
    }
    if copied == 0 {
        return Ok(None);
    }
    kept.extend_from_slice(&bytes[copied..]);
    Ok(Some(kept))
}

fn u16_at(bytes: &[u8], at: usize, big: bool) -> Option<u16> {
    let b = bytes.get(at..at.checked_add(2)?)?.try_into().ok()?;
    Some(if big { u16::from_be_bytes(b) } else { u16::from_le_bytes(b) })
}

fn u32_at(bytes: &[u8], at: usize, big: bool) -> Option<u32> {
    let b = bytes.get(at..at.checked_add(4)?)?.try_into().ok()?;
    Some(if big { u32::from_be_bytes(b) } else { u32::from_le_bytes(b) })
}

fn header(bytes: &[u8], at: usize, syntax: Syntax) -> Parsed<Element> {
    let big = syntax.big_endian;
    let read = || {
        let tag = (u16_at(bytes, at, big)?, u16_at(bytes, at + 2, big)?);
        if tag.0 == 0xFFFE || !syntax.explicit {
            let length = u32_at(bytes, at + 4, big)?;
            return Some(Element { tag, sequence: false, unknown: false, words: true, length, value: at + 8 });
        }
        let vr = bytes.get(at + 4..at + 6)?;
        let short = matches!(
            vr,
            b"AE"
                | b"AS"
                | b"AT"
                | b"CS"
                | b"DA"
                | b"DS"
                | b"DT"
                | b"FD"
                | b"FL"
                | b"IS"
                | b"LO"
                | b"LT"
                | b"PN"
                | b"SH"
                | b"SL"
                | b"SS"
                | b"ST"
                | b"TM"
                | b"UI"
                | b"UL"
                | b"US"
        );
        let (length, value) = if short { (u16_at(bytes, at + 6, big)?.into(), at + 8) } else { (u32_at(bytes, at + 8, big)?, at + 12) };
        Some(Element { tag, sequence: vr == b"SQ", unknown: vr == b"UN", words: vr == b"OW", length, value })
    };
    read().ok_or_else(|| Fault::damaged("it ends within the header of an element"))
}

fn value(bytes: &[u8], element: &Element, end: usize) -> Parsed<Range<usize>> {
    let stop = element.value.checked_add(element.length as usize).filter(|&stop| stop <= end.min(bytes.len()));
    stop.map(|stop| element.value..stop).ok_or_else(|| {
        Fault::damaged(format!(
            "its element ({:04X},{:04X}) states {} bytes, {} are there",
            element.tag.0,
            element.tag.1,
            element.length,
            end.saturating_sub(element.value)
        ))
    })
}

/// Passes over an element and all within it; returns where the next begins. `unknown` becomes true where a sequence of unknown
/// type is met.
fn walk(bytes: &[u8], element: &Element, end: usize, syntax: Syntax, depth: usize, unknown: &mut bool) -> Parsed<usize> {
    if depth > DEPTH {
        return Err(Fault::damaged(format!("its sequences are nested more than {DEPTH} deep")));
    }
    if element.length != UNDEFINED && !element.sequence {
        return value(bytes, element, end).map(|v| v.end);
    }
    *unknown |= element.unknown;
    // An element of unknown type and undefined length is a sequence in implicit little endian. [PS3.5 6.2.2]
    let syntax = if element.unknown { Syntax { explicit: false, big_endian: false } } else { syntax };
    let sequence_end = if element.length == UNDEFINED { end } else { value(bytes, element, end)?.end };
    let mut at = element.value;
    loop {
        if at >= sequence_end && element.length != UNDEFINED {
            return Ok(sequence_end);
        }
        let item = header(bytes, at, syntax)?;
        match item.tag {
            SEQUENCE_END => return Ok(item.value),
            ITEM if item.length != UNDEFINED => {
                let within = value(bytes, &item, sequence_end)?;
                at = within.start;
                while at < within.end {
                    let inner = header(bytes, at, syntax)?;
                    at = walk(bytes, &inner, within.end, syntax, depth + 1, unknown)?;
                }
            }
            ITEM => {
                at = item.value;
                loop {
                    let inner = header(bytes, at, syntax)?;
                    if inner.tag == ITEM_END {
                        at = inner.value;
                        break;
                    }
                    at = walk(bytes, &inner, sequence_end, syntax, depth + 1, unknown)?;
                }
            }
            tag => return Err(Fault::damaged(format!("a sequence holds ({:04X},{:04X}) where an item belongs", tag.0, tag.1))),
        }
    }
}

fn fragments(bytes: &[u8], mut at: usize, syntax: Syntax) -> Parsed<(Vec<Range<usize>>, usize)> {
    let mut fragments = Vec::new();
    let mut first = true;
    loop {
        let item = header(bytes, at, syntax)?;
        match item.tag {
            SEQUENCE_END => return Ok((fragments, item.value)),
            ITEM => {
                let range = value(bytes, &item, bytes.len())?;
                at = range.end;
                // The first item is the table of offsets, often empty.
                if !std::mem::take(&mut first) {
                    fragments.push(range);
                }
            }
            tag => {
                return Err(Fault::damaged(format!("its compressed pixels hold ({:04X},{:04X}) where a fragment belongs", tag.0, tag.1)));
            }
        }
    }
}
