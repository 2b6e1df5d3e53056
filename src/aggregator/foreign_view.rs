//! Counts of other cells about vehicles, as votes and tracks weigh them.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use super::Aggregator;
use crate::model::names::NodeName;
use crate::model::time::Timestamp;
use crate::reputation::ForeignReputations;
use crate::tracking::Tracker;
use crate::vote::Vote;
use crate::wire::ForeignVotes;

/// The latest counts of other cells, and the trust in those cells.
#[derive(Debug, Clone, Default)]
pub(super) struct ForeignView {
    reputations: Arc<ForeignReputations>,
    /// Trust in each cell, 0 to 1, that votes and tracks currently use; `None` if they have not
    /// been set yet.
    trust: Option<BTreeMap<NodeName, f64>>,
    /// True if the effective counts have changed since they were last read.
    is_news: bool,
}

impl ForeignView {
    /// Replaces all counts.
    pub(super) fn set(&mut self, reputations: &Arc<ForeignReputations>) {
        (self.reputations, self.trust) = (Arc::clone(reputations), None);
    }

    /// Makes the next call of `weigh` update votes and tracks, because they may have restarted.
    pub(super) fn repeat(&mut self) {
        self.trust = None;
    }

    /// Updates votes and tracks if the counts or the trust in any cell have changed. A cell without
    /// a track record is trusted like a newcomer.
    pub(super) fn weigh(&mut self, vote: Option<&mut Vote>, tracks: Option<&mut Tracker>) {
        let of_cell = |cell: &NodeName| {
            tracks
                .as_ref()
                .map_or(1.0, |tracks| tracks.trust_in_cell(cell))
        };
        let trust = self
            .reputations
            .cells()
            .into_iter()
            .map(|cell| (cell.clone(), of_cell(cell)))
            .collect();
        if self.trust.as_ref() == Some(&trust) {
            return;
        }
        (self.trust, self.is_news) = (Some(trust), true);
        if let Some(vote) = vote {
            vote.set_foreign(|prior_votes| self.votes_beside(prior_votes));
        }
        if let Some(tracks) = tracks {
            tracks.set_foreign(|prior_votes| self.votes_beside(prior_votes));
        }
    }

    /// The votes of other cells for published reputations, if they have changed since the last
    /// call.
    pub(super) fn take_news(
        &mut self,
        prior_votes: f64,
    ) -> Option<BTreeMap<NodeName, ForeignVotes>> {
        std::mem::take(&mut self.is_news).then(|| self.votes_beside(prior_votes))
    }

    fn votes_beside(&self, prior_votes: f64) -> BTreeMap<NodeName, ForeignVotes> {
        let trust = |cell: &NodeName| {
            self.trust
                .as_ref()
                .and_then(|trust| trust.get(cell).copied())
                .unwrap_or(1.0)
        };
        self.reputations.votes(prior_votes, trust)
    }
}

impl Aggregator {
    /// Replaces all counts of other cells about vehicles. From the next round on, they change the
    /// reputation with which the vehicles start.
    pub fn take_foreign(&mut self, reputations: &Arc<ForeignReputations>) {
        self.foreign.set(reputations);
    }

    /// The votes of other cells for published reputations, if they have changed since the last
    /// call.
    pub fn take_foreign_news(&mut self) -> Option<BTreeMap<NodeName, ForeignVotes>> {
        self.foreign.take_news(self.initial_votes)
    }

    /// The present vehicles: those that were active in the last ten seconds.
    pub fn present(&self, now: Timestamp) -> BTreeSet<NodeName> {
        self.windows
            .iter()
            .flat_map(|window| window.present(now))
            .collect()
    }
}
