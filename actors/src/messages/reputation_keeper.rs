//! Messages to the actor of this name.

use std::collections::BTreeMap;
use std::sync::Arc;

use ecod::model::epoch::Epoch;
use ecod::model::names::NodeName;
use ecod::reputation::{Evidence, ReputationConfig};
use ecod::wire::{ForeignVotes, LedgerShare, Reputation};

use crate::transport::mqtt::Delivery;

/// Messages to the keeper.
#[derive(Debug)]
pub enum ReputationKeeperMessage {
    /// Publish in the node's own leadership from now on.
    Lead {
        /// The leadership.
        epoch: Epoch,
        /// Number of the last round before it.
        last_round: u64,
    },
    /// Record what a round of the node's own leadership says about vehicles.
    Record {
        /// The leadership.
        epoch: Epoch,
        /// The round.
        round: u64,
        /// Votes that were settled by it.
        evidence: Vec<Evidence>,
        /// In VOTE's `paper` mode, the reputations after it.
        reputations: Option<BTreeMap<NodeName, Reputation>>,
    },
    /// Publish scores beside these votes of other cells.
    SetForeign {
        /// The round from which on they count.
        round: u64,
        /// All votes of other cells, as they count here.
        votes: BTreeMap<NodeName, ForeignVotes>,
    },
    /// Tell the uplink all counts that other cells are told, and from now on what changes.
    TellUplink,
    /// Publish nothing more.
    StepDown,
    /// Go on with other parameters of reputations.
    Configure {
        /// The parameters.
        reputation: ReputationConfig,
    },
    /// Take in another candidate's evidence.
    Merge {
        /// The share and when it came.
        delivery: Delivery<Arc<LedgerShare>>,
    },
    /// Share all evidence: a node needs it to lead, or to remain the leader.
    SendSnapshot {
        /// The node; other candidates get it too.
        to: NodeName,
    },
    /// Save, publish and pass on what has changed.
    Tick,
    /// Drop the evidence of nodes whose certificate was revoked.
    CheckCertificates,
}
