//! Messages to the actor of this name.

use std::collections::BTreeMap;
use std::sync::Arc;

use ecod::admission::timeliness::Timeliness;
use ecod::aggregator::FusionConfig;
use ecod::aggregator::round::FirstRound;
use ecod::model::epoch::Epoch;
use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ecod::perception::landmark::LandmarkConfig;
use ecod::reputation::{ForeignReputations, ReputationLedger};
use ecod::wire::{GlobalMap, NeighbourObject, Reputation};
use ractor::RpcReplyPort;

/// Messages to the fuser.
#[derive(Debug)]
pub enum FuserMessage {
    /// Fuse the reports that wait in its queue.
    TakeReports,
    /// Keep another aggregator's map, which the follower's gate admitted, to go on from when leading.
    TakeMap {
        /// The map.
        map: Arc<GlobalMap>,
        /// When it came.
        received_at: Timestamp,
    },
    /// Do not go on from a map of this aggregator: it is not trusted any more.
    ForgetMap {
        /// The aggregator.
        of: NodeName,
    },
    /// Show these objects of other cells, and take over their identities.
    TakeNeighbours {
        /// All that are near this cell; their times are by this node's clock.
        objects: Arc<[NeighbourObject]>,
        /// When they were of the age that they state.
        stated_at: Timestamp,
    },
    /// Start vehicles from what other cells say of them.
    TakeForeign {
        /// All that they say of the vehicles that are present.
        reputations: Arc<ForeignReputations>,
    },
    /// Tell the uplink anew which vehicles are present.
    TellUplink,
    /// Close the round if it is due.
    CloseRound,
    /// Publish from now on.
    Lead {
        /// The leadership.
        epoch: Epoch,
        /// Number of the next round.
        first_round: u64,
        /// When it is due.
        first: FirstRound,
    },
    /// Let the present round last its whole length: another node is about to lead from the next one on.
    HoldRound,
    /// Publish nothing more; go on fusing, to be ready.
    StopPublishing,
    /// Go on under other settings.
    Configure {
        /// Settings of fusion.
        fusion: Box<FusionConfig>,
        /// Known locations.
        landmarks: Vec<LandmarkConfig>,
    },
    /// Start from evidence that came from elsewhere.
    Adopt {
        /// All evidence that is known.
        ledger: Arc<ReputationLedger>,
    },
    /// Go on, in VOTE's `paper` mode, from reputations that were published.
    Resume {
        /// The reputations.
        reputations: BTreeMap<NodeName, Reputation>,
    },
    /// Query whether the reports of vehicles are usable by their time.
    Timeliness {
        /// Gets the share of the vehicles.
        reply: RpcReplyPort<Timeliness>,
    },
}
