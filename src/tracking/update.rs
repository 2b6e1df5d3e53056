//! Update of the tracks by all reports of one instant.
//!
//! [`InstantUpdate::run`] updates the tracks of the reporting vehicles themselves, [associates](super::assignment) the
//! detections of all vehicles with tracks, updates each track once with all its detections, weighs the observations of
//! every vehicle, updates the sensor models, and spawns tracks from the remaining detections.

use hashbrown::HashMap;
use nalgebra::{Matrix2, Vector2};
use smallvec::SmallVec;

use super::assignment::{Assignment, Hypothesis};
use super::class::ObjectClass;
use super::config::TracksConfig;
use super::existence::{ExistenceStatement, ObservationState, logistic};
use super::handles::{SensorId, TrackIndex};
use super::kinematics::{KinematicState, Measurement, VELOCITY_SIGMA_MPS};
use super::lifecycle::track_id;
use super::neighbour_tracks::NeighbourTracks;
use super::population::LeavingRates;
use super::registration::{RegistrationFrame, RegistrationSample};
use super::scan::{Scan, ScannedDetection};
use super::sensors::{Residual, Sensors};
use super::store::TrackStore;
use super::track::Track;
use super::trust::Judgement;
use crate::model::time::Timestamp;
use crate::reputation::Evidence;
use crate::wire::{ObjectReport, PerceivedObject};

/// Normalised innovation squared, of two dimensions, above which an object manoeuvres.
const MANOEUVRE: f64 = 5.0;

/// Probability above which a track is certain enough to measure the noise of detections.
const CERTAIN: f64 = 0.9;

/// Maximum number of objects of each neighbouring cell that are compared with a report.
const MAX_NEIGHBOURS_EACH: usize = 32;

/// Log-odds that a vehicle exists if it states its own pose.
const OWN_NATS: f64 = 4.0;

/// Result of one instant.
#[derive(Debug, Default)]
pub(super) struct InstantOutcome {
    pub(super) frames: Vec<RegistrationFrame>,
    /// Judgements of the vehicles' statements.
    pub(super) evidence: Vec<Evidence>,
}

/// TrackObservation of one track by one vehicle.
struct TrackObservation {
    track: TrackIndex,
    /// Number of the scan.
    scan: usize,
    /// Number of the detection, if the observation was a detection.
    detection: Option<usize>,
    /// The position at which the vehicle would have reported the object, metres.
    place: Vector2<f64>,
    /// Evidence of the result, nats.
    nats: f64,
    /// State before the observation.
    state: ObservationState,
    /// True if the vehicle states its pose.
    has_pose: bool,
    /// True if the place is in the field of view.
    is_in_view: bool,
    /// True if another detection of the vehicle may hide the place.
    is_hidden: bool,
}

/// Update of the tracks by all reports of one instant.
pub(super) struct InstantUpdate<'a> {
    pub(super) config: &'a TracksConfig,
    pub(super) tracks: &'a mut TrackStore,
    pub(super) sensors: &'a mut Sensors,
    pub(super) neighbours: &'a mut NeighbourTracks,
    pub(super) leaving: LeavingRates,
    pub(super) at: Timestamp,
}

impl InstantUpdate<'_> {
    /// Carries out the update by reports with the corrections of their stamps in seconds.
    pub(super) fn run<'r>(
        mut self,
        reports: impl IntoIterator<Item = (&'r ObjectReport, f64)>,
    ) -> InstantOutcome {
        let mut scans = Vec::new();
        for (report, delay_s) in reports {
            let (sensor, fleet) = self.sensors.receive(&report.node, self.at, self.config);
            let id = sensor.id;
            let trust = fleet.trust(sensor.id);
            let has_jumped = sensor.observe(report, self.at, self.config);
            if trust > 0.0 {
                self.update_own_track(id, report);
            }
            if let Some(sensor) = self.sensors.get(id) {
                scans.push(Scan {
                    delay_s,
                    has_jumped,
                    ..Scan::new(sensor, report, trust, self.config)
                });
            }
        }
        let hypotheses = Assignment::of(&scans, self.tracks, self.sensors, self.at, self.config);
        let mut outcome = InstantOutcome::default();
        outcome
            .frames
            .extend(scans.iter().map(|scan| RegistrationFrame {
                sensor: scan.sensor,
                at: self.at,
                delay_s: scan.delay_s,
                has_jumped: scan.has_jumped,
                samples: Vec::with_capacity(scan.detections.len()),
            }));
        let observations = self.observations(&scans, &hypotheses);
        for hypothesis in &hypotheses {
            if let Some(track) = hypothesis.track.filter(|_| !hypothesis.hits.is_empty()) {
                self.sample(track, hypothesis, &scans, &mut outcome.frames);
                self.update_track(track, hypothesis, &scans);
            }
        }
        self.weigh(&observations, &scans, &mut outcome.evidence);
        for scan in &scans {
            self.judge_neighbours(scan);
        }
        for hypothesis in &hypotheses {
            if hypothesis.track.is_none() && !hypothesis.hits.is_empty() {
                self.spawn(hypothesis, &scans);
            }
        }
        outcome
    }

    /// Updates or spawns the track of the reporting vehicle from its pose. Only the vehicle's own reports do so.
    fn update_own_track(&mut self, vehicle: SensorId, report: &ObjectReport) {
        let Some(pose) = report.pose.filter(|_| report.moving != Some(false)) else {
            return;
        };
        let Some(sensor) = self.sensors.get(vehicle) else {
            return;
        };
        let sigma_m = (self.config.vehicle_radius_m / 2.0).max(self.config.noise_floor_m);
        let measurement = Measurement {
            position: sensor.pose_bias.corrector()(&Vector2::new(pose.x_m, pose.y_m)),
            independent: Matrix2::identity() * (sigma_m * sigma_m),
            common_m: self.config.common_m,
        };
        let at = self.at;
        let known = self.tracks.of_vehicle(vehicle);
        let is_in_reach = known.is_some_and(|track| {
            let innovation = self.tracks[track].state.innovation(at, &measurement);
            innovation.offset.norm() <= self.config.gate_m
                || innovation.distance_squared <= self.config.gate()
        });
        let begin = |update: &mut Self| {
            let track = update.begin(&measurement, report, usize::MAX, None);
            update.tracks.add(track)
        };
        let Some(index) = known.or_else(|| begin(self)) else {
            return;
        };
        self.tracks.set_vehicle(index, vehicle);
        let class = ObjectClass::of(&self.config.vehicle_label, self.config);
        let track = &mut self.tracks[index];
        if is_in_reach {
            track.state.update(at, &measurement);
            track.state.limit_speed();
        } else if known.is_some() && at >= track.state.at {
            // The vehicle has jumped, so earlier detections at its new position were not of this vehicle.
            track.state = KinematicState::new(at, &measurement, class);
            track.history.clear();
        }
        track.record_hit(at);
        track.predict_existence(at, self.leaving);
        track.existence.raise(OWN_NATS);
        if let Some(history) = track.history.for_hit(vehicle, at) {
            history.hit(at, measurement.position, OWN_NATS, OWN_NATS);
        }
        track.record_detected(at);
        self.tracks.record_speed(index);
    }

    /// All observations of the instant: detections, and misses of the tracks in view.
    fn observations(&self, scans: &[Scan<'_>], hypotheses: &[Hypothesis]) -> Vec<TrackObservation> {
        let mut detected: Vec<Vec<TrackIndex>> = vec![Vec::new(); scans.len()];
        let mut observations = Vec::with_capacity(self.tracks.len());
        for hypothesis in hypotheses {
            let Some(track) = hypothesis.track else {
                continue;
            };
            for (number, detection) in hypothesis.hits.iter().copied() {
                let scan = &scans[number];
                detected[number].push(track);
                let history = &self.tracks[track].history;
                let Some(sensor) = self.sensors.get(scan.sensor) else {
                    continue;
                };
                let place = scan.detections[detection].reported;
                let state = history.state_of(scan.sensor);
                let in_view = sensor.observation_rates(&place, state);
                let rates = in_view.unwrap_or_else(|| sensor.rates_out_of_view(state));
                observations.push(TrackObservation {
                    track,
                    scan: number,
                    detection: Some(detection),
                    place,
                    nats: rates.nats(true),
                    state,
                    has_pose: rates.has_pose,
                    is_in_view: in_view.is_some(),
                    is_hidden: false,
                });
            }
        }
        for (number, (scan, detected)) in scans.iter().zip(&mut detected).enumerate() {
            detected.sort_unstable();
            self.misses(number, scan, detected, &mut observations);
        }
        observations
    }

    /// Adds a miss of every track in the vehicle's view that is not among the `detected`.
    fn misses(
        &self,
        number: usize,
        scan: &Scan<'_>,
        detected: &[TrackIndex],
        observations: &mut Vec<TrackObservation>,
    ) {
        let Some(sensor) = self.sensors.get(scan.sensor) else {
            return;
        };
        let Some(centre) = sensor.coverage.centre() else {
            return;
        };
        // Uses the positions of the index, so that the result is independent of updates within the round.
        let since_indexed_s = self.tracks.seconds_since_indexed(self.at);
        let reach_m = sensor.coverage.range_m() + self.tracks.slack_m(self.at);
        self.tracks.near(&centre, reach_m, |indexed| {
            let place = indexed.position + indexed.velocity * since_indexed_s;
            let Some(object) = sensor.coverage.rates_at(&place) else {
                return;
            };
            let track = &self.tracks[indexed.track];
            let history = track.history.get(scan.sensor);
            let has_room = history.is_some() || track.history.has_room(self.at);
            if !has_room || detected.binary_search(&indexed.track).is_ok() {
                return;
            }
            let has_jumped = (track.state.position_at(self.at) - place).norm() > self.config.gate_m;
            let is_stale = history.is_some_and(|history| history.observed_at >= self.at);
            if track.vehicle == Some(scan.sensor) || has_jumped || is_stale {
                return;
            }
            let state = history.map_or(ObservationState::First, |history| history.state);
            let rates = sensor.rates(object, state);
            observations.push(TrackObservation {
                track: indexed.track,
                scan: number,
                detection: None,
                place,
                nats: rates.nats(false),
                state,
                has_pose: rates.has_pose,
                is_in_view: true,
                is_hidden: scan.occlusion.hides(&place),
            });
        });
    }

    /// Takes samples for registration from the detections of a confirmed track.
    fn sample(
        &self,
        index: TrackIndex,
        hypothesis: &Hypothesis,
        scans: &[Scan<'_>],
        frames: &mut [RegistrationFrame],
    ) {
        let track = &self.tracks[index];
        if !track.is_confirmed() || track.vehicle.is_some() {
            return;
        }
        for (scan, detection) in hypothesis.hits.iter().copied() {
            let detection = &scans[scan].detections[detection];
            frames[scan].samples.push(RegistrationSample {
                track: index,
                reported: detection.reported,
                variance: detection.measurement.independent.trace() / 2.0,
            });
        }
    }

    /// Updates a track once with all its detections, and the noise of the vehicles by the residuals.
    fn update_track(&mut self, index: TrackIndex, hypothesis: &Hypothesis, scans: &[Scan<'_>]) {
        let at = self.at;
        let hits = || {
            hypothesis
                .hits
                .iter()
                .map(|(scan, detection)| (&scans[*scan], &scans[*scan].detections[*detection]))
        };
        // Without trusted detections, the remaining information is only a rounding error.
        if hits().all(|(scan, _)| !scan.is_trusted()) {
            return;
        }
        let track = &mut self.tracks[index];
        let Some((position, independent)) = hypothesis.detected() else {
            return;
        };
        let measurement = Measurement {
            position,
            independent,
            common_m: track.state.class.common_m,
        };
        let is_known = track.is_confirmed()
            && track.vehicle.is_none()
            && track.existence.probability() > CERTAIN;
        let predicted = track.state.covariance_at(at).trace() / 2.0;
        let prior = track.state.clone();
        let alone = hypothesis.hits.len() == 1;
        let alone_offset = position - track.state.position_at(at);
        let innovation = track.state.innovation(at, &measurement);
        if innovation.distance_squared > MANOEUVRE {
            track.state.adapt(innovation.distance_squared / MANOEUVRE);
        }
        track.state.update(at, &measurement);
        let is_only_hit = hits().filter(|(scan, _)| scan.is_trusted()).count() == 1;
        for (scan, detection) in hits().filter(|(scan, _)| scan.is_trusted()) {
            let Some(velocity) = velocity_stated(self.sensors, scan, detection) else {
                continue;
            };
            let fleet = &self.sensors.fleet;
            let is_only_witness =
                is_only_hit && !track.is_detected_by_others(scan.sensor, |id| fleet.trust(id));
            let is_admitted = if is_only_witness {
                prior.is_possible(&velocity)
            } else {
                (track.is_confirmed() || track.is_velocity_stated)
                    && prior.admits_velocity(at, &velocity, VELOCITY_SIGMA_MPS, self.config.gate())
            };
            if is_admitted {
                track.update_velocity(at, velocity);
            }
        }
        track.record_hit_by(hits().map(|(scan, _)| scan.sensor), at);
        if is_known {
            let estimated = track.state.covariance_at(at).trace() / 2.0;
            let here = track.state.position_at(at);
            for (scan, detection) in hits() {
                if alone && track.history.len() > 1 {
                    continue;
                }
                let residual = if alone {
                    Residual {
                        offset: alone_offset,
                        variance: -predicted,
                    }
                } else {
                    Residual {
                        offset: detection.measurement.position - here,
                        variance: estimated,
                    }
                };
                if let Some(sensor) = self.sensors.get_mut(scan.sensor) {
                    let origin = sensor.coverage.position();
                    sensor
                        .noise
                        .learn(detection.object, origin.as_ref(), &residual, self.config);
                }
            }
        }
        for (scan, detection) in hits().filter(|(scan, _)| scan.is_trusted()) {
            let heading_rad = heading_stated(self.sensors, scan, detection);
            track.record_attributes(scan.sensor, detection.object, heading_rad, scan.trust, at);
        }
        track.combine_attributes(at);
        if track.vehicle.is_none() {
            track.state.class = ObjectClass::of(&track.label(self.config), self.config);
        }
        track.state.limit_speed();
        self.tracks.record_speed(index);
    }

    /// Adds all observations to the existences, then updates rates, calibrations and judgements.
    fn weigh(
        &mut self,
        observations: &[TrackObservation],
        scans: &[Scan<'_>],
        evidence: &mut Vec<Evidence>,
    ) {
        let at = self.at;
        let mut due = Vec::new();
        for (number, observation) in observations.iter().enumerate() {
            let scan = &scans[observation.scan];
            let track = &mut self.tracks[observation.track];
            track.predict_existence(at, self.leaving);
            let nats = observation.nats;
            if observation.detection.is_some() && scan.is_trusted() && track.is_confirmed() {
                track.existence.revive();
            }
            track.existence.add(scan.trust * nats);
            let statement = match observation.detection.map(|number| &scan.detections[number]) {
                Some(detection) => {
                    let sensor = self.sensors.get(scan.sensor);
                    let is_shifted =
                        sensor.is_some_and(|sensor| sensor.shifts(detection.object, self.config));
                    let slot = if scan.is_trusted() {
                        track.history.for_hit(scan.sensor, at)
                    } else {
                        track.history.for_observation(scan.sensor, at)
                    };
                    slot.and_then(|history| {
                        let position = detection.measurement.position;
                        history.hit(at, position, nats, detection.confidence_nats);
                        history.is_shifted = is_shifted;
                        history.take_due(at)
                    })
                }
                None => track
                    .history
                    .for_observation(scan.sensor, at)
                    .and_then(|history| {
                        history.miss(at, nats);
                        if !observation.is_hidden {
                            history.state_miss();
                            history.deny(nats, observation.has_pose);
                        }
                        history.take_due(at)
                    }),
            };
            due.extend(statement.map(|statement| (number, statement)));
        }
        let mut existences = HashMap::with_capacity(observations.len().min(self.tracks.len()));
        for observation in observations {
            let exists = *existences
                .entry(observation.track)
                .or_insert_with(|| self.conclude(observation.track));
            self.learn(observation, &scans[observation.scan], exists);
        }
        for (number, statement) in due {
            let observation = &observations[number];
            self.judge(
                observation,
                scans[observation.scan].sensor,
                statement,
                evidence,
            );
        }
    }

    /// Concludes from all observations of a track in the instant; returns the probability that its object exists.
    fn conclude(&mut self, index: TrackIndex) -> f64 {
        let track = &mut self.tracks[index];
        track.record_detected(self.at);
        let fleet = &self.sensors.fleet;
        let denied = track.denied_nats(self.at, |id| fleet.trust(id));
        let exists = logistic(track.existence.log_odds() + denied.unwrap_or(0.0));
        let is_object = track.vehicle.is_none() && track.is_confirmed() && exists > CERTAIN;
        if is_object && !track.is_settled {
            track.is_settled = true;
            self.sensors.settle(track.spawned_by, true);
        }
        exists
    }

    /// Updates rates and calibration with an observation of an object that `exists` with a probability.
    fn learn(&mut self, observation: &TrackObservation, scan: &Scan<'_>, exists: f64) {
        let track = &self.tracks[observation.track];
        if track.vehicle.is_some() {
            return;
        }
        let is_hit = observation.detection.is_some();
        let is_evident = track.is_confirmed()
            && observation.is_in_view
            && (observation.state.is_hit() || track.is_seen_by_others(scan.sensor, self.at));
        let Some(sensor) = self.sensors.get_mut(scan.sensor) else {
            return;
        };
        if is_evident {
            sensor
                .coverage
                .learn(&observation.place, observation.state, is_hit, exists);
        }
        sensor
            .clutter
            .learn(observation.state, is_hit, 1.0 - exists);
        if let Some(detection) = observation.detection.map(|number| &scan.detections[number]) {
            sensor.calibration.learn(detection.log_odds, exists);
        }
    }

    /// Judges a vehicle's statement about a track by the evidence of the other vehicles.
    fn judge(
        &mut self,
        observation: &TrackObservation,
        vehicle: SensorId,
        statement: ExistenceStatement,
        evidence: &mut Vec<Evidence>,
    ) {
        let track = &self.tracks[observation.track];
        let (sensor, fleet) = match self.sensors.with_fleet(vehicle) {
            Some(both) => both,
            None => return,
        };
        let distance_m = sensor
            .coverage
            .centre()
            .map_or(0.0, |centre| (observation.place - centre).norm());
        let judged = fleet.judge(vehicle, statement, &track.history, distance_m, self.at);
        let is_shifted = || {
            let mut histories = track.history.iter();
            histories.any(|history| history.sensor == vehicle && history.is_shifted)
        };
        let judgement = match judged {
            None => return,
            Some(Judgement::Correct) if is_shifted() => Judgement::Shifted,
            Some(judgement) => judgement,
        };
        let correct = judgement == Judgement::Correct;
        fleet.count(vehicle, &mut sensor.counts, correct);
        evidence.push(Evidence {
            node: sensor.node.clone(),
            label: track.label(self.config),
            correct,
        });
    }

    /// Compares a vehicle's detections with the objects that other cells state, and judges these cells.
    fn judge_neighbours(&mut self, scan: &Scan<'_>) {
        let id = scan.sensor;
        let at = self.at;
        let gate = self.config.gate();
        let Some(sensor) = self.sensors.get(id).filter(|_| !self.neighbours.is_empty()) else {
            return;
        };
        let Some(centre) = sensor.coverage.centre() else {
            return;
        };
        let reach_m = sensor.coverage.range_m();
        let near_m = 2.0 * self.config.gate_m;
        let is_in_view = |place: &Vector2<f64>| sensor.coverage.rates_at(place).is_some();
        // Objects outside the view must not use up the limit per cell.
        let is_observed = |place: &Vector2<f64>| {
            let is_within = (place - centre).norm() <= reach_m;
            let mut places = scan
                .detections
                .iter()
                .map(|detection| detection.measurement.position);
            is_within && (is_in_view(place) || places.any(|other| (other - place).norm() <= near_m))
        };
        for neighbour in self.neighbours.stated(MAX_NEIGHBOURS_EACH, at, is_observed) {
            let position = neighbour.state.position_at(at);
            let state = neighbour.history.state_of(id);
            let near = scan.detections.iter().filter(|detection| {
                let innovation = neighbour.state.innovation(at, &detection.measurement);
                // The position of the object is as old as its cell's map.
                innovation.offset.norm() <= near_m && innovation.distance_squared <= gate
            });
            let confidence = near
                .map(|detection| detection.confidence_nats)
                .max_by(f64::total_cmp);
            if let Some(confidence) = confidence {
                let nats = sensor.hit_rates(&position, state).nats(true);
                if let Some(history) = neighbour.history.for_hit(id, at) {
                    history.hit(at, position, nats, confidence);
                }
            } else if let Some(rates) = sensor.observation_rates(&position, state)
                && let Some(history) = neighbour.history.for_observation(id, at)
            {
                history.miss(at, rates.nats(false));
            }
        }
        self.neighbours.judge(&self.sensors.fleet, at);
    }

    /// A new track at a measurement of object `index` of a report. The track continues an object of a neighbouring cell
    /// at that position.
    fn begin(
        &mut self,
        measurement: &Measurement,
        report: &ObjectReport,
        index: usize,
        detected: Option<&PerceivedObject>,
    ) -> Track {
        let at = self.at;
        let config = self.config;
        let fleet = &self.sensors.fleet;
        match self
            .neighbours
            .find(at, measurement, detected, self.tracks, fleet, config)
        {
            Some(neighbour) => {
                let track = neighbour.lend(at, measurement, config);
                self.neighbours.hand_overs.begun += 1;
                track
            }
            None => {
                let label = detected.map_or(&config.vehicle_label, |object| &object.label);
                let class = ObjectClass::of(label, config);
                Track::new(track_id(report, index), at, measurement, class)
            }
        }
    }

    /// Spawns a track from detections that no track explains.
    fn spawn(&mut self, hypothesis: &Hypothesis, scans: &[Scan<'_>]) {
        let at = self.at;
        let hits = || {
            hypothesis
                .hits
                .iter()
                .map(|(scan, detection)| (&scans[*scan], &scans[*scan].detections[*detection]))
                .filter(|(scan, _)| scan.is_trusted())
        };
        let Some((first, detection)) = hits().next() else {
            return;
        };
        let Some((position, independent)) = hypothesis.detected() else {
            return;
        };
        let measurement = Measurement {
            position,
            independent,
            common_m: detection.class.common_m,
        };
        let object = Some(detection.object);
        let mut track = self.begin(&measurement, first.report, detection.index, object);
        track.spawned_by = Some(first.sensor);
        let spawner = self.sensors.get(first.sensor);
        let births = spawner.map(|sensor| sensor.births.log_odds());
        let mut log_odds = births.unwrap_or_default();
        for (number, (scan, detection)) in hits().enumerate() {
            let Some(sensor) = self.sensors.get(scan.sensor) else {
                continue;
            };
            let nats = if number == 0 {
                0.0
            } else {
                let rates = sensor.hit_rates(&detection.reported, ObservationState::First);
                rates.nats(true)
            };
            log_odds += scan.trust * nats;
            let heading_rad = heading_stated(self.sensors, scan, detection);
            track.record_attributes(scan.sensor, detection.object, heading_rad, scan.trust, at);
            if let Some(history) = track.history.for_hit(scan.sensor, at) {
                let own_position = detection.measurement.position;
                history.hit(at, own_position, nats, detection.confidence_nats);
            }
        }
        for (number, scan) in scans.iter().enumerate() {
            let hit = hypothesis
                .hits
                .binary_search_by_key(&number, |(scan, _)| *scan);
            if scan.is_trusted() && hit.is_ok() {
                continue;
            }
            let Some(sensor) = self.sensors.get(scan.sensor) else {
                continue;
            };
            let rates = sensor.observation_rates(&position, ObservationState::First);
            if let Some(rates) = rates {
                let nats = rates.nats(false);
                log_odds += scan.trust * nats;
                if let Some(history) = track.history.for_observation(scan.sensor, at) {
                    history.miss(at, nats);
                    if !scan.occlusion.hides(&position) {
                        history.deny(nats, rates.has_pose);
                    }
                }
            }
        }
        track.combine_attributes(at);
        let velocities: SmallVec<[Vector2<f64>; 4]> = hits()
            .filter_map(|(scan, detection)| velocity_stated(self.sensors, scan, detection))
            .filter(|velocity| track.state.is_possible(velocity))
            .collect();
        let max_squared = 2.0 * VELOCITY_SIGMA_MPS.powi(2) * self.config.gate();
        let agree = |other: &Vector2<f64>| (other - velocities[0]).norm_squared() <= max_squared;
        let is_only_witness = hits().nth(1).is_none();
        if is_only_witness || velocities.len() > 1 && velocities.iter().all(agree) {
            for velocity in &velocities {
                track.update_velocity(at, *velocity);
            }
        }
        track.record_hit(at);
        let trust = hits().map(|(scan, _)| scan.trust).fold(0.0, f64::max);
        track.existence.raise(log_odds + trust.ln());
        self.tracks.add(track);
    }
}

/// The velocity that a vehicle states for an object, corrected by the vehicle's pose bias, m/s.
fn velocity_stated(
    sensors: &Sensors,
    scan: &Scan<'_>,
    detection: &ScannedDetection<'_>,
) -> Option<Vector2<f64>> {
    let [x, y] = detection.object.velocity_mps?;
    let bias = &sensors.get(scan.sensor)?.pose_bias;
    Some(bias.correct_velocity(&Vector2::new(x, y)))
}

/// The heading that a vehicle states for an object, corrected by the vehicle's pose bias, radians.
fn heading_stated(
    sensors: &Sensors,
    scan: &Scan<'_>,
    detection: &ScannedDetection<'_>,
) -> Option<f64> {
    let heading_rad = detection.object.heading_rad?;
    let bias = &sensors.get(scan.sensor)?.pose_bias;
    Some(bias.correct_heading(heading_rad))
}
