//! Addresses of hosts that are given by name, with a deadline.
//!
//! The system's resolver knows none: beside a name server that is silent it waits for tens of seconds, and whoever waits with it can neither be
//! told to stop nor let a device go. It runs in a thread of its own; a question that is still open is not asked a second time.

use std::{
    io,
    net::{SocketAddr, ToSocketAddrs},
    sync::mpsc::{Receiver, RecvTimeoutError, channel},
    thread,
    time::Duration,
};

/// Asks for addresses, one question at a time.
#[derive(Default)]
pub(crate) struct Resolver {
    open: Option<Receiver<io::Result<SocketAddr>>>,
}

impl Resolver {
    /// The first address of `host:port`.
    ///
    /// # Errors
    /// When there is none, or no answer within `patience`: the question stays open, and the next call waits for the same answer.
    pub fn resolve(&mut self, address: &str, patience: Duration) -> io::Result<SocketAddr> {
        self.ask(patience, {
            let address = address.to_owned();
            move || {
                let none = || io::Error::new(io::ErrorKind::NotFound, format!("{address} is no address"));
                address.to_socket_addrs()?.next().ok_or_else(none)
            }
        })
    }

    fn ask(&mut self, patience: Duration, question: impl FnOnce() -> io::Result<SocketAddr> + Send + 'static) -> io::Result<SocketAddr> {
        let answer = match self.open.take() {
            Some(answer) => answer,
            None => {
                let (tell, answer) = channel();
                // nobody may wait for it any more
                thread::Builder::new().name("resolver".into()).spawn(move || drop(tell.send(question())))?;
                answer
            }
        };
        match answer.recv_timeout(patience) {
            Ok(told) => told,
            Err(RecvTimeoutError::Timeout) => {
                self.open = Some(answer);
                Err(io::Error::new(
                    io::ErrorKind::TimedOut,
                    format!("its name is not resolved yet (no answer for {} ms)", patience.as_millis()),
                ))
            }
            Err(RecvTimeoutError::Disconnected) => Err(io::Error::other("the system's resolver crashed")),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::{
        Arc,
        atomic::{AtomicU32, Ordering},
    };

    #[test]
    fn numbers_and_the_own_host_are_resolved_and_nonsense_is_not() {
        let mut resolver = Resolver::default();
        let patience = Duration::from_secs(20);
        assert_eq!(resolver.resolve("127.0.0.1:10001", patience).unwrap().to_string(), "127.0.0.1:10001");
        assert!(resolver.resolve("localhost:1", patience).unwrap().ip().is_loopback());
        assert!(resolver.resolve("no port", patience).is_err());
    }

    #[test]
    fn a_silent_name_server_costs_no_more_than_patience_and_is_asked_once() {
        let (mut resolver, asked) = (Resolver::default(), Arc::new(AtomicU32::new(0)));
        let (go, wait) = channel::<()>();
        let mut wait = Some(wait);
        let mut ask = |resolver: &mut Resolver, patience| {
            let (asked, wait) = (asked.clone(), wait.take());
            resolver.ask(patience, move || {
                asked.fetch_add(1, Ordering::Relaxed);
                let _ = wait.map(|wait| wait.recv());
                Ok(SocketAddr::from(([10, 0, 0, 7], 7)))
            })
        };
        for _ in 0..3 {
            let late = ask(&mut resolver, Duration::from_millis(5)).unwrap_err();
            assert_eq!(late.kind(), io::ErrorKind::TimedOut);
        }
        go.send(()).unwrap();
        assert_eq!(ask(&mut resolver, Duration::from_secs(20)).unwrap().to_string(), "10.0.0.7:7");
        assert_eq!(asked.load(Ordering::Relaxed), 1);
    }
}
