//! Proof of certificates in the handshake: transcripts, signatures, and the resulting keys.
//!
//! The prover signs with its proof, the accepter with its accept. The transcript of each contains
//! both sessions, both cookies and its own ephemeral key; the accepter's transcript also includes
//! the prover's. The frame keys depend on the accepter's transcript. Two nodes with the same keys
//! therefore agree on everything in it, and on each other's certificate.

use std::cmp::Reverse;
use std::collections::{BTreeMap, HashMap};
use std::net::{IpAddr, SocketAddr};
use std::sync::Arc;
use std::time::Duration;

use ecod::diagnostics::TroubleKind;
use ecod::leadership::Rights;
use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ring::agreement::{self, EphemeralPrivateKey, UnparsedPublicKey, X25519};
use ring::digest;
use ring::rand::SystemRandom;
use rustls::pki_types::UnixTime;
use serde::{Deserialize, Serialize};

use super::counters::FrameEvent;
use super::frame::HEADER_BYTES;
use super::key::{CellKey, Cookie, SessionId, SessionNonce, session_of};
use super::notices::{GossipNotice, Notices};
use super::replay_window::ReplayWindow;
use super::session_keys::KeySet;
use crate::platform::throttle::host_network;
use crate::transport::pki::{CertificateSubject, Distrust, LoadedCredentials, is_signed_by};

/// Certificates of this node, and the time at which other nodes' certificates are verified.
#[derive(Clone)]
pub(crate) struct Identity {
    pub(crate) credentials: Arc<LoadedCredentials>,
    /// This machine's wall clock.
    pub(crate) wall: UnixTime,
}

/// The proof of a certificate, behind a [`Handshake`](super::frame::Handshake) in the same frame.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Attestation {
    /// Public X25519 key for this handshake.
    pub(crate) ephemeral: [u8; 32],
    /// With the name, the preimage of the sender's session, so that a session cannot be used under
    /// another name.
    pub(crate) nonce: SessionNonce,
    /// The sender's certificate in DER.
    pub(crate) certificate: Vec<u8>,
    /// Its owner's signature of the transcript.
    pub(crate) signature: Vec<u8>,
}

/// Hash of all that one side signs.
pub(crate) type Transcript = [u8; 32];

/// Side of a handshake. Its label is in the signed text, so that no signature can be returned to
/// its maker.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Side {
    Prover,
    Accepter,
}

/// A message of a handshake as it is signed.
pub(crate) struct SignedMessage<'a> {
    pub(crate) side: Side,
    /// Head of its frame, with the sender's session and counter.
    pub(crate) head: [u8; HEADER_BYTES],
    pub(crate) receiver: SessionId,
    /// The prover's transcript for an accepter; the accepter's name for a prover.
    pub(crate) context: &'a [u8],
    pub(crate) message: &'a [u8],
}

/// The owner of a verified certificate.
#[derive(Debug, Clone)]
pub(crate) struct Proven {
    /// The node that the certificate names; the session may be an observer's.
    pub(crate) holder: NodeName,
    pub(crate) certificate: Arc<[u8]>,
    pub(crate) expires: Timestamp,
    pub(crate) rights: Rights,
}

/// This node's side of handshakes in a cell with certificates.
pub(crate) struct Prover {
    identity: Identity,
    nonce: SessionNonce,
    random: SystemRandom,
    pending: HashMap<PendingKey, PendingProof>,
    notices: Notices,
}

/// The challenge that a proof answers. The cookie is part of the key, so that a forged challenge
/// does not replace an honest one's proof.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(crate) struct PendingKey {
    /// The challenger's session.
    pub(crate) session: SessionId,
    /// The challenger's address.
    pub(crate) address: SocketAddr,
    pub(crate) cookie: Cookie,
}

/// A proof that was sent and not yet accepted.
pub(crate) struct PendingProof {
    since: Timestamp,
    private: EphemeralPrivateKey,
    transcript: Transcript,
    /// Name of the challenger.
    pub(crate) accepter: NodeName,
}

impl Prover {
    pub(crate) fn new(identity: Identity, nonce: SessionNonce) -> Self {
        Self {
            identity,
            nonce,
            random: SystemRandom::new(),
            pending: HashMap::new(),
            notices: Notices::default(),
        }
    }

    /// Replaces the certificates and the time; returns true if the certificates have changed.
    pub(crate) fn set_identity(&mut self, identity: Identity) -> bool {
        let has_changed = !Arc::ptr_eq(&self.identity.credentials, &identity.credentials);
        self.identity = identity;
        has_changed
    }

    #[cfg(test)]
    pub(crate) fn identity(&self) -> &Identity {
        &self.identity
    }

    /// The node's certificate in DER.
    pub(crate) fn certificate(&self) -> &[u8] {
        self.identity.credentials.certificate()
    }

    /// True if a previously verified certificate has expired in the meantime.
    pub(crate) fn has_expired(&self, proven: &Proven) -> bool {
        proven.expires.micros() / 1_000_000 < self.identity.wall.as_secs()
    }

    /// Verifies that a node's certificate proves its name.
    pub(crate) fn verify(
        &mut self,
        name: &NodeName,
        certificate: &[u8],
        from: SocketAddr,
    ) -> Option<Proven> {
        let checked = self
            .identity
            .credentials
            .verify_node(certificate, self.identity.wall);
        let refusal = match checked {
            Ok(subject) if subject.may_act_as(name.as_str()) => {
                return Some(proven(&subject, name, certificate));
            }
            Ok(subject) => format!("its certificate is for {}", subject.name()),
            Err(Distrust::Untrusted(error)) => error.to_string(),
            Err(Distrust::Invalid(error)) => error.to_string(),
        };
        self.refuse(name, from, &refusal);
        None
    }

    /// A key pair for one handshake; `None` if the system provides no random numbers.
    pub(crate) fn draw_ephemeral(&self) -> Option<(EphemeralPrivateKey, [u8; 32])> {
        let private = EphemeralPrivateKey::generate(&X25519, &self.random).ok()?;
        let public = private
            .compute_public_key()
            .ok()?
            .as_ref()
            .try_into()
            .ok()?;
        Some((private, public))
    }

    /// This node's proof for a message, and the transcript of it.
    pub(crate) fn attest(
        &self,
        signed: &SignedMessage<'_>,
        ephemeral: [u8; 32],
    ) -> Option<(Attestation, Transcript)> {
        let nonce = self.nonce;
        let certificate = self.certificate().to_vec();
        let mut attestation = Attestation {
            ephemeral,
            nonce,
            certificate,
            signature: Vec::new(),
        };
        let transcript = signed.transcript(&attestation);
        attestation.signature = self
            .identity
            .credentials
            .sign(&signed.side.statement(&transcript))
            .ok()?;
        Some((attestation, transcript))
    }

    /// Verifies another node's proof of its name for a message.
    pub(crate) fn check(
        &mut self,
        signed: &SignedMessage<'_>,
        attestation: &Attestation,
        name: &NodeName,
        session: &SessionId,
        from: SocketAddr,
    ) -> Result<(Proven, Transcript), FrameEvent> {
        if session_of(name, &attestation.nonce) != *session {
            return Err(FrameEvent::Untrusted);
        }
        let transcript = signed.transcript(attestation);
        let statement = signed.side.statement(&transcript);
        if !is_signed_by(&attestation.certificate, &statement, &attestation.signature) {
            return Err(FrameEvent::Untrusted);
        }
        let proven = self
            .verify(name, &attestation.certificate, from)
            .ok_or(FrameEvent::Untrusted)?;
        Ok((proven, transcript))
    }

    /// True if a challenge needs an answer: its proof is not already in transit.
    pub(crate) fn wants_proof(&mut self, key: &PendingKey, now: Timestamp) -> bool {
        self.pending
            .retain(|_, proof| now.since(proof.since) < PROOF_TIMEOUT);
        let repeated = |proof: &PendingProof| now.since(proof.since) >= PROOF_RETRY;
        self.pending.get(key).is_none_or(repeated)
    }

    /// Stores a proof that is sent. If all places are taken, the oldest proof of the host with most
    /// proofs is dropped, so that forged challenges take no other host's place.
    pub(crate) fn expect_accept(
        &mut self,
        key: PendingKey,
        private: EphemeralPrivateKey,
        transcript: Transcript,
        accepter: NodeName,
        now: Timestamp,
    ) {
        self.pending.insert(
            key,
            PendingProof {
                since: now,
                private,
                transcript,
                accepter,
            },
        );
        if self.pending.len() > MAX_PENDING_PROOFS {
            let mut counts: BTreeMap<IpAddr, usize> = BTreeMap::new();
            self.pending
                .keys()
                .for_each(|key| *counts.entry(host_of(key)).or_default() += 1);
            let most = self
                .pending
                .iter()
                .max_by_key(|(key, proof)| (counts.get(&host_of(key)), Reverse(proof.since)))
                .map(|(key, _)| *key);
            most.and_then(|key| self.pending.remove(&key));
        }
    }

    /// Proofs to a session at an address that wait for an accept.
    pub(crate) fn pending(
        &self,
        session: &SessionId,
        address: SocketAddr,
    ) -> Vec<(PendingKey, Transcript, NodeName)> {
        let to = self
            .pending
            .iter()
            .filter(|(key, _)| key.session == *session && key.address == address);
        to.map(|(key, proof)| (*key, proof.transcript, proof.accepter.clone()))
            .collect()
    }

    /// The ephemeral key of an accepted proof. Other proofs to the session are dropped.
    pub(crate) fn take_pending(&mut self, key: &PendingKey) -> Option<EphemeralPrivateKey> {
        let proof = self.pending.remove(key);
        self.pending.retain(|other, _| other.session != key.session);
        proof.map(|proof| proof.private)
    }

    /// Records that a node is not admitted.
    pub(crate) fn refuse(&mut self, name: &NodeName, from: SocketAddr, cause: &str) {
        self.notices.add(
            name,
            TroubleKind::NotAdmitted,
            format!("not admitted from {}: {cause}", from.ip()),
        );
    }

    /// Nodes that were not admitted since the last call.
    pub(crate) fn take_notices(&mut self) -> Vec<GossipNotice> {
        self.notices.take()
    }
}

impl Side {
    /// The text that is signed.
    fn statement(self, transcript: &Transcript) -> Vec<u8> {
        [self.label(), transcript].concat()
    }

    /// No TLS signature begins like this, so that the key can serve both.
    fn label(self) -> &'static [u8] {
        match self {
            Self::Prover => b"ecod membership 2 proof\0",
            Self::Accepter => b"ecod membership 2 accept\0",
        }
    }
}

impl SignedMessage<'_> {
    /// Hash of the message and of everything that it is bound to, each part with its length.
    pub(super) fn transcript(&self, attestation: &Attestation) -> Transcript {
        let Attestation {
            ephemeral,
            nonce,
            certificate,
            signature: _,
        } = attestation;
        let mut hash = digest::Context::new(&digest::SHA256);
        let parts: [&[u8]; 8] = [
            self.side.label(),
            &self.head,
            &self.receiver,
            self.context,
            self.message,
            ephemeral,
            nonce,
            certificate,
        ];
        for part in parts {
            hash.update(&(part.len() as u64).to_be_bytes());
            hash.update(part);
        }
        hash.finish().as_ref().try_into().unwrap_or_default()
    }
}

/// Inputs of the derivation of a handshake's keys.
pub(crate) struct KeyAgreement<'a> {
    pub(crate) cell: &'a CellKey,
    /// This node's ephemeral key.
    pub(crate) private: EphemeralPrivateKey,
    /// The other node's public ephemeral key.
    pub(crate) theirs: &'a [u8; 32],
    /// The accepter's transcript.
    pub(crate) transcript: &'a Transcript,
    /// This node's session.
    pub(crate) own: &'a SessionId,
    /// The other node's session.
    pub(crate) other: &'a SessionId,
}

/// The keys of a handshake: a function of the cell's key, the ephemeral keys and the accepter's
/// transcript.
pub(crate) fn agree(agreement: KeyAgreement<'_>, is_confirmed: bool) -> Result<KeySet, FrameEvent> {
    let KeyAgreement {
        cell,
        private,
        theirs,
        transcript,
        own,
        other,
    } = agreement;
    let theirs = UnparsedPublicKey::new(&X25519, theirs);
    let agreed = agreement::agree_ephemeral(private, &theirs, |secret| {
        let session = cell.session(secret, transcript);
        (session.seal(own, other), session.seal(other, own))
    });
    let (to, from) = agreed.map_err(|_| FrameEvent::Untrusted)?;
    Ok(KeySet {
        to,
        from,
        window: ReplayWindow::after(0),
        is_confirmed,
    })
}

fn host_of(key: &PendingKey) -> IpAddr {
    host_network(key.address.ip())
}

fn proven(subject: &CertificateSubject, name: &NodeName, certificate: &[u8]) -> Proven {
    Proven {
        holder: subject.name().clone(),
        certificate: certificate.into(),
        expires: subject.expires(),
        rights: subject.rights_of(name),
    }
}

/// Time for which an accept is waited for.
const PROOF_TIMEOUT: Duration = Duration::from_secs(1);

/// Time after which a challenge that comes again is answered with another proof.
const PROOF_RETRY: Duration = Duration::from_millis(200);

/// Maximum proofs that wait for an accept.
const MAX_PENDING_PROOFS: usize = 512;
