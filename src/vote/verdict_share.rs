//! The share of one vehicle in a round's verdicts: verdicts that rest on one vehicle alone take a
//! bounded part of the message.

use std::collections::{BTreeMap, BTreeSet};

use crate::model::names::{LandmarkId, NodeName};
use crate::wire::Verdict;

/// Maximum size in JSON of the verdicts of a round that rest on one vehicle, including its parts:
/// about 170 verdicts with short texts. Without this bound, one member could name enough locations
/// to fill the links of all nodes.
const MAX_SOLE_BYTES: usize = 32 * 1024;

/// Size in JSON of a verdict without its texts.
const NUMBERS_BYTES: usize = 128;

/// Size in JSON of one label's votes without the label.
const VOTES_BYTES: usize = 24;

/// Landmarks of an open cell whose news waits for a later round.
#[derive(Debug, Clone, Default)]
pub(super) struct PostponedVerdicts {
    landmarks: BTreeSet<LandmarkId>,
}

impl PostponedVerdicts {
    /// The verdicts of the landmarks that were postponed or have `changed`, the postponed ones
    /// first. Verdicts beyond the share of a vehicle are postponed to the next round.
    pub(super) fn next(
        &mut self,
        changed: BTreeSet<LandmarkId>,
        verdict: impl Fn(&LandmarkId) -> Option<Verdict>,
    ) -> Vec<Verdict> {
        let waiting = std::mem::take(&mut self.landmarks);
        let new = changed
            .iter()
            .filter(|landmark| !waiting.contains(*landmark));
        let mut bytes: BTreeMap<NodeName, usize> = BTreeMap::new();
        let mut verdicts = Vec::new();
        for landmark in waiting.iter().chain(new) {
            let Some(verdict) = verdict(landmark) else {
                continue;
            };
            let is_within_share = match &verdict.contributors[..] {
                [node] => {
                    let used = bytes.entry(node.vehicle()).or_default();
                    *used += bytes_of(&verdict);
                    *used <= MAX_SOLE_BYTES
                }
                _ => true,
            };
            if is_within_share {
                verdicts.push(verdict);
            } else {
                self.landmarks.insert(landmark.clone());
            }
        }
        verdicts
    }
}

/// About the size of a verdict in JSON.
fn bytes_of(verdict: &Verdict) -> usize {
    let votes = verdict.votes.keys().map(|label| label.len() + VOTES_BYTES);
    let names = verdict.contributors.iter().map(|name| name.as_str().len());
    NUMBERS_BYTES
        + verdict.landmark.as_str().len()
        + verdict.label.as_ref().map_or(0, |label| label.len())
        + votes.sum::<usize>()
        + names.sum::<usize>()
}
