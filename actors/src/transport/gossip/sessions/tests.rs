use std::net::Ipv4Addr;

use ecod::wire::Role;
use proptest::prelude::*;

use super::*;
use crate::transport::gossip::frame::Handshake;
use crate::transport::gossip::handshake::Identity;

mod certificates;

const NOW: Timestamp = Timestamp(1_700_000_000_000_000);

struct End {
    sessions: Sessions,
    id: NodeId,
    address: SocketAddr,
    known: Option<KnownMember>,
}

impl End {
    fn new(name: &'static str, session: u8) -> Self {
        Self::with(name, session, None)
    }

    fn with(name: &'static str, session: u8, identity: Option<Identity>) -> Self {
        Self::of_cell("lot-1", "07", name, session, identity)
    }

    fn of_cell(
        cell: &'static str,
        key: &str,
        name: &'static str,
        session: u8,
        identity: Option<Identity>,
    ) -> Self {
        let address = SocketAddr::from((Ipv4Addr::new(10, 0, 0, session), 1));
        let name = NodeName::from_static(name);
        let cell = NodeName::from_static(cell);
        let key = CellKey::new(&key.repeat(32), &cell);
        let id = NodeId {
            name,
            run: 1,
            life: 1,
            role: Role::Auto,
            gossip: address,
            broker: None,
        };
        let sessions = Sessions::new(
            SessionsSetup {
                cell,
                key,
                name: &id.name,
                nonce: [session; 16],
                identity,
                secret: &[session; 32],
                max_peers: 4,
                counters: Arc::default(),
            },
            NOW,
        );
        Self {
            sessions,
            id,
            address,
            known: None,
        }
    }

    fn hello(&mut self) -> Vec<u8> {
        self.sessions.hello(&self.id.clone(), false)
    }

    /// A frame with the word for the node of a name.
    fn seal(&mut self, to: &NodeName, word: &[u8]) -> Vec<u8> {
        self.sessions
            .seal(to, FrameKind::Payload, word, NOW)
            .unwrap()
            .1
    }

    fn open(
        &mut self,
        frame: &[u8],
        from: SocketAddr,
        now: Timestamp,
    ) -> Result<FrameContent, FrameEvent> {
        let known = self.known;
        self.sessions.open(
            frame,
            &Arrival {
                from,
                now,
                own: &self.id,
                is_alone: known.is_none(),
                known: &|_| known,
            },
        )
    }
}

fn payload(from: &End, body: &[u8]) -> FrameContent {
    let rights = from
        .sessions
        .prover
        .as_ref()
        .map_or(Rights::ALL, |_| Role::Auto.into());
    FrameContent::Payload {
        from: from.id.name.clone(),
        rights,
        body: body.to_vec(),
    }
}

fn answer(opened: Result<FrameContent, FrameEvent>) -> Vec<u8> {
    match opened {
        Ok(
            FrameContent::Answer(frame)
            | FrameContent::Introduced {
                answer: Some(frame),
                ..
            },
        ) => frame,
        other => panic!("no answer but {other:?}"),
    }
}

/// The four frames of a handshake.
fn introduce(a: &mut End, b: &mut End) -> [Vec<u8>; 4] {
    let hello = a.hello();
    let challenge = answer(b.open(&hello, a.address, NOW));
    let proof = answer(a.open(&challenge, b.address, NOW));
    let accept = answer(b.open(&proof, a.address, NOW));
    assert!(matches!(
        a.open(&accept, b.address, NOW),
        Ok(FrameContent::Introduced {
            answer: None,
            speaks: true,
            ..
        })
    ));
    [hello, challenge, proof, accept]
}

#[test]
fn handshake_opens_session_once() {
    let mut a = End::new("a", 1);
    let mut b = End::new("b", 2);
    introduce(&mut a, &mut b);
    let (to, frame) = a
        .sessions
        .seal(&b.id.name, FrameKind::Payload, b"hi", NOW)
        .unwrap();
    assert_eq!(to, b.address);
    let expected = payload(&a, b"hi");
    assert_eq!(b.open(&frame, a.address, NOW), Ok(expected));
    assert_eq!(b.open(&frame, a.address, NOW), Err(FrameEvent::Replayed));
    assert_eq!(
        a.open(&frame, b.address, NOW),
        Err(FrameEvent::Replayed),
        "sent back"
    );
    assert_eq!(
        End::new("c", 3).open(&frame, a.address, NOW),
        Err(FrameEvent::BadSeal)
    );
    assert_eq!(
        End::new("b", 4).open(&frame, a.address, NOW),
        Err(FrameEvent::BadSeal),
        "restarted"
    );
}

/// A holder of the cell's key makes a frame in the name of a session that it saw.
fn forge(key: &CellKey, sender: &SessionId, receiver: &SessionId, counter: u64) -> Vec<u8> {
    let head = FrameHeader {
        version: Version::Key,
        kind: FrameKind::Payload,
        sender: *sender,
        counter,
    };
    head.write(key.tag(), b"forged", &key.seal(sender, receiver))
}

#[test]
fn huge_counter_blocks_no_frames() {
    let mut a = End::new("a", 1);
    let mut b = End::new("b", 2);
    introduce(&mut a, &mut b);
    for counter in [u64::MAX, u64::MAX - 1, 1 << 53, 1 << 22] {
        let frame = forge(&a.sessions.key, &[1; 16], &[2; 16], counter);
        assert_eq!(
            b.open(&frame, a.address, NOW),
            Ok(FrameContent::Stranger),
            "{counter}"
        );
    }
    assert_eq!(b.sessions.counters.get(FrameEvent::CounterJump), 4);
    let frame = a.seal(&b.id.name, b"hi");
    let expected = payload(&a, b"hi");
    assert_eq!(b.open(&frame, a.address, NOW), Ok(expected));
}

#[test]
fn live_session_resists_takeover() {
    let mut a = End::new("a", 1);
    let mut b = End::new("b", 2);
    introduce(&mut a, &mut b);
    let mut thief = End::new("a", 1);
    thief.address = SocketAddr::from(([10, 0, 0, 9], 1));
    thief.sessions.counter = u64::MAX - 100;
    let mut take_over = |b: &mut End, now| {
        let hello = thief.hello();
        let challenge = answer(b.open(&hello, thief.address, now));
        let proof = answer(thief.open(&challenge, b.address, now));
        b.open(&proof, thief.address, now)
    };
    assert_eq!(take_over(&mut b, NOW), Err(FrameEvent::Replayed));
    let frame = a.seal(&b.id.name, b"hi");
    let expected = payload(&a, b"hi");
    assert_eq!(b.open(&frame, a.address, NOW), Ok(expected));
    let mut mover = End::new("a", 1);
    mover.address = SocketAddr::from(([10, 0, 0, 8], 1));
    mover.id.gossip = mover.address;
    mover.sessions.counter = u64::MAX - 100;
    let hello = mover.hello();
    let soon = NOW + Duration::from_millis(100);
    let challenge = answer(b.open(&hello, mover.address, soon));
    let proof = answer(mover.open(&challenge, b.address, soon));
    assert_eq!(
        b.open(&proof, mover.address, soon),
        Err(FrameEvent::CounterJump)
    );
    let later = NOW + Duration::from_secs(1);
    assert!(
        matches!(
            take_over(&mut b, later),
            Ok(FrameContent::Introduced { .. })
        ),
        "a node that has moved is met again"
    );
}

#[test]
fn flooding_member_is_muted() {
    let mut a = End::new("a", 1);
    let mut b = End::new("b", 2);
    introduce(&mut a, &mut b);
    let mut taken_in_a_second = |second: u64| {
        let mut is_taken = |n: u64| {
            let frame = a.seal(&b.id.name, b"?");
            let now = NOW + Duration::from_micros(1_000_000 * second + 100 * n);
            b.open(&frame, a.address, now).is_ok()
        };
        (0..10_000).filter(|n| is_taken(*n)).count()
    };
    assert!(taken_in_a_second(0) <= 1500, "a burst");
    assert!((450..=550).contains(&taken_in_a_second(1)));
}

#[test]
fn recorded_handshakes_admit_nobody() {
    let mut a = End::new("a", 1);
    let mut b = End::new("b", 2);
    let [hello, challenge, proof, accept] = introduce(&mut a, &mut b);
    for frame in [&proof, &challenge, &accept] {
        for end in [&mut a, &mut b] {
            assert!(
                end.open(frame, SocketAddr::from(([10, 0, 0, 9], 1)), NOW)
                    .is_err()
            );
        }
    }
    let mut restarted = End::new("b", 3);
    assert!(
        matches!(
            restarted.open(&hello, a.address, NOW),
            Ok(FrameContent::Answer(_))
        ),
        "at most a challenge"
    );
    assert_eq!(
        restarted.open(&proof, a.address, NOW),
        Err(FrameEvent::BadSeal)
    );
    assert!(restarted.sessions.peers.len() == 0);
}

#[test]
fn late_or_foreign_proof_is_refused() {
    let mut a = End::new("a", 1);
    let mut b = End::new("b", 2);
    let hello = a.hello();
    let challenge = answer(b.open(&hello, a.address, NOW));
    let proof = answer(a.open(&challenge, b.address, NOW));
    let elsewhere = SocketAddr::from(([10, 0, 0, 9], 1));
    assert_eq!(b.open(&proof, elsewhere, NOW), Err(FrameEvent::Replayed));
    assert_eq!(
        b.open(&proof, a.address, NOW + Duration::from_secs(5)),
        Err(FrameEvent::Replayed)
    );
    assert!(b.sessions.peers.len() == 0);
}

#[test]
fn stranger_frames_trigger_counted_greeting() {
    let mut a = End::new("a", 1);
    let mut b = End::new("b", 2);
    introduce(&mut a, &mut b);
    let frame = a.seal(&b.id.name, b"news");
    b.sessions.peers.clear();
    assert_eq!(b.open(&frame, a.address, NOW), Ok(FrameContent::Stranger));
    assert_eq!(b.sessions.counters.get(FrameEvent::Unestablished), 1);
}

#[test]
fn only_silent_peers_are_evicted() {
    let mut b = End::new("b", 100);
    for (session, name) in (1..=4).zip(["v", "w", "x", "y"]) {
        introduce(&mut End::new(name, session), &mut b);
    }
    let mut late = End::new("z", 5);
    let hello = late.hello();
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
    let hello = End::new("b", 2).hello();
    let from = SocketAddr::from(([10, 0, 0, 9], 1));
    let mut elsewhere = hello.clone();
    elsewhere[4] ^= 1;
    assert_eq!(a.open(&elsewhere, from, NOW), Err(FrameEvent::WrongCell));
    assert_eq!(a.open(&hello[..40], from, NOW), Err(FrameEvent::Malformed));
    assert_eq!(
        a.open(&[hello.clone(), vec![0; 2000]].concat(), from, NOW),
        Err(FrameEvent::Oversized)
    );
    assert_eq!(
        a.open(b"GET / HTTP/1.1", from, NOW),
        Err(FrameEvent::Malformed)
    );
}

proptest! {
    /// Bodies that a holder of the key encoded incorrectly.
    #[test]
    fn sealed_junk_changes_nothing(kind in 1u8..=4, body in prop::collection::vec(any::<u8>(), 0..200)) {
        let mut a = End::new("a", 1);
        let mut b = End::new("b", 2);
        introduce(&mut a, &mut b);
        let kind = [FrameKind::Hello, FrameKind::Handshake, FrameKind::Gossip, FrameKind::Payload][usize::from(kind) - 1];
        let head = a.sessions.head(kind);
        let seal = if kind == FrameKind::Hello { &BROADCAST } else { &[2; 16] };
        let seal = a.sessions.key.seal(&[1; 16], seal);
        let frame = head.write(a.sessions.key.tag(), &body, &seal);
        let _ = b.open(&frame, a.address, NOW);
        prop_assert_eq!(b.sessions.peers.len(), 1);
    }
}

/// Misconfigured nodes are reported by their address: a node with another key, and at a node that is
/// alone also a node of another cell.
#[test]
fn other_key_and_cell_reported() {
    let notices_of = |cell: &'static str, key: &str, is_alone: bool| {
        let mut node = End::of_cell("lot-1", "07", "euclid", 1, None);
        node.known = (!is_alone).then_some(KnownMember {
            run: 1,
            life: 1,
            alive: true,
        });
        let mut stranger = End::of_cell(cell, key, "gauss", 7, None);
        let greeting = stranger.hello();
        let from = stranger.address;
        assert!(node.open(&greeting, from, NOW).is_err());
        let notices = node.sessions.take_notices();
        notices
            .into_iter()
            .map(|notice| (notice.kind, notice.cause))
            .collect::<Vec<_>>()
    };
    assert_eq!(
        notices_of("lot-1", "08", false),
        [(
            TroubleKind::WrongKey,
            "received a datagram of cell lot-1 with another key or none from 10.0.0.7".into()
        )]
    );
    let finds_nobody = "received a datagram of another cell from 10.0.0.7; this node is in lot-1 and finds no other node";
    assert_eq!(
        notices_of("lott-1", "07", true),
        [(TroubleKind::OtherCell, finds_nobody.into())]
    );
    assert_eq!(notices_of("lott-1", "07", false), [], "a neighbour");
}
