//! Handshakes that prove certificates, and attacks on them by a holder of the cell's key or of
//! another certificate.

use rustls::pki_types::UnixTime;

use super::*;
use crate::transport::gossip::handshake::{Attestation, Side, SignedMessage};
use crate::transport::gossip::test_authority::TestAuthority;

/// Time after which a session is answered again.
const SLOW: Duration = Duration::from_millis(250);

fn cell_key() -> CellKey {
    CellKey::new(&"07".repeat(32), &NodeName::from_static("lot-1"))
}

fn node(authority: &mut TestAuthority, name: &'static str, session: u8) -> End {
    End::with(name, session, Some(authority.identity(name, Role::Auto)))
}

fn two() -> (TestAuthority, End, End) {
    let mut authority = TestAuthority::new();
    let a = node(&mut authority, "a", 1);
    let b = node(&mut authority, "b", 2);
    (authority, a, b)
}

fn assert_received(from: &mut End, to: &mut End) {
    let frame = from.seal(&to.id.name, b"hi");
    assert_eq!(to.open(&frame, from.address, NOW), Ok(payload(from, b"hi")));
}

fn assert_both_received(a: &mut End, b: &mut End) {
    for _ in 0..3 {
        assert_received(a, b);
        assert_received(b, a);
    }
}

/// The proof of `a` to `b`.
fn proof(a: &mut End, b: &mut End) -> Vec<u8> {
    let hello = a.sessions.hello(&a.id.clone(), true);
    let challenge = answer(b.open(&hello, a.address, NOW + SLOW));
    answer(a.open(&challenge, b.address, NOW + SLOW))
}

/// An attacker with the cell's key opens a handshake's frame and seals it again.
fn reseal(
    receiver: &SessionId,
    frame: &[u8],
    change: impl FnOnce(&mut FrameHeader, &mut Vec<u8>),
) -> Vec<u8> {
    let key = cell_key();
    let mut head = FrameHeader::read(frame, key.tag()).unwrap();
    let (open, sealed) = frame.split_at(HEADER_BYTES);
    let mut body = key
        .seal(&head.sender, receiver)
        .open(head.counter, open, sealed)
        .unwrap();
    change(&mut head, &mut body);
    head.write(key.tag(), &body, &key.seal(&head.sender, receiver))
}

/// Changes the proof behind a handshake's message.
fn change_attestation(body: &mut Vec<u8>, change: impl FnOnce(&mut Attestation)) {
    let (message, rest) = decode_first::<Handshake>(body).unwrap();
    let mut attestation = decode(rest).unwrap();
    change(&mut attestation);
    *body = [encode(&message), encode(&attestation)].concat();
}

#[test]
fn certified_nodes_exchange_rights() {
    let (_authority, mut a, mut b) = two();
    introduce(&mut a, &mut b);
    assert_both_received(&mut a, &mut b);
    let frame = a.seal(&b.id.name, b"once");
    assert!(b.open(&frame, a.address, NOW).is_ok());
    assert_eq!(b.open(&frame, a.address, NOW), Err(FrameEvent::Replayed));
    let proven = b
        .sessions
        .proven(&a.id.name)
        .map(|(id, proven)| (id, proven.rights));
    assert_eq!(proven, Some((&a.id, Role::Auto.into())));
}

#[test]
fn longest_frame_fits_datagram() {
    let mut authority = TestAuthority::new();
    let names: [&'static str; 2] = ["a", "b"].map(|letter| &*letter.repeat(64).leak());
    let [mut a, mut b] = [(names[0], 1), (names[1], 2)].map(|(name, session)| {
        let mut end = node(&mut authority, name, session);
        let address = "[2001:db8:aaaa:bbbb:cccc:dddd:eeee:ffff]:65535"
            .parse()
            .unwrap();
        end.id.run = u64::MAX;
        end.id.life = 1 << 54;
        end.id.gossip = address;
        end.id.broker = Some(address);
        end
    });
    b.known = Some(KnownMember {
        run: u64::MAX,
        life: 1 << 53,
        alive: false,
    });
    let sizes = introduce(&mut a, &mut b).map(|frame| frame.len());
    println!("hello, challenge, proof, accept: {sizes:?} bytes");
    assert!(sizes.iter().all(|size| *size <= 1248), "{sizes:?}");
}

/// The former defect: a holder of the cell's key muted a link by one frame with the last counter.
#[test]
fn cell_key_alone_cannot_forge() {
    let (_authority, mut a, mut b) = two();
    introduce(&mut a, &mut b);
    let key = cell_key();
    let own = a.sessions.own;
    let other = b.sessions.own;
    let frame = a.seal(&b.id.name, b"hi");
    let (open, sealed) = frame.split_at(HEADER_BYTES);
    let head = FrameHeader::read(&frame, key.tag()).unwrap();
    assert_eq!(
        key.seal(&own, &other).open(head.counter, open, sealed),
        None,
        "read"
    );
    for counter in [u64::MAX, head.counter + 1] {
        let forged = FrameHeader { counter, ..head };
        let forged = forged.write(key.tag(), b"forged", &key.seal(&own, &other));
        assert_eq!(b.open(&forged, a.address, NOW), Err(FrameEvent::BadSeal));
    }
    assert_eq!(
        b.open(&frame, a.address, NOW),
        Ok(payload(&a, b"hi")),
        "no session was muted"
    );
}

#[test]
fn node_without_certificate_is_refused() {
    let (_authority, mut a, _) = two();
    let mut bare = End::new("b", 2);
    let hello = bare.hello();
    assert_eq!(
        a.open(&hello, bare.address, NOW),
        Err(FrameEvent::Uncertified)
    );
    let hello = a.hello();
    assert_eq!(
        bare.open(&hello, a.address, NOW),
        Err(FrameEvent::Uncertified),
        "nor one with, where none are"
    );
    assert_eq!(a.sessions.peers.len() + bare.sessions.peers.len(), 0);
}

#[test]
fn foreign_certificate_is_refused() {
    let (mut authority, mut a, mut b) = two();
    let mut strange = node(&mut TestAuthority::new(), "euclid", 3);
    let forged = proof(&mut strange, &mut b);
    assert_eq!(
        b.open(&forged, strange.address, NOW + SLOW),
        Err(FrameEvent::Untrusted)
    );
    let mut gauss = node(&mut authority, "gauss", 4);
    gauss.id.name = NodeName::from_static("edge");
    let forged = proof(&mut gauss, &mut b);
    assert_eq!(
        b.open(&forged, gauss.address, NOW + SLOW),
        Err(FrameEvent::Untrusted),
        "a session of another name"
    );
    let mut posing = End::with("edge", 5, Some(authority.identity("gauss", Role::Auto)));
    let forged = proof(&mut posing, &mut b);
    assert_eq!(
        b.open(&forged, posing.address, NOW + SLOW),
        Err(FrameEvent::Untrusted),
        "another's name"
    );
    assert_eq!(b.sessions.peers.len(), 0);
    introduce(&mut a, &mut b);
    assert_both_received(&mut a, &mut b);
}

#[test]
fn revoked_certificate_ends_session() {
    let (mut authority, mut a, mut b) = two();
    introduce(&mut a, &mut b);
    authority.revoke(&a.id.name);
    let files = authority.files(&b.id.name);
    let (expelled, greeted) = b.sessions.set_identity(TestAuthority::read(&files, "b"));
    assert_eq!((expelled, greeted), (vec![a.id.name.clone()], Vec::new()));
    let frame = a.seal(&b.id.name, b"hi");
    assert_eq!(b.open(&frame, a.address, NOW), Err(FrameEvent::BadSeal));
    let late = proof(&mut a, &mut b);
    assert_eq!(
        b.open(&late, a.address, NOW + SLOW),
        Err(FrameEvent::Untrusted)
    );
    assert_eq!(b.sessions.counters.get(FrameEvent::Expelled), 1);
}

#[test]
fn expired_certificate_ends_session() {
    let mut authority = TestAuthority::new();
    let files = authority.issue("a", Role::Auto, Duration::from_secs(60));
    let mut a = End::with("a", 1, Some(TestAuthority::read(&files, "a")));
    let mut b = node(&mut authority, "b", 2);
    introduce(&mut a, &mut b);
    let Some(prover) = &b.sessions.prover else {
        panic!("no certificates")
    };
    let mut identity = prover.identity().clone();
    assert_eq!(b.sessions.set_identity(identity.clone()).0, []);
    identity.wall = UnixTime::since_unix_epoch(Duration::from_secs(identity.wall.as_secs() + 61));
    assert_eq!(
        b.sessions.set_identity(identity).0,
        std::slice::from_ref(&a.id.name)
    );
}

#[test]
fn repeated_proof_has_no_effect() {
    let (_authority, mut a, mut b) = two();
    let [_, _, first, _] = introduce(&mut a, &mut b);
    assert_both_received(&mut a, &mut b);
    let receiver = b.sessions.own;
    let elsewhere = SocketAddr::from(([10, 0, 0, 9], 1));
    assert_eq!(b.open(&first, a.address, NOW), Err(FrameEvent::Replayed));
    assert_eq!(
        b.open(&first, elsewhere, NOW),
        Err(FrameEvent::Replayed),
        "re-addressed"
    );
    let counted_up = reseal(&receiver, &first, |head, _| head.counter += 1000);
    assert_eq!(
        b.open(&counted_up, a.address, NOW),
        Err(FrameEvent::Untrusted),
        "under a later counter"
    );
    let swapped = reseal(&receiver, &first, |head, body| {
        head.counter += 1000;
        change_attestation(body, |attestation| attestation.ephemeral = [9; 32]);
    });
    assert_eq!(
        b.open(&swapped, a.address, NOW),
        Err(FrameEvent::Untrusted),
        "with another ephemeral key"
    );
    assert_both_received(&mut a, &mut b);
}

/// A man in the middle has the cell's key and a certificate of his own.
#[test]
fn swapped_handshake_parts_are_refused() {
    let (mut authority, mut a, mut b) = two();
    let eve = node(&mut authority, "eve", 6);
    let Some(prover) = &eve.sessions.prover else {
        panic!("no certificates")
    };
    let proof = proof(&mut a, &mut b);
    let accept = answer(b.open(&proof, a.address, NOW + SLOW));
    let to_a = a.sessions.own;
    let swapped = reseal(&to_a, &accept, |_, body| {
        change_attestation(body, |attestation| {
            attestation.ephemeral = prover.draw_ephemeral().unwrap().1;
        });
    });
    assert_eq!(
        a.open(&swapped, b.address, NOW + SLOW),
        Err(FrameEvent::Untrusted)
    );
    // Eve accepts as herself in the session of b, so that b's messages would be attributed to her.
    let posing = reseal(&to_a, &accept, |head, body| {
        let (message, rest) = decode_first::<Handshake>(body).unwrap();
        let theirs: Attestation = decode(rest).unwrap();
        let Handshake::Accept {
            echo,
            mut introduction,
        } = message
        else {
            panic!("no accept")
        };
        introduction.id.name = NodeName::from_static("eve");
        let message = encode(&Handshake::Accept { echo, introduction });
        let head = head.bytes(cell_key().tag());
        let signed = SignedMessage {
            side: Side::Accepter,
            head,
            receiver: to_a,
            context: &[0; 32],
            message: &message,
        };
        let (attestation, _) = prover.attest(&signed, theirs.ephemeral).unwrap();
        *body = [message, encode(&attestation)].concat();
    });
    assert!(a.open(&posing, b.address, NOW + SLOW).is_err());
    assert!(
        matches!(
            a.open(&accept, b.address, NOW + SLOW),
            Ok(FrameContent::Introduced { .. })
        ),
        "the honest one counts"
    );
    assert_both_received(&mut a, &mut b);
}

/// The holder of one certificate invents any number of observers.
#[test]
fn one_certificate_cannot_fill_table() {
    let mut authority = TestAuthority::new();
    let mut b = node(&mut authority, "b", 200);
    b.sessions.peers = PeerTable::new(256);
    let files = authority.issue("gauss", Role::Cav, Duration::from_secs(60));
    let mut refused = 0;
    for n in 0..40 {
        let name: &'static str = format!("gauss--{n}").leak();
        let mut observer = End::with(name, n, Some(TestAuthority::read(&files, name)));
        let proof = proof(&mut observer, &mut b);
        let opened = b.open(&proof, observer.address, NOW + SLOW);
        refused += usize::from(opened == Err(FrameEvent::TooManyPeers));
    }
    assert_eq!((b.sessions.peers.len(), refused), (16, 24));
    introduce(&mut node(&mut authority, "a", 100), &mut b);
}

/// All frames that a node sent are returned to it.
#[test]
fn reflected_frames_are_refused() {
    let (_authority, mut a, mut b) = two();
    let [hello, challenge, proof, accept] = introduce(&mut a, &mut b);
    let frame = a.seal(&b.id.name, b"hi");
    assert_eq!(a.open(&proof, b.address, NOW), Err(FrameEvent::Replayed));
    for sent in [&challenge, &accept] {
        assert_eq!(b.open(sent, a.address, NOW), Err(FrameEvent::Replayed));
    }
    assert_eq!(a.open(&hello, b.address, NOW), Ok(FrameContent::Nothing));
    assert_eq!(a.open(&frame, b.address, NOW), Err(FrameEvent::Replayed));
}

/// Both sides start a handshake at once. In any order, and if one accept is lost, both can open
/// each other's frames.
#[test]
fn simultaneous_handshakes_open_one_session() {
    for (a_hears, b_hears) in [(true, true), (true, false), (false, true)] {
        let (_authority, mut a, mut b) = two();
        let to_b = proof(&mut a, &mut b);
        let to_a = proof(&mut b, &mut a);
        let at = NOW + SLOW;
        let to_a_back = answer(b.open(&to_b, a.address, at));
        let to_b_back = answer(a.open(&to_a, b.address, at));
        assert!(!a_hears || a.open(&to_a_back, b.address, at).is_ok());
        assert!(!b_hears || b.open(&to_b_back, a.address, at).is_ok());
        for _ in 0..2 {
            let frame = a.seal(&b.id.name, b"hi");
            let _ = b.open(&frame, a.address, at);
            let frame = b.seal(&a.id.name, b"hi");
            let _ = a.open(&frame, b.address, at);
        }
        assert_both_received(&mut a, &mut b);
    }
}

/// A holder of the cell's key forges challenges for nearly a second, from invented addresses and
/// from a node's address.
fn forge_challenges(to: &mut End, in_place_of: SocketAddr) {
    let key = cell_key();
    let receiver = to.sessions.own;
    for number in 1..=2000_u64 {
        let head = FrameHeader {
            version: Version::Certificate,
            kind: FrameKind::Handshake,
            sender: (u128::from(number) << 64).to_be_bytes(),
            counter: number,
        };
        let challenge = Handshake::Challenge {
            cookie: Default::default(),
            name: NodeName::from_static("mallory"),
        };
        let forged = head.write(
            key.tag(),
            &encode(&challenge),
            &key.seal(&head.sender, &receiver),
        );
        let from = if number % 2 == 0 {
            in_place_of
        } else {
            SocketAddr::from(([10, 1, (number % 256) as u8, 1], 1))
        };
        let _ = to.open(&forged, from, NOW + Duration::from_micros(450 * number));
    }
}

/// True if a node that has restarted is admitted again.
fn meets_again(a: &mut End, restarted: &mut End, at: Timestamp) -> bool {
    let challenge = answer(restarted.open(&a.hello(), a.address, at));
    let Ok(FrameContent::Answer(proof)) = a.open(&challenge, restarted.address, at) else {
        return false;
    };
    let accept = answer(restarted.open(&proof, a.address, at));
    matches!(
        a.open(&accept, restarted.address, at),
        Ok(FrameContent::Introduced { .. })
    )
}

#[test]
fn forged_challenges_delay_no_session() {
    let mut authority = TestAuthority::new();
    let [mut a, mut b, mut c] =
        [("a", 1), ("b", 2), ("c", 3)].map(|(name, id)| node(&mut authority, name, id));
    introduce(&mut a, &mut b);
    introduce(&mut a, &mut c);
    forge_challenges(&mut a, b.address);
    // The last of them came a millisecond ago.
    let later = NOW + Duration::from_millis(901);
    let mut restarted = |name, id| {
        let mut end = node(&mut authority, name, id);
        end.id.run = 2;
        end
    };
    assert!(
        meets_again(&mut a, &mut restarted("c", 3), later),
        "another node's places are its own"
    );
    assert_both_received(&mut a, &mut b);
    let mut b = restarted("b", 2);
    assert!(
        meets_again(&mut a, &mut b, later + Duration::from_secs(1)),
        "the attack is over"
    );
}
