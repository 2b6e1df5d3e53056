//! PACE as the paper prints it (Algorithm 2).
//!
//! For each location ρ, O_ρ holds every object of the vehicles' latest reports within δ of ρ. The
//! label has the largest sum of confidences, the confidence is Σc²/Σc over O_ρ, and the position is
//! the mean. An object within δ of two locations counts at both. Vacancy signs, covariances, `seen`
//! and the order of frames are not used.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use nalgebra::{Point2, Vector2};
use smallvec::SmallVec;

use super::grouping::{Grouping, Place, VehicleItems, places_after};
use super::{PaceConfig, PaceRound};
use crate::model::names::{Label, NodeName};
use crate::model::time::Timestamp;
use crate::perception::landmark::{Landmark, LandmarkIndex};
use crate::wire::{LandmarkState, ObjectReport};

/// State of PACE as the paper prints it; the module describes the algorithm.
#[derive(Debug, Clone)]
pub struct PaperPace {
    gate_m: f64,
    max_age: Duration,
    landmarks: Arc<LandmarkIndex>,
    vehicles: BTreeMap<NodeName, LatestDetections>,
    grouping: Grouping,
}

/// A vehicle's latest report: its objects near landmarks, once for each landmark.
#[derive(Debug, Clone, Default)]
struct LatestDetections {
    captured_at: Timestamp,
    places: Vec<Place>,
    objects: Vec<NearbyObject>,
}

/// The used fields of an object.
#[derive(Debug, Clone)]
struct NearbyObject {
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

    /// The same reports under other settings; objects at removed landmarks are dropped.
    pub(super) fn configured(mut self, config: &PaceConfig, landmarks: Arc<LandmarkIndex>) -> Self {
        let place_now = places_after(Arc::clone(&self.landmarks), Arc::clone(&landmarks), 1);
        for latest in self.vehicles.values_mut() {
            let known = std::mem::take(&mut latest.places)
                .into_iter()
                .zip(std::mem::take(&mut latest.objects));
            let (places, objects) = known
                .filter_map(|(place, object)| Some((place_now(place)?, object)))
                .unzip();
            latest.places = places;
            latest.objects = objects;
        }
        Self {
            gate_m: config.gate_m,
            max_age: config.max_age(),
            landmarks,
            ..self
        }
    }

    pub(super) fn add_landmarks(&mut self, added: Vec<Landmark>) {
        self.landmarks = Arc::new(self.landmarks.extended(added, self.gate_m));
    }

    /// The landmarks and the gate in metres.
    pub(super) fn places(&self) -> (&LandmarkIndex, f64) {
        (&self.landmarks, self.gate_m)
    }

    /// Replaces the vehicle's report: keeps each object once for every landmark within the gate.
    pub(super) fn observe(&mut self, report: &ObjectReport, captured_at: Timestamp) {
        let latest = self.vehicles.entry(report.node.clone()).or_default();
        latest.captured_at = captured_at;
        latest.places.clear();
        latest.objects.clear();
        for object in &report.objects {
            let position = Vector2::new(object.x_m, object.y_m);
            for landmark in self.landmarks.within(&Point2::from(position), self.gate_m) {
                latest.places.push(Place(landmark as u32));
                latest.objects.push(NearbyObject {
                    label: object.label.clone(),
                    confidence: object.confidence,
                    position,
                });
            }
        }
    }

    /// Closes a round from the latest report of each vehicle that is not older than `max_age_s`.
    pub(super) fn close(&mut self, now: Timestamp) -> PaceRound {
        self.vehicles
            .retain(|_, latest| now.since(latest.captured_at) <= self.max_age);
        let items: Vec<_> = self
            .vehicles
            .iter()
            .map(|(node, latest)| VehicleItems {
                node: node.clone(),
                places: &latest.places,
                items: &latest.objects,
            })
            .collect();
        let by_place = self
            .grouping
            .group(&items, self.landmarks.landmarks().len());
        let landmarks = self.landmarks.landmarks().iter().enumerate();
        PaceRound {
            landmarks: landmarks
                .map(|(index, landmark)| agree(landmark, by_place.at(Place(index as u32))))
                .collect(),
            oldest_capture: self
                .vehicles
                .values()
                .map(|latest| latest.captured_at)
                .min(),
        }
    }
}

/// The map's entry for a location ρ, given O_ρ by vehicle.
fn agree<'a>(
    landmark: &Landmark,
    near: impl ExactSizeIterator<Item = (&'a NodeName, &'a NearbyObject)> + Clone,
) -> LandmarkState {
    let count = near.len();
    let mut position_sum = Vector2::zeros();
    let mut confidence_sum = 0.0;
    let mut confidence_square_sum = 0.0;
    // A separate pass: its loads, which take most of the time, do not wait for each other.
    for (
        _,
        NearbyObject {
            confidence,
            position,
            ..
        },
    ) in near.clone()
    {
        position_sum += position;
        confidence_sum += confidence;
        confidence_square_sum += confidence * confidence;
    }
    let mut labels: SmallVec<[(&Label, f64); 4]> = SmallVec::new();
    let mut contributors: Vec<NodeName> = Vec::with_capacity(count);
    for (
        node,
        NearbyObject {
            label, confidence, ..
        },
    ) in near
    {
        match labels.iter_mut().find(|(known, _)| *known == label) {
            Some((_, sum)) => *sum += confidence,
            None => labels.push((label, *confidence)),
        }
        if contributors.last() != Some(node) {
            contributors.push(node.clone());
        }
    }
    let best = labels
        .iter()
        .max_by(|a, b| a.1.total_cmp(&b.1).then_with(|| b.0.cmp(a.0)));
    let position = if count > 0 {
        Point2::from(position_sum / count as f64)
    } else {
        landmark.position
    };
    LandmarkState {
        id: landmark.id.clone(),
        label: best.map(|(label, _)| (*label).clone()),
        confidence: if confidence_sum > 0.0 {
            confidence_square_sum / confidence_sum
        } else {
            0.0
        },
        x_m: position.x,
        y_m: position.y,
        contributors,
        observers: Vec::new(),
        readings: Vec::new(),
    }
}
