//! Packets that arrive on a link, in the form for their receiver.

use ecod::leadership::BrokerAddress;
use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use uuid::Uuid;

/// The broker that forwarded a packet.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Via<'a> {
    pub(crate) address: &'a BrokerAddress,
    /// The node whose certificate it has proven, for a broker of a cell with certificates.
    pub(crate) node: Option<&'a NodeName>,
}

/// The effect of a packet on its link.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum PacketOutcome {
    /// No further effect.
    Done,
    /// The broker published this node's last will: the link must publish the status again.
    DeclaredOffline,
    /// The broker returned this run's own status: the node may publish there.
    OwnStatus,
    /// Another run with this node's name is alive.
    Namesake(Uuid),
}

/// Receiver of the messages that arrive on links.
pub(crate) trait PacketSink: Send + Sync {
    /// Processes one packet of a broker, on the link's task; it must not block.
    fn accept(
        &self,
        via: Via<'_>,
        topic: &[u8],
        payload: &[u8],
        received_at: Timestamp,
    ) -> PacketOutcome;
}
