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

use std::collections::BTreeMap;
use std::sync::Arc;

use nalgebra::{Matrix2, Point2, Vector2};

use super::{PaceConfig, PaceRound};
use crate::geometry::Covariance;
use crate::landmark::{Candidate, Landmark, LandmarkIndex};
use crate::names::{Label, NodeName};
use crate::time::Timestamp;
use crate::wire::{LandmarkState, ObjectReport, PerceivedObject};

/// See the module.
#[derive(Debug, Clone)]
pub struct BayesPace {
    config: PaceConfig,
    hit_nats: f64,
    miss_nats: f64,
    landmarks: Arc<LandmarkIndex>,
    vehicles: BTreeMap<NodeName, Vehicle>,
    published: Vec<Option<Label>>,
}

/// What one vehicle knows, one entry per (landmark, place) in ascending order.
#[derive(Debug, Clone, Default)]
struct Vehicle {
    last_capture: Option<Timestamp>,
    looks: Vec<Look>,
}

/// A landmark, and whether its vacancy sign or the object before it is meant.
type Place = (usize, bool);

/// One vehicle's view of one place.
#[derive(Debug, Clone)]
struct Look {
    place: Place,
    last_look: Timestamp,
    /// Log-odds that anything is there.
    anything: f64,
    labels: Vec<LabelEvidence>,
    position: Option<(Point2<f64>, Covariance)>,
}

#[derive(Debug, Clone)]
struct LabelEvidence {
    label: Label,
    nats: f64,
}

impl BayesPace {
    pub(super) fn new(config: PaceConfig, landmarks: Arc<LandmarkIndex>) -> Self {
        let (p_d, p_f) = (config.detection_probability, config.false_alarm_probability);
        Self {
            hit_nats: (p_d / p_f).ln(),
            miss_nats: ((1.0 - p_f) / (1.0 - p_d)).ln(),
            config,
            published: vec![None; landmarks.landmarks().len()],
            landmarks,
            vehicles: BTreeMap::new(),
        }
    }

    pub(super) fn observe(&mut self, report: &ObjectReport, captured_at: Timestamp) {
        let hits = self.associate(&report.objects);
        let looked_at = self.places_in_view(report, &hits);
        let vehicle = self.vehicles.entry(report.node.clone()).or_default();
        let independence = vehicle.last_capture.map_or(1.0, |last| {
            let elapsed = captured_at.since(last).as_secs_f64();
            if self.config.independent_after_s > 0.0 {
                (elapsed / self.config.independent_after_s).min(1.0)
            } else {
                1.0
            }
        });
        vehicle.last_capture = Some(captured_at);
        let update = Update {
            hit_nats: self.hit_nats * independence,
            miss_nats: self.miss_nats * independence,
            config: &self.config,
            captured_at,
        };
        vehicle.merge(&looked_at, &hits, &report.objects, &update);
    }

    pub(super) fn close(&mut self, now: Timestamp) -> PaceRound {
        let max_age = self.config.max_age();
        self.vehicles.retain(|_, vehicle| {
            vehicle.looks.retain(|look| now.since(look.last_look) <= max_age);
            !vehicle.looks.is_empty()
        });
        let mut looks: Vec<(Place, &NodeName, &Look)> = Vec::new();
        for (node, vehicle) in &self.vehicles {
            looks.extend(vehicle.looks.iter().map(|look| (look.place, node, look)));
        }
        looks.sort_by_key(|(place, _, _)| *place);

        let mut rest = looks.as_slice();
        let mut landmarks = Vec::with_capacity(self.landmarks.landmarks().len());
        for (index, landmark) in self.landmarks.landmarks().iter().enumerate() {
            let objects = take_place(&mut rest, (index, false));
            let signs = take_place(&mut rest, (index, true));
            let state = self.state(landmark, self.published[index].as_ref(), objects, signs);
            landmarks.push(state);
        }
        let oldest_capture = looks.iter().map(|(_, _, look)| look.last_look).min();
        self.published = landmarks.iter().map(|state| state.label.clone()).collect();
        PaceRound { landmarks, oldest_capture }
    }

    /// The best landmark of each object, by object; with `one_to_one` the nearest object keeps a contested place.
    fn associate(&self, objects: &[PerceivedObject]) -> Vec<(Place, usize)> {
        let gate = self.config.gate();
        let mut pairs: Vec<(Candidate, usize)> = objects
            .iter()
            .enumerate()
            .filter_map(|(object, perceived)| {
                let covariance = self.config.covariance(perceived);
                let point = Point2::new(perceived.x_m, perceived.y_m);
                self.landmarks.best(&perceived.label, &point, &covariance, &gate).map(|best| (best, object))
            })
            .collect();
        pairs.sort_by(|(a, i), (b, j)| {
            (a.landmark, a.is_vacancy_sign)
                .cmp(&(b.landmark, b.is_vacancy_sign))
                .then(a.mahalanobis_squared.total_cmp(&b.mahalanobis_squared))
                .then(i.cmp(j))
        });
        if self.config.one_to_one {
            pairs.dedup_by_key(|(candidate, _)| (candidate.landmark, candidate.is_vacancy_sign));
        }
        pairs.into_iter().map(|(best, object)| ((best.landmark, best.is_vacancy_sign), object)).collect()
    }

    /// Every place that the vehicle looked at, ascending: where it found something and what it says it saw.
    fn places_in_view(&self, report: &ObjectReport, hits: &[(Place, usize)]) -> Vec<Place> {
        let seen = report.seen.iter().flatten().filter_map(|id| self.landmarks.position_of(id));
        let mut places: Vec<Place> = seen.map(|landmark| (landmark, false)).collect();
        places.extend(hits.iter().map(|(place, _)| *place));
        places.sort_unstable();
        places.dedup();
        places
    }

    fn state(
        &self,
        landmark: &Landmark,
        published: Option<&Label>,
        objects: &[(Place, &NodeName, &Look)],
        signs: &[(Place, &NodeName, &Look)],
    ) -> LandmarkState {
        let observers = || objects.iter().map(|(_, node, _)| (*node).clone()).collect();
        for looks in [objects, signs] {
            if let Some(winner) = Tally::of(looks).winner(published, self.config.switch_lead) {
                let contributes = |look: &Look| look.nats_for(winner.label) > 0.0;
                let contributions = looks.iter().filter(|(_, _, look)| contributes(look));
                let positions = contributions.clone().filter_map(|(_, _, look)| look.position);
                let position = weighted_mean(positions, self.config.position_floor_m).unwrap_or(landmark.position);
                return LandmarkState {
                    id: landmark.id.clone(),
                    label: Some(winner.label.clone()),
                    confidence: winner.posterior,
                    x_m: position.x,
                    y_m: position.y,
                    contributors: contributions.map(|(_, node, _)| (*node).clone()).collect(),
                    observers: observers(),
                };
            }
        }
        let absence: f64 = -objects.iter().map(|(_, _, look)| look.anything).sum::<f64>();
        let known_empty = absence >= self.config.empty_evidence;
        let vacancy = landmark.vacancy.as_ref().filter(|_| known_empty);
        LandmarkState {
            id: landmark.id.clone(),
            label: vacancy.map(|sign| sign.label.clone()),
            confidence: vacancy.map_or(0.0, |_| logistic(absence)),
            x_m: landmark.position.x,
            y_m: landmark.position.y,
            contributors: if vacancy.is_some() { observers() } else { Vec::new() },
            observers: if known_empty { observers() } else { Vec::new() },
        }
    }
}

/// How one report changes a vehicle's evidence.
struct Update<'a> {
    config: &'a PaceConfig,
    hit_nats: f64,
    miss_nats: f64,
    captured_at: Timestamp,
}

impl Vehicle {
    /// Goes through the known looks and the new ones together; both are in ascending order of place.
    fn merge(
        &mut self,
        looked_at: &[Place],
        hits: &[(Place, usize)],
        objects: &[PerceivedObject],
        update: &Update<'_>,
    ) {
        let max_age = update.config.max_age();
        let mut known = std::mem::take(&mut self.looks).into_iter().peekable();
        let mut hits = hits.iter().peekable();
        for &place in looked_at {
            while let Some(look) = known.next_if(|look| look.place < place) {
                self.looks.push(look);
            }
            let fresh = |look: &Look| update.captured_at.since(look.last_look) <= max_age;
            let mut look = known.next_if(|look| look.place == place).filter(fresh).unwrap_or_else(|| Look::new(place));
            look.last_look = update.captured_at;
            if hits.peek().is_none_or(|(hit, _)| *hit != place) {
                look.miss(update);
            }
            while let Some((_, object)) = hits.next_if(|(hit, _)| *hit == place) {
                let object = &objects[*object];
                look.hit(object, update.config.covariance(object), update);
            }
            self.looks.push(look);
        }
        self.looks.extend(known);
    }
}

impl Look {
    fn new(place: Place) -> Self {
        Self { place, last_look: Timestamp(0), anything: 0.0, labels: Vec::new(), position: None }
    }

    fn hit(&mut self, object: &PerceivedObject, covariance: Covariance, update: &Update<'_>) {
        let nats = update.hit_nats * object.confidence;
        if !self.labels.iter().any(|evidence| evidence.label == object.label) {
            self.labels.push(LabelEvidence { label: object.label.clone(), nats: 0.0 });
        }
        for evidence in &mut self.labels {
            let signed = if evidence.label == object.label { nats } else { -nats };
            evidence.nats = (evidence.nats + signed).clamp(-update.config.evidence_limit, update.config.evidence_limit);
        }
        self.labels.retain(|evidence| evidence.nats > 0.0);
        self.anything = (self.anything + nats).min(update.config.evidence_limit);
        self.position = Some((Point2::new(object.x_m, object.y_m), covariance));
    }

    fn miss(&mut self, update: &Update<'_>) {
        for evidence in &mut self.labels {
            evidence.nats -= update.miss_nats;
        }
        self.labels.retain(|evidence| evidence.nats > 0.0);
        self.anything = (self.anything - update.miss_nats).max(-update.config.absence_limit);
    }

    fn nats_for(&self, label: &Label) -> f64 {
        self.labels.iter().find(|evidence| evidence.label == *label).map_or(0.0, |evidence| evidence.nats)
    }
}

/// Log-odds of the labels at one place, summed over the vehicles.
struct Tally<'a> {
    labels: Vec<(&'a Label, f64)>,
}

struct Winner<'a> {
    label: &'a Label,
    posterior: f64,
}

impl<'a> Tally<'a> {
    fn of(looks: &[(Place, &'a NodeName, &'a Look)]) -> Self {
        let mut labels: Vec<(&'a Label, f64)> = Vec::new();
        for (_, _, look) in looks {
            for evidence in &look.labels {
                match labels.iter_mut().find(|(label, _)| **label == evidence.label) {
                    Some((_, nats)) => *nats += evidence.nats,
                    None => labels.push((&evidence.label, evidence.nats)),
                }
            }
        }
        let absence: f64 = looks.iter().map(|(_, _, look)| look.anything.min(0.0)).sum();
        for (_, nats) in &mut labels {
            *nats += absence;
        }
        Self { labels }
    }

    /// The label with the most evidence, or the published one as long as it is not behind by more than the lead.
    fn winner(&self, published: Option<&Label>, switch_lead: f64) -> Option<Winner<'a>> {
        let best = self.labels.iter().max_by(|a, b| a.1.total_cmp(&b.1).then_with(|| b.0.cmp(a.0)))?;
        let kept = self.labels.iter().find(|(label, nats)| Some(*label) == published && *nats > best.1 - switch_lead);
        let (label, nats) = kept.unwrap_or(best);
        let total: f64 = self.labels.iter().map(|(_, nats)| (nats - best.1).exp()).sum();
        let posterior = (nats - best.1).exp() / (total + (-best.1).exp());
        (*nats > 0.0).then_some(Winner { label, posterior })
    }
}

/// Takes the looks at `place` off the front.
fn take_place<'a, 'b>(
    rest: &mut &'a [(Place, &'b NodeName, &'b Look)],
    place: Place,
) -> &'a [(Place, &'b NodeName, &'b Look)] {
    let end = rest.iter().position(|(at, _, _)| *at != place).unwrap_or(rest.len());
    let (taken, remaining) = rest.split_at(end);
    *rest = remaining;
    taken
}

fn weighted_mean(positions: impl Iterator<Item = (Point2<f64>, Covariance)>, floor_m: f64) -> Option<Point2<f64>> {
    let floor = Covariance::isotropic(floor_m);
    let (mut information, mut sum) = (Matrix2::zeros(), Vector2::zeros());
    for (position, covariance) in positions {
        let weight = (covariance + floor).matrix().try_inverse()?;
        information += weight;
        sum += weight * position.coords;
    }
    information.try_inverse().map(|covariance| Point2::from(covariance * sum))
}

fn logistic(nats: f64) -> f64 {
    1.0 / (1.0 + (-nats).exp())
}
