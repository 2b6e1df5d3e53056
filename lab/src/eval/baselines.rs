//! Baselines on the same reports: one vehicle alone, the union of all vehicles, and late fusion.
//!
//! Late fusion as in OPV2V and V2V4Real: the objects of all vehicles, with non-maximum suppression
//! by score, here by centre distance. Identities come from a tracker as simple as AB3DMOT's (Weng
//! et al., IROS 2020): a constant velocity and the nearest detection.

use std::collections::BTreeMap;
use std::time::Duration;

use ecod::model::names::{Label, NodeName};
use ecod::model::time::Timestamp;
use ecod::wire::ObjectReport;
use nalgebra::{Point2, Vector2};

use super::tracks::ReportedObject;

/// Age beyond which a vehicle's last report is not used.
const MAX_AGE: Duration = Duration::from_millis(300);
/// Distances within which the suppression merges two cars, and two other objects.
const SAME_CAR_M: f64 = 2.0;
const SAME_OTHER_M: f64 = 1.0;
/// The tracker's gate, the weight of a new velocity, and the time for which a lost object is kept.
const GATE_M: f64 = 3.0;
const GAIN: f64 = 0.3;
const PATIENCE: Duration = Duration::from_millis(500);

/// An object that was found, with its score.
#[derive(Debug, Clone)]
pub struct FoundObject {
    label: Label,
    score: f64,
    position: Point2<f64>,
}

/// All objects of one report, including the vehicle itself if its pose is stated.
pub fn found(report: &ObjectReport) -> Vec<FoundObject> {
    let objects = report.objects.iter().map(|object| FoundObject {
        label: object.label.clone(),
        score: object.confidence,
        position: Point2::new(object.x_m, object.y_m),
    });
    let own = report
        .pose
        .filter(|_| report.moving != Some(false))
        .map(|pose| FoundObject {
            label: Label::new_static("car"),
            score: 1.0,
            position: Point2::new(pose.x_m, pose.y_m),
        });
    objects.chain(own).collect()
}

/// The last reports of all vehicles.
#[derive(Debug, Default)]
pub struct LatestReports(BTreeMap<NodeName, (Timestamp, Vec<FoundObject>)>);

impl LatestReports {
    /// Stores a report, unless a later one is already stored.
    pub fn report(&mut self, report: &ObjectReport) {
        let last = self.0.entry(report.node.clone()).or_default();
        if report.captured_at_us > last.0 {
            *last = (report.captured_at_us, found(report));
        }
    }

    /// Objects that all vehicles found.
    pub fn union(&self, now: Timestamp) -> Vec<FoundObject> {
        let fresh = self
            .0
            .values()
            .filter(|(captured, _)| now.since(*captured) <= MAX_AGE);
        fresh.flat_map(|(_, found)| found.iter().cloned()).collect()
    }
}

/// Among objects with one label near each other, keeps the one with the highest score.
pub fn suppressed(mut found: Vec<FoundObject>) -> Vec<FoundObject> {
    found.sort_by(|a, b| b.score.total_cmp(&a.score));
    let mut kept: Vec<FoundObject> = Vec::new();
    for candidate in found {
        let limit_m = if candidate.label == "car" {
            SAME_CAR_M
        } else {
            SAME_OTHER_M
        };
        let is_same = |other: &FoundObject| {
            other.label == candidate.label && (other.position - candidate.position).norm() < limit_m
        };
        if !kept.iter().any(is_same) {
            kept.push(candidate);
        }
    }
    kept
}

/// Assigns identities to detected objects.
#[derive(Debug, Default)]
pub struct NearestTracker {
    tracks: Vec<NearestTrack>,
    identities: u32,
}

#[derive(Debug)]
struct NearestTrack {
    id: u32,
    label: Label,
    position: Point2<f64>,
    velocity: Vector2<f64>,
    at: Timestamp,
}

impl NearestTracker {
    /// Processes the objects present at a time.
    pub fn track(&mut self, at: Timestamp, found: &[FoundObject]) -> Vec<ReportedObject> {
        self.tracks.retain(|track| at.since(track.at) <= PATIENCE);
        let mut pairs = Vec::new();
        for (number, track) in self.tracks.iter().enumerate() {
            let expected = track.position + track.velocity * at.since(track.at).as_secs_f64();
            for (place, object) in found
                .iter()
                .enumerate()
                .filter(|(_, object)| object.label == track.label)
            {
                let distance_m = (object.position - expected).norm();
                if distance_m < GATE_M {
                    pairs.push((distance_m, number, place));
                }
            }
        }
        pairs.sort_by(|a, b| a.0.total_cmp(&b.0));
        let mut continued = vec![false; self.tracks.len()];
        let mut ids = vec![None; found.len()];
        for (_, number, place) in pairs {
            if !continued[number] && ids[place].is_none() {
                continued[number] = true;
                ids[place] = Some(self.tracks[number].follow(at, found[place].position));
            }
        }
        let identified = found.iter().zip(ids).map(|(object, id)| ReportedObject {
            id: id.unwrap_or_else(|| self.begin(at, object)),
            label: object.label.clone(),
            score: object.score,
            existence: None,
            position: object.position,
        });
        identified.collect()
    }

    fn begin(
        &mut self,
        at: Timestamp,
        FoundObject {
            label, position, ..
        }: &FoundObject,
    ) -> u32 {
        let id = self.identities;
        self.identities += 1;
        self.tracks.push(NearestTrack {
            id,
            label: label.clone(),
            position: *position,
            velocity: Vector2::zeros(),
            at,
        });
        id
    }
}

impl NearestTrack {
    fn follow(&mut self, at: Timestamp, position: Point2<f64>) -> u32 {
        let passed_s = at.since(self.at).as_secs_f64();
        if passed_s > 0.0 {
            self.velocity += ((position - self.position) / passed_s - self.velocity) * GAIN;
        }
        self.position = position;
        self.at = at;
        self.id
    }
}
