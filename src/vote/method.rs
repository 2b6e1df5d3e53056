//! The interface of voting methods, which turn votes into verdicts, and their common types.

use std::collections::{BTreeMap, BTreeSet};

use super::config::VoteConfig;
use crate::model::names::{Label, LandmarkId, NodeName};
use crate::model::time::Timestamp;
use crate::reputation::{Evidence, ReputationLedger};
use crate::wire::{Reputation, Verdict};

/// A vote before it is counted.
#[derive(Debug, Clone, Copy)]
pub(super) struct NewVote<'a> {
    pub(super) landmark: &'a LandmarkId,
    pub(super) node: &'a NodeName,
    pub(super) label: &'a Label,
    pub(super) confidence: f64,
    /// Distance in metres and bearing in radians of the landmark, if the vehicle's pose is
    /// available.
    pub(super) range_bearing: Option<(f64, f64)>,
    pub(super) at: Timestamp,
}

/// A voting method. The default methods do nothing, for steps that a method does not need.
pub(super) trait VotingMethod {
    /// Applies other settings of the same mode.
    fn configure(&mut self, config: &VoteConfig);

    /// Adds a landmark, so that it has a verdict even without votes.
    fn add_landmark(&mut self, landmark: LandmarkId);

    fn remove_landmark(&mut self, landmark: &LandmarkId);

    fn has_landmark(&self, landmark: &LandmarkId) -> bool;

    /// All landmarks, by name.
    fn landmarks(&self) -> Vec<LandmarkId>;

    fn remove_vehicles(&mut self, nodes: &BTreeSet<NodeName>);

    /// Makes room for the label of a vote; returns the number of votes dropped for it, or `None` if
    /// there is no room.
    fn make_room_for(&mut self, vote: &NewVote<'_>, max_labels: usize) -> Option<usize>;

    fn add_vote(&mut self, vote: &NewVote<'_>);

    /// Ends a round: returns the landmarks with news and the votes that have turned out to be right
    /// or wrong.
    fn close(&mut self, now: Timestamp) -> (BTreeSet<LandmarkId>, Vec<Evidence>);

    /// The verdict at a landmark.
    fn verdict(&self, landmark: &LandmarkId) -> Option<Verdict>;

    /// The labels of the current votes on a landmark, and their vehicles.
    fn readings(&self, _landmark: &LandmarkId) -> BTreeMap<Label, Vec<NodeName>> {
        BTreeMap::new()
    }

    /// The reputation of each vehicle.
    fn reputations(&self) -> BTreeMap<NodeName, Reputation>;

    /// Whether a vehicle has voted often enough to be evaluated, and was right more often than
    /// wrong.
    fn is_proven(&self, _node: &NodeName) -> bool {
        false
    }

    /// False for a vehicle that was wrong more often than right.
    fn is_trusted(&self, _node: &NodeName) -> bool {
        true
    }

    /// See [`super::Vote::begin_record`].
    fn begin_record(&mut self, _now: Timestamp) {}

    /// See [`super::Vote::refine`].
    fn refine(&mut self, _passes: u32) {}

    /// See [`super::Vote::adopt`].
    fn adopt(&mut self, _ledger: &ReputationLedger, _limits: &VoteConfig) {}

    /// See [`super::Vote::resume`].
    fn resume(&mut self, _reputations: &BTreeMap<NodeName, Reputation>) {}
}

/// A verdict with `published` or, if absent, the label of the highest score, the first in
/// alphabetical order on a tie.
///
/// With hysteresis the published label may not be the highest for a while; its margin is 0 then.
pub(super) fn verdict(
    landmark: LandmarkId,
    votes: BTreeMap<Label, f64>,
    published: Option<Label>,
    contributors: Vec<NodeName>,
) -> Verdict {
    let label = published.or_else(|| best(&votes).cloned());
    let score = label
        .as_ref()
        .and_then(|l| votes.get(l))
        .copied()
        .unwrap_or(0.0);
    let others = votes
        .iter()
        .filter(|(l, _)| Some(*l) != label.as_ref())
        .map(|(_, s)| *s);
    let margin = (score - others.fold(0.0, f64::max)).max(0.0);
    Verdict {
        landmark,
        label,
        score,
        margin,
        votes,
        contributors,
    }
}

/// The label of the highest score, the first in alphabetical order on a tie.
pub(super) fn best(votes: &BTreeMap<Label, f64>) -> Option<&Label> {
    let mut best: Option<(&Label, f64)> = None;
    for (label, &score) in votes {
        if best.is_none_or(|(_, highest)| score > highest) {
            best = Some((label, score));
        }
    }
    best.map(|(label, _)| label)
}
