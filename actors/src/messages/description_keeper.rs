//! Requests to the actor `DescriptionKeeper`, from the election, the gateway and the node's local
//! broker.

use std::sync::Arc;

use ecod::model::names::NodeName;
use ecod::wire::{CellDescription, DescriptionStamp};

use crate::transport::mqtt::Delivery;

/// Requests to the keeper of the cell's description.
#[derive(Debug)]
pub enum DescriptionKeeperMessage {
    /// Process a node's authenticated statement about its description.
    HandleStamp {
        /// Name of the node.
        from: NodeName,
        /// True if it may lead.
        may_lead: bool,
        /// True if it is an operator's, which may set descriptions.
        may_describe: bool,
        /// The version and hash that it has.
        stamp: DescriptionStamp,
    },
    /// Process a description from a broker.
    HandleDescription {
        /// The description and its path of delivery.
        delivery: Delivery<Arc<CellDescription>>,
    },
    /// Set the cell's description, which was checked.
    Set {
        /// The settings, as TOML.
        text: String,
    },
    /// Publish to a broker that has just accepted a link.
    Connected,
    /// Repeat messages that other nodes still lack, and try the disk again.
    Tick,
}
