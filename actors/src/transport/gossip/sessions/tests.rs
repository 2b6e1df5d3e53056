use std::net::Ipv4Addr;

use ecod::wire::Role;
use proptest::prelude::*;

use super::*;

const NOW: Timestamp = Timestamp(1_700_000_000_000_000);

struct End {
    sessions: Sessions,
    id: NodeId,
    address: SocketAddr,
    known: Option<KnownMember>,
}

impl End {
    fn new(name: &'static str, session: u8) -> Self {
        let address = SocketAddr::from((Ipv4Addr::new(10, 0, 0, session), 1));
        let name = NodeName::from_static(name);
        let key = CellKey::new(&"07".repeat(32), &NodeName::from_static("lot-1"));
        let id = NodeId { name, run: 1, life: 1, role: Role::Auto, gossip: address, broker: None };
        let sessions = Sessions::new(key, [session; 16], &[session; 32], 4, Arc::default(), NOW);
        Self { sessions, id, address, known: None }
    }

    fn open(&mut self, frame: &[u8], from: SocketAddr, now: Timestamp) -> Result<FrameContent, FrameEvent> {
        let known = self.known;
        self.sessions.open(frame, &Arrival { from, now, own: &self.id, known: &|_| known })
    }
}

fn answer(opened: Result<FrameContent, FrameEvent>) -> Vec<u8> {
    match opened {
        Ok(FrameContent::Answer(frame) | FrameContent::Met { answer: Some(frame), .. }) => frame,
        other => panic!("no answer but {other:?}"),
    }
}

/// The four frames of a handshake.
fn introduce(a: &mut End, b: &mut End) -> [Vec<u8>; 4] {
    let hello = a.sessions.hello(&a.id.clone());
    let challenge = answer(b.open(&hello, a.address, NOW));
    let proof = answer(a.open(&challenge, b.address, NOW));
    let accept = answer(b.open(&proof, a.address, NOW));
    assert!(matches!(a.open(&accept, b.address, NOW), Ok(FrameContent::Met { answer: None, speaks: true, .. })));
    [hello, challenge, proof, accept]
}

#[test]
fn introduced_nodes_understand_each_other_once() {
    let (mut a, mut b) = (End::new("a", 1), End::new("b", 2));
    introduce(&mut a, &mut b);
    let (to, frame) = a.sessions.seal(&b.id.name, FrameKind::Payload, b"hi").unwrap();
    assert_eq!(to, b.address);
    let heard = FrameContent::Payload { from: a.id.name.clone(), body: b"hi".to_vec() };
    assert_eq!(b.open(&frame, a.address, NOW), Ok(heard));
    assert_eq!(b.open(&frame, a.address, NOW), Err(FrameEvent::Replayed));
    assert_eq!(a.open(&frame, b.address, NOW), Err(FrameEvent::Replayed), "sent back");
    assert_eq!(End::new("c", 3).open(&frame, a.address, NOW), Err(FrameEvent::BadSeal));
    assert_eq!(End::new("b", 4).open(&frame, a.address, NOW), Err(FrameEvent::BadSeal), "restarted");
}

#[test]
fn recorded_handshakes_admit_nobody() {
    let (mut a, mut b) = (End::new("a", 1), End::new("b", 2));
    let [hello, challenge, proof, accept] = introduce(&mut a, &mut b);
    for frame in [&proof, &challenge, &accept] {
        for end in [&mut a, &mut b] {
            assert!(end.open(frame, SocketAddr::from(([10, 0, 0, 9], 1)), NOW).is_err());
        }
    }
    let mut restarted = End::new("b", 3);
    assert!(matches!(restarted.open(&hello, a.address, NOW), Ok(FrameContent::Answer(_))), "at most a challenge");
    assert_eq!(restarted.open(&proof, a.address, NOW), Err(FrameEvent::BadSeal));
    assert!(restarted.sessions.peers.is_empty());
}

#[test]
fn a_proof_from_elsewhere_or_too_late_is_none() {
    let (mut a, mut b) = (End::new("a", 1), End::new("b", 2));
    let hello = a.sessions.hello(&a.id.clone());
    let challenge = answer(b.open(&hello, a.address, NOW));
    let proof = answer(a.open(&challenge, b.address, NOW));
    let elsewhere = SocketAddr::from(([10, 0, 0, 9], 1));
    assert_eq!(b.open(&proof, elsewhere, NOW), Err(FrameEvent::Replayed));
    assert_eq!(b.open(&proof, a.address, NOW + Duration::from_secs(5)), Err(FrameEvent::Replayed));
    assert!(b.sessions.peers.is_empty());
}

#[test]
fn frames_of_strangers_cause_a_greeting_and_count() {
    let (mut a, mut b) = (End::new("a", 1), End::new("b", 2));
    introduce(&mut a, &mut b);
    let (_, frame) = a.sessions.seal(&b.id.name, FrameKind::Gossip, b"news").unwrap();
    b.sessions.peers.clear();
    assert_eq!(b.open(&frame, a.address, NOW), Ok(FrameContent::Stranger));
    assert_eq!(b.sessions.counters.get(FrameEvent::Unestablished), 1);
}

#[test]
fn the_table_is_bounded_and_only_the_silent_give_way() {
    let mut b = End::new("b", 100);
    for (session, name) in (1..=4).zip(["v", "w", "x", "y"]) {
        introduce(&mut End::new(name, session), &mut b);
    }
    let mut late = End::new("z", 5);
    let hello = late.sessions.hello(&late.id.clone());
    let mut try_at = |now| {
        let challenge = answer(b.open(&hello, late.address, now));
        let proof = answer(late.open(&challenge, b.address, now));
        b.open(&proof, late.address, now).map(drop)
    };
    assert_eq!(try_at(NOW), Err(FrameEvent::TooManyPeers));
    assert_eq!(try_at(NOW + Duration::from_secs(11)), Ok(()));
    assert_eq!(b.sessions.peers.len(), 4);
}

#[test]
fn junk_is_told_apart() {
    let mut a = End::new("a", 1);
    let hello = End::new("b", 2).sessions.hello(&a.id.clone());
    let from = SocketAddr::from(([10, 0, 0, 9], 1));
    let mut elsewhere = hello.clone();
    elsewhere[4] ^= 1;
    assert_eq!(a.open(&elsewhere, from, NOW), Err(FrameEvent::WrongCell));
    assert_eq!(a.open(&hello[..40], from, NOW), Err(FrameEvent::Malformed));
    assert_eq!(a.open(&[hello.clone(), vec![0; 2000]].concat(), from, NOW), Err(FrameEvent::Oversized));
    assert_eq!(a.open(b"GET / HTTP/1.1", from, NOW), Err(FrameEvent::Malformed));
}

proptest! {
    /// Bodies that a holder of the key got wrong.
    #[test]
    fn sealed_junk_changes_nothing(kind in 1u8..=4, body in prop::collection::vec(any::<u8>(), 0..200)) {
        let (mut a, mut b) = (End::new("a", 1), End::new("b", 2));
        introduce(&mut a, &mut b);
        let kind = [FrameKind::Hello, FrameKind::Handshake, FrameKind::Gossip, FrameKind::Payload][usize::from(kind) - 1];
        let head = a.sessions.head(kind);
        let seal = if kind == FrameKind::Hello { &a.sessions.everybody } else { &a.sessions.peers[&[2; 16]].to };
        let frame = head.write(a.sessions.key.tag(), &body, seal);
        let _ = b.open(&frame, a.address, NOW);
        prop_assert_eq!(b.sessions.peers.len(), 1);
    }
}
