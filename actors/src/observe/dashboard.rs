//! The page, API, metrics and health of a node by HTTP.

pub(crate) mod access;
pub(crate) mod assets;
pub(crate) mod config;
pub(crate) mod feed;
pub(crate) mod history;
pub(crate) mod latency;
pub(crate) mod metrics;
pub(crate) mod observer;
pub(crate) mod paced;
pub(crate) mod picture;
pub(crate) mod places;
pub(crate) mod process;
pub(crate) mod routes;
pub(crate) mod server;
pub(crate) mod sources;
pub use assets::paths as page_paths;
pub use config::{DEFAULT_ADDRESS, DashboardConfig};
pub use feed::{Feed, MAX_SHOWN, Sighting};
pub use picture::{LandmarkFacts, NodeFacts};
pub use sources::Sources;
