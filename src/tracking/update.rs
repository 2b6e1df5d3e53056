//! Update of the tracks by one report.
//!
//! [`ReportUpdate::run`] updates the vehicle's own track, associates the detections with tracks, updates those, counts
//! misses of the others in view, and spawns tracks from what is left.

use nalgebra::{Matrix2, Vector2};

use super::calibration::log_odds;
use super::config::TracksConfig;
use super::existence::{DetectionRates, ExistenceStatement, LookRates};
use super::foreign::ForeignObjects;
use super::handles::TrackIndex;
use super::kinematics::{KinematicState, Measurement};
use super::lifecycle::track_id;
use super::occlusion::OcclusionMap;
use super::registration::RegistrationSample;
use super::sensors::SensorModel;
use super::store::TrackStore;
use super::track::Track;
use super::trust::{Fleet, Judgement};
use crate::model::time::Timestamp;
use crate::reputation::Evidence;
use crate::wire::{ObjectReport, PerceivedObject};

/// Standard deviation of reported velocities, m/s.
const VELOCITY_SIGMA_MPS: f64 = 1.0;

/// Minimum trust by which the covariances of positions are divided.
const MIN_TRUST: f64 = 0.05;

/// Number of detections from which a track measures the noise of detections.
const MATURE_HITS: u32 = 8;

/// Number of detections from which a track measures pose biases and detection rates.
pub(super) const ESTABLISHED_HITS: u32 = 5;

/// Maximum number of objects of each neighbouring cell that are compared with a report.
const MAX_FOREIGN_EACH: usize = 32;

/// Log-odds of a vehicle's confidence that it exists itself.
const OWN_NATS: f64 = 4.0;

/// A detection of a report, corrected by the estimated pose bias.
pub(super) struct TimedDetection<'a> {
    /// Index into the objects of the report.
    pub(super) index: usize,
    pub(super) object: &'a PerceivedObject,
    /// Log-odds of the confidence.
    log_odds: f64,
    /// Position as reported, metres.
    reported: Vector2<f64>,
    pub(super) measurement: Measurement,
}

/// Update of the tracks by one report of one vehicle.
pub(super) struct ReportUpdate<'a> {
    pub(super) config: &'a TracksConfig,
    pub(super) tracks: &'a mut TrackStore,
    pub(super) sensor: &'a mut SensorModel,
    pub(super) at: Timestamp,
    fleet: &'a mut Fleet,
    foreign: &'a mut ForeignObjects,
    report: &'a ObjectReport,
    /// Weight of the vehicle's evidence before the update, 0 to 1.
    trust: f64,
    occlusion: OcclusionMap,
    outcome: ReportOutcome,
}

/// Result of an update.
#[derive(Debug, Default)]
pub(super) struct ReportOutcome {
    /// Whether the vehicle has jumped to another place, so that its earlier samples are void.
    pub(super) has_jumped: bool,
    pub(super) samples: Vec<RegistrationSample>,
    /// Judgements of the vehicle's statements.
    pub(super) evidence: Vec<Evidence>,
}

impl<'a> ReportUpdate<'a> {
    /// An update by `report`, captured at `at`; the sensor model takes note of it.
    pub(super) fn new(
        config: &'a TracksConfig,
        tracks: &'a mut TrackStore,
        (sensor, fleet): (&'a mut SensorModel, &'a mut Fleet),
        foreign: &'a mut ForeignObjects,
        report: &'a ObjectReport,
        at: Timestamp,
    ) -> Self {
        let has_jumped = sensor.observe(report, at, config);
        let is_likely = sensor.calibration.likely();
        let mut occlusion = OcclusionMap::new(sensor.coverage.position());
        for object in report
            .objects
            .iter()
            .filter(|object| is_likely(object.confidence))
        {
            occlusion.add(object, config.vehicle_radius_m);
        }
        let trust = fleet.trust(sensor.id);
        let samples = Vec::with_capacity(report.objects.len());
        let outcome = ReportOutcome {
            has_jumped,
            samples,
            evidence: Vec::new(),
        };
        Self {
            config,
            tracks,
            sensor,
            at,
            fleet,
            foreign,
            report,
            trust,
            occlusion,
            outcome,
        }
    }

    /// Carries out the update.
    pub(super) fn run(mut self) -> ReportOutcome {
        if self.is_trusted() {
            self.update_own_track();
        }
        let detections = self.detections();
        let mut pairings = self.associate(&detections);
        if self.is_trusted() {
            self.associate_fast(&detections, &mut pairings);
        }
        let mut detected: Vec<TrackIndex> = pairings.iter().map(|pairing| pairing.track).collect();
        detected.sort_unstable();
        let mut pairings = pairings.iter().peekable();
        let mut unassociated = Vec::new();
        for (number, detection) in detections.iter().enumerate() {
            match pairings.next_if(|pairing| pairing.detection == number) {
                Some(pairing) => self.update_track(pairing.track, detection),
                None => unassociated.push(detection),
            }
        }
        self.count_misses(&detected);
        self.look_at_foreign(&detections);
        if self.is_trusted() {
            unassociated
                .into_iter()
                .for_each(|detection| self.spawn(detection));
        }
        self.outcome
    }

    /// Whether the report changes tracks. A proven liar's statements are judged and have no other effect.
    fn is_trusted(&self) -> bool {
        self.trust > 0.0
    }

    /// Updates or spawns the track of the vehicle itself from its pose; no other report may do so.
    fn update_own_track(&mut self) {
        let Some(pose) = self
            .report
            .pose
            .filter(|_| self.report.moving != Some(false))
        else {
            return;
        };
        let sigma_m = (self.config.vehicle_radius_m / 2.0).max(self.config.noise_floor_m);
        let measurement = Measurement {
            position: self.sensor.pose_bias.corrector()(&Vector2::new(pose.x_m, pose.y_m)),
            independent: Matrix2::identity() * (sigma_m * sigma_m),
            common_m: self.config.common_m,
        };
        let (density, vehicle, at) = (self.config.density(), self.sensor.id, self.at);
        let known = self.tracks.of_vehicle(vehicle);
        let is_in_reach = known.is_some_and(|track| {
            let innovation = self.tracks[track]
                .state
                .innovation(at, &measurement, density);
            innovation.offset.norm() <= self.config.gate_m
                || innovation.distance_squared <= self.config.gate()
        });
        let begin = |update: &mut Self| {
            let track = update.begin(&measurement, usize::MAX, None);
            update.tracks.add(track)
        };
        let Some(index) = known.or_else(|| begin(self)) else {
            return;
        };
        self.tracks.set_vehicle(index, vehicle);
        let track = &mut self.tracks[index];
        if is_in_reach {
            track.state.update(at, &measurement, density);
            track.state.limit_speed(self.config.max_speed_mps);
        } else if at >= track.state.at {
            // The vehicle is new or has jumped; no other vehicle can have seen it here before.
            track.state = KinematicState::new(at, &measurement, self.config.speed_mps);
            track.history.clear();
        }
        track.record_hit(at);
        if let Some(history) = track.history.for_hit(vehicle, at) {
            history.hit(at, measurement.position, OWN_NATS, Some(LookRates::PRIOR));
        }
        self.tracks.note_speed(index);
    }

    /// The report's detections, but for those of the vehicle itself.
    fn detections(&self) -> Vec<TimedDetection<'a>> {
        let own = self
            .report
            .pose
            .map(|pose| Vector2::new(pose.x_m, pose.y_m));
        let trust = self.trust.max(MIN_TRUST);
        let correct = self.sensor.pose_bias.corrector();
        let detection = |(index, object): (usize, &'a PerceivedObject)| {
            let reported = Vector2::new(object.x_m, object.y_m);
            let is_itself =
                own.is_some_and(|own| (own - reported).norm() < self.config.vehicle_radius_m);
            let measurement = Measurement {
                position: correct(&reported),
                independent: self.sensor.noise.covariance(object, self.config) / trust,
                common_m: self.config.common_m,
            };
            let log_odds = log_odds(object.confidence);
            (!is_itself).then_some(TimedDetection {
                index,
                object,
                log_odds,
                reported,
                measurement,
            })
        };
        let mut detections = Vec::with_capacity(self.report.objects.len());
        detections.extend(self.report.objects.iter().enumerate().filter_map(detection));
        detections
    }

    /// Updates a track with its detection, and the sensor model with what the track tells of it.
    fn update_track(&mut self, index: TrackIndex, detection: &TimedDetection<'_>) {
        let (id, at, density) = (self.sensor.id, self.at, self.config.density());
        let TimedDetection {
            object,
            reported,
            measurement,
            ..
        } = detection;
        let track = &mut self.tracks[index];
        let is_vehicle = track.vehicle.is_some();
        if track.hits >= MATURE_HITS && !is_vehicle {
            let offset = measurement.position - track.state.position_at(at);
            let expected = track.state.covariance_at(at, density).trace();
            self.sensor
                .noise
                .learn(object, offset.norm_squared(), expected, self.config);
        }
        if track.hits >= ESTABLISHED_HITS && !is_vehicle {
            let variance = measurement.independent.trace() / 2.0;
            self.outcome.samples.push(RegistrationSample {
                track: index,
                reported: *reported,
                variance,
            });
        }
        let rates = self
            .sensor
            .coverage
            .rates_at(reported)
            .filter(|_| !self.occlusion.hides(reported));
        let look_rates = self
            .sensor
            .look_rates(rates.unwrap_or(DetectionRates::PRIOR));
        let history = track.history.get(id);
        if let (Some(history), Some(probability)) = (history, track.clutter) {
            self.sensor
                .clutter
                .learn(probability, history.was_hit, true);
        }
        let has_room = history.is_some() || track.history.has_room(id, at);
        let last_hit = history
            .filter(|history| history.was_hit)
            .map(|history| history.confidence_log_odds);
        let was_hit = last_hit.is_some();
        let exists = track.hits >= ESTABLISHED_HITS && (was_hit || track.is_confirmed(id, at));
        if rates.is_some() && exists && has_room {
            self.sensor.coverage.learn(reported, was_hit, true);
        }
        if self.trust > 0.0 {
            track.state.update(at, measurement, density);
            detection.describe(track, self.sensor, at, self.config);
        }
        if let Some(log_odds) = last_hit {
            self.sensor.calibration.learn(log_odds, true);
        }
        let nats = self.sensor.calibration.nats(detection.log_odds);
        let slot = if self.trust > 0.0 {
            track.history.for_hit(id, at)
        } else {
            track.history.for_look(id, at)
        };
        let due = slot.and_then(|history| {
            history.hit(at, measurement.position, nats, Some(look_rates));
            history.confidence_log_odds = detection.log_odds;
            history.take_due(at)
        });
        self.tracks.note_speed(index);
        if let Some(statement) = due {
            self.judge(index, reported, statement);
        }
    }

    /// Counts a miss for every track in the vehicle's view that is not among the `detected`.
    fn count_misses(&mut self, detected: &[TrackIndex]) {
        let (id, at) = (self.sensor.id, self.at);
        let Some(centre) = self.sensor.coverage.centre() else {
            return;
        };
        // Positions are those of the index, so that updates of the same round make no difference.
        let since_indexed_s = self.tracks.seconds_since_indexed(at);
        let mut in_view = Vec::new();
        let reach_m = self.sensor.coverage.range_m() + self.tracks.slack_m(at);
        self.tracks.near(&centre, reach_m, |indexed| {
            let position = indexed.position + indexed.velocity * since_indexed_s;
            if detected.binary_search(&indexed.track).is_err()
                && let Some(rates) = self
                    .sensor
                    .coverage
                    .rates_at(&position)
                    .filter(|_| !self.occlusion.hides(&position))
            {
                in_view.push((indexed.track, position, rates));
            }
        });
        for (index, position, rates) in in_view {
            let track = &mut self.tracks[index];
            let has_jumped = (track.state.position_at(at) - position).norm() > self.config.gate_m;
            if track.vehicle == Some(id) || has_jumped {
                continue;
            }
            let history = track.history.get(id);
            if history.map_or(!track.history.has_room(id, at), |history| {
                history.last_look >= at
            }) {
                continue;
            }
            let was_hit = history.is_some_and(|history| history.was_hit);
            let look_rates = self.sensor.look_rates(rates);
            if let (Some(_), Some(probability)) = (history, track.clutter) {
                self.sensor.clutter.learn(probability, was_hit, false);
            }
            if let Some(history) = history.filter(|history| history.was_hit) {
                self.sensor
                    .calibration
                    .learn(history.confidence_log_odds, false);
            }
            let had_detected = history.is_some_and(|history| history.last_hit.is_some());
            let dt_s = history.map_or(0.0, |history| at.since(history.last_look).as_secs_f64());
            if track.hits >= ESTABLISHED_HITS && (was_hit || track.is_confirmed(id, at)) {
                self.sensor.coverage.learn(&position, was_hit, false);
            }
            let due = track.history.for_look(id, at).and_then(|history| {
                history.miss(at, look_rates);
                history.take_due(at)
            });
            if had_detected && self.trust > 0.0 {
                track.record_miss(at, dt_s, rates.after(was_hit));
            }
            if let Some(statement) = due {
                self.judge(index, &position, statement);
            }
        }
    }

    /// Takes note of what the vehicle sees where cells state that objects are, and judges those cells.
    fn look_at_foreign(&mut self, detections: &[TimedDetection<'_>]) {
        let (id, at, gate) = (self.sensor.id, self.at, self.config.gate());
        let Some(centre) = self
            .sensor
            .coverage
            .centre()
            .filter(|_| !self.foreign.is_empty())
        else {
            return;
        };
        let (coverage, occlusion) = (&self.sensor.coverage, &self.occlusion);
        let (reach_m, near_m) = (coverage.range_m(), 2.0 * self.config.gate_m);
        let rates_at =
            |place: &Vector2<f64>| coverage.rates_at(place).filter(|_| !occlusion.hides(place));
        // Objects that nobody can see take no place from others.
        let is_looked_at = |place: &Vector2<f64>| {
            let is_within = (place - centre).norm() <= reach_m;
            let mut places = detections
                .iter()
                .map(|detection| detection.measurement.position);
            is_within
                && (rates_at(place).is_some()
                    || places.any(|other| (other - place).norm() <= near_m))
        };
        for foreign in self.foreign.stated(MAX_FOREIGN_EACH, at, is_looked_at) {
            let position = foreign.state.position_at(at);
            let rates = rates_at(&position);
            let near = detections.iter().filter(|detection| {
                let innovation =
                    foreign
                        .state
                        .innovation(at, &detection.measurement, self.config.density());
                // Its place is as old as its cell's map.
                innovation.offset.norm() <= near_m && innovation.distance_squared <= gate
            });
            let likeliest = near
                .map(|detection| detection.log_odds)
                .max_by(f64::total_cmp);
            match (likeliest, rates) {
                (Some(log_odds), rates) => {
                    let rates = self
                        .sensor
                        .look_rates(rates.unwrap_or(DetectionRates::PRIOR));
                    if let Some(history) = foreign.history.for_hit(id, at) {
                        history.hit(
                            at,
                            position,
                            self.sensor.calibration.nats(log_odds),
                            Some(rates),
                        );
                    }
                }
                (None, Some(rates)) => {
                    let rates = self.sensor.look_rates(rates);
                    if let Some(history) = foreign.history.for_look(id, at) {
                        history.miss(at, rates);
                    }
                }
                (None, None) => {}
            }
        }
        self.foreign.judge(self.fleet, at);
    }

    /// Judges the vehicle's statement about a track by the evidence of the others.
    fn judge(&mut self, index: TrackIndex, reported: &Vector2<f64>, statement: ExistenceStatement) {
        let track = &self.tracks[index];
        let distance_m = self
            .sensor
            .coverage
            .centre()
            .map_or(0.0, |centre| (reported - centre).norm());
        let judgement = self.fleet.judge(
            self.sensor.id,
            statement,
            &track.history,
            distance_m,
            self.at,
        );
        let Some(judgement) = judgement else { return };
        let correct = judgement == Judgement::Correct;
        self.fleet
            .count(self.sensor.id, &mut self.sensor.counts, correct);
        let label = track.label(self.config);
        self.outcome.evidence.push(Evidence {
            node: self.sensor.node.clone(),
            label,
            correct,
        });
    }

    /// A new track at a measurement of object `index` of the report: an object of a neighbouring cell, if one is there.
    fn begin(
        &mut self,
        measurement: &Measurement,
        index: usize,
        detected: Option<&PerceivedObject>,
    ) -> Track {
        let (at, config) = (self.at, self.config);
        match self
            .foreign
            .find(at, measurement, detected, self.tracks, self.fleet, config)
        {
            Some(foreign) => {
                let track = foreign.lend(at, measurement, config);
                self.foreign.hand_overs.begun += 1;
                track
            }
            None => Track::new(track_id(self.report, index), at, measurement, config),
        }
    }

    /// Spawns a track from a detection that no track explains.
    fn spawn(&mut self, detection: &TimedDetection<'_>) {
        let at = self.at;
        let mut track = self.begin(
            &detection.measurement,
            detection.index,
            Some(detection.object),
        );
        detection.describe(&mut track, self.sensor, at, self.config);
        let nats = self.sensor.calibration.nats(detection.log_odds);
        if let Some(history) = track.history.for_hit(self.sensor.id, at) {
            history.hit(at, detection.measurement.position, nats, None);
            history.confidence_log_odds = detection.log_odds;
        }
        self.tracks.add(track);
    }
}

impl TimedDetection<'_> {
    /// Updates velocity, attributes and time of a track.
    fn describe(
        &self,
        track: &mut Track,
        sensor: &SensorModel,
        at: Timestamp,
        config: &TracksConfig,
    ) {
        if let Some([x, y]) = self.object.velocity_mps {
            let velocity = sensor.pose_bias.correct_velocity(&Vector2::new(x, y));
            track
                .state
                .update_velocity(at, velocity, VELOCITY_SIGMA_MPS, config.density());
        }
        track.state.limit_speed(config.max_speed_mps);
        let heading_rad = self
            .object
            .heading_rad
            .map(|heading_rad| sensor.pose_bias.correct_heading(heading_rad));
        track.update_attributes(self.object, heading_rad);
        track.record_hit(at);
    }
}
