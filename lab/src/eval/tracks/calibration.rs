//! Calibration: how often an object exists that is reported with a given probability.
//!
//! The expected calibration error is the mean difference of both over bins of equal width, weighted
//! by the objects in each (Naeini, Cooper, Hauskrecht, AAAI 2015). Zero is perfect; the error does
//! not measure how well probabilities separate true objects from false ones.

use serde::Serialize;

use super::matching::{best, near_pairs};
use super::{SaidObject, ScoredFrame, ZERO_DISTANCE_M, percent};

/// Bins of equal width.
const BINS: usize = 10;

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

/// The reliability diagram of a probability, and its expected calibration error.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Reliability {
    /// Expected calibration error; `None` without reported objects.
    pub ece_pct: Option<f64>,
    /// Bins that are not empty, in ascending order.
    pub bins: Vec<ReliabilityBin>,
}

/// Objects of which nearly the same probability was stated.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct ReliabilityBin {
    /// Their mean probability.
    pub stated_pct: f64,
    /// The share of them that is right.
    pub right_pct: f64,
    /// Their number.
    pub objects: u64,
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
    stated: impl Fn(&SaidObject) -> Option<f64>,
) -> Reliability {
    let mut sums = [(0u64, 0u64, 0.0); BINS];
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
            let Some(stated) = stated(said) else { continue };
            let (objects, right, sum) = &mut sums[((stated * BINS as f64) as usize).min(BINS - 1)];
            (*objects, *right, *sum) = (*objects + 1, *right + u64::from(is_right), *sum + stated);
        }
    }
    let all: u64 = sums.iter().map(|(objects, ..)| objects).sum();
    let error: f64 = sums
        .iter()
        .map(|(_, right, sum)| (*right as f64 - sum).abs())
        .sum();
    let filled = sums.iter().filter(|(objects, ..)| *objects > 0);
    let bins = filled.map(|&(objects, right, sum)| ReliabilityBin {
        stated_pct: 100.0 * sum / objects as f64,
        right_pct: 100.0 * right as f64 / objects as f64,
        objects,
    });
    Reliability {
        ece_pct: percent(error, all),
        bins: bins.collect(),
    }
}
