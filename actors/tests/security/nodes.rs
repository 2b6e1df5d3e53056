//! Whole nodes of a cell with certificates, in this process.

use std::net::SocketAddr;

use ecod::leadership::Position;
use ecod::wire::Role;
use ecod_actors::node::config::NodeConfig;
use ecod_actors::node::{self, NodeHandle};
use ecod_actors::transport::pki::TlsConfig;
use ecod_testkit::{node_config, until};

/// Starts a node that greets another one.
pub(crate) async fn start(
    node: &str,
    role: Role,
    tls: TlsConfig,
    seed: Option<SocketAddr>,
) -> NodeHandle {
    start_with(node, role, tls, seed, |_| ()).await
}

/// The node with other settings.
pub(crate) async fn start_with(
    node: &str,
    role: Role,
    tls: TlsConfig,
    seed: Option<SocketAddr>,
    adjust: impl FnOnce(&mut NodeConfig),
) -> NodeHandle {
    let mut config = NodeConfig {
        tls: Some(tls),
        ..node_config(node, "lot", role)
    };
    config.membership.seeds = seed.iter().map(ToString::to_string).collect();
    adjust(&mut config);
    node::start(config).await.unwrap()
}

/// The edge, the candidate `euclid` and the vehicle `gauss`, once the edge leads both and `euclid` stands by.
pub(crate) async fn start_cell([edge, euclid, gauss]: [TlsConfig; 3]) -> [NodeHandle; 3] {
    let edge = start("edge", Role::Edge, edge, None).await;
    let euclid = start("euclid", Role::Auto, euclid, edge.gossip_address()).await;
    let gauss = start("gauss", Role::Cav, gauss, euclid.gossip_address()).await;
    until("edge leads all, with a standby", || {
        let stands_by = euclid.leadership().borrow().position == Position::StandingBy;
        stands_by
            && [&euclid, &gauss]
                .iter()
                .all(|node| aggregator(node).as_deref() == Some("edge"))
    })
    .await;
    [edge, euclid, gauss]
}

/// Leader of the newest map of a node.
pub(crate) fn aggregator(node: &NodeHandle) -> Option<String> {
    node.newest_map()
        .borrow()
        .as_ref()
        .map(|newest| newest.map.aggregator.to_string())
}
