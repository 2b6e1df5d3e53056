//! The evidence that one vehicle has gathered, place by place.

use nalgebra::Point2;
use smallvec::SmallVec;

use crate::geometry::Covariance;
use crate::names::Label;
use crate::pace::PaceConfig;
use crate::time::Timestamp;
use crate::wire::PerceivedObject;

/// Where a vehicle can look: the object or the vacancy sign of a landmark, in configuration order.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct Place(u32);

impl Place {
    pub(super) fn object(landmark: usize) -> Self {
        Self(2 * landmark as u32)
    }

    pub(super) fn vacancy_sign(landmark: usize) -> Self {
        Self(2 * landmark as u32 + 1)
    }

    pub(super) fn index(self) -> usize {
        self.0 as usize
    }
}

/// What one vehicle knows.
#[derive(Debug, Clone, Default)]
pub(super) struct Vehicle {
    last_capture: Option<Timestamp>,
    /// Ascending by place.
    looks: Vec<Look>,
}

/// One vehicle's view of one place.
#[derive(Debug, Clone)]
pub(super) struct Look {
    pub(super) place: Place,
    pub(super) last_look: Timestamp,
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
        let known = self.looks.len();
        let mut at = 0;
        for sighting in sightings {
            while at < known && self.looks[at].place < sighting.place {
                at += 1;
            }
            let newest = self.looks.len().wrapping_sub(1);
            let index = if at < known && self.looks[at].place == sighting.place {
                at
            } else if newest >= known && self.looks.last().is_some_and(|look| look.place == sighting.place) {
                newest
            } else {
                self.looks.push(Look::new(sighting.place));
                self.looks.len() - 1
            };
            self.looks[index].update(sighting.found, captured_at, worth, config);
        }
        if self.looks.len() > known {
            self.looks.sort_by_key(|look| look.place);
        }
    }

    /// Drops what was last looked at before `limit`; the time of the oldest look that is left, `None` when none is.
    pub(super) fn forget_before(&mut self, limit: Timestamp) -> Option<Timestamp> {
        let mut oldest = None;
        self.looks.retain(|look| {
            let kept = look.last_look >= limit;
            if kept && oldest.is_none_or(|oldest| look.last_look < oldest) {
                oldest = Some(look.last_look);
            }
            kept
        });
        oldest
    }

    pub(super) fn looks(&self) -> &[Look] {
        &self.looks
    }
}

impl Look {
    fn new(place: Place) -> Self {
        Self { place, last_look: Timestamp(0), anything: 0.0, labels: SmallVec::new(), position: None }
    }

    fn update(&mut self, found: Option<&PerceivedObject>, captured_at: Timestamp, worth: Worth, config: &PaceConfig) {
        if captured_at.since(self.last_look) > config.max_age() {
            self.anything = 0.0;
            self.labels.clear();
        }
        self.last_look = captured_at;
        match found {
            Some(object) => self.hit(object, worth, config),
            None => self.miss(worth, config),
        }
        self.labels.retain(|evidence| evidence.nats > 0.0);
    }

    fn hit(&mut self, object: &PerceivedObject, worth: Worth, config: &PaceConfig) {
        let nats = worth.hit_nats * object.confidence;
        if !self.labels.iter().any(|evidence| evidence.label == object.label) {
            self.labels.push(LabelEvidence { label: object.label.clone(), nats: 0.0 });
        }
        for evidence in &mut self.labels {
            let signed = if evidence.label == object.label { nats } else { -nats };
            evidence.nats = (evidence.nats + signed).min(config.evidence_limit);
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
