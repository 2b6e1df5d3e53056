//! Requests to the actor `Fuser`, from the follower, the uplink, the election and the keeper of
//! reputations.

use std::collections::BTreeMap;
use std::sync::Arc;

use ecod::admission::timeliness::Timeliness;
use ecod::aggregator::FusionConfig;
use ecod::aggregator::round::FirstRound;
use ecod::model::epoch::Epoch;
use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ecod::perception::landmark::LandmarkConfig;
use ecod::reputation::ReputationLedger;
use ecod::wire::{GlobalMap, NeighbourObject, Reputation};
use ractor::RpcReplyPort;

/// Messages to the fuser.
#[derive(Debug)]
pub enum FuserMessage {
    /// Fuse the reports that wait in its queue.
    HandleReports,
    /// Keep another aggregator's map, which the follower accepted, to continue from it when
    /// leading.
    HandleMap {
        /// The map as the follower accepted it.
        map: Arc<GlobalMap>,
        /// Time of receipt by this node's clock.
        received_at: Timestamp,
    },
    /// Do not continue from a map of this node, and remove objects that it alone has reported: its
    /// certificate was revoked or has expired.
    Expel {
        /// Name of the node whose certificate is invalid.
        node: NodeName,
    },
    /// Show these objects of other cells, and take over their identities.
    HandleNeighbours {
        /// All that are near this cell; their times are by this node's clock.
        objects: Arc<[NeighbourObject]>,
        /// Time at which the objects had the ages that they state.
        stated_at: Timestamp,
    },
    /// Close the round if it is due.
    CloseRound,
    /// Publish from now on.
    Lead {
        /// Epoch of the node's own leadership.
        epoch: Epoch,
        /// Number of the next round.
        first_round: u64,
        /// When it is due.
        first: FirstRound,
    },
    /// Let the current round last its full length: another node is about to lead from the next one
    /// on.
    HoldRound,
    /// Stop publishing; continue to fuse, to be ready.
    StopPublishing,
    /// Continue with other settings.
    Configure {
        /// Settings of the fusion, which must be valid.
        fusion: Box<FusionConfig>,
        /// All landmarks of the cell.
        landmarks: Vec<LandmarkConfig>,
    },
    /// Start from evidence of another source.
    Adopt {
        /// All evidence that the node has.
        ledger: Arc<ReputationLedger>,
    },
    /// Continue, in VOTE's `paper` mode, from published reputations.
    Resume {
        /// Reputations by the name of the vehicle.
        reputations: BTreeMap<NodeName, Reputation>,
    },
    /// Query whether the reports of vehicles are usable by their time.
    Timeliness {
        /// Gets the share of the vehicles.
        reply: RpcReplyPort<Timeliness>,
    },
}
