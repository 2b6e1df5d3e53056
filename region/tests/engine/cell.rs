//! A cell on its region's broker, as its leader is there.

use std::sync::{Arc, Mutex};
use std::time::Duration;

use ecod::model::epoch::Epoch;
use ecod::model::geometry::Covariance;
use ecod::model::names::NodeName;
use ecod::model::origin::GeographicOrigin;
use ecod::wire::{
    CellMap, Encoding, FusedObject, GlobalMap, NodeState, NodeStatus, RegionTopic, RegionTopicKind,
    Role, SCHEMA_VERSION, encode,
};
use ecod_actors::platform::clock;
use ecod_region::account::CellAccount;
use ecod_testkit::until;
use rumqttc::{AsyncClient, Event, LastWill, Packet, QoS, SubscribeFilter, SubscribeReasonCode};
use tokio::task::JoinHandle;
use uuid::Uuid;

use crate::broker::{Broker, PlacedCell};

/// A cell's connection, and what came on it.
pub(crate) struct Cell {
    pub(crate) account: CellAccount,
    origin: GeographicOrigin,
    pub(crate) client: AsyncClient,
    received: Arc<Mutex<Received>>,
    polling: JoinHandle<()>,
}

/// Answers and messages of the broker.
#[derive(Debug, Default, Clone)]
pub(crate) struct Received {
    pub(crate) logins: usize,
    pub(crate) is_refused: bool,
    pub(crate) granted: Vec<bool>,
    pub(crate) topics: Vec<String>,
}

impl Cell {
    /// Connects as this user.
    pub(crate) fn connect(broker: &Broker, cell: PlacedCell) -> Self {
        let origin = GeographicOrigin {
            latitude_deg: cell.latitude_deg,
            longitude_deg: cell.longitude_deg,
            height_m: 0.0,
            rotation_deg: 0.0,
        };
        let (client, mut events) = AsyncClient::new(broker.login(cell.name).options(), 4096);
        let received = Arc::new(Mutex::new(Received::default()));
        let noted = Arc::clone(&received);
        let polling = tokio::spawn(async move {
            loop {
                let event = events.poll().await;
                let mut noted = noted.lock().unwrap();
                match event {
                    Ok(Event::Incoming(Packet::ConnAck(_))) => noted.logins += 1,
                    Ok(Event::Incoming(Packet::SubAck(answer))) => {
                        let granted =
                            |code: &SubscribeReasonCode| *code != SubscribeReasonCode::Failure;
                        noted
                            .granted
                            .extend(answer.return_codes.iter().map(granted));
                    }
                    Ok(Event::Incoming(Packet::Publish(message))) => {
                        noted.topics.push(message.topic);
                    }
                    Err(rumqttc::ConnectionError::ConnectionRefused(_)) => {
                        noted.is_refused = true;
                        return;
                    }
                    Err(_) => {
                        drop(noted);
                        tokio::time::sleep(Duration::from_millis(100)).await;
                    }
                    Ok(_) => {}
                }
            }
        });
        Self {
            account: CellAccount::new(NodeName::from_static(cell.name), &origin),
            origin,
            client,
            received,
            polling,
        }
    }

    /// Logs in as this user with a last will, if the broker lets it, and is gone without goodbye.
    pub(crate) async fn vanish(broker: &Broker, user: &str, topic: &str, retain: bool) {
        let mut options = broker.login(user).options();
        options.set_last_will(LastWill::new(topic, "a last will", QoS::AtMostOnce, retain));
        let (_client, mut events) = AsyncClient::new(options, 4);
        while let Ok(event) = events.poll().await {
            if let Event::Incoming(Packet::ConnAck(_)) = event {
                break;
            }
        }
    }

    pub(crate) fn received(&self) -> Received {
        self.received.lock().unwrap().clone()
    }

    /// A topic of this cell.
    pub(crate) fn topic(&self, kind: RegionTopicKind) -> String {
        RegionTopic {
            tile: self.account.tile,
            cell: self.account.cell.clone(),
            kind,
        }
        .path()
    }

    /// Publishes without waiting.
    pub(crate) fn publish(&self, topic: &str, retain: bool, payload: Vec<u8>) {
        self.client
            .try_publish(topic, QoS::AtMostOnce, retain, payload)
            .unwrap();
    }

    /// Publishes the map of a round, with so many objects, one of which is a vehicle.
    pub(crate) fn publish_map(&self, round: u64, objects: usize) {
        self.publish(
            &self.topic(RegionTopicKind::Map),
            false,
            encode(&self.map(round, objects), Encoding::Compact),
        );
    }

    pub(crate) fn map(&self, round: u64, objects: usize) -> CellMap {
        let now = clock::now();
        let epoch = Epoch::new(1, NodeName::from_static("edge"));
        let object = |number: usize| FusedObject {
            velocity_mps: Some([1.0, 2.0]),
            vehicle: (number == 0).then(|| NodeName::from_static("euclid")),
            ..FusedObject::new(
                Uuid::from_u128(number as u128),
                "car",
                0.9,
                number as f64,
                5.0,
                Covariance::isotropic(0.1),
            )
        };
        let objects = (0..objects).map(object).collect();
        let map = GlobalMap {
            objects,
            ..GlobalMap::new(&epoch, round, now)
        };
        CellMap {
            schema: SCHEMA_VERSION,
            cell: self.account.cell.clone(),
            sent_at_us: now,
            origin: self.origin,
            map,
        }
    }

    /// The status of its leader.
    pub(crate) fn status(&self, state: NodeState) -> Vec<u8> {
        let starting = NodeStatus::starting(
            NodeName::from_static("edge"),
            Uuid::nil(),
            Role::Edge,
            "0.1.0",
        );
        let page = Some("10.0.0.3:8080".to_owned());
        let aggregator = Some(NodeName::from_static("edge"));
        encode(
            &NodeStatus {
                state,
                epoch: 1,
                aggregator,
                page,
                ..starting
            },
            Encoding::Json,
        )
    }

    /// Subscribes, and returns what the broker granted.
    pub(crate) async fn subscribe(&self, filters: &[String]) -> Vec<bool> {
        let before = self.received().granted.len();
        let wanted = filters
            .iter()
            .map(|filter| SubscribeFilter::new(filter.clone(), QoS::AtMostOnce));
        self.client.subscribe_many(wanted).await.unwrap();
        until("the broker answers", || {
            self.received().granted.len() == before + filters.len()
        })
        .await;
        self.received().granted.split_off(before)
    }
}

impl Drop for Cell {
    fn drop(&mut self) {
        self.polling.abort();
    }
}
