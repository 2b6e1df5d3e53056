//! Votes of the vehicles, without fusion: their majority, and each vehicle alone.

use std::collections::BTreeMap;

use ecod::model::geometry::Covariance;
use ecod::model::names::{Label, NodeName};
use ecod::perception::landmark::{Landmark, LandmarkGate, LandmarkIndex};
use ecod::wire::PerceivedObject;
use nalgebra::Point2;
use serde::Serialize;

use super::truth::Truth;
use super::{Item, percent};

/// One vehicle alone. Shares are percentages; `None` without evaluated items.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct VehicleScores {
    /// Votes on locations with a truth.
    pub votes: u64,
    /// Right votes of these.
    pub vote_accuracy_pct: Option<f64>,
    /// Share of items that it voted on, among the items with an object.
    pub coverage_pct: Option<f64>,
    /// Right items of all when it alone decides.
    pub accuracy_pct: Option<f64>,
}

/// The votes on all items, by vehicle.
#[derive(Debug, Clone, Default)]
pub(super) struct Votes {
    items: BTreeMap<Item, BTreeMap<NodeName, Ballot>>,
}

type Ballot = BTreeMap<Label, Said>;

#[derive(Debug, Clone, Copy, Default)]
struct Said {
    votes: u64,
    right: bool,
}

impl Votes {
    pub(super) fn is_empty(&self) -> bool {
        self.items.is_empty()
    }

    pub(super) fn count(&mut self, node: &NodeName, item: Item, label: &Label, right: bool) {
        let ballot = self
            .items
            .entry(item)
            .or_default()
            .entry(node.clone())
            .or_default();
        let said = ballot.entry(label.clone()).or_default();
        said.votes += 1;
        said.right = right;
    }

    pub(super) fn majority_accuracy_pct(&self, truth: &Truth) -> Option<f64> {
        let mut all = 0;
        let mut right = 0.0;
        for (id, number, span) in truth.spans() {
            all += 1;
            let mut sums = Ballot::new();
            for (label, said) in self
                .items
                .get(&(id.clone(), number))
                .into_iter()
                .flatten()
                .flat_map(|(_, b)| b)
            {
                let sum = sums.entry(label.clone()).or_default();
                *sum = Said {
                    votes: sum.votes + said.votes,
                    right: said.right,
                };
            }
            right +=
                chance(&sums).unwrap_or_else(|| f64::from(u8::from(truth.accepts(span, None))));
        }
        if self.is_empty() {
            None
        } else {
            percent(right, all)
        }
    }

    pub(super) fn vehicles(&self, truth: &Truth) -> BTreeMap<NodeName, VehicleScores> {
        let mut all = 0;
        let mut standing = 0;
        let mut free = 0;
        for (_, _, span) in truth.spans() {
            all += 1;
            *(if truth.accepts(span, None) {
                &mut free
            } else {
                &mut standing
            }) += 1;
        }
        let mut sums: BTreeMap<&NodeName, Sum> = BTreeMap::new();
        for (id, number, span) in truth.spans() {
            for (node, ballot) in self.items.get(&(id.clone(), number)).into_iter().flatten() {
                let sum = sums.entry(node).or_default();
                sum.votes += ballot.values().map(|said| said.votes).sum::<u64>();
                sum.right_votes += ballot
                    .values()
                    .filter(|said| said.right)
                    .map(|said| said.votes)
                    .sum::<u64>();
                sum.right_items += chance(ballot).unwrap_or(0.0);
                *(if truth.accepts(span, None) {
                    &mut sum.free
                } else {
                    &mut sum.standing
                }) += 1;
            }
        }
        let scores = |sum: Sum| VehicleScores {
            votes: sum.votes,
            vote_accuracy_pct: percent(sum.right_votes as f64, sum.votes),
            coverage_pct: percent(sum.standing as f64, standing),
            // No vote is right for an empty location.
            accuracy_pct: percent(sum.right_items + (free - sum.free) as f64, all),
        };
        sums.into_iter()
            .map(|(node, sum)| (node.clone(), scores(sum)))
            .collect()
    }
}

#[derive(Debug, Default)]
struct Sum {
    votes: u64,
    right_votes: u64,
    right_items: f64,
    standing: u64,
    free: u64,
}

/// The chance that one of the most frequent labels, drawn at random, is right; `None` without
/// votes.
fn chance(ballot: &Ballot) -> Option<f64> {
    let most = ballot.values().map(|said| said.votes).max()?;
    let first = ballot.values().filter(|said| said.votes == most);
    Some(first.clone().filter(|said| said.right).count() as f64 / first.count() as f64)
}

/// The location to which an object is assigned: the location that it names, otherwise the best one
/// by position.
pub(super) fn place<'a>(
    object: &PerceivedObject,
    landmarks: &'a LandmarkIndex,
    gate: &LandmarkGate,
) -> Option<&'a Landmark> {
    let index = match &object.landmark {
        Some(id) => landmarks.position_of(id)?,
        None => {
            let covariance = object
                .covariance()
                .unwrap_or(Covariance::isotropic(gate.radius_m / gate.sigmas));
            landmarks
                .best(
                    &object.label,
                    &Point2::new(object.x_m, object.y_m),
                    &covariance,
                    gate,
                )?
                .landmark
        }
    };
    landmarks.landmarks().get(index)
}
