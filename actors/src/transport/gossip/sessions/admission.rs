//! Steps of the handshake, and the admission of the node that completes it.

use std::net::SocketAddr;

use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;

use super::peers::PeerSession;
use super::{Arrival, FrameContent, KnownMember, Sessions, decode, decode_first, encode};
use crate::transport::gossip::counters::FrameEvent;
use crate::transport::gossip::frame::{
    FrameHeader, FrameKind, Handshake, Hello, Introduction, NameClaim,
};
use crate::transport::gossip::handshake::{
    Attestation, KeyAgreement, PendingKey, Proven, Side, SignedMessage, Transcript, agree,
};
use crate::transport::gossip::key::{Cookie, SessionId};
use crate::transport::gossip::node_id::NodeId;
use crate::transport::gossip::replay_window::ReplayWindow;
use crate::transport::gossip::session_keys::{KeyRing, KeySet};

/// A node that has proven its name in a handshake, with the resulting keys.
struct Admission {
    proven: Option<Proven>,
    keys: Option<KeySet>,
    is_proof: bool,
}

impl Sessions {
    /// Answers a greeting with a challenge. A living member at its last address needs no handshake,
    /// unless it requests one.
    pub(super) fn handle_hello(
        &mut self,
        head: &FrameHeader,
        hello: &Hello,
        wants_session: bool,
        arrival: &Arrival<'_>,
    ) -> Result<FrameContent, FrameEvent> {
        let is_accepted = self.peers.speaker_id(&hello.name) == Some(head.sender);
        let is_there = self.peers.get(&head.sender).is_some() && !self.has_moved(head, arrival);
        let is_alive = || (arrival.known)(&hello.name).is_some_and(|known| known.alive);
        if !wants_session && is_accepted && is_there && is_alive() {
            return Ok(FrameContent::Nothing);
        }
        if !self
            .challenges
            .allow(&head.sender, arrival.from, arrival.now)
        {
            return Err(FrameEvent::Throttled);
        }
        let cookie = self
            .cookies
            .issue(&head.sender, arrival.from, slot(arrival.now));
        let challenge = Handshake::Challenge {
            cookie,
            name: arrival.own.name.clone(),
        };
        Ok(FrameContent::Answer(
            self.handshake(&head.sender, &challenge),
        ))
    }

    /// Processes a step of the handshake.
    pub(super) fn handle_handshake(
        &mut self,
        head: &FrameHeader,
        body: &[u8],
        arrival: &Arrival<'_>,
    ) -> Result<FrameContent, FrameEvent> {
        let (message, attestation) = decode_first::<Handshake>(body)?;
        let signed = body
            .get(..body.len() - attestation.len())
            .unwrap_or_default();
        let answer = message.answer();
        if let Some((echo, introduction)) = answer {
            self.check_freshness(&head.sender, echo, introduction, arrival)?;
        }
        if !self.prove_certificates() {
            let stated = answer.map(|(_, introduction)| introduction.id.gossip);
            self.peers
                .accept_counter(head, arrival.from, stated, arrival.now)?;
        }
        let has_moved = self.has_moved(head, arrival);
        match message {
            Handshake::Challenge { cookie, name } => {
                if !self.proofs.allow(&head.sender, arrival.from, arrival.now) {
                    return Err(FrameEvent::Throttled);
                }
                let claim = match (arrival.known)(&name) {
                    Some(KnownMember {
                        life, alive: false, ..
                    }) => NameClaim::After(life),
                    Some(_) if self.has_other_address(head, &name, arrival.from) => {
                        NameClaim::Taken
                    }
                    _ => NameClaim::Free,
                };
                let introduction = Introduction {
                    id: arrival.own.clone(),
                    seen_at: arrival.from,
                    claim,
                };
                let own_cookie = self
                    .cookies
                    .issue(&head.sender, arrival.from, slot(arrival.now));
                let proof = Handshake::Proof {
                    echo: cookie,
                    cookie: own_cookie,
                    introduction,
                };
                if self.prove_certificates() {
                    let challenge = PendingKey {
                        session: head.sender,
                        address: arrival.from,
                        cookie,
                    };
                    let frame = self.prove(&proof, challenge, &name, arrival.now);
                    return Ok(frame.map_or(FrameContent::Nothing, FrameContent::Answer));
                }
                Ok(FrameContent::Answer(self.handshake(&head.sender, &proof)))
            }
            Handshake::Proof {
                cookie,
                introduction,
                ..
            } => {
                if !self.prove_certificates() {
                    let is_namesake = introduction.id.name == arrival.own.name;
                    let admission = Admission {
                        proven: None,
                        keys: None,
                        is_proof: true,
                    };
                    let claim = if is_namesake {
                        NameClaim::Taken
                    } else {
                        self.admit(head, &introduction.id, admission, arrival)?
                    };
                    let answer = Introduction {
                        id: arrival.own.clone(),
                        seen_at: arrival.from,
                        claim,
                    };
                    let accept = Handshake::Accept {
                        echo: cookie,
                        introduction: answer,
                    };
                    let answer = Some(self.handshake(&head.sender, &accept));
                    if is_namesake {
                        return Ok(FrameContent::Namesake {
                            id: introduction.id,
                            answer,
                        });
                    }
                    return Ok(FrameContent::Introduced {
                        introduction,
                        answer,
                        speaks: claim != NameClaim::Taken,
                        has_moved,
                    });
                }
                let attestation = decode(attestation)?;
                self.on_proof(head, signed, &attestation, introduction, &cookie, arrival)
            }
            Handshake::Accept { introduction, .. } => {
                let admission = if self.prove_certificates() {
                    let attestation = decode(attestation)?;
                    self.on_accept(head, signed, &attestation, &introduction, arrival)?
                } else {
                    Admission {
                        proven: None,
                        keys: None,
                        is_proof: false,
                    }
                };
                if introduction.id.name == arrival.own.name {
                    return Ok(FrameContent::Namesake {
                        id: introduction.id,
                        answer: None,
                    });
                }
                let claim = self.admit(head, &introduction.id, admission, arrival)?;
                Ok(FrameContent::Introduced {
                    introduction,
                    answer: None,
                    speaks: claim != NameClaim::Taken,
                    has_moved,
                })
            }
        }
    }

    /// Checks that a cookie was issued to this session at this address a moment ago, and that the
    /// introduction is plausible.
    fn check_freshness(
        &self,
        session: &SessionId,
        echo: &Cookie,
        introduction: &Introduction,
        arrival: &Arrival<'_>,
    ) -> Result<(), FrameEvent> {
        let slot = slot(arrival.now);
        let issued = |slot| self.cookies.issue(session, arrival.from, slot) == *echo;
        if !issued(slot) && !issued(slot.wrapping_sub(1)) {
            return Err(FrameEvent::Replayed);
        }
        if introduction.id.has_plausible_life() {
            Ok(())
        } else {
            Err(FrameEvent::Malformed)
        }
    }

    /// A proof of this node's certificate to a challenger; `None` while the one before may still be
    /// answered.
    fn prove(
        &mut self,
        proof: &Handshake,
        challenge: PendingKey,
        accepter: &NodeName,
        now: Timestamp,
    ) -> Option<Vec<u8>> {
        let wants_proof = self.prover.as_mut()?.wants_proof(&challenge, now);
        let head = self.head(FrameKind::Handshake);
        let message = encode(proof);
        let prover = self.prover.as_mut().filter(|_| wants_proof)?;
        let (private, public) = prover.draw_ephemeral()?;
        let signed = SignedMessage {
            side: Side::Prover,
            head: head.bytes(self.key.tag()),
            receiver: challenge.session,
            context: accepter.as_str().as_bytes(),
            message: &message,
        };
        let (attestation, transcript) = prover.attest(&signed, public)?;
        prover.expect_accept(challenge, private, transcript, accepter.clone(), now);
        Some(self.write_handshake(&head, &challenge.session, &message, &attestation))
    }

    /// Verifies a proof, and accepts it with this node's own. `message` is the encoded proof, to
    /// which the attestation belongs.
    fn on_proof(
        &mut self,
        head: &FrameHeader,
        message: &[u8],
        attestation: &Attestation,
        introduction: Introduction,
        echo: &Cookie,
        arrival: &Arrival<'_>,
    ) -> Result<FrameContent, FrameEvent> {
        if self
            .peers
            .get(&head.sender)
            .is_some_and(|peer| head.counter <= peer.proof_counter)
        {
            return Err(FrameEvent::Replayed);
        }
        if !self.verifications.allow_host(arrival.from, arrival.now) {
            return Err(FrameEvent::Throttled);
        }
        let Some(prover) = &mut self.prover else {
            return Err(FrameEvent::Uncertified);
        };
        let signed = SignedMessage {
            side: Side::Prover,
            head: head.bytes(self.key.tag()),
            receiver: self.own,
            context: arrival.own.name.as_str().as_bytes(),
            message,
        };
        let (proven, transcript) = prover.check(
            &signed,
            attestation,
            &introduction.id.name,
            &head.sender,
            arrival.from,
        )?;
        let Some((private, public)) = prover.draw_ephemeral() else {
            return Ok(FrameContent::Nothing);
        };
        let is_namesake = introduction.id.name == arrival.own.name;
        // Created before the keys are available: the answer's claim depends on the gossip and the
        // table only.
        let claim = if is_namesake {
            NameClaim::Taken
        } else {
            self.claim(head, &introduction.id, arrival)
        };
        let answer = Introduction {
            id: arrival.own.clone(),
            seen_at: arrival.from,
            claim,
        };
        let accept = encode(&Handshake::Accept {
            echo: *echo,
            introduction: answer,
        });
        let own_head = self.head(FrameKind::Handshake);
        let own_head_bytes = own_head.bytes(self.key.tag());
        let Some(prover) = &mut self.prover else {
            return Err(FrameEvent::Uncertified);
        };
        let signed = accepted(own_head_bytes, head.sender, &transcript, &accept);
        let Some((own_attestation, transcript)) = prover.attest(&signed, public) else {
            return Ok(FrameContent::Nothing);
        };
        if is_namesake {
            let answer =
                Some(self.write_handshake(&own_head, &head.sender, &accept, &own_attestation));
            return Ok(FrameContent::Namesake {
                id: introduction.id,
                answer,
            });
        }
        let agreement = KeyAgreement {
            cell: &self.key,
            private,
            theirs: &attestation.ephemeral,
            transcript: &transcript,
            own: &self.own,
            other: &head.sender,
        };
        let keys = agree(agreement, false)?;
        let admission = Admission {
            proven: Some(proven),
            keys: Some(keys),
            is_proof: true,
        };
        let has_moved = self.has_moved(head, arrival);
        let claim = self.admit(head, &introduction.id, admission, arrival)?;
        let answer = self.write_handshake(&own_head, &head.sender, &accept, &own_attestation);
        Ok(FrameContent::Introduced {
            introduction,
            answer: Some(answer),
            speaks: claim != NameClaim::Taken,
            has_moved,
        })
    }

    /// Verifies the accept of a proof that this node sent. `message` is the encoded accept, to
    /// which the attestation belongs.
    fn on_accept(
        &mut self,
        head: &FrameHeader,
        message: &[u8],
        attestation: &Attestation,
        introduction: &Introduction,
        arrival: &Arrival<'_>,
    ) -> Result<Admission, FrameEvent> {
        if !self.verifications.allow_host(arrival.from, arrival.now) {
            return Err(FrameEvent::Throttled);
        }
        let Some(prover) = &mut self.prover else {
            return Err(FrameEvent::Uncertified);
        };
        let name = &introduction.id.name;
        let head_bytes = head.bytes(self.key.tag());
        let mut refusal = FrameEvent::Replayed;
        for (pending, proof, accepter) in prover.pending(&head.sender, arrival.from) {
            if accepter != *name {
                continue;
            }
            let signed = accepted(head_bytes, self.own, &proof, message);
            match prover.check(&signed, attestation, name, &head.sender, arrival.from) {
                Ok((proven, transcript)) => {
                    let Some(private) = prover.take_pending(&pending) else {
                        continue;
                    };
                    let agreement = KeyAgreement {
                        cell: &self.key,
                        private,
                        theirs: &attestation.ephemeral,
                        transcript: &transcript,
                        own: &self.own,
                        other: &head.sender,
                    };
                    let keys = agree(agreement, true)?;
                    return Ok(Admission {
                        proven: Some(proven),
                        keys: Some(keys),
                        is_proof: false,
                    });
                }
                Err(reason) => refusal = reason,
            }
        }
        Err(refusal)
    }

    /// Other claims to the name of a node that has just proven itself. A run that is alive
    /// elsewhere keeps its name; a run at the same address must have ended.
    fn claim(&self, head: &FrameHeader, id: &NodeId, arrival: &Arrival<'_>) -> NameClaim {
        let is_speaker = self.peers.speaker_id(&id.name) == Some(head.sender);
        let is_elsewhere = self
            .peers
            .speaker(&id.name)
            .is_none_or(|speaker| speaker.address != arrival.from);
        match (arrival.known)(&id.name) {
            Some(KnownMember {
                run,
                life,
                alive: true,
            }) if !is_speaker && (life > id.life || run != id.run && is_elsewhere) => {
                NameClaim::Taken
            }
            Some(KnownMember {
                life, alive: false, ..
            }) if life >= id.life => NameClaim::After(life),
            _ => NameClaim::Free,
        }
    }

    /// True if the sender's session is at another address so far.
    fn has_moved(&self, head: &FrameHeader, arrival: &Arrival<'_>) -> bool {
        self.peers
            .get(&head.sender)
            .is_some_and(|peer| peer.address != arrival.from)
    }

    /// True if another session at another address is accepted for a name.
    fn has_other_address(&self, head: &FrameHeader, name: &NodeName, from: SocketAddr) -> bool {
        self.peers
            .speaker_id(name)
            .is_some_and(|speaker| speaker != head.sender)
            && self
                .peers
                .speaker(name)
                .is_some_and(|speaker| speaker.address != from)
    }

    /// Stores a session that has just proven its reachability, and decides whether it is accepted
    /// for its name.
    fn admit(
        &mut self,
        head: &FrameHeader,
        id: &NodeId,
        admission: Admission,
        arrival: &Arrival<'_>,
    ) -> Result<NameClaim, FrameEvent> {
        let address = arrival.from;
        let now = arrival.now;
        let claim = self.claim(head, id, arrival);
        let Admission {
            proven,
            keys,
            is_proof,
        } = admission;
        if let Some(peer) = self.peers.get_mut(&head.sender) {
            peer.address = address;
            match keys {
                Some(keys) => peer.keys.add(keys),
                None => peer.keys.skip_to(head.counter),
            }
            if proven.is_some() {
                peer.id = id.clone();
                peer.proven = proven;
            }
            peer.record_received(now);
            if is_proof {
                peer.proof_counter = head.counter;
            }
        } else {
            let keys = keys.unwrap_or_else(|| KeySet {
                to: self.key.seal(&self.own, &head.sender),
                from: self.key.seal(&head.sender, &self.own),
                window: ReplayWindow::after(head.counter),
                is_confirmed: true,
            });
            let peer = PeerSession {
                id: id.clone(),
                proven,
                address,
                keys: KeyRing::new(keys),
                frames: PeerSession::frames(now),
                proof_counter: if is_proof { head.counter } else { 0 },
                received_at: now,
                unanswered_since: None,
                superseded: None,
            };
            self.peers.insert(head.sender, peer)?;
        }
        for throttle in [
            &mut self.challenges,
            &mut self.proofs,
            &mut self.verifications,
        ] {
            throttle.admit(address, now);
        }
        self.peers
            .settle(head.sender, &id.name, claim != NameClaim::Taken, now);
        Ok(claim)
    }

    fn handshake(&mut self, to: &SessionId, message: &Handshake) -> Vec<u8> {
        let head = self.head(FrameKind::Handshake);
        head.write(
            self.key.tag(),
            &encode(message),
            &self.key.seal(&self.own, to),
        )
    }

    fn write_handshake(
        &self,
        head: &FrameHeader,
        to: &SessionId,
        message: &[u8],
        attestation: &Attestation,
    ) -> Vec<u8> {
        let body = [message, &encode(attestation)].concat();
        head.write(self.key.tag(), &body, &self.key.seal(&self.own, to))
    }
}

/// The accepter's message as it is signed.
fn accepted<'a>(
    head: [u8; super::HEADER_BYTES],
    receiver: SessionId,
    proof: &'a Transcript,
    message: &'a [u8],
) -> SignedMessage<'a> {
    SignedMessage {
        side: Side::Accepter,
        head,
        receiver,
        context: proof,
        message,
    }
}

/// Time slot of a cookie, which is valid in its slot and the next.
fn slot(now: Timestamp) -> u64 {
    now.micros() / 2_000_000
}
