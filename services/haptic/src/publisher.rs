//! Publishing off the tick: iceoryx2's `loan`/`send` allocate 48 bytes a message and may map memory when a peer appears.
//!
//! The thread sleeps until the loop wakes it for a tool move, and at least at the scene's rate for states.

use crate::{HapticError, outbox::Outbox};
use maille_contract::{ToolMove, ToolState};
use maille_scene::Scene;
use maille_transport::{Domain, Node};
use std::{
    sync::{Arc, atomic::Ordering::Relaxed, mpsc},
    thread::{self, JoinHandle, Thread},
    time::Duration,
};

pub(crate) struct Publisher {
    outbox: Arc<Outbox>,
    thread: JoinHandle<()>,
}

impl Publisher {
    pub fn thread(&self) -> &Thread {
        self.thread.thread()
    }

    pub fn stop(self) {
        self.outbox.stop.store(true, Relaxed);
        self.thread.thread().unpark();
        // a publisher that died has nothing left to say
        let _ = self.thread.join();
    }
}

pub(crate) fn start(domain: &Domain, scene: &Scene, outbox: Arc<Outbox>, incarnation: u64) -> Result<Publisher, HapticError> {
    let (name, interval) = (domain.name().to_owned(), Duration::from_secs_f64(1.0 / scene.haptic.state_hz));
    let (ready, opened) = mpsc::channel();
    let shared = Arc::clone(&outbox);
    let body = move || {
        let ports = Domain::named(&name).and_then(|domain| {
            let node = Node::open(&domain, "haptic")?;
            Ok((node.publisher::<ToolState>()?, node.publisher::<ToolMove>()?, node))
        });
        let (states, moves, _node) = match ports {
            Ok(ports) => ports,
            Err(error) => return drop(ready.send(Err(error))),
        };
        drop(ready.send(Ok(())));
        let (mut sent_state, mut sent_move, mut next_state) = (0, 0, std::time::Instant::now());
        while !shared.stop.load(Relaxed) {
            if let Some((mut message, generation)) = shared.moves.load::<ToolMove>().filter(|(_, g)| *g != sent_move) {
                sent_move = generation;
                message.stamp.incarnation = incarnation;
                // a failed send is superseded by the next one; nobody downstream counts on each
                let _ = moves.send(&message);
            }
            let now = std::time::Instant::now();
            if now >= next_state {
                next_state = now + interval;
                if let Some((mut message, generation)) = shared.state.load::<ToolState>().filter(|(_, g)| *g != sent_state) {
                    sent_state = generation;
                    message.stamp.incarnation = incarnation;
                    let _ = states.send(&message);
                }
            }
            thread::park_timeout(next_state.saturating_duration_since(std::time::Instant::now()).max(Duration::from_micros(100)));
        }
    };
    let thread = thread::Builder::new().name("publisher".into()).spawn(body).map_err(HapticError::Thread)?;
    match opened.recv() {
        Ok(Ok(())) => Ok(Publisher { outbox, thread }),
        Ok(Err(error)) => Err(error.into()),
        Err(_) => Err(HapticError::Thread(std::io::Error::other("it ended at once"))),
    }
}
