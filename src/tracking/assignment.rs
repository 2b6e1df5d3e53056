//! Joint association of all scans of one instant.
//!
//! Every track is a hypothesis in information form: Y = P⁻¹ and y = Y·x of its predicted position. The vehicles are
//! assigned one after the other by global nearest neighbour (Blackman, Popoli, "Design and Analysis of Modern Tracking
//! Systems", 1999, chapter 6). The information of each assigned detection is added, so that the next vehicle is compared
//! with the prediction and the others' detections. A second pass subtracts the detections of one vehicle at a time and
//! assigns them again: iterated conditional modes of the multi-sensor assignment (Besag, "On the statistical analysis
//! of dirty pictures", 1986). A detection that no hypothesis explains opens a new hypothesis, which the following
//! vehicles may join.
//!
//! The benefit of a pair is its log-likelihood ratio to a detection of clutter or of a new object (Bar-Shalom, Li,
//! "Multitarget-Multisensor Tracking", 1995, section 2.4).

use std::f64::consts::TAU;
use std::time::Duration;

use hashbrown::{HashMap, HashSet};
use nalgebra::{Matrix2, Vector2};
use smallvec::SmallVec;

use super::config::TracksConfig;
use super::existence::{DetectionRates, ObservationState};
use super::grid::square;
use super::handles::{SensorId, TrackIndex};
use super::kinematics::inverse;
use super::scan::{Scan, ScannedDetection};
use super::sensors::Sensors;
use super::store::TrackStore;
use super::track::{MIN_LABEL_SIMILARITY, Track};
use crate::association::{Candidate, ClusterSize, assign};
use crate::model::time::Timestamp;

/// Number of passes over the scans of an instant that has several scans.
const PASSES: usize = 2;

/// Minimum probability that a track is detected, so that tracks of low existence can recover.
const MIN_DETECTED: f64 = 0.2;

/// Probability that a new hypothesis of this instant is an object.
const NEW_EXISTENCE: f64 = 0.5;

/// Number of detections in a cluster above which the assignment is greedy, the best pair first.
const MAX_CLUSTER: usize = 48;

/// Maximum age of a new track that is associated as an object of any velocity.
const FAST_WITHIN: Duration = Duration::from_millis(250);

/// Maximum number of detections of a scan that are compared with such tracks. A scan with more detections is the first
/// scan of the cell, or its vehicle fabricates detections.
const MAX_FAST: usize = 64;

/// Maximum number of new hypotheses that are compared with a detection in each of the nine squares around it, whose
/// side is the gate.
const MAX_NEW_NEAR: usize = 16;

/// Maximum number of tracks that are compared with a detection, the nearest first.
const MAX_TRACKS_NEAR: usize = 64;

/// Maximum number of pairs of a detection and a track that are compared for one report. More would delay the round of
/// all vehicles.
const MAX_PAIRS: usize = 20_000;

/// Probability of a detection by a vehicle whose view is unknown.
pub(super) const UNKNOWN_RATE: f64 = 0.5;

/// A possible cause of detections of this instant.
#[derive(Debug)]
pub(super) struct Hypothesis {
    /// The track; `None` for an object that begins here.
    pub(super) track: Option<TrackIndex>,
    /// Predicted information; zero for an object that begins here.
    prior: Information,
    information: Information,
    /// Position and covariance of `information`, metres; `None` without any.
    estimate: Option<(Vector2<f64>, Matrix2<f64>)>,
    /// Probability that the object exists.
    existence: f64,
    /// Numbers of scans and their detections, by scan.
    pub(super) hits: SmallVec<[(usize, usize); 4]>,
}

/// Gaussian estimate of a position in information form.
#[derive(Debug, Clone, Copy)]
struct Information {
    matrix: Matrix2<f64>,
    vector: Vector2<f64>,
}

impl Information {
    const NONE: Self = Self {
        matrix: Matrix2::new(0.0, 0.0, 0.0, 0.0),
        vector: Vector2::new(0.0, 0.0),
    };

    fn of(position: &Vector2<f64>, covariance: &Matrix2<f64>) -> Self {
        let matrix = inverse(covariance).unwrap_or_default();
        Self {
            matrix,
            vector: matrix * position,
        }
    }

    fn add(&mut self, other: &Self, sign: f64) {
        self.matrix += other.matrix * sign;
        self.vector += other.vector * sign;
    }

    fn mean(&self) -> Option<(Vector2<f64>, Matrix2<f64>)> {
        let covariance = inverse(&self.matrix)?;
        Some((covariance * self.vector, covariance))
    }
}

impl Hypothesis {
    fn new(track: Option<TrackIndex>, prior: Information, existence: f64) -> Self {
        Self {
            track,
            prior,
            information: prior,
            estimate: prior.mean(),
            existence,
            hits: SmallVec::new(),
        }
    }

    /// Adds the information of a detection, or removes it if `sign` is -1.
    fn add(&mut self, information: &Information, sign: f64) {
        self.information.add(information, sign);
        self.estimate = self.information.mean();
    }

    /// Position and covariance of all detections of the hypothesis together.
    pub(super) fn detected(&self) -> Option<(Vector2<f64>, Matrix2<f64>)> {
        let mut detected = self.information;
        detected.add(&self.prior, -1.0);
        detected.mean()
    }
}

/// A detection and a hypothesis within the gate.
#[derive(Debug, Clone, Copy)]
struct GatedPair {
    detection: usize,
    hypothesis: usize,
    benefit: f64,
}

/// One scan in the passes of an assignment.
struct AssignedScan<'a> {
    scan: &'a Scan<'a>,
    /// Information of each detection.
    information: Vec<Information>,
    /// Hypotheses of the tracks near the detections, one detection after the other; empty before the first pass.
    near: Vec<usize>,
    /// By detection, the end of its hypotheses in `near`.
    near_ends: Vec<usize>,
    /// Hypothesis of each detection by the latest pass; empty before the first pass.
    owners: Vec<usize>,
}

impl<'a> AssignedScan<'a> {
    fn new(scan: &'a Scan<'a>) -> Self {
        let information = |detection: &ScannedDetection<'_>| {
            let measurement = &detection.measurement;
            Information::of(&measurement.position, &measurement.independent)
        };
        Self {
            scan,
            information: scan.detections.iter().map(information).collect(),
            near: Vec::new(),
            near_ends: Vec::new(),
            owners: Vec::new(),
        }
    }
}

/// Association of one instant.
pub(super) struct Assignment<'a> {
    config: &'a TracksConfig,
    tracks: &'a TrackStore,
    sensors: &'a Sensors,
    at: Timestamp,
    hypotheses: Vec<Hypothesis>,
    of_track: HashMap<TrackIndex, usize>,
    /// Hypotheses of new objects by square of the gate's side.
    new: HashMap<(i64, i64), SmallVec<[usize; 4]>>,
}

impl<'a> Assignment<'a> {
    /// Assigns the detections of all scans.
    pub(super) fn of(
        scans: &[Scan<'_>],
        tracks: &'a TrackStore,
        sensors: &'a Sensors,
        at: Timestamp,
        config: &'a TracksConfig,
    ) -> Vec<Hypothesis> {
        let detections = scans.iter().map(|scan| scan.detections.len()).sum();
        let mut assignment = Self {
            config,
            tracks,
            sensors,
            at,
            hypotheses: Vec::with_capacity(detections),
            of_track: HashMap::with_capacity(detections),
            new: HashMap::new(),
        };
        let mut assigned: Vec<AssignedScan<'_>> = scans.iter().map(AssignedScan::new).collect();
        let passes = if scans.len() > 1 { PASSES } else { 1 };
        for _ in 0..passes {
            for scan in &mut assigned {
                assignment.assign(scan);
            }
        }
        for (number, scan) in assigned.iter().enumerate() {
            for (detection, owner) in scan.owners.iter().enumerate() {
                assignment.hypotheses[*owner].hits.push((number, detection));
            }
        }
        assignment.hypotheses
    }

    /// Assigns one scan, anew after an earlier pass.
    fn assign(&mut self, assigned: &mut AssignedScan<'_>) {
        let scan = assigned.scan;
        self.add_information(assigned, -1.0);
        if assigned.near_ends.is_empty() {
            self.find_near_tracks(assigned);
        }
        let pairs = self.gated_pairs(assigned);
        let mut owners: Vec<Option<usize>> = vec![None; scan.detections.len()];
        for pair in assign(pairs, greedy_if_large) {
            owners[pair.detection] = Some(pair.hypothesis);
        }
        self.assign_fast(scan, &mut owners);
        assigned.owners = owners
            .iter()
            .zip(&scan.detections)
            .map(|(owner, detection)| owner.unwrap_or_else(|| self.open(scan, detection)))
            .collect();
        self.add_information(assigned, 1.0);
    }

    /// Adds the information of a scan's detections to its hypotheses, or removes it if `sign` is -1.
    fn add_information(&mut self, assigned: &AssignedScan<'_>, sign: f64) {
        if assigned.scan.is_trusted() {
            for (owner, information) in assigned.owners.iter().zip(&assigned.information) {
                self.hypotheses[*owner].add(information, sign);
            }
        }
    }

    /// Assigns remaining detections that are likely objects to unconfirmed tracks, whose velocity is unknown.
    fn assign_fast(&mut self, scan: &Scan<'_>, assigned: &mut [Option<usize>]) {
        let detections = scan.detections.iter().enumerate();
        let likely = detections.filter(|(number, detection)| {
            assigned[*number].is_none() && detection.confidence_nats > 0.0
        });
        let likely: SmallVec<[_; 4]> = likely.take(MAX_FAST).collect();
        if likely.is_empty() {
            return;
        }
        let taken: HashSet<usize> = assigned.iter().flatten().copied().collect();
        let mut pairs = Vec::new();
        for (number, detection) in likely {
            let reach_m = detection.class.max_speed_mps * FAST_WITHIN.as_secs_f64();
            let near = self.nearest_tracks(
                &detection.measurement.position,
                reach_m + self.tracks.slack_m(self.at),
                MAX_TRACKS_NEAR,
                |track| self.tracks[track].may_have_any_velocity(),
            );
            for track in near {
                let hypothesis = self.of_track(track);
                if !taken.contains(&hypothesis)
                    && let Some(benefit) = self.benefit_if_fast(&self.tracks[track], detection)
                {
                    pairs.push(GatedPair {
                        detection: number,
                        hypothesis,
                        benefit,
                    });
                }
            }
        }
        for pair in assign(pairs, greedy_if_large) {
            assigned[pair.detection] = Some(pair.hypothesis);
        }
    }

    /// Benefit of pairing a detection with a new track of any velocity; `None` if they cannot be the same object.
    fn benefit_if_fast(&self, track: &Track, detection: &ScannedDetection<'_>) -> Option<f64> {
        let passed = self.at.since(track.last_seen);
        let offset = detection.measurement.position - track.state.position_at(self.at);
        let max_mps = detection.class.max_speed_mps;
        if passed > FAST_WITHIN || offset.norm() > max_mps * passed.as_secs_f64() {
            return None;
        }
        let similarity = track.label_similarity(detection.object);
        let mut state = track.state.clone();
        state.inflate_velocity_covariance(max_mps / 2.0);
        let distance_squared = state
            .innovation(self.at, &detection.measurement)
            .distance_squared;
        let benefit = self.config.gate() - distance_squared + similarity.ln();
        (benefit > 0.0 && similarity > MIN_LABEL_SIMILARITY).then_some(benefit)
    }

    /// The hypothesis of a track.
    fn of_track(&mut self, track: TrackIndex) -> usize {
        let next = self.hypotheses.len();
        let hypothesis = *self.of_track.entry(track).or_insert(next);
        if hypothesis == next {
            let Track {
                state, existence, ..
            } = &self.tracks[track];
            let prior = Information::of(&state.position_at(self.at), &state.covariance_at(self.at));
            self.hypotheses
                .push(Hypothesis::new(Some(track), prior, existence.probability()));
        }
        hypothesis
    }

    /// Finds the tracks near each detection. The vehicle's own track is excluded; of many near tracks only the nearest
    /// are compared.
    fn find_near_tracks(&mut self, assigned: &mut AssignedScan<'_>) {
        let scan = assigned.scan;
        let reach_m = self.config.gate_m + self.tracks.slack_m(self.at);
        let max_near = max_tracks_near(scan.detections.len());
        let own_track = self.tracks.of_vehicle(scan.sensor);
        for detection in &scan.detections {
            let position = &detection.measurement.position;
            let tracks = self.nearest_tracks(position, reach_m, max_near, |track| {
                Some(track) != own_track
            });
            let hypotheses = tracks.into_iter().map(|track| self.of_track(track));
            assigned.near.extend(hypotheses);
            assigned.near_ends.push(assigned.near.len());
        }
    }

    /// All pairs of a detection and a hypothesis that explain the detection better than clutter.
    fn gated_pairs(&self, assigned: &AssignedScan<'_>) -> Vec<GatedPair> {
        let detections = &assigned.scan.detections;
        let mut pairs = Vec::with_capacity(2 * detections.len());
        let Some(sensor) = self.sensors.get(assigned.scan.sensor) else {
            return pairs;
        };
        let mut start = 0;
        for (number, (detection, end)) in detections.iter().zip(&assigned.near_ends).enumerate() {
            let near = &assigned.near[start..*end];
            start = *end;
            let rates = sensor.coverage.rates_at(&detection.reported);
            let new = self.new_near(&detection.measurement.position);
            for hypothesis in near.iter().copied().chain(new) {
                let benefit =
                    self.benefit(sensor.id, rates, detection, &self.hypotheses[hypothesis]);
                pairs.extend(benefit.map(|benefit| GatedPair {
                    detection: number,
                    hypothesis,
                    benefit,
                }));
            }
        }
        pairs
    }

    /// Tracks within `reach_m` of a position for which `is_candidate` holds: of more than `max`, the
    /// nearest.
    fn nearest_tracks(
        &self,
        position: &Vector2<f64>,
        reach_m: f64,
        max: usize,
        is_candidate: impl Fn(TrackIndex) -> bool,
    ) -> SmallVec<[TrackIndex; 16]> {
        let mut tracks: SmallVec<[(f64, TrackIndex); 16]> = SmallVec::new();
        self.tracks.near(position, reach_m, |indexed| {
            if is_candidate(indexed.track) {
                tracks.push(((indexed.position - position).norm(), indexed.track));
            }
        });
        if tracks.len() > max {
            let by_distance = |a: &(f64, TrackIndex), b: &(f64, TrackIndex)| {
                a.0.total_cmp(&b.0).then(a.1.cmp(&b.1))
            };
            tracks.select_nth_unstable_by(max, by_distance);
            tracks.truncate(max);
            tracks.sort_unstable_by(by_distance);
        }
        tracks.into_iter().map(|(_, track)| track).collect()
    }

    /// Log-likelihood ratio of a pair, greater than 0; `None` if clutter or a new object explains the detection better.
    /// `rates` are the vehicle's detection rates at the detection; `None` if its view is unknown.
    fn benefit(
        &self,
        sensor: SensorId,
        rates: Option<&DetectionRates>,
        detection: &ScannedDetection<'_>,
        hypothesis: &Hypothesis,
    ) -> Option<f64> {
        let (position, covariance) = hypothesis.estimate?;
        let measurement = &detection.measurement;
        let offset = measurement.position - position;
        if offset.norm_squared() > self.config.gate_m.powi(2) {
            return None;
        }
        let common = Matrix2::identity() * measurement.common_m.powi(2);
        let covariance = covariance + measurement.independent + common;
        let distance_squared = offset.dot(&(inverse(&covariance)? * offset));
        if distance_squared > self.config.gate() {
            return None;
        }
        let rate = |state| rates.map_or(UNKNOWN_RATE, |rates| rates.rate(state));
        let (state, similarity) = match hypothesis.track.map(|track| &self.tracks[track]) {
            Some(track) => (
                track.history.state_of(sensor),
                track.label_similarity(detection.object),
            ),
            None => (ObservationState::First, 1.0),
        };
        let detected = hypothesis.existence * rate(state);
        let odds = detected.max(MIN_DETECTED) / (1.0 - detected);
        let new_per_m2 = detection.class.new_per_m2;
        let density = TAU * covariance.determinant().sqrt() * new_per_m2;
        let benefit = (odds * similarity / density).ln() - distance_squared / 2.0;
        (benefit > 0.0).then_some(benefit)
    }

    /// A new hypothesis at a detection. Other vehicles may join it if it has information.
    fn open(&mut self, scan: &Scan<'_>, detection: &ScannedDetection<'_>) -> usize {
        let square = square(&detection.measurement.position, self.config.gate_m);
        let number = self.hypotheses.len();
        self.hypotheses
            .push(Hypothesis::new(None, Information::NONE, NEW_EXISTENCE));
        if scan.is_trusted() {
            self.new.entry(square).or_default().push(number);
        }
        number
    }

    /// The instant's new hypotheses in the squares around a position.
    fn new_near(&self, position: &Vector2<f64>) -> impl Iterator<Item = usize> {
        let (column, row) = square(position, self.config.gate_m);
        let squares = (column - 1..=column + 1)
            .flat_map(move |column| (row - 1..=row + 1).map(move |row| (column, row)));
        let squares = (!self.new.is_empty()).then_some(squares);
        let numbers = squares
            .into_iter()
            .flatten()
            .filter_map(|square| self.new.get(&square));
        numbers.flat_map(|numbers| numbers.iter().copied().take(MAX_NEW_NEAR))
    }
}

/// Maximum number of tracks that are compared with each detection of a report. In a large report it is smaller, so that
/// the time for a crowd grows with the number of its objects instead of the square.
fn max_tracks_near(detections: usize) -> usize {
    MAX_TRACKS_NEAR.min(MAX_PAIRS / detections.max(1)).max(1)
}

/// Greedy assignment of a large cluster: the best pair first.
fn greedy_if_large(size: ClusterSize, cluster: &[GatedPair]) -> Option<Vec<GatedPair>> {
    (size.rows > MAX_CLUSTER).then(|| {
        let mut by_benefit = cluster.to_vec();
        by_benefit.sort_by(|a, b| b.benefit.total_cmp(&a.benefit));
        let mut detections = HashSet::new();
        let mut hypotheses = HashSet::new();
        by_benefit.retain(|pair| {
            let is_free =
                !detections.contains(&pair.detection) && !hypotheses.contains(&pair.hypothesis);
            is_free && detections.insert(pair.detection) && hypotheses.insert(pair.hypothesis)
        });
        by_benefit
    })
}

impl Candidate for GatedPair {
    const SPARE_COLUMNS: bool = true;

    fn row(&self) -> u32 {
        self.detection as u32
    }

    fn column(&self) -> u32 {
        self.hypothesis as u32
    }

    /// The benefit in units of 2⁻³⁰, at least one unit.
    fn benefit(&self) -> i64 {
        (self.benefit.min(1e6) * f64::from(1u32 << 30)) as i64 + 1
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn large_report_compares_bounded_pairs() {
        assert!((1..=300).all(|detections| max_tracks_near(detections) == MAX_TRACKS_NEAR));
        for detections in 1..=MAX_PAIRS {
            assert!(detections * max_tracks_near(detections) <= MAX_PAIRS);
        }
    }
}
