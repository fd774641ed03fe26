//! touch and forcedimension against stand-ins for the vendors' libraries, built here as shared objects: 1 kHz, unplugged and plugged
//! in again in mid-run, silent ticks, libraries that are missing or lack a function.

use maille_contact::{AnalyticSurface, Device, DeviceStatus, HapticConfig, HapticCore, Material, TickInputs, TissueTable};
use maille_device::{DeviceError, Kind, Mounting, Options, RemoteDevice, open, open_telling, probe::probe_kind, profiles, usable};
use maille_realtime::{CountingAllocator, Period, assert_steady, monotonic_ns};
use maille_volume::VolumeSample;
use std::{
    path::{Path, PathBuf},
    process::Command,
    time::Duration,
};

#[global_allocator]
static ALLOCATOR: CountingAllocator = CountingAllocator;

/// Builds a stand-in; each test has its own, with its own state.
fn built(mock: &str, test: &str) -> PathBuf {
    let source = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/mocks").join(format!("{mock}.rs"));
    let out = Path::new(env!("CARGO_TARGET_TMPDIR")).join(format!("lib{mock}_{test}.so"));
    let rustc = std::env::var_os("RUSTC").unwrap_or_else(|| "rustc".into());
    let status = Command::new(rustc)
        .args(["--edition", "2024", "--crate-type", "cdylib", "--crate-name", mock, "-Awarnings", "-o"])
        .arg(&out)
        .arg(&source)
        .status()
        .expect("rustc runs");
    assert!(status.success(), "{mock} is built");
    out
}

/// The test's side of a stand-in.
struct Mock(libloading::Library);

impl Mock {
    fn of(path: &Path) -> Self {
        // SAFETY: a library built above, whose initialisers do nothing; the device opens the same one.
        Self(unsafe { libloading::Library::new(path) }.expect("the stand-in opens"))
    }
    fn plug(&self, on: bool) {
        // SAFETY: the type that the stand-in declares.
        let plug = unsafe { self.0.get::<extern "C" fn(i32)>(b"mock_plug") }.unwrap();
        plug(i32::from(on));
    }
    fn place(&self, mm: [f64; 3]) {
        // SAFETY: the type that the stand-in declares.
        let place = unsafe { self.0.get::<extern "C" fn(f64, f64, f64)>(b"mock_move") }.unwrap();
        place(mm[0] * 1e-3, mm[1] * 1e-3, mm[2] * 1e-3);
    }
    fn is_open(&self) -> bool {
        // SAFETY: the type that the stand-in declares.
        let open = unsafe { self.0.get::<extern "C" fn() -> i32>(b"mock_open") }.unwrap();
        open() != 0
    }
    fn three(&self, name: &str) -> [f64; 3] {
        let mut to = [0.0; 3];
        // SAFETY: the type that the stand-in declares.
        let tell = unsafe { self.0.get::<extern "C" fn(*mut f64)>(name.as_bytes()) }.unwrap();
        tell(to.as_mut_ptr());
        to
    }
    fn force(&self) -> [f64; 3] {
        self.three("mock_force")
    }
    /// [N·mm]
    fn torque(&self) -> [f64; 3] {
        self.three("mock_torque")
    }
    /// Largest force [N], and largest change in an exchange, since the last call of `clear_steps`.
    fn steps(&self) -> (f64, f64) {
        let [largest, steepest, _] = self.three("mock_steps");
        (largest, steepest)
    }
    fn clear_steps(&self) {
        self.set("mock_clear_steps", 0);
    }
    fn set(&self, name: &str, value: i32) {
        // SAFETY: the type that the stand-in declares.
        let set = unsafe { self.0.get::<extern "C" fn(i32)>(name.as_bytes()) }.unwrap();
        set(value);
    }
    fn watchdog(&self) -> i32 {
        // SAFETY: the type that the stand-in declares.
        let watchdog = unsafe { self.0.get::<extern "C" fn() -> i32>(b"mock_watchdog") }.unwrap();
        watchdog()
    }
}

/// Ticks at 1 kHz until `done`, or two thousand times `seconds`; never blocking, never allocating.
fn ticks(device: &mut RemoteDevice, seconds: f64, force_n: [f64; 3], mut done: impl FnMut(&RemoteDevice) -> bool) -> bool {
    let mut period = Period::new(1000.0);
    let until = monotonic_ns() + (seconds * 1e9) as u64;
    while monotonic_ns() < until {
        period.wait();
        assert_steady(|| {
            device.read(monotonic_ns());
            device.write(force_n);
        });
        if done(device) {
            return true;
        }
    }
    false
}

/// Everything that both libraries have in common.
fn lives_through_unplugging(kind: Kind, mock: &str) {
    let path = built(mock, "life");
    let other = Mock::of(&path);
    other.plug(false);
    let options =
        Options { library: Some(path), mounting: Mounting { origin_mm: [100.0, 0.0, 0.0], ..Mounting::default() }, ..Options::default() };
    let mut device = open(kind, &options).unwrap();
    assert!(!ticks(&mut device, 0.3, [0.0; 3], |d| d.status() != DeviceStatus::Unplugged), "there is no device yet");
    assert!(!device.read(0).valid && device.pose_age_s().is_infinite());

    other.plug(true);
    assert!(ticks(&mut device, 5.0, [0.0; 3], |d| d.status() == DeviceStatus::Connected), "it is found");
    let pose = device.read(0);
    let expected = if kind == Kind::Touch { [101.0, 2.0, 3.0] } else { [110.0, 20.0, 30.0] };
    for (seen, expected) in pose.position_mm.iter().zip(expected) {
        assert!((seen - expected).abs() < 1e-9, "{pose:?}");
    }
    let velocity = if kind == Kind::Touch { 20.0 } else { 200.0 };
    assert!((pose.velocity_mm_s.unwrap()[1] - velocity).abs() < 1e-9);
    // a quarter turn about z
    let q = device.orientation().unwrap();
    let half = std::f64::consts::FRAC_1_SQRT_2;
    assert!((q[2].abs() - half).abs() < 1e-9 && (q[2] * q[3] - 0.5).abs() < 1e-9, "{q:?}");
    assert!((pose.direction[2] - 1.0).abs() < 1e-9);

    // at 1 kHz, both sides
    let (before, began) = (device.exchanges(), monotonic_ns());
    ticks(&mut device, 1.0, [0.5, -0.25, 0.125], |_| false);
    let rate = (device.exchanges() - before) as f64 / ((monotonic_ns() - began) as f64 * 1e-9);
    println!("{}: {rate:.0} exchanges a second, pose {:.2} ms old", kind.name(), device.pose_age_s() * 1e3);
    assert!(rate > 100.0, "{rate} a second, on however busy a machine");
    let arrived = |_: &RemoteDevice| other.force() == [0.5, -0.25, 0.125];
    assert!(ticks(&mut device, 5.0, [0.5, -0.25, 0.125], arrived), "the force arrives, after its rise");

    // a tick that hangs: zero force
    std::thread::sleep(Duration::from_millis(400));
    assert_eq!(other.force(), [0.0; 3], "a silent tick gives no force");

    // unplugged in mid-run
    assert!(ticks(&mut device, 1.0, [0.5, 0.0, 0.0], |_| other.force()[0] > 0.0));
    other.plug(false);
    assert!(ticks(&mut device, 5.0, [0.5, 0.0, 0.0], |d| d.status() == DeviceStatus::Unplugged), "it is missed");
    assert!(!device.read(0).valid);
    other.plug(true);
    let mut first = None;
    assert!(
        ticks(&mut device, 5.0, [0.5, 0.0, 0.0], |d| {
            if d.status() == DeviceStatus::Connected && first.is_none() {
                first = Some(other.force()[0]);
            }
            other.force()[0] == 0.5 && d.status() == DeviceStatus::Connected
        }),
        "it comes back with its whole force"
    );
    assert!(first.unwrap() < 0.4, "and that rises: {first:?}");
    assert_eq!(device.opened(), 2);

    drop(device);
    assert_eq!(other.force(), [0.0; 3], "what is let go gets no force");
    assert!(!other.is_open(), "and is closed");
}

#[test]
fn a_touch_lives_through_unplugging() {
    lives_through_unplugging(Kind::Touch, "hd");
}

#[test]
fn a_force_dimension_device_lives_through_unplugging() {
    lives_through_unplugging(Kind::ForceDimension, "dhd");
}

/// What arrives at a device of a wrench, after its rise.
fn arrives(device: &mut RemoteDevice, mock: &Mock, torque_n_mm: [f64; 3]) -> [f64; 3] {
    let until = monotonic_ns() + 1_500_000_000;
    while monotonic_ns() < until {
        assert_steady(|| {
            device.read(monotonic_ns());
            device.write_wrench([0.1, 0.0, 0.0], torque_n_mm);
        });
        std::thread::sleep(Duration::from_millis(1));
    }
    mock.torque()
}

/// Torque goes to devices that give it, in their own frame and units, within their profile's limit, and to no other.
#[test]
fn torque_arrives_where_the_device_can_and_within_its_profile() {
    let close = |a: [f64; 3], b: [f64; 3]| assert!(a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-9), "{a:?} {b:?}");
    // a quarter turn about z: the patient's x is the device's −y … the torque goes back by Rᵀ
    let rotation = [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]];
    let with = |path: &Path, profile| Options {
        library: Some(path.into()),
        mounting: Mounting { rotation, ..Mounting::default() },
        profile: Some(profile),
        ..Options::default()
    };
    let path = built("dhd", "torque");
    let mock = Mock::of(&path);
    let mut sigma = open(Kind::ForceDimension, &with(&path, profiles::SIGMA)).unwrap();
    close(arrives(&mut sigma, &mock, [30.0, 40.0, 5.0]), [40.0, -30.0, 5.0]);
    assert!(mock.watchdog() > 0, "and the device's own watchdog is on");
    close(arrives(&mut sigma, &mock, [0.0, 0.0, -900.0]), [0.0, 0.0, -200.0]);
    close(arrives(&mut sigma, &mock, [f64::NAN, 0.0, 1.0]), [0.0; 3]);
    close(arrives(&mut sigma, &mock, [0.0, 0.0, 7.0]), [0.0, 0.0, 7.0]);
    drop(sigma);
    close(mock.torque(), [0.0; 3]);
    let mut omega = open(Kind::ForceDimension, &with(&path, profiles::OMEGA)).unwrap();
    close(arrives(&mut omega, &mock, [30.0, 0.0, 0.0]), [0.0; 3]);

    let path = built("hd", "torque");
    let mock = Mock::of(&path);
    // three directions: whoever gives it a torque is refused, and the device would count as lost
    let mut touch = open(Kind::Touch, &with(&path, profiles::PREMIUM)).unwrap();
    close(arrives(&mut touch, &mock, [30.0, 0.0, 0.0]), [0.0; 3]);
    assert_eq!((touch.opened(), touch.status()), (1, DeviceStatus::Connected));
    drop(touch);
    mock.set("mock_directions", 6);
    let mut premium = open(Kind::Touch, &with(&path, profiles::PREMIUM)).unwrap();
    close(arrives(&mut premium, &mock, [30.0, 40.0, 5.0]), [40.0, -30.0, 5.0]);
    close(arrives(&mut premium, &mock, [0.0, 900.0, 0.0]), [170.0, 0.0, 0.0]);
    drop(premium);
    close(mock.torque(), [0.0; 3]);
}

/// Who holds a device and panics has not let go: its force fades before it is closed, and so it does where a tick only falls silent.
#[test]
fn a_panic_or_a_silence_lets_go_of_a_device_without_a_step() {
    let path = built("dhd", "panic");
    let mock = Mock::of(&path);
    mock.clear_steps();
    let options = Options { library: Some(path), ..Options::default() };
    let panicked = std::thread::spawn(move || {
        let mut device = open(Kind::ForceDimension, &options).unwrap();
        assert!(ticks(&mut device, 5.0, [0.0; 3], |d| d.status() == DeviceStatus::Connected), "it is found");
        // no faster than a tick may: 0.02 N each
        for n in 0..150 {
            device.read(monotonic_ns());
            device.write([0.0, 0.0, 0.02 * f64::from(n)]);
            std::thread::sleep(Duration::from_millis(1));
        }
        let until = monotonic_ns() + 100_000_000;
        while monotonic_ns() < until {
            device.write([0.0, 0.0, 3.0]);
            std::thread::sleep(Duration::from_millis(1));
        }
        // silent for long enough to be let go of, and back
        std::thread::sleep(Duration::from_millis(120));
        for _ in 0..100 {
            device.write([0.0, 0.0, 3.0]);
            std::thread::sleep(Duration::from_millis(1));
        }
        panic!("the loop breaks its own invariant");
    });
    assert!(panicked.join().is_err());
    let (largest, steepest) = mock.steps();
    println!("at most {largest:.2} N, by {steepest:.3} N an exchange");
    assert!(largest == 3.0 && mock.force() == [0.0; 3] && !mock.is_open(), "{largest} {:?}", mock.force());
    // up to here by 0.02 N a tick, of which a busy machine may lay some into one exchange
    assert!(steepest <= 0.25, "{steepest} N in one exchange");
}

/// A servo loop that runs nothing leaves no reading: the device is lost, is told of once, gives no made-up pose, and comes back.
#[test]
fn a_servo_loop_that_does_not_run_is_a_device_that_is_lost() {
    let path = built("hd", "stuck");
    let mock = Mock::of(&path);
    mock.set("mock_stuck", 1);
    let (sender, told) = std::sync::mpsc::channel();
    let tell = move |sentence: &str| drop(sender.send(sentence.to_owned()));
    let mut device = open_telling(Kind::Touch, &Options { library: Some(path), ..Options::default() }, tell).unwrap();
    assert!(!ticks(&mut device, 0.5, [0.0; 3], |d| d.status() == DeviceStatus::Connected), "nothing that runs, no device");
    assert!(device.opened() < 10, "and it is not looked for without a pause: {}", device.opened());
    mock.set("mock_stuck", 0);
    assert!(ticks(&mut device, 5.0, [0.5, 0.0, 0.0], |_| mock.force()[0] == 0.5), "it is found, and given its force");
    mock.set("mock_stuck", 1);
    assert!(ticks(&mut device, 5.0, [0.5, 0.0, 0.0], |d| d.status() == DeviceStatus::Unplugged), "it is missed");
    assert!(!device.read(0).valid && device.read(0).position_mm == [1.0, 2.0, 3.0], "no pose is made up: {:?}", device.read(0));
    drop(device);
    assert!(!mock.is_open(), "what is lost is let go");
    let told: Vec<String> = told.into_iter().collect();
    assert_eq!(told.iter().filter(|said| said.contains("servo loop does not run")).count(), 2, "{told:?}");
}

/// Warm motors, or a force at the device's limit: it goes on with less, without a step, and says so once.
#[test]
fn a_device_that_warns_is_asked_for_less_and_not_let_go() {
    let path = built("hd", "warns");
    let mock = Mock::of(&path);
    let (sender, told) = std::sync::mpsc::channel();
    let tell = move |sentence: &str| drop(sender.send(sentence.to_owned()));
    let mut device = open_telling(Kind::Touch, &Options { library: Some(path), ..Options::default() }, tell).unwrap();
    assert!(ticks(&mut device, 5.0, [3.0, 0.0, 0.0], |_| mock.force()[0] == 3.0), "it is found, and given its force");
    mock.set("mock_warns", 0x0201);
    assert!(ticks(&mut device, 5.0, [3.0, 0.0, 0.0], |_| mock.force()[0] < 2.5), "the force is lowered: {:?}", mock.force());
    assert!(mock.force()[0] > 2.0, "step by step");
    mock.set("mock_warns", 0);
    assert_eq!((device.opened(), device.status()), (1, DeviceStatus::Connected), "and the device is kept");
    assert!(ticks(&mut device, 20.0, [3.0, 0.0, 0.0], |_| mock.force()[0] == 3.0), "it comes back: {:?}", mock.force());
    drop(device);
    let told: Vec<String> = told.into_iter().collect();
    assert!(told.len() == 1 && told[0].contains("0x0201"), "{told:?}");
}

/// The whole loop, device to contact to device: pressed on a wall, unplugged in mid-press, plugged in again. The force falls by the slew limit, is not
/// there while the device is not, and rises from zero.
#[test]
fn contact_through_a_device_fades_when_it_is_unplugged_and_rises_when_it_is_back() {
    let path = built("dhd", "contact");
    let mock = Mock::of(&path);
    let mut device = open(Kind::ForceDimension, &Options { library: Some(path), ..Options::default() }).unwrap();
    let (config, _) = HapticConfig::on_device(2.0, 2.0, 5e-4, 1e-3, &device.profile().unwrap()).unwrap();
    let tissue = TissueTable::uniform(Material { stiffness_n_per_mm: 0.5, friction_static: 0.0, ..Material::SOFT });
    let mut core = HapticCore::new(HapticConfig { tissue, ..config });
    let field = |at: [f64; 3]| VolumeSample { value: -100.0 * at[2], gradient: [0.0, 0.0, -100.0] };
    let wall = AnalyticSurface { field, threshold: 0.0, resolution_mm: 1.0 };
    let (mut period, mut last, mut n) = (Period::new(1000.0), 0.0f64, 0u64);
    let mut tick = |device: &mut RemoteDevice, core: &mut HapticCore, steepest: f64| {
        period.wait();
        let out = assert_steady(|| {
            let pose = device.read(0);
            if let Some(q) = device.orientation() {
                core.set_orientation(q);
            }
            core.set_given(device.gives());
            n += 1;
            let out = core.tick(&TickInputs {
                now_ns: n * 1_000_000,
                pose,
                pose_age_s: device.pose_age_s(),
                tissue: Some(&wall),
                epoch: 0,
                tissue_age_s: 0.0,
                release: false,
            });
            device.write_wrench(out.force_n, out.torque_n_mm);
            out
        });
        let f = out.force_n[2];
        assert!((0.0..=12.0).contains(&f) && (f - last).abs() <= steepest, "{last} → {f}");
        last = f;
        f
    };
    // down to the wall, 2 mm deep: some 1 N
    for k in 0..1500 {
        mock.place([0.0, 0.0, 6.0 - 0.006 * f64::from(k.min(1000))]);
        tick(&mut device, &mut core, 0.1 + 1e-9);
    }
    // on a busy machine a pose may be late now and then, and the force fades for a while: wait until it rests
    let (mut pressed, mut resting) = (0.0, 0);
    for _ in 0..5000 {
        let f = tick(&mut device, &mut core, 0.1 + 1e-9);
        // the coupling goes with the mean age of the poses, which a busy machine moves by some per cent
        resting = if f > 0.5 && (f - pressed).abs() < 0.02 { resting + 1 } else { 0 };
        pressed = f;
        if resting > 100 {
            break;
        }
    }
    assert!(resting > 100, "{pressed}");
    mock.plug(false);
    for _ in 0..600 {
        tick(&mut device, &mut core, 0.1 + 1e-9);
    }
    assert_eq!(tick(&mut device, &mut core, 0.1 + 1e-9), 0.0, "no device, no force");
    mock.plug(true);
    let mut back = 0.0;
    for _ in 0..5000 {
        back = tick(&mut device, &mut core, 0.1 + 1e-9);
        if (back - pressed).abs() < 0.05 {
            break;
        }
    }
    assert!((back - pressed).abs() < 0.05, "{back} of {pressed}");
    assert!(mock.force()[2] > 0.5 * pressed);
}

#[test]
fn missing_libraries_and_functions_are_named_with_what_to_do() {
    for kind in [Kind::Touch, Kind::ForceDimension] {
        let gone = Options { library: Some("/nowhere/lib.so".into()), ..Options::default() };
        let error = open(kind, &gone).err().expect("refused");
        assert!(matches!(error, DeviceError::LibraryMissing { .. }) && error.to_string().contains("install"), "{error}");
        let finding = probe_kind(kind, &gone);
        assert!(!finding.software && finding.says.contains("was not found"), "{finding:?}");
    }
    // a file that is no library: named, with what is wrong with it
    let text = Path::new(env!("CARGO_TARGET_TMPDIR")).join("no_library.so");
    std::fs::write(&text, "no library").unwrap();
    for kind in [Kind::Touch, Kind::ForceDimension] {
        let error = usable(kind, &Options { library: Some(text.clone()), ..Options::default() }).expect_err("refused");
        let said = error.to_string();
        assert!(matches!(error, DeviceError::LibraryUnusable { .. }) && said.contains("no_library.so cannot be opened"), "{said}");
    }
    let path = built("dhd", "probe");
    let wrong = Options { library: Some(path.clone()), ..Options::default() };
    let error = open(Kind::Touch, &wrong).err().expect("refused");
    assert!(error.to_string().contains("hdInitDevice"), "{error}");
    assert_eq!(usable(Kind::Touch, &wrong).expect_err("refused").to_string(), error.to_string());
    assert!(usable(Kind::ForceDimension, &wrong).is_ok());
    let found = probe_kind(Kind::ForceDimension, &wrong);
    assert!(found.software && found.device, "{found:?}");
    // kept open: a library that nobody holds forgets its state
    let mock = Mock::of(&path);
    mock.plug(false);
    let found = probe_kind(Kind::ForceDimension, &wrong);
    assert!(found.software && !found.device && found.says.contains("plug it in"), "{found:?}");
    let hd = Options { library: Some(built("hd", "probe")), ..Options::default() };
    assert!(probe_kind(Kind::Touch, &hd).software);
}

#[test]
fn kinds_are_named_as_scenes_write_them() {
    for kind in Kind::ALL {
        assert_eq!(Kind::named(kind.name()), Some(kind));
    }
    assert_eq!(Kind::named("mouse"), None);
}

/// libdhd numbers the devices that are plugged in; the stand-in has one.
#[test]
fn the_second_device_is_not_the_first() {
    let library = built("dhd", "second");
    let named = |id: &str| Options { library: Some(library.clone()), device: Some(id.into()), ..Options::default() };
    let mut first = open(Kind::ForceDimension, &named("0")).unwrap();
    assert!(ticks(&mut first, 5.0, [0.0; 3], |d| d.status() == DeviceStatus::Connected));
    drop(first);
    let mut second = open(Kind::ForceDimension, &named("1")).unwrap();
    assert!(!ticks(&mut second, 0.3, [0.0; 3], |d| d.status() == DeviceStatus::Connected), "there is no second");
    for no_number in ["left", "-1", "1.0", "", "128"] {
        assert!(matches!(usable(Kind::ForceDimension, &named(no_number)), Err(DeviceError::NoNumber { .. })), "{no_number}");
    }
}
