//! The configuration of the testbed's nodes: one set of parameters for every scene.

use std::net::SocketAddr;
use std::sync::Arc;

use ecod::admission::report_window::WindowConfig;
use ecod::aggregator::round::RoundConfig;
use ecod::aggregator::{Algorithms, FusionConfig};
use ecod::model::names::NodeName;
use ecod::pace::PaceConfig;
use ecod::perception::camera::Mount;
use ecod::perception::landmark::{LandmarkConfig, LandmarkIndex};
use ecod::perception::projection::{ObjectSize, ObjectSizes, ProjectionConfig};
use ecod::perception::view::ViewConfig;
use ecod::vote::VoteConfig;
use ecod::wire::Role;
use ecod_actors::camera::config::{CameraConfig, MountConfig, OpticsConfig};
use ecod_actors::camera::detect::DetectorConfig;
use ecod_actors::camera::detect::placard::PlacardConfig;
use ecod_actors::camera::frame_source::SourceConfig;
use ecod_actors::camera::frame_source::capture::CaptureConfig;
use ecod_actors::camera::lens::Lens;
use ecod_actors::camera::perception::{Perception, VehicleCamera};
use ecod_actors::camera::vehicle_pose::PoseConfig;
use ecod_actors::node::config::NodeConfig;
use ecod_actors::observe::dashboard::DashboardConfig;
use ecod_actors::transport::gossip::{MembershipConfig, MulticastConfig};

use crate::testbed::{Cav, Placard, Scene, Testbed};

/// The paper's δ in metres, an inch and a quarter: less than half the least distance between
/// neighbouring spots.
const GATE_M: f64 = 0.032;

/// Minimum number of frames for which a report counts, as far as [`MAX_AGE_S`] allows.
const FRAMES_REMEMBERED: f64 = 3.0;
/// The most seconds that a report may count.
const MAX_AGE_S: f64 = 3600.0;

/// The edge's configuration: role, landmarks and fusion.
pub fn edge(testbed: &Testbed, scene: &Scene) -> NodeConfig {
    NodeConfig {
        name: Some(unused_name(scene, "edge")),
        role: Role::Edge,
        ..cell(testbed, scene)
    }
}

/// The wanted name, or the first of `name-2`, `name-3` … that no vehicle of the scene has.
pub fn unused_name(scene: &Scene, wanted: &'static str) -> NodeName {
    let numbered = (2..).map(|n| NodeName::new(format!("{wanted}-{n}")));
    let mut names = std::iter::once(Ok(NodeName::from_static(wanted)))
        .chain(numbered)
        .filter_map(Result::ok);
    let unused = names.find(|name| scene.cavs.iter().all(|cav| cav.name != *name));
    unused.unwrap_or(NodeName::from_static(wanted))
}

/// A vehicle's configuration, with its frames from `source`.
pub fn cav(testbed: &Testbed, scene: &Scene, cav: &Cav, source: SourceConfig) -> NodeConfig {
    let placard = &testbed.placard;
    let intrinsics = &testbed.camera.intrinsics;
    let half_angle = |pixels: u32, focal: f64| (f64::from(pixels) / 2.0 / focal).atan();
    let camera = CameraConfig {
        name: None,
        source,
        masks: Default::default(),
        capture: CaptureConfig::default(),
        optics: OpticsConfig {
            calibration: None,
            width_px: Some(intrinsics.width),
            height_px: Some(intrinsics.height),
            horizontal_fov_deg: 2.0 * half_angle(intrinsics.width, intrinsics.fx).to_degrees(),
            vertical_fov_deg: Some(2.0 * half_angle(intrinsics.height, intrinsics.fy).to_degrees()),
        },
        mount: MountConfig::default(),
        detector: DetectorConfig::Placard(PlacardConfig::default()),
        projection: projection(placard),
        view: view(placard),
        votes: false,
    };
    NodeConfig {
        name: Some(cav.name.clone()),
        role: Role::Cav,
        pose: PoseConfig {
            x_m: cav.pose.position.x,
            y_m: cav.pose.position.y,
            heading_deg: cav.pose.heading_rad.to_degrees(),
            ..PoseConfig::default()
        },
        camera: Some(camera),
        ..cell(testbed, scene)
    }
}

/// A vehicle's processing from detections to reports.
pub fn perception(testbed: &Testbed, scene: &Scene, cav: &Cav) -> Perception {
    let gate = fusion(testbed).pace.gate();
    let vehicle_camera = VehicleCamera {
        node: cav.name.clone(),
        pose: cav.pose,
        mount: Mount::default(),
        lens: Lens::ideal(testbed.camera.intrinsics),
        landmarks: Arc::new(LandmarkIndex::new(
            scene.landmarks(&testbed.placard),
            gate.radius_m,
        )),
    };
    Perception::new(
        vehicle_camera,
        projection(&testbed.placard),
        view(&testbed.placard),
        gate,
    )
}

/// Fusion of reports: a round for every frame, which counts until some more have come.
pub fn fusion(testbed: &Testbed) -> FusionConfig {
    let period_s = testbed.camera.capture_interval.as_secs_f64();
    let mut window = WindowConfig::default();
    let mut pace = PaceConfig::default();
    pace.gate_m = GATE_M;
    pace.position_floor_m = 0.01;
    pace.max_age_s = pace
        .max_age_s
        .max(FRAMES_REMEMBERED * period_s)
        .min(MAX_AGE_S);
    window.max_age_s = window
        .max_age_s
        .max(FRAMES_REMEMBERED * period_s)
        .min(MAX_AGE_S);
    let mut vote = VoteConfig::default();
    vote.weighted.freshness_s = vote.weighted.freshness_s.max(FRAMES_REMEMBERED * period_s);
    FusionConfig {
        algorithms: Algorithms::Pace,
        round: RoundConfig {
            period_s,
            ..RoundConfig::default()
        },
        pace,
        vote,
        window,
        ..FusionConfig::default()
    }
}

/// Poses are accurate to two millimetres, corners to half a pixel.
fn projection(placard: &Placard) -> ProjectionConfig {
    ProjectionConfig {
        sizes: ObjectSizes {
            default: Some(ObjectSize::square(placard.qr_width_m)),
            ..ObjectSizes::default()
        },
        pixel_sigma_px: 0.5,
        heading_sigma_rad: 0.002,
        position_sigma_m: 0.002,
        floor_m: 0.002,
        ..ProjectionConfig::default()
    }
}

/// A spot counts as in view if a plate there would be read in most frames.
fn view(placard: &Placard) -> ViewConfig {
    ViewConfig {
        target_width_m: Some(placard.qr_width_m),
        min_target_px: 30.0,
        max_yaw_rad: 66f64.to_radians(),
        occluder_width_m: Some(placard.card_width_m),
        ..ViewConfig::default()
    }
}

/// Configuration that all nodes of the cell share. They gossip on loopback, apart from other cells
/// of this machine, and serve no page.
fn cell(testbed: &Testbed, scene: &Scene) -> NodeConfig {
    let membership = MembershipConfig {
        bind: Some(SocketAddr::from(([127, 0, 0, 1], 0))),
        multicast: MulticastConfig {
            enabled: false,
            ..MulticastConfig::default()
        },
        ..MembershipConfig::default()
    };
    NodeConfig {
        membership,
        dashboard: DashboardConfig {
            enabled: false,
            ..DashboardConfig::default()
        },
        cell: NodeName::from_static("testbed"),
        landmarks: scene
            .landmarks(&testbed.placard)
            .iter()
            .map(LandmarkConfig::from)
            .collect(),
        fusion: fusion(testbed),
        ..NodeConfig::default()
    }
}
