//! The neurosurgery scene on the made head, with the deformation process killed in the middle of the cut.

#[path = "neurosurgery/operate.rs"]
mod operate;

use operate::{operate, scene};

#[test]
fn an_incision_into_the_made_head_is_felt_and_seen_survives_a_kill_and_is_taken_back_bit_for_bit() {
    let taken = operate("neurosurgery-made", &scene(160, 5.0), &[], true);
    assert!(taken.iter().any(|(_, hu)| *hu > 400.0), "through bone");
}
