//! Average precision by centre distance, and the greatest F1.
//!
//! Objects are taken in descending order of confidence; each takes the nearest true object of its
//! label that is within the distance and not yet taken, or is a false alarm. This is also the
//! method of nuScenes (Caesar et al., CVPR 2020, section 3.4), and OPV2V and V2V4Real with overlap
//! in place of distance.
//!
//! Average precision is the area under the curve of precision over recall, with precision the
//! greatest at that recall or a higher one, summed over all points at which recall changes. This is
//! the definition of PASCAL VOC since 2010 (Everingham et al., IJCV 2015) and of the cooperative
//! benchmarks, so the figures are comparable to theirs. nuScenes leaves out values below 10 % of
//! precision or recall, and is not comparable. Objects of equal confidence enter the curve
//! together, because a threshold cannot separate them.

use std::collections::BTreeMap;

use ecod::model::names::Label;

use super::matching::{MatchedPair, near_pairs};
use super::{AP_DISTANCES_M, MATCH_DISTANCE_M, ScoredFrame};

/// The threshold at which F1 is greatest.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct BestF1 {
    pub(super) threshold: f64,
    pub(super) f1: f64,
}

/// The average precisions in percent of every class of the truth; a class that is only reported is
/// ignored.
pub(super) fn by_class(
    frames: &[ScoredFrame],
) -> BTreeMap<Label, [Option<f64>; AP_DISTANCES_M.len()]> {
    let mut objects: BTreeMap<Label, u64> = BTreeMap::new();
    for object in frames.iter().flat_map(|frame| &frame.truth) {
        *objects.entry(object.label.clone()).or_default() += 1;
    }
    let mut classes: BTreeMap<Label, _> = objects
        .keys()
        .map(|label| (label.clone(), [None; 4]))
        .collect();
    for (place, limit_m) in AP_DISTANCES_M.into_iter().enumerate() {
        let verdicts = verdicts(frames, limit_m);
        for (label, ap_pct) in &mut classes {
            let of_class: Vec<RankedObject> = verdicts
                .iter()
                .filter(|verdict| verdict.label == label)
                .copied()
                .collect();
            ap_pct[place] = Some(100.0 * average_precision(&curve(of_class, objects[label])));
        }
    }
    classes
}

/// The threshold of the greatest F1; `None` without reported or without true objects.
pub(super) fn best_f1(frames: &[ScoredFrame]) -> Option<BestF1> {
    let objects: usize = frames.iter().map(|frame| frame.truth.len()).sum();
    if objects == 0 {
        return None;
    }
    let f1 = |point: &Point| BestF1 {
        threshold: point.threshold,
        f1: 2.0 * point.precision * point.recall
            / (point.precision + point.recall).max(f64::MIN_POSITIVE),
    };
    let points = curve(verdicts(frames, MATCH_DISTANCE_M), objects as u64);
    points
        .iter()
        .map(f1)
        .reduce(|best, next| if next.f1 > best.f1 { next } else { best })
}

/// The greatest MODA in percent over all thresholds, at every distance; `None` without true
/// objects.
pub(super) fn best_moda_pct(frames: &[ScoredFrame]) -> [Option<f64>; AP_DISTANCES_M.len()] {
    let objects: usize = frames.iter().map(|frame| frame.truth.len()).sum();
    let moda = |point: &Point| point.recall * (2.0 - 1.0 / point.precision.max(f64::MIN_POSITIVE));
    AP_DISTANCES_M.map(|limit_m| {
        let points = (objects > 0).then(|| curve(verdicts(frames, limit_m), objects as u64))?;
        Some(100.0 * points.iter().map(moda).fold(0.0, f64::max))
    })
}

/// True if a reported object took a true one.
#[derive(Debug, Clone, Copy)]
struct RankedObject<'a> {
    label: &'a Label,
    score: f64,
    is_right: bool,
}

/// Precision and recall of all objects from a threshold up.
#[derive(Debug, Clone, Copy)]
struct Point {
    threshold: f64,
    precision: f64,
    recall: f64,
}

fn verdicts(frames: &[ScoredFrame], limit_m: f64) -> Vec<RankedObject<'_>> {
    let mut verdicts = Vec::new();
    for frame in frames {
        let mut by_said: Vec<Vec<MatchedPair>> = vec![Vec::new(); frame.said.len()];
        for pair in near_pairs(frame, limit_m) {
            by_said[pair.said].push(pair);
        }
        let mut order: Vec<usize> = (0..frame.said.len()).collect();
        order.sort_by(|a, b| frame.said[*b].score.total_cmp(&frame.said[*a].score));
        let mut taken = vec![false; frame.truth.len()];
        for said in order {
            let free = by_said[said].iter().filter(|pair| !taken[pair.truth]);
            let nearest = free.min_by(|a, b| a.value.total_cmp(&b.value));
            if let Some(pair) = nearest {
                taken[pair.truth] = true;
            }
            let object = &frame.said[said];
            verdicts.push(RankedObject {
                label: &object.label,
                score: object.score,
                is_right: nearest.is_some(),
            });
        }
    }
    verdicts
}

fn curve(mut verdicts: Vec<RankedObject<'_>>, objects: u64) -> Vec<Point> {
    verdicts.sort_by(|a, b| b.score.total_cmp(&a.score));
    let mut right = 0u64;
    let mut all = 0u64;
    let mut points = Vec::new();
    for equal in verdicts.chunk_by(|a, b| a.score == b.score) {
        right += equal.iter().filter(|verdict| verdict.is_right).count() as u64;
        all += equal.len() as u64;
        points.push(Point {
            threshold: equal[0].score,
            precision: right as f64 / all as f64,
            recall: right as f64 / objects as f64,
        });
    }
    points
}

fn average_precision(points: &[Point]) -> f64 {
    let mut area = 0.0;
    let mut precision = 0.0;
    for (place, point) in points.iter().enumerate().rev() {
        precision = point.precision.max(precision);
        let before = if place > 0 {
            points[place - 1].recall
        } else {
            0.0
        };
        area += (point.recall - before) * precision;
    }
    area
}
