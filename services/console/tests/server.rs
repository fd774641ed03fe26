//! The server over real sockets, with a made run behind it: what arrives, what is published, what is refused.

mod mock;

use maille_contract::ToolCommand;
use mock::{Mock, Shared};
use std::{
    io::{Read, Write},
    net::TcpStream,
    sync::{Arc, atomic::Ordering::Relaxed},
    thread::JoinHandle,
    time::{Duration, Instant},
};
use tungstenite::{Message, WebSocket, client::IntoClientRequest, http::HeaderValue};

/// Long enough for a machine that does much else; nothing here waits that long when it works.
const PATIENCE: Duration = Duration::from_secs(20);

struct Console {
    shared: Arc<Shared>,
    port: u16,
    thread: Option<JoinHandle<()>>,
}

impl Console {
    fn start() -> Self {
        let shared = Arc::<Shared>::default();
        let (listener, port) = maille_console::listen(0).unwrap();
        let thread = std::thread::spawn({
            let shared = Arc::clone(&shared);
            move || maille_console::serve(Mock::new(shared, 64), listener, 80).unwrap()
        });
        Self { shared, port, thread: Some(thread) }
    }

    fn connect(&self) -> Page {
        self.connect_from(Some(&format!("http://127.0.0.1:{}", self.port))).unwrap()
    }

    fn connect_from(&self, origin: Option<&str>) -> Result<Page, String> {
        let mut request = format!("ws://127.0.0.1:{}/ws", self.port).into_client_request().unwrap();
        if let Some(origin) = origin {
            request.headers_mut().insert("Origin", HeaderValue::from_str(origin).unwrap());
        }
        let stream = TcpStream::connect(("127.0.0.1", self.port)).unwrap();
        stream.set_read_timeout(Some(PATIENCE)).unwrap();
        let (socket, _) = tungstenite::client(request, stream).map_err(|e| e.to_string())?;
        Ok(Page { socket })
    }

    /// Waits until something holds.
    fn until<T>(&self, what: &str, mut found: impl FnMut(&Shared) -> Option<T>) -> T {
        let start = Instant::now();
        while start.elapsed() < PATIENCE {
            if let Some(value) = found(&self.shared) {
                return value;
            }
            std::thread::sleep(Duration::from_millis(5));
        }
        panic!("waited in vain for: {what}")
    }

    /// One plain request, given as it goes over the wire.
    fn http(&self, path: &str, host: &str) -> String {
        let mut stream = TcpStream::connect(("127.0.0.1", self.port)).unwrap();
        stream.set_read_timeout(Some(PATIENCE)).unwrap();
        write!(stream, "GET {path} HTTP/1.1\r\nHost: {host}\r\nConnection: close\r\n\r\n").unwrap();
        let mut answer = String::new();
        stream.read_to_string(&mut answer).unwrap();
        answer
    }
}

impl Drop for Console {
    fn drop(&mut self) {
        self.shared.end.store(true, Relaxed);
        let ended = self.thread.take().unwrap().join();
        assert!(ended.is_ok() || std::thread::panicking(), "the console's thread panicked");
    }
}

struct Page {
    socket: WebSocket<TcpStream>,
}

impl Page {
    fn say(&mut self, text: &str) {
        self.socket.send(Message::text(text)).unwrap();
    }

    fn text(&mut self) -> serde_json::Value {
        loop {
            if let Message::Text(text) = self.socket.read().unwrap() {
                return serde_json::from_str(&text).unwrap();
            }
        }
    }

    fn frame(&mut self) -> Vec<u8> {
        loop {
            if let Message::Binary(bytes) = self.socket.read().unwrap() {
                return bytes.to_vec();
            }
        }
    }

    fn acknowledge(&mut self, frame: &[u8]) {
        let number = u32::from_le_bytes(frame[4..8].try_into().unwrap());
        self.say(&format!(r#"{{"type":"ack","frame":{number}}}"#));
    }
}

/// The four JPEGs of a frame.
fn jpegs(frame: &[u8]) -> Vec<&[u8]> {
    let mut at = 88;
    let cut = |v: usize| {
        let bytes = u32::from_le_bytes(frame[44 + 8 * v..48 + 8 * v].try_into().unwrap()) as usize;
        at += bytes;
        &frame[at - bytes..at]
    };
    (0..4).map(cut).collect()
}

#[test]
fn a_page_is_greeted_and_gets_four_pictures_and_a_state() {
    let console = Console::start();
    let mut page = console.connect();
    let hello = page.text();
    assert_eq!((hello["type"].as_str(), hello["protocol"].as_u64()), (Some("hello"), Some(3)));
    assert_eq!(hello["facts"]["low_mm"][0], -90.0);
    assert!(hello["presets"].as_array().unwrap().len() >= 4);
    let frame = page.frame();
    for jpeg in jpegs(&frame) {
        assert_eq!((&jpeg[..2], &jpeg[jpeg.len() - 2..]), (&[0xFF, 0xD8][..], &[0xFF, 0xD9][..]));
    }
    page.acknowledge(&frame);
    let state = page.text();
    assert_eq!(state["type"], "state");
    assert_eq!(state["services"].as_array().unwrap().len(), 4);
    assert!(state["tool"]["tip_mm"][2].is_number());
}

#[test]
fn a_page_that_does_not_acknowledge_gets_two_pictures_and_no_more() {
    let console = Console::start();
    let mut page = console.connect();
    page.socket.get_ref().set_read_timeout(Some(Duration::from_millis(700))).unwrap();
    let mut frames = Vec::new();
    let start = Instant::now();
    while start.elapsed() < Duration::from_millis(700) {
        match page.socket.read() {
            Ok(Message::Binary(b)) => frames.push(b.to_vec()),
            Ok(_) => {}
            Err(_) => break,
        }
    }
    assert_eq!(frames.len(), 2);
    let drawn = console.shared.frames.load(Relaxed);
    assert!(drawn <= 3, "{drawn} frames were encoded for nobody");
    page.socket.get_ref().set_read_timeout(Some(PATIENCE)).unwrap();
    page.acknowledge(&frames[1]);
    page.frame();
}

#[test]
fn nothing_is_encoded_while_no_page_is_open() {
    let console = Console::start();
    std::thread::sleep(Duration::from_millis(200));
    assert_eq!(console.shared.frames.load(Relaxed), 0);
}

#[test]
fn the_threshold_of_the_page_is_published() {
    let console = Console::start();
    let mut page = console.connect();
    let before = console.until("a first view", |s| *s.view.lock().unwrap());
    page.say(r#"{"type":"view","threshold_hu":123.5}"#);
    let view = console.until("the new threshold", |s| s.view.lock().unwrap().filter(|v| v.threshold_hu == 123.5));
    assert!(view.stamp.sequence > before.stamp.sequence);
    assert_eq!(view.eye_mm, before.eye_mm);
}

#[test]
fn what_is_no_request_changes_nothing_and_is_counted() {
    let console = Console::start();
    let mut page = console.connect();
    let before = console.until("a first view", |s| *s.view.lock().unwrap());
    for text in ["{", "[]", r#"{"type":"format"}"#, r#"{"type":"view","fov_deg":-1}"#, r#"{"type":"ack","frame":4000000000}"#] {
        page.say(text);
    }
    page.socket.send(Message::binary(vec![1, 2, 3])).unwrap();
    console.until("six refusals", |s| (s.refused.load(Relaxed) == 6).then_some(()));
    assert_eq!(*console.shared.view.lock().unwrap(), Some(before));
    // and the page is still served
    page.say(r#"{"type":"view","threshold_hu":7}"#);
    console.until("a good request after bad ones", |s| s.view.lock().unwrap().filter(|v| v.threshold_hu == 7.0));
}

#[test]
fn a_message_too_long_ends_that_page_and_no_other() {
    let console = Console::start();
    let (mut good, mut bad) = (console.connect(), console.connect());
    let _ = bad.socket.send(Message::text(" ".repeat(1 << 20)));
    let cut_off = (0..1000).any(|_| bad.socket.read().is_err());
    assert!(cut_off);
    good.say(r#"{"type":"view","threshold_hu":8}"#);
    console.until("the other page's request", |s| s.view.lock().unwrap().filter(|v| v.threshold_hu == 8.0));
}

/// The last command, if it holds or frees the tool as asked.
fn last(shared: &Shared, taken: bool) -> Option<ToolCommand> {
    shared.commands.lock().unwrap().last().copied().filter(|c| (c.taken != 0) == taken)
}

#[test]
fn one_page_holds_the_tool_at_a_time_and_lets_go_by_leaving() {
    let console = Console::start();
    let (mut one, mut two) = (console.connect(), console.connect());
    one.say(r#"{"type":"tool","taken":true,"target_mm":[1,2,3]}"#);
    let command = console.until("the tool taken", |s| last(s, true));
    assert_eq!(command.target_mm, [1.0, 2.0, 3.0]);
    two.say(r#"{"type":"tool","taken":true,"target_mm":[9,9,9]}"#);
    two.say(r#"{"type":"tool","taken":false}"#);
    console.until("two refusals", |s| (s.refused.load(Relaxed) == 2).then_some(()));
    assert!(console.shared.commands.lock().unwrap().iter().all(|c| c.target_mm == [1.0, 2.0, 3.0]));
    drop(one);
    console.until("the tool free", |s| last(s, false));
    two.say(r#"{"type":"tool","taken":true,"target_mm":[9,9,9]}"#);
    console.until("the tool taken by the other", |s| last(s, true).filter(|c| c.target_mm == [9.0; 3]));
}

#[test]
fn a_hand_that_falls_silent_lets_go() {
    let console = Console::start();
    let mut page = console.connect();
    page.say(r#"{"type":"tool","taken":true,"target_mm":[1,2,3]}"#);
    console.until("the tool taken", |s| last(s, true));
    console.until("the tool free without a word", |s| last(s, false));
}

#[test]
fn other_origins_and_other_names_are_refused() {
    let console = Console::start();
    for origin in ["http://example.org", "null", "http://127.0.0.1:1"] {
        let refusal = console.connect_from(Some(origin)).err();
        assert!(refusal.as_deref().is_some_and(|e| e.contains("403")), "{origin}: {refusal:?}");
    }
    assert!(console.connect_from(None).is_ok());
    let ours = format!("127.0.0.1:{}", console.port);
    assert!(console.http("/", &ours).starts_with("HTTP/1.1 200"));
    assert!(console.http("/", "evil.example.org").starts_with("HTTP/1.1 403"));
}

#[test]
fn the_page_is_whole_and_loads_nothing_from_elsewhere() {
    let console = Console::start();
    let host = format!("localhost:{}", console.port);
    let index = console.http("/", &host);
    assert!(index.contains("content-security-policy: default-src 'self'"), "{}", &index[..400]);
    let mut todo: Vec<String> = vec!["/".into()];
    let mut done = Vec::new();
    while let Some(path) = todo.pop() {
        let text = console.http(&path, &host);
        assert!(text.starts_with("HTTP/1.1 200"), "{path} is missing");
        let body = text.split_once("\r\n\r\n").unwrap().1;
        for word in body.split(['"', '\'', '`', '(', ')']) {
            assert!(!word.starts_with("https:") && !word.starts_with("//cdn"), "{path} names {word}");
            let is_file = [".js", ".css", ".svg"].iter().any(|e| word.ends_with(e));
            if word.starts_with('/') && is_file && !done.contains(&word.to_owned()) {
                todo.push(word.into());
            }
        }
        done.push(path);
    }
    assert!(done.len() > 5);
    assert!(console.http("/nothing", &host).starts_with("HTTP/1.1 404"));
}

#[test]
fn the_end_of_the_run_ends_the_server_while_pages_are_open() {
    let console = Console::start();
    let mut page = console.connect();
    page.text();
    let start = Instant::now();
    drop(console);
    assert!(start.elapsed() < Duration::from_secs(2), "the server took {:?} to end", start.elapsed());
}
