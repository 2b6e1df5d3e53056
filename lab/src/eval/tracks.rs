//! Accuracy of the objects of maps: detection, localisation and identity against a truth that
//! moves.
//!
//! An object of a map can be matched with a true object of equal label that is near enough.
//! Detection is evaluated by average precision at four distances and by the best F1; then, at a
//! threshold on the confidence, by MODA and MODP, CLEAR MOT, IDF1 and HOTA. Stated probabilities
//! are evaluated by their calibration. Definitions and sources are given with each part, and
//! together in `docs/evaluation.md`.
//!
//! Call [`TrackEvaluation::map`] with every map of a replay, in order, then
//! [`TrackEvaluation::result`]. Output of other programs is evaluated by [`score`].

mod calibration;
mod clear;
mod hota;
mod identity;
mod matching;
mod precision;
#[cfg(test)]
mod tests;
mod truth;

use std::collections::{BTreeMap, BTreeSet};

use ecod::model::names::Label;
use ecod::model::time::Timestamp;
use ecod::wire::{FusedObject, GlobalMap};
use hashbrown::HashMap;
use nalgebra::Point2;
use serde::Serialize;
use uuid::Uuid;

pub use calibration::ReliabilityBins;
pub use truth::{TrackTruth, TrackTruthError};

use super::formats::{Sequence, time_of};
use super::percent;

/// Distances in metres at which average precision is given.
pub const AP_DISTANCES_M: [f64; 4] = [0.5, 1.0, 2.0, 4.0];

/// Maximum distance in metres between matched objects, except in average precision and HOTA.
pub const MATCH_DISTANCE_M: f64 = 2.0;

/// Distance in metres at which the similarity of two places becomes zero; HOTA averages over
/// distances below it. At half of it the similarity 1 − d/d₀ is 0.5, the usual threshold, at
/// [`MATCH_DISTANCE_M`].
pub const ZERO_DISTANCE_M: f64 = 2.0 * MATCH_DISTANCE_M;

/// Default confidence from which an object counts.
pub const DEFAULT_THRESHOLD: f64 = 0.5;

/// Maximum distance of a map from a frame, as a share of the frame period. A half would leave
/// frames without a map if rounds jitter about the middle between two frames; a whole period would
/// hide missing maps.
const REACH: f64 = 0.75;

/// One moment: the true objects and the reported objects.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct ScoredFrame {
    /// True objects, each id once.
    pub truth: Vec<TrueObject>,
    /// Objects of the map, each id once.
    pub said: Vec<ReportedObject>,
}

/// An object of the truth in one frame.
#[derive(Debug, Clone, PartialEq)]
pub struct TrueObject {
    /// Identity: a small number, used as a table index.
    pub id: u32,
    /// Class of the object.
    pub label: Label,
    /// Its centre in metres.
    pub position: Point2<f64>,
}

/// An object of a map in one frame.
#[derive(Debug, Clone, PartialEq)]
pub struct ReportedObject {
    /// Reported identity: a small number, used as a table index.
    pub id: u32,
    /// Reported class.
    pub label: Label,
    /// Confidence that the object exists; for average precision only the order matters.
    pub score: f64,
    /// Probability that the object exists at any position, if stated separately from `confidence`.
    pub existence: Option<f64>,
    /// Its centre in metres.
    pub position: Point2<f64>,
}

impl ReportedObject {
    /// An object of a map; `ids` are the numbers given so far.
    pub fn of(object: &FusedObject, ids: &mut HashMap<Uuid, u32>) -> Self {
        let next = ids.len() as u32;
        Self {
            id: *ids.entry(object.id).or_insert(next),
            label: object.label.clone(),
            score: object.confidence,
            existence: object.existence,
            position: Point2::new(object.x_m, object.y_m),
        }
    }
}

/// Result of an evaluation. Shares are percentages; `None` without evaluated objects.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct TrackScores {
    /// Frames of the truth.
    pub frames: u64,
    /// Number of frames with a map; all objects of other frames count as missed.
    pub frames_with_map: u64,
    /// True objects, each in every frame.
    pub objects: u64,
    /// Number of reported objects in the frames, of any confidence.
    pub said: u64,
    /// Average precision at [`AP_DISTANCES_M`], the mean over the classes of the truth.
    pub ap_pct: [Option<f64>; AP_DISTANCES_M.len()],
    /// Average precision at [`AP_DISTANCES_M`] of every class.
    pub class_ap_pct: BTreeMap<Label, [Option<f64>; AP_DISTANCES_M.len()]>,
    /// Greatest F1 at [`MATCH_DISTANCE_M`] over all thresholds, all classes together.
    pub best_f1_pct: Option<f64>,
    /// Greatest MODA at [`AP_DISTANCES_M`] over all thresholds, all classes together, with the
    /// matches of average precision.
    pub best_moda_pct: [Option<f64>; AP_DISTANCES_M.len()],
    /// Scores at the threshold with the greatest F1.
    pub at_best_f1: ThresholdScores,
    /// Scores at [`DEFAULT_THRESHOLD`].
    pub at_default: ThresholdScores,
    /// Calibration of the stated probabilities, independent of the threshold.
    pub calibration: ReliabilityBins,
}

/// Figures of the objects whose confidence is at or above a threshold, at [`MATCH_DISTANCE_M`], all
/// classes together.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct ThresholdScores {
    /// Least confidence of the objects that count.
    pub threshold: f64,
    /// Reported objects that matched a true one.
    pub matches: u64,
    /// Reported objects without a match.
    pub false_alarms: u64,
    /// True objects without a match.
    pub misses: u64,
    /// Times that a true object was given another identity than before.
    pub id_switches: u64,
    /// Times that a true object was found again after it had been missed.
    pub fragments: u64,
    /// Detection accuracy 1 − (misses + false alarms) / objects; below zero with many false alarms.
    pub moda_pct: Option<f64>,
    /// Detection precision, mean of 1 − d/[`MATCH_DISTANCE_M`] over the matches.
    pub modp_pct: Option<f64>,
    /// Tracking accuracy 1 − (misses + false alarms + switches) / objects.
    pub mota_pct: Option<f64>,
    /// Mean distance of the matches in metres.
    pub motp_m: Option<f64>,
    /// F1 of identities that are one to one over the whole time.
    pub idf1_pct: Option<f64>,
    /// Higher order tracking accuracy.
    pub hota_pct: Option<f64>,
    /// Detection component of HOTA (DetA).
    pub deta_pct: Option<f64>,
    /// Association component of HOTA (AssA).
    pub assa_pct: Option<f64>,
    /// Mean similarity of the matches.
    pub loca_pct: Option<f64>,
}

/// Evaluates frames that follow each other in time.
pub fn score(frames: &[ScoredFrame]) -> TrackScores {
    let count = |of: fn(&ScoredFrame) -> usize| frames.iter().map(|frame| of(frame) as u64).sum();
    let class_ap_pct = precision::by_class(frames);
    let mean = |place: usize| {
        let all: Vec<f64> = class_ap_pct.values().filter_map(|ap| ap[place]).collect();
        percent(all.iter().sum::<f64>() / 100.0, all.len() as u64)
    };
    let best = precision::best_f1(frames);
    TrackScores {
        frames: frames.len() as u64,
        frames_with_map: frames.len() as u64,
        objects: count(|frame| frame.truth.len()),
        said: count(|frame| frame.said.len()),
        ap_pct: std::array::from_fn(mean),
        class_ap_pct,
        best_f1_pct: best.map(|best| 100.0 * best.f1),
        best_moda_pct: precision::best_moda_pct(frames),
        at_best_f1: at_threshold(
            frames,
            best.map_or(DEFAULT_THRESHOLD, |best| best.threshold),
        ),
        at_default: at_threshold(frames, DEFAULT_THRESHOLD),
        calibration: calibration::judge(frames),
    }
}

fn at_threshold(frames: &[ScoredFrame], threshold: f64) -> ThresholdScores {
    let kept = |frame: &ScoredFrame| {
        let said = frame
            .said
            .iter()
            .filter(|said| said.score >= threshold)
            .cloned()
            .collect();
        ScoredFrame {
            truth: frame.truth.clone(),
            said,
        }
    };
    let frames: Vec<ScoredFrame> = frames.iter().map(kept).collect();
    let clear = clear::judge(&frames);
    let identity = identity::judge(&frames);
    let hota = hota::judge(&frames);
    let objects = clear.matches + clear.misses;
    let wrong = (clear.misses + clear.false_alarms) as f64;
    let share = |part: f64| (objects > 0).then_some(100.0 * part);
    let motp_m = (clear.matches > 0).then(|| clear.distance_sum_m / clear.matches as f64);
    ThresholdScores {
        threshold,
        matches: clear.matches,
        false_alarms: clear.false_alarms,
        misses: clear.misses,
        id_switches: clear.id_switches,
        fragments: clear.fragments,
        moda_pct: percent(objects as f64 - wrong, objects),
        modp_pct: motp_m.map(|mean| 100.0 * (1.0 - mean / MATCH_DISTANCE_M)),
        mota_pct: percent(objects as f64 - wrong - clear.id_switches as f64, objects),
        motp_m,
        idf1_pct: share(identity.f1()),
        hota_pct: share(hota.hota),
        deta_pct: share(hota.deta),
        assa_pct: share(hota.assa),
        loca_pct: share(hota.loca),
    }
}

/// The first names of a set, in quotes.
fn listed(labels: &BTreeSet<&Label>) -> String {
    const SHOWN: usize = 5;
    let names = labels
        .iter()
        .take(SHOWN)
        .map(|label| format!("{label:?}"))
        .collect::<Vec<_>>()
        .join(", ");
    match labels.len().saturating_sub(SHOWN) {
        0 => names,
        more => format!("{names} and {more} more"),
    }
}

/// Evaluates the maps of a replay; see the module.
///
/// A map states the positions of objects at its `fused_at_us`. A frame is evaluated by the nearest
/// map in time (the later one if two are equally near), if it is within three quarters of a frame
/// period, where the period is the median of the truth. True objects are interpolated to the time
/// of the map, on a straight line between the two frames around it. Without a map, all objects of a
/// frame count as missed.
#[derive(Debug, Clone)]
pub struct TrackEvaluation {
    truth: TrackTruth,
    reach_us: i64,
    /// By frame, the nearest map so far.
    maps: Vec<Option<(Timestamp, Vec<ReportedObject>)>>,
    ids: HashMap<Uuid, u32>,
}

impl TrackEvaluation {
    /// An evaluation without any input yet.
    pub fn new(truth: TrackTruth) -> Self {
        let reach_us = (REACH * truth.period_us() as f64) as i64;
        Self {
            maps: vec![None; truth.frames().len()],
            truth,
            reach_us,
            ids: HashMap::new(),
        }
    }

    /// Processes the next map.
    pub fn map(&mut self, map: &GlobalMap) {
        let ids = &mut self.ids;
        let said: Vec<ReportedObject> = map
            .objects
            .iter()
            .map(|object| ReportedObject::of(object, ids))
            .collect();
        self.add_objects(map.fused_at_us, &said);
    }

    /// Adds objects reported at a time by any other program.
    pub fn add_objects(&mut self, at: Timestamp, said: &[ReportedObject]) {
        let frames = self.truth.frames();
        let first = frames.partition_point(|frame| at.micros_from(frame.at) > self.reach_us);
        let near = frames[first..]
            .iter()
            .take_while(|frame| frame.at.micros_from(at) <= self.reach_us);
        for (frame, nearest) in near.zip(&mut self.maps[first..]) {
            let distance = |time: Timestamp| frame.at.micros_from(time).abs();
            if nearest
                .as_ref()
                .is_none_or(|(other, _)| distance(*other) >= distance(at))
            {
                *nearest = Some((at, said.to_owned()));
            }
        }
    }

    /// Returns the classes of the reported objects and of the truth if both sets are non-empty and
    /// disjoint.
    pub fn labels_without_match(&self) -> Option<(String, String)> {
        let said: BTreeSet<&Label> = self
            .maps
            .iter()
            .flatten()
            .flat_map(|(_, said)| said)
            .map(|object| &object.label)
            .collect();
        let frames = self.truth.frames().iter();
        let truth: BTreeSet<&Label> = frames
            .flat_map(|frame| &frame.objects)
            .map(|object| &object.label)
            .collect();
        let are_apart = !said.is_empty() && !truth.is_empty() && said.is_disjoint(&truth);
        are_apart.then(|| (listed(&said), listed(&truth)))
    }

    /// Computes the figures from all frames.
    pub fn result(self) -> TrackScores {
        let with_map = self.maps.iter().flatten().count() as u64;
        let frames: Vec<ScoredFrame> = self
            .maps
            .into_iter()
            .enumerate()
            .map(|(number, map)| match map {
                Some((at, said)) => ScoredFrame {
                    truth: self.truth.at(number, at),
                    said,
                },
                None => ScoredFrame {
                    truth: self.truth.frames()[number].objects.clone(),
                    said: Vec::new(),
                },
            })
            .collect();
        let mut scores = TrackScores {
            frames_with_map: with_map,
            ..score(&frames)
        };
        if !self.truth.has_identities() {
            for at in [&mut scores.at_best_f1, &mut scores.at_default] {
                *at = ThresholdScores {
                    id_switches: 0,
                    fragments: 0,
                    mota_pct: None,
                    idf1_pct: None,
                    ..*at
                };
                at.hota_pct = None;
                at.deta_pct = None;
                at.assa_pct = None;
                at.loca_pct = None;
            }
        }
        scores
    }

    /// Adds the contents of a benchmark's files, frame by frame.
    pub fn sequences(&mut self, sequences: &[Sequence], frame_rate_hz: f64) {
        let times: Vec<Timestamp> = self.truth.frames().iter().map(|frame| frame.at).collect();
        let mut said: BTreeMap<Timestamp, Vec<ReportedObject>> =
            times.into_iter().map(|at| (at, Vec::new())).collect();
        let mut ids: HashMap<(usize, i64), u32> = HashMap::new();
        // Detections have no identity, so every detection gets a new one.
        let mut next = 0;
        for (number, sequence) in sequences.iter().enumerate() {
            for (frame, objects) in &sequence.frames {
                let objects = objects.iter().map(|object| {
                    next += 1;
                    ReportedObject {
                        id: object
                            .id
                            .map_or(next, |id| *ids.entry((number, id)).or_insert(next)),
                        label: object.perceived.label.clone(),
                        score: object.perceived.confidence,
                        existence: None,
                        position: Point2::new(object.perceived.x_m, object.perceived.y_m),
                    }
                });
                said.insert(time_of(number, *frame, frame_rate_hz), objects.collect());
            }
        }
        for (at, objects) in &said {
            self.add_objects(*at, objects);
        }
    }
}
