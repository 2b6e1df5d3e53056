//! Access of the simulated clients to a broker.

use ecod_actors::node::config::NodeConfig;
use ecod_actors::transport::mqtt::{BrokerAddress, Security};
use rumqttc::{
    AsyncClient, ConnectionError, Event, EventLoop, MqttOptions, NetworkOptions, Packet, QoS,
    SubscribeFilter, TlsConfiguration, Transport,
};

/// Address of a broker with the credentials that it and its cell require from clients: TLS, user
/// name and password, signed payloads.
#[derive(Debug, Clone)]
pub struct BrokerAccess {
    /// Address of the broker.
    pub broker: BrokerAddress,
    login: Option<(String, String)>,
    pub(super) security: Security,
}

/// The reason why simulated vehicles are not admitted.
#[derive(Debug, thiserror::Error)]
pub enum AccessError {
    /// A certificate of the cell is valid for one vehicle.
    #[error(
        "the broker at {0} is embedded in a cell with certificates, where each speaks for one vehicle only: no program can \
         be many of them. Measure without --config and --connect a cell of this machine's own, or the cell through an \
         external broker in `mqtt.broker`"
    )]
    Closed(BrokerAddress),
    /// Certificates or the cell's key cannot be used.
    #[error(transparent)]
    Security(#[from] ecod_actors::transport::mqtt::SecurityError),
}

impl BrokerAccess {
    /// Access to a broker without requirements.
    pub fn open(broker: BrokerAddress) -> Self {
        Self {
            broker,
            login: None,
            security: Security::default(),
        }
    }

    /// Access as a node with this configuration; the files that it names are read.
    ///
    /// # Errors
    /// Returns an [`AccessError`] if the broker is embedded in a node with certificates, or a file
    /// cannot be used.
    pub fn of(broker: BrokerAddress, config: &NodeConfig) -> Result<Self, AccessError> {
        if config.tls.is_some() && config.mqtt.broker.as_ref() != Some(&broker) {
            return Err(AccessError::Closed(broker));
        }
        let password = config
            .mqtt
            .password
            .as_ref()
            .map_or("", |password| password.reveal());
        let login = config
            .mqtt
            .user
            .as_ref()
            .map(|user| (user.clone(), password.to_owned()));
        Ok(Self {
            broker,
            login,
            security: config.security()?,
        })
    }

    /// Adds the signature envelope for a topic, if the cell signs payloads.
    pub(super) fn seal(&self, topic: &str, payload: Vec<u8>) -> Vec<u8> {
        self.security.seal(topic, payload)
    }

    /// The payload of a received message; its signature is not verified.
    pub(super) fn unseal<'a>(&self, received: &'a [u8]) -> &'a [u8] {
        received
            .get(self.security.envelope_bytes()..)
            .unwrap_or_default()
    }

    /// A connected client that is subscribed to the topics.
    pub(super) async fn subscribed(
        &self,
        client_id: &str,
        topics: &[&str],
    ) -> Result<(AsyncClient, EventLoop), ConnectionError> {
        let trust = self.security.tls(&self.broker).map_err(unconnected)?;
        // The parser of host names rejects brackets.
        let host = if trust.is_some() {
            self.broker.host().trim_matches(['[', ']'])
        } else {
            self.broker.host()
        };
        let mut options = MqttOptions::new(client_id, host, self.broker.port());
        options.set_max_packet_size(MAX_PACKET_BYTES, MAX_PACKET_BYTES);
        if let Some((user, password)) = &self.login {
            options.set_credentials(user, password);
        }
        if let Some(trust) = trust {
            options.set_transport(Transport::tls_with_config(TlsConfiguration::Rustls(
                trust.client(),
            )));
        }
        let (client, mut events) = AsyncClient::new(options, 1024);
        let mut network = NetworkOptions::new();
        network.set_tcp_nodelay(true);
        events.set_network_options(network);
        loop {
            match events.poll().await? {
                Event::Incoming(Packet::ConnAck(_)) => {
                    let filters = topics
                        .iter()
                        .map(|topic| SubscribeFilter::new((*topic).to_owned(), QoS::AtMostOnce));
                    client.try_subscribe_many(filters).map_err(unconnected)?;
                }
                Event::Incoming(Packet::SubAck(_)) => return Ok((client, events)),
                _ => {}
            }
        }
    }
}

/// The error of a connection that fails on this machine's side.
fn unconnected(error: impl std::error::Error + Send + Sync + 'static) -> ConnectionError {
    ConnectionError::Io(std::io::Error::other(error))
}

/// Large enough for a map of a thousand vehicles.
const MAX_PACKET_BYTES: usize = 1 << 20;

#[cfg(test)]
mod tests {
    use ecod_actors::platform::secret::Secret;
    use ecod_actors::transport::gossip::MembershipConfig;

    use super::*;

    fn address(text: &str) -> BrokerAddress {
        text.parse().unwrap()
    }

    #[test]
    fn single_vehicle_certificates_are_refused() {
        let mut config = NodeConfig {
            tls: Some(ecod_actors::transport::pki::TlsConfig {
                ca: "ca.pem".into(),
                certificate: "euclid.pem".into(),
                key: "euclid.key".into(),
                revocation_list: None,
                city: None,
            }),
            ..NodeConfig::default()
        };
        let error = BrokerAccess::of(address("10.0.0.2:8883"), &config)
            .unwrap_err()
            .to_string();
        assert!(
            error.contains("10.0.0.2:8883") && error.contains("one vehicle only"),
            "{error}"
        );
        config.mqtt.broker = Some(address("10.0.0.9:8883"));
        assert!(matches!(
            BrokerAccess::of(address("10.0.0.2:8883"), &config),
            Err(AccessError::Closed(_))
        ));
    }

    #[test]
    fn signature_is_skipped_on_read() {
        let mut config = NodeConfig {
            membership: MembershipConfig {
                key: Some(Secret::new("correct horse battery")),
                ..Default::default()
            },
            ..NodeConfig::default()
        };
        let open = BrokerAccess::of(address("10.0.0.2:1883"), &config).unwrap();
        assert_eq!(open.unseal(&open.seal("a/b", b"{}".to_vec())), b"{}");
        config.mqtt.sign = true;
        let signing = BrokerAccess::of(address("10.0.0.2:1883"), &config).unwrap();
        let sealed = signing.seal("a/b", b"{}".to_vec());
        assert_eq!(
            sealed.len(),
            ecod_actors::transport::mqtt::ENVELOPE_BYTES + 2
        );
        assert_eq!(signing.unseal(&sealed), b"{}");
        assert_eq!(signing.unseal(b"{}"), b"");
    }
}
