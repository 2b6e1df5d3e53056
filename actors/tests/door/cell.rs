//! Real nodes, each on a runtime of its own, and plain MQTT clients at their doors.

use std::collections::BTreeMap;
use std::net::{SocketAddr, UdpSocket};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use ecod::model::names::NodeName;
use ecod::perception::landmark::LandmarkConfig;
use ecod::wire::{Encoding, GlobalMap, ObjectReport, PerceivedObject, Role, decode, encode};
use ecod_actors::node::config::NodeConfig;
use ecod_actors::node::{self, NodeHandle};
use ecod_actors::platform::clock;
use rumqttc::v5::mqttbytes::QoS;
use rumqttc::v5::mqttbytes::v5::Packet;
use rumqttc::v5::{AsyncClient, Event, MqttOptions};
use tokio::runtime::{Builder, Runtime};
use tokio::task::JoinHandle;
use tracing_subscriber::EnvFilter;

/// How long anything may take.
pub(crate) const PATIENCE: Duration = Duration::from_secs(30);

pub(crate) struct Cell {
    seed: SocketAddr,
    nodes: BTreeMap<String, (NodeHandle, Runtime)>,
}

impl Cell {
    pub(crate) fn new() -> Self {
        tracing_subscriber::fmt().with_env_filter(EnvFilter::from_default_env()).try_init().ok();
        Self { seed: UdpSocket::bind("127.0.0.1:0").unwrap().local_addr().unwrap(), nodes: BTreeMap::new() }
    }

    /// An edge, two vehicles that may lead, and one that may not; all follow the edge, and gauss stands by.
    pub(crate) async fn of_four() -> Self {
        Self::of_four_with(|_| ()).await
    }

    pub(crate) async fn of_four_with(adjust: impl Fn(&mut NodeConfig)) -> Self {
        let mut cell = Self::new();
        let nodes = [("edge", Role::Edge), ("gauss", Role::Auto), ("noether", Role::Auto), ("euclid", Role::Cav)];
        for (name, role) in nodes {
            cell.start(name, role, |config| {
                config.election.priority = if name == "gauss" { 200 } else { 100 };
                adjust(config);
            })
            .await;
        }
        cell.until("the edge serves all", |cell| cell.sources().iter().all(|source| source.as_deref() == Some("edge")))
            .await;
        cell.until("gauss is the standby", |cell| {
            cell.nodes.values().all(|(node, _)| {
                node.leadership().borrow().standby.as_ref().is_some_and(|name| name.as_str() == "gauss")
            })
        })
        .await;
        tokio::time::sleep(Duration::from_millis(300)).await;
        cell
    }

    pub(crate) async fn start(&mut self, name: &str, role: Role, adjust: impl FnOnce(&mut NodeConfig)) {
        let bind = if self.nodes.is_empty() { self.seed } else { loopback() };
        let mut config = NodeConfig {
            name: Some(NodeName::new(name).unwrap()),
            cell: NodeName::from_static("lot"),
            role,
            listen: Some(loopback()),
            landmarks: vec![LandmarkConfig::at("west", 0.0, 0.0), LandmarkConfig::at("east", 3.0, 0.0)],
            ..NodeConfig::default()
        };
        config.membership.bind = Some(bind);
        config.membership.seeds = vec![self.seed.to_string()];
        config.membership.multicast.enabled = false;
        config.dashboard.enabled = false;
        adjust(&mut config);
        config.validate().unwrap();
        let runtime = Builder::new_multi_thread().worker_threads(1).enable_all().build().unwrap();
        let node = runtime.spawn(node::start(config)).await.unwrap().unwrap();
        self.nodes.insert(name.to_owned(), (node, runtime));
    }

    /// Ends all tasks of a node where they are; its sockets close.
    pub(crate) fn kill(&mut self, name: &str) {
        let (node, runtime) = self.nodes.remove(name).unwrap();
        runtime.shutdown_background();
        drop(node);
    }

    pub(crate) async fn stop(mut self) {
        while let Some((_, (node, runtime))) = self.nodes.pop_first() {
            runtime.spawn(node.stop()).await.unwrap();
            runtime.shutdown_background();
        }
    }

    pub(crate) fn node(&self, name: &str) -> &NodeHandle {
        &self.nodes[name].0
    }

    pub(crate) fn names(&self) -> Vec<String> {
        self.nodes.keys().cloned().collect()
    }

    pub(crate) fn door(&self, name: &str) -> SocketAddr {
        self.node(name).listens_at().expect("the node listens")
    }

    /// Whose map each node took last.
    pub(crate) fn sources(&self) -> Vec<Option<String>> {
        let source = |(node, _): &(NodeHandle, Runtime)| {
            node.newest_map().borrow().as_ref().map(|received| received.map.aggregator.to_string())
        };
        self.nodes.values().map(source).collect()
    }

    pub(crate) async fn until(&self, what: &str, holds: impl Fn(&Self) -> bool) {
        let deadline = Instant::now() + PATIENCE;
        while !holds(self) {
            assert!(Instant::now() < deadline, "never: {what}: {:?}", self.sources());
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
    }

    /// Every round that a node accepts from now on, and when.
    pub(crate) fn watch(&self, name: &str) -> Arc<Mutex<Vec<(Round, Instant)>>> {
        let (mut maps, seen) = (self.node(name).newest_map(), Arc::<Mutex<Vec<_>>>::default());
        let rounds = Arc::clone(&seen);
        tokio::spawn(async move {
            while maps.changed().await.is_ok() {
                let at = Instant::now();
                let round = maps.borrow_and_update().as_ref().map(|received| round_of(&received.map));
                rounds.lock().unwrap().extend(round.map(|round| (round, at)));
            }
        });
        seen
    }
}

fn loopback() -> SocketAddr {
    SocketAddr::from(([127, 0, 0, 1], 0))
}

/// Epoch, aggregator and round.
pub(crate) type Round = (u64, String, u64);

pub(crate) fn round_of(map: &GlobalMap) -> Round {
    (map.epoch, map.aggregator.to_string(), map.round)
}

/// A message as a program gets it.
#[derive(Debug, Clone)]
pub(crate) struct Heard {
    pub(crate) topic: String,
    pub(crate) payload: Vec<u8>,
    pub(crate) at: Instant,
}

/// A plain MQTT 5 client.
pub(crate) struct Program {
    client: AsyncClient,
    heard: Arc<Mutex<Vec<Heard>>>,
    answers: Arc<Mutex<Vec<(String, String)>>>,
    task: JoinHandle<()>,
}

impl Program {
    /// Connects and subscribes; returns once the broker has answered.
    pub(crate) async fn connect(id: &str, door: SocketAddr, filters: &[&str]) -> Self {
        let mut options = MqttOptions::new(id, door.ip().to_string(), door.port());
        options.set_max_packet_size(Some(1 << 20));
        let (client, mut events) = AsyncClient::new(options, 64);
        for filter in filters {
            client.subscribe(format!("ecod/v1/lot/{filter}"), QoS::AtLeastOnce).await.unwrap();
        }
        let (heard, answers) = (Arc::<Mutex<Vec<_>>>::default(), Arc::<Mutex<Vec<_>>>::default());
        let (messages, acknowledgements) = (Arc::clone(&heard), Arc::clone(&answers));
        let (ready, mut is_ready) = tokio::sync::mpsc::unbounded_channel();
        let task = tokio::spawn(async move {
            loop {
                match events.poll().await {
                    Ok(Event::Incoming(Packet::Publish(publish))) => messages.lock().unwrap().push(Heard {
                        topic: String::from_utf8(publish.topic.to_vec()).unwrap(),
                        payload: publish.payload.to_vec(),
                        at: Instant::now(),
                    }),
                    Ok(Event::Incoming(Packet::ConnAck(_) | Packet::SubAck(_))) => drop(ready.send(())),
                    Ok(Event::Incoming(Packet::PubAck(answer))) => {
                        let text = answer.properties.and_then(|properties| properties.reason_string);
                        acknowledgements
                            .lock()
                            .unwrap()
                            .push((format!("{:?}", answer.reason), text.unwrap_or_default()));
                    }
                    Ok(_) => {}
                    Err(_) => tokio::time::sleep(Duration::from_millis(20)).await,
                }
            }
        });
        for _ in 0..=filters.len() {
            tokio::time::timeout(PATIENCE, is_ready.recv()).await.expect("the door answers");
        }
        Self { client, heard, answers, task }
    }

    pub(crate) fn heard(&self) -> Vec<Heard> {
        self.heard.lock().unwrap().clone()
    }

    pub(crate) fn heard_on(&self, topic: &str) -> Vec<Heard> {
        self.heard().into_iter().filter(|heard| heard.topic == format!("ecod/v1/lot/{topic}")).collect()
    }

    /// The maps so far, and when they came.
    pub(crate) fn rounds(&self) -> Vec<(Round, Instant)> {
        let maps = self.heard_on("global_detections").into_iter();
        maps.map(|heard| (round_of(&decode(&heard.payload, &Default::default()).unwrap()), heard.at)).collect()
    }

    pub(crate) async fn publish(&self, topic: &str, payload: Vec<u8>, qos: QoS) {
        self.client.publish(format!("ecod/v1/lot/{topic}"), qos, false, payload).await.unwrap();
    }

    /// Reports a car at a place.
    pub(crate) async fn report(&self, topic: &str, name: &str, seq: u64, x_m: f64) {
        let report = ObjectReport {
            objects: vec![PerceivedObject::new("car", 0.9, x_m, 0.0)],
            ..ObjectReport::new(NodeName::new(name).unwrap(), seq, clock::now())
        };
        self.publish(&format!("{topic}/{name}"), encode(&report, Encoding::Json), QoS::AtMostOnce).await;
    }

    /// Publishes with QoS 1; the reason and its text in the answer.
    pub(crate) async fn ask(&self, topic: &str, payload: Vec<u8>) -> (String, String) {
        let before = self.answers.lock().unwrap().len();
        self.publish(topic, payload, QoS::AtLeastOnce).await;
        let deadline = Instant::now() + PATIENCE;
        loop {
            if let Some(answer) = self.answers.lock().unwrap().get(before) {
                return answer.clone();
            }
            assert!(Instant::now() < deadline, "no answer");
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    }
}

impl Drop for Program {
    fn drop(&mut self) {
        self.task.abort();
    }
}
