//! The torso.

use crate::{
    Landmarks,
    label::Label,
    part::{Part, Parts},
    shape::{ball, v},
};

/// Extent, parts and landmarks of the torso.
pub(crate) fn build(_seed: u64) -> ([f64; 3], Vec<Part>, Landmarks) {
    let mut parts = Parts::default();
    parts.add(Label::Skin, [-100.0; 3], [100.0; 3], 1.0, |at| ball(&at.p, v(0.0, 0.0, 0.0), 100.0));
    let landmarks = Landmarks { lesion: Some(([-60.0, 0.0, 0.0], 12.0)), skin_entry: [-180.0, 0.0, 0.0], ..Default::default() };
    ([360.0, 260.0, 360.0], parts.0, landmarks)
}
