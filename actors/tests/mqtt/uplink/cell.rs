//! Cells of one node with an uplink.

use ecod::aggregator::Algorithms;
use ecod::model::origin::GeographicOrigin;
use ecod::wire::{Role, Trouble};
use ecod_actors::node::config::NodeConfig;
use ecod_actors::node::{self, NodeHandle};
use ecod_actors::transport::mqtt::BrokerAddress;
use ecod_testkit::node_config;

/// The place of the first cell; others are some metres from it.
pub(crate) const ORIGIN: GeographicOrigin = GeographicOrigin {
    latitude_deg: 52.2,
    longitude_deg: 21.0,
    height_m: 100.0,
    rotation_deg: 0.0,
};

/// An edge on loopback alone that leads a cell without landmarks.
pub(crate) fn config(cell: &'static str, broker: BrokerAddress) -> NodeConfig {
    let mut config = NodeConfig {
        origin: Some(ORIGIN),
        ..node_config("edge", cell, Role::Edge)
    };
    config.fusion.algorithms = Algorithms::Pace;
    config.uplink.broker = Some(broker);
    config.validate().unwrap();
    config
}

pub(crate) async fn start(config: NodeConfig) -> NodeHandle {
    node::start(config).await.unwrap()
}

/// The round of the node's newest map.
pub(crate) fn round(node: &NodeHandle) -> u64 {
    node.newest_map()
        .borrow()
        .as_ref()
        .map_or(0, |newest| newest.map.round)
}

/// The present trouble of a kind.
pub(crate) fn trouble(node: &NodeHandle, kind: &str) -> Option<Trouble> {
    node.counters()
        .troubles()
        .present()
        .into_iter()
        .find(|trouble| trouble.kind == kind)
}
