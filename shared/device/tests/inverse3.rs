//! inverse3 against a stand-in for the Haply Inverse Service: both forms of its protocol, 1 kHz, unplugged and back in mid-run.

use maille_contact::{Device, DeviceStatus};
use maille_device::{Kind, Options, Protocol, RemoteDevice, open, open_telling, probe::probe_kind};
use maille_realtime::{CountingAllocator, Period, assert_steady, monotonic_ns};
use serde_json::{Value, json};
use std::{
    net::TcpListener,
    sync::{
        Arc, Mutex,
        atomic::{AtomicBool, AtomicU64, Ordering::Relaxed},
    },
    thread::{self, JoinHandle},
    time::Duration,
};
use tungstenite::Message;

#[global_allocator]
static ALLOCATOR: CountingAllocator = CountingAllocator;

/// What the test and the service share.
#[derive(Default)]
struct Shared {
    stop: AtomicBool,
    /// the device is plugged in at the service
    plugged: AtomicBool,
    /// the service closes connections
    down: AtomicBool,
    /// the service says that it lives, and nothing of its device
    pings: AtomicBool,
    force: Mutex<[f64; 3]>,
    refused: AtomicU64,
    states: AtomicU64,
}

struct Service {
    address: String,
    shared: Arc<Shared>,
    thread: Option<JoinHandle<()>>,
}

impl Service {
    /// A service that speaks one form only and counts commands in any other.
    fn start(new: bool) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        listener.set_nonblocking(true).unwrap();
        let address = listener.local_addr().unwrap().to_string();
        let shared = Arc::new(Shared { plugged: AtomicBool::new(true), ..Shared::default() });
        let for_thread = Arc::clone(&shared);
        let thread = thread::spawn(move || {
            while !for_thread.stop.load(Relaxed) {
                match listener.accept() {
                    Ok((stream, _)) if !for_thread.down.load(Relaxed) => {
                        stream.set_nonblocking(false).unwrap();
                        stream.set_read_timeout(Some(Duration::from_millis(300))).unwrap();
                        stream.set_nodelay(true).unwrap();
                        if let Ok(mut socket) = tungstenite::accept(stream) {
                            serve(&mut socket, new, &for_thread);
                        }
                    }
                    Ok(_) => {}
                    Err(_) => thread::sleep(Duration::from_millis(5)),
                }
            }
        });
        Self { address, shared, thread: Some(thread) }
    }

    fn force(&self) -> [f64; 3] {
        *self.shared.force.lock().unwrap()
    }
}

impl Drop for Service {
    fn drop(&mut self) {
        self.shared.stop.store(true, Relaxed);
        self.thread.take().unwrap().join().unwrap();
    }
}

/// One connection: a state a millisecond at most, the next after a command.
fn serve(socket: &mut tungstenite::WebSocket<std::net::TcpStream>, new: bool, shared: &Shared) {
    let mut next = monotonic_ns();
    while !shared.stop.load(Relaxed) && !shared.down.load(Relaxed) {
        if shared.pings.load(Relaxed) {
            if socket.send(Message::Ping(Default::default())).is_err() {
                return;
            }
            thread::sleep(Duration::from_millis(20));
            continue;
        }
        let n = shared.states.fetch_add(1, Relaxed);
        let state = json!({
            "cursor_position": { "x": 0.001 * (n as f64 * 0.01).sin(), "y": 0.02, "z": 0.15 },
            "cursor_velocity": { "x": 0.0, "y": 0.0, "z": 0.0 } });
        let devices = if shared.plugged.load(Relaxed) {
            json!([{ "device_id": "04BA", "state": state, "status": { "ready": true } }])
        } else {
            json!([])
        };
        let frame =
            if new { json!({ "session_id": 1, "inverse3": devices, "wireless_verse_grip": [] }) } else { json!({ "inverse3": devices }) };
        if socket.send(Message::text(frame.to_string())).is_err() {
            return;
        }
        let Ok(Message::Text(text)) = socket.read() else { return };
        let command: Value = serde_json::from_str(&text).unwrap();
        let force = &command["inverse3"][0]["commands"]["set_cursor_force"];
        let vector = if new && force["execute"] == true {
            &force["vector"]
        } else if new {
            &Value::Null
        } else {
            &force["values"]
        };
        let three = ["x", "y", "z"].map(|c| vector[c].as_f64());
        match three {
            [Some(x), Some(y), Some(z)] => *shared.force.lock().unwrap() = [x, y, z],
            _ => drop(shared.refused.fetch_add(u64::from(shared.plugged.load(Relaxed)), Relaxed)),
        }
        next = (next + 1_000_000).max(monotonic_ns());
        thread::sleep(Duration::from_nanos(next.saturating_sub(monotonic_ns())));
    }
    let _ = socket.close(None);
}

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

#[test]
fn an_inverse3_lives_through_unplugging_with_either_form_of_the_protocol() {
    for new in [false, true] {
        let service = Service::start(new);
        let mut device = open(Kind::Inverse3, &Options { address: service.address.clone(), ..Options::default() }).unwrap();
        assert!(ticks(&mut device, 5.0, [0.0; 3], |d| d.status() == DeviceStatus::Connected), "it is found");
        let pose = device.read(0);
        assert!(pose.valid && (pose.position_mm[2] - 150.0).abs() < 1e-9 && (pose.position_mm[1] - 20.0).abs() < 1e-9, "{pose:?}");

        let (before, began) = (device.exchanges(), monotonic_ns());
        ticks(&mut device, 1.0, [0.5, -0.25, 0.125], |_| false);
        let rate = (device.exchanges() - before) as f64 / ((monotonic_ns() - began) as f64 * 1e-9);
        println!("service {}: {rate:.0} exchanges a second, pose {:.2} ms old", if new { "3.5" } else { "3.4" }, device.pose_age_s() * 1e3);
        assert!(rate > 100.0, "{rate} a second, on however busy a machine");
        assert_eq!(service.force(), [0.5, -0.25, 0.125], "the force arrives in the form that this service knows");
        assert_eq!(service.shared.refused.load(Relaxed), 0, "and in no other");

        thread::sleep(Duration::from_millis(400));
        assert_eq!(service.force(), [0.0; 3], "a silent tick gives no force");

        // the device is unplugged from the service, then the service itself goes down
        for (what, on) in [(&service.shared.plugged, false), (&service.shared.down, true)] {
            what.store(on, Relaxed);
            assert!(ticks(&mut device, 5.0, [0.5, 0.0, 0.0], |d| d.status() == DeviceStatus::Unplugged), "it is missed");
            assert!(!device.read(0).valid);
            what.store(!on, Relaxed);
            let back = ticks(&mut device, 8.0, [0.5, 0.0, 0.0], |d| d.status() == DeviceStatus::Connected && service.force()[0] == 0.5);
            assert!(back, "it comes back with its whole force");
        }
        assert!(device.opened() >= 3);
        drop(device);
        // sent by then, and on its way through a socket
        let began = monotonic_ns();
        while service.force() != [0.0; 3] {
            assert!(monotonic_ns() - began < 2_000_000_000, "what is let go gets no force, not {:?}", service.force());
            thread::sleep(Duration::from_millis(1));
        }
    }
}

/// A service that goes on talking without a state, or says its handshake byte by byte, is given up in time: told once, called again, and let go of at once.
#[test]
fn a_service_that_talks_and_says_nothing_is_lost_and_called_again() {
    let service = Service::start(true);
    let (sender, told) = std::sync::mpsc::channel();
    let tell = move |sentence: &str| drop(sender.send(sentence.to_owned()));
    let options = Options { address: service.address.clone(), ..Options::default() };
    let mut device = open_telling(Kind::Inverse3, &options, tell).unwrap();
    assert!(ticks(&mut device, 5.0, [0.0; 3], |d| d.status() == DeviceStatus::Connected), "it is found");
    service.shared.pings.store(true, Relaxed);
    assert!(ticks(&mut device, 5.0, [0.5, 0.0, 0.0], |d| d.status() == DeviceStatus::Unplugged), "it is missed");
    assert!(ticks(&mut device, 5.0, [0.5, 0.0, 0.0], |d| d.opened() >= 2), "it is called again");
    service.shared.pings.store(false, Relaxed);
    let back = ticks(&mut device, 8.0, [0.5, 0.0, 0.0], |d| d.status() == DeviceStatus::Connected && service.force()[0] == 0.5);
    assert!(back, "and comes back with its whole force");
    service.shared.pings.store(true, Relaxed);
    let began = monotonic_ns();
    drop(device);
    assert!(monotonic_ns() - began < 5_000_000_000, "whoever ends does not wait for it");
    let told: Vec<String> = told.into_iter().collect();
    assert_eq!(told.iter().filter(|said| said.contains("no answer for 200 ms")).count(), 1, "{told:?}");
}

#[test]
fn a_handshake_that_drips_is_given_up() {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = listener.local_addr().unwrap().to_string();
    let dripping = thread::spawn(move || {
        let (mut stream, _) = listener.accept().unwrap();
        let mut sent = 0;
        // a byte in time for any timeout that begins anew with each
        for byte in b"HTTP/1.1 101 Switching Protocols\r\nUpgrade: websocket\r\n".iter().cycle() {
            if std::io::Write::write_all(&mut stream, &[*byte]).is_err() || sent > 200 {
                break;
            }
            sent += 1;
            thread::sleep(Duration::from_millis(50));
        }
        sent
    });
    let found = probe_kind(Kind::Inverse3, &Options { address, ..Options::default() });
    assert!(!found.software && found.says.contains("no answer for 200 ms"), "{found:?}");
    assert!(dripping.join().unwrap() < 200, "the connection was given up");
}

#[test]
fn a_form_that_is_asked_for_is_kept() {
    let service = Service::start(true);
    let options = Options { address: service.address.clone(), protocol: Protocol::Values, ..Options::default() };
    let mut device = open(Kind::Inverse3, &options).unwrap();
    assert!(ticks(&mut device, 5.0, [0.5, 0.0, 0.0], |_| service.shared.refused.load(Relaxed) > 3), "the new service refuses the old form");
}

#[test]
fn a_service_is_probed() {
    let service = Service::start(true);
    let options = Options { address: service.address.clone(), ..Options::default() };
    let found = probe_kind(Kind::Inverse3, &options);
    assert!(found.software && found.device && found.says.contains("ready"), "{found:?}");
    service.shared.plugged.store(false, Relaxed);
    let found = probe_kind(Kind::Inverse3, &options);
    assert!(found.software && !found.device && found.says.contains("no such device"), "{found:?}");
    drop(service);
    let found = probe_kind(Kind::Inverse3, &options);
    assert!(!found.software && found.says.contains("start the Haply Inverse Service"), "{found:?}");
}
