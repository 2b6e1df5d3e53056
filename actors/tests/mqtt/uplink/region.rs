//! A region: a broker, and a subscriber to all messages that cells publish there.

use std::sync::{Arc, Mutex};
use std::time::Duration;

use bytes::Bytes;
use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ecod::wire::{
    CellDescription, CellMap, Limits, NodeStatus, Payload, RegionTopic, RegionTopicKind, decode,
};
use ecod_actors::platform::clock;
use ecod_actors::transport::mqtt::BrokerAddress;
use rumqttc::{AsyncClient, Event, Incoming, MqttOptions, QoS};
use tokio::task::JoinHandle;
use uuid::Uuid;

use crate::mosquitto::Mosquitto;
use crate::uplink::nats::Nats;

/// A broker that both run.
pub(crate) enum Broker {
    Mosquitto(Mosquitto),
    Nats(Nats),
}

impl Broker {
    pub(crate) fn both() -> [Self; 2] {
        [
            Self::Mosquitto(Mosquitto::start()),
            Self::Nats(Nats::start()),
        ]
    }

    pub(crate) fn both_with_user(user: &str, password: &str) -> [Self; 2] {
        [
            Self::Mosquitto(Mosquitto::with_user(user, password)),
            Self::Nats(Nats::with_user(user, password)),
        ]
    }

    pub(crate) fn name(&self) -> &'static str {
        match self {
            Self::Mosquitto(_) => "mosquitto",
            Self::Nats(_) => "nats-server",
        }
    }

    pub(crate) fn address(&self) -> BrokerAddress {
        match self {
            Self::Mosquitto(broker) => broker.address(),
            Self::Nats(broker) => broker.address(),
        }
    }

    pub(crate) fn kill(&mut self) {
        match self {
            Self::Mosquitto(broker) => broker.kill(),
            Self::Nats(broker) => broker.kill(),
        }
    }

    pub(crate) fn revive(&mut self) {
        match self {
            Self::Mosquitto(broker) => broker.revive(),
            Self::Nats(broker) => broker.revive(),
        }
    }
}

/// A message as the subscriber got it.
#[derive(Debug, Clone)]
pub(crate) struct ReceivedMessage {
    pub(crate) topic: RegionTopic,
    payload: Bytes,
    pub(crate) is_retained: bool,
    pub(crate) at: Timestamp,
}

impl ReceivedMessage {
    /// The payload, if the topic is of this kind.
    fn read<T: Payload>(&self, kind: RegionTopicKind) -> Option<T> {
        (self.topic.kind == kind).then(|| decode(&self.payload, &Limits::default()).unwrap())
    }
}

/// A subscriber to all topics of the region that connects again after each break.
pub(crate) struct Subscriber {
    received: Arc<Mutex<Vec<ReceivedMessage>>>,
    client: AsyncClient,
    task: JoinHandle<()>,
}

impl Subscriber {
    pub(crate) fn new(broker: &BrokerAddress) -> Self {
        let mut options = MqttOptions::new(
            Uuid::new_v4().simple().to_string(),
            broker.host(),
            broker.port(),
        );
        options.set_keep_alive(Duration::from_secs(60));
        let (client, mut events) = AsyncClient::new(options, 64);
        let received = Arc::<Mutex<Vec<ReceivedMessage>>>::default();
        let list = Arc::clone(&received);
        let subscriber = client.clone();
        let task = tokio::spawn(async move {
            loop {
                match events.poll().await {
                    Ok(Event::Incoming(Incoming::ConnAck(_))) => {
                        subscriber
                            .try_subscribe("ecod/v1/geo/#", QoS::AtMostOnce)
                            .unwrap();
                    }
                    Ok(Event::Incoming(Incoming::Publish(publish)))
                        if !publish.payload.is_empty() =>
                    {
                        // Junk that a test publishes itself does not count as a message of a cell.
                        let Some(topic) = RegionTopic::parse(&publish.topic) else {
                            continue;
                        };
                        let at = clock::now();
                        let received = ReceivedMessage {
                            topic,
                            payload: publish.payload,
                            is_retained: publish.retain,
                            at,
                        };
                        list.lock().unwrap().push(received);
                    }
                    Ok(_) => {}
                    Err(_) => tokio::time::sleep(Duration::from_millis(20)).await,
                }
            }
        });
        Self {
            received,
            client,
            task,
        }
    }

    pub(crate) async fn publish(&self, topic: &RegionTopic, payload: impl Into<Vec<u8>>) {
        self.publish_at(&topic.path(), payload).await;
    }

    pub(crate) async fn publish_at(&self, topic: &str, payload: impl Into<Vec<u8>>) {
        self.client
            .publish(topic, QoS::AtMostOnce, false, payload.into())
            .await
            .unwrap();
    }

    pub(crate) fn received(&self) -> Vec<ReceivedMessage> {
        self.received.lock().unwrap().clone()
    }

    /// Maps of a cell and when they came.
    pub(crate) fn maps(&self, cell: &str) -> Vec<(CellMap, Timestamp)> {
        let of_cell = |received: &ReceivedMessage| received.topic.cell.as_str() == cell;
        let maps = self.received().into_iter().filter(of_cell);
        maps.filter_map(|received| Some((received.read(RegionTopicKind::Map)?, received.at)))
            .collect()
    }

    /// The last status of a cell's leader.
    pub(crate) fn status(&self, cell: &str) -> Option<NodeStatus> {
        self.last(cell, RegionTopicKind::Status)
    }

    /// The last description of a cell.
    pub(crate) fn description(&self, cell: &str) -> Option<CellDescription> {
        self.last(cell, RegionTopicKind::Cell)
    }

    fn last<T: Payload>(&self, cell: &str, kind: RegionTopicKind) -> Option<T> {
        let received = self.received();
        received
            .iter()
            .rev()
            .filter(|received| received.topic.cell.as_str() == cell)
            .find_map(|received| received.read(kind))
    }
}

impl Drop for Subscriber {
    fn drop(&mut self) {
        self.task.abort();
    }
}

/// The longest time between two maps.
pub(crate) fn longest_gap(maps: &[(CellMap, Timestamp)]) -> Duration {
    maps.windows(2)
        .map(|pair| pair[1].1.since(pair[0].1))
        .max()
        .unwrap_or_default()
}

/// The maps that subscribers take: each later than all before. Where two lead for a moment, the later epoch's count.
pub(crate) fn in_order(maps: Vec<(CellMap, Timestamp)>) -> Vec<(CellMap, Timestamp)> {
    let mut taken: Vec<(CellMap, Timestamp)> = Vec::new();
    for (message, at) in maps {
        if taken
            .last()
            .is_none_or(|(last, _)| order(last) < order(&message))
        {
            taken.push((message, at));
        }
    }
    taken
}

fn order(message: &CellMap) -> (u64, NodeName, u64) {
    (
        message.map.epoch,
        message.map.aggregator.clone(),
        message.map.round,
    )
}

/// Maps come in the order of epoch and round, each once.
#[track_caller]
pub(crate) fn assert_in_order(maps: &[(CellMap, Timestamp)]) {
    for pair in maps.windows(2) {
        assert!(
            order(&pair[0].0) < order(&pair[1].0),
            "{:?} after {:?}",
            order(&pair[1].0),
            order(&pair[0].0)
        );
    }
}
