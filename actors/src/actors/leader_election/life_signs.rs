//! Signatures on leaders' signs of life, in a cell with certificates.
//!
//! A leader signs how long it has led. Another node passes the signed time on to a node that misses
//! the leader. The receiver relies only on the leader's signature, so a faulty member cannot make a
//! cell wait for a leader that hangs.

use std::collections::BTreeMap;
use std::sync::Arc;

use base64::Engine;
use base64::engine::general_purpose::STANDARD as BASE64;
use ecod::leadership::election::{Body, ElectionMessage, LifeSign};
use ecod::model::epoch::Epoch;
use ecod::model::names::NodeName;
use ecod::wire::Role;

use crate::transport::gossip::Member;
use crate::transport::pki::{Credentials, is_signed_by};

/// Maximum number of candidates whose certificates are kept.
const MAX_CERTIFICATES: usize = 4096;

/// Signs this node's signs of life, and verifies other leaders' signs of life.
pub(super) struct LifeSigns {
    cell: NodeName,
    credentials: Option<Arc<Credentials>>,
    /// Certificates with which other candidates have proven their identity.
    certificates: BTreeMap<NodeName, Arc<[u8]>>,
    /// The last sign of life that was signed, and its leadership.
    signed: Option<(Epoch, LifeSign)>,
}

impl LifeSigns {
    /// Without `credentials`, in a cell without certificates, signs of life are unsigned and all
    /// are accepted.
    pub(super) fn new(cell: NodeName, credentials: Option<Arc<Credentials>>) -> Self {
        Self {
            cell,
            credentials,
            certificates: BTreeMap::new(),
            signed: None,
        }
    }

    /// The node's own certificate; `None` in a cell without certificates.
    pub(super) fn credentials(&self) -> Option<&Credentials> {
        self.credentials.as_deref()
    }

    /// Stores the certificate of a node that may lead. A certificate has any number of observers,
    /// which may not.
    pub(super) fn member_up(&mut self, member: &Member) {
        let Some(certificate) = &member.certificate else {
            return;
        };
        let has_room = self.certificates.len() < MAX_CERTIFICATES
            || self.certificates.contains_key(&member.name);
        if member.role != Role::Cav && has_room {
            self.certificates
                .insert(member.name.clone(), Arc::clone(certificate));
        }
    }

    /// Removes the certificate of a node that was expelled.
    pub(super) fn remove(&mut self, name: &NodeName) {
        self.certificates.remove(name);
    }

    /// Signs the sign of life in a beat of this node.
    pub(super) fn sign(&mut self, message: &mut ElectionMessage) {
        let (Some(credentials), Some(epoch)) = (&self.credentials, &message.epoch) else {
            return;
        };
        let Body::Beat { life, .. } = &mut message.body else {
            return;
        };
        let is_signed =
            |(of, signed): &&(Epoch, LifeSign)| of == epoch && signed.led_ms == life.led_ms;
        if let Some((_, signed)) = self.signed.as_ref().filter(is_signed) {
            *life = signed.clone();
            return;
        }
        // If the system provides no random numbers, there is no signature, and other nodes do not
        // pass this sign of life on.
        life.signature = credentials
            .current()
            .sign(&life.signed_bytes(&self.cell, epoch))
            .ok()
            .map(|it| BASE64.encode(it).into());
        self.signed = Some((epoch.clone(), life.clone()));
    }

    /// True unless the message passes on a sign of life that its leader did not sign.
    pub(super) fn is_proven(&self, message: &ElectionMessage) -> bool {
        let Body::LeaderEvidence { life, .. } = &message.body else {
            return true;
        };
        if self.credentials.is_none() {
            return true;
        }
        let Some(epoch) = &message.epoch else {
            return false;
        };
        let Some(certificate) = self.certificates.get(&epoch.leader) else {
            return false;
        };
        let signature = life
            .signature
            .as_ref()
            .and_then(|text| BASE64.decode(text.as_bytes()).ok());
        signature.is_some_and(|signature| {
            is_signed_by(
                certificate,
                &life.signed_bytes(&self.cell, epoch),
                &signature,
            )
        })
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use ecod::leadership::election::Candidacy;
    use ecod::wire::SCHEMA_VERSION;

    use super::*;
    use crate::platform::clock;
    use crate::transport::pki::Authority;

    fn message(from: &'static str, body: Body) -> ElectionMessage {
        ElectionMessage {
            schema: SCHEMA_VERSION,
            from: NodeName::from_static(from),
            run: 1,
            seq: 1,
            candidacy: Candidacy {
                role: Role::Auto,
                priority: 100,
                load: 0,
                fit: true,
            },
            term: 4,
            epoch: Some(Epoch::new(4, NodeName::from_static("edge"))),
            hears_you: true,
            body,
            clock: None,
            description: None,
        }
    }

    fn member(name: &str, role: Role, credentials: &Credentials) -> Member {
        let gossip = "127.0.0.1:1".parse().unwrap();
        Member {
            name: NodeName::new(name).unwrap(),
            run: 1,
            gossip,
            broker: None,
            role,
            certificate: Some(credentials.current().certificate().into()),
        }
    }

    #[test]
    fn only_leader_sends_life_signs() {
        let directory = tempfile::tempdir().unwrap();
        let cell = NodeName::from_static("lot");
        let mut authority = Authority::init(directory.path(), &cell, clock::now()).unwrap();
        let mut credentials = |name: &'static str| {
            let name = NodeName::from_static(name);
            authority
                .issue(&name, Role::Edge, Duration::from_secs(60), clock::now())
                .unwrap();
            let files = authority.tls_of(&name);
            Arc::new(Credentials::load(&files, &name).unwrap())
        };
        let [edge, euclid] = ["edge", "euclid"].map(&mut credentials);
        let beat = |led_ms| {
            let life = LifeSign {
                led_ms,
                signature: None,
            };
            Body::Beat {
                every_ms: 50,
                round: 1,
                followers: 1,
                after: None,
                successors: Vec::new(),
                life,
            }
        };
        let life_of = |credentials: &Arc<Credentials>, led_ms| {
            let mut signs = LifeSigns::new(cell.clone(), Some(Arc::clone(credentials)));
            let mut sent = message("edge", beat(led_ms));
            signs.sign(&mut sent);
            let Body::Beat { life, .. } = sent.body else {
                panic!("a beat")
            };
            life
        };
        let mut seeker = LifeSigns::new(cell.clone(), Some(Arc::clone(&euclid)));
        let evidence = |life| {
            message(
                "gauss",
                Body::LeaderEvidence {
                    ask: 1,
                    age_ms: 0,
                    life,
                },
            )
        };
        assert!(
            !seeker.is_proven(&evidence(life_of(&edge, 500))),
            "a leader without contact so far"
        );
        seeker.member_up(&member("edge", Role::Edge, &edge));
        assert!(seeker.is_proven(&evidence(life_of(&edge, 500))));
        assert!(
            !seeker.is_proven(&evidence(life_of(&euclid, 500))),
            "signed by another"
        );
        let later = LifeSign {
            led_ms: 9000,
            ..life_of(&edge, 500)
        };
        assert!(!seeker.is_proven(&evidence(later)), "dated later");
        assert!(
            !seeker.is_proven(&evidence(LifeSign::default())),
            "unsigned"
        );
        let of_later_term = ElectionMessage {
            epoch: Some(Epoch::new(5, NodeName::from_static("edge"))),
            term: 5,
            ..evidence(life_of(&edge, 500))
        };
        assert!(!seeker.is_proven(&of_later_term), "of another leadership");
    }

    #[test]
    fn observers_displace_no_certificate() {
        let directory = tempfile::tempdir().unwrap();
        let cell = NodeName::from_static("lot");
        let mut authority = Authority::init(directory.path(), &cell, clock::now()).unwrap();
        let edge = NodeName::from_static("edge");
        authority
            .issue(&edge, Role::Edge, Duration::from_secs(60), clock::now())
            .unwrap();
        let credentials = Arc::new(Credentials::load(&authority.tls_of(&edge), &edge).unwrap());
        let mut seeker = LifeSigns::new(cell, Some(Arc::clone(&credentials)));
        for number in 0..MAX_CERTIFICATES {
            let observer = format!("mallory--{number}");
            seeker.member_up(&member(&observer, Role::Cav, &credentials));
        }
        seeker.member_up(&member("edge", Role::Edge, &credentials));
        assert_eq!(seeker.certificates.keys().collect::<Vec<_>>(), [&edge]);
    }
}
