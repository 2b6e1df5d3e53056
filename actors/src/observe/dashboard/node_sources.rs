//! Inputs of the dashboard. Reading them does not block other parts of the node.

use std::net::SocketAddr;
use std::sync::Arc;

use ecod::model::names::{Label, LandmarkId, NodeName};
use ecod::model::origin::GeographicOrigin;
use ecod::model::time::Timestamp;
use ecod::perception::landmark::LandmarkConfig;
use ecod::wire::Role;
use serde::Serialize;
use tokio::sync::watch;

use super::camera_feed::CameraFeed;
use super::floor_plan::{FloorPlan, FloorPlanFacts};
use super::live_state::LiveState;
#[cfg(feature = "camera")]
use super::mount_answer::CameraSetup;
use crate::observe::readiness::Vitals;
use crate::telemetry::counters::Counters;
use crate::transport::gossip::{FrameCounters, Member};

/// All inputs that the dashboard reads from its node.
#[derive(Debug, Clone)]
pub struct NodeSources {
    /// Facts about the node at its start.
    pub node: NodeFacts,
    /// Newest messages, leadership, links and broker.
    pub vitals: Vitals,
    /// All living nodes except this one.
    pub members: watch::Receiver<Vec<Member>>,
    /// Counters of the node.
    pub counters: Arc<Counters>,
    /// Counters of its gossip.
    pub frames: Arc<FrameCounters>,
    /// Latest reports and statuses.
    pub live_state: Arc<LiveState>,
    /// The node's cameras, if their pictures are shown.
    pub cameras: Vec<ShownCamera>,
    /// Cameras of other nodes of this process, if their pictures are shown, too.
    pub further_cameras: watch::Receiver<Vec<ShownCamera>>,
    /// Image under the map.
    pub floor_plan: Option<FloorPlan>,
}

/// A camera whose pictures are shown.
#[derive(Debug, Clone)]
pub struct ShownCamera {
    /// Its name, if it has one.
    pub name: Option<String>,
    /// Feed of the camera's pictures.
    pub feed: Arc<CameraFeed>,
    /// Name under which it reports.
    pub reporter: NodeName,
    /// Settings with which the camera's mount is fitted.
    #[cfg(feature = "camera")]
    pub setup: CameraSetup,
}

/// Facts about a node.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct NodeFacts {
    /// Name of the node.
    pub name: NodeName,
    /// Name of its cell.
    pub cell: NodeName,
    /// Role with which the node was started.
    pub role: Role,
    /// True if `/api/camera` shows the pictures of its cameras.
    pub camera: bool,
    /// Names of these cameras, in their order; `None` for the camera without a name, which is the
    /// first.
    pub cameras: Vec<Option<String>>,
    /// Names under which the cameras of `/api/cameras` report: the node's cameras in their order,
    /// and then the cameras of other nodes of its process.
    pub pictures: Vec<NodeName>,
    /// The image under the map, if there is one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub floor_plan: Option<FloorPlanFacts>,
    /// Place of the cell's frame on Earth; absent without one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub origin: Option<GeographicOrigin>,
    /// Version of the software.
    pub version: &'static str,
    /// Start of the node in Unix microseconds by its clock.
    pub started_at_us: Timestamp,
    /// Maximum time between two rounds of a live aggregator, in seconds.
    pub round_period_s: f64,
    /// Address at which its broker listens for programs; absent without one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub door: Option<SocketAddr>,
    /// How vehicles begin to report, for a cell without reports.
    pub guide: String,
    /// End of the validity of its certificate; absent without one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub certificate_ends_us: Option<Timestamp>,
}

impl NodeSources {
    /// The current facts about the node.
    pub(crate) fn node_facts(&self) -> NodeFacts {
        let credentials = self.vitals.security.credentials.as_ref();
        let shared = self.vitals.shared.borrow();
        NodeFacts {
            certificate_ends_us: credentials
                .map(|credentials| credentials.current().identity.expires()),
            round_period_s: shared.round_period_s,
            origin: shared.origin,
            pictures: self
                .pictured_cameras()
                .into_iter()
                .map(|camera| camera.reporter)
                .collect(),
            ..self.node.clone()
        }
    }

    /// The camera with this name, or the first.
    pub(crate) fn camera(&self, name: Option<&str>) -> Option<&ShownCamera> {
        self.cameras
            .iter()
            .find(|camera| name.is_none() || camera.name.as_deref() == name)
    }

    /// All cameras whose pictures the page shows, the node's own first.
    pub(crate) fn pictured_cameras(&self) -> Vec<ShownCamera> {
        let further = self.further_cameras.borrow();
        self.cameras.iter().chain(&*further).cloned().collect()
    }

    /// Landmarks of the cell.
    pub(crate) fn landmarks(&self) -> Vec<LandmarkFacts> {
        let landmarks = Arc::clone(&self.vitals.shared.borrow().landmarks);
        landmarks.iter().map(LandmarkFacts::from).collect()
    }
}

/// A landmark in the form for the page.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct LandmarkFacts {
    /// Name of the location.
    pub id: LandmarkId,
    /// East in metres.
    pub x_m: f64,
    /// North in metres.
    pub y_m: f64,
    /// Direction that it faces, in radians counter-clockwise from east.
    pub facing_rad: Option<f64>,
    /// Label of its vacancy sign.
    pub vacancy: Option<Label>,
}

impl From<&LandmarkConfig> for LandmarkFacts {
    fn from(landmark: &LandmarkConfig) -> Self {
        Self {
            id: landmark.id.clone(),
            x_m: landmark.x_m,
            y_m: landmark.y_m,
            facing_rad: landmark.facing_deg.map(f64::to_radians),
            vacancy: landmark.vacancy.as_ref().map(|sign| sign.label.clone()),
        }
    }
}
