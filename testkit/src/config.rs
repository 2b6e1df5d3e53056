//! Configurations of nodes on loopback.

use std::net::{Ipv4Addr, SocketAddr, UdpSocket};

use ecod::model::names::NodeName;
use ecod::wire::Role;
use ecod_actors::node::config::NodeConfig;

/// Any free port of loopback.
pub fn loopback() -> SocketAddr {
    SocketAddr::from((Ipv4Addr::LOCALHOST, 0))
}

/// The name of a node or of a cell.
///
/// # Panics
/// Panics if the text is no name.
pub fn name(text: &str) -> NodeName {
    NodeName::new(text).unwrap()
}

/// An address at which no node gossips at present.
///
/// # Panics
/// Panics if loopback has no free port.
pub fn free_gossip_address() -> SocketAddr {
    UdpSocket::bind(loopback()).unwrap().local_addr().unwrap()
}

/// A node that listens on loopback, has no page, and does not find the cells of other tests: it finds its cell by
/// seeds.
pub fn node_config(node: &str, cell: &str, role: Role) -> NodeConfig {
    let mut config = NodeConfig {
        name: Some(name(node)),
        cell: name(cell),
        role,
        listen: Some(loopback()),
        ..NodeConfig::default()
    };
    config.membership.bind = Some(loopback());
    config.membership.multicast.enabled = false;
    config.dashboard.enabled = false;
    config
}

/// Makes a node find its cell by `seed`, the gossip address of the node with `is_seed`.
pub fn greet(config: &mut NodeConfig, seed: SocketAddr, is_seed: bool) {
    config.membership.bind = Some(if is_seed { seed } else { loopback() });
    config.membership.seeds = vec![seed.to_string()];
}
