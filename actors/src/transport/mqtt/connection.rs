//! One MQTT connection, 3.1.1 or 5. It is not reconnected, so that old messages are not sent late.

use std::error::Error;
use std::io;
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use ecod::leadership::BrokerAddress;
use ecod::wire::{Encoding, NodeState, NodeStatus, encode};
use rumqttc::v5::mqttbytes::QoS as QoS5;
use rumqttc::v5::mqttbytes::v5::PubAckReason;
use rumqttc::{QoS as QoS4, TlsConfiguration, Transport, v5};
use rustls::ClientConfig;

use super::config::{MqttConfig, MqttVersion};
use crate::transport::pki::CredentialsError;

/// QoS and retention of a message, as defined for its topic.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Retention {
    /// QoS 0, not retained: the next message replaces it.
    Transient,
    /// QoS 1, not retained: the sender waits for the answer.
    Acknowledged,
    /// QoS 1, retained: new subscribers need it.
    Retained,
    /// QoS 0, retained: the sender repeats it on every connection.
    Repeated,
}

/// Maximum QoS of a subscription's messages.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum MaxQos {
    /// QoS 0: brokers queue no messages for the subscriber.
    AtMostOnce,
    /// QoS 1.
    AtLeastOnce,
}

/// The sending half; it does not block.
#[derive(Debug, Clone)]
pub(crate) enum Client {
    V311(rumqttc::AsyncClient),
    V5(v5::AsyncClient),
}

/// The receiving half; must be polled for anything to be sent or received.
pub(crate) enum Connection {
    V311(Box<rumqttc::EventLoop>),
    V5(Box<v5::EventLoop>),
}

/// Result of polling a connection.
pub(crate) enum Packet {
    /// The broker accepted the connection.
    Accepted,
    /// A message. Its topic may be invalid UTF-8.
    Message { topic: Bytes, payload: Bytes },
    /// DISCONNECT was sent.
    Disconnected,
    /// The broker refused filters of a subscription: index of each filter and reason.
    SubscriptionRefused(Vec<(usize, String)>),
    /// The broker refused a message of QoS 1, with its reason if it gave one; only MQTT 5 reports
    /// refusals.
    PublishRefused(String),
    /// A packet was sent.
    Sent,
    /// Another packet of the protocol arrived.
    Other,
}

/// Reason for the end of a connection.
#[derive(Debug, thiserror::Error)]
pub(crate) enum ConnectionError {
    /// The port is closed: the broker's process is gone.
    #[error("{0}")]
    NotListening(String),
    /// The broker rejected the login, or one side rejected the other's certificate.
    #[error("{0}")]
    Rejected(String),
    /// A packet larger than [`MqttConfig::max_packet_bytes`] arrived.
    #[error("{0}")]
    Oversized(String),
    #[error("nothing within {0:?}")]
    Timeout(Duration),
    #[error("the broker's certificate is no longer valid: {0}")]
    BrokerInvalidated(rustls::Error),
    #[error(transparent)]
    Credentials(#[from] Box<CredentialsError>),
    #[error("{0}")]
    Other(String),
}

impl ConnectionError {
    /// The reason why the broker rejected this node, or this node the broker.
    pub(crate) fn rejection(&self) -> Option<String> {
        match self {
            Self::Rejected(reason) => Some(reason.clone()),
            Self::BrokerInvalidated(error) => Some(error.to_string()),
            _ => None,
        }
    }

    /// An error that is common to both versions of the protocol.
    fn of(error: &(dyn Error + 'static)) -> Self {
        let causes = || std::iter::successors(Some(error), |&error| error.source());
        let io_errors = || causes().filter_map(|error| error.downcast_ref::<io::Error>());
        let rejected_certificate = |error: &io::Error| {
            let error = error.get_ref()?.downcast_ref()?;
            matches!(
                error,
                rustls::Error::InvalidCertificate(_) | rustls::Error::AlertReceived(_)
            )
            .then(|| error.to_string())
        };
        if let Some(reason) = io_errors().find_map(rejected_certificate) {
            Self::Rejected(reason)
        } else if io_errors().any(|error| error.kind() == io::ErrorKind::ConnectionRefused) {
            Self::NotListening(error.to_string())
        } else {
            Self::Other(error.to_string())
        }
    }
}

impl From<rumqttc::ConnectionError> for ConnectionError {
    fn from(error: rumqttc::ConnectionError) -> Self {
        use rumqttc::{ConnectionError, Error, StateError};
        match &error {
            ConnectionError::ConnectionRefused(code) => Self::Rejected(format!("{code:?}")),
            ConnectionError::MqttState(StateError::Deserialization(
                Error::PayloadSizeLimitExceeded(_),
            )) => Self::Oversized(error.to_string()),
            _ => Self::of(&error),
        }
    }
}

impl From<v5::ConnectionError> for ConnectionError {
    fn from(error: v5::ConnectionError) -> Self {
        use rumqttc::v5::mqttbytes::Error::PayloadSizeLimitExceeded;
        use rumqttc::v5::{ConnectionError, StateError};
        match &error {
            ConnectionError::ConnectionRefused(code) => Self::Rejected(format!("{code:?}")),
            ConnectionError::MqttState(
                StateError::Deserialization(PayloadSizeLimitExceeded { .. })
                | StateError::IncomingPacketTooLarge { .. },
            ) => Self::Oversized(error.to_string()),
            _ => Self::of(&error),
        }
    }
}

/// Message that the broker publishes when this node's connection breaks.
#[derive(Debug, Clone)]
pub(crate) struct LastWill {
    pub(crate) topic: String,
    pub(crate) payload: Bytes,
}

/// Payload of the last will of a node with this status.
pub(crate) fn offline_payload(status: &NodeStatus, encoding: Encoding) -> Vec<u8> {
    let gone = NodeStatus {
        state: NodeState::Offline,
        aggregator: None,
        troubles: Vec::new(),
        ..status.clone()
    };
    encode(&gone, encoding)
}

/// Prepares a connection; the first poll connects.
pub(crate) fn open(
    address: &BrokerAddress,
    client_id: &str,
    will: Option<&LastWill>,
    config: &MqttConfig,
    tls: Option<Arc<ClientConfig>>,
) -> (Client, Connection) {
    let timeout_s = config.connect_timeout().as_secs().max(1);
    let mut network = rumqttc::NetworkOptions::new();
    network.set_tcp_nodelay(true);
    network.set_connection_timeout(timeout_s);
    let login = config
        .user
        .as_deref()
        .map(|user| (user, config.password.as_ref().map_or("", |p| p.reveal())));
    let port = address.port();
    // The client library compares the host with the name in the certificate, which has no brackets.
    let host = if tls.is_some() {
        address.host().trim_matches(['[', ']'])
    } else {
        address.host()
    };
    let transport = tls.map(|tls| Transport::tls_with_config(TlsConfiguration::Rustls(tls)));
    let max_packet_bytes = config.max_packet_bytes();
    match config.version {
        MqttVersion::V311 => {
            let mut options = rumqttc::MqttOptions::new(client_id, host, port);
            options.set_keep_alive(config.keep_alive());
            options.set_max_packet_size(max_packet_bytes, max_packet_bytes);
            if let Some(transport) = transport {
                options.set_transport(transport);
            }
            if let Some(will) = will {
                let payload = will.payload.clone();
                options.set_last_will(rumqttc::LastWill::new(
                    &will.topic,
                    payload,
                    QoS4::AtLeastOnce,
                    true,
                ));
            }
            if let Some((user, password)) = login {
                options.set_credentials(user, password);
            }
            let (client, mut events) = rumqttc::AsyncClient::new(options, config.send_queue);
            events.set_network_options(network);
            (Client::V311(client), Connection::V311(Box::new(events)))
        }
        MqttVersion::V5 => {
            let mut options = v5::MqttOptions::new(client_id, host, port);
            options.set_keep_alive(config.keep_alive());
            options.set_connection_timeout(timeout_s);
            options.set_max_packet_size(u32::try_from(max_packet_bytes).ok());
            if let Some(transport) = transport {
                options.set_transport(transport);
            }
            if let Some(will) = will {
                let payload = will.payload.clone();
                let will = v5::mqttbytes::v5::LastWill::new(
                    &will.topic,
                    payload,
                    QoS5::AtLeastOnce,
                    true,
                    None,
                );
                options.set_last_will(will);
            }
            options.set_network_options(network);
            if let Some((user, password)) = login {
                options.set_credentials(user, password);
            }
            let (client, events) = v5::AsyncClient::new(options, config.send_queue);
            (Client::V5(client), Connection::V5(Box::new(events)))
        }
    }
}

impl Client {
    /// Queues a message; false if there is no room or the connection has ended.
    pub(crate) fn publish(&self, topic: &str, payload: &Bytes, retention: Retention) -> bool {
        let retain = matches!(retention, Retention::Retained | Retention::Repeated);
        let is_acknowledged = matches!(retention, Retention::Retained | Retention::Acknowledged);
        match self {
            Self::V311(client) => {
                let qos = if is_acknowledged {
                    QoS4::AtLeastOnce
                } else {
                    QoS4::AtMostOnce
                };
                client
                    .try_publish(topic, qos, retain, payload.clone())
                    .is_ok()
            }
            Self::V5(client) => {
                let qos = if is_acknowledged {
                    QoS5::AtLeastOnce
                } else {
                    QoS5::AtMostOnce
                };
                client
                    .try_publish(topic, qos, retain, payload.clone())
                    .is_ok()
            }
        }
    }

    /// Queues one subscription to all filters; false if there is no room.
    pub(crate) fn subscribe(&self, filters: &[String], max_qos: MaxQos) -> bool {
        match self {
            Self::V311(client) => {
                let qos = match max_qos {
                    MaxQos::AtMostOnce => QoS4::AtMostOnce,
                    MaxQos::AtLeastOnce => QoS4::AtLeastOnce,
                };
                let filters = filters
                    .iter()
                    .map(|path| rumqttc::SubscribeFilter::new(path.clone(), qos));
                client.try_subscribe_many(filters).is_ok()
            }
            Self::V5(client) => {
                let qos = match max_qos {
                    MaxQos::AtMostOnce => QoS5::AtMostOnce,
                    MaxQos::AtLeastOnce => QoS5::AtLeastOnce,
                };
                let filters = filters
                    .iter()
                    .map(|path| v5::mqttbytes::v5::Filter::new(path.clone(), qos));
                client.try_subscribe_many(filters).is_ok()
            }
        }
    }

    /// Queues unsubscriptions; false if there is no room for all.
    pub(crate) fn unsubscribe(&self, filters: &[String]) -> bool {
        filters.iter().all(|filter| match self {
            Self::V311(client) => client.try_unsubscribe(filter).is_ok(),
            Self::V5(client) => client.try_unsubscribe(filter).is_ok(),
        })
    }

    /// Queues DISCONNECT, after which the broker publishes no last will; false if there is no room.
    pub(crate) fn disconnect(&self) -> bool {
        match self {
            Self::V311(client) => client.try_disconnect().is_ok(),
            Self::V5(client) => client.try_disconnect().is_ok(),
        }
    }
}

impl Connection {
    /// Sends and receives until there is a packet to report, for at most `patience`.
    pub(crate) async fn next(&mut self, patience: Duration) -> Result<Packet, ConnectionError> {
        tokio::time::timeout(patience, self.poll())
            .await
            .unwrap_or(Err(ConnectionError::Timeout(patience)))
    }

    /// Sends and receives until the client library reports an event, in the form that both versions
    /// of MQTT share.
    async fn poll(&mut self) -> Result<Packet, ConnectionError> {
        Ok(match self {
            Self::V311(events) => match events.poll().await? {
                rumqttc::Event::Incoming(rumqttc::Packet::ConnAck(_)) => Packet::Accepted,
                rumqttc::Event::Incoming(rumqttc::Packet::Publish(publish)) => Packet::Message {
                    topic: publish.topic.into(),
                    payload: publish.payload,
                },
                rumqttc::Event::Incoming(rumqttc::Packet::SubAck(answer)) => {
                    refused_filters(answer.return_codes, |code| {
                        matches!(code, rumqttc::SubscribeReasonCode::Success(_))
                    })
                }
                rumqttc::Event::Outgoing(rumqttc::Outgoing::Disconnect) => Packet::Disconnected,
                rumqttc::Event::Outgoing(_) => Packet::Sent,
                rumqttc::Event::Incoming(_) => Packet::Other,
            },
            Self::V5(events) => match events.poll().await? {
                v5::Event::Incoming(v5::Incoming::ConnAck(_)) => Packet::Accepted,
                v5::Event::Incoming(v5::Incoming::Publish(publish)) => Packet::Message {
                    topic: publish.topic,
                    payload: publish.payload,
                },
                v5::Event::Incoming(v5::Incoming::SubAck(answer)) => {
                    refused_filters(answer.return_codes, |code| {
                        matches!(code, v5::mqttbytes::v5::SubscribeReasonCode::Success(_))
                    })
                }
                v5::Event::Incoming(v5::Incoming::PubAck(answer)) => match answer.reason {
                    PubAckReason::Success | PubAckReason::NoMatchingSubscribers => Packet::Other,
                    code => {
                        let text = answer
                            .properties
                            .and_then(|properties| properties.reason_string);
                        Packet::PublishRefused(text.unwrap_or_else(|| format!("{code:?}")))
                    }
                },
                v5::Event::Outgoing(rumqttc::Outgoing::Disconnect) => Packet::Disconnected,
                v5::Event::Outgoing(_) => Packet::Sent,
                v5::Event::Incoming(_) => Packet::Other,
            },
        })
    }
}

/// The filters of a subscription that were refused.
fn refused_filters<C: std::fmt::Debug>(codes: Vec<C>, granted: impl Fn(&C) -> bool) -> Packet {
    let refused: Vec<_> = codes
        .into_iter()
        .enumerate()
        .filter(|(_, code)| !granted(code))
        .map(|(index, code)| (index, format!("{code:?}")))
        .collect();
    if refused.is_empty() {
        Packet::Other
    } else {
        Packet::SubscriptionRefused(refused)
    }
}
