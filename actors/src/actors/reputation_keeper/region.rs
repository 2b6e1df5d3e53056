//! The keeper's exchange with other cells: counts for the uplink, votes from the uplink.

use std::cmp::Reverse;
use std::collections::BTreeMap;

use ecod::model::names::NodeName;
use ecod::reputation::CellCounts;
use ecod::wire::ForeignVotes;

use super::ReputationKeeperState;
use crate::messages::uplink::UplinkMessage;

/// Maximum number of vehicles whose counts a new leader compares with the region's. A former leader
/// may have stopped before it sent them.
const MAX_COMPARED: usize = 256;

/// Counts that were sent to the uplink.
#[derive(Debug, Default)]
pub(super) struct ToldCounts {
    counts: BTreeMap<NodeName, CellCounts>,
    /// True if the ledger may contain different counts.
    pub(super) is_due: bool,
    /// True if the uplink that had them has ended.
    is_lost: bool,
}

impl ReputationKeeperState {
    /// From now on publishes reputations that include these votes of other cells.
    pub(super) fn set_foreign(&mut self, round: u64, votes: BTreeMap<NodeName, ForeignVotes>) {
        self.arguments.reputations.open().foreign = votes;
        self.last_round = self.last_round.max(round);
    }

    /// Sends the uplink the counts of the most recently counted vehicles, even if it has them
    /// already. A vehicle that is counted later is included at the next check at the latest.
    pub(super) fn tell_all(&mut self) {
        if self.resync.leads().is_none() {
            return;
        }
        let store = self.arguments.reputations.open();
        let all = store
            .ledger
            .cell_counts(self.arguments.reputation.memory_votes);
        let lanes = store.ledger.latest_lanes();
        drop(store);
        let mut latest: Vec<_> = all.iter().collect();
        latest.sort_by_key(|(node, _)| Reverse(lanes.get(*node).copied()));
        let counts = latest
            .into_iter()
            .take(MAX_COMPARED)
            .map(|(node, counts)| (node.clone(), *counts))
            .collect();
        let is_lost = !self
            .arguments
            .uplink
            .send(UplinkMessage::TellCounts { counts });
        self.told = ToldCounts {
            counts: all,
            is_due: false,
            is_lost,
        };
    }

    /// Sends changed counts to the uplink, while this node leads.
    pub(super) fn tell_uplink(&mut self) {
        let is_wanted = self.resync.leads().is_some() && self.arguments.uplink.get().is_some();
        if is_wanted && self.told.is_lost {
            return self.tell_all();
        }
        if !is_wanted || !std::mem::take(&mut self.told.is_due) {
            return;
        }
        let store = self.arguments.reputations.open();
        let now = store
            .ledger
            .cell_counts(self.arguments.reputation.memory_votes);
        // After a reset, all counts of vehicles that the uplink had are void.
        let nothing = CellCounts {
            reset_at: store.ledger.reset_at(),
            ..CellCounts::default()
        };
        drop(store);
        let has_changed = |(node, counts): &(&NodeName, &CellCounts)| {
            self.told.counts.get(*node) != Some(*counts)
        };
        let changed = now
            .iter()
            .filter(has_changed)
            .map(|(node, counts)| (node.clone(), *counts));
        let gone = self
            .told
            .counts
            .keys()
            .filter(|node| !now.contains_key(*node))
            .map(|node| (node.clone(), nothing));
        let counts: Vec<_> = changed.chain(gone).collect();
        self.told.counts = now;
        self.told.is_lost = !counts.is_empty()
            && !self
                .arguments
                .uplink
                .send(UplinkMessage::TellCounts { counts });
    }
}
