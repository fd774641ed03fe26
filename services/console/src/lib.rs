//! The console: one page on 127.0.0.1 that shows the four views, charts and services of a run, and takes orders from the mouse.
//!
//! One plain thread (`pump`) reads the run's shared memory through a [`feed::Feed`] every few milliseconds, because iceoryx2's
//! ports may not leave their thread; one thread runs the web server. They meet in a `hub` of latest-value channels. The
//! messages are described in [`protocol`]; the page itself is built in (`page/`), loads nothing from elsewhere and needs no
//! build step.
//!
//! Invariants: the socket listens on 127.0.0.1 alone and answers only its own page; no page, slow or hostile, makes the
//! console hold more than two pictures for it; what a page says is checked before it reaches another process; a page that
//! falls silent lets go of the tool.
//!
//! Cost: no picture is encoded while no page can take one. Not here: drawing (the rendering process draws), voxels (never
//! mapped).

#![forbid(unsafe_code)]

mod assets;
pub mod breath;
mod encode;
pub mod feed;
mod hub;
mod live;
pub mod presets;
pub mod protocol;
mod pump;
pub mod rates;
mod server;

pub use live::run;

use std::{net::TcpListener, time::Duration};
use thiserror::Error;

/// Why the console ended before its time.
#[derive(Debug, Error)]
#[allow(missing_docs)] // the sentences say it
pub enum ConsoleError {
    #[error("the page cannot be served on 127.0.0.1:{port}: {source}; set `console.port = 0` in the scene to take any free port")]
    Port { port: u16, source: std::io::Error },
    #[error("the web server stopped: {0}")]
    Server(std::io::Error),
    #[error(transparent)]
    Transport(#[from] maille_transport::TransportError),
    #[error("the scene of this run cannot be read: {0}")]
    Scene(String),
    #[error(transparent)]
    Breathing(#[from] maille_breathing::BreathingError),
    #[error("the volume of this run cannot be read: {0}")]
    Store(String),
}

/// A socket on 127.0.0.1 and its port; port 0 takes any free one.
///
/// # Errors
/// When the port is taken.
pub fn listen(port: u16) -> Result<(TcpListener, u16), ConsoleError> {
    let bound = TcpListener::bind(("127.0.0.1", port)).and_then(|l| l.local_addr().map(|a| (l, a.port())));
    bound.map_err(|source| ConsoleError::Port { port, source })
}

/// Serves a feed until it says that the console should end.
///
/// # Errors
/// When the web server cannot start.
pub fn serve(feed: impl feed::Feed, listener: TcpListener, jpeg_quality: u8) -> Result<(), ConsoleError> {
    let (hub, events) = hub::Hub::new();
    let pump = pump::Pump::new(feed, std::sync::Arc::clone(&hub), events, jpeg_quality);
    let runtime = tokio::runtime::Builder::new_current_thread().enable_io().enable_time().build().map_err(ConsoleError::Server)?;
    let web = std::thread::Builder::new()
        .name("maille-web".into())
        .spawn(move || {
            let result = runtime.block_on(server::serve(listener, hub));
            runtime.shutdown_timeout(Duration::from_millis(100));
            result
        })
        .map_err(ConsoleError::Server)?;
    pump.run();
    match web.join() {
        Ok(result) => result.map_err(ConsoleError::Server),
        Err(panic) => std::panic::resume_unwind(panic),
    }
}
