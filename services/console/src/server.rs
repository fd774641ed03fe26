//! HTTP and WebSocket on 127.0.0.1: the page's files, and one socket a page.
//!
//! Only this machine's own page may talk: the `Host` must be 127.0.0.1 or localhost with our port (a name that an attacker
//! points at 127.0.0.1 is not), and a WebSocket's `Origin`, which every browser sends, must be the same. The page may
//! load nothing from elsewhere (`Content-Security-Policy`).
//!
//! Back-pressure: a page has at most [`PICTURES_UNDRAWN`] pictures that it has not acknowledged; while it is behind it is
//! skipped, and gets the newest picture when it has caught up.

use crate::{
    assets,
    encode::Picture,
    hub::{Hub, PageId},
    protocol::{MAX_REQUEST_BYTES, Request as PageRequest},
};
use axum::{
    Router,
    extract::{
        FromRequestParts, Request, State,
        ws::{Message, WebSocket, WebSocketUpgrade},
    },
    http::{HeaderMap, HeaderName, HeaderValue, StatusCode, header},
    middleware::{self, Next},
    response::{IntoResponse, Response},
    routing::get,
};
use std::{
    collections::VecDeque,
    net::TcpListener,
    sync::{Arc, atomic::Ordering::Relaxed},
    time::Duration,
};
use tokio::{
    sync::{
        broadcast::{self, error::RecvError},
        watch,
    },
    time::timeout,
};

/// Pictures on their way to a page: one being drawn, one behind it.
const PICTURES_UNDRAWN: usize = 2;
/// A page whose socket takes nothing for this long is cut off.
const SEND_WITHIN: Duration = Duration::from_secs(10);
/// The page may use its own files and its own socket, and stand in no other page.
const POLICY: &str = "default-src 'self'; img-src 'self' blob:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'";

/// Serves until the hub says that the console has ended.
pub async fn serve(listener: TcpListener, hub: Arc<Hub>) -> std::io::Result<()> {
    listener.set_nonblocking(true)?;
    let listener = tokio::net::TcpListener::from_std(listener)?;
    let mut ended = hub.ended.subscribe();
    tokio::select! {
        result = axum::serve(listener, router(hub)).into_future() => result,
        _ = ended.wait_for(|&e| e) => Ok(()),
    }
}

fn router(hub: Arc<Hub>) -> Router {
    let mut router = Router::new().route("/ws", get(socket)).with_state(hub);
    for file in assets::FILES {
        router = router.route(file.path, get(move || async move { ([(header::CONTENT_TYPE, file.content_type)], file.content) }));
    }
    router.layer(middleware::from_fn(guard))
}

/// Lets through what is meant for us, and says what the answer may do.
async fn guard(request: Request, next: Next) -> Response {
    if !is_ours(request.headers()) {
        return (StatusCode::FORBIDDEN, "this console talks only to its own page on 127.0.0.1").into_response();
    }
    let mut response = next.run(request).await;
    for (name, value) in [
        (header::CONTENT_SECURITY_POLICY, POLICY),
        (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
        (header::REFERRER_POLICY, "no-referrer"),
        (header::CACHE_CONTROL, "no-store"),
        (HeaderName::from_static("cross-origin-resource-policy"), "same-origin"),
    ] {
        response.headers_mut().insert(name, HeaderValue::from_static(value));
    }
    response
}

/// Whether `Host` is this machine by a name that nobody else can give out, and `Origin`, if any, the same place.
fn is_ours(headers: &HeaderMap) -> bool {
    let Some(host) = headers.get(header::HOST).and_then(|h| h.to_str().ok()) else { return false };
    let name = host.rsplit_once(':').map_or(host, |(name, _)| name);
    if !["127.0.0.1", "localhost"].contains(&name) {
        return false;
    }
    match headers.get(header::ORIGIN) {
        None => true,
        Some(origin) => origin.to_str().is_ok_and(|o| o.strip_prefix("http://") == Some(host)),
    }
}

async fn socket(State(hub): State<Arc<Hub>>, request: Request) -> Response {
    let (mut parts, _) = request.into_parts();
    match WebSocketUpgrade::from_request_parts(&mut parts, &()).await {
        Ok(upgrade) => upgrade.max_message_size(MAX_REQUEST_BYTES).max_frame_size(MAX_REQUEST_BYTES).on_upgrade(move |s| page(s, hub)),
        Err(refusal) => refusal.into_response(),
    }
}

async fn page(socket: WebSocket, hub: Arc<Hub>) {
    let id = hub.page_id();
    hub.pages.fetch_add(1, Relaxed);
    let mut page = Page { id, socket, undrawn: VecDeque::new(), waiting: false, hub: Arc::clone(&hub) };
    page.talk().await;
    page.set_waiting(false);
    hub.pages.fetch_sub(1, Relaxed);
    hub.left(id);
}

struct Page {
    id: PageId,
    socket: WebSocket,
    /// pictures sent and not acknowledged
    undrawn: VecDeque<u32>,
    /// whether this page is counted in `hub.waiting`
    waiting: bool,
    hub: Arc<Hub>,
}

/// What a page's task woke up for.
enum Wake {
    Said(Message),
    Picture(Option<Arc<Picture>>),
    Text(Arc<str>),
    Missed,
    Gone,
}

impl Page {
    fn set_waiting(&mut self, waiting: bool) {
        match (self.waiting, waiting) {
            (false, true) => _ = self.hub.waiting.fetch_add(1, Relaxed),
            (true, false) => _ = self.hub.waiting.fetch_sub(1, Relaxed),
            _ => {}
        }
        self.waiting = waiting;
    }

    async fn talk(&mut self) {
        let mut pictures = self.hub.pictures.subscribe();
        pictures.mark_changed(); // what is shown now is shown to a new page at once
        let mut hello = self.hub.hello.subscribe();
        let mut states = self.hub.states.subscribe();
        let greeting = Arc::clone(&hello.borrow_and_update());
        if !self.send_text(&greeting).await {
            return;
        }
        loop {
            self.set_waiting(self.undrawn.len() < PICTURES_UNDRAWN);
            let going_on = match self.wake(&mut pictures, &mut states).await {
                Wake::Said(Message::Text(text)) => {
                    self.hear(&text);
                    true
                }
                Wake::Said(Message::Binary(_)) => {
                    self.hub.refuse();
                    true
                }
                Wake::Said(Message::Close(_)) | Wake::Gone => false,
                Wake::Said(_) | Wake::Missed | Wake::Picture(None) => true,
                Wake::Picture(Some(picture)) => {
                    self.undrawn.push_back(picture.number);
                    self.send(Message::Binary(axum::body::Bytes::from_owner(Bytes(Arc::clone(&picture.message))))).await
                }
                Wake::Text(text) => self.send_text(&text).await,
            };
            if !going_on {
                return;
            }
        }
    }

    async fn wake(&mut self, pictures: &mut watch::Receiver<Option<Arc<Picture>>>, states: &mut broadcast::Receiver<Arc<str>>) -> Wake {
        tokio::select! {
            said = self.socket.recv() => match said {
                Some(Ok(message)) => Wake::Said(message),
                Some(Err(_)) | None => Wake::Gone,
            },
            state = states.recv() => match state {
                Ok(text) => Wake::Text(text),
                Err(RecvError::Lagged(_)) => Wake::Missed,
                Err(RecvError::Closed) => Wake::Gone,
            },
            changed = pictures.changed(), if self.waiting => match changed {
                Ok(()) => Wake::Picture(pictures.borrow_and_update().clone()),
                Err(_) => Wake::Gone,
            },
        }
    }

    fn hear(&mut self, text: &str) {
        if let Some(PageRequest::Ack { frame }) = self.hub.request(self.id, text) {
            // pictures are drawn in order, so one acknowledgement stands for those before it
            match self.undrawn.iter().position(|&n| n == frame) {
                Some(at) => _ = self.undrawn.drain(..=at),
                None => self.hub.refuse(),
            }
        }
    }

    async fn send_text(&mut self, text: &str) -> bool {
        self.send(Message::text(text)).await
    }

    /// Whether it could be sent.
    async fn send(&mut self, message: Message) -> bool {
        matches!(timeout(SEND_WITHIN, self.socket.send(message)).await, Ok(Ok(())))
    }
}

/// Shares a message's bytes between pages without copying them.
struct Bytes(Arc<[u8]>);

impl AsRef<[u8]> for Bytes {
    fn as_ref(&self) -> &[u8] {
        &self.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn headers(host: &str, origin: Option<&str>) -> HeaderMap {
        let mut map = HeaderMap::new();
        map.insert(header::HOST, HeaderValue::from_str(host).unwrap());
        if let Some(origin) = origin {
            map.insert(header::ORIGIN, HeaderValue::from_str(origin).unwrap());
        }
        map
    }

    #[test]
    fn only_our_own_page_is_ours() {
        for (host, origin, ours) in [
            ("127.0.0.1:4000", None, true),
            ("localhost:4000", Some("http://localhost:4000"), true),
            ("127.0.0.1:4000", Some("http://127.0.0.1:4000"), true),
            ("127.0.0.1:4000", Some("http://127.0.0.1:4001"), false),
            ("127.0.0.1:4000", Some("http://example.org"), false),
            ("127.0.0.1:4000", Some("null"), false),
            ("127.0.0.1:4000", Some("https://127.0.0.1:4000"), false),
            ("example.org:4000", None, false),
            ("example.org:4000", Some("http://example.org:4000"), false),
            ("127.0.0.1.example.org:4000", None, false),
        ] {
            assert_eq!(is_ours(&headers(host, origin)), ours, "{host} {origin:?}");
        }
        assert!(!is_ours(&HeaderMap::new()));
    }
}
