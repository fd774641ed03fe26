//! One frame of raw views → one binary message of as many JPEGs, made once for all pages.
//!
//! Cost: about 10 ns a pixel. A view whose pixels are those of the frame before keeps its JPEG: sections that stand still
//! cost a comparison.

use crate::protocol::{FRAME_HEADER_BYTES, FRAME_MAGIC};
use jpeg_encoder::{ColorType, Encoder};
use maille_contract::{FrameHeader, messages::VIEWS};
use std::sync::Arc;

/// A frame ready to be sent.
#[derive(Clone, Debug, PartialEq)]
pub struct Picture {
    /// number to be acknowledged, from 1
    pub number: u32,
    /// the message, laid out as [`crate::protocol`] says
    pub message: Arc<[u8]>,
}

/// Encodes frame after frame.
pub struct PictureEncoder {
    quality: u8,
    number: u32,
    views: [EncodedView; VIEWS.len()],
}

#[derive(Default)]
struct EncodedView {
    width: u16,
    height: u16,
    pixels: Vec<u8>,
    jpeg: Vec<u8>,
}

impl EncodedView {
    /// Brings the JPEG up to date with the pixels; an empty view, or one that the encoder refuses, has none.
    fn update(&mut self, width: u32, height: u32, pixels: &[u8], quality: u8) {
        let (width, height) = (width as u16, height as u16);
        if (self.width, self.height) == (width, height) && self.pixels == pixels {
            return;
        }
        (self.width, self.height) = (width, height);
        self.pixels.clear();
        self.pixels.extend_from_slice(pixels);
        self.jpeg.clear();
        if !pixels.is_empty() && Encoder::new(&mut self.jpeg, quality).encode(pixels, width, height, ColorType::Rgb).is_err() {
            self.jpeg.clear();
        }
    }
}

impl PictureEncoder {
    /// An encoder of a quality from 10 to 100.
    pub fn new(quality: u8) -> Self {
        Self { quality: quality.clamp(10, 100), number: 0, views: Default::default() }
    }

    /// The message of a frame, or `None` if the header does not fit its payload.
    pub fn encode(&mut self, header: &FrameHeader, payload: &[u8]) -> Option<Picture> {
        let header = header.checked(payload.len())?;
        for (encoded, rect) in self.views.iter_mut().zip(&header.views) {
            let first = rect.offset as usize;
            let len = rect.width as usize * rect.height as usize * 3;
            encoded.update(rect.width, rect.height, payload.get(first..first + len)?, self.quality);
        }
        self.number = self.number.wrapping_add(1).max(1);
        let mut message = Vec::with_capacity(FRAME_HEADER_BYTES + self.views.iter().map(|v| v.jpeg.len()).sum::<usize>());
        message.extend_from_slice(&FRAME_MAGIC.to_le_bytes());
        message.extend_from_slice(&self.number.to_le_bytes());
        message.extend_from_slice(&(header.stamp.time_ns as f64 * 1e-9).to_le_bytes());
        message.extend_from_slice(&(header.epoch as f64).to_le_bytes());
        message.extend_from_slice(&(header.view_sequence as f64).to_le_bytes());
        message.extend_from_slice(&(header.render_ns as f32 * 1e-6).to_le_bytes());
        message.extend_from_slice(&(self.views.len() as u32).to_le_bytes());
        for view in &self.views {
            message.extend_from_slice(&view.width.to_le_bytes());
            message.extend_from_slice(&view.height.to_le_bytes());
            message.extend_from_slice(&(view.jpeg.len() as u32).to_le_bytes());
        }
        for view in &self.views {
            message.extend_from_slice(&view.jpeg);
        }
        Some(Picture { number: self.number, message: message.into() })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use maille_contract::{Stamp, messages::ViewRect};

    fn frame() -> (FrameHeader, Vec<u8>) {
        let rect = |offset, width, height| ViewRect { offset, width, height };
        let views = [rect(0, 32, 24), rect(2304, 16, 8), rect(2688, 16, 8), rect(0, 0, 0), rect(0, 0, 0), rect(0, 0, 0)];
        let stamp = Stamp { time_ns: 2_500_000_000, sequence: 7, incarnation: 1 };
        (
            FrameHeader { stamp, epoch: 5, view_sequence: 3, render_ns: 4_000_000, shown_ns: 0, views },
            (0..3072u32).map(|i| (i % 251) as u8).collect(),
        )
    }

    #[test]
    fn the_message_is_laid_out_as_documented() {
        let (header, payload) = frame();
        let picture = PictureEncoder::new(85).encode(&header, &payload).unwrap();
        let m = &picture.message;
        assert_eq!(&m[..4], b"MLF3");
        assert_eq!(u32::from_le_bytes(m[4..8].try_into().unwrap()), picture.number);
        assert_eq!(f64::from_le_bytes(m[8..16].try_into().unwrap()), 2.5);
        assert_eq!(f64::from_le_bytes(m[16..24].try_into().unwrap()), 5.0);
        assert_eq!(f64::from_le_bytes(m[24..32].try_into().unwrap()), 3.0);
        assert_eq!(f32::from_le_bytes(m[32..36].try_into().unwrap()), 4.0);
        let mut at = FRAME_HEADER_BYTES;
        for v in 0..VIEWS.len() {
            let row = &m[40 + 8 * v..48 + 8 * v];
            let len = u32::from_le_bytes(row[4..].try_into().unwrap()) as usize;
            assert_eq!(u16::from_le_bytes(row[..2].try_into().unwrap()) as u32, header.views[v].width);
            if header.views[v].width > 0 {
                assert_eq!((&m[at..at + 2], &m[at + len - 2..at + len]), (&[0xFF, 0xD8][..], &[0xFF, 0xD9][..]), "view {v} is no JPEG");
            } else {
                assert_eq!(len, 0);
            }
            at += len;
        }
        assert_eq!(at, m.len());
    }

    #[test]
    fn a_view_that_stands_still_keeps_its_bytes_and_a_changed_one_does_not() {
        let (header, mut payload) = frame();
        let mut encoder = PictureEncoder::new(85);
        let first = encoder.encode(&header, &payload).unwrap();
        let same = encoder.encode(&header, &payload).unwrap();
        assert_eq!(first.message[8..], same.message[8..]);
        assert_eq!(same.number, first.number + 1);
        payload[..600].fill(255);
        assert_ne!(encoder.encode(&header, &payload).unwrap().message[8..], first.message[8..]);
    }

    #[test]
    fn a_header_that_lies_about_its_payload_is_refused() {
        let (header, payload) = frame();
        assert!(PictureEncoder::new(85).encode(&header, &payload[..2000]).is_none());
    }
}
