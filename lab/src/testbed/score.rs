//! Accuracy of maps: the share of spots whose label is the truth.

use std::collections::BTreeMap;

use ecod::model::names::{LandmarkId, NodeName};
use ecod::wire::{GlobalMap, LandmarkState, Verdicts};
use serde::{Serialize, Serializer};

use crate::testbed::{Scene, Spot, Testbed};

/// Numbers of right and of evaluated spots, for all spots and for the occupied ones.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct SpotScore {
    right: u64,
    judged: u64,
    right_occupied: u64,
    judged_occupied: u64,
}

impl SpotScore {
    /// Evaluates every spot of a map; an undetermined spot counts as wrong.
    pub fn judge(&mut self, testbed: &Testbed, scene: &Scene, map: &GlobalMap) {
        for spot in &scene.spots {
            let state = map.landmarks.iter().find(|state| state.id == spot.id);
            self.count(
                spot,
                state.and_then(|state| is_right(testbed, spot, state)) == Some(true),
            );
        }
    }

    /// Evaluates every spot of a map in `paper` mode, where a location without reports has no label:
    /// that is right if the spot is free, whether or not a vehicle sees it.
    pub fn judge_paper(&mut self, testbed: &Testbed, scene: &Scene, map: &GlobalMap) {
        for spot in &scene.spots {
            let state = map.landmarks.iter().find(|state| state.id == spot.id);
            let label = state.and_then(|state| state.label.as_ref());
            let free = &testbed.placard.empty_text;
            self.count(
                spot,
                label.unwrap_or(free) == spot.truth.as_ref().unwrap_or(free),
            );
        }
    }

    /// Evaluates every spot by its verdict. A spot without a label counts as wrong, because there
    /// were no votes for the placard of a free spot.
    pub fn judge_verdicts(&mut self, testbed: &Testbed, scene: &Scene, verdicts: &Verdicts) {
        for spot in &scene.spots {
            let verdict = verdicts
                .verdicts
                .iter()
                .find(|verdict| verdict.landmark == spot.id);
            let right = spot.truth.as_ref().unwrap_or(&testbed.placard.empty_text);
            self.count(
                spot,
                verdict.is_some_and(|verdict| verdict.label.as_ref() == Some(right)),
            );
        }
    }

    /// Share of right spots in percent; zero without evaluated spots.
    pub fn accuracy_pct(&self) -> f64 {
        percent(self.right, self.judged)
    }

    /// Share of right spots among the occupied ones in percent; `None` without occupied spots.
    pub fn occupied_accuracy_pct(&self) -> Option<f64> {
        (self.judged_occupied > 0).then(|| percent(self.right_occupied, self.judged_occupied))
    }

    fn count(&mut self, spot: &Spot, right: bool) {
        self.judged += 1;
        self.right += u64::from(right);
        if spot.truth.is_some() {
            self.judged_occupied += 1;
            self.right_occupied += u64::from(right);
        }
    }
}

/// True if a map's label of a spot is right; `None` if the map has no answer. A plate must be read
/// exactly. A free spot must be reported as empty: by its placard's text or, without a placard, by
/// vehicles that had it in view without a detection.
pub(super) fn is_right(testbed: &Testbed, spot: &Spot, state: &LandmarkState) -> Option<bool> {
    match (&state.label, &spot.truth) {
        (Some(label), Some(truth)) => Some(label == truth),
        (Some(label), None) => Some(*label == testbed.placard.empty_text),
        (None, _) if state.observers.is_empty() => None,
        (None, Some(_)) => Some(false),
        (None, None) => spot.empty.is_none().then_some(true),
    }
}

/// Result of one scene.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct SceneResult {
    /// Name of the scene.
    pub name: String,
    /// Number of fused maps that were evaluated.
    pub verdicts: u64,
    /// Right spots in percent, fused.
    pub pace_accuracy_pct: f64,
    /// Right spots in percent by PACE in `paper` mode; null if it does not run.
    pub paper_accuracy_pct: Option<f64>,
    /// Right spots in percent by VOTE alone; null if VOTE does not run.
    pub vote_accuracy_pct: Option<f64>,
    /// Right spots in percent as PACE and VOTE agree on them; null if one of them does not run.
    pub answer_accuracy_pct: Option<f64>,
    /// Right spots among the occupied ones in percent, fused; written as 100 without occupied
    /// spots.
    #[serde(serialize_with = "hundred_if_none")]
    pub occupied_accuracy_pct: Option<f64>,
    /// Right spots in percent of every vehicle alone.
    pub single_cav_accuracy_pct: BTreeMap<NodeName, f64>,
    /// Right spots in percent of always guessing that a spot is empty.
    pub always_empty_pct: f64,
    /// Mean fused accuracy recorded on the physical testbed in percent; null when there is no
    /// recording.
    pub recorded_pace_accuracy_pct: Option<f64>,
    /// Mean accuracy of every vehicle alone recorded on the physical testbed in percent.
    pub recorded_single_cav_accuracy_pct: BTreeMap<NodeName, f64>,
    /// Spots whose placard no camera could see, by the geometry of the scene.
    pub unseen_spots: Vec<LandmarkId>,
}

impl SceneResult {
    /// The result of a scene from the scores of the fused maps and of every vehicle alone.
    pub fn new(
        testbed: &Testbed,
        scene: &Scene,
        verdicts: u64,
        fused: &SpotScore,
        single: &BTreeMap<NodeName, SpotScore>,
    ) -> Self {
        let empty = scene
            .spots
            .iter()
            .filter(|spot| spot.truth.is_none())
            .count() as u64;
        let unseen = |spot: &&Spot| {
            !scene
                .cavs
                .iter()
                .any(|cav| testbed.sighting(scene, cav, spot).is_some())
        };
        let recorded_single = scene.cavs.iter().filter_map(|cav| {
            let runs = scene
                .recorded
                .iter()
                .flat_map(|run| &run.single_cav_accuracy_pct);
            Some((
                cav.name.clone(),
                mean(
                    runs.filter(|(name, _)| *name == cav.name)
                        .map(|(_, pct)| *pct),
                )?,
            ))
        });
        Self {
            name: scene.name.clone(),
            verdicts,
            pace_accuracy_pct: fused.accuracy_pct(),
            paper_accuracy_pct: None,
            vote_accuracy_pct: None,
            answer_accuracy_pct: None,
            occupied_accuracy_pct: fused.occupied_accuracy_pct(),
            single_cav_accuracy_pct: single
                .iter()
                .map(|(name, s)| (name.clone(), s.accuracy_pct()))
                .collect(),
            always_empty_pct: percent(empty, scene.spots.len() as u64),
            recorded_pace_accuracy_pct: mean(
                scene
                    .recorded
                    .iter()
                    .filter_map(|run| run.pace_accuracy_pct),
            ),
            recorded_single_cav_accuracy_pct: recorded_single.collect(),
            unseen_spots: scene
                .spots
                .iter()
                .filter(unseen)
                .map(|spot| spot.id.clone())
                .collect(),
        }
    }
}

fn hundred_if_none<S: Serializer>(pct: &Option<f64>, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.serialize_f64(pct.unwrap_or(100.0))
}

fn percent(part: u64, whole: u64) -> f64 {
    if whole == 0 {
        0.0
    } else {
        100.0 * part as f64 / whole as f64
    }
}

fn mean(values: impl Iterator<Item = f64>) -> Option<f64> {
    let (sum, count) = values.fold((0.0, 0u32), |(sum, count), value| (sum + value, count + 1));
    (count > 0).then(|| sum / f64::from(count))
}
