//! PACE as the paper writes it (Algorithm 2).
//!
//! For each location ρ, O_ρ is every object of the vehicles' freshest reports within δ of ρ; the label has the largest
//! sum of confidences, the confidence is Σc²/Σc over O_ρ, the position the mean. An object within δ of two locations
//! counts at both. Vacancy signs, covariances, `seen` and the order of frames play no part.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use nalgebra::{Point2, Vector2};
use smallvec::SmallVec;

use super::grouping::{Grouping, Held, Place};
use super::{PaceConfig, PaceRound};
use crate::landmark::{Landmark, LandmarkIndex};
use crate::names::{Label, NodeName};
use crate::time::Timestamp;
use crate::wire::{LandmarkState, ObjectReport};

/// See the module.
#[derive(Debug, Clone)]
pub struct PaperPace {
    gate_m: f64,
    max_age: Duration,
    landmarks: Arc<LandmarkIndex>,
    vehicles: BTreeMap<NodeName, Freshest>,
    grouping: Grouping,
}

/// A vehicle's freshest report: its objects near any location, once for each.
#[derive(Debug, Clone, Default)]
struct Freshest {
    captured_at: Timestamp,
    places: Vec<Place>,
    objects: Vec<Near>,
}

/// What counts of an object.
#[derive(Debug, Clone)]
struct Near {
    label: Label,
    confidence: f64,
    position: Vector2<f64>,
}

impl PaperPace {
    pub(super) fn new(config: &PaceConfig, landmarks: Arc<LandmarkIndex>) -> Self {
        Self {
            gate_m: config.gate_m,
            max_age: config.max_age(),
            landmarks,
            vehicles: BTreeMap::new(),
            grouping: Grouping::default(),
        }
    }

    pub(super) fn add_landmarks(&mut self, added: Vec<Landmark>) {
        self.landmarks = Arc::new(self.landmarks.extended(added, self.gate_m));
    }

    /// The known locations, and how near an object must be to one.
    pub(super) fn places(&self) -> (&LandmarkIndex, f64) {
        (&self.landmarks, self.gate_m)
    }

    pub(super) fn observe(&mut self, report: &ObjectReport, captured_at: Timestamp) {
        let freshest = self.vehicles.entry(report.node.clone()).or_default();
        freshest.captured_at = captured_at;
        freshest.places.clear();
        freshest.objects.clear();
        for object in &report.objects {
            let position = Vector2::new(object.x_m, object.y_m);
            for landmark in self.landmarks.within(&Point2::from(position), self.gate_m) {
                freshest.places.push(Place(landmark as u32));
                freshest.objects.push(Near { label: object.label.clone(), confidence: object.confidence, position });
            }
        }
    }

    pub(super) fn close(&mut self, now: Timestamp) -> PaceRound {
        self.vehicles.retain(|_, freshest| now.since(freshest.captured_at) <= self.max_age);
        let held: Vec<_> = self
            .vehicles
            .iter()
            .map(|(node, freshest)| Held { node: node.clone(), places: &freshest.places, items: &freshest.objects })
            .collect();
        let by_place = self.grouping.group(&held, self.landmarks.landmarks().len());
        let landmarks = self.landmarks.landmarks().iter().enumerate();
        PaceRound {
            landmarks: landmarks.map(|(index, landmark)| agree(landmark, by_place.at(Place(index as u32)))).collect(),
            oldest_capture: self.vehicles.values().map(|freshest| freshest.captured_at).min(),
        }
    }
}

/// The map's entry for a location, given O_ρ by vehicle.
fn agree<'a>(
    landmark: &Landmark,
    near: impl ExactSizeIterator<Item = (&'a NodeName, &'a Near)> + Clone,
) -> LandmarkState {
    let count = near.len();
    let (mut position_sum, mut confidence_sum, mut confidence_square_sum) = (Vector2::zeros(), 0.0, 0.0);
    // A pass of its own: its loads do not wait for each other, and most of the time goes into them.
    for (_, Near { confidence, position, .. }) in near.clone() {
        position_sum += position;
        confidence_sum += confidence;
        confidence_square_sum += confidence * confidence;
    }
    let mut labels: SmallVec<[(&Label, f64); 4]> = SmallVec::new();
    let mut contributors: Vec<NodeName> = Vec::with_capacity(count);
    for (node, Near { label, confidence, .. }) in near {
        match labels.iter_mut().find(|(known, _)| *known == label) {
            Some((_, sum)) => *sum += confidence,
            None => labels.push((label, *confidence)),
        }
        if contributors.last() != Some(node) {
            contributors.push(node.clone());
        }
    }
    let best = labels.iter().max_by(|a, b| a.1.total_cmp(&b.1).then_with(|| b.0.cmp(a.0)));
    let position = if count > 0 { Point2::from(position_sum / count as f64) } else { landmark.position };
    LandmarkState {
        id: landmark.id.clone(),
        label: best.map(|(label, _)| (*label).clone()),
        confidence: if confidence_sum > 0.0 { confidence_square_sum / confidence_sum } else { 0.0 },
        x_m: position.x,
        y_m: position.y,
        contributors,
        observers: Vec::new(),
    }
}
