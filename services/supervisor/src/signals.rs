//! SIGINT, SIGTERM, SIGHUP and SIGQUIT as a file descriptor to poll and a flag to ask.
//!
//! A signal only writes a byte and sets a number; all that follows happens in the supervisor's loop.

use signal_hook::consts::{SIGHUP, SIGINT, SIGQUIT, SIGTERM};
use std::{
    io::{self, Read as _},
    os::{
        fd::{AsFd, BorrowedFd},
        unix::net::UnixStream,
    },
    sync::{
        Arc,
        atomic::{AtomicUsize, Ordering::Relaxed},
    },
};

/// The signals that end a run.
pub struct Signals {
    woken: UnixStream,
    received: Arc<AtomicUsize>,
    registered: Vec<signal_hook::SigId>,
}

impl Signals {
    /// Takes the signals over until the value is dropped.
    pub fn register() -> io::Result<Self> {
        let (woken, wake) = UnixStream::pair()?;
        woken.set_nonblocking(true)?;
        let received = Arc::new(AtomicUsize::new(0));
        let mut registered = Vec::new();
        for signal in [SIGINT, SIGTERM, SIGHUP, SIGQUIT] {
            registered.push(signal_hook::flag::register_usize(signal, Arc::clone(&received), signal as usize)?);
            registered.push(signal_hook::low_level::pipe::register(signal, wake.try_clone()?)?);
        }
        Ok(Self { woken, received, registered })
    }

    /// Name of the last of these signals that came, if any.
    pub fn received(&self) -> Option<&'static str> {
        match self.received.load(Relaxed) as i32 {
            SIGINT => Some("SIGINT"),
            SIGTERM => Some("SIGTERM"),
            SIGHUP => Some("SIGHUP"),
            SIGQUIT => Some("SIGQUIT"),
            _ => None,
        }
    }

    /// Becomes readable when a signal comes.
    pub fn fd(&self) -> BorrowedFd<'_> {
        self.woken.as_fd()
    }

    /// Takes the bytes out, so that the next poll waits for the next signal.
    pub fn drain(&mut self) {
        let mut bytes = [0; 64];
        while matches!(self.woken.read(&mut bytes), Ok(n) if n > 0) {}
    }
}

impl Drop for Signals {
    fn drop(&mut self) {
        for &id in &self.registered {
            signal_hook::low_level::unregister(id);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rustix::event::{PollFd, PollFlags, Timespec, poll};

    #[test]
    fn a_signal_wakes_the_poll_and_says_its_name() {
        let mut signals = Signals::register().unwrap();
        assert_eq!(signals.received(), None);
        signal_hook::low_level::raise(SIGHUP).unwrap();
        let ready = |signals: &Signals| {
            let wait = Timespec { tv_sec: 0, tv_nsec: 0 };
            poll(&mut [PollFd::from_borrowed_fd(signals.fd(), PollFlags::IN)], Some(&wait)).unwrap()
        };
        assert_eq!(ready(&signals), 1);
        assert_eq!(signals.received(), Some("SIGHUP"));
        signals.drain();
        assert_eq!(ready(&signals), 0);
    }
}
