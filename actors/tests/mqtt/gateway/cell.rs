//! A cell for tests: brokers, nodes with a gateway each, and strangers with a bare client.

use std::net::{Ipv4Addr, SocketAddr};
use std::sync::Arc;
use std::time::Duration;

use ecod::model::epoch::Epoch;
use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ecod::wire::{
    GlobalMap, NodeState, NodeStatus, ObjectReport, PerceivedObject, ReportKind, Role,
};
use ecod_actors::actors::gateway::{Gateway, GatewayArguments};
use ecod_actors::messages::gateway::GatewayMessage;
use ecod_actors::telemetry::counters::Counters;
use ecod_actors::transport::broker::{BrokerConfig, EmbeddedBroker, MqttBroker};
use ecod_actors::transport::mqtt::{
    BrokerAddress, Delivery, Incoming, LinkState, MqttConfig, Security, SubscriptionRole,
};
use ractor::{Actor, ActorRef};
use rumqttc::{AsyncClient, Event, MqttOptions, Packet, QoS};
use tokio::sync::mpsc;
use tokio::task::JoinHandle;
use uuid::Uuid;

pub(crate) const LOOPBACK: SocketAddr =
    SocketAddr::new(std::net::IpAddr::V4(Ipv4Addr::LOCALHOST), 0);
const PATIENCE: Duration = Duration::from_secs(20);

pub(crate) fn embedded() -> (EmbeddedBroker, BrokerAddress) {
    let mut broker = EmbeddedBroker::new(BrokerConfig::default());
    let address = broker.start(LOOPBACK).unwrap();
    (broker, address.into())
}

pub(crate) fn name(name: &str) -> NodeName {
    NodeName::new(name).unwrap()
}

pub(crate) fn topic(level: &str) -> String {
    format!("ecod/v1/test/{level}")
}

pub(crate) struct Node {
    pub(crate) name: NodeName,
    pub(crate) gateway: ActorRef<GatewayMessage>,
    pub(crate) counters: Arc<Counters>,
    pub(crate) status: NodeStatus,
    deliveries: mpsc::UnboundedReceiver<Delivery>,
    handle: JoinHandle<()>,
}

impl Node {
    /// A node whose links are up.
    pub(crate) async fn join(
        node: &str,
        role: SubscriptionRole,
        mqtt: MqttConfig,
        brokers: &[&BrokerAddress],
    ) -> Self {
        let mut node = Self::start(node, role, mqtt).await;
        node.send(GatewayMessage::SetBrokers {
            addresses: brokers.iter().copied().cloned().collect(),
        });
        for _ in brokers {
            node.link(LinkState::Up).await;
        }
        node
    }

    /// A vehicle with the settings of an unconfigured node.
    pub(crate) async fn follower(node: &str, broker: &BrokerAddress) -> Self {
        let role = SubscriptionRole::Follower;
        Self::join(node, role, MqttConfig::default(), &[broker]).await
    }

    pub(crate) async fn start(node: &str, role: SubscriptionRole, mqtt: MqttConfig) -> Self {
        let (sender, deliveries) = mpsc::unbounded_channel();
        let counters = Arc::new(Counters::default());
        let status = NodeStatus {
            epoch: 1,
            ..NodeStatus::starting(name(node), Uuid::new_v4(), Role::Auto, "0.1.0")
        };
        let arguments = GatewayArguments {
            cell: name("test"),
            role,
            status: status.clone(),
            mqtt,
            security: Security::default(),
            clock: Default::default(),
            counters: Arc::clone(&counters),
            subscriber: Arc::new(move |delivery| sender.send(delivery).unwrap_or_default()),
            seed: 7,
            only_observes: false,
        };
        let (gateway, handle) = Actor::spawn(None, Gateway, arguments).await.unwrap();
        Self {
            name: name(node),
            gateway,
            counters,
            status,
            deliveries,
            handle,
        }
    }

    pub(crate) fn send(&self, message: GatewayMessage) {
        assert!(self.gateway.cast(message).is_ok(), "the gateway is gone");
    }

    pub(crate) fn report(&self, seq: u64) {
        let report = Arc::new(report(self.name.as_str(), seq));
        self.send(GatewayMessage::PublishReport {
            kind: ReportKind::Detections,
            report,
        });
    }

    /// The next message for which `pick` has an answer; others are passed over.
    pub(crate) async fn next<T>(&mut self, mut pick: impl FnMut(&Incoming) -> Option<T>) -> T {
        let found = async {
            loop {
                let delivery = self.deliveries.recv().await.expect("the gateway lives");
                if let Some(found) = pick(&delivery.message) {
                    return found;
                }
            }
        };
        tokio::time::timeout(PATIENCE, found)
            .await
            .expect("the message arrives")
    }

    pub(crate) async fn next_report(&mut self) -> (NodeName, u64) {
        self.next(|message| match message {
            Incoming::Report { report, .. } => Some((report.node.clone(), report.seq)),
            _ => None,
        })
        .await
    }

    pub(crate) async fn next_map_round(&mut self) -> u64 {
        self.next(|message| match message {
            Incoming::Map(map) => Some(map.round),
            _ => None,
        })
        .await
    }

    pub(crate) async fn next_state_of(&mut self, node: &str) -> NodeState {
        self.next(|message| match message {
            Incoming::Status { status, .. } if status.node.as_str() == node => Some(status.state),
            _ => None,
        })
        .await
    }

    pub(crate) async fn link(&mut self, wanted: LinkState) -> BrokerAddress {
        self.next(|message| match message {
            Incoming::Link { broker, state } if *state == wanted => Some(broker.clone()),
            _ => None,
        })
        .await
    }

    /// Cuts the node off without any farewell.
    pub(crate) async fn kill(self) {
        self.gateway.kill();
        self.handle.await.unwrap();
    }

    pub(crate) async fn stop(self) {
        self.gateway.stop(None);
        self.handle.await.unwrap();
    }
}

/// The node `edge`, which may lead, and the vehicle `euclid` at one broker.
pub(crate) async fn edge_and_vehicle(broker: &BrokerAddress, mqtt: MqttConfig) -> (Node, Node) {
    let edge = Node::join("edge", SubscriptionRole::Candidate, mqtt.clone(), &[broker]).await;
    let euclid = Node::join("euclid", SubscriptionRole::Follower, mqtt, &[broker]).await;
    (edge, euclid)
}

/// A plain client without ECOD's code.
pub(crate) struct Stranger {
    client: AsyncClient,
    events: rumqttc::EventLoop,
}

impl Stranger {
    pub(crate) async fn connect(broker: &BrokerAddress) -> Self {
        let mut options =
            MqttOptions::new(Uuid::new_v4().to_string(), broker.host(), broker.port());
        options.set_max_packet_size(usize::MAX, usize::MAX);
        let (client, mut events) = AsyncClient::new(options, 16);
        let first = tokio::time::timeout(PATIENCE, events.poll())
            .await
            .unwrap()
            .unwrap();
        assert!(matches!(first, Event::Incoming(Packet::ConnAck(_))));
        Self { client, events }
    }

    /// Publishes with QoS 1 and waits until the broker has taken it; false when the broker hangs up instead.
    pub(crate) async fn publish(
        &mut self,
        topic: &str,
        retain: bool,
        payload: impl Into<Vec<u8>>,
    ) -> bool {
        self.client
            .publish(topic, QoS::AtLeastOnce, retain, payload)
            .await
            .unwrap();
        let taken = async {
            loop {
                match self.events.poll().await {
                    Ok(Event::Incoming(Packet::PubAck(_))) => return true,
                    Ok(_) => {}
                    Err(_) => return false,
                }
            }
        };
        tokio::time::timeout(PATIENCE, taken).await.unwrap()
    }
}

pub(crate) fn report(node: &str, seq: u64) -> ObjectReport {
    ObjectReport {
        objects: vec![PerceivedObject::new("car", 0.9, 1.0, 2.0)],
        ..ObjectReport::new(name(node), seq, Timestamp(1_732_154_400_123_456))
    }
}

pub(crate) fn map(aggregator: &str, round: u64) -> Arc<GlobalMap> {
    Arc::new(GlobalMap::new(
        &Epoch::new(1, name(aggregator)),
        round,
        Timestamp(1_732_154_400_200_000),
    ))
}
