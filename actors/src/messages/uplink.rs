//! Messages to the actor of this name.

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
    /// Look who leads and which map is the newest: one of them has changed.
    Look,
    /// Publish this status of the node while it leads.
    SetStatus {
        /// The status.
        status: NodeStatus,
    },
    /// Go on under other settings of the cell.
    Configure {
        /// The place of the cell's frame on Earth.
        origin: Option<GeographicOrigin>,
        /// The description of the cell.
        description: Option<Arc<CellDescription>>,
    },
    /// Ask the region about these vehicles, which are present in the cell, and about no others.
    SetPresent {
        /// All of them.
        vehicles: BTreeSet<NodeName>,
    },
    /// Tell the region what the cell's own evidence says of vehicles.
    TellCounts {
        /// The vehicles whose counts have changed.
        counts: Vec<(NodeName, CellCounts)>,
    },
    /// Take the next steps in telling and asking about vehicles.
    Exchange,
    /// Take a message of the region.
    Take {
        /// The message and when it came.
        delivery: Delivery<FromRegion>,
    },
    /// An event of the link's own task.
    LinkChanged {
        /// The event.
        event: LinkEvent,
    },
}
