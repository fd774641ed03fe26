//! What a packet of rays saw, lane by lane, and what becomes of it before it is pixels.

use crate::{lanes::MOST, scalar::Seen};

/// What a packet saw.
pub struct Packet {
    pub(super) color: [[f32; MOST]; 3],
    pub(super) transmittance: [f32; MOST],
    pub(super) depth: [f32; MOST],
}

impl Packet {
    #[inline]
    pub fn lane(&self, n: usize) -> Seen {
        Seen { color: [self.color[0][n], self.color[1][n], self.color[2][n]], transmittance: self.transmittance[n], depth: self.depth[n] }
    }

    /// Red, green and blue bytes of all lanes before what is behind them.
    #[inline]
    pub fn bytes(&self, behind: [f32; 3]) -> [[u8; MOST]; 3] {
        std::array::from_fn(|c| {
            std::array::from_fn(|n| {
                let v = self.color[c][n] + self.transmittance[n] * behind[c];
                (v * 255.0 + 0.5).clamp(0.0, 255.0) as u8
            })
        })
    }

    /// What is left behind an opaque ray is taken to look like what was seen.
    pub(super) fn saturate(&mut self, opaque: f32) {
        for n in 0..MOST {
            if self.transmittance[n] < opaque {
                let whole = 1.0 / (1.0 - self.transmittance[n]);
                self.color.iter_mut().for_each(|c| c[n] *= whole);
                self.transmittance[n] = 0.0;
            }
        }
    }

    /// Dense bright.
    pub(super) fn transmit(&mut self, attenuation: &[f32; MOST]) {
        for n in 0..MOST {
            self.transmittance[n] = (-attenuation[n]).exp();
            self.color.iter_mut().for_each(|c| c[n] = 1.0 - self.transmittance[n]);
        }
    }
}
