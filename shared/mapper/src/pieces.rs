//! Tissue beside voids and cuts: which corners of a cell hang together, and how their map goes on to the others.
//!
//! Inside tissue a cell is one piece, and its map is trilinear in its eight corners. Where a corner is void or an edge is cut the
//! corners fall into pieces, joined along the edges that are left. A piece's map goes on to foreign corners with the mean displacement
//! of its own nearest ones: with one corner it is a translation, and on a face that holds only its own corners it is what the
//! neighbouring cell says, so that tissue has no seam. A piece owns the part of a cell that lies nearest to its
//! corners: half of a link reaches from each side of a cut, and all of it into a void, so that a surface keeps its partial
//! volume when it moves. A removed element's part belongs to nobody. What no piece's image holds is a gap.

use crate::{rows::Box3, window::Window};
use maille_chainmail::{CUT, ChainMail, DisplacementBrick};
use maille_volume::{BrickSource, brick::EDGE};

/// Tissue, beside the bits of cut links (`maille_chainmail::CUT`).
const TISSUE: u8 = 8;
/// Taken out: a void that no piece reaches into, since what is seen there at rest is gone.
const REMOVED: u8 = 16;

/// All three links of an element.
const ALL_CUT: u8 = CUT[0] | CUT[1] | CUT[2];

/// Corners of a cell that hang together.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Piece {
    /// bit n: corner n is the piece's own tissue
    pub own: u8,
    /// bit n: what lies nearest to corner n goes with the piece
    pub territory: u8,
}

/// The whole cell.
const WHOLE: Piece = Piece { own: 0xff, territory: 0xff };

/// Tissue and cuts in the box of a window.
#[derive(Default)]
pub struct Pieces {
    size: [usize; 3],
    flags: Vec<u8>,
}

impl Pieces {
    /// Reads the elements that a window holds.
    pub fn gather<S: BrickSource + ?Sized>(&mut self, rest: &S, mail: &ChainMail, window: &Window) {
        let (layout, rescale, low) = (*rest.layout(), rest.info().rescale, window.low());
        let threshold = mail.tissue().threshold_hu;
        self.size = window.size();
        let [nx, ny, nz] = self.size;
        self.flags.clear();
        for k in 0..nz {
            for j in 0..ny {
                // a window is never smaller than a cell, a volume may be
                let (y, z) = ((low[1] + j).min(layout.size[1] - 1), (low[2] + k).min(layout.size[2] - 1));
                for i in 0..nx {
                    let x = (low[0] + i).min(layout.size[0] - 1);
                    let n = DisplacementBrick::offset(x % EDGE, y % EDGE, z % EDGE);
                    let cut = mail.cut_brick(layout.brick_of(x, y, z)).map_or(0, |cuts| cuts[n] & ALL_CUT);
                    let tissue = threshold.is_none_or(|t| rescale.value(f64::from(rest.voxel(x, y, z))) >= t);
                    let kind = if cut == ALL_CUT && mail.is_removed([x, y, z]) {
                        REMOVED
                    } else if tissue {
                        TISSUE
                    } else {
                        0
                    };
                    self.flags.push(cut | kind);
                }
            }
        }
    }

    /// Tissue all through: nothing to read.
    pub fn all_tissue(&mut self, window: &Window) {
        self.size = window.size();
        self.flags.clear();
    }

    /// Whether an element is tissue.
    pub fn is_tissue(&self, at: [usize; 3]) -> bool {
        self.flags.is_empty() || self.at(at) & TISSUE != 0
    }

    /// Whether an element was taken out.
    pub fn is_removed(&self, at: [usize; 3]) -> bool {
        !self.flags.is_empty() && self.at(at) & REMOVED != 0
    }

    fn at(&self, [i, j, k]: [usize; 3]) -> u8 {
        self.flags[(k * self.size[1] + j) * self.size[0] + i]
    }

    fn corners(&self, base: [usize; 3]) -> [u8; 8] {
        std::array::from_fn(|n| self.at([base[0] + (n & 1), base[1] + (n >> 1 & 1), base[2] + (n >> 2)]))
    }

    /// Whether the cell around a position, relative to the window, is tissue all through.
    pub fn is_whole(&self, position: [f32; 3]) -> bool {
        if self.flags.is_empty() {
            return true;
        }
        // a position on the last plane lies in the last cell, as it does for the kernel
        let base = std::array::from_fn(|c| (position[c].max(0.0) as usize).min(self.size[c] - 2));
        is_whole(&self.corners(base))
    }

    /// Whether a voxel or one of its 26 neighbours is tissue.
    pub fn is_near_tissue(&self, at: [usize; 3]) -> bool {
        let range = |c: usize| at[c].saturating_sub(1)..(at[c] + 2).min(self.size[c]);
        range(2).any(|k| range(1).any(|j| range(0).any(|i| self.at([i, j, k]) & TISSUE != 0)))
    }

    /// The pieces of the cell with this lower corner, in `out`; their number.
    pub fn of_cell(&self, base: [usize; 3], out: &mut [Piece; 8]) -> usize {
        if !self.flags.is_empty() {
            let corners = self.corners(base);
            if !is_whole(&corners) {
                return split(&corners, out);
            }
        }
        out[0] = WHOLE;
        1
    }
}

fn is_whole(corners: &[u8; 8]) -> bool {
    let joined = |n: usize| (0..3).all(|c| n >> c & 1 == 1 || corners[n] >> c & 1 == 0);
    (0..8).all(|n| corners[n] & TISSUE != 0 && joined(n))
}

fn split(corners: &[u8; 8], out: &mut [Piece; 8]) -> usize {
    let tissue = |n: usize| corners[n] & TISSUE != 0;
    let (mut seen, mut count) = (0u8, 0);
    for start in 0..8 {
        if !tissue(start) || seen >> start & 1 == 1 {
            continue;
        }
        let mut own = 1u8 << start;
        loop {
            let mut grown = own;
            for n in (0..8).filter(|n| own >> n & 1 == 1) {
                for c in 0..3 {
                    let m = n ^ 1 << c;
                    // the link belongs to its lower end
                    if tissue(m) && corners[n.min(m)] >> c & 1 == 0 {
                        grown |= 1 << m;
                    }
                }
            }
            if grown == own {
                break;
            }
            own = grown;
        }
        seen |= own;
        out[count] = Piece { own, territory: own };
        count += 1;
    }
    // a void corner goes with the nearest piece, the first of several
    for n in (0..8).filter(|&n| corners[n] & (TISSUE | REMOVED) == 0) {
        if let Some(nearest) = (0..count).min_by_key(|&p| steps(out[p].own, n)) {
            out[nearest].territory |= 1 << n;
        }
    }
    count
}

/// Edges from a corner to the nearest of a set.
fn steps(set: u8, n: usize) -> u32 {
    (0..8usize).filter(|m| set >> m & 1 == 1).map(|m| (m ^ n).count_ones()).min().unwrap_or(4)
}

impl Piece {
    /// Displacements of a cell's corners as this piece has them.
    pub fn extend(&self, corners: &mut [[f32; 3]; 8]) {
        if self.own == 0xff {
            return;
        }
        let known = *corners;
        for n in (0..8).filter(|n| self.own >> n & 1 == 0) {
            let nearest = steps(self.own, n);
            let (mut sum, mut count) = ([0.0f32; 3], 0.0);
            for m in (0..8usize).filter(|m| self.own >> m & 1 == 1 && (m ^ n).count_ones() == nearest) {
                (0..3).for_each(|c| sum[c] += known[m][c]);
                count += 1.0;
            }
            corners[n] = sum.map(|v| v / count);
        }
    }

    /// Whether the point at fractions `f` of the cell is this piece's, and whether it lies nearest to its tissue.
    pub fn holds(&self, f: [f32; 3]) -> Option<bool> {
        if self.own == 0xff {
            return Some(true);
        }
        // points on the border are held from both sides, so that nothing falls between
        let border = 1e-3;
        let near = |n: usize| (0..3).all(|c| if n >> c & 1 == 1 { f[c] >= 0.5 - border } else { f[c] <= 0.5 + border });
        let of = |set: u8| (0..8).any(|n| set >> n & 1 == 1 && near(n));
        of(self.territory).then(|| of(self.own))
    }
}

/// Box of cells of a window.
pub fn cells(window: &Window) -> Box3 {
    Box3 { low: [0; 3], high: window.size().map(|s| s - 2) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_cut_plane_makes_two_halves_and_a_void_corner_goes_with_its_neighbours() {
        // links along i cut: even and odd corners
        let cut = [TISSUE | 1; 8];
        let mut out = [WHOLE; 8];
        assert_eq!(split(&cut, &mut out), 2);
        assert_eq!([out[0].own, out[1].own], [0b0101_0101, 0b1010_1010]);
        assert_eq!(out[0].holds([0.4, 0.9, 0.1]), Some(true));
        assert_eq!(out[0].holds([0.6, 0.9, 0.1]), None);
        // one cut link alone leaves one piece: the way round is open
        let mut one = [TISSUE; 8];
        one[0] |= 1;
        assert_eq!(split(&one, &mut out), 1);
        assert_eq!(out[0].own, 0xff);
        // tissue below, void above: everything goes with the tissue
        let surface = std::array::from_fn(|n| if n < 4 { TISSUE } else { 0 });
        assert_eq!(split(&surface, &mut out), 1);
        assert_eq!((out[0].own, out[0].territory), (0x0f, 0xff));
        assert_eq!(out[0].holds([0.2, 0.2, 0.9]), Some(false));
        // the same with the upper half taken out: nothing reaches there
        let opened = std::array::from_fn(|n| if n < 4 { TISSUE } else { REMOVED });
        assert_eq!(split(&opened, &mut out), 1);
        assert_eq!((out[0].holds([0.2, 0.2, 0.9]), out[0].holds([0.2, 0.2, 0.4])), (None, Some(true)));
    }

    #[test]
    fn a_piece_goes_on_as_it_is_on_its_own_face() {
        let piece = Piece { own: 0b0101_0101, territory: 0b0101_0101 };
        let mut corners: [[f32; 3]; 8] = std::array::from_fn(|n| [n as f32, 0.0, 0.5]);
        piece.extend(&mut corners);
        for n in (0..8).step_by(2) {
            assert_eq!(corners[n + 1], corners[n]);
        }
    }
}
