//! What the gossip says of a node.

use std::net::{IpAddr, SocketAddr};

use ecod::names::NodeName;
use ecod::wire::Role;
use serde::{Deserialize, Serialize};

use super::Member;

/// A node at one time of its life. Of two with one name, the one with the later `life` is believed.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct NodeId {
    pub(super) name: NodeName,
    /// When the node started, in Unix microseconds by its own clock.
    pub(super) run: u64,
    /// Counts up from when the membership started, whenever the node returns from the dead or its addresses change.
    pub(super) life: u64,
    pub(super) role: Role,
    /// Where it gossips; unspecified while the node does not know.
    pub(super) gossip: SocketAddr,
    pub(super) broker: Option<SocketAddr>,
}

impl NodeId {
    /// The node as others are told, where it is seen at `address`.
    pub(super) fn member(&self, address: Option<SocketAddr>) -> Member {
        let gossip = address.unwrap_or(self.gossip);
        let reached = |ip: IpAddr| if ip.is_unspecified() { gossip.ip() } else { ip };
        let broker = self.broker.map(|broker| SocketAddr::new(reached(broker.ip()), broker.port()));
        Member { name: self.name.clone(), run: self.run, gossip, broker, role: self.role }
    }
}

impl foca::Identity for NodeId {
    type Addr = NodeName;

    /// The gossip renews its identity itself, and not too often.
    fn renew(&self) -> Option<Self> {
        None
    }

    fn addr(&self) -> NodeName {
        self.name.clone()
    }

    fn win_addr_conflict(&self, adversary: &Self) -> bool {
        self.life > adversary.life
    }
}
