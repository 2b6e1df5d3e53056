//! The town in other file formats: GeoJSON of one moment, MCAP of a period.

mod geojson;
mod log;

pub use geojson::{FeatureCollection, geojson};
pub use log::CellMapLog;
