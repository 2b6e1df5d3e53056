//! PACE with evidence of presence and of absence.
//!
//! Each vehicle has the log-odds of each label at each landmark that it had in view recently, as in
//! an occupancy grid (Thrun, Burgard, Fox, "Probabilistic Robotics", 2005, chapter 9.2). Unlike
//! there, a cell has one value per label:
//!
//! - A frame that shows label l with confidence c adds c·ln(p_d/p_f) to l and subtracts as much
//!   from the other labels.
//! - A frame without a detection at a landmark in view subtracts ln((1−p_f)/(1−p_d)) from all
//!   labels. A landmark is in view if the report lists it as `seen` or, in a report without a list,
//!   if it lies in the stated field of view.
//! - One vehicle's evidence is bounded, so that a fast or stubborn vehicle does not outvote the
//!   others.
//!
//! A round adds the vehicles' log-odds: S(ρ,l) = Σ_v L_v(ρ,l), label = argmax S, confidence =
//! e^S(l) / (1 + Σ e^S). This is the posterior if the labels and the empty state exclude each other
//! and have equal priors. The position is the mean of the vehicles' last positions weighted by
//! their inverse covariances.
//!
//! The vacancy sign of a landmark has separate log-odds. A detected object takes precedence, because
//! a sign behind an object can still be seen from the side. A landmark counts as empty if vehicles had it
//! in view without a detection: it then gets the label of its vacancy sign, or null without a sign.

mod belief;
mod consensus;

use std::collections::BTreeMap;
use std::sync::Arc;

use nalgebra::Point2;
use smallvec::SmallVec;

use self::belief::{Belief, Increments, Observation, VehicleBelief};
use self::consensus::{LabelScores, NamedBelief, WeightedMean};
use super::assignment::{Pairing, one_to_one};
use super::grouping::{ByPlace, Grouping, Place, places_after};
use super::{PaceConfig, PaceRound};
use crate::model::geometry::Pose;
use crate::model::names::{Label, NodeName};
use crate::model::time::Timestamp;
use crate::perception::landmark::{Landmark, LandmarkCandidate, LandmarkIndex};
use crate::wire::{LandmarkState, ObjectReport, PerceivedObject};

/// The beliefs about one place; most places are in view of few vehicles.
type Beliefs<'a> = SmallVec<[NamedBelief<'a>; 16]>;

/// State of PACE with evidence of presence and of absence; the module describes the algorithm.
#[derive(Debug, Clone)]
pub struct BayesPace {
    config: PaceConfig,
    increments: Increments,
    landmarks: Arc<LandmarkIndex>,
    vehicles: BTreeMap<NodeName, VehicleBelief>,
    published: Vec<Option<Label>>,
    grouping: Grouping,
}

impl BayesPace {
    pub(super) fn new(config: PaceConfig, landmarks: Arc<LandmarkIndex>) -> Self {
        Self {
            increments: Increments::new(&config),
            config,
            published: vec![None; landmarks.landmarks().len()],
            landmarks,
            vehicles: BTreeMap::new(),
            grouping: Grouping::default(),
        }
    }

    /// The same evidence under other settings. Evidence and published labels follow their landmarks
    /// by id; evidence at removed landmarks is dropped.
    pub(super) fn configured(mut self, config: PaceConfig, landmarks: Arc<LandmarkIndex>) -> Self {
        let place_now = places_after(Arc::clone(&self.landmarks), Arc::clone(&landmarks), 2);
        self.vehicles
            .values_mut()
            .for_each(|vehicle| vehicle.move_places(&place_now));
        let published_of = |landmark: &Landmark| {
            self.published
                .get(self.landmarks.position_of(&landmark.id)?)?
                .clone()
        };
        let published = landmarks.landmarks().iter().map(published_of).collect();
        Self {
            increments: Increments::new(&config),
            config,
            published,
            landmarks,
            ..self
        }
    }

    /// Adds landmarks after the existing ones, without evidence.
    pub(super) fn add_landmarks(&mut self, added: Vec<Landmark>) {
        self.landmarks = Arc::new(self.landmarks.extended(added, self.config.gate_m));
        self.published
            .resize(self.landmarks.landmarks().len(), None);
    }

    /// The landmarks, and the gate between an object and a landmark.
    pub(super) fn places(&self) -> (&LandmarkIndex, f64) {
        (&self.landmarks, self.config.gate_m)
    }

    /// Counts one report: a hit or a miss at each landmark that the vehicle had in view.
    pub(super) fn observe(&mut self, report: &ObjectReport, captured_at: Timestamp) {
        let observations = self.observations(report);
        let vehicle = self.vehicles.entry(report.node.clone()).or_default();
        vehicle.observe(&observations, captured_at, self.increments, &self.config);
    }

    /// Closes a round: drops observations older than `max_age_s`, adds the vehicles' evidence at
    /// each landmark, and records the published label, which the next round replaces only with a
    /// lead of `switch_lead`.
    pub(super) fn close(&mut self, now: Timestamp) -> PaceRound {
        let limit = now - self.config.max_age();
        let mut oldest_capture = None;
        self.vehicles.retain(|_, vehicle| {
            let oldest = vehicle.drop_before(limit);
            oldest_capture = [oldest_capture, oldest].into_iter().flatten().min();
            oldest.is_some()
        });
        let mut grouping = std::mem::take(&mut self.grouping);
        let items: Vec<_> = self
            .vehicles
            .iter()
            .map(|(node, vehicle)| vehicle.items_of(node))
            .collect();
        let by_place = grouping.group(&items, 2 * self.landmarks.landmarks().len());
        let mut published = std::mem::take(&mut self.published);
        let mut landmarks = Vec::with_capacity(published.len());
        for (index, (landmark, published)) in self
            .landmarks
            .landmarks()
            .iter()
            .zip(&mut published)
            .enumerate()
        {
            let state = self.agree(landmark, published.as_ref(), index, &by_place);
            published.clone_from(&state.label);
            landmarks.push(state);
        }
        self.grouping = grouping;
        self.published = published;
        PaceRound {
            landmarks,
            oldest_capture,
        }
    }

    /// Every place that the vehicle had in view, ascending: places with a detection and places
    /// listed as `seen`.
    fn observations<'a>(&self, report: &'a ObjectReport) -> Vec<Observation<'a>> {
        if self.landmarks.landmarks().is_empty() {
            return Vec::new();
        }
        let mut observations = self.associate(&report.objects);
        let observation_of = |landmark| Observation {
            place: Place::object(landmark),
            found: None,
        };
        match &report.seen {
            Some(seen) => {
                let mut expected = 0;
                observations.extend(seen.iter().filter_map(|id| {
                    let landmark = self.landmarks.position_near(id, expected)?;
                    expected = landmark + 1;
                    Some(observation_of(landmark))
                }));
            }
            None => observations.extend(self.in_stated_view(report).map(observation_of)),
        }
        // A stable sort: a detection at a place comes before the entry in `seen`.
        observations.sort_by_key(|observation| observation.place);
        observations.dedup_by(|later, kept| later.place == kept.place && later.found.is_none());
        observations
    }

    /// The landmarks in the field of view that a report states, by their positions in the index.
    fn in_stated_view(&self, report: &ObjectReport) -> impl Iterator<Item = usize> {
        let stated = report.pose.zip(report.view);
        stated.into_iter().flat_map(|(pose, view)| {
            let pose = Pose::from(pose);
            self.landmarks
                .landmarks()
                .iter()
                .enumerate()
                .filter_map(move |(index, landmark)| {
                    let (range_m, bearing_rad) = pose.range_bearing(&landmark.position);
                    (range_m <= view.range_m && bearing_rad.abs() <= view.angle_rad / 2.0)
                        .then_some(index)
                })
        })
    }

    /// The objects at their nearest places, ascending by place. With `one_to_one`, conflicts are
    /// resolved so that objects don't share a place.
    fn associate<'a>(&self, objects: &'a [PerceivedObject]) -> Vec<Observation<'a>> {
        let gate = self.config.gate();
        let pairing = |object, candidate: LandmarkCandidate| Pairing {
            place: Place::of(&candidate),
            object,
            distance_squared: candidate.mahalanobis_squared,
        };
        let point = |object: &PerceivedObject| Point2::new(object.x_m, object.y_m);
        let wish = |object: &'a PerceivedObject| {
            let covariance = self.config.covariance(object);
            Some(pairing(
                object,
                self.landmarks
                    .best(&object.label, &point(object), &covariance, &gate)?,
            ))
        };
        let pairings = |object: &'a PerceivedObject| {
            let covariance = self.config.covariance(object);
            let candidates =
                self.landmarks
                    .candidates(&object.label, point(object), covariance, gate);
            candidates.map(move |candidate| pairing(object, candidate))
        };
        let mut wishes: Vec<_> = objects.iter().filter_map(wish).collect();
        wishes.sort_by(|a, b| {
            a.place
                .cmp(&b.place)
                .then(a.distance_squared.total_cmp(&b.distance_squared))
        });
        if self.config.one_to_one {
            wishes = one_to_one(wishes, pairings, self.config.gate_sigmas);
        }
        let mut observations = Vec::with_capacity(2 * wishes.len());
        observations.extend(wishes.into_iter().map(|pairing| Observation {
            place: pairing.place,
            found: Some(pairing.object),
        }));
        observations
    }

    /// The state of one landmark that the vehicles agree on.
    fn agree(
        &self,
        landmark: &Landmark,
        published: Option<&Label>,
        index: usize,
        by_place: &ByPlace<'_, Belief>,
    ) -> LandmarkState {
        let beliefs: Beliefs<'_> = by_place.at(Place::object(index)).collect();
        if let Some(state) = self.agree_on_label(landmark, published, &beliefs, &beliefs) {
            return state;
        }
        if landmark.vacancy.is_some() {
            let signs: Beliefs<'_> = by_place.at(Place::vacancy_sign(index)).collect();
            if let Some(state) = self.agree_on_label(landmark, published, &signs, &beliefs) {
                return state;
            }
        }
        self.without_label(landmark, &beliefs)
    }

    /// The label with the most evidence at one place, if there is any; `observers` had the landmark
    /// in view.
    fn agree_on_label(
        &self,
        landmark: &Landmark,
        published: Option<&Label>,
        beliefs: &[NamedBelief<'_>],
        observers: &[NamedBelief<'_>],
    ) -> Option<LandmarkState> {
        let winner = LabelScores::of(beliefs).winner(published, self.config.switch_lead)?;
        let mut contributors = Vec::with_capacity(beliefs.len());
        let mut mean = WeightedMean::default();
        for (node, belief) in beliefs
            .iter()
            .filter(|(_, belief)| belief.nats_for(winner.label) > 0.0)
        {
            contributors.push((*node).clone());
            if let Some((position, covariance)) = &belief.position {
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
            readings: Vec::new(),
        })
    }

    /// The state of a landmark that counts as empty or was not in view.
    fn without_label(&self, landmark: &Landmark, beliefs: &[NamedBelief<'_>]) -> LandmarkState {
        let absence: f64 = -beliefs
            .iter()
            .map(|(_, belief)| belief.anything)
            .sum::<f64>();
        let known_empty = absence >= self.config.empty_evidence;
        let vacancy = landmark.vacancy.as_ref().filter(|_| known_empty);
        let observers = if known_empty {
            names(beliefs)
        } else {
            Vec::new()
        };
        LandmarkState {
            id: landmark.id.clone(),
            label: vacancy.map(|sign| sign.label.clone()),
            confidence: vacancy.map_or(0.0, |_| logistic(absence)),
            x_m: landmark.position.x,
            y_m: landmark.position.y,
            contributors: if vacancy.is_some() {
                observers.clone()
            } else {
                Vec::new()
            },
            observers,
            readings: Vec::new(),
        }
    }
}

fn names(beliefs: &[NamedBelief<'_>]) -> Vec<NodeName> {
    beliefs.iter().map(|(node, _)| (*node).clone()).collect()
}

fn logistic(nats: f64) -> f64 {
    1.0 / (1.0 + (-nats).exp())
}
