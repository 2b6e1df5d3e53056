//! Likelihood of votes and the posterior that follows from it.

use smallvec::SmallVec;

use super::index_map::LabelIndex;

/// A vote in the form for the model.
#[derive(Debug, Clone, Copy)]
pub(super) struct WeightedVote {
    /// Index of the vehicle.
    pub(super) vehicle: usize,
    pub(super) label: LabelIndex,
    /// Calibrated confidence × visibility, 1 for a plain vote.
    pub(super) weight: f64,
    /// Part of the vote that does not depend on other vehicles, 0 to 1.
    pub(super) independence: f64,
}

/// Probabilities of labels.
pub(super) type Posterior = SmallVec<[(LabelIndex, f64); 2]>;

/// Evaluation of a landmark by all its votes.
pub(super) struct LandmarkPosterior {
    pub(super) labels: Posterior,
    /// Probability of each vote's label given the other votes.
    pub(super) agreements: SmallVec<[f64; 4]>,
}

/// Likelihood of one vote, by candidate for the true label.
pub(super) struct Likelihood {
    /// Logarithm of the probability that the vehicle states the vote's label, but at most its value
    /// where the stated label is true, so that a vote does not count against its own label.
    /// Otherwise the model has a mirrored solution, in which the honest majority counts as
    /// consistently wrong.
    pub(super) logs: SmallVec<[f64; 2]>,
    /// The logarithm where the stated label is true.
    own_log: f64,
}

impl Likelihood {
    /// Created from the probabilities by candidate; the vote's label is one of the candidates.
    pub(super) fn new(
        vote: &WeightedVote,
        candidates: &[LabelIndex],
        stating: impl Iterator<Item = f64>,
    ) -> Self {
        let mut logs: SmallVec<[f64; 2]> = stating.map(|p| p.max(1e-12).ln()).collect();
        let own_log = candidates
            .iter()
            .zip(&logs)
            .find(|(label, _)| **label == vote.label)
            .map_or(0.0, |(_, own)| *own);
        logs.iter_mut().for_each(|log| *log = log.min(own_log));
        Self { logs, own_log }
    }

    /// The posterior of the same candidates without `vote`.
    pub(super) fn leave_out(
        &self,
        vote: &WeightedVote,
        posterior: &[(LabelIndex, f64)],
    ) -> Posterior {
        let weight = vote.weight * vote.independence;
        let without = |((label, p), log): (&(LabelIndex, f64), &f64)| {
            (*label, p * (weight * (self.own_log - log)).min(500.0).exp())
        };
        let mut others: Posterior = posterior.iter().zip(&self.logs).map(without).collect();
        if normalise(&mut others) {
            others
        } else {
            posterior.into()
        }
    }
}

/// Scales the sum to 1; returns false, without a change, if the sum is 0.
pub(super) fn normalise(posterior: &mut [(LabelIndex, f64)]) -> bool {
    let total: f64 = posterior.iter().map(|(_, p)| p).sum();
    if total > 0.0 {
        posterior.iter_mut().for_each(|(_, p)| *p /= total);
    }
    total > 0.0
}

/// Probability of a label; 0 for a label that is not listed.
pub(super) fn probability(posterior: &[(LabelIndex, f64)], label: LabelIndex) -> f64 {
    posterior
        .iter()
        .find(|(l, _)| *l == label)
        .map_or(0.0, |(_, p)| *p)
}
