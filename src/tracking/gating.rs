//! Association of a report's detections with tracks: gating by distance, then the assignment with the greatest benefit.

use std::time::Duration;

use super::handles::TrackIndex;
use super::track::{MIN_LABEL_SIMILARITY, Track};
use super::update::{ESTABLISHED_HITS, ReportUpdate, TimedDetection};
use crate::association::{Candidate, ClusterSize, assign};

/// A detection and a track within the gate.
#[derive(Debug, Clone, Copy)]
pub(super) struct GatedPair {
    /// Index into the detections of the report.
    pub(super) detection: usize,
    pub(super) track: TrackIndex,
    /// Benefit of the assignment, greater than 0.
    benefit: f64,
}

/// Minimum benefit of a pairing within the gate.
const MIN_BENEFIT: f64 = 0.01;

/// Number of detections in one cluster beyond which the best pairings are taken one after the other.
const MAX_CLUSTER: usize = 48;

/// Maximum number of hits that raise the benefit of a track.
const MAX_MATURITY: u32 = 10;

/// Maximum age of a new track that may have any velocity.
const FAST_WITHIN: Duration = Duration::from_millis(250);

/// Maximum number of detections of a report that are compared with such tracks. Where more are new, nothing is known
/// yet, or a vehicle fabricates them.
const MAX_FAST: usize = 64;

impl ReportUpdate<'_> {
    /// Pairings of detections with tracks within the gate, by detection.
    pub(super) fn associate(&self, detections: &[TimedDetection<'_>]) -> Vec<GatedPair> {
        let (gate, gate_m) = (self.config.gate(), self.config.gate_m);
        let reach_m = gate_m + self.tracks.slack_m(self.at);
        let mut pairings = Vec::with_capacity(2 * detections.len());
        for (number, detection) in detections.iter().enumerate() {
            let alone =
                detection.measurement.independent.trace() / 2.0 + self.config.common_m.powi(2);
            self.tracks
                .near(&detection.measurement.position, reach_m, |indexed| {
                    let track = &self.tracks[indexed.track];
                    let offset = detection.measurement.position - track.state.position_at(self.at);
                    if track.vehicle == Some(self.sensor.id)
                        || offset.norm_squared() > gate_m.powi(2)
                    {
                        return;
                    }
                    let innovation = track.state.innovation(
                        self.at,
                        &detection.measurement,
                        self.config.density(),
                    );
                    if innovation.distance_squared > gate {
                        return;
                    }
                    let similarity = track.label_similarity(detection.object);
                    let spread = innovation.covariance.determinant().sqrt() / alone;
                    let maturity = f64::from(track.hits.clamp(1, MAX_MATURITY));
                    let benefit = gate - innovation.distance_squared
                        + (maturity * similarity.powi(2) / spread).ln();
                    if benefit > 0.0 || similarity > MIN_LABEL_SIMILARITY {
                        let benefit = benefit.max(MIN_BENEFIT);
                        pairings.push(GatedPair {
                            detection: number,
                            track: indexed.track,
                            benefit,
                        });
                    }
                });
        }
        best(pairings)
    }

    /// Adds pairings of the remaining likely detections with tracks that are so new that they may have any velocity.
    pub(super) fn associate_fast(
        &mut self,
        detections: &[TimedDetection<'_>],
        pairings: &mut Vec<GatedPair>,
    ) {
        if pairings.len() == detections.len() {
            return;
        }
        let max_mps = self.config.max_speed_mps;
        let reach_m = max_mps * FAST_WITHIN.as_secs_f64() + self.tracks.slack_m(self.at);
        let mut continued: Vec<TrackIndex> = pairings.iter().map(|pairing| pairing.track).collect();
        continued.sort_unstable();
        let mut matched = pairings.iter().map(|pairing| pairing.detection).peekable();
        let rest = detections
            .iter()
            .enumerate()
            .filter(|(number, _)| matched.next_if_eq(number).is_none());
        let is_likely = self.sensor.calibration.likely();
        let likely = rest.filter(|(_, detection)| is_likely(detection.object.confidence));
        let mut fast = Vec::new();
        for (number, detection) in likely.take(MAX_FAST) {
            self.tracks
                .near(&detection.measurement.position, reach_m, |indexed| {
                    if continued.binary_search(&indexed.track).is_err()
                        && let Some(benefit) =
                            self.benefit_if_fast(&self.tracks[indexed.track], detection)
                    {
                        fast.push(GatedPair {
                            detection: number,
                            track: indexed.track,
                            benefit,
                        });
                    }
                });
        }
        for pairing in best(fast) {
            self.tracks[pairing.track]
                .state
                .inflate_velocity_covariance(max_mps / 2.0);
            pairings.push(pairing);
        }
        pairings.sort_by_key(|pairing| pairing.detection);
    }

    /// Benefit of pairing a detection with a new track of any velocity; `None` if they cannot be the same object.
    fn benefit_if_fast(&self, track: &Track, detection: &TimedDetection<'_>) -> Option<f64> {
        let passed = self.at.since(track.last_seen);
        let is_new = track.hits < ESTABLISHED_HITS && track.vehicle.is_none();
        let offset = detection.measurement.position - track.state.position_at(self.at);
        let max_mps = self.config.max_speed_mps;
        if !is_new || passed > FAST_WITHIN || offset.norm() > max_mps * passed.as_secs_f64() {
            return None;
        }
        let similarity = track.label_similarity(detection.object);
        let mut state = track.state.clone();
        state.inflate_velocity_covariance(max_mps / 2.0);
        let innovation = state.innovation(self.at, &detection.measurement, self.config.density());
        let is_possible =
            innovation.distance_squared <= self.config.gate() && similarity > MIN_LABEL_SIMILARITY;
        let benefit = self.config.gate() - innovation.distance_squared + 2.0 * similarity.ln();
        is_possible.then_some(benefit.max(MIN_BENEFIT))
    }
}

/// The best pairings, by detection.
fn best(mut pairings: Vec<GatedPair>) -> Vec<GatedPair> {
    pairings.sort_by_key(|pairing| (pairing.detection, pairing.track));
    let mut assigned = assign(pairings, greedy_if_large);
    assigned.sort_by_key(|pairing| pairing.detection);
    assigned
}

/// Of a cluster that is too large, the pairings taken one after the other, the best first.
fn greedy_if_large(size: ClusterSize, cluster: &[GatedPair]) -> Option<Vec<GatedPair>> {
    (size.rows > MAX_CLUSTER).then(|| {
        let mut by_benefit = cluster.to_vec();
        by_benefit.sort_by(|a, b| b.benefit.total_cmp(&a.benefit));
        let mut chosen: Vec<GatedPair> = Vec::new();
        for pairing in by_benefit {
            if chosen
                .iter()
                .all(|other| other.detection != pairing.detection && other.track != pairing.track)
            {
                chosen.push(pairing);
            }
        }
        chosen
    })
}

impl Candidate for GatedPair {
    const SPARE_COLUMNS: bool = true;

    fn row(&self) -> u32 {
        self.detection as u32
    }

    fn column(&self) -> u32 {
        self.track.number()
    }

    /// The benefit in units of 2⁻³⁰, at least one unit.
    fn benefit(&self) -> i64 {
        (self.benefit.min(1e6) * f64::from(1u32 << 30)) as i64 + 1
    }
}
