//! The town in files of others: GeoJSON of one moment, MCAP of a time.

mod geojson;
mod log;

pub use geojson::{FeatureCollection, geojson};
pub use log::CellMapLog;
