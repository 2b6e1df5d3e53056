//! Simulated cells: each the connection of a leader that publishes its maps, and nothing while it has none.

use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use ecod::leadership::BrokerAddress;
use ecod::model::epoch::Epoch;
use ecod::model::geometry::Covariance;
use ecod::model::names::NodeName;
use ecod::model::quadkey::Quadkey;
use ecod::model::time::Timestamp;
use ecod::wire::{
    CellMap, Encoding, FusedObject, GlobalMap, NodeState, NodeStatus, RegionTopic, RegionTopicKind,
    Role, SCHEMA_VERSION, encode,
};
use ecod_actors::platform::clock;
use ecod_region::broker::BrokerLogin;
use rumqttc::{AsyncClient, Event, LastWill, NetworkOptions, Packet, QoS};
use tokio::runtime::Runtime;
use tokio::time::{Instant, MissedTickBehavior, interval_at, sleep};
use uuid::Uuid;

use crate::cluster::{Cluster, PASSWORD};
use crate::places::Place;

/// Cells that run; ended when dropped.
pub(crate) struct Fleet {
    sent: Arc<AtomicU64>,
    _runtime: Runtime,
}

impl Fleet {
    pub(crate) fn start(
        places: &[Place],
        cluster: &Cluster,
        hz: f64,
        objects: usize,
    ) -> anyhow::Result<Self> {
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .worker_threads(2)
            .enable_all()
            .build()?;
        let sent = Arc::new(AtomicU64::new(0));
        for (number, place) in places.iter().enumerate() {
            let cell = SimulatedCell {
                place: place.clone(),
                servers: cluster.addresses(),
                number,
                period: Duration::from_secs_f64(1.0 / hz),
                objects,
                sent: Arc::clone(&sent),
            };
            runtime.spawn(cell.run());
        }
        Ok(Self {
            sent,
            _runtime: runtime,
        })
    }

    /// Maps that were sent so far.
    pub(crate) fn sent(&self) -> u64 {
        self.sent.load(Ordering::Relaxed)
    }
}

struct SimulatedCell {
    place: Place,
    servers: Vec<SocketAddr>,
    number: usize,
    period: Duration,
    objects: usize,
    sent: Arc<AtomicU64>,
}

/// First and longest wait before the next attempt to connect.
const RETRY_MIN: Duration = Duration::from_millis(50);
const RETRY_MAX: Duration = Duration::from_secs(5);

/// Time for a login in seconds. Servers that elect a JetStream leader take up to 4 s. Thousands of cells that give up
/// before and ask again keep them from ever answering.
const LOGIN_TIMEOUT_S: u64 = 10;

/// Silence after which a broker is asked whether it is there, and then given up.
const KEEP_ALIVE: Duration = Duration::from_secs(5);

impl SimulatedCell {
    async fn run(self) {
        // Cells do not start, send and return all at once.
        let share = (self.number as f64 * 0.618_034).fract();
        let mut server = self.number;
        let mut round = 0;
        let mut wait = RETRY_MIN;
        sleep(self.period.mul_f64(share)).await;
        loop {
            let address = self.servers[server % self.servers.len()];
            if self.connection(address, share, &mut round).await {
                wait = RETRY_MIN;
            }
            // The next one: an address in front of the servers does the same.
            server += 1;
            sleep(wait.mul_f64(0.5 + share / 2.0)).await;
            wait = (2 * wait).min(RETRY_MAX);
        }
    }

    /// One connection until it ends; true if there was one.
    async fn connection(&self, address: SocketAddr, share: f64, round: &mut u64) -> bool {
        let Place { cell, origin } = &self.place;
        let tile = Quadkey::of_cell(origin);
        let topic = |kind| {
            RegionTopic {
                tile,
                cell: cell.clone(),
                kind,
            }
            .path()
        };
        let mut options =
            BrokerLogin::plain(BrokerAddress::from(address), cell.as_str(), PASSWORD).options();
        options.set_keep_alive(KEEP_ALIVE);
        let gone = encode(&status(NodeState::Offline), Encoding::Json);
        options.set_last_will(LastWill::new(
            topic(RegionTopicKind::Status),
            gone,
            QoS::AtMostOnce,
            true,
        ));
        let (client, mut events) = AsyncClient::new(options, 8);
        let mut network = NetworkOptions::new();
        network.set_connection_timeout(LOGIN_TIMEOUT_S);
        network.set_tcp_nodelay(true);
        events.set_network_options(network);
        loop {
            match events.poll().await {
                Ok(Event::Incoming(Packet::ConnAck(_))) => break,
                Ok(_) => {}
                Err(_) => return false,
            }
        }
        let template = MapTemplate::new(&self.map(TEMPLATE_ROUND, TEMPLATE_TIME));
        let present = encode(&status(NodeState::Aggregating), Encoding::Json);
        // A new connection has room for its first message.
        let _ = client.try_publish(
            topic(RegionTopicKind::Status),
            QoS::AtMostOnce,
            true,
            present,
        );
        let publishing = async {
            let mut ticks = interval_at(Instant::now() + self.period.mul_f64(share), self.period);
            ticks.set_missed_tick_behavior(MissedTickBehavior::Skip);
            loop {
                ticks.tick().await;
                let payload = template.map(*round + 1, clock::now());
                // A full queue is that of a hanging server: this map is dropped.
                if client
                    .try_publish(topic(RegionTopicKind::Map), QoS::AtMostOnce, false, payload)
                    .is_ok()
                {
                    *round += 1;
                    self.sent.fetch_add(1, Ordering::Relaxed);
                }
            }
        };
        let polling = async { while events.poll().await.is_ok() {} };
        tokio::select! {
            () = publishing => {}
            () = polling => {}
        }
        true
    }

    fn map(&self, round: u64, now: Timestamp) -> CellMap {
        let object = |number: usize| {
            let id = Uuid::from_u128((self.number * 1000 + number) as u128);
            let angle = 0.2 * number as f64;
            let x_m = 80.0 * angle.cos();
            let y_m = 80.0 * angle.sin();
            let contributors = vec![
                NodeName::from_static("euclid"),
                NodeName::from_static("gauss"),
            ];
            FusedObject {
                contributors,
                existence: Some(0.97),
                velocity_mps: Some([3.0 * angle.sin(), -3.0 * angle.cos()]),
                heading_rad: Some(angle),
                first_seen_us: Some(now),
                scores: [("car".into(), 0.9), ("van".into(), 0.1)].into(),
                ..FusedObject::new(id, "car", 0.9, x_m, y_m, Covariance::isotropic(0.1))
            }
        };
        let epoch = Epoch::new(1, NodeName::from_static("edge"));
        let map = GlobalMap {
            oldest_capture_us: Some(now),
            objects: (0..self.objects).map(object).collect(),
            ..GlobalMap::new(&epoch, round, now)
        };
        let origin = self.place.origin;
        CellMap {
            schema: SCHEMA_VERSION,
            cell: self.place.cell.clone(),
            sent_at_us: now,
            origin,
            map,
        }
    }
}

/// An encoded map whose round and times are replaced, so that a machine can play thousands of cells.
struct MapTemplate {
    payload: Vec<u8>,
    /// Where the round is, and the times.
    round_at: Vec<usize>,
    times_at: Vec<usize>,
}

/// Values of a template; both have the length in CBOR of all that take their place.
const TEMPLATE_ROUND: u64 = 0x5eed_0001;
const TEMPLATE_TIME: Timestamp = Timestamp(0x0005_eed0_5eed_0002);

impl MapTemplate {
    fn new(map: &CellMap) -> Self {
        let payload = encode(map, Encoding::Compact);
        let places = |wanted: &[u8]| {
            let found = payload
                .windows(wanted.len())
                .enumerate()
                .filter(|(_, window)| *window == wanted);
            found.map(|(at, _)| at).collect()
        };
        let round_at = places(&(TEMPLATE_ROUND as u32).to_be_bytes());
        let times_at = places(&TEMPLATE_TIME.micros().to_be_bytes());
        Self {
            payload,
            round_at,
            times_at,
        }
    }

    fn map(&self, round: u64, now: Timestamp) -> Vec<u8> {
        let mut payload = self.payload.clone();
        for at in &self.round_at {
            payload[*at..*at + 4].copy_from_slice(&(FIRST_ROUND + round as u32).to_be_bytes());
        }
        for at in &self.times_at {
            payload[*at..*at + 8].copy_from_slice(&now.micros().to_be_bytes());
        }
        payload
    }
}

/// The first number that takes four bytes, less one.
const FIRST_ROUND: u32 = 0xffff;

fn status(state: NodeState) -> NodeStatus {
    let edge = NodeName::from_static("edge");
    let starting = NodeStatus::starting(
        edge.clone(),
        Uuid::nil(),
        Role::Edge,
        env!("CARGO_PKG_VERSION"),
    );
    let aggregator = (state == NodeState::Aggregating).then_some(edge);
    NodeStatus {
        state,
        epoch: 1,
        aggregator,
        ..starting
    }
}
