//! Events: one process wakes another that is blocked. What happened is read elsewhere; an event only says "look".
//!
//! A notification costs the caller a system call of some microseconds (DESIGN D7), so the 1 kHz tick sends none. Nothing is
//! queued without bound: notifications that nobody has taken yet merge into one.

use crate::{
    Node, TransportError,
    messages::{Ice, NODES, ice, retry, service_name},
};
use iceoryx2::{
    port::{listener::Listener as IceListener, notifier::Notifier as IceNotifier},
    service::port_factory::event::PortFactory,
};
use std::time::Duration;

/// Notifiers and listeners that an event takes.
const PORTS: usize = 4;

/// An event, held open by whoever made it.
pub struct Event {
    _service: PortFactory<Ice>,
}

/// Wakes listeners.
pub struct Notifier {
    port: IceNotifier<Ice>,
    event: String,
}

/// Waits to be woken.
pub struct Listener {
    port: IceListener<Ice>,
    event: String,
}

impl Node {
    /// Makes an event; it lives while the returned value does.
    ///
    /// # Errors
    /// When iceoryx2 refuses it.
    pub fn create_event(&self, event: &str) -> Result<Event, TransportError> {
        let name = service_name(event)?;
        let builder = self.node.service_builder(&name).event().max_nodes(NODES).max_notifiers(PORTS).max_listeners(PORTS);
        Ok(Event { _service: ice(|| format!("create the event {event}"), builder.create())? })
    }

    fn open_event(&self, event: &str) -> Result<PortFactory<Ice>, TransportError> {
        let name = service_name(event)?;
        retry(event, || self.node.service_builder(&name).event().open())
    }

    /// A notifier of an event.
    ///
    /// # Errors
    /// When the event does not exist or has no place.
    pub fn notifier(&self, event: &str) -> Result<Notifier, TransportError> {
        let service = self.open_event(event)?;
        Ok(Notifier { port: retry(event, || service.notifier_builder().create())?, event: event.into() })
    }

    /// A listener of an event.
    ///
    /// # Errors
    /// When the event does not exist or has no place.
    pub fn listener(&self, event: &str) -> Result<Listener, TransportError> {
        let service = self.open_event(event)?;
        Ok(Listener { port: retry(event, || service.listener_builder().create())?, event: event.into() })
    }
}

impl Notifier {
    /// Wakes all listeners; never waits for one.
    ///
    /// # Errors
    /// When iceoryx2 refuses.
    pub fn notify(&self) -> Result<(), TransportError> {
        ice(|| format!("notify {}", self.event), self.port.notify()).map(drop)
    }
}

impl Listener {
    /// Blocks until a notification comes or the time is over; says whether one came.
    ///
    /// # Errors
    /// When iceoryx2 refuses.
    pub fn wait(&self, at_most: Duration) -> Result<bool, TransportError> {
        let mut came = false;
        ice(|| format!("wait for {}", self.event), self.port.timed_wait(|_| came = true, at_most))?;
        Ok(came)
    }
}
