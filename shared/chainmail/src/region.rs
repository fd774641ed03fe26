//! What a push changed, brick by brick and row by row, so that nothing has to be searched for afterwards.

use crate::brick::ELEMENTS;
use maille_volume::{BrickId, BrickLayout, brick::EDGE};

/// Rows (runs along i) of a brick.
pub const ROWS: usize = ELEMENTS / EDGE;

/// The changed elements of one brick, as one span a row.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ChangedBrick {
    /// which brick
    pub id: BrickId,
    /// for row j + EDGE·k of the brick the half-open range of i that holds all its changed elements; empty: `[0, 0]`
    pub spans: Box<[[u8; 2]; ROWS]>,
}

/// The changed elements of a volume, in ascending order of bricks.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct ChangedRegion {
    /// bricks with at least one changed element, ascending
    pub bricks: Vec<ChangedBrick>,
}

impl ChangedBrick {
    /// A brick without changes.
    pub fn new(id: BrickId) -> Self {
        Self { id, spans: Box::new([[0; 2]; ROWS]) }
    }

    /// Extends a row's span by `low..high`.
    #[inline]
    pub fn extend(&mut self, row: usize, low: usize, high: usize) {
        let span = &mut self.spans[row];
        *span = if span[1] == 0 { [low as u8, high as u8] } else { [span[0].min(low as u8), span[1].max(high as u8)] };
    }

    /// Whether no element changed.
    pub fn is_empty(&self) -> bool {
        self.spans.iter().all(|s| s[1] == 0)
    }
}

impl ChangedRegion {
    /// Whether nothing changed.
    pub fn is_empty(&self) -> bool {
        self.bricks.is_empty()
    }

    /// Bricks with a changed element, ascending.
    pub fn ids(&self) -> impl Iterator<Item = BrickId> + '_ {
        self.bricks.iter().map(|b| b.id)
    }

    /// Adds what another push changed.
    pub fn merge(&mut self, other: &Self) {
        for brick in &other.bricks {
            match self.bricks.binary_search_by_key(&brick.id, |b| b.id) {
                Ok(at) => {
                    for (row, span) in brick.spans.iter().enumerate().filter(|(_, s)| s[1] > 0) {
                        self.bricks[at].extend(row, span[0] as usize, span[1] as usize);
                    }
                }
                Err(at) => self.bricks.insert(at, brick.clone()),
            }
        }
    }

    /// Smallest box of voxels (inclusive) around all spans; `None` when nothing changed.
    pub fn bounds(&self, layout: &BrickLayout) -> Option<([usize; 3], [usize; 3])> {
        let mut bounds: Option<([usize; 3], [usize; 3])> = None;
        for brick in &self.bricks {
            let first = layout.first_voxel(brick.id);
            for (row, span) in brick.spans.iter().enumerate().filter(|(_, s)| s[1] > 0) {
                let low = [first[0] + span[0] as usize, first[1] + row % EDGE, first[2] + row / EDGE];
                let high = [first[0] + span[1] as usize - 1, low[1], low[2]];
                let (l, h) = bounds.get_or_insert((low, high));
                for c in 0..3 {
                    l[c] = l[c].min(low[c]);
                    h[c] = h[c].max(high[c]);
                }
            }
        }
        bounds
    }
}
