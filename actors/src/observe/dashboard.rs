//! Page, API, metrics and health of a node over HTTP.

pub(crate) mod assets;
pub(crate) mod camera_feed;
#[cfg(feature = "camera")]
pub(crate) mod camera_picture;
pub(crate) mod config;
pub(crate) mod floor_plan;
pub(crate) mod history;
pub(crate) mod live_state;
pub(crate) mod map_latency;
pub(crate) mod metrics;
#[cfg(feature = "camera")]
pub(crate) mod mount_answer;
pub(crate) mod node_monitor;
pub(crate) mod node_sources;
pub mod process_metrics;
pub(crate) mod response_cache;
pub(crate) mod routes;
pub(crate) mod server;
pub(crate) mod snapshot;
pub(crate) mod timeline;

pub use assets::{page_file, paths as page_paths};
pub use camera_feed::CameraFeed;
#[cfg(feature = "camera")]
pub use camera_picture::{PictureBox, camera_event};
pub use config::{DEFAULT_ADDRESS, DashboardConfig};
pub use floor_plan::{FloorPlan, FloorPlanConfig, FloorPlanFacts, FloorPlanPoint};
pub use live_state::{LatestReport, LiveState, MAX_SHOWN};
#[cfg(feature = "camera")]
pub use mount_answer::CameraSetup;
pub use node_sources::{LandmarkFacts, NodeFacts, NodeSources, ShownCamera};
