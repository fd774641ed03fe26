//! Haply Inverse3 by the Haply Inverse Service's WebSocket: JSON, one state against one command.
//!
//! The service sends a state; it sends the next when it has a command, so every state is answered, with zero force if need be. Two forms of
//! the force command exist: `values` up to service 3.4, `vector` with `execute` from 3.5 on. From 3.5 on states carry a
//! `session_id`, by which [`Protocol::Auto`] tells them apart. Units: m, N.

use crate::{
    DeviceError, Options,
    link::{Command, Driver, Report},
    resolve::Resolver,
};
use bytemuck::Zeroable;
use serde_json::{Value, json};
use std::{
    io::{self, Read, Write},
    net::TcpStream,
    time::{Duration, Instant},
};
use tungstenite::{Message, WebSocket};

/// Form of the service's commands.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Protocol {
    /// decided by the first state
    #[default]
    Auto,
    /// up to 3.4: `set_cursor_force.values`
    Values,
    /// from 3.5 on: `set_cursor_force.vector` and `execute`
    Vector,
}

/// Longest wait for a connection, for the whole of its handshake, and for the whole of an exchange, however many bytes and pings come meanwhile.
const PATIENCE: Duration = Duration::from_millis(200);
/// Longest time that saying goodbye may take.
const GOODBYE: Duration = Duration::from_millis(20);
const DEVICE: &str = "the Inverse3";

pub(crate) struct Inverse3 {
    address: String,
    resolver: Resolver,
    protocol: Protocol,
    wanted: Option<String>,
    socket: Option<WebSocket<Timely>>,
    /// what is known since the connection: the device's id and the form of commands
    session: Option<(String, Protocol)>,
}

impl Inverse3 {
    pub fn new(options: &Options) -> Self {
        Self {
            address: options.address.clone(),
            resolver: Resolver::default(),
            protocol: options.protocol,
            wanted: options.device.clone(),
            socket: None,
            session: None,
        }
    }

    /// Takes a state; `None` when it holds no such device.
    fn take(&mut self, state: &Value) -> Option<Report> {
        let devices = state.get("inverse3")?.as_array()?;
        let id_of = |device: &Value| device.get("device_id").and_then(Value::as_str).map(str::to_owned);
        let device = match &self.wanted {
            Some(wanted) => devices.iter().find(|d| id_of(d).as_ref() == Some(wanted))?,
            None => devices.first()?,
        };
        let id = id_of(device)?;
        if self.session.as_ref().is_none_or(|(known, _)| *known != id) {
            let told = if state.get("session_id").is_some() { Protocol::Vector } else { Protocol::Values };
            self.session = Some((id, if self.protocol == Protocol::Auto { told } else { self.protocol }));
        }
        let from = device.get("state")?;
        let three = |name: &str| {
            let v = from.get(name)?;
            Some([v.get("x")?.as_f64()?, v.get("y")?.as_f64()?, v.get("z")?.as_f64()?])
        };
        let position = three("cursor_position")?;
        let velocity = three("cursor_velocity");
        // the grip has its own entry, wired or not
        let grip = ["wireless_verse_grip", "verse_grip", "custom_verse_grip"]
            .iter()
            .filter_map(|kind| state.get(kind)?.as_array()?.first()?.get("state"))
            .next();
        let orientation = grip.and_then(|g| {
            let q = g.get("orientation")?;
            Some([q.get("x")?.as_f64()?, q.get("y")?.as_f64()?, q.get("z")?.as_f64()?, q.get("w")?.as_f64()?])
        });
        let buttons = grip.and_then(|g| g.get("buttons")).map_or(0, |b| {
            ["a", "b", "c"].iter().enumerate().map(|(n, name)| u64::from(b.get(name) == Some(&Value::Bool(true))) << n).sum()
        });
        // older services tell no status: a device that sends poses is ready
        let ready = device.get("status").and_then(|s| s.get("ready")).and_then(Value::as_bool).unwrap_or(true);
        Some(Report {
            position_mm: position.map(|c| c * 1000.0),
            velocity_mm_s: velocity.unwrap_or_default().map(|c| c * 1000.0),
            orientation: orientation.unwrap_or_default(),
            buttons,
            ready: u64::from(ready),
            has_velocity: u64::from(velocity.is_some()),
            ..Report::zeroed()
        })
    }

    fn answer(&self, f: [f64; 3]) -> Value {
        let Some((id, protocol)) = &self.session else { return json!({}) };
        let force = json!({ "x": f[0], "y": f[1], "z": f[2] });
        let command = match protocol {
            Protocol::Values => json!({ "values": force }),
            _ => json!({ "vector": force, "execute": true }),
        };
        json!({ "inverse3": [{ "device_id": id, "commands": { "set_cursor_force": command } }] })
    }
}

/// A stream whose reads and writes all end at one moment: a timeout of the socket would begin anew with each byte.
struct Timely {
    stream: TcpStream,
    until: Instant,
}

impl Timely {
    fn left(&self) -> io::Result<Duration> {
        let left = self.until.saturating_duration_since(Instant::now());
        if left.is_zero() { Err(late()) } else { Ok(left) }
    }
}

fn late() -> io::Error {
    io::Error::new(io::ErrorKind::TimedOut, format!("no answer for {} ms", PATIENCE.as_millis()))
}

/// A socket that ran out of time says so in two ways.
fn in_time<T>(done: io::Result<T>) -> io::Result<T> {
    done.map_err(|error| if matches!(error.kind(), io::ErrorKind::WouldBlock | io::ErrorKind::TimedOut) { late() } else { error })
}

impl Read for Timely {
    fn read(&mut self, to: &mut [u8]) -> io::Result<usize> {
        self.stream.set_read_timeout(Some(self.left()?))?;
        in_time(self.stream.read(to))
    }
}

impl Write for Timely {
    fn write(&mut self, from: &[u8]) -> io::Result<usize> {
        self.stream.set_write_timeout(Some(self.left()?))?;
        in_time(self.stream.write(from))
    }

    fn flush(&mut self) -> io::Result<()> {
        self.stream.flush()
    }
}

fn lost(reason: impl ToString) -> DeviceError {
    DeviceError::Lost { device: DEVICE, reason: reason.to_string() }
}

impl Driver for Inverse3 {
    fn open(&mut self) -> Result<(), DeviceError> {
        let not_there = |reason: String| DeviceError::NotThere { device: DEVICE, reason };
        let address = self.resolver.resolve(&self.address, PATIENCE).map_err(|e| not_there(e.to_string()))?;
        let stream = TcpStream::connect_timeout(&address, PATIENCE).map_err(|e| not_there(e.to_string()))?;
        // small messages at once
        stream.set_nodelay(true).map_err(lost)?;
        let stream = Timely { stream, until: Instant::now() + PATIENCE };
        let (socket, _) = tungstenite::client(format!("ws://{}", self.address), stream).map_err(|e| not_there(e.to_string()))?;
        (self.socket, self.session) = (Some(socket), None);
        Ok(())
    }

    fn exchange(&mut self, command: &dyn Fn() -> Command) -> Result<Report, DeviceError> {
        let mut socket = self.socket.take().ok_or_else(|| lost("there is no connection"))?;
        socket.get_mut().until = Instant::now() + PATIENCE;
        let text = loop {
            match socket.read().map_err(lost)? {
                Message::Text(text) => break text,
                Message::Close(_) => return Err(lost("the service closed the connection")),
                _ => {}
            }
        };
        let state: Value = serde_json::from_str(&text).map_err(lost)?;
        let report = self.take(&state);
        socket.send(Message::text(self.answer(command().force_n).to_string())).map_err(lost)?;
        self.socket = Some(socket);
        report.ok_or_else(|| lost("the service knows no such device"))
    }

    fn close(&mut self) {
        if let Some(mut socket) = self.socket.take() {
            // who has gone need not be told
            socket.get_mut().until = Instant::now() + GOODBYE;
            let _ = socket.close(None);
        }
        self.session = None;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn device() -> Inverse3 {
        Inverse3::new(&Options::default())
    }

    #[test]
    fn states_of_both_services_are_read_and_answered_in_their_own_form() {
        let old = json!({ "inverse3": [{ "device_id": "04AA", "state": { "cursor_position": { "x": 0.01, "y": -0.02, "z": 0.15 } } }] });
        let mut d = device();
        let report = d.take(&old).unwrap();
        assert_eq!((report.position_mm, report.ready, report.has_velocity), ([10.0, -20.0, 150.0], 1, 0));
        assert_eq!(
            d.answer([1.0, 2.0, 3.0])["inverse3"][0]["commands"]["set_cursor_force"],
            json!({ "values": { "x": 1.0, "y": 2.0, "z": 3.0 } })
        );
        let new = json!({
            "session_id": 7,
            "inverse3": [{ "device_id": "05DA", "state": {
                "cursor_position": { "x": 0.0, "y": 0.0, "z": 0.1 }, "cursor_velocity": { "x": 0.1, "y": 0.0, "z": 0.0 } },
                "status": { "ready": false, "calibrated": false } }],
            "wireless_verse_grip": [{ "device_id": "9", "state": {
                "orientation": { "x": 0.0, "y": 1.0, "z": 0.0, "w": 0.0 }, "buttons": { "a": true, "b": false, "c": true } } }]
        });
        let mut d = device();
        let report = d.take(&new).unwrap();
        assert_eq!((report.ready, report.buttons, report.velocity_mm_s[0]), (0, 5, 100.0));
        assert_eq!(report.orientation, [0.0, 1.0, 0.0, 0.0]);
        let answer = d.answer([0.0; 3]);
        assert_eq!(answer["inverse3"][0]["device_id"], "05DA");
        assert_eq!(answer["inverse3"][0]["commands"]["set_cursor_force"]["execute"], true);
        assert!(answer["inverse3"][0]["commands"]["set_cursor_force"]["vector"].is_object());
    }

    #[test]
    fn what_is_no_state_is_no_report() {
        for text in [
            "{}",
            "[]",
            "null",
            r#"{"inverse3":[]}"#,
            r#"{"inverse3":[{}]}"#,
            r#"{"inverse3":[{"device_id":"1","state":{"cursor_position":{"x":"far"}}}]}"#,
        ] {
            assert_eq!(device().take(&serde_json::from_str(text).unwrap()), None, "{text}");
        }
        let mut other = Inverse3::new(&Options { device: Some("77".into()), ..Options::default() });
        assert_eq!(
            other.take(&json!({ "inverse3": [{ "device_id": "1", "state": { "cursor_position": { "x": 0.0, "y": 0.0, "z": 0.0 } } }] })),
            None
        );
    }
}
