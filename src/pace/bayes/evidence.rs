//! The evidence that one vehicle has gathered, place by place.

use nalgebra::Point2;
use smallvec::SmallVec;

use crate::geometry::Covariance;
use crate::landmark::Candidate;
use crate::names::{Label, NodeName};
use crate::pace::PaceConfig;
use crate::pace::grouping::{Held, Place};
use crate::time::Timestamp;
use crate::wire::PerceivedObject;

/// A vehicle can look at the object and at the vacancy sign of a landmark, in configuration order.
impl Place {
    pub(super) fn of(candidate: &Candidate) -> Self {
        if candidate.is_vacancy_sign {
            Self::vacancy_sign(candidate.landmark)
        } else {
            Self::object(candidate.landmark)
        }
    }

    pub(super) fn object(landmark: usize) -> Self {
        Self(2 * landmark as u32)
    }

    pub(super) fn vacancy_sign(landmark: usize) -> Self {
        Self(2 * landmark as u32 + 1)
    }
}

/// What one vehicle knows.
#[derive(Debug, Clone, Default)]
pub(super) struct Vehicle {
    last_capture: Option<Timestamp>,
    /// When the look that is longest ago was.
    oldest_look: Option<Timestamp>,
    /// Ascending.
    places: Vec<Place>,
    /// One for each place.
    looks: Vec<Look>,
}

/// One vehicle's view of one place.
#[derive(Debug, Clone, Default)]
pub(super) struct Look {
    last_look: Timestamp,
    /// Log-odds that anything is there.
    pub(super) anything: f64,
    /// Log-odds of the labels that have any evidence left.
    pub(super) labels: SmallVec<[LabelEvidence; 1]>,
    /// Where the object was last.
    pub(super) position: Option<(Point2<f64>, Covariance)>,
}

/// Log-odds of one label.
#[derive(Debug, Clone)]
pub(super) struct LabelEvidence {
    pub(super) label: Label,
    pub(super) nats: f64,
}

/// A place that was looked at in one frame, and what was found there.
#[derive(Debug, Clone, Copy)]
pub(super) struct Sighting<'a> {
    pub(super) place: Place,
    pub(super) found: Option<&'a PerceivedObject>,
}

/// What a hit and a miss in one frame are worth.
#[derive(Debug, Clone, Copy)]
pub(super) struct Worth {
    pub(super) hit_nats: f64,
    pub(super) miss_nats: f64,
}

impl Worth {
    pub(super) fn new(config: &PaceConfig) -> Self {
        let (p_d, p_f) = (config.detection_probability, config.false_alarm_probability);
        Self { hit_nats: (p_d / p_f).ln(), miss_nats: ((1.0 - p_f) / (1.0 - p_d)).ln() }
    }
}

impl Vehicle {
    /// Takes one frame's sightings, ascending by place.
    pub(super) fn observe(
        &mut self,
        sightings: &[Sighting<'_>],
        captured_at: Timestamp,
        worth: Worth,
        config: &PaceConfig,
    ) {
        let elapsed_s = self.last_capture.map_or(f64::INFINITY, |last| captured_at.since(last).as_secs_f64());
        let independence =
            if elapsed_s < config.independent_after_s { elapsed_s / config.independent_after_s } else { 1.0 };
        let worth = Worth { hit_nats: worth.hit_nats * independence, miss_nats: worth.miss_nats * independence };
        self.last_capture = Some(captured_at);
        self.add_places(sightings);
        let outdated = captured_at - config.max_age();
        let mut at = 0;
        for sighting in sightings {
            while self.places[at] < sighting.place {
                at += 1;
            }
            let look = &mut self.looks[at];
            if look.last_look < outdated {
                *look = Look::default();
            }
            look.last_look = captured_at;
            look.update(sighting.found, worth, config);
        }
        self.oldest_look = self.looks.iter().map(|look| look.last_look).min();
    }

    /// Makes a look for every place that is sighted for the first time.
    fn add_places(&mut self, sightings: &[Sighting<'_>]) {
        let mut known = self.places.iter().peekable();
        let mut added: Vec<Place> = Vec::new();
        for Sighting { place, .. } in sightings {
            while known.next_if(|known| *known < place).is_some() {}
            if known.peek() != Some(&place) && added.last() != Some(place) {
                added.push(*place);
            }
        }
        if added.is_empty() {
            return;
        }
        let known = std::mem::take(&mut self.places).into_iter().zip(std::mem::take(&mut self.looks));
        let mut all: Vec<(Place, Look)> =
            known.chain(added.into_iter().map(|place| (place, Look::default()))).collect();
        all.sort_by_key(|(place, _)| *place);
        (self.places, self.looks) = all.into_iter().unzip();
    }

    /// Drops what was last looked at before `limit`; the time of the oldest look that is left, `None` when none is.
    pub(super) fn forget_before(&mut self, limit: Timestamp) -> Option<Timestamp> {
        if self.oldest_look.is_some_and(|oldest| oldest < limit) {
            let mut looks = self.looks.iter();
            self.places.retain(|_| looks.next().is_some_and(|look| look.last_look >= limit));
            self.looks.retain(|look| look.last_look >= limit);
            self.oldest_look = self.looks.iter().map(|look| look.last_look).min();
        }
        self.oldest_look
    }

    /// The vehicle's looks under its name.
    pub(super) fn held_by(&self, node: &NodeName) -> Held<'_, Look> {
        Held { node: node.clone(), places: &self.places, items: &self.looks }
    }
}

impl Look {
    fn update(&mut self, found: Option<&PerceivedObject>, worth: Worth, config: &PaceConfig) {
        match found {
            Some(object) => self.hit(object, worth, config),
            None => self.miss(worth, config),
        }
        self.labels.retain(|evidence| evidence.nats > 0.0);
    }

    fn hit(&mut self, object: &PerceivedObject, worth: Worth, config: &PaceConfig) {
        let nats = worth.hit_nats * object.confidence;
        let mut is_known = false;
        for evidence in &mut self.labels {
            let is_same = evidence.label == object.label;
            is_known |= is_same;
            evidence.nats = (evidence.nats + if is_same { nats } else { -nats }).min(config.evidence_limit);
        }
        if !is_known {
            self.labels.push(LabelEvidence { label: object.label.clone(), nats: nats.min(config.evidence_limit) });
        }
        self.anything = (self.anything + nats).min(config.evidence_limit);
        self.position = Some((Point2::new(object.x_m, object.y_m), config.covariance(object)));
    }

    fn miss(&mut self, worth: Worth, config: &PaceConfig) {
        for evidence in &mut self.labels {
            evidence.nats -= worth.miss_nats;
        }
        self.anything = (self.anything - worth.miss_nats).max(-config.absence_limit);
    }

    pub(super) fn nats_for(&self, label: &Label) -> f64 {
        self.labels.iter().find(|evidence| evidence.label == *label).map_or(0.0, |evidence| evidence.nats)
    }
}
