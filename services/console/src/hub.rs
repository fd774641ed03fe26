//! What the thread of the feed and the tasks of the pages share.
//!
//! Pictures and greetings are latest-value channels, states a short broadcast; requests come back in one queue. Nothing here
//! grows with a slow page: a page that falls behind misses states and pictures.

use crate::{encode::Picture, protocol::Request};
use std::sync::{
    Arc,
    atomic::{AtomicU64, AtomicUsize, Ordering::Relaxed},
    mpsc,
};
use tokio::sync::{broadcast, watch};

/// Number of a page's connection.
pub type PageId = u64;

/// States that a page may be behind by.
const STATES_KEPT: usize = 8;
/// Requests that may wait for the thread of the feed: it empties the queue every few milliseconds.
const REQUESTS_KEPT: usize = 1024;

/// What comes from a page.
#[derive(Clone, Debug, PartialEq)]
pub enum Event {
    /// a request that was understood
    Request(PageId, Request),
    /// a page has gone
    Left(PageId),
}

/// The meeting place.
pub struct Hub {
    /// newest picture
    pub pictures: watch::Sender<Option<Arc<Picture>>>,
    /// greeting for new pages; sent again when it changes
    pub hello: watch::Sender<Arc<str>>,
    /// true once the console should end
    pub ended: watch::Sender<bool>,
    /// states as JSON
    pub states: broadcast::Sender<Arc<str>>,
    events: mpsc::SyncSender<Event>,
    /// pages that could take a picture now
    pub waiting: AtomicUsize,
    /// pages connected
    pub pages: AtomicUsize,
    /// requests not understood, or lost because too many came
    pub refused: AtomicU64,
    next_page: AtomicU64,
}

impl Hub {
    /// A hub, and the end of the queue for the thread of the feed.
    pub fn new() -> (Arc<Self>, mpsc::Receiver<Event>) {
        let (events, receiver) = mpsc::sync_channel(REQUESTS_KEPT);
        let hub = Self {
            pictures: watch::Sender::new(None),
            hello: watch::Sender::new("".into()),
            ended: watch::Sender::new(false),
            states: broadcast::Sender::new(STATES_KEPT),
            events,
            waiting: AtomicUsize::new(0),
            pages: AtomicUsize::new(0),
            refused: AtomicU64::new(0),
            next_page: AtomicU64::new(1),
        };
        (Arc::new(hub), receiver)
    }

    /// A number for a new page.
    pub fn page_id(&self) -> PageId {
        self.next_page.fetch_add(1, Relaxed)
    }

    /// Takes a page's message: understood ones go to the feed's thread, others are counted.
    pub fn request(&self, page: PageId, text: &str) -> Option<Request> {
        let request = serde_json::from_str::<Request>(text).ok();
        match &request {
            Some(Request::Ack { .. }) => {}
            Some(other) if self.events.try_send(Event::Request(page, other.clone())).is_ok() => {}
            _ => self.refuse(),
        }
        request
    }

    /// Counts a request that came to nothing.
    pub fn refuse(&self) {
        self.refused.fetch_add(1, Relaxed);
    }

    /// Says that a page has gone. If the queue is full its tool goes free all the same, when its hand has been still too long.
    pub fn left(&self, page: PageId) {
        let _ = self.events.try_send(Event::Left(page));
    }
}
