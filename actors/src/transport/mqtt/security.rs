//! Protection of links by TLS, and of payloads by signatures.

use std::path::PathBuf;
use std::sync::Arc;

use chrono::DateTime;
use ecod::leadership::BrokerAddress;
use ecod::leadership::round_filter::SignatureState;
use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ring::hmac;
use tokio::sync::watch;

use super::config::MqttConfig;
use super::round_signature;
use crate::platform::clock;
use crate::transport::gossip::{KeyError, Member, MembershipConfig, payload_key};
use crate::transport::pki::{
    BrokerIdentity, BrokerTrust, CertificateSubject, Credentials, CredentialsError, TlsConfig,
    external_broker, is_signed_by,
};

/// Protection of links and payloads; by default they are unprotected.
#[derive(Debug, Clone, Default)]
pub struct Security {
    /// The node's certificates, for the brokers of the cell.
    pub credentials: Option<Arc<Credentials>>,
    external: Option<ExternalBroker>,
    pub(crate) signing: Option<SigningKey>,
    /// The other nodes, with the certificates that they have proven.
    members: Option<watch::Receiver<Vec<Member>>>,
}

/// A broker outside the cell. Without `ca` it is reached in plaintext.
#[derive(Debug, Clone)]
struct ExternalBroker {
    address: BrokerAddress,
    /// The key of the configuration that names the CA, and the file.
    ca: Option<(&'static str, PathBuf)>,
}

/// An error in the configured protection.
#[derive(Debug, thiserror::Error)]
pub enum SecurityError {
    /// The certificates cannot be used.
    #[error(transparent)]
    Credentials(#[from] CredentialsError),
    /// The cell's key, which signs payloads, cannot be used.
    #[error("key `mqtt.sign`: {0}")]
    Key(#[from] KeyError),
}

impl Security {
    /// Reads the certificates of the node that `tls` names, and the key of the cell.
    ///
    /// # Errors
    /// Returns a [`SecurityError`] that names the file.
    pub fn load(
        tls: Option<(&TlsConfig, &NodeName)>,
        mqtt: &MqttConfig,
        membership: &MembershipConfig,
        cell: &NodeName,
    ) -> Result<Self, SecurityError> {
        let credentials = tls
            .map(|(files, name)| Credentials::load(files, name))
            .transpose()?
            .map(Arc::new);
        let external = mqtt.broker.clone().map(|address| ExternalBroker {
            address,
            ca: mqtt.ca.clone().map(|ca| ("mqtt.ca", ca)),
        });
        let signing = mqtt
            .sign
            .then(|| payload_key(membership, cell))
            .transpose()?;
        let security = Self {
            credentials,
            external,
            signing: signing.map(SigningKey),
            members: None,
        };
        if let Some(external) = &security.external {
            security.tls(&external.address)?;
        }
        Ok(security)
    }

    /// The protection of the connection to the region's broker, with the node's own certificate.
    ///
    /// # Errors
    /// Returns an error if the file of the CA cannot be used.
    pub fn of_uplink(
        &self,
        broker: BrokerAddress,
        ca: Option<PathBuf>,
    ) -> Result<Self, CredentialsError> {
        let external = ExternalBroker {
            address: broker,
            ca: ca.map(|ca| ("uplink.ca", ca)),
        };
        let broker = external.address.clone();
        let security = Self {
            credentials: self.credentials.clone(),
            external: Some(external),
            ..Self::default()
        };
        security.tls(&broker)?;
        Ok(security)
    }

    /// The same protection for a node with a list of members: it verifies their signatures on
    /// rounds.
    pub fn with_members(self, members: watch::Receiver<Vec<Member>>) -> Self {
        Self {
            members: Some(members),
            ..self
        }
    }

    /// TLS for one connection to a broker; `None` for plaintext.
    ///
    /// # Errors
    /// Returns an error if the credentials have become unusable.
    pub fn tls(&self, broker: &BrokerAddress) -> Result<Option<BrokerTrust>, CredentialsError> {
        match self
            .external
            .as_ref()
            .filter(|external| external.address == *broker)
        {
            Some(ExternalBroker {
                ca: Some((key, ca)),
                ..
            }) => {
                let current = self
                    .credentials
                    .as_ref()
                    .map(|credentials| credentials.current());
                external_broker(key, ca, current.as_deref()).map(Some)
            }
            Some(ExternalBroker { ca: None, .. }) => Ok(None),
            None => Ok(self.credentials.as_ref().map(BrokerTrust::of_cell)),
        }
    }

    /// The reason for which this machine's clock makes every connection by certificate fail, and
    /// the remedy. Such connections are retried, and succeed once the clock is set.
    pub fn clock_fault(&self) -> Option<String> {
        let credentials = self.credentials.as_ref()?.current();
        let wall = clock::wall();
        let begins = credentials.identity.begins();
        let expires = credentials.identity.expires();
        let date = |time: Timestamp| {
            let date = i64::try_from(time.micros())
                .ok()
                .and_then(DateTime::from_timestamp_micros);
            date.map_or_else(
                || time.to_string(),
                |date| date.format("%Y-%m-%dT%H:%MZ").to_string(),
            )
        };
        (wall < begins || wall > expires).then(|| {
            let wall = date(wall);
            let begins = date(begins);
            let expires = date(expires);
            format!(
                "this machine's clock reads {wall}, and the node's certificate is valid from {begins} to {expires}: set the \
                 clock, such as by `timedatectl set-ntp true`, or give it a new certificate by `ecod-node pki issue`"
            )
        })
    }

    /// True if this node or the broker has a certificate that ends later than the connection's.
    pub(crate) fn has_renewed(&self, connection: &BrokerIdentity) -> bool {
        let own = self.credentials.as_ref().map(|own| own.current());
        if own.is_some_and(|own| connection.ends_before(&own)) {
            return true;
        }
        let (Some(members), Some(broker)) = (&self.members, connection.broker()) else {
            return false;
        };
        let members = members.borrow();
        let proven = members.iter().find(|member| member.name == *broker.name());
        proven
            .and_then(|member| member.certificate.as_ref())
            .and_then(|certificate| CertificateSubject::of(certificate).ok())
            .is_some_and(|proven| broker.expires() < proven.expires())
    }

    /// The payload as sent on a topic: in a signed envelope where the cell signs.
    pub fn seal(&self, topic: &str, payload: Vec<u8>) -> Vec<u8> {
        match &self.signing {
            Some(key) => key.sign(topic, &payload),
            None => payload,
        }
    }

    /// A round with this node's signature, if the node has certificates.
    pub(crate) fn sign_round(&self, topic: &str, payload: Vec<u8>) -> Vec<u8> {
        let Some(credentials) = &self.credentials else {
            return payload;
        };
        let sign = |signed: &[u8]| {
            credentials
                .current()
                .sign(&round_signature::statement(topic.as_bytes(), signed))
                .ok()
        };
        round_signature::append(&payload, sign).unwrap_or(payload)
    }

    /// State of the signature under a round.
    pub(crate) fn check_round(
        &self,
        aggregator: Option<&NodeName>,
        topic: &[u8],
        payload: &[u8],
    ) -> SignatureState {
        let Some(members) = self.members.as_ref().filter(|_| self.credentials.is_some()) else {
            return SignatureState::Unverifiable;
        };
        let certificate = members
            .borrow()
            .iter()
            .find(|member| Some(&member.name) == aggregator)
            .and_then(|member| member.certificate.clone());
        let is_valid = certificate
            .zip(round_signature::split(payload))
            .is_some_and(|(certificate, (signed, signature))| {
                is_signed_by(
                    &certificate,
                    &round_signature::statement(topic, signed),
                    &signature,
                )
            });
        if is_valid {
            SignatureState::Valid
        } else {
            SignatureState::Invalid
        }
    }

    /// True if arbitrary bytes do not verify, and a signed payload does. Only built for the fuzz
    /// targets.
    #[cfg(fuzzing)]
    pub fn rejects_forgery(&self, topic: &str, bytes: &[u8]) -> bool {
        let Some(key) = &self.signing else {
            return false;
        };
        key.verify(topic.as_bytes(), bytes).is_none()
            && key.verify(topic.as_bytes(), &key.sign(topic, bytes)) == Some(bytes)
    }

    /// Bytes that a signature adds to a payload.
    pub fn envelope_bytes(&self) -> usize {
        if self.signing.is_some() {
            ENVELOPE_BYTES
        } else {
            0
        }
    }
}

/// Key that signs payloads for brokers that other parties use too.
///
/// The signature is HMAC-SHA256 over the length of the topic, the topic and the payload. The key is
/// derived from the cell's key.
///
/// ```text
/// | ec | tag (32) | payload |
/// ```
///
/// No payload begins with `ec`: JSON is text, and in CBOR that byte is a reserved value.
#[derive(Debug, Clone)]
pub(crate) struct SigningKey(hmac::Key);

const MARK: u8 = 0xec;
const TAG_BYTES: usize = 32;

/// Bytes that a signature adds to a payload.
pub const ENVELOPE_BYTES: usize = 1 + TAG_BYTES;

impl SigningKey {
    /// The payload in its envelope.
    pub(crate) fn sign(&self, topic: &str, payload: &[u8]) -> Vec<u8> {
        let tag = hmac::sign(&self.0, &signed(topic.as_bytes(), payload));
        [&[MARK], tag.as_ref(), payload].concat()
    }

    /// The payload of an envelope that was signed with this key for this topic.
    pub(crate) fn verify<'a>(&self, topic: &[u8], envelope: &'a [u8]) -> Option<&'a [u8]> {
        let (tag, payload) = envelope
            .strip_prefix(&[MARK])?
            .split_at_checked(TAG_BYTES)?;
        hmac::verify(&self.0, &signed(topic, payload), tag).ok()?;
        Some(payload)
    }
}

fn signed(topic: &[u8], payload: &[u8]) -> Vec<u8> {
    [&(topic.len() as u64).to_be_bytes(), topic, payload].concat()
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use ecod::model::names::NodeName;
    use ecod::wire::Role;

    use super::*;
    use crate::transport::gossip::MembershipConfig;
    use crate::transport::pki::Authority;

    #[test]
    fn clock_outside_certificate_names_remedy() {
        let name = NodeName::from_static("edge");
        let cell = NodeName::from_static("lot");
        let month_us = 30 * 86_400 * 1_000_000;
        let now = clock::now();
        for (issued_at, is_wrong) in [
            (now, false),
            (Timestamp(now.micros() + month_us), true),
            (Timestamp(now.micros() - month_us), true),
        ] {
            let directory = tempfile::tempdir().unwrap();
            let mut authority = Authority::init(directory.path(), &cell, issued_at).unwrap();
            authority
                .issue(&name, Role::Edge, Duration::from_secs(3600), issued_at)
                .unwrap();
            let tls = authority.tls_of(&name);
            let mqtt = MqttConfig::default();
            let membership = MembershipConfig::default();
            let security = Security::load(Some((&tls, &name)), &mqtt, &membership, &cell).unwrap();
            let fault = security.clock_fault();
            assert_eq!(
                fault
                    .as_ref()
                    .is_some_and(|fault| fault.contains("set the clock")),
                is_wrong,
                "{fault:?}"
            );
        }
    }

    #[test]
    fn altered_signed_round_is_refused() {
        let cell = NodeName::from_static("lot");
        let [edge, euclid] = ["edge", "euclid"].map(NodeName::from_static);
        let directory = tempfile::tempdir().unwrap();
        let mut authority = Authority::init(directory.path(), &cell, clock::now()).unwrap();
        let [of_edge, of_euclid] = [&edge, &euclid].map(|name| {
            authority
                .issue(name, Role::Auto, Duration::from_secs(3600), clock::now())
                .unwrap();
            let (certificate, key) = authority.files_of(name);
            let tls = TlsConfig {
                ca: authority.ca(),
                certificate,
                key,
                revocation_list: None,
                city: None,
            };
            let mqtt = MqttConfig::default();
            let membership = MembershipConfig::default();
            Security::load(Some((&tls, name)), &mqtt, &membership, &cell).unwrap()
        });
        let certificate = of_edge
            .credentials
            .as_ref()
            .unwrap()
            .current()
            .certificate()
            .into();
        let gossip = "10.0.0.2:17884".parse().unwrap();
        let member = Member {
            name: edge.clone(),
            run: 1,
            gossip,
            broker: None,
            role: Role::Auto,
            certificate: Some(certificate),
        };
        let (members, updates) = watch::channel(vec![member]);
        let receiver = of_euclid.clone().with_members(updates);
        let topic = "ecod/v1/lot/global_detections";
        let payload = br#"{"schema":1,"round":7}"#.to_vec();
        let signed = of_edge.sign_round(topic, payload.clone());
        let check = |topic: &str, payload: &[u8]| {
            receiver.check_round(Some(&edge), topic.as_bytes(), payload)
        };
        assert_eq!(check(topic, &signed), SignatureState::Valid);
        assert_eq!(
            check("ecod/v1/lot/global_verdicts", &signed),
            SignatureState::Invalid
        );
        assert_eq!(check(topic, &payload), SignatureState::Invalid, "none");
        assert_eq!(
            check(topic, &of_euclid.sign_round(topic, payload.clone())),
            SignatureState::Invalid
        );
        assert_eq!(
            receiver.check_round(Some(&euclid), topic.as_bytes(), &signed),
            SignatureState::Invalid
        );
        for at in 0..signed.len() - 2 {
            let mut changed = signed.clone();
            changed[at] ^= 1;
            assert_eq!(check(topic, &changed), SignatureState::Invalid, "byte {at}");
        }
        assert_eq!(
            of_euclid.check_round(Some(&edge), topic.as_bytes(), &signed),
            SignatureState::Unverifiable
        );
        members.send_replace(Vec::new());
        assert_eq!(
            check(topic, &signed),
            SignatureState::Invalid,
            "no member any more"
        );
        assert_eq!(
            Security::default().sign_round(topic, payload.clone()),
            payload,
            "without certificates"
        );
    }

    fn key(text: &str, cell: &'static str) -> SigningKey {
        let membership = MembershipConfig {
            key: Some(crate::platform::secret::Secret::new(text)),
            ..MembershipConfig::default()
        };
        SigningKey(payload_key(&membership, &NodeName::from_static(cell)).unwrap())
    }

    #[test]
    fn envelope_opens_with_sealing_context() {
        let key_of_cell = key("correct horse battery", "lot-1");
        let envelope = key_of_cell.sign("a/b", b"payload");
        assert_eq!(key_of_cell.verify(b"a/b", &envelope), Some(&b"payload"[..]));
        assert_eq!(key_of_cell.verify(b"a/", &envelope), None);
        assert_eq!(
            key("correct horse batterz", "lot-1").verify(b"a/b", &envelope),
            None
        );
        assert_eq!(
            key("correct horse battery", "lot-2").verify(b"a/b", &envelope),
            None
        );
        for at in 0..envelope.len() {
            let mut changed = envelope.clone();
            changed[at] ^= 1;
            assert_eq!(key_of_cell.verify(b"a/b", &changed), None, "byte {at}");
        }
        for bare in [&b"{}"[..], b"", &[MARK], &envelope[..TAG_BYTES]] {
            assert_eq!(key_of_cell.verify(b"a/b", bare), None);
        }
    }
}
