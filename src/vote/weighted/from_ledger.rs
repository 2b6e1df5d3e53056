//! Evidence taken over from a reputation ledger.

use std::cmp::Reverse;
use std::collections::BTreeMap;

use super::WeightedVoting;
use crate::model::names::{Label, NodeName};
use crate::reputation::{RememberedVotes, ReputationLedger};
use crate::vote::config::VoteConfig;
use crate::vote::confusion::Confusion;
use crate::vote::index_map::LabelIndex;
use crate::vote::label_bias::LabelRecord;

impl WeightedVoting {
    /// Takes over the ledger's kept votes except those that were counted here: a standby has
    /// counted the latest votes itself. They replace the votes of an earlier ledger.
    ///
    /// If room is short, the labels with most evidence are taken, and the vehicles that were right
    /// most often (on a tie, those in the latest lanes). A ledger counts by stated label only: the
    /// truth behind a wrong vote is assumed to be any other label with equal probability.
    pub(super) fn take_over(&mut self, ledger: &ReputationLedger, limits: &VoteConfig) {
        let own = |node: &NodeName| {
            self.vehicles
                .get(node)
                .map_or(0, |&vehicle| self.counts[vehicle].total())
        };
        let (heard, mut others): (Vec<_>, Vec<_>) = ledger
            .remembered(self.config.memory_votes, own)
            .into_iter()
            .partition(|(node, _)| self.vehicles.contains_key(node));
        let lanes = ledger.latest_lanes();
        others.sort_by_cached_key(|(node, labels)| {
            let correct: f64 = labels.values().map(|(correct, _)| correct).sum();
            (
                Reverse(correct.round() as u64),
                Reverse(lanes.get(node).copied()),
                node.clone(),
            )
        });
        others.truncate(limits.max_vehicles.saturating_sub(self.vehicles.len()));
        let known = [heard, others].concat();
        self.take_over_labels(&known, limits.max_labels);
        // Evidence that has left the ledger stops counting.
        self.model
            .vehicles
            .iter_mut()
            .for_each(|vehicle| vehicle.inherited = Confusion::default());
        self.model.label_bias.clear_inherited();
        for (node, labels) in known {
            let mut inherited = Confusion::default();
            let records: Vec<LabelRecord> = labels
                .into_iter()
                .filter_map(|(label, (right, wrong))| {
                    let label = self.labels.index(&label)?;
                    Some(LabelRecord {
                        label,
                        right,
                        wrong,
                    })
                })
                .collect();
            for &LabelRecord {
                label,
                right,
                wrong,
            } in &records
            {
                inherited.add(label, [(label, 1.0)], right);
                let labels = self.labels.len() as LabelIndex;
                if wrong > 0.0 && labels > 1 {
                    let each = 1.0 / f64::from(labels - 1);
                    let others = (0..labels).filter(|truth| *truth != label);
                    inherited.add(label, others.map(|truth| (truth, each)), wrong);
                }
            }
            let vehicle = self.vehicle(&node);
            self.model.label_bias.inherit(vehicle, &records);
            self.model.vehicles[vehicle].inherited = inherited;
        }
    }

    /// Adds the labels of the ledger's votes to the cell, the most useful labels first, as far as
    /// there is room.
    fn take_over_labels(&mut self, known: &[(NodeName, RememberedVotes)], max_labels: usize) {
        let mut votes: BTreeMap<&Label, f64> = BTreeMap::new();
        for (label, (correct, incorrect)) in known.iter().flat_map(|(_, labels)| labels) {
            // A label that is mostly wrong is only useful if there is room.
            *votes.entry(label).or_default() += correct + 1e-3 * incorrect;
        }
        let mut labels: Vec<_> = votes.into_iter().collect();
        labels.sort_by(|a, b| b.1.total_cmp(&a.1));
        for (label, _) in labels {
            if self.labels.has_room_for(label, max_labels) {
                self.label(label, None);
            }
        }
    }
}
