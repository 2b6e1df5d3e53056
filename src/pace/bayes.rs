//! PACE with evidence of presence and of absence.
//!
//! Every vehicle keeps, for every landmark that it looked at lately, the log-odds of each label it read there, as in
//! an occupancy grid (Thrun, Burgard, Fox, "Probabilistic Robotics", 2005, chapter 9.2): a frame that shows label l
//! with confidence c adds c·ln(p_d/p_f) to l and takes as much from the others; a frame in which the landmark was in
//! view and nothing was found takes ln((1−p_f)/(1−p_d)) from all. One vehicle's evidence is bounded, so that a fast or
//! stubborn vehicle does not outvote the others.
//!
//! A round adds the vehicles' log-odds: S(ρ,l) = Σ_v L_v(ρ,l), label = argmax S, confidence = e^S(l) / (1 + Σ e^S), the
//! posterior when the labels and "nothing" exclude each other and are equally likely at first. The position is the
//! mean of the vehicles' last positions weighted by their inverse covariances.
//!
//! A landmark's vacancy sign is read where it stands and agreed on in the same way; any object outweighs it, because a
//! sign behind an object can still be seen from the side. A landmark in whose place vehicles looked and found nothing
//! is known to be empty: it takes the vacancy sign's label if it has a sign, and null otherwise.

mod evidence;
mod tally;

use std::collections::BTreeMap;
use std::sync::Arc;

use nalgebra::Point2;
use smallvec::SmallVec;

use self::evidence::{Look, Sighting, Vehicle, Worth};
use self::tally::{NamedLook, Tally, WeightedMean};
use super::assignment::{Pairing, one_to_one};
use super::grouping::{ByPlace, Grouping, Place};
use super::{PaceConfig, PaceRound};
use crate::landmark::{Candidate, Landmark, LandmarkIndex};
use crate::names::{Label, NodeName};
use crate::time::Timestamp;
use crate::wire::{LandmarkState, ObjectReport, PerceivedObject};

/// The looks at one place; most places are in few vehicles' view.
type Looks<'a> = SmallVec<[NamedLook<'a>; 16]>;

/// See the module.
#[derive(Debug, Clone)]
pub struct BayesPace {
    config: PaceConfig,
    worth: Worth,
    landmarks: Arc<LandmarkIndex>,
    vehicles: BTreeMap<NodeName, Vehicle>,
    published: Vec<Option<Label>>,
    grouping: Grouping,
}

impl BayesPace {
    pub(super) fn new(config: PaceConfig, landmarks: Arc<LandmarkIndex>) -> Self {
        Self {
            worth: Worth::new(&config),
            config,
            published: vec![None; landmarks.landmarks().len()],
            landmarks,
            vehicles: BTreeMap::new(),
            grouping: Grouping::default(),
        }
    }

    pub(super) fn add_landmarks(&mut self, added: Vec<Landmark>) {
        self.landmarks = Arc::new(self.landmarks.extended(added, self.config.gate_m));
        self.published.resize(self.landmarks.landmarks().len(), None);
    }

    /// The known locations, and how near an object must be to one.
    pub(super) fn places(&self) -> (&LandmarkIndex, f64) {
        (&self.landmarks, self.config.gate_m)
    }

    pub(super) fn observe(&mut self, report: &ObjectReport, captured_at: Timestamp) {
        let sightings = self.sightings(report);
        let vehicle = self.vehicles.entry(report.node.clone()).or_default();
        vehicle.observe(&sightings, captured_at, self.worth, &self.config);
    }

    pub(super) fn close(&mut self, now: Timestamp) -> PaceRound {
        let limit = now - self.config.max_age();
        let mut oldest_capture = None;
        self.vehicles.retain(|_, vehicle| {
            let oldest = vehicle.forget_before(limit);
            oldest_capture = [oldest_capture, oldest].into_iter().flatten().min();
            oldest.is_some()
        });
        let mut grouping = std::mem::take(&mut self.grouping);
        let held: Vec<_> = self.vehicles.iter().map(|(node, vehicle)| vehicle.held_by(node)).collect();
        let by_place = grouping.group(&held, 2 * self.landmarks.landmarks().len());
        let mut published = std::mem::take(&mut self.published);
        let mut landmarks = Vec::with_capacity(published.len());
        for (index, (landmark, published)) in self.landmarks.landmarks().iter().zip(&mut published).enumerate() {
            let state = self.agree(landmark, published.as_ref(), index, &by_place);
            published.clone_from(&state.label);
            landmarks.push(state);
        }
        self.grouping = grouping;
        self.published = published;
        PaceRound { landmarks, oldest_capture }
    }

    /// Every place that the vehicle looked at, ascending: where it found something and what it says it saw.
    fn sightings<'a>(&self, report: &'a ObjectReport) -> Vec<Sighting<'a>> {
        let mut sightings = self.associate(&report.objects);
        let mut expected = 0;
        sightings.extend(report.seen.iter().flatten().filter_map(|id| {
            let landmark = self.landmarks.position_near(id, expected)?;
            expected = landmark + 1;
            Some(Sighting { place: Place::object(landmark), found: None })
        }));
        // Stable: what was found at a place comes before the bare fact that it was in view.
        sightings.sort_by_key(|sighting| sighting.place);
        sightings.dedup_by(|later, kept| later.place == kept.place && later.found.is_none());
        sightings
    }

    /// The objects at their nearest places, with `one_to_one` settled so that they share none; ascending by place.
    fn associate<'a>(&self, objects: &'a [PerceivedObject]) -> Vec<Sighting<'a>> {
        let gate = self.config.gate();
        let pairing = |object, candidate: Candidate| Pairing {
            place: Place::of(&candidate),
            object,
            distance_squared: candidate.mahalanobis_squared,
        };
        let point = |object: &PerceivedObject| Point2::new(object.x_m, object.y_m);
        let wish = |object: &'a PerceivedObject| {
            let covariance = self.config.covariance(object);
            Some(pairing(object, self.landmarks.best(&object.label, &point(object), &covariance, &gate)?))
        };
        let pairings = |object: &'a PerceivedObject| {
            let covariance = self.config.covariance(object);
            let candidates = self.landmarks.candidates(&object.label, point(object), covariance, gate);
            candidates.map(move |candidate| pairing(object, candidate))
        };
        let mut wishes: Vec<_> = objects.iter().filter_map(wish).collect();
        wishes.sort_by(|a, b| a.place.cmp(&b.place).then(a.distance_squared.total_cmp(&b.distance_squared)));
        if self.config.one_to_one {
            wishes = one_to_one(wishes, pairings, self.config.gate_sigmas);
        }
        let mut sightings = Vec::with_capacity(2 * wishes.len());
        sightings
            .extend(wishes.into_iter().map(|pairing| Sighting { place: pairing.place, found: Some(pairing.object) }));
        sightings
    }

    /// What the vehicles agree on for one landmark.
    fn agree(
        &self,
        landmark: &Landmark,
        published: Option<&Label>,
        index: usize,
        by_place: &ByPlace<'_, Look>,
    ) -> LandmarkState {
        let looks: Looks<'_> = by_place.at(Place::object(index)).collect();
        if let Some(state) = self.agree_on_label(landmark, published, &looks, &looks) {
            return state;
        }
        if landmark.vacancy.is_some() {
            let signs: Looks<'_> = by_place.at(Place::vacancy_sign(index)).collect();
            if let Some(state) = self.agree_on_label(landmark, published, &signs, &looks) {
                return state;
            }
        }
        self.without_label(landmark, &looks)
    }

    /// The label that the looks at one place have the most evidence for, if they have any; `observers` looked at the
    /// landmark at all.
    fn agree_on_label(
        &self,
        landmark: &Landmark,
        published: Option<&Label>,
        looks: &[NamedLook<'_>],
        observers: &[NamedLook<'_>],
    ) -> Option<LandmarkState> {
        let winner = Tally::of(looks).winner(published, self.config.switch_lead)?;
        let mut contributors = Vec::with_capacity(looks.len());
        let mut mean = WeightedMean::default();
        for (node, look) in looks.iter().filter(|(_, look)| look.nats_for(winner.label) > 0.0) {
            contributors.push((*node).clone());
            if let Some((position, covariance)) = &look.position {
                mean.add(position, covariance, self.config.position_floor_m);
            }
        }
        let position = mean.position().unwrap_or(landmark.position);
        Some(LandmarkState {
            id: landmark.id.clone(),
            label: Some(winner.label.clone()),
            confidence: winner.posterior,
            x_m: position.x,
            y_m: position.y,
            contributors,
            observers: names(observers),
        })
    }

    /// Known to be empty or never looked at.
    fn without_label(&self, landmark: &Landmark, looks: &[NamedLook<'_>]) -> LandmarkState {
        let absence: f64 = -looks.iter().map(|(_, look)| look.anything).sum::<f64>();
        let known_empty = absence >= self.config.empty_evidence;
        let vacancy = landmark.vacancy.as_ref().filter(|_| known_empty);
        let observers = if known_empty { names(looks) } else { Vec::new() };
        LandmarkState {
            id: landmark.id.clone(),
            label: vacancy.map(|sign| sign.label.clone()),
            confidence: vacancy.map_or(0.0, |_| logistic(absence)),
            x_m: landmark.position.x,
            y_m: landmark.position.y,
            contributors: if vacancy.is_some() { observers.clone() } else { Vec::new() },
            observers,
        }
    }
}

fn names(looks: &[NamedLook<'_>]) -> Vec<NodeName> {
    looks.iter().map(|(node, _)| (*node).clone()).collect()
}

fn logistic(nats: f64) -> f64 {
    1.0 / (1.0 + (-nats).exp())
}
