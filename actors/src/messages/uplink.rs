//! Requests to the actor `Uplink`, from the supervisor and its own link.

use std::sync::Arc;

use ecod::model::origin::GeographicOrigin;
use ecod::wire::{CellDescription, NodeStatus};

use crate::transport::mqtt::{Delivery, FromRegion, LinkEvent};

/// Messages to the uplink.
#[derive(Debug)]
pub enum UplinkMessage {
    /// Check the leader and the newest map, because the leader or the map has changed.
    Update,
    /// Replace the connection: it is from an address that this machine has lost.
    Reconnect,
    /// Publish this status of the node while it leads.
    SetStatus {
        /// The complete status of this node.
        status: NodeStatus,
    },
    /// Continue with other settings of the cell.
    Configure {
        /// The place of the cell's frame on Earth.
        origin: Option<GeographicOrigin>,
        /// The description of the cell.
        description: Option<Arc<CellDescription>>,
    },
    /// Process a message of the region.
    HandleRegionMessage {
        /// The message and its time of receipt.
        delivery: Delivery<FromRegion>,
    },
    /// An event of the link's own task.
    LinkChanged {
        /// The event that the link reports.
        event: LinkEvent,
    },
}
