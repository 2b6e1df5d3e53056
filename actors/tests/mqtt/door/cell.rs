//! Real nodes, each on a separate runtime, and plain MQTT clients at their doors.

use std::collections::BTreeSet;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use ecod::leadership::Rights;
use ecod::model::names::NodeName;
use ecod::perception::landmark::LandmarkConfig;
use ecod::wire::{Encoding, GlobalMap, ObjectReport, PerceivedObject, Role, decode, encode};
use ecod_actors::node::NodeHandle;
use ecod_actors::node::config::NodeConfig;
use ecod_actors::platform::clock;
use ecod_actors::transport::pki::{Authority, BrokerTrust, Credentials};
use ecod_testkit::{loopback, node_config};
use rumqttc::v5::mqttbytes::QoS;
use rumqttc::v5::mqttbytes::v5::Packet;
use rumqttc::v5::{AsyncClient, Event, MqttOptions};
use rumqttc::{TlsConfiguration, Transport};
use tokio::task::JoinHandle;
use uuid::Uuid;

/// Maximum time for anything.
pub(crate) const PATIENCE: Duration = Duration::from_secs(30);

pub(crate) struct Cell {
    /// Their directory also has the certificates.
    nodes: ecod_testkit::Cell,
    authority: Option<Authority>,
}

impl Cell {
    pub(crate) fn new() -> Self {
        Self {
            nodes: ecod_testkit::Cell::new(config),
            authority: None,
        }
    }

    /// A cell whose nodes and programs have certificates.
    pub(crate) fn with_certificates() -> Self {
        let cell = Self::new();
        let authority = Authority::init(
            &cell.nodes.directory().join("pki"),
            &NodeName::from_static("lot"),
            clock::now(),
        );
        Self {
            authority: Some(authority.unwrap()),
            ..cell
        }
    }

    /// An edge, two vehicles that may lead, and one vehicle that may not. All follow the edge, and gauss is the
    /// standby.
    pub(crate) async fn of_four() -> Self {
        Self::of_four_with(|_| ()).await
    }

    pub(crate) async fn of_four_with(adjust: impl Fn(&mut NodeConfig)) -> Self {
        Self::new().and_four(adjust).await
    }

    pub(crate) async fn and_four(self, adjust: impl Fn(&mut NodeConfig)) -> Self {
        let mut cell = self;
        let nodes = [
            ("edge", Role::Edge),
            ("gauss", Role::Auto),
            ("noether", Role::Auto),
            ("euclid", Role::Cav),
        ];
        for (name, role) in nodes {
            cell.start(name, role, |config| {
                config.election.priority = if name == "gauss" { 200 } else { 100 };
                adjust(config);
            })
            .await;
        }
        cell.served_by("edge").await;
        cell.stands_by("gauss").await;
        cell
    }

    /// Waits until every node takes maps of this node.
    pub(crate) async fn served_by(&self, name: &str) {
        let all = |cell: &Self| {
            cell.sources()
                .iter()
                .all(|source| source.as_deref() == Some(name))
        };
        self.until(&format!("{name} serves all"), all).await;
    }

    /// Waits until every node has this node as the standby, and a link to it.
    pub(crate) async fn stands_by(&self, name: &str) {
        let standby = |node: &NodeHandle| {
            node.leadership()
                .borrow()
                .standby
                .as_ref()
                .map(ToString::to_string)
        };
        let all = |cell: &Self| {
            cell.nodes
                .nodes()
                .all(|(_, node)| standby(node).as_deref() == Some(name))
        };
        self.until(&format!("{name} is the standby"), all).await;
        tokio::time::sleep(Duration::from_millis(300)).await;
    }

    pub(crate) async fn start(
        &mut self,
        name: &str,
        role: Role,
        adjust: impl FnOnce(&mut NodeConfig),
    ) {
        let mut config = self.nodes.config(name, role);
        config.membership.bind = Some(loopback());
        let seeds = self
            .nodes
            .nodes()
            .filter_map(|(_, node)| node.gossip_address());
        config.membership.seeds = seeds.map(|address| address.to_string()).collect();
        if let Some(authority) = &mut self.authority {
            let node = NodeName::new(name).unwrap();
            let year = Duration::from_secs(365 * 86_400);
            authority
                .issue(
                    &node,
                    Rights {
                        priority: u8::MAX,
                        ..Rights::from(role)
                    },
                    year,
                    clock::now(),
                )
                .unwrap();
            config.tls = Some(authority.tls_of(&node));
        }
        adjust(&mut config);
        config.validate().unwrap();
        self.nodes.start_with(config).await;
    }

    /// A program at a node's door, with the node's certificate if there are any.
    pub(crate) async fn program(&self, id: &str, node: &str, filters: &[&str]) -> Program {
        self.program_with(id, node, node, filters).await
    }

    /// A program at one node's door, with the certificate of another.
    pub(crate) async fn program_with(
        &self,
        id: &str,
        door: &str,
        owner: &str,
        filters: &[&str],
    ) -> Program {
        let door = self.door(door);
        let Some(authority) = &self.authority else {
            return Program::connect(id, door, filters).await;
        };
        let owner = NodeName::new(owner).unwrap();
        let id = format!("{owner}--{id}-{}", Uuid::new_v4().simple());
        let credentials = Credentials::load(&authority.tls_of(&owner), &owner).unwrap();
        let tls = TlsConfiguration::Rustls(BrokerTrust::of_door(&credentials).client());
        let mut options = MqttOptions::new(id, door.ip().to_string(), door.port());
        options.set_transport(Transport::tls_with_config(tls));
        Program::connect_with(options, filters).await
    }

    fn map_log(&self, name: &str) -> PathBuf {
        self.nodes.directory().join(format!("{name}.maps"))
    }

    /// The maps that a node has accepted, by its log.
    pub(crate) fn accepted(&self, name: &str) -> Vec<Round> {
        let text = std::fs::read_to_string(self.map_log(name)).unwrap_or_default();
        let whole = text.rsplit_once('\n').map_or("", |(whole, _)| whole);
        let map = |line| serde_json::from_str::<serde_json::Value>(line).unwrap()["map"].take();
        whole
            .lines()
            .map(|line| round_of(&serde_json::from_value(map(line)).unwrap()))
            .collect()
    }

    /// Waits until each program has its node's newest map: it has got exactly the maps that the node accepted, in order.
    /// The result is who led in them.
    pub(crate) async fn have_exactly(&self, programs: &[(&str, Program)]) -> Vec<BTreeSet<String>> {
        let mut leaders = Vec::new();
        for (name, program) in programs {
            let accepted = self.accepted(name);
            let last = accepted.last().expect("the node accepts maps");
            let got = || {
                program
                    .rounds()
                    .into_iter()
                    .map(|(round, _)| round)
                    .collect::<Vec<_>>()
            };
            self.until("the program has its node's newest map", |_| {
                got().contains(last)
            })
            .await;
            let mut got = got();
            got.truncate(1 + got.iter().position(|round| round == last).unwrap());
            let since = accepted
                .iter()
                .position(|round| *round == got[0])
                .expect("the node accepted the first");
            assert_eq!(got, accepted[since..], "{name}");
            leaders.push(got.into_iter().map(|(_, leader, _)| leader).collect());
        }
        leaders
    }

    /// Ends all tasks of a node where they are; its sockets close.
    pub(crate) fn kill(&mut self, name: &str) {
        self.nodes.kill(name);
    }

    pub(crate) async fn stop(self) {
        self.nodes.stop().await;
    }

    pub(crate) fn node(&self, name: &str) -> &NodeHandle {
        self.nodes.node(name)
    }

    pub(crate) fn names(&self) -> Vec<String> {
        self.nodes.names()
    }

    pub(crate) fn door(&self, name: &str) -> SocketAddr {
        self.node(name).listens_at().expect("the node listens")
    }

    /// Whose map each node took last.
    pub(crate) fn sources(&self) -> Vec<Option<String>> {
        let source = |(_, node): (&str, &NodeHandle)| {
            node.newest_map()
                .borrow()
                .as_ref()
                .map(|received| received.map.aggregator.to_string())
        };
        self.nodes.nodes().map(source).collect()
    }

    pub(crate) async fn until(&self, what: &str, holds: impl Fn(&Self) -> bool) {
        let deadline = Instant::now() + PATIENCE;
        while !holds(self) {
            assert!(
                Instant::now() < deadline,
                "never: {what}: {:?}",
                self.sources()
            );
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
    }

    /// Every round that a node accepts from now on, and when.
    pub(crate) fn watch(&self, name: &str) -> Arc<Mutex<Vec<(Round, Instant)>>> {
        let mut maps = self.node(name).newest_map();
        let seen = Arc::<Mutex<Vec<_>>>::default();
        let rounds = Arc::clone(&seen);
        tokio::spawn(async move {
            while maps.changed().await.is_ok() {
                let at = Instant::now();
                let round = maps
                    .borrow_and_update()
                    .as_ref()
                    .map(|received| round_of(&received.map));
                rounds
                    .lock()
                    .unwrap()
                    .extend(round.map(|round| (round, at)));
            }
        });
        seen
    }
}

/// A node with its map log in the directory.
fn config(name: &str, role: Role, directory: &Path) -> NodeConfig {
    NodeConfig {
        map_log: Some(directory.join(format!("{name}.maps"))),
        landmarks: vec![
            LandmarkConfig::at("west", 0.0, 0.0),
            LandmarkConfig::at("east", 3.0, 0.0),
        ],
        ..node_config(name, "lot", role)
    }
}

/// Epoch, aggregator and round.
pub(crate) type Round = (u64, String, u64);

pub(crate) fn round_of(map: &GlobalMap) -> Round {
    (map.epoch, map.aggregator.to_string(), map.round)
}

/// A message as a program gets it.
#[derive(Debug, Clone)]
pub(crate) struct ReceivedMessage {
    pub(crate) topic: String,
    pub(crate) payload: Vec<u8>,
    pub(crate) at: Instant,
}

/// A plain MQTT 5 client.
pub(crate) struct Program {
    client: AsyncClient,
    received: Arc<Mutex<Vec<ReceivedMessage>>>,
    answers: Arc<Mutex<Vec<(String, String)>>>,
    task: JoinHandle<()>,
}

impl Program {
    /// Connects and subscribes; returns once the broker has answered.
    pub(crate) async fn connect(id: &str, door: SocketAddr, filters: &[&str]) -> Self {
        Self::connect_with(
            MqttOptions::new(id, door.ip().to_string(), door.port()),
            filters,
        )
        .await
    }

    async fn connect_with(mut options: MqttOptions, filters: &[&str]) -> Self {
        options.set_max_packet_size(Some(1 << 20));
        let (client, mut events) = AsyncClient::new(options, 64);
        for filter in filters {
            client
                .subscribe(format!("ecod/v1/lot/{filter}"), QoS::AtLeastOnce)
                .await
                .unwrap();
        }
        let received = Arc::<Mutex<Vec<_>>>::default();
        let answers = Arc::<Mutex<Vec<_>>>::default();
        let messages = Arc::clone(&received);
        let acknowledgements = Arc::clone(&answers);
        let (ready, mut is_ready) = tokio::sync::mpsc::unbounded_channel();
        let task = tokio::spawn(async move {
            loop {
                match events.poll().await {
                    Ok(Event::Incoming(Packet::Publish(publish))) => {
                        messages.lock().unwrap().push(ReceivedMessage {
                            topic: String::from_utf8(publish.topic.to_vec()).unwrap(),
                            payload: publish.payload.to_vec(),
                            at: Instant::now(),
                        });
                    }
                    Ok(Event::Incoming(Packet::ConnAck(_) | Packet::SubAck(_))) => {
                        let _ = ready.send(());
                    }
                    Ok(Event::Incoming(Packet::PubAck(answer))) => {
                        let text = answer
                            .properties
                            .and_then(|properties| properties.reason_string);
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
            tokio::time::timeout(PATIENCE, is_ready.recv())
                .await
                .expect("the door answers");
        }
        Self {
            client,
            received,
            answers,
            task,
        }
    }

    pub(crate) fn received(&self) -> Vec<ReceivedMessage> {
        self.received.lock().unwrap().clone()
    }

    pub(crate) fn received_on(&self, topic: &str) -> Vec<ReceivedMessage> {
        self.received()
            .into_iter()
            .filter(|received| received.topic == format!("ecod/v1/lot/{topic}"))
            .collect()
    }

    /// The maps so far, and when they came.
    pub(crate) fn rounds(&self) -> Vec<(Round, Instant)> {
        let maps = self.received_on("global_detections").into_iter();
        maps.map(|received| {
            (
                round_of(&decode(&received.payload, &Default::default()).unwrap()),
                received.at,
            )
        })
        .collect()
    }

    pub(crate) async fn publish(&self, topic: &str, payload: Vec<u8>, qos: QoS) {
        self.client
            .publish(format!("ecod/v1/lot/{topic}"), qos, false, payload)
            .await
            .unwrap();
    }

    /// Reports a car at a place.
    pub(crate) async fn report(&self, topic: &str, name: &str, seq: u64, x_m: f64) {
        self.send(topic, name, seq, PerceivedObject::new("car", 0.9, x_m, 0.0))
            .await;
    }

    /// Votes for a car at a landmark.
    pub(crate) async fn vote(&self, name: &str, seq: u64, landmark: &str) {
        let car = PerceivedObject::new("car", 0.9, 0.0, 0.0);
        self.send(
            "vote_detections",
            name,
            seq,
            PerceivedObject {
                landmark: Some(landmark.into()),
                ..car
            },
        )
        .await;
    }

    async fn send(&self, topic: &str, name: &str, seq: u64, object: PerceivedObject) {
        let report = ObjectReport {
            objects: vec![object],
            ..ObjectReport::new(NodeName::new(name).unwrap(), seq, clock::now())
        };
        self.publish(
            &format!("{topic}/{name}"),
            encode(&report, Encoding::Json),
            QoS::AtMostOnce,
        )
        .await;
    }

    /// Publishes with QoS 1; the reason and its text in the answer.
    pub(crate) async fn ask(&self, topic: &str, payload: Vec<u8>) -> (String, String) {
        self.ask_retained(topic, payload, false).await
    }

    pub(crate) async fn ask_retained(
        &self,
        topic: &str,
        payload: Vec<u8>,
        retain: bool,
    ) -> (String, String) {
        let before = self.answers.lock().unwrap().len();
        self.client
            .publish(
                format!("ecod/v1/lot/{topic}"),
                QoS::AtLeastOnce,
                retain,
                payload,
            )
            .await
            .unwrap();
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
