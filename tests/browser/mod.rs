//! A headless Chromium driven through its DevTools protocol: opens a page, runs scripts in it, sends real mouse and key events.
//!
//! The browser gets a profile of its own in a fresh directory and no network but this machine's; both go when it is dropped.

use serde_json::{Value, json};
use std::{
    fs,
    net::TcpStream,
    path::{Path, PathBuf},
    process::{Child, Command, Stdio},
    sync::atomic::{AtomicUsize, Ordering::Relaxed},
    time::{Duration, Instant},
};
use tungstenite::{Message, WebSocket};

/// Longest wait for the browser to start or to answer.
const PATIENCE: Duration = Duration::from_secs(60);

/// Where Chromium is, if it is installed.
pub fn chromium() -> Option<PathBuf> {
    let names = ["chromium", "chromium-browser", "google-chrome", "google-chrome-stable"];
    let path = std::env::var_os("PATH")?;
    names.iter().find_map(|name| std::env::split_paths(&path).map(|dir| dir.join(name)).find(|p| p.is_file()))
}

/// A browser with one page.
pub struct Browser {
    child: Child,
    profile: PathBuf,
    socket: WebSocket<TcpStream>,
    session: String,
    next_id: u64,
    /// what the page wrote to its console as errors, and exceptions that nobody caught
    pub complaints: Vec<String>,
}

impl Browser {
    /// Starts Chromium and opens an address in a window of a size.
    pub fn open(chromium: &Path, address: &str, width: u32, height: u32) -> Self {
        static BROWSERS: AtomicUsize = AtomicUsize::new(0);
        let number = BROWSERS.fetch_add(1, Relaxed);
        let profile = std::env::temp_dir().join(format!("maille-page-test-{}-{number}", std::process::id()));
        fs::create_dir_all(&profile).expect("a directory for the browser's profile");
        let child = Command::new(chromium)
            .args(["--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-background-networking"])
            .args(["--disable-component-update", "--disable-sync", "--disable-default-apps", "--remote-debugging-port=0"])
            .arg(format!("--window-size={width},{height}"))
            .arg(format!("--user-data-dir={}", profile.display()))
            .arg("about:blank")
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()
            .expect("Chromium starts");
        let (port, path) = devtools(&profile);
        let stream = TcpStream::connect(("127.0.0.1", port)).expect("the DevTools port answers");
        stream.set_read_timeout(Some(PATIENCE)).expect("a timeout");
        let (socket, _) = tungstenite::client(format!("ws://127.0.0.1:{port}{path}"), stream).expect("a DevTools socket");
        let mut browser = Self { child, profile, socket, session: String::new(), next_id: 0, complaints: Vec::new() };
        let target = browser.call("Target.createTarget", json!({"url": "about:blank"}));
        let attached = browser.call("Target.attachToTarget", json!({"targetId": target["targetId"], "flatten": true}));
        browser.session = attached["sessionId"].as_str().expect("a session").to_owned();
        for domain in ["Page.enable", "Runtime.enable", "Log.enable"] {
            browser.call(domain, json!({}));
        }
        let size = json!({"width": width, "height": height, "deviceScaleFactor": 1, "mobile": false});
        browser.call("Emulation.setDeviceMetricsOverride", size);
        browser.call("Page.navigate", json!({"url": address}));
        browser
    }

    /// Calls a method of the protocol.
    pub fn call(&mut self, method: &str, parameters: Value) -> Value {
        self.next_id += 1;
        let mut message = json!({"id": self.next_id, "method": method, "params": parameters});
        if !self.session.is_empty() {
            message["sessionId"] = self.session.as_str().into();
        }
        self.socket.send(Message::text(message.to_string())).expect("the browser listens");
        loop {
            let Message::Text(text) = self.socket.read().expect("the browser answers") else { continue };
            let answer: Value = serde_json::from_str(&text).expect("the browser speaks JSON");
            if answer["id"] == self.next_id {
                assert!(answer["error"].is_null(), "{method}: {}", answer["error"]);
                return answer["result"].clone();
            }
            match answer["method"].as_str() {
                Some("Runtime.exceptionThrown") => self.complaints.push(answer["params"]["exceptionDetails"].to_string()),
                Some("Log.entryAdded") if answer["params"]["entry"]["level"] == "error" => {
                    self.complaints.push(answer["params"]["entry"]["text"].to_string());
                }
                _ => {}
            }
        }
    }

    /// The value of an expression in the page (a promise is waited for).
    pub fn evaluate(&mut self, expression: &str) -> Value {
        let answer = self.call("Runtime.evaluate", json!({"expression": expression, "returnByValue": true, "awaitPromise": true}));
        assert!(answer["exceptionDetails"].is_null(), "{expression}: {}", answer["exceptionDetails"]);
        answer["result"]["value"].clone()
    }

    /// Waits until an expression is true.
    pub fn until(&mut self, what: &str, expression: &str) {
        let start = Instant::now();
        while self.evaluate(expression) != Value::Bool(true) {
            assert!(start.elapsed() < PATIENCE, "waited in vain for: {what}; the page's complaints: {:?}", self.complaints);
            std::thread::sleep(Duration::from_millis(50));
        }
    }

    /// Moves the mouse with a button held, from one point of the window to another.
    pub fn drag(&mut self, from: [f64; 2], to: [f64; 2], button: &str, modifiers: u32) {
        let buttons = if button == "right" { 2 } else { 1 };
        let mut event = |kind: &str, at: [f64; 2], buttons: u32| {
            let event = json!({"type": kind, "x": at[0], "y": at[1], "button": button, "buttons": buttons, "clickCount": 1, "modifiers": modifiers});
            self.call("Input.dispatchMouseEvent", event);
        };
        event("mousePressed", from, buttons);
        for step in 1..=8 {
            let t = f64::from(step) / 8.0;
            event("mouseMoved", [from[0] + t * (to[0] - from[0]), from[1] + t * (to[1] - from[1])], buttons);
        }
        event("mouseReleased", to, 0);
    }

    /// Turns the wheel at a point of the window; 100 is a notch towards the hand.
    pub fn wheel(&mut self, at: [f64; 2], delta: f64) {
        self.call("Input.dispatchMouseEvent", json!({"type": "mouseWheel", "x": at[0], "y": at[1], "deltaX": 0, "deltaY": delta}));
    }
}

impl Drop for Browser {
    fn drop(&mut self) {
        // ends its helper processes too; killing alone would leave them to notice by themselves
        let _ = self.socket.send(Message::text(json!({"id": 0, "method": "Browser.close"}).to_string()));
        let start = Instant::now();
        while matches!(self.child.try_wait(), Ok(None)) && start.elapsed() < Duration::from_secs(5) {
            std::thread::sleep(Duration::from_millis(20));
        }
        let _ = self.child.kill();
        let _ = self.child.wait();
        let _ = fs::remove_dir_all(&self.profile);
    }
}

/// Port and path of the DevTools socket, which Chromium writes into its profile.
fn devtools(profile: &Path) -> (u16, String) {
    let file = profile.join("DevToolsActivePort");
    let start = Instant::now();
    loop {
        let text = fs::read_to_string(&file).unwrap_or_default();
        if let Some((port, path)) = text.split_once('\n')
            && let Ok(port) = port.parse()
            && path.starts_with('/')
        {
            return (port, path.trim().to_owned());
        }
        assert!(start.elapsed() < PATIENCE, "Chromium did not open its DevTools port");
        std::thread::sleep(Duration::from_millis(50));
    }
}
