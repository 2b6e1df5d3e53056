//! PACE as the paper writes it (Algorithm 2).
//!
//! For each location ρ, O_ρ is every object of the vehicles' freshest reports within δ of ρ; the label has the largest
//! sum of confidences, the confidence is Σc²/Σc over O_ρ, the position the mean. An object within δ of two locations
//! counts at both. Vacancy signs, covariances, `seen` and the order of frames play no part.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use nalgebra::Point2;

use super::{PaceConfig, PaceRound};
use crate::landmark::{Landmark, LandmarkIndex};
use crate::names::{Label, NodeName};
use crate::time::Timestamp;
use crate::wire::{LandmarkState, ObjectReport, PerceivedObject};

/// See the module.
#[derive(Debug, Clone)]
pub struct PaperPace {
    gate_m: f64,
    max_age: Duration,
    landmarks: Arc<LandmarkIndex>,
    reports: BTreeMap<NodeName, (Timestamp, Vec<PerceivedObject>)>,
}

impl PaperPace {
    pub(super) fn new(config: &PaceConfig, landmarks: Arc<LandmarkIndex>) -> Self {
        Self { gate_m: config.gate_m, max_age: config.max_age(), landmarks, reports: BTreeMap::new() }
    }

    pub(super) fn add_landmarks(&mut self, added: Vec<Landmark>) {
        self.landmarks = Arc::new(self.landmarks.extended(added, self.gate_m));
    }

    pub(super) fn observe(&mut self, report: &ObjectReport, captured_at: Timestamp) {
        self.reports.insert(report.node.clone(), (captured_at, report.objects.clone()));
    }

    pub(super) fn close(&mut self, now: Timestamp) -> PaceRound {
        self.reports.retain(|_, (captured_at, _)| now.since(*captured_at) <= self.max_age);
        let mut near: Vec<Group<'_>> = vec![Group::default(); self.landmarks.landmarks().len()];
        for (node, (_, objects)) in &self.reports {
            for object in objects {
                for landmark in self.landmarks.within(&Point2::new(object.x_m, object.y_m), self.gate_m) {
                    near[landmark].add(node, object);
                }
            }
        }
        let landmarks = self.landmarks.landmarks().iter().zip(near);
        PaceRound {
            landmarks: landmarks.map(|(landmark, group)| group.state(landmark)).collect(),
            oldest_capture: self.reports.values().map(|(captured_at, _)| *captured_at).min(),
        }
    }
}

/// The objects near one location, O_ρ.
#[derive(Debug, Clone, Default)]
struct Group<'a> {
    count: f64,
    sum: Point2<f64>,
    confidence_sum: f64,
    confidence_square_sum: f64,
    labels: Vec<(&'a Label, f64)>,
    contributors: Vec<&'a NodeName>,
}

impl<'a> Group<'a> {
    fn add(&mut self, node: &'a NodeName, object: &'a PerceivedObject) {
        self.count += 1.0;
        self.sum += Point2::new(object.x_m, object.y_m).coords;
        self.confidence_sum += object.confidence;
        self.confidence_square_sum += object.confidence * object.confidence;
        match self.labels.iter_mut().find(|(label, _)| **label == object.label) {
            Some((_, sum)) => *sum += object.confidence,
            None => self.labels.push((&object.label, object.confidence)),
        }
        if self.contributors.last() != Some(&node) {
            self.contributors.push(node);
        }
    }

    fn state(self, landmark: &Landmark) -> LandmarkState {
        let best = self.labels.iter().max_by(|a, b| a.1.total_cmp(&b.1).then_with(|| b.0.cmp(a.0)));
        let position = if self.count > 0.0 { self.sum / self.count } else { landmark.position };
        LandmarkState {
            id: landmark.id.clone(),
            label: best.map(|(label, _)| (*label).clone()),
            confidence: if self.confidence_sum > 0.0 { self.confidence_square_sum / self.confidence_sum } else { 0.0 },
            x_m: position.x,
            y_m: position.y,
            contributors: self.contributors.into_iter().cloned().collect(),
            observers: Vec::new(),
        }
    }
}
