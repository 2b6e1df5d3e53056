//! The share of one vehicle in the verdicts of an open cell: verdicts on which no other vehicle
//! voted take a bounded part of a round, and the rest waits for later rounds.

use std::collections::BTreeMap;

use super::map_share::{MAX_SOLE_BYTES, SCORE_BYTES, escaped};
use crate::model::names::{LandmarkId, NodeName};
use crate::vote::Vote;
use crate::wire::Verdict;

/// Size in JSON of a verdict without its texts.
const VERDICT_BYTES: usize = 110;

/// Landmarks whose verdicts wait, at most one entry of each.
#[derive(Debug, Clone, Default)]
pub(super) struct VerdictShare {
    /// By the only voter, or `None` if the voter has left; the longest waiting landmarks first.
    waiting: BTreeMap<Option<NodeName>, BTreeMap<u64, LandmarkId>>,
    positions: BTreeMap<LandmarkId, QueuePosition>,
    /// Number of the next entry.
    next: u64,
}

/// The position of a waiting landmark in its voter's queue.
#[derive(Debug, Clone)]
struct QueuePosition {
    voter: Option<NodeName>,
    number: u64,
}

impl VerdictShare {
    /// True if no verdict waits.
    pub(super) fn is_empty(&self) -> bool {
        self.positions.is_empty()
    }

    /// Reduces the new verdicts of a round to each vehicle's share, in which landmarks that wait
    /// come first. All verdicts on which several vehicles voted are kept.
    pub(super) fn limit(&mut self, verdicts: Vec<Verdict>, vote: &Vote) -> Vec<Verdict> {
        let mut kept = Vec::new();
        for verdict in verdicts {
            if verdict.contributors.len() > 1 {
                self.remove(&verdict.landmark);
                kept.push(verdict);
            } else {
                self.add(verdict);
            }
        }
        let mut published = Vec::new();
        for landmarks in self.waiting.values() {
            let mut bytes = 0;
            for landmark in landmarks.values() {
                let verdict = vote.verdict(landmark);
                let is_first = bytes == 0;
                bytes += verdict.as_ref().map_or(0, bytes_of);
                if bytes > MAX_SOLE_BYTES && !is_first {
                    break;
                }
                kept.extend(verdict);
                published.push(landmark.clone());
            }
        }
        published.iter().for_each(|landmark| self.remove(landmark));
        kept.sort_by(|one, other| one.landmark.cmp(&other.landmark));
        kept
    }

    /// The new verdicts and all that wait, for the end of a recording.
    pub(super) fn drain(&mut self, verdicts: Vec<Verdict>, vote: &Vote) -> Vec<Verdict> {
        verdicts.into_iter().for_each(|verdict| self.add(verdict));
        std::mem::take(self)
            .positions
            .keys()
            .filter_map(|landmark| vote.verdict(landmark))
            .collect()
    }

    /// Adds a landmark behind the others of its voter; a waiting landmark keeps its position.
    fn add(&mut self, verdict: Verdict) {
        let voter = verdict.contributors.into_iter().next();
        let landmark = verdict.landmark;
        if self
            .positions
            .get(&landmark)
            .is_some_and(|position| position.voter == voter)
        {
            return;
        }
        self.remove(&landmark);
        let number = self.next;
        self.next += 1;
        self.waiting
            .entry(voter.clone())
            .or_default()
            .insert(number, landmark.clone());
        self.positions
            .insert(landmark, QueuePosition { voter, number });
    }

    fn remove(&mut self, landmark: &LandmarkId) {
        let Some(QueuePosition { voter, number }) = self.positions.remove(landmark) else {
            return;
        };
        if let Some(landmarks) = self.waiting.get_mut(&voter) {
            landmarks.remove(&number);
            if landmarks.is_empty() {
                self.waiting.remove(&voter);
            }
        }
    }
}

/// About the size of a verdict in JSON.
fn bytes_of(verdict: &Verdict) -> usize {
    let scores = verdict
        .votes
        .keys()
        .map(|label| escaped(label) + SCORE_BYTES);
    let names = verdict.contributors.iter().map(|name| name.as_str().len());
    VERDICT_BYTES
        + escaped(&verdict.landmark)
        + verdict.label.as_ref().map_or(0, escaped)
        + scores.sum::<usize>()
        + names.sum::<usize>()
}
