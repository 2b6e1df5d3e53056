//! Requests to the actor `ReputationKeeper`, from the fuser, the gateway and the election.

use std::collections::BTreeMap;
use std::sync::Arc;

use ecod::model::epoch::Epoch;
use ecod::model::names::NodeName;
use ecod::reputation::{Evidence, ReputationConfig};
use ecod::wire::{LedgerShare, Reputation};

use crate::transport::mqtt::Delivery;

/// Messages to the keeper.
#[derive(Debug)]
pub enum ReputationKeeperMessage {
    /// Publish in the node's own leadership from now on.
    Lead {
        /// Epoch of the node's own leadership.
        epoch: Epoch,
        /// Number of the last round before it.
        last_round: u64,
    },
    /// Record the evidence about vehicles from a round of the node's own leadership.
    Record {
        /// Epoch of the leadership that closed the round.
        epoch: Epoch,
        /// Number of the round.
        round: u64,
        /// Votes that were settled by it.
        evidence: Vec<Evidence>,
        /// In VOTE's `paper` mode, the reputations after it.
        reputations: Option<BTreeMap<NodeName, Reputation>>,
    },
    /// Stop publishing, because the leadership has ended.
    StepDown,
    /// Continue with other parameters of reputations.
    Configure {
        /// Parameters by which evidence becomes reputations.
        reputation: ReputationConfig,
    },
    /// Merge another candidate's evidence.
    Merge {
        /// The share and its time of receipt.
        delivery: Delivery<Arc<LedgerShare>>,
    },
    /// Share all evidence: a node needs it to lead, or to remain the leader.
    SendSnapshot {
        /// The node; other candidates get it too.
        to: NodeName,
    },
    /// Save, publish and distribute pending changes.
    Tick,
    /// Drop the evidence of nodes whose certificate was revoked.
    CheckCertificates,
}
