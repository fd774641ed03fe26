//! Borders that the tip has crossed, and how far the layer at each is cut.
//!
//! A layer at the entry of a tissue ([`crate::Capsule`]) is cut once. A tip that goes back inside it, or out of the tissue and in again by the same hole, as
//! a breath does with a hand at rest, finds it as far cut as it was: on the way that is cut already the tip takes only what the tissue itself takes, at
//! the end of that way the layer's own force for what is left. A hole is what lies within [`HOLE_MM`] of the place of crossing.
//!
//! Units: mm, N; frame: reference. The oldest is forgotten where there is no room. Cost: constant. Allocation: none.

use crate::limits::MAX_BORDERS;
use crate::{Material, V3};

/// A tip that went back out of a tissue and comes within this of where it had come in goes by the same hole [mm]: the thickest needle's width.
const HOLE_MM: f64 = 2.0;

/// A crossing into a tissue.
#[derive(Clone, Copy, Debug)]
struct Border {
    material: u8,
    at: V3,
    /// length of the path there [mm]
    depth_mm: f64,
    /// the tip has gone back out
    left: bool,
    /// its layer: force and thickness [N, mm]
    layer: Option<(f64, f64)>,
    /// how far the layer is cut [mm]
    cut_mm: f64,
    /// nothing of it is left: the tissue was punctured
    through: bool,
}

/// The borders, and the one that the tip is behind.
#[derive(Clone, Debug, Default)]
pub(super) struct Borders {
    of: [Option<Border>; MAX_BORDERS],
    next: usize,
    here: Option<usize>,
    /// how far the tip is behind that border [mm]
    behind_mm: f64,
}

/// What holds a tip beside its tissue.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Standing {
    /// nothing
    Free,
    /// nothing for so far [mm]: what lies before it is cut, then a layer stands
    Cut(f64),
    /// a layer of this force and so much of its thickness left [N, mm]
    Layer(f64, f64),
}

impl Borders {
    pub fn clear(&mut self) {
        *self = Self::default();
    }

    /// The tip is at a border, on the side of a tissue of this kind. True where it was through there before.
    pub fn enter(&mut self, index: u8, material: &Material, at: V3, depth_mm: f64) -> bool {
        self.behind_mm = 0.0;
        let same = |b: &Border| b.left && b.material == index && (b.at - at).norm() < HOLE_MM;
        let known = self.of.iter().position(|b| b.as_ref().is_some_and(same));
        let slot = known.unwrap_or(self.next);
        if known.is_none() {
            let layer = material.capsule.map(|c| (c.cutting_force_n, c.thickness_mm));
            // what cannot be cut is never gone through
            let through = layer.is_none() && material.cutting_force_n < f64::INFINITY;
            self.of[slot] = Some(Border { material: index, at, depth_mm, left: false, layer, cut_mm: 0.0, through });
            self.next = (slot + 1) % MAX_BORDERS;
        }
        self.here = Some(slot);
        let Some(border) = &mut self.of[slot] else { return false };
        border.left = false;
        known.is_some() && border.through
    }

    /// The tip went back over a border: all that it crossed beyond this length of path it has left.
    pub fn leave(&mut self, depth_mm: f64) {
        (self.here, self.behind_mm) = (None, 0.0);
        self.of.iter_mut().flatten().filter(|b| b.depth_mm > depth_mm).for_each(|b| b.left = true);
    }

    /// What holds the tip.
    pub fn standing(&self) -> Standing {
        let Some(border) = self.here.and_then(|slot| self.of[slot]).filter(|b| !b.through) else { return Standing::Free };
        let Some((force, thickness)) = border.layer else { return Standing::Free };
        if self.behind_mm < border.cut_mm {
            return Standing::Cut(border.cut_mm - self.behind_mm);
        }
        Standing::Layer(force, (thickness - border.cut_mm).max(0.0))
    }

    /// The tip went on by this, or back. True where that was the last of a layer.
    pub fn went(&mut self, by_mm: f64) -> bool {
        self.behind_mm = (self.behind_mm + by_mm).max(0.0);
        let Some(border) = self.here.and_then(|slot| self.of[slot].as_mut()).filter(|b| !b.through) else { return false };
        if self.behind_mm > border.cut_mm - 1e-9 {
            // so that a way that is cut comes to its end
            border.cut_mm = border.cut_mm.max(self.behind_mm);
            self.behind_mm = border.cut_mm;
        }
        let Some((_, thickness)) = border.layer else { return false };
        border.through = border.cut_mm > 0.0 && border.cut_mm >= thickness - 1e-9;
        border.through
    }

    /// A layer without thickness gives way.
    pub fn give_way(&mut self) {
        if let Some(border) = self.here.and_then(|slot| self.of[slot].as_mut()) {
            border.through = true;
        }
    }
}
