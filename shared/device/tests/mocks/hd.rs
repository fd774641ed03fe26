//! A stand-in for libHD: one device that is a mass in the mind of the test. Built as a shared object by `tests/libraries.rs`.
#![allow(non_snake_case, clippy::missing_safety_doc)]

use std::ffi::{c_char, c_double, c_int, c_uint, c_ushort, c_void};
use std::sync::Mutex;
use std::time::{Duration, Instant};

struct State {
    plugged: bool,
    open: bool,
    running: bool,
    error: c_uint,
    force: [f64; 3],
    torque: [f64; 3],
    /// the servo loop runs nothing, and says nothing
    stuck: bool,
    /// an error that each frame ends with
    warns: c_uint,
    /// directions of output
    directions: c_int,
    position: [f64; 3],
    buttons: c_int,
    frames: u64,
    next: Option<Instant>,
}
static STATE: Mutex<State> = Mutex::new(State {
    plugged: true, open: false, running: false, error: 0, force: [0.0; 3], torque: [0.0; 3], stuck: false, warns: 0, directions: 3, position: [1.0, 2.0, 3.0], buttons: 0, frames: 0, next: None,
});

#[repr(C)]
pub struct HDErrorInfo { code: c_uint, internal: c_int, device: c_uint }

/// frames to come whose place is no number
static UNPLACED: std::sync::atomic::AtomicI32 = std::sync::atomic::AtomicI32::new(0);

#[unsafe(no_mangle)] pub extern "C" fn hdInitDevice(_name: *const c_char) -> c_uint {
    let mut s = STATE.lock().unwrap();
    if s.plugged { s.open = true; 0 } else { s.error = 0x0301; 0xFFFF_FFFF }
}
#[unsafe(no_mangle)] pub extern "C" fn hdDisableDevice(_device: c_uint) { STATE.lock().unwrap().open = false; }
#[unsafe(no_mangle)] pub extern "C" fn hdMakeCurrentDevice(_device: c_uint) {}
#[unsafe(no_mangle)] pub extern "C" fn hdBeginFrame(_device: c_uint) {
    let mut s = STATE.lock().unwrap();
    if !s.plugged { s.error = 0x0302; }
}
#[unsafe(no_mangle)] pub extern "C" fn hdEndFrame(_device: c_uint) {
    let mut s = STATE.lock().unwrap();
    s.frames += 1;
    if s.error == 0 { s.error = s.warns }
}
#[unsafe(no_mangle)] pub unsafe extern "C" fn hdGetDoublev(what: c_uint, to: *mut c_double) {
    let s = STATE.lock().unwrap();
    let p = if UNPLACED.load(std::sync::atomic::Ordering::Relaxed) > 0 && what == 0x2052 {
        UNPLACED.fetch_sub(1, std::sync::atomic::Ordering::Relaxed);
        [f64::NAN; 3]
    } else {
        s.position
    };
    // a quarter turn about z, then the place
    let transform = [0.0, 1.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, p[0], p[1], p[2], 1.0];
    let numbers: &[f64] = match what {
        0x2052 => &transform,
        0x2051 => &[10.0, 20.0, 30.0],
        _ => &[],
    };
    // SAFETY: the caller gives place for what it asks, 16 or 3 doubles, as libHD does.
    unsafe { std::ptr::copy_nonoverlapping(numbers.as_ptr(), to, numbers.len()) };
}
#[unsafe(no_mangle)] pub unsafe extern "C" fn hdGetIntegerv(what: c_uint, to: *mut c_int) {
    let s = STATE.lock().unwrap();
    let number = if what == 0x2554 { s.directions } else { s.buttons };
    // SAFETY: the caller gives place for an int, as libHD asks.
    unsafe { *to = number };
}
#[unsafe(no_mangle)] pub unsafe extern "C" fn hdSetDoublev(what: c_uint, from: *const c_double) {
    if what == 0x2700 {
        // SAFETY: the caller gives a force, three doubles, as libHD asks.
        let force = unsafe { *from.cast::<[f64; 3]>() };
        STATE.lock().unwrap().force = force;
    }
    if what == 0x2701 {
        // SAFETY: the caller gives a torque, three doubles, as libHD asks.
        let torque = unsafe { *from.cast::<[f64; 3]>() };
        let mut s = STATE.lock().unwrap();
        // what a device without torque does when it is given one is its own affair: here an error, HD_INVALID_INPUT_TYPE
        if s.directions < 6 { s.error = 0x0100 } else { s.torque = torque }
    }
}
#[unsafe(no_mangle)] pub extern "C" fn hdEnable(_what: c_uint) {}
#[unsafe(no_mangle)] pub extern "C" fn hdGetError() -> HDErrorInfo {
    HDErrorInfo { code: std::mem::take(&mut STATE.lock().unwrap().error), internal: 0, device: 0 }
}
#[unsafe(no_mangle)] pub extern "C" fn hdStartScheduler() { STATE.lock().unwrap().running = true; }
#[unsafe(no_mangle)] pub extern "C" fn hdStopScheduler() { STATE.lock().unwrap().running = false; }
#[unsafe(no_mangle)] pub extern "C" fn hdScheduleSynchronous(call: extern "C" fn(*mut c_void) -> c_uint, data: *mut c_void, _priority: c_ushort) {
    let due = {
        let mut s = STATE.lock().unwrap();
        if s.stuck { return }
        let now = Instant::now();
        let due = s.next.map_or(now, |next| (next + Duration::from_millis(1)).max(now));
        s.next = Some(due);
        due
    };
    std::thread::sleep(due.saturating_duration_since(Instant::now()));
    // another thread, as the servo loop is
    let (call, data) = (call as usize, data as usize);
    std::thread::spawn(move || {
        // SAFETY: it is the address of such a function, given by the caller a few lines above, and functions stay where they are.
        let call: extern "C" fn(*mut c_void) -> c_uint = unsafe { std::mem::transmute(call) };
        call(data as *mut c_void)
    }).join().unwrap();
}
// for the test
#[unsafe(no_mangle)] pub extern "C" fn mock_plug(on: c_int) { STATE.lock().unwrap().plugged = on != 0; }
#[unsafe(no_mangle)] pub unsafe extern "C" fn mock_force(to: *mut c_double) {
    for n in 0..3 {
        // SAFETY: the test gives room for three numbers.
        unsafe { *to.add(n) = STATE.lock().unwrap().force[n] }
    }
}
#[unsafe(no_mangle)] pub unsafe extern "C" fn mock_torque(to: *mut c_double) {
    let torque = STATE.lock().unwrap().torque;
    // SAFETY: the test gives place for three doubles.
    unsafe { std::ptr::copy_nonoverlapping(torque.as_ptr(), to, 3) };
}
#[unsafe(no_mangle)] pub extern "C" fn mock_unplaced(frames: c_int) { UNPLACED.store(frames, std::sync::atomic::Ordering::Relaxed); }
#[unsafe(no_mangle)] pub extern "C" fn mock_stuck(on: c_int) { STATE.lock().unwrap().stuck = on != 0; }
#[unsafe(no_mangle)] pub extern "C" fn mock_warns(code: c_int) { STATE.lock().unwrap().warns = code as c_uint; }
#[unsafe(no_mangle)] pub extern "C" fn mock_directions(count: c_int) { STATE.lock().unwrap().directions = count; }
#[unsafe(no_mangle)] pub extern "C" fn mock_open() -> c_int { let s = STATE.lock().unwrap(); c_int::from(s.open || s.running) }
