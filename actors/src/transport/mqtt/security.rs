//! How links and payloads are protected.

use std::path::PathBuf;
use std::sync::Arc;

use ecod::leadership::BrokerAddress;
use ecod::names::NodeName;
use ring::hmac;

use super::config::MqttConfig;
use crate::transport::gossip::{KeyError, MembershipConfig, payload_key};
use crate::transport::pki::{BrokerTrust, Credentials, CredentialsError, TlsConfig, external_broker};

/// How links and payloads are protected; the default is not at all.
#[derive(Debug, Clone, Default)]
pub struct Security {
    /// The node's certificates, for the brokers of the cell.
    pub credentials: Option<Arc<Credentials>>,
    external: Option<ExternalBroker>,
    pub(crate) signing: Option<SigningKey>,
}

/// A broker that is none of the cell's, and who signed its certificate, if it has one.
#[derive(Debug, Clone)]
struct ExternalBroker {
    address: BrokerAddress,
    ca: Option<PathBuf>,
}

/// Why links or payloads cannot be protected as configured.
#[derive(Debug, thiserror::Error)]
pub enum SecurityError {
    /// The certificates cannot be used.
    #[error(transparent)]
    Credentials(#[from] CredentialsError),
    /// The cell's key, by which payloads are signed, cannot be used.
    #[error("key `mqtt.sign`: {0}")]
    Key(#[from] KeyError),
}

impl Security {
    /// Protection as configured; reads the certificates of the node `tls` names, and the key of the cell.
    ///
    /// # Errors
    /// [`SecurityError`] naming the file.
    pub fn load(
        tls: Option<(&TlsConfig, &NodeName)>,
        mqtt: &MqttConfig,
        (membership, cell): (&MembershipConfig, &NodeName),
    ) -> Result<Self, SecurityError> {
        let credentials = tls.map(|(files, name)| Credentials::load(files, name)).transpose()?.map(Arc::new);
        let external = mqtt.broker.clone().map(|address| ExternalBroker { address, ca: mqtt.ca.clone() });
        let signing = mqtt.sign.then(|| payload_key(membership, cell)).transpose()?;
        let security = Self { credentials, external, signing: signing.map(SigningKey) };
        if let Some(external) = &security.external {
            security.tls(&external.address)?;
        }
        Ok(security)
    }

    /// How to speak TLS to a broker, for one connection; none where it is spoken to in plaintext.
    ///
    /// # Errors
    /// When the credentials can no longer be used.
    pub fn tls(&self, broker: &BrokerAddress) -> Result<Option<BrokerTrust>, CredentialsError> {
        match self.external.as_ref().filter(|external| external.address == *broker) {
            Some(ExternalBroker { ca: Some(ca), .. }) => {
                let current = self.credentials.as_ref().map(|credentials| credentials.current());
                external_broker(ca, current.as_deref()).map(Some)
            }
            Some(ExternalBroker { ca: None, .. }) => Ok(None),
            None => Ok(self.credentials.as_ref().map(BrokerTrust::of_cell)),
        }
    }

    /// The payload as it travels on a topic: signed where the cell signs.
    pub fn seal(&self, topic: &str, payload: Vec<u8>) -> Vec<u8> {
        match &self.signing {
            Some(key) => key.seal(topic, &payload),
            None => payload,
        }
    }

    /// Whether an envelope of another's making is shut, and one's own holds the payload; only built for the fuzz
    /// targets.
    #[cfg(fuzzing)]
    pub fn keeps_shut(&self, topic: &str, bytes: &[u8]) -> bool {
        let Some(key) = &self.signing else { return false };
        key.open(topic.as_bytes(), bytes).is_none()
            && key.open(topic.as_bytes(), &key.seal(topic, bytes)) == Some(bytes)
    }

    /// Bytes before a payload that travels.
    pub fn envelope_bytes(&self) -> usize {
        if self.signing.is_some() { ENVELOPE_BYTES } else { 0 }
    }
}

/// Signs payloads for brokers that others use too: HMAC-SHA256 by a key that is derived from the cell's, over the
/// length of the topic, the topic and the payload.
///
/// ```text
/// | ec | tag (32) | payload |
/// ```
///
/// No payload begins with the byte of the envelope: JSON is text, and CBOR's `ec` is a value that nobody may use.
#[derive(Debug, Clone)]
pub(crate) struct SigningKey(hmac::Key);

const MARK: u8 = 0xec;
const TAG_BYTES: usize = 32;

/// What a signature adds to a payload.
pub const ENVELOPE_BYTES: usize = 1 + TAG_BYTES;

impl SigningKey {
    /// The payload in its envelope.
    pub(crate) fn seal(&self, topic: &str, payload: &[u8]) -> Vec<u8> {
        let tag = hmac::sign(&self.0, &signed(topic.as_bytes(), payload));
        [&[MARK], tag.as_ref(), payload].concat()
    }

    /// The payload of an envelope, if somebody who has the key sealed it for this topic.
    pub(crate) fn open<'a>(&self, topic: &[u8], envelope: &'a [u8]) -> Option<&'a [u8]> {
        let (tag, payload) = envelope.strip_prefix(&[MARK])?.split_at_checked(TAG_BYTES)?;
        hmac::verify(&self.0, &signed(topic, payload), tag).ok()?;
        Some(payload)
    }
}

fn signed(topic: &[u8], payload: &[u8]) -> Vec<u8> {
    [&(topic.len() as u64).to_be_bytes(), topic, payload].concat()
}

#[cfg(test)]
mod tests {
    use ecod::names::NodeName;

    use super::*;
    use crate::transport::gossip::MembershipConfig;

    fn key(text: &str, cell: &'static str) -> SigningKey {
        let membership =
            MembershipConfig { key: Some(crate::platform::secret::Secret::new(text)), ..MembershipConfig::default() };
        SigningKey(payload_key(&membership, &NodeName::from_static(cell)).unwrap())
    }

    #[test]
    fn only_key_cell_topic_and_payload_of_the_sealing_open_an_envelope() {
        let key_of_cell = key("correct horse battery", "lot-1");
        let envelope = key_of_cell.seal("a/b", b"payload");
        assert_eq!(key_of_cell.open(b"a/b", &envelope), Some(&b"payload"[..]));
        assert_eq!(key_of_cell.open(b"a/", &envelope), None);
        assert_eq!(key("correct horse batterz", "lot-1").open(b"a/b", &envelope), None);
        assert_eq!(key("correct horse battery", "lot-2").open(b"a/b", &envelope), None);
        for at in 0..envelope.len() {
            let mut changed = envelope.clone();
            changed[at] ^= 1;
            assert_eq!(key_of_cell.open(b"a/b", &changed), None, "byte {at}");
        }
        for bare in [&b"{}"[..], b"", &[MARK], &envelope[..TAG_BYTES]] {
            assert_eq!(key_of_cell.open(b"a/b", bare), None);
        }
    }
}
