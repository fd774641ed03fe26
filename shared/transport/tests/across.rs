//! Messages and frames between two nodes of a domain, in one process and in two.

use bytemuck::Zeroable;
use maille_contract::{FrameHeader, ToolMove, ToolState, probe::Ping};
use maille_transport::{Domain, Node};
use std::time::Duration;

/// One test, since a process takes iceoryx2's configuration once.
#[test]
fn messages_and_frames_arrive_in_order_and_old_ones_are_dropped() {
    let domain = Domain::fresh().unwrap();
    let keeper = Node::open(&domain, "supervisor").unwrap();
    let services = keeper.create_services().unwrap();
    let (a, b) = (Node::open(&domain, "haptic").unwrap(), Node::open(&domain, "deformation").unwrap());

    let (publisher, subscriber) = (a.publisher::<ToolMove>().unwrap(), b.subscriber::<ToolMove>().unwrap());
    assert!(subscriber.next().is_none());
    let message = |n: u64| {
        let mut m = ToolMove::zeroed();
        m.stamp.sequence = n;
        m
    };
    for n in 0..3 {
        publisher.send(&message(n)).unwrap();
    }
    assert_eq!((subscriber.next().unwrap().stamp.sequence, subscriber.latest().unwrap().stamp.sequence), (0, 2));
    // nobody reads: the publisher goes on, the newest stay
    for n in 0..1000 {
        publisher.send(&message(n)).unwrap();
    }
    assert_eq!(subscriber.latest().unwrap().stamp.sequence, 999);
    assert!(b.subscriber::<ToolState>().unwrap().next().is_none());

    let (frames, viewer) = (a.frame_publisher(4096).unwrap(), b.frame_subscriber().unwrap());
    for n in 0..20u8 {
        let header = FrameHeader { epoch: u64::from(n), ..FrameHeader::default() };
        frames
            .send(3000, |pixels| {
                pixels.fill(n);
                header
            })
            .unwrap();
        if n % 7 == 0 {
            let frame = viewer.latest().unwrap();
            assert_eq!((frame.header().epoch, frame.bytes().len(), frame.bytes()[2999]), (u64::from(n), 3000, n));
        }
    }
    // an event wakes a blocked listener once, however often it was notified; a topic of one's own works like the others
    let event = keeper.create_event("maille/test/v1").unwrap();
    let (notifier, listener) = (a.notifier("maille/test/v1").unwrap(), b.listener("maille/test/v1").unwrap());
    assert!(!listener.wait(Duration::from_millis(1)).unwrap(), "nobody has notified");
    std::thread::scope(|s| {
        let waker = s.spawn(|| {
            std::thread::sleep(Duration::from_millis(5));
            a.notifier("maille/test/v1").unwrap().notify().unwrap();
        });
        assert!(listener.wait(Duration::from_secs(10)).unwrap());
        waker.join().unwrap();
    });
    for _ in 0..1000 {
        notifier.notify().unwrap();
    }
    assert!(listener.wait(Duration::from_secs(10)).unwrap());
    assert!(!listener.wait(Duration::from_millis(1)).unwrap(), "they have merged");
    let topic = keeper.create_topic::<Ping>().unwrap();
    let (pings, heard) = (a.publisher::<Ping>().unwrap(), b.subscriber::<Ping>().unwrap());
    pings.send(&Ping { sequence: 3, ..Ping::zeroed() }).unwrap();
    assert_eq!(heard.next().unwrap().sequence, 3);

    drop((notifier, listener, event, pings, heard, topic));
    drop((publisher, subscriber, frames, viewer, a, b, services, keeper));
    assert!(domain.remove().unwrap() > 0);
    assert!(!Domain::list().iter().any(|d| d.name() == domain.name()));
}
