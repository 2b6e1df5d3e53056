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

/// The counts of other cells as last told, and the trust in those cells.
#[derive(Debug, Clone, Default)]
pub(super) struct ForeignView {
    reputations: Arc<ForeignReputations>,
    /// Trust in each cell, 0 to 1, by which votes and tracks weigh them at present; none if they do not yet.
    trust: Option<BTreeMap<NodeName, f64>>,
    /// True if what counts has changed since it was asked for.
    is_news: bool,
}

impl ForeignView {
    /// Takes all that is known.
    pub(super) fn set(&mut self, reputations: &Arc<ForeignReputations>) {
        (self.reputations, self.trust) = (Arc::clone(reputations), None);
    }

    /// Has votes and tracks told again: they may have begun anew.
    pub(super) fn repeat(&mut self) {
        self.trust = None;
    }

    /// Tells votes and tracks, if anything or the trust in any cell has changed. A cell of which tracks know nothing is
    /// trusted as a newcomer is.
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

    /// The votes beside the prior of published reputations, if they have changed since the last call.
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
    /// Takes all that other cells say of vehicles. It moves the trust from which they start, from the next round on.
    pub fn take_foreign(&mut self, reputations: &Arc<ForeignReputations>) {
        self.foreign.set(reputations);
    }

    /// The votes of other cells beside the prior of published reputations, if they have changed since the last call.
    pub fn take_foreign_news(&mut self) -> Option<BTreeMap<NodeName, ForeignVotes>> {
        self.foreign.take_news(self.initial_votes)
    }

    /// The vehicles that are present: those heard in the last ten seconds.
    pub fn present(&self, now: Timestamp) -> BTreeSet<NodeName> {
        self.windows
            .iter()
            .flat_map(|window| window.present(now))
            .collect()
    }
}
