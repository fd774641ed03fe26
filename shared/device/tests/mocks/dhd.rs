//! A stand-in for libdhd: one device. Built as a shared object by `tests/libraries.rs`.
#![allow(non_snake_case, clippy::missing_safety_doc)]

use std::ffi::{c_char, c_double, c_int, c_uchar, c_uint};
use std::sync::Mutex;

struct State { plugged: bool, open: bool, enabled: bool, wrench: [f64; 6], watchdog: u8, position: [f64; 3], largest: f64, steepest: f64 }
static STATE: Mutex<State> = Mutex::new(State { plugged: true, open: false, enabled: false, wrench: [0.0; 6], watchdog: 0, position: [0.01, 0.02, 0.03], largest: 0.0, steepest: 0.0 });

fn there() -> c_int { let s = STATE.lock().unwrap(); if s.plugged && s.open { 0 } else { -1 } }

#[unsafe(no_mangle)] pub extern "C" fn dhdGetDeviceCount() -> c_int { c_int::from(STATE.lock().unwrap().plugged) }
#[unsafe(no_mangle)] pub extern "C" fn dhdOpenID(index: c_char) -> c_int {
    let mut s = STATE.lock().unwrap();
    if s.plugged && index == 0 { s.open = true; 3 } else { -1 }
}
#[unsafe(no_mangle)] pub extern "C" fn dhdClose(_id: c_char) -> c_int { STATE.lock().unwrap().open = false; 0 }
#[unsafe(no_mangle)] pub unsafe extern "C" fn dhdGetPosition(x: *mut c_double, y: *mut c_double, z: *mut c_double, id: c_char) -> c_int {
    let p = STATE.lock().unwrap().position;
    // SAFETY: the caller gives three places for a double, as libdhd asks.
    unsafe { (*x, *y, *z) = (p[0], p[1], p[2]) };
    if id == 3 { there() } else { -1 }
}
#[unsafe(no_mangle)] pub unsafe extern "C" fn dhdGetLinearVelocity(x: *mut c_double, y: *mut c_double, z: *mut c_double, _id: c_char) -> c_int {
    // SAFETY: the caller gives three places for a double, as libdhd asks.
    unsafe { (*x, *y, *z) = (0.1, 0.2, 0.3) };
    there()
}
#[unsafe(no_mangle)] pub unsafe extern "C" fn dhdGetOrientationFrame(frame: *mut [c_double; 3], _id: c_char) -> c_int {
    // a quarter turn about z, row by row
    let turn = [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]];
    // SAFETY: the caller gives place for nine doubles, three rows of three, as libdhd asks.
    unsafe { std::ptr::copy_nonoverlapping(turn.as_ptr(), frame, 3) };
    there()
}
#[unsafe(no_mangle)] pub extern "C" fn dhdSetForceAndTorqueAndGripperForce(fx: c_double, fy: c_double, fz: c_double, tx: c_double, ty: c_double, tz: c_double, _g: c_double, _id: c_char) -> c_int {
    {
        let mut s = STATE.lock().unwrap();
        let norm = |v: [f64; 3]| v.iter().map(|c| c * c).sum::<f64>().sqrt();
        let [x, y, z, ..] = s.wrench;
        s.steepest = s.steepest.max(norm([fx - x, fy - y, fz - z]));
        s.largest = s.largest.max(norm([fx, fy, fz]));
        s.wrench = [fx, fy, fz, tx, ty, tz];
    }
    there()
}
#[unsafe(no_mangle)] pub extern "C" fn dhdEnableForce(on: c_uchar, _id: c_char) -> c_int { STATE.lock().unwrap().enabled = on == 1; there() }
#[unsafe(no_mangle)] pub extern "C" fn dhdSetWatchdog(duration: c_uchar, _id: c_char) -> c_int { STATE.lock().unwrap().watchdog = duration; 0 }
#[unsafe(no_mangle)] pub extern "C" fn dhdGetButtonMask(_id: c_char) -> c_uint { 2 }
#[unsafe(no_mangle)] pub extern "C" fn dhdErrorGetLastStr() -> *const c_char { c"no device".as_ptr() }
// for the test
#[unsafe(no_mangle)] pub extern "C" fn mock_plug(on: c_int) { STATE.lock().unwrap().plugged = on != 0; }
#[unsafe(no_mangle)] pub unsafe extern "C" fn mock_force(to: *mut c_double) {
    let wrench = STATE.lock().unwrap().wrench;
    // SAFETY: the test gives place for three doubles.
    unsafe { std::ptr::copy_nonoverlapping(wrench.as_ptr(), to, 3) };
}
#[unsafe(no_mangle)] pub unsafe extern "C" fn mock_torque(to: *mut c_double) {
    // in N·mm, as libHD's is
    let torque = STATE.lock().unwrap().wrench.map(|w| w * 1e3);
    // SAFETY: the test gives place for three doubles.
    unsafe { std::ptr::copy_nonoverlapping(torque.as_ptr().add(3), to, 3) };
}
#[unsafe(no_mangle)] pub unsafe extern "C" fn mock_steps(to: *mut c_double) {
    let s = STATE.lock().unwrap();
    // SAFETY: the test gives place for three doubles.
    unsafe { std::ptr::copy_nonoverlapping([s.largest, s.steepest, 0.0].as_ptr(), to, 3) };
}
#[unsafe(no_mangle)] pub extern "C" fn mock_clear_steps(_: c_int) { let mut s = STATE.lock().unwrap(); (s.largest, s.steepest) = (0.0, 0.0); }
#[unsafe(no_mangle)] pub extern "C" fn mock_watchdog() -> c_int { STATE.lock().unwrap().watchdog.into() }
#[unsafe(no_mangle)] pub extern "C" fn mock_open() -> c_int { c_int::from(STATE.lock().unwrap().open) }
#[unsafe(no_mangle)]
pub extern "C" fn mock_move(x: c_double, y: c_double, z: c_double) {
    STATE.lock().unwrap().position = [x, y, z];
}
