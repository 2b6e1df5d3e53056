//! What a round tells of the vehicles' poses: detections of objects that others detected too.

use std::time::Duration;

use nalgebra::Vector2;

use super::Tracker;
use super::registration::Pair;
use crate::time::Timestamp;

/// Within how much time another vehicle's detection still tells where an object was.
const SIMULTANEOUS: Duration = Duration::from_millis(300);

/// A detection of an object that others may have detected too.
#[derive(Debug, Clone, Copy)]
pub(super) struct Sighting {
    /// Number of the object's track; good until tracks are joined.
    pub(super) track: u32,
    /// Position as the vehicle reported it.
    pub(super) reported: Vector2<f64>,
    /// Variance of the detection in each direction, m².
    pub(super) variance: f64,
}

/// What a vehicle detected at a time.
#[derive(Debug, Clone)]
pub(super) struct Sightings {
    /// The vehicle's number.
    pub(super) number: u32,
    /// When it was captured, by the estimate of that moment: `delay_s` before its stamp.
    pub(super) at: Timestamp,
    pub(super) delay_s: f64,
    pub(super) seen: Vec<Sighting>,
}

impl Tracker {
    /// Estimates the errors of the vehicles' poses, when all of a round is taken in: held against what was detected at
    /// the same time, wherever that is known, a lag of the tracks behind the objects is nobody's error.
    pub(super) fn align(&mut self, sightings: &[Sightings]) {
        let (spread, trusts) = (self.spread(), self.trusts());
        let mut pairs: Vec<Pair> = Vec::new();
        for Sightings { number, at, delay_s, seen } in sightings {
            pairs.clear();
            pairs.extend(seen.iter().filter_map(|seen| self.pair(*number, *at, seen, &trusts)));
            if let Some(source) = self.sources.get_mut(*number as usize).and_then(Option::as_mut) {
                source.alignment.observe(*at, *delay_s, &pairs, &spread);
            }
        }
    }

    /// The detection beside the mean of where the others saw the object, each as far as it is trusted.
    fn pair(&self, number: u32, at: Timestamp, seen: &Sighting, trusts: &[f64]) -> Option<Pair> {
        let track = &self.tracks[seen.track as usize];
        let velocity = track.motion.velocity;
        let (mut sum, mut weight, mut common) = (Vector2::zeros(), 0.0, 0.0);
        for other in track.seen_by(at - SIMULTANEOUS).filter(|witness| witness.source != number) {
            let theirs = self.sources.get(other.source as usize).and_then(Option::as_ref);
            let (Some(hit), Some(theirs)) = (other.last_hit, theirs) else { continue };
            let passed_us = at.micros_from(hit);
            let trust = trusts[other.source as usize];
            if passed_us.unsigned_abs() > SIMULTANEOUS.as_micros() as u64 || trust <= 0.0 {
                continue;
            }
            sum += (other.position + velocity * (passed_us as f64 * 1e-6)) * trust;
            common += theirs.alignment.variance_at(&seen.reported, &velocity) * trust;
            weight += trust;
        }
        (weight > 0.0).then(|| Pair {
            reported: seen.reported,
            reference: sum / weight,
            velocity,
            variance: seen.variance * (1.0 + 1.0 / weight),
            common: common / weight,
        })
    }
}
