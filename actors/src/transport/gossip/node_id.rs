//! Identity of a node in the gossip.

use std::net::{IpAddr, SocketAddr};

use ecod::model::names::NodeName;
use ecod::wire::Role;
use serde::{Deserialize, Serialize};

use super::Member;
use super::socket::is_of_this_machine;

/// Identity of a node. If two nodes have one name, the node with the greater `life` is accepted.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct NodeId {
    pub(crate) name: NodeName,
    /// When the node started, in Unix microseconds by its own clock.
    pub(crate) run: u64,
    /// Counts up from when the membership started, whenever the node returns from the dead or its
    /// addresses change.
    pub(crate) life: u64,
    pub(crate) role: Role,
    /// Address of its gossip socket; unspecified until the node has discovered it.
    pub(crate) gossip: SocketAddr,
    pub(crate) broker: Option<SocketAddr>,
}

/// Largest life that others may claim for a node. The node itself can always outbid it.
pub(crate) const MAX_CLAIMED_LIFE: u64 = 1 << 53;

impl NodeId {
    /// True if the node itself could have reached the life: it starts with the time of day, and
    /// grows by single steps.
    pub(crate) fn has_plausible_life(&self) -> bool {
        self.life <= 2 * MAX_CLAIMED_LIFE
    }

    /// The node as other actors see it, at the `address` where it was seen. A broker on another
    /// machine's loopback address is left out: this machine would find its own there.
    pub(crate) fn member(&self, address: Option<SocketAddr>) -> Member {
        let gossip = address.unwrap_or(self.gossip);
        let reached = |ip: IpAddr| if ip.is_unspecified() { gossip.ip() } else { ip };
        let is_near =
            |broker: &SocketAddr| !broker.ip().is_loopback() || is_of_this_machine(gossip.ip());
        let broker = self
            .broker
            .filter(is_near)
            .map(|broker| SocketAddr::new(reached(broker.ip()), broker.port()));
        Member {
            name: self.name.clone(),
            run: self.run,
            gossip,
            broker,
            role: self.role,
            certificate: None,
        }
    }
}

impl foca::Identity for NodeId {
    type Addr = NodeName;

    /// Not used: [`Swim`](super::swim::Swim) limits how often it renews its identity.
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn foreign_loopback_broker_is_ignored() {
        let id = |gossip: &str| NodeId {
            name: NodeName::from_static("euclid"),
            run: 1,
            life: 1,
            role: Role::Auto,
            gossip: gossip.parse().unwrap(),
            broker: Some("127.0.0.1:1883".parse().unwrap()),
        };
        // An address reserved for documentation.
        assert_eq!(id("192.0.2.7:17884").member(None).broker, None);
        assert_eq!(
            id("127.0.0.1:17884").member(None).broker,
            id("127.0.0.1:17884").broker,
            "this machine's"
        );
        let open = NodeId {
            broker: Some("0.0.0.0:1883".parse().unwrap()),
            ..id("192.0.2.7:17884")
        };
        assert_eq!(
            open.member(None).broker,
            Some("192.0.2.7:1883".parse().unwrap())
        );
    }
}
