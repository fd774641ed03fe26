//! Messages and frames between two nodes of a domain, in one process and in two.

use bytemuck::Zeroable;
use maille_contract::{FrameHeader, ToolMove, ToolState};
use maille_transport::{Domain, Node};

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
    drop((publisher, subscriber, frames, viewer, a, b, services, keeper));
    assert!(domain.remove().unwrap() > 0);
    assert!(!Domain::list().iter().any(|d| d.name() == domain.name()));
}
