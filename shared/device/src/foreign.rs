//! Calls into vendors' shared objects, opened at run time: the only unsafe code of this crate.
//!
//! Signatures are those of the vendors' public headers (libHD: `hd.h`, `hdDevice.h`, `hdScheduler.h`; libdhd: `dhdc.h`). Function pointers
//! are copied out of the library once; the library is kept for as long as they are and never closed before them. All calls come
//! from the thread of the device.

use crate::DeviceError;
use libloading::Library;
use std::{
    ffi::{CStr, CString, c_char, c_double, c_int, c_uchar, c_uint, c_ushort, c_void},
    path::Path,
};

/// Opens the first of `names` that can be opened, or `path` alone.
pub(crate) fn library(
    path: Option<&Path>,
    names: &[&str],
    library: &'static str,
    package: &'static str,
) -> Result<(Library, String), DeviceError> {
    let mut reason: Option<String> = None;
    let candidates: Vec<&std::ffi::OsStr> = match path {
        Some(path) => vec![path.as_os_str()],
        None => names.iter().map(std::ffi::OsStr::new).collect(),
    };
    for name in candidates {
        // SAFETY: opening runs the library's initialisers. They are the vendor's, named by the system's or the user's own path, and this
        // happens once, before any other thread of the device exists.
        match unsafe { Library::new(name) } {
            Ok(opened) => return Ok((opened, name.to_string_lossy().into_owned())),
            Err(error) => {
                let error = error.to_string();
                // that a name is not there says less than what is wrong with one that is
                let absent = |said: &str| said.starts_with(&*name.to_string_lossy()) && said.contains("cannot open shared object file");
                if reason.is_none() || !absent(&error) {
                    reason = Some(error);
                }
            }
        }
    }
    let reason = reason.unwrap_or_default();
    Err(match path.filter(|path| path.exists()) {
        Some(path) => DeviceError::LibraryUnusable { path: path.display().to_string(), library, package, reason },
        None => DeviceError::LibraryMissing { library, package, reason },
    })
}

/// Copies a function pointer out of a library.
fn function<T: Copy>(library: &Library, name: &str, function: &'static str) -> Result<T, DeviceError> {
    // SAFETY: `T` is the function's type as its public header declares it; each caller writes it beside the name. The copy outlives the
    // symbol but not the library: whoever holds one holds both.
    match unsafe { library.get::<T>(function.as_bytes()) } {
        Ok(symbol) => Ok(*symbol),
        Err(_) => Err(DeviceError::FunctionMissing { library: name.to_owned(), function }),
    }
}

/// What libHD says of its last error: passed by value, as `HDErrorInfo`.
#[repr(C)]
#[derive(Clone, Copy)]
struct HdError {
    code: c_uint,
    internal: c_int,
    device: c_uint,
}

/// Names of `hdDefines.h`.
pub(crate) mod hd {
    pub const CURRENT_BUTTONS: u32 = 0x2000;
    pub const CURRENT_VELOCITY: u32 = 0x2051;
    pub const CURRENT_TRANSFORM: u32 = 0x2052;
    pub const OUTPUT_DOF: u32 = 0x2554;
    pub const CURRENT_FORCE: u32 = 0x2700;
    pub const CURRENT_TORQUE: u32 = 0x2701;
    pub const FORCE_OUTPUT: u32 = 0x4000;
    /// libHD shortens what is too long a force, where it would refuse it
    pub const MAX_FORCE_CLAMPING: u32 = 0x4001;
    /// force is going on, with less than was asked for: warm motors, too large a force or impulse, too fast a hand
    pub const WARNINGS: std::ops::Range<u32> = 0x0200..0x0300;
    pub const INVALID_HANDLE: u32 = 0xFFFF_FFFF;
    pub const SUCCESS: u32 = 0;
    pub const CALLBACK_DONE: u32 = 0;
    pub const DEFAULT_PRIORITY: u16 = 500;
}

/// libHD, with the functions that are used.
pub(crate) struct Hd {
    init_device: unsafe extern "C" fn(*const c_char) -> c_uint,
    disable_device: unsafe extern "C" fn(c_uint),
    make_current: unsafe extern "C" fn(c_uint),
    begin_frame: unsafe extern "C" fn(c_uint),
    end_frame: unsafe extern "C" fn(c_uint),
    get_doubles: unsafe extern "C" fn(c_uint, *mut c_double),
    get_integers: unsafe extern "C" fn(c_uint, *mut c_int),
    set_doubles: unsafe extern "C" fn(c_uint, *const c_double),
    enable: unsafe extern "C" fn(c_uint),
    get_error: unsafe extern "C" fn() -> HdError,
    start_scheduler: unsafe extern "C" fn(),
    stop_scheduler: unsafe extern "C" fn(),
    schedule: unsafe extern "C" fn(extern "C" fn(*mut c_void) -> c_uint, *mut c_void, c_ushort),
    /// keeps the pointers above valid; dropped after them
    _library: Library,
}

/// One exchange with libHD's servo loop.
#[derive(Clone, Copy, Default)]
pub(crate) struct HdFrame {
    pub device: u32,
    pub force_n: [f64; 3],
    /// for a device that gives torque [mN·m, which is N·mm]
    pub torque_n_mm: Option<[f64; 3]>,
    /// 4×4, column by column; translation in mm
    pub transform: [f64; 16],
    pub velocity_mm_s: [f64; 3],
    pub buttons: i32,
    pub error: u32,
    /// the servo loop has run this; without it nothing above is a reading
    pub ran: bool,
}

impl Hd {
    pub fn load(library: Library, name: &str) -> Result<Self, DeviceError> {
        Ok(Self {
            init_device: function(&library, name, "hdInitDevice")?,
            disable_device: function(&library, name, "hdDisableDevice")?,
            make_current: function(&library, name, "hdMakeCurrentDevice")?,
            begin_frame: function(&library, name, "hdBeginFrame")?,
            end_frame: function(&library, name, "hdEndFrame")?,
            get_doubles: function(&library, name, "hdGetDoublev")?,
            get_integers: function(&library, name, "hdGetIntegerv")?,
            set_doubles: function(&library, name, "hdSetDoublev")?,
            enable: function(&library, name, "hdEnable")?,
            get_error: function(&library, name, "hdGetError")?,
            start_scheduler: function(&library, name, "hdStartScheduler")?,
            stop_scheduler: function(&library, name, "hdStopScheduler")?,
            schedule: function(&library, name, "hdScheduleSynchronous")?,
            _library: library,
        })
    }

    /// Code of the last error, which it also forgets.
    pub fn error(&self) -> u32 {
        // SAFETY: takes nothing, returns three integers by value; the library is open.
        unsafe { (self.get_error)() }.code
    }

    /// Opens a device by its configured name (`None`: the default one); `INVALID_HANDLE` when there is none.
    pub fn init(&self, name: Option<&CStr>) -> u32 {
        let name = name.map_or(std::ptr::null(), CStr::as_ptr);
        // SAFETY: a string that ends in zero and lives through the call, or null, which libHD takes for its default device.
        unsafe { (self.init_device)(name) }
    }

    /// Enables force and starts the servo loop; how many directions the device gives force and torque in, 6 where it gives torque. The error is the code of
    /// what failed.
    pub fn start(&self, device: u32) -> Result<i32, u32> {
        // SAFETY: a handle that `init` gave and that was not disabled since.
        unsafe { (self.make_current)(device) };
        let mut directions = 0;
        // SAFETY: room for one integer, as this parameter gives.
        unsafe { (self.get_integers)(hd::OUTPUT_DOF, &raw mut directions) };
        // a device that does not tell has none, and that is no error of it
        self.error();
        // SAFETY: takes a constant of the header.
        unsafe { (self.enable)(hd::FORCE_OUTPUT) };
        let cannot = self.error();
        // SAFETY: takes a constant of the header.
        unsafe { (self.enable)(hd::MAX_FORCE_CLAMPING) };
        // libraries too old for it keep their own limit
        self.error();
        if cannot != hd::SUCCESS {
            return Err(cannot);
        }
        // SAFETY: takes nothing; called once for each `stop`.
        unsafe { (self.start_scheduler)() };
        match self.error() {
            hd::SUCCESS => Ok(directions),
            error => Err(error),
        }
    }

    /// Stops the servo loop and lets the device go.
    pub fn stop(&self, device: u32) {
        // SAFETY: takes nothing; after it no callback runs.
        unsafe { (self.stop_scheduler)() };
        // SAFETY: a handle that `init` gave, disabled once.
        unsafe { (self.disable_device)(device) };
    }

    /// Sets the force and reads the pose in the servo loop's next turn; returns when it has run, about a millisecond later.
    pub fn exchange(&self, frame: &mut HdFrame) {
        let mut call = HdCall { hd: self, frame: &mut *frame };
        let call: *mut HdCall<'_> = &raw mut call;
        // SAFETY: the callback has the type that libHD asks for; `call` lives on this stack until the call returns, which is when the
        // callback has run (that is what "synchronous" promises), and nobody else touches it meanwhile.
        unsafe { (self.schedule)(in_servo_loop, call.cast(), hd::DEFAULT_PRIORITY) };
        if frame.error == hd::SUCCESS {
            // what the call itself has to say: that there is no servo loop to run in
            frame.error = self.error();
        }
    }
}

struct HdCall<'a> {
    hd: &'a Hd,
    frame: &'a mut HdFrame,
}

/// Runs in libHD's servo loop. Does not panic: nothing in it can.
extern "C" fn in_servo_loop(data: *mut c_void) -> c_uint {
    // SAFETY: `data` is the `HdCall` of `Hd::exchange`, alive and not aliased until that returns.
    let call = unsafe { &mut *data.cast::<HdCall<'_>>() };
    let (hd, frame) = (call.hd, &mut *call.frame);
    // SAFETY: a frame of an open device, ended below.
    unsafe { (hd.begin_frame)(frame.device) };
    // SAFETY: three doubles, as this parameter takes.
    unsafe { (hd.set_doubles)(hd::CURRENT_FORCE, frame.force_n.as_ptr()) };
    if let Some(torque) = &frame.torque_n_mm {
        // SAFETY: three doubles, as this parameter takes.
        unsafe { (hd.set_doubles)(hd::CURRENT_TORQUE, torque.as_ptr()) };
    }
    // SAFETY: room for sixteen doubles, as this parameter gives.
    unsafe { (hd.get_doubles)(hd::CURRENT_TRANSFORM, frame.transform.as_mut_ptr()) };
    // SAFETY: room for three doubles, as this parameter gives.
    unsafe { (hd.get_doubles)(hd::CURRENT_VELOCITY, frame.velocity_mm_s.as_mut_ptr()) };
    // SAFETY: room for one integer, as this parameter gives.
    unsafe { (hd.get_integers)(hd::CURRENT_BUTTONS, &raw mut frame.buttons) };
    // SAFETY: ends the frame begun above.
    unsafe { (hd.end_frame)(frame.device) };
    frame.error = hd.error();
    frame.ran = true;
    hd::CALLBACK_DONE
}

/// libdhd, with the functions that are used.
pub(crate) struct Dhd {
    device_count: unsafe extern "C" fn() -> c_int,
    open_id: unsafe extern "C" fn(c_char) -> c_int,
    close: unsafe extern "C" fn(c_char) -> c_int,
    position: unsafe extern "C" fn(*mut c_double, *mut c_double, *mut c_double, c_char) -> c_int,
    velocity: unsafe extern "C" fn(*mut c_double, *mut c_double, *mut c_double, c_char) -> c_int,
    orientation: unsafe extern "C" fn(*mut [c_double; 3], c_char) -> c_int,
    set_wrench: unsafe extern "C" fn(c_double, c_double, c_double, c_double, c_double, c_double, c_double, c_char) -> c_int,
    enable_force: unsafe extern "C" fn(c_uchar, c_char) -> c_int,
    buttons: unsafe extern "C" fn(c_char) -> c_uint,
    last_error: unsafe extern "C" fn() -> *const c_char,
    /// absent before SDK 3.4: then the thread's own silence guard is the only one
    watchdog: Option<unsafe extern "C" fn(c_uchar, c_char) -> c_int>,
    /// keeps the pointers above valid; dropped after them
    _library: Library,
}

impl Dhd {
    pub fn load(library: Library, name: &str) -> Result<Self, DeviceError> {
        Ok(Self {
            device_count: function(&library, name, "dhdGetDeviceCount")?,
            open_id: function(&library, name, "dhdOpenID")?,
            close: function(&library, name, "dhdClose")?,
            position: function(&library, name, "dhdGetPosition")?,
            velocity: function(&library, name, "dhdGetLinearVelocity")?,
            orientation: function(&library, name, "dhdGetOrientationFrame")?,
            set_wrench: function(&library, name, "dhdSetForceAndTorqueAndGripperForce")?,
            enable_force: function(&library, name, "dhdEnableForce")?,
            buttons: function(&library, name, "dhdGetButtonMask")?,
            last_error: function(&library, name, "dhdErrorGetLastStr")?,
            watchdog: function(&library, name, "dhdSetWatchdog").ok(),
            _library: library,
        })
    }

    /// Devices that are plugged in.
    pub fn count(&self) -> i32 {
        // SAFETY: takes nothing, returns an integer.
        unsafe { (self.device_count)() }
    }

    /// Opens a device by its number among those plugged in; its id, negative when that fails.
    pub fn open(&self, number: i8) -> i32 {
        // SAFETY: takes an index by value.
        unsafe { (self.open_id)(number as c_char) }
    }

    /// Lets a device go.
    pub fn shut(&self, id: i8) {
        // SAFETY: an id that `open` gave, closed once.
        unsafe { (self.close)(id as c_char) };
    }

    /// Switches force on, and the watchdog of `10 ms` units where there is one. Negative: it failed.
    pub fn enable(&self, id: i8, watchdog: u8) -> i32 {
        if let Some(set) = self.watchdog {
            // SAFETY: an open id and a byte by value. A device without a watchdog refuses, which harms nothing.
            unsafe { set(watchdog, id as c_char) };
        }
        // SAFETY: an open id and a byte by value.
        unsafe { (self.enable_force)(1, id as c_char) }
    }

    /// Position [m] and what the call returned: negative, it failed.
    pub fn position(&self, id: i8) -> (i32, [f64; 3]) {
        let [mut x, mut y, mut z] = [0.0; 3];
        // SAFETY: three doubles of this stack, written before the call returns.
        let result = unsafe { (self.position)(&raw mut x, &raw mut y, &raw mut z, id as c_char) };
        (result, [x, y, z])
    }

    /// Velocity [m/s] and what the call returned.
    pub fn velocity(&self, id: i8) -> (i32, [f64; 3]) {
        let [mut x, mut y, mut z] = [0.0; 3];
        // SAFETY: three doubles of this stack, written before the call returns.
        let result = unsafe { (self.velocity)(&raw mut x, &raw mut y, &raw mut z, id as c_char) };
        (result, [x, y, z])
    }

    /// Orientation, row by row, and what the call returned.
    pub fn orientation(&self, id: i8) -> (i32, [[f64; 3]; 3]) {
        let mut frame = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
        // SAFETY: three rows of three doubles, as the header's `double matrix[3][3]`, written before the call returns.
        let result = unsafe { (self.orientation)(frame.as_mut_ptr(), id as c_char) };
        (result, frame)
    }

    /// Force [N] and torque [N·m]. Negative: it failed.
    pub fn set(&self, id: i8, f: [f64; 3], t: [f64; 3]) -> i32 {
        // SAFETY: an open id and numbers by value; the gripper gets none.
        unsafe { (self.set_wrench)(f[0], f[1], f[2], t[0], t[1], t[2], 0.0, id as c_char) }
    }

    /// Buttons held.
    pub fn button_mask(&self, id: i8) -> u32 {
        // SAFETY: an open id by value.
        unsafe { (self.buttons)(id as c_char) }
    }

    /// What the library says of its last error.
    pub fn why(&self) -> String {
        // SAFETY: takes nothing, returns a string of the library or null.
        let text = unsafe { (self.last_error)() };
        if text.is_null() {
            return "no reason given".into();
        }
        // SAFETY: not null, ends in zero, and stays until this thread's next call into the library: it is copied at once.
        unsafe { CStr::from_ptr(text) }.to_string_lossy().into_owned()
    }
}

/// A name for a library call; `None` when it has a zero inside.
pub(crate) fn c_string(text: &str) -> Option<CString> {
    CString::new(text).ok()
}
