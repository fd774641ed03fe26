//! The neurosurgery scene on a real head with an open skull window.

#[path = "neurosurgery/operate.rs"]
mod operate;

use maille_testkit::real_data;
use operate::{operate, scene};

#[test]
fn brain_is_reached_through_the_open_window_of_a_real_skull_without_touching_bone() {
    let Some(head) = real_data("ct_head_invesalius/cranium_lps.nrrd") else { return };
    let taken = operate("neurosurgery-real", &scene(160, 5.0), &["--volume", head.to_str().unwrap()], false);
    let share = |low: f64, high: f64| taken.iter().filter(|(_, hu)| (low..high).contains(hu)).count() as f64 / taken.len() as f64;
    let (scalp, brain, bone) = (share(46.0, 250.0), share(-30.0, 46.0), share(250.0, f64::INFINITY));
    println!("of what was taken away {:.0} % scalp, {:.0} % brain, {:.1} % bone", 100.0 * scalp, 100.0 * brain, 100.0 * bone);
    assert!(scalp > 0.1 && brain > 0.2 && bone < 0.05, "{scalp} {brain} {bone}");
}
