//! A cell whose nodes log their maps.

use std::path::Path;

use ecod::perception::landmark::LandmarkConfig;
use ecod::wire::Role;
use ecod_actors::node::config::NodeConfig;
use ecod_testkit::{Cell, node_config};

use crate::failover::record::Record;

/// A node with its map log and its term in the directory.
pub(crate) fn config(name: &str, role: Role, directory: &Path) -> NodeConfig {
    let mut config = NodeConfig {
        state_dir: Some(directory.into()),
        map_log: Some(directory.join(format!("{name}.maps"))),
        landmarks: vec![LandmarkConfig::at("slot-0", 0.0, 0.0)],
        ..node_config(name, "cell", role)
    };
    config.election.stable_ms = 1000;
    config.validate().unwrap();
    config
}

/// The maps that a node of the cell has accepted.
pub(crate) fn record(cell: &Cell, name: &str) -> Record {
    Record::read(&cell.directory().join(format!("{name}.maps")))
}
