//! Going on from a ledger.

use std::cmp::Reverse;
use std::collections::BTreeMap;

use super::WeightedTally;
use crate::names::{Label, NodeName};
use crate::reputation::{RememberedVotes, ReputationLedger};
use crate::vote::confusion::{Confusion, LabelIndex};

impl WeightedTally {
    /// Takes over what a ledger remembers beyond what was counted here, as a standby has counted the latest itself; in
    /// place of what it took over before. Of more than `most_vehicles` or `most_labels` those with most evidence are
    /// taken, of vehicles that they were right, and those heard in the latest lanes.
    ///
    /// A ledger counts by stated label; what was right instead of a wrong one is taken to be any other label alike.
    pub(in super::super) fn adopt(&mut self, ledger: &ReputationLedger, (most_vehicles, most_labels): (usize, usize)) {
        let own = |node: &NodeName| {
            let (correct, incorrect) = self.vehicles.get(node).map_or((0, 0), |&vehicle| self.records[vehicle]);
            correct.saturating_add(incorrect)
        };
        let (heard, mut others): (Vec<_>, Vec<_>) = ledger
            .remembered(self.config.memory_votes, own)
            .into_iter()
            .partition(|(node, _)| self.vehicles.contains_key(node));
        let lanes = ledger.latest_lanes();
        others.sort_by_cached_key(|(node, labels)| {
            let correct: f64 = labels.values().map(|(correct, _)| correct).sum();
            (Reverse(correct.round() as u64), Reverse(lanes.get(node).copied()), node.clone())
        });
        others.truncate(most_vehicles.saturating_sub(self.vehicles.len()));
        let known = [heard, others].concat();
        self.adopt_labels(&known, most_labels);
        for (node, labels) in known {
            let mut inherited = Confusion::default();
            for (label, (correct, incorrect)) in labels {
                let Some(label) = self.labels.number(&label) else { continue };
                inherited.add(label, label, correct);
                let others: Vec<_> = (0..self.labels.len() as LabelIndex).filter(|l| *l != label).collect();
                let each = incorrect / others.len().max(1) as f64;
                if each > 0.0 {
                    others.into_iter().for_each(|truth| inherited.add(truth, label, each));
                }
            }
            let vehicle = self.vehicle(&node);
            self.model.witnesses[vehicle].inherited = inherited;
        }
    }

    fn adopt_labels(&mut self, known: &[(NodeName, RememberedVotes)], most: usize) {
        let mut votes: BTreeMap<&Label, f64> = BTreeMap::new();
        for (label, (correct, incorrect)) in known.iter().flat_map(|(_, labels)| labels) {
            // What is mostly wrong is of use as long as there is room.
            *votes.entry(label).or_default() += correct + 1e-3 * incorrect;
        }
        let mut labels: Vec<_> = votes.into_iter().collect();
        labels.sort_by(|a, b| b.1.total_cmp(&a.1));
        for (label, _) in labels {
            if self.labels.has_room_for(label, most) {
                self.label(label, None);
            }
        }
    }
}
