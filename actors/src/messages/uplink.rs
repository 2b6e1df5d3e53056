//! Requests to the actor `Uplink`, from the supervisor, the fuser, the keeper of reputations and
//! its own link.

use std::collections::BTreeSet;
use std::sync::Arc;

use ecod::model::names::NodeName;
use ecod::model::origin::GeographicOrigin;
use ecod::reputation::CellCounts;
use ecod::wire::{CellDescription, NodeStatus};

use crate::transport::mqtt::{Delivery, FromRegion, LinkEvent};

/// Messages to the uplink.
#[derive(Debug)]
pub enum UplinkMessage {
    /// Check the leader and the newest map: one of them has changed.
    Look,
    /// Publish this status of the node while it leads.
    SetStatus {
        /// The status.
        status: NodeStatus,
    },
    /// Continue with other settings of the cell.
    Configure {
        /// The place of the cell's frame on Earth.
        origin: Option<GeographicOrigin>,
        /// The description of the cell.
        description: Option<Arc<CellDescription>>,
    },
    /// Subscribe to the counts of these vehicles, which are present in the cell, and only of these.
    SetPresent {
        /// All of them.
        vehicles: BTreeSet<NodeName>,
    },
    /// Publish the cell's own counts about vehicles to the region.
    TellCounts {
        /// The vehicles whose counts have changed.
        counts: Vec<(NodeName, CellCounts)>,
    },
    /// Take the next steps in the exchange of counts about vehicles.
    Exchange,
    /// Take a message of the region.
    Take {
        /// The message and its time of receipt.
        delivery: Delivery<FromRegion>,
    },
    /// An event of the link's own task.
    LinkChanged {
        /// The event.
        event: LinkEvent,
    },
}
