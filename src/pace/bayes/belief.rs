//! The belief of one vehicle: its evidence about each place, as log-odds in nats.

use nalgebra::Point2;
use smallvec::SmallVec;

use crate::model::geometry::Covariance;
use crate::model::names::{Label, NodeName};
use crate::model::time::Timestamp;
use crate::pace::PaceConfig;
use crate::pace::grouping::{Place, VehicleItems};
use crate::perception::landmark::LandmarkCandidate;
use crate::wire::PerceivedObject;

/// Maximum number of labels of a belief: the weakest is dropped. Consensus compares the labels of all
/// vehicles with each other, so a vehicle that states another label in every frame would otherwise
/// delay the cell's rounds.
const MAX_LABELS: usize = 8;

/// Places of `bayes` PACE: the object and the vacancy sign of each landmark, in configuration
/// order.
impl Place {
    pub(super) fn of(candidate: &LandmarkCandidate) -> Self {
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

/// All beliefs of one vehicle.
#[derive(Debug, Clone, Default)]
pub(super) struct VehicleBelief {
    last_capture: Option<Timestamp>,
    /// Time of the belief that was observed least recently.
    oldest_seen: Option<Timestamp>,
    /// Ascending.
    places: Vec<Place>,
    /// One for each place.
    beliefs: Vec<Belief>,
}

/// The belief of one vehicle about one place.
#[derive(Debug, Clone, Default)]
pub(super) struct Belief {
    last_seen: Timestamp,
    /// Log-odds that any object is there.
    pub(super) anything: f64,
    /// Log-odds of the labels that have evidence left.
    pub(super) labels: SmallVec<[LabelEvidence; 1]>,
    /// The last position of the object.
    pub(super) position: Option<(Point2<f64>, Covariance)>,
}

/// Log-odds of one label.
#[derive(Debug, Clone)]
pub(super) struct LabelEvidence {
    pub(super) label: Label,
    pub(super) nats: f64,
}

/// A place that was in view in one frame, and the object that was found there.
#[derive(Debug, Clone, Copy)]
pub(super) struct Observation<'a> {
    pub(super) place: Place,
    pub(super) found: Option<&'a PerceivedObject>,
}

/// Evidence of a hit and of a miss in one frame.
#[derive(Debug, Clone, Copy)]
pub(super) struct Increments {
    pub(super) hit_nats: f64,
    pub(super) miss_nats: f64,
}

impl Increments {
    pub(super) fn new(config: &PaceConfig) -> Self {
        let p_d = config.detection_probability;
        let p_f = config.false_alarm_probability;
        Self {
            hit_nats: (p_d / p_f).ln(),
            miss_nats: ((1.0 - p_f) / (1.0 - p_d)).ln(),
        }
    }
}

impl VehicleBelief {
    /// Keeps the beliefs about places that still exist, under their new numbers.
    pub(super) fn move_places(&mut self, place_now: impl Fn(Place) -> Option<Place>) {
        let known = std::mem::take(&mut self.places)
            .into_iter()
            .zip(std::mem::take(&mut self.beliefs));
        let mut kept: Vec<_> = known
            .filter_map(|(place, belief)| Some((place_now(place)?, belief)))
            .collect();
        kept.sort_by_key(|(place, _)| *place);
        let (places, beliefs) = kept.into_iter().unzip();
        self.places = places;
        self.beliefs = beliefs;
        self.oldest_seen = self.beliefs.iter().map(|belief| belief.last_seen).min();
    }

    /// Takes one frame's observations, ascending by place.
    pub(super) fn observe(
        &mut self,
        observations: &[Observation<'_>],
        captured_at: Timestamp,
        increments: Increments,
        config: &PaceConfig,
    ) {
        let elapsed_s = self
            .last_capture
            .map_or(f64::INFINITY, |last| captured_at.since(last).as_secs_f64());
        let independence = if elapsed_s < config.independent_after_s {
            elapsed_s / config.independent_after_s
        } else {
            1.0
        };
        let increments = Increments {
            hit_nats: increments.hit_nats * independence,
            miss_nats: increments.miss_nats * independence,
        };
        self.last_capture = Some(captured_at);
        self.add_places(observations);
        let outdated = captured_at - config.max_age();
        let mut at = 0;
        for observation in observations {
            while self.places[at] < observation.place {
                at += 1;
            }
            let belief = &mut self.beliefs[at];
            if belief.last_seen < outdated {
                *belief = Belief::default();
            }
            belief.last_seen = captured_at;
            belief.update(observation.found, increments, config);
        }
        self.oldest_seen = self.beliefs.iter().map(|belief| belief.last_seen).min();
    }

    /// Adds a belief for every place that is observed for the first time.
    fn add_places(&mut self, observations: &[Observation<'_>]) {
        let mut known = self.places.iter().peekable();
        let mut added: Vec<Place> = Vec::new();
        for Observation { place, .. } in observations {
            while known.next_if(|known| *known < place).is_some() {}
            if known.peek() != Some(&place) && added.last() != Some(place) {
                added.push(*place);
            }
        }
        if added.is_empty() {
            return;
        }
        let known = std::mem::take(&mut self.places)
            .into_iter()
            .zip(std::mem::take(&mut self.beliefs));
        let mut all: Vec<(Place, Belief)> = known
            .chain(added.into_iter().map(|place| (place, Belief::default())))
            .collect();
        all.sort_by_key(|(place, _)| *place);
        let (places, beliefs) = all.into_iter().unzip();
        self.places = places;
        self.beliefs = beliefs;
    }

    /// Drops beliefs that were last observed before `limit`; returns the time of the oldest one
    /// left, if any is.
    pub(super) fn drop_before(&mut self, limit: Timestamp) -> Option<Timestamp> {
        if self.oldest_seen.is_some_and(|oldest| oldest < limit) {
            let mut beliefs = self.beliefs.iter();
            self.places.retain(|_| {
                beliefs
                    .next()
                    .is_some_and(|belief| belief.last_seen >= limit)
            });
            self.beliefs.retain(|belief| belief.last_seen >= limit);
            self.oldest_seen = self.beliefs.iter().map(|belief| belief.last_seen).min();
        }
        self.oldest_seen
    }

    /// The vehicle's beliefs under its name.
    pub(super) fn items_of(&self, node: &NodeName) -> VehicleItems<'_, Belief> {
        VehicleItems {
            node: node.clone(),
            places: &self.places,
            items: &self.beliefs,
        }
    }
}

impl Belief {
    /// Counts one frame that had the place in view: a hit with an object, a miss without; labels
    /// whose evidence is used up, and the weakest beyond [`MAX_LABELS`], are dropped.
    fn update(
        &mut self,
        found: Option<&PerceivedObject>,
        increments: Increments,
        config: &PaceConfig,
    ) {
        match found {
            Some(object) => self.hit(object, increments, config),
            None => self.miss(increments, config),
        }
        self.labels.retain(|evidence| evidence.nats > 0.0);
        if self.labels.len() > MAX_LABELS {
            let weakest = self
                .labels
                .iter()
                .enumerate()
                .min_by(|(_, a), (_, b)| a.nats.total_cmp(&b.nats));
            if let Some((weakest, _)) = weakest {
                self.labels.remove(weakest);
            }
        }
    }

    /// Counts a detection: evidence for its label, against all other labels, and for the presence
    /// of any object, each within `evidence_limit`.
    fn hit(&mut self, object: &PerceivedObject, increments: Increments, config: &PaceConfig) {
        let nats = increments.hit_nats * object.confidence;
        let mut is_known = false;
        for evidence in &mut self.labels {
            let is_same = evidence.label == object.label;
            is_known |= is_same;
            evidence.nats =
                (evidence.nats + if is_same { nats } else { -nats }).min(config.evidence_limit);
        }
        if !is_known {
            self.labels.push(LabelEvidence {
                label: object.label.clone(),
                nats: nats.min(config.evidence_limit),
            });
        }
        self.anything = (self.anything + nats).min(config.evidence_limit);
        self.position = Some((
            Point2::new(object.x_m, object.y_m),
            config.covariance(object),
        ));
    }

    /// Counts a frame without a detection: evidence against every label, and against any object
    /// within `absence_limit`.
    fn miss(&mut self, increments: Increments, config: &PaceConfig) {
        for evidence in &mut self.labels {
            evidence.nats -= increments.miss_nats;
        }
        self.anything = (self.anything - increments.miss_nats).max(-config.absence_limit);
    }

    pub(super) fn nats_for(&self, label: &Label) -> f64 {
        self.labels
            .iter()
            .find(|evidence| evidence.label == *label)
            .map_or(0.0, |evidence| evidence.nats)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Each label has a third of the previous label's evidence, so that later labels do not use it
    /// up.
    #[test]
    fn ever_new_labels_are_bounded() {
        let config = PaceConfig::default();
        let increments = Increments::new(&config);
        let mut belief = Belief::default();
        for frame in 0..100 {
            let label = format!("label-{frame}");
            let object = PerceivedObject::new(&label, 3_f64.powi(-frame), 0.0, 0.0);
            belief.update(Some(&object), increments, &config);
        }
        assert_eq!(belief.labels.len(), MAX_LABELS);
        assert_eq!(belief.labels[0].label, "label-0");
    }
}
