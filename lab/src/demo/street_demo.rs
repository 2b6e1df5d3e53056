//! The street live: every camera is on the network, every node is a process, and the results are
//! evaluated against the truth.
//!
//! ```text
//! street ── renders ──> network cameras ── MJPEG over HTTP ──> ecod-node × 4
//!        ── poses of those that drive, over UDP ──────────────────^
//! ```

use std::collections::BTreeMap;
use std::net::{Ipv4Addr, SocketAddr, UdpSocket};
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use ecod::aggregator::round::RoundConfig;
use ecod::aggregator::{Aggregator, Algorithms, Fused, FusionConfig};
use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ecod::perception::camera::Mount;
use ecod::perception::projection::ProjectionConfig;
use ecod::perception::view::ViewConfig;
use ecod::wire::{GlobalMap, ReportKind, Role};
use ecod_actors::camera::config::{CameraConfig, MountConfig, OpticsConfig};
use ecod_actors::camera::detect::DetectorConfig;
use ecod_actors::camera::detect::placard::{Pass, PlacardConfig};
use ecod_actors::camera::frame_source::SourceConfig;
use ecod_actors::camera::frame_source::capture::CaptureConfig;
use ecod_actors::camera::vehicle_pose::PoseConfig;
use ecod_actors::messages::newest::ReceivedMap;
use ecod_actors::node::config::NodeConfig;
use ecod_actors::platform::clock;
use ecod_actors::transport::gossip::{MembershipConfig, MulticastConfig};
use hashbrown::HashMap;
use nalgebra::Point2;
use serde::Serialize;

use super::judged_term::{JudgedTerm, judged_terms};
use super::report_collector::ObservedReport;
use super::stage::{Played, Progress, Stage};
use crate::eval::tracks::{
    DEFAULT_THRESHOLD, MATCH_DISTANCE_M, ReportedObject, ScoredFrame, score,
};
use crate::street::network_camera::{FRAMES_PER_S, NetworkCamera};
use crate::street::{Carrier, Street, StreetCamera};

/// The street to be run live.
#[derive(Debug, Clone, Copy)]
pub struct StreetDemo<'a> {
    /// The program that is run as every node.
    pub program: &'a Path,
    /// Time for which the maps are evaluated.
    pub duration: Duration,
    /// Directory for configurations and logs.
    pub directory: &'a Path,
    /// Address of the first vehicle's page.
    pub dashboard: SocketAddr,
}

/// Result of a run.
#[derive(Debug)]
pub struct StreetOutcome {
    /// Figures of the run, as the command prints them.
    pub result: StreetResult,
    /// Time from which on the maps are evaluated.
    pub from: Timestamp,
    /// Terms of all leaders, in order.
    pub terms: Vec<JudgedTerm>,
}

/// Figures of the street.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct StreetResult {
    /// Cars and people in the street.
    pub objects: usize,
    /// Each node alone: its knowledge from its own reports.
    pub alone: BTreeMap<NodeName, KnownShare>,
    /// Each node with the cell: its knowledge from the maps that it received.
    pub with_cell: BTreeMap<NodeName, KnownShare>,
    /// All leaders in the order of their terms.
    pub leaders: Vec<NodeName>,
    /// The node that led after the edge was killed; null if there was no such node.
    pub took_over: Option<NodeName>,
    /// Longest time that a node waited for its first map then, in ms; null also when that node led
    /// before.
    pub failover_gap_ms: Option<u64>,
    /// People whom only a single node reported to the cell, at least once: these nodes, each with
    /// the number of such people.
    pub seen_only_by: BTreeMap<NodeName, usize>,
}

/// A node's knowledge of the street, evaluated every tenth of a second. An object counts as
/// detected within 2 m.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct KnownShare {
    /// Mean number of objects that the node has at a time.
    pub known: f64,
    /// Share of the node's objects that are real, in percent.
    pub precision_pct: f64,
    /// Share of the real objects that the node has, in percent.
    pub recall_pct: f64,
}

/// Time between two moments that are evaluated.
const STEP: Duration = Duration::from_millis(100);

/// Age of a map from which on a node counts as having no objects.
const STALE_AFTER: Duration = Duration::from_secs(1);

/// Time between two poses of a vehicle that drives.
const POSE_PERIOD: Duration = Duration::from_millis(50);

impl StreetDemo<'_> {
    /// Runs the street; `progress` is called once a second.
    ///
    /// # Errors
    /// Returns an error if a node does not start or ends early, `progress` fails, or a file cannot
    /// be written; all nodes are stopped in any case.
    pub async fn run(
        &self,
        progress: impl Fn(Progress) -> anyhow::Result<()>,
    ) -> anyhow::Result<StreetOutcome> {
        let street = Arc::new(Street::default());
        let start = clock::now();
        let mut cameras = Vec::new();
        for number in 0..street.cameras.len() {
            cameras.push(NetworkCamera::start(&street, number, start).await?);
        }
        let stage = Stage::new(self.program, self.directory, street.cameras.len() + 1)?;
        let mut configs = vec![NodeConfig {
            name: Some(edge_name()),
            role: Role::Edge,
            ..cell()
        }];
        let mut driving = Vec::new();
        for (number, (camera, served)) in street.cameras.iter().zip(&cameras).enumerate() {
            let poses = street
                .drives(camera)
                .then(|| stage.pose_address(number + 1));
            driving.extend(poses.map(|address| (number, address)));
            let source = SourceConfig::Url {
                url: served.url(),
                latency_s: None,
            };
            configs.push(camera_node(&street, camera, source, poses));
        }
        let localisation = tokio::spawn(send_poses(Arc::clone(&street), driving, start));
        let observer = NodeName::from_static("observer");
        let played = stage
            .play(configs, self.dashboard, observer, self.duration, progress)
            .await;
        localisation.abort();
        for camera in cameras {
            camera.stop().await?;
        }
        let played = played?;
        let mut logs = Vec::new();
        for camera in &street.cameras {
            logs.push((camera.name.clone(), stage.map_log(&camera.name)?));
        }
        let judge = Judge {
            street: &street,
            start,
            from: played.from,
            until: played.until,
        };
        let terms = judge.terms(&logs);
        let result = judge.result(&played, &logs, &terms);
        Ok(StreetOutcome {
            from: played.from,
            terms,
            result,
        })
    }
}

fn edge_name() -> NodeName {
    NodeName::from_static("edge")
}

/// Configuration that all nodes share. They gossip on loopback, apart from other cells of this
/// machine.
fn cell() -> NodeConfig {
    let membership = MembershipConfig {
        multicast: MulticastConfig {
            enabled: false,
            ..MulticastConfig::default()
        },
        ..MembershipConfig::default()
    };
    NodeConfig {
        membership,
        cell: NodeName::from_static("street"),
        fusion: fusion(),
        ..NodeConfig::default()
    }
}

/// A round for every frame.
fn fusion() -> FusionConfig {
    let round = RoundConfig {
        period_s: 1.0 / FRAMES_PER_S,
        ..RoundConfig::default()
    };
    FusionConfig {
        algorithms: Algorithms::Pace,
        round,
        ..FusionConfig::default()
    }
}

/// Configuration of the node of a camera that shows `source`; `poses` is the address at which a
/// driving node receives its poses.
pub(crate) fn camera_node(
    street: &Street,
    camera: &StreetCamera,
    source: SourceConfig,
    poses: Option<SocketAddr>,
) -> NodeConfig {
    let optics = Street::optics();
    let Mount {
        height_m,
        pitch_rad,
        ..
    } = camera.mount;
    let pose = street.pose(camera, 0.0);
    let pass = |stretch| Pass {
        stretch_x: stretch,
        stretch_y: stretch,
    };
    let config = CameraConfig {
        name: None,
        source,
        masks: Default::default(),
        capture: CaptureConfig::default(),
        optics: OpticsConfig {
            width_px: Some(optics.width),
            height_px: Some(optics.height),
            horizontal_fov_deg: optics.horizontal_field_of_view().to_degrees(),
            ..OpticsConfig::default()
        },
        mount: MountConfig {
            height_m,
            pitch_deg: pitch_rad.to_degrees(),
            ..MountConfig::default()
        },
        // A third pass reads little more in these pictures, and takes most of the time.
        detector: DetectorConfig::Placard(PlacardConfig {
            passes: vec![pass(1.0), pass(2.0)],
            ..PlacardConfig::default()
        }),
        projection: projection(street),
        view: ViewConfig::default(),
        votes: false,
    };
    NodeConfig {
        name: Some(camera.name.clone()),
        pose: PoseConfig {
            x_m: pose.position.x,
            y_m: pose.position.y,
            heading_deg: pose.heading_rad.to_degrees(),
            listen: poses,
            moving: matches!(camera.carrier, Carrier::Mast(_)).then_some(false),
            ..PoseConfig::default()
        },
        camera: Some(config),
        ..cell()
    }
}

/// A placard stands up to 0.8 m in front of the middle of its wearer.
fn projection(street: &Street) -> ProjectionConfig {
    ProjectionConfig {
        sizes: street.code_sizes(),
        pixel_sigma_px: 0.5,
        heading_sigma_rad: 0.01,
        position_sigma_m: 0.05,
        floor_m: 0.3,
        ..ProjectionConfig::default()
    }
}

/// Sends the poses of the driving cameras to their nodes, like a vehicle's localisation; does not
/// return.
async fn send_poses(
    street: Arc<Street>,
    driving: Vec<(usize, SocketAddr)>,
    start: Timestamp,
) -> anyhow::Result<()> {
    let socket = UdpSocket::bind((Ipv4Addr::LOCALHOST, 0))?;
    let mut ticks = tokio::time::interval(POSE_PERIOD);
    loop {
        ticks.tick().await;
        for (number, address) in &driving {
            let now = clock::now();
            let pose = street.pose(&street.cameras[*number], now.since(start).as_secs_f64());
            let fix = serde_json::json!({
                "x_m": pose.position.x,
                "y_m": pose.position.y,
                "heading_rad": pose.heading_rad,
                "captured_at_us": now.shifted(clock::wall_offset_us()),
            });
            // The node may not be listening yet, or not any more.
            let _ = socket.send_to(fix.to_string().as_bytes(), address);
        }
    }
}

/// Truth and time of a street that has run.
struct Judge<'a> {
    street: &'a Street,
    start: Timestamp,
    from: Timestamp,
    until: Timestamp,
}

impl Judge<'_> {
    fn result(
        &self,
        played: &Played,
        logs: &[(NodeName, Vec<ReceivedMap>)],
        terms: &[JudgedTerm],
    ) -> StreetResult {
        let names = || self.street.cameras.iter().map(|camera| &camera.name);
        let alone =
            names().map(|name| (name.clone(), self.share(&self.alone(name, &played.reports))));
        let with_cell = logs
            .iter()
            .map(|(name, log)| (name.clone(), self.share(log)));
        let mut seen_only_by: BTreeMap<NodeName, std::collections::BTreeSet<u32>> = BTreeMap::new();
        for ReceivedMap { map, .. } in logs
            .iter()
            .flat_map(|(_, log)| log)
            .filter(|line| self.is_judged(&line.map))
        {
            let truth = self
                .street
                .truth(map.fused_at_us.since(self.start).as_secs_f64());
            for object in map
                .objects
                .iter()
                .filter(|object| object.confidence >= DEFAULT_THRESHOLD)
            {
                let place = Point2::new(object.x_m, object.y_m);
                let near = truth
                    .iter()
                    .filter(|known| known.label == object.label && known.label.as_str() == "person")
                    .map(|known| (nalgebra::distance(&known.position, &place), known.id));
                let nearest = near
                    .filter(|(distance_m, _)| *distance_m <= MATCH_DISTANCE_M / 2.0)
                    .min_by(|a, b| a.0.total_cmp(&b.0));
                if let ([node], Some((_, id))) = (object.contributors.as_slice(), nearest) {
                    seen_only_by.entry(node.clone()).or_default().insert(id);
                }
            }
        }
        let killed_at = played.killed_at.unwrap_or(self.until);
        let after = terms
            .iter()
            .find(|term| term.until > killed_at && term.epoch.leader != edge_name());
        StreetResult {
            objects: self.street.truth(0.0).len(),
            alone: alone.collect(),
            with_cell: with_cell.collect(),
            leaders: terms.iter().map(|term| term.epoch.leader.clone()).collect(),
            took_over: after.map(|term| term.epoch.leader.clone()),
            failover_gap_ms: after
                .filter(|term| term.from >= killed_at)
                .and_then(|term| term.gap)
                .map(|gap| gap.as_millis() as u64),
            seen_only_by: seen_only_by
                .into_iter()
                .map(|(node, people)| (node, people.len()))
                .collect(),
        }
    }

    fn is_judged(&self, map: &GlobalMap) -> bool {
        self.from <= map.fused_at_us && map.fused_at_us <= self.until
    }

    /// The maps that a node would have made of its own reports.
    fn alone(&self, name: &NodeName, reports: &[ObservedReport]) -> Vec<ReceivedMap> {
        let mut aggregator = Aggregator::new(name.clone(), 1, fusion(), Vec::new(), self.start);
        let own = reports
            .iter()
            .filter(|observed| observed.report.node == *name);
        let mut maps = Vec::new();
        for ObservedReport {
            report,
            received_at,
        } in own
        {
            if let Ok(Some(Fused { map: Some(map), .. })) =
                aggregator.report(ReportKind::Detections, report, *received_at)
            {
                maps.push(ReceivedMap {
                    received_at: *received_at,
                    map: Arc::new(map),
                });
            }
        }
        maps
    }

    /// Terms with the share of the objects that their maps have.
    fn terms(&self, logs: &[(NodeName, Vec<ReceivedMap>)]) -> Vec<JudgedTerm> {
        let logs: Vec<Vec<ReceivedMap>> = logs
            .iter()
            .map(|(_, log)| {
                log.iter()
                    .filter(|line| self.is_judged(&line.map))
                    .cloned()
                    .collect()
            })
            .collect();
        judged_terms(logs.iter().map(Vec::as_slice), |maps| {
            let frames = maps
                .iter()
                .map(|map| self.frame(map.fused_at_us, Some(map), &mut HashMap::new()));
            share(&frames.collect::<Vec<_>>()).recall_pct
        })
    }

    /// Knowledge of a node that received these maps.
    fn share(&self, maps: &[ReceivedMap]) -> KnownShare {
        let mut frames = Vec::new();
        let mut at = self.from;
        let mut next = 0;
        let mut ids = HashMap::new();
        while at <= self.until {
            next += maps[next..]
                .iter()
                .take_while(|line| line.received_at <= at)
                .count();
            let newest = next.checked_sub(1).map(|place| &maps[place]);
            let known = newest.filter(|line| at.since(line.received_at) < STALE_AFTER);
            frames.push(self.frame(at, known.map(|line| &*line.map), &mut ids));
            at = at + STEP;
        }
        share(&frames)
    }

    fn frame(
        &self,
        at: Timestamp,
        map: Option<&GlobalMap>,
        ids: &mut HashMap<uuid::Uuid, u32>,
    ) -> ScoredFrame {
        let said = map
            .into_iter()
            .flat_map(|map| &map.objects)
            .map(|object| ReportedObject::of(object, ids));
        ScoredFrame {
            said: said.collect(),
            truth: self.street.truth(at.since(self.start).as_secs_f64()),
        }
    }
}

fn share(frames: &[ScoredFrame]) -> KnownShare {
    let scores = score(frames).at_default;
    let matches = scores.matches as f64;
    let percent = |of: u64| {
        if of == 0 {
            0.0
        } else {
            100.0 * matches / of as f64
        }
    };
    KnownShare {
        known: matches / frames.len().max(1) as f64,
        precision_pct: percent(scores.matches + scores.false_alarms),
        recall_pct: percent(scores.matches + scores.misses),
    }
}

#[cfg(test)]
mod tests {
    use ecod::pace::PaceConfig;
    use ecod::perception::landmark::LandmarkIndex;
    use ecod_actors::camera::detect::Detect;
    use ecod_actors::camera::detect::placard::PlacardDetector;
    use ecod_actors::camera::frame::CameraFrame;
    use ecod_actors::camera::lens::Lens;
    use ecod_actors::camera::perception::{Perception, VehicleCamera};

    use super::*;
    use crate::street::view::StreetView;

    #[test]
    fn placard_is_at_its_wearer() {
        let street = Street::default();
        let view = StreetView::new(&street).unwrap();
        let mut detector = PlacardDetector::new(PlacardConfig::default());
        let mut read = BTreeMap::<_, usize>::new();
        for camera in &street.cameras {
            for at_s in [0.5, 4.0, 7.5, 11.0] {
                let image = view.render(&street, camera, at_s).unwrap();
                let frame = CameraFrame {
                    image,
                    captured_at: Timestamp::default(),
                    seq: 0,
                };
                let detections = detector.detect(&frame).unwrap();
                let vehicle_camera = VehicleCamera {
                    node: camera.name.clone(),
                    pose: street.pose(camera, at_s),
                    mount: camera.mount,
                    lens: Lens::ideal(Street::optics()),
                    landmarks: Arc::new(LandmarkIndex::new(Vec::new(), 1.0)),
                };
                let gate = PaceConfig::default().gate();
                let mut perception = Perception::new(
                    vehicle_camera,
                    projection(&street),
                    ViewConfig::default(),
                    gate,
                );
                let report = perception.report(detections, Timestamp::default());
                for object in &report.objects {
                    *read
                        .entry((camera.name.clone(), object.label.clone()))
                        .or_default() += 1;
                    let place = Point2::new(object.x_m, object.y_m);
                    let truth = street
                        .truth(at_s)
                        .into_iter()
                        .filter(|known| known.label == object.label);
                    let error_m = truth
                        .map(|known| nalgebra::distance(&known.position, &place))
                        .fold(f64::MAX, f64::min);
                    // Half the length between a car's placards, and the error of a small code's
                    // corners.
                    let allowed_m = 0.8
                        + 0.05 * nalgebra::distance(&place, &street.pose(camera, at_s).position);
                    let name = &camera.name;
                    let label = &object.label;
                    assert!(
                        error_m < allowed_m,
                        "{name} places a {label} {error_m:.2} m off at {at_s} s"
                    );
                }
            }
        }
        let people = read
            .keys()
            .filter(|(_, label)| label.as_str() == "person")
            .count();
        assert_eq!(
            people,
            street.cameras.len(),
            "each camera detects an object: {read:?}"
        );
    }
}
