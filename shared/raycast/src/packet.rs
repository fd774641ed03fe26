//! Eight rays at a time with AVX2 (being built).
use crate::{
    frame::Frame,
    scalar::{Caster, Seen},
    skip::Skip,
};
use maille_volume::BrickSource;

/// Whether this processor has what the kernel needs.
pub fn available() -> bool {
    false
}

/// Casts the rays of a tile.
pub fn cast_tile<S: BrickSource + ?Sized>(
    frame: &Frame,
    source: &S,
    skip: &Skip,
    first: [usize; 2],
    size: [usize; 2],
    mut put: impl FnMut(usize, usize, Seen),
) {
    let caster = Caster { frame, source, skip: Some(skip) };
    for y in first[1]..first[1] + size[1] {
        for x in first[0]..first[0] + size[0] {
            put(x, y, caster.cast(x, y));
        }
    }
}
