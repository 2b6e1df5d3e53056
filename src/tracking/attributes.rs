//! Label, heading and size of an object: what each vehicle states, and the weighted sum or median.
//!
//! Each vehicle that has detected the object recently counts once, by its confidences, however often
//! it reports.

use std::cmp::Reverse;
use std::time::Duration;

use smallvec::SmallVec;

use crate::model::geometry::wrap_angle;
use crate::model::names::Label;
use crate::model::time::Timestamp;
use crate::wire::PerceivedObject;

/// Maximum number of labels; the most likely labels are kept.
const MAX_LABELS: usize = 8;

/// Share of earlier readings that remains after a reading.
pub(super) const KEPT: f64 = 0.95;

/// Share of a new value in a vehicle's heading: a car turns within a second.
const HEADING_SHARE: f64 = 0.5;

/// Share of a new value in a vehicle's size.
const SIZE_SHARE: f64 = 0.3;

/// Number of readings with which a vehicle has half of its weight.
const HALF_WEIGHT_READINGS: f64 = 2.0;

/// Maximum age of a vehicle's last statement: the object may have turned since, or the vehicle may
/// have detected it from afar.
const MAX_AGE: Duration = Duration::from_secs(2);

/// Maximum angle from the median heading of headings that count.
const NEAR_RAD: f64 = std::f64::consts::FRAC_PI_4;

/// Labels with their weights.
pub(super) type LabelWeights = SmallVec<[(Label, f64); 1]>;

/// Attributes of one object as one vehicle states them.
#[derive(Debug, Clone, Default)]
pub(super) struct StatedAttributes {
    /// Fading sums of the scores by label.
    labels: LabelWeights,
    /// Fading number of readings.
    readings: f64,
    /// Time of the last statement.
    stated_at: Timestamp,
    /// Smoothed direction, radians.
    heading_rad: Option<f64>,
    /// Smoothed length and width, metres.
    size_m: Option<[f64; 2]>,
}

impl StatedAttributes {
    /// True if the last statement is recent at `at`.
    pub(super) fn is_recent(&self, at: Timestamp) -> bool {
        at <= self.stated_at + MAX_AGE
    }

    /// Adds a detection at `at`; `heading_rad` is its corrected heading, `trust` the vehicle's weight,
    /// 0 to 1.
    pub(super) fn record(
        &mut self,
        object: &PerceivedObject,
        heading_rad: Option<f64>,
        trust: f64,
        at: Timestamp,
    ) {
        self.stated_at = self.stated_at.max(at);
        self.readings = KEPT * self.readings + 1.0;
        self.labels
            .iter_mut()
            .for_each(|(_, weight)| *weight *= KEPT);
        if object.scores.is_empty() {
            add(&mut self.labels, &object.label, trust * object.confidence);
        }
        for (label, score) in &object.scores {
            add(&mut self.labels, label, trust * score);
        }
        keep_most_likely(&mut self.labels);
        if let Some(new) = heading_rad {
            let old = self.heading_rad.unwrap_or(new);
            self.heading_rad = Some(wrap_angle(old + HEADING_SHARE * wrap_angle(new - old)));
        }
        if let Some(new) = object.size_m {
            let old = self.size_m.unwrap_or(new);
            self.size_m = Some([0, 1].map(|side| old[side] + SIZE_SHARE * (new[side] - old[side])));
        }
    }
}

/// Attributes of one object by the statements of several vehicles.
pub(super) struct CombinedAttributes {
    /// Sum of the vehicles' mean scores by label. A vehicle with few readings has less weight.
    pub(super) labels: LabelWeights,
    pub(super) heading_rad: Option<f64>,
    pub(super) size_m: Option<[f64; 2]>,
}

impl CombinedAttributes {
    pub(super) fn of<'a>(stated: impl Iterator<Item = &'a StatedAttributes>) -> Self {
        let mut labels = LabelWeights::new();
        let mut headings = Headings::new();
        let mut sizes: SmallVec<[[f64; 2]; 8]> = SmallVec::new();
        for attributes in stated {
            let readings = attributes.readings + HALF_WEIGHT_READINGS;
            for (label, weight) in &attributes.labels {
                add(&mut labels, label, weight / readings);
            }
            if let Some(heading_rad) = attributes.heading_rad {
                headings.push((attributes.stated_at, heading_rad));
            }
            if let Some(size_m) = attributes.size_m {
                sizes.push(size_m);
            }
        }
        Self {
            labels,
            heading_rad: mean_heading_rad(headings),
            size_m: median_size_m(&sizes),
        }
    }
}

/// Headings and the times at which they were stated.
type Headings = SmallVec<[(Timestamp, f64); 8]>;

/// Mean of the stated headings that are near their median on the circle, the heading with the smallest
/// sum of angles to the others; of several, the latest.
fn mean_heading_rad(mut headings: Headings) -> Option<f64> {
    headings.sort_by_key(|(stated_at, _)| Reverse(*stated_at));
    let distance = |heading: f64| -> f64 {
        let others = headings.iter();
        others
            .map(|(_, other)| wrap_angle(other - heading).abs())
            .sum()
    };
    let (_, median) = headings
        .iter()
        .map(|(_, heading)| (distance(*heading), *heading))
        .min_by(|a, b| a.0.total_cmp(&b.0))?;
    let angles: SmallVec<[f64; 8]> = headings
        .iter()
        .map(|(_, heading)| wrap_angle(heading - median))
        .filter(|angle| angle.abs() <= NEAR_RAD)
        .collect();
    let mean = angles.iter().sum::<f64>() / angles.len() as f64;
    Some(wrap_angle(median + mean))
}

/// Median of the stated lengths and of the stated widths; of two, the smaller one.
fn median_size_m(sizes: &[[f64; 2]]) -> Option<[f64; 2]> {
    let middle = sizes.len().checked_sub(1)? / 2;
    Some([0, 1].map(|side| {
        let mut values: SmallVec<[f64; 8]> = sizes.iter().map(|size| size[side]).collect();
        values.sort_unstable_by(f64::total_cmp);
        values[middle]
    }))
}

/// Adds a weight to a label.
pub(super) fn add(labels: &mut LabelWeights, label: &Label, weight: f64) {
    match labels.iter_mut().find(|(known, _)| known == label) {
        Some((_, sum)) => *sum += weight,
        None => labels.push((label.clone(), weight)),
    }
}

/// Removes all but the most likely labels.
pub(super) fn keep_most_likely(labels: &mut LabelWeights) {
    if labels.len() > MAX_LABELS {
        labels.sort_by(|a, b| b.1.total_cmp(&a.1));
        labels.truncate(MAX_LABELS);
    }
}
