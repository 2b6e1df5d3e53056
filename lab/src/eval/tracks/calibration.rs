//! Calibration: how often an object exists that is reported with a given probability.

use serde::Serialize;

use super::matching::{best, near_pairs};
use super::{ReportedObject, ScoredFrame, ZERO_DISTANCE_M};
use crate::eval::reliability::{JudgedStatement, Reliability};

/// The distance in metres within which a `confidence` places the object.
const CONFIDENCE_DISTANCE_M: f64 = 1.5;

/// Calibration of the probabilities of a map.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ReliabilityBins {
    /// Of `confidence`: right if a true object is within 1.5 m.
    pub confidence: Reliability,
    /// Calibration of `existence`, which is independent of the exact place: right if a true object
    /// is within 4 m. Absent if existence is not stated.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub existence: Option<Reliability>,
}

pub(super) fn judge(frames: &[ScoredFrame]) -> ReliabilityBins {
    let states_existence = frames
        .iter()
        .flat_map(|frame| &frame.said)
        .any(|said| said.existence.is_some());
    ReliabilityBins {
        confidence: reliability(frames, CONFIDENCE_DISTANCE_M, |said| Some(said.score)),
        existence: states_existence
            .then(|| reliability(frames, ZERO_DISTANCE_M, |said| said.existence)),
    }
}

/// Reported and true objects of equal label are matched one to one, so that the sum of their
/// nearness is greatest.
fn reliability(
    frames: &[ScoredFrame],
    limit_m: f64,
    stated: impl Fn(&ReportedObject) -> Option<f64>,
) -> Reliability {
    let mut statements = Vec::new();
    for frame in frames {
        let mut pairs = near_pairs(frame, limit_m);
        // A pair just within the limit still has some benefit.
        pairs
            .iter_mut()
            .for_each(|pair| pair.value = 2.0 - pair.value / limit_m);
        let mut is_right = vec![false; frame.said.len()];
        best(&pairs)
            .iter()
            .for_each(|pair| is_right[pair.said] = true);
        for (said, is_right) in frame.said.iter().zip(is_right) {
            if let Some(stated) = stated(said) {
                statements.push(JudgedStatement { stated, is_right });
            }
        }
    }
    Reliability::of(statements)
}
