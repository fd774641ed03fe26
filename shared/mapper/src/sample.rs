//! Trilinear rest values in stored units.

use maille_volume::{
    Brick, BrickId, BrickSource,
    brick::{EDGE, ROW, SLICE},
};

/// Samples the rest volume at positions relative to one element; remembers the last brick.
pub struct RestSampler<'a, S: BrickSource + ?Sized> {
    rest: &'a S,
    /// the element at position 0
    low: [usize; 3],
    /// positions inside the grid; a hundredth of a voxel is rounding
    inside: [[f32; 2]; 3],
    /// last position that has a brick
    last: [f32; 3],
    brick: (BrickId, &'a Brick),
}

impl<'a, S: BrickSource + ?Sized> RestSampler<'a, S> {
    /// Positions count from the element `low` and end, for a brick to be found, at the element `low + size − 1`.
    pub fn new(rest: &'a S, low: [usize; 3], size: [usize; 3]) -> Self {
        let volume = rest.layout().size;
        let inside = std::array::from_fn(|c| [-(low[c] as f32) - 0.01, (volume[c] - 1 - low[c]) as f32 + 0.01]);
        let last = std::array::from_fn(|c| (size[c] - 1).min(volume[c] - 1 - low[c]) as f32);
        let id = rest.layout().brick_of(low[0], low[1], low[2]);
        Self { rest, low, inside, last, brick: (id, rest.brick(id)) }
    }

    /// The eight voxels around a position, and where in their cell it lies; `None` outside the grid.
    #[inline(always)]
    fn cell(&mut self, position: [f32; 3]) -> Option<([i16; 8], [f32; 3])> {
        let (mut at, mut f) = ([0usize; 3], [0.0f32; 3]);
        for c in 0..3 {
            let p = position[c];
            if !(p >= self.inside[c][0] && p <= self.inside[c][1]) {
                return None;
            }
            let p = if p > 0.0 { if p < self.last[c] { p } else { self.last[c] } } else { 0.0 };
            // not below 0, and small: i32 converts in one instruction
            let whole = p as i32;
            at[c] = self.low[c] + whole as usize;
            f[c] = p - whole as f32;
        }
        let id = self.rest.layout().brick_of(at[0], at[1], at[2]);
        if id != self.brick.0 {
            self.brick = (id, self.rest.brick(id));
        }
        // the apron holds a cell's upper corners, and repeats the last voxel beyond the border
        let from = Brick::offset((at[0] % EDGE) as isize, (at[1] % EDGE) as isize, (at[2] % EDGE) as isize);
        let v: &[i16; SLICE + ROW + 2] = self.brick.1.voxels[from..].first_chunk()?;
        Some(([v[0], v[1], v[ROW], v[ROW + 1], v[SLICE], v[SLICE + 1], v[SLICE + ROW], v[SLICE + ROW + 1]], f))
    }

    /// Trilinear value, rounded; `None` outside the grid.
    #[inline(always)]
    pub fn stored(&mut self, position: [f32; 3]) -> Option<i16> {
        let (v, f) = self.cell(position)?;
        let v = v.map(f32::from);
        let lerp = |a: f32, b: f32, t: f32| a + (b - a) * t;
        let (a, b) = (lerp(v[0], v[1], f[0]), lerp(v[2], v[3], f[0]));
        let (c, d) = (lerp(v[4], v[5], f[0]), lerp(v[6], v[7], f[0]));
        let value = lerp(lerp(a, b, f[1]), lerp(c, d, f[1]), f[2]);
        // a trilinear value lies between its corners, so that it fits an i16; the bias makes truncation round half up
        Some(((value + 32_768.5) as i32 - 32_768) as i16)
    }

    /// Whether the cell around a position holds any tissue at its corners.
    pub fn is_tissue_cell(&mut self, position: [f32; 3], threshold_hu: f64) -> bool {
        let rescale = self.rest.info().rescale;
        self.cell(position).is_some_and(|(v, _)| v.iter().any(|&v| rescale.value(f64::from(v)) >= threshold_hu))
    }
}
