//! Nodes with a page, and vehicles that only exist as their reports.

use std::f64::consts::{PI, TAU};
use std::net::SocketAddr;
use std::time::Duration;

use ecod::model::names::NodeName;
use ecod::perception::landmark::LandmarkConfig;
use ecod::wire::{Encoding, FieldOfView, ObjectReport, PerceivedObject, Role, WirePose, encode};
use ecod_actors::node::config::NodeConfig;
use ecod_actors::node::{self, NodeHandle};
use ecod_actors::platform::clock;
use ecod_testkit::{PATIENCE, loopback, node_config};
use rumqttc::{AsyncClient, MqttOptions, QoS};
use tokio::task::JoinSet;

/// Configuration of a node with a page on a free port, separated from the cells of other tests.
pub(crate) fn config(name: &str, role: Role, landmarks: usize) -> NodeConfig {
    let landmark = |index: usize| {
        let (x_m, y_m) = place(index);
        LandmarkConfig {
            facing_deg: Some(if y_m > 0.0 { -90.0 } else { 90.0 }),
            ..LandmarkConfig::at(format!("slot-{index}"), x_m, y_m)
        }
    };
    let mut config = NodeConfig {
        landmarks: (0..landmarks).map(landmark).collect(),
        ..node_config(name, "lot", role)
    };
    config.dashboard.enabled = true;
    config.dashboard.listen = Some(loopback());
    config.reputations.publish_period_s = 0.2;
    config
}

/// Two rows of parking spots, three metres apart.
fn place(index: usize) -> (f64, f64) {
    (
        (index / 2) as f64 * 3.0,
        if index.is_multiple_of(2) { 4.0 } else { -4.0 },
    )
}

/// Starts a node in this process and waits for its page.
pub(crate) async fn start(config: NodeConfig) -> (NodeHandle, SocketAddr) {
    config.validate().unwrap();
    let node = node::start(config).await.unwrap();
    let mut address = node.dashboard_address();
    let address = tokio::time::timeout(PATIENCE, address.wait_for(Option::is_some))
        .await
        .expect("no page")
        .unwrap();
    (node, address.unwrap())
}

/// A node that finds the cell of another.
pub(crate) async fn join(mut config: NodeConfig, other: &NodeHandle) -> (NodeHandle, SocketAddr) {
    config.membership.seeds = vec![other.gossip_address().unwrap().to_string()];
    start(config).await
}

/// Vehicles that report ten times a second to some brokers, as vehicles do to leader and standby; ends when dropped.
pub(crate) struct Vehicles {
    _tasks: JoinSet<()>,
}

impl Vehicles {
    pub(crate) fn start(brokers: &[SocketAddr], count: usize, landmarks: usize) -> Self {
        let mut tasks = JoinSet::new();
        for vehicle in 0..count {
            for broker in brokers {
                tasks.spawn(report_to(*broker, vehicle, landmarks));
            }
        }
        Self { _tasks: tasks }
    }
}

/// A vehicle that votes now and then; ends when dropped.
pub(crate) struct Stray {
    client: AsyncClient,
    seq: u64,
    _task: JoinSet<()>,
}

impl Stray {
    pub(crate) fn start(broker: SocketAddr) -> Self {
        let options = MqttOptions::new("stray", broker.ip().to_string(), broker.port());
        let (client, mut events) = AsyncClient::new(options, 16);
        let mut tasks = JoinSet::new();
        tasks.spawn(async move {
            loop {
                if events.poll().await.is_err() {
                    tokio::time::sleep(Duration::from_millis(200)).await;
                }
            }
        });
        Self {
            client,
            seq: 0,
            _task: tasks,
        }
    }

    /// Reports from a place in the east that something stands at another.
    pub(crate) async fn report(&mut self, at_m: f64, seen_at_m: f64) {
        self.send(at_m, vec![PerceivedObject::new("car", 0.8, seen_at_m, 0.0)])
            .await;
    }

    /// Reports an empty place from a pose in the east.
    pub(crate) async fn stand(&mut self, at_m: f64) {
        self.send(at_m, Vec::new()).await;
    }

    async fn send(&mut self, at_m: f64, objects: Vec<PerceivedObject>) {
        self.seq += 1;
        let node = NodeName::from_static("stray");
        let report = ObjectReport {
            pose: Some(WirePose::new(at_m, 0.0, 0.0)),
            objects,
            ..ObjectReport::new(node, self.seq, clock::now())
        };
        let payload = encode(&report, Encoding::Json);
        self.client
            .publish(
                "ecod/v1/lot/vote_detections/stray",
                QoS::AtLeastOnce,
                false,
                payload,
            )
            .await
            .unwrap();
    }
}

async fn report_to(broker: SocketAddr, vehicle: usize, landmarks: usize) {
    let options = MqttOptions::new(
        format!("vehicle-{vehicle}"),
        broker.ip().to_string(),
        broker.port(),
    );
    let (client, mut events) = AsyncClient::new(options, 16);
    let mut ticks = tokio::time::interval(Duration::from_millis(100));
    let mut seq = 0;
    loop {
        tokio::select! {
            polled = events.poll() => if polled.is_err() {
                tokio::time::sleep(Duration::from_millis(200)).await;
            },
            _ = ticks.tick() => {
                seq += 1;
                for (kind, report) in reports(vehicle, seq, landmarks) {
                    let topic = format!("ecod/v1/lot/{kind}/{}", report.node);
                    // An absent broker receives no messages.
                    let _ = client.try_publish(topic, QoS::AtMostOnce, false, encode(&report, Encoding::Json));
                }
            }
        }
    }
}

const NAMES: [&str; 6] = ["ada", "boole", "curie", "dirac", "escher", "fermat"];

/// A vehicle's reports of the lot: parked cars at most spots, a pedestrian who walks about, and votes on what stands at
/// the first spots, about which the last vehicle errs.
fn reports(vehicle: usize, seq: u64, landmarks: usize) -> [(&'static str, ObjectReport); 2] {
    let second = clock::now().micros() as f64 / 1e6;
    let length = (landmarks / 2) as f64 * 3.0;
    let way_m = 3.0 * (second * 0.15 + vehicle as f64).sin();
    let from_west = vehicle.is_multiple_of(2);
    let (x_m, y_m) = if from_west {
        (way_m - 3.0, -0.9)
    } else {
        (length - way_m, 0.9)
    };
    let heading_rad = if from_west { 0.1 } else { PI + 0.1 };
    let pose = WirePose::new(x_m, y_m, heading_rad);
    let in_view = |x: f64, y: f64| {
        let bearing = (y - y_m).atan2(x - x_m) - heading_rad;
        let bearing = (bearing + PI).rem_euclid(TAU) - PI;
        bearing.abs() < 0.55 && (x - x_m).hypot(y - y_m) < 16.0
    };
    let object = |label: &str, x: f64, y: f64, landmark: Option<usize>| PerceivedObject {
        covariance_m2: Some([0.09, 0.02, 0.04]),
        landmark: landmark.map(|index| format!("slot-{index}").into()),
        ..PerceivedObject::new(
            label,
            0.86,
            x + 0.1 * (second + vehicle as f64).sin(),
            y + 0.1 * (second * 1.3 + vehicle as f64).cos(),
        )
    };
    let visible: Vec<usize> = (0..landmarks)
        .filter(|index| in_view(place(*index).0, place(*index).1))
        .collect();
    let parked = visible.iter().filter(|index| *index % 5 != 2);
    let mut objects: Vec<_> = parked
        .map(|index| object("car", place(*index).0, place(*index).1, Some(*index)))
        .collect();
    let walker = (
        length / 2.0 + 5.0 * (second * 0.2).cos(),
        1.6 * (second * 0.2).sin(),
    );
    if in_view(walker.0, walker.1) {
        objects.push(object("person", walker.0, walker.1, None));
    }
    let name = NAMES[vehicle % NAMES.len()];
    let node = if vehicle < NAMES.len() {
        name.to_owned()
    } else {
        format!("{name}-{vehicle}")
    };
    let node = NodeName::new(node).unwrap();
    let captured_at_us = clock::now();
    let seen = visible
        .iter()
        .map(|index| format!("slot-{index}").into())
        .collect();
    let view = Some(FieldOfView {
        range_m: 16.0,
        angle_rad: 1.1,
    });
    let map = ObjectReport {
        pose: Some(pose),
        objects,
        seen: Some(seen),
        view,
        ..ObjectReport::new(node, seq, captured_at_us)
    };
    let label = |index: usize| match (vehicle, index) {
        (3, _) => "truck",
        (_, 1) if seq.is_multiple_of(3) => "van",
        _ => "car",
    };
    let voted = visible.iter().filter(|index| **index < 6);
    let votes = voted.map(|index| {
        object(
            label(*index),
            place(*index).0,
            place(*index).1,
            Some(*index),
        )
    });
    let votes = ObjectReport {
        objects: votes.collect(),
        seen: None,
        view: None,
        ..map.clone()
    };
    [("detections", map), ("vote_detections", votes)]
}
