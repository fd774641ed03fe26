//! A stand-in for the Haply Inverse Service (its protocol from 3.5 on): one Inverse3 whose cursor stands where the test says, and which
//! can be unplugged. A state a millisecond at most, the next one after a command.

use serde_json::{Value, json};
use std::{
    net::{TcpListener, TcpStream},
    sync::{
        Arc, Mutex,
        atomic::{AtomicBool, Ordering::Relaxed},
    },
    thread::{self, JoinHandle},
    time::Duration,
};
use tungstenite::{Message, WebSocket};

#[derive(Default)]
struct Shared {
    stop: AtomicBool,
    unplugged: AtomicBool,
    position_m: Mutex<[f64; 3]>,
    force_n: Mutex<[f64; 3]>,
}

/// The service; ends when dropped.
pub struct Service {
    /// host and port
    pub address: String,
    shared: Arc<Shared>,
    thread: Option<JoinHandle<()>>,
}

impl Service {
    /// Starts it on a port of its own.
    pub fn start() -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").expect("a port can be had");
        listener.set_nonblocking(true).expect("a socket");
        let address = listener.local_addr().expect("it has an address").to_string();
        let shared = Arc::new(Shared::default());
        let own = Arc::clone(&shared);
        let thread = thread::spawn(move || {
            while !own.stop.load(Relaxed) {
                match listener.accept() {
                    Ok((stream, _)) => serve(stream, &own),
                    Err(_) => thread::sleep(Duration::from_millis(5)),
                }
            }
        });
        Self { address, shared, thread: Some(thread) }
    }

    /// Puts the cursor somewhere, in the device's own axes [mm].
    pub fn put(&self, position_mm: [f64; 3]) {
        *self.shared.position_m.lock().expect("no thread died") = position_mm.map(|v| v * 1e-3);
    }

    /// Unplugs the device from the service, or plugs it in.
    pub fn plug(&self, plugged: bool) {
        self.shared.unplugged.store(!plugged, Relaxed);
    }

    /// The force of the last command [N]; zero once nobody is connected.
    pub fn force_n(&self) -> [f64; 3] {
        *self.shared.force_n.lock().expect("no thread died")
    }
}

impl Drop for Service {
    fn drop(&mut self) {
        self.shared.stop.store(true, Relaxed);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

/// One connection.
fn serve(stream: TcpStream, shared: &Shared) {
    let usable = stream.set_nonblocking(false).and(stream.set_read_timeout(Some(Duration::from_millis(300)))).and(stream.set_nodelay(true));
    if let (Ok(()), Ok(mut socket)) = (usable, tungstenite::accept(stream)) {
        while !shared.stop.load(Relaxed) && exchange(&mut socket, shared).is_some() {
            thread::sleep(Duration::from_millis(1));
        }
        let _ = socket.close(None);
    }
    *shared.force_n.lock().expect("no thread died") = [0.0; 3];
}

/// A state there, a command back.
fn exchange(socket: &mut WebSocket<TcpStream>, shared: &Shared) -> Option<()> {
    let [x, y, z] = *shared.position_m.lock().expect("no thread died");
    let state = json!({ "cursor_position": { "x": x, "y": y, "z": z }, "cursor_velocity": { "x": 0.0, "y": 0.0, "z": 0.0 } });
    let device = json!({ "device_id": "04BA", "state": state, "status": { "ready": true } });
    let devices = if shared.unplugged.load(Relaxed) { json!([]) } else { json!([device]) };
    let frame = json!({ "session_id": 1, "inverse3": devices, "wireless_verse_grip": [] });
    socket.send(Message::text(frame.to_string())).ok()?;
    let Message::Text(text) = socket.read().ok()? else { return None };
    let command: Value = serde_json::from_str(&text).ok()?;
    let vector = &command["inverse3"][0]["commands"]["set_cursor_force"]["vector"];
    if let [Some(x), Some(y), Some(z)] = ["x", "y", "z"].map(|c| vector[c].as_f64()) {
        *shared.force_n.lock().expect("no thread died") = [x, y, z];
    }
    Some(())
}
