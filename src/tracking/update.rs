//! What becomes of one report: detections are matched to objects, the rest found new ones, and what is overlooked
//! counts.

use std::time::Duration;

use nalgebra::{Matrix2, Vector2};
use uuid::Uuid;

use super::Tracker;
use super::assignment::{Pairing, assign};
use super::calibration::log_odds;
use super::config::TracksConfig;
use super::existence::Rates;
use super::grid::Point;
use super::kinematics::{Measurement, Motion};
use super::occlusion::Shadows;
use super::pairs::Sighting;
use super::registration::Alignment;
use super::sensors::Source;
use super::track::{OTHER_LABEL, Track};
use super::trust::{Others, Word, judge};
use crate::reputation::Evidence;
use crate::time::Timestamp;
use crate::wire::{ObjectReport, PerceivedObject};

/// A detection on its way to an object.
struct Seen<'a> {
    /// Its place in the report.
    index: usize,
    object: &'a PerceivedObject,
    /// Of its confidence.
    log_odds: f64,
    reported: Vector2<f64>,
    measurement: Measurement,
}

/// One vehicle's report on its way in.
pub(super) struct Taking<'a> {
    /// Number of the vehicle.
    pub(super) number: u32,
    pub(super) source: &'a mut Source,
    pub(super) report: &'a ObjectReport,
    pub(super) at: Timestamp,
    /// Weight of the vehicle's word, 0 to 1.
    pub(super) trust: f64,
    /// Whether the vehicle is somewhere else all at once, and nothing is known of its alignment any more.
    pub(super) has_jumped: bool,
    /// What the vehicle's alignment is estimated from.
    pub(super) sightings: Vec<Sighting>,
}

/// Where nothing is known of a vehicle's view.
const UNKNOWN: Rates = Rates { stay: 0.9, find: 0.15 };

/// Standard deviation of reported velocities, m/s.
const VELOCITY_SIGMA_MPS: f64 = 1.0;

/// Trust that positions are weighed by at least.
const LEAST_TRUST: f64 = 0.05;

/// Detections after which a track is known well enough to measure detections by.
const MATURE_HITS: u32 = 8;

/// Detections after which a track says what a vehicle sees.
const SURE_HITS: u32 = 5;

/// Within how much time a new object may be anywhere that the highest speed allows.
const FAST_WITHIN: Duration = Duration::from_millis(250);

/// Most detections of a report that are held against such objects: where more are new, nothing is known yet, or somebody
/// makes them up.
const MOST_FAST: usize = 64;

/// Confidence of a vehicle that it exists itself, log-odds.
const SELF_NATS: f64 = 4.0;

impl Tracker {
    pub(super) fn take(&mut self, taking: &mut Taking<'_>) {
        let Taking { source, report, at, .. } = taking;
        source.last_report = source.last_report.max(*at);
        taking.has_jumped = source.view.observe(report);
        if taking.has_jumped {
            source.alignment = Alignment::new(*at, &self.spread());
        }
        if let Some(centre) = source.view.centre() {
            source.alignment.turn_about(centre);
        }
        let is_trusted = taking.trust > 0.0;
        let is_likely = source.calibration.likely();
        let mut shadows = Shadows::new(source.view.position());
        for object in report.objects.iter().filter(|object| is_likely(object.confidence)) {
            shadows.cast(object, self.config.vehicle_radius_m);
        }
        // What a proven liar says is judged where others say something of it, and counts for nothing.
        if is_trusted {
            self.take_own_pose(taking);
        }
        let seen = self.seen(taking);
        let mut chosen = self.associate(taking.number, &seen, taking.at);
        if is_trusted {
            self.associate_fast(taking.source, &seen, taking.at, &mut chosen);
        }
        let mut detected: Vec<u32> = chosen.iter().map(|pairing| pairing.track).collect();
        detected.sort_unstable();
        let mut chosen = chosen.iter().peekable();
        let mut founding = Vec::new();
        for (detection, seen) in seen.iter().enumerate() {
            match chosen.next_if(|pairing| pairing.detection as usize == detection) {
                Some(pairing) => self.confirm(taking, &shadows, pairing.track, seen),
                None => founding.push(seen),
            }
        }
        self.look(taking, &shadows, &detected);
        for seen in founding.into_iter().filter(|_| is_trusted) {
            self.found(taking, seen);
        }
    }

    /// The vehicle is an object too, and the only one whose word that is.
    fn take_own_pose(&mut self, taking: &mut Taking<'_>) {
        let Some(pose) = taking.report.pose else { return };
        let reported = Vector2::new(pose.x_m, pose.y_m);
        let sigma_m = (self.config.vehicle_radius_m / 2.0).max(self.config.noise_floor_m);
        let measurement = Measurement {
            position: taking.source.alignment.correct(&reported),
            independent: Matrix2::identity() * (sigma_m * sigma_m),
            common_m: self.config.common_m,
        };
        let (density, number, at) = (self.config.density(), taking.number, taking.at);
        let known = self.own.get(&number).copied();
        let is_in_reach = known.is_some_and(|track| {
            let innovation = self.tracks[track as usize].motion.innovation(at, &measurement, density);
            innovation.offset.norm() <= self.config.gate_m || innovation.distance_squared <= self.config.gate()
        });
        let track = match known {
            Some(track) => track as usize,
            None => {
                let id = founding_id(taking.report, usize::MAX);
                let Some(track) = self.add(Track::new(id, at, &measurement, &self.config)) else { return };
                track
            }
        };
        self.own.insert(number, track as u32);
        let track = &mut self.tracks[track];
        track.vehicle = Some(number);
        if is_in_reach {
            track.motion.update(at, &measurement, density);
            track.motion.limit_speed(self.config.max_speed_mps);
        } else if at >= track.motion.at {
            // New, or somewhere else all at once, where nobody else can have seen it before.
            track.motion = Motion::new(at, &measurement, self.config.speed_mps);
            track.witnesses.clear();
        }
        track.refresh(at);
        self.fastest_mps = self.fastest_mps.max(track.motion.velocity.norm());
        if let Some(witness) = track.witnesses.detecting(number, at) {
            witness.hit(at, measurement.position, SELF_NATS, UNKNOWN, true);
        }
    }

    /// The report's detections, corrected; those of the vehicle itself are left out.
    fn seen<'a>(&self, taking: &Taking<'a>) -> Vec<Seen<'a>> {
        let Taking { source, report, trust, .. } = taking;
        let own = report.pose.map(|pose| Vector2::new(pose.x_m, pose.y_m));
        let trust = trust.max(LEAST_TRUST);
        let correct = source.alignment.correction();
        let seen = |(index, object): (usize, &'a PerceivedObject)| {
            let reported = Vector2::new(object.x_m, object.y_m);
            let is_itself = own.is_some_and(|own| (own - reported).norm() < self.config.vehicle_radius_m);
            let measurement = Measurement {
                position: correct(&reported),
                independent: source.noise.covariance(object, &self.config) / trust,
                common_m: self.config.common_m,
            };
            (!is_itself).then(|| Seen { index, object, log_odds: log_odds(object.confidence), reported, measurement })
        };
        let mut all = Vec::with_capacity(report.objects.len());
        all.extend(report.objects.iter().enumerate().filter_map(seen));
        all
    }

    /// Which detections are which objects: within the gate, and the likeliest for all together.
    fn associate(&self, number: u32, seen: &[Seen<'_>], at: Timestamp) -> Vec<Pairing> {
        let gate = self.config.gate();
        let density = self.config.density();
        let gate_m_squared = self.config.gate_m.powi(2);
        let reach_m = self.config.gate_m + self.slack_m(at);
        let mut pairings = Vec::with_capacity(2 * seen.len());
        for (detection, seen) in seen.iter().enumerate() {
            let alone = seen.measurement.independent.trace() / 2.0 + self.config.common_m.powi(2);
            self.grid.around(&seen.measurement.position, reach_m, |point| {
                let track = &self.tracks[point.number as usize];
                let offset = seen.measurement.position - track.motion.position_at(at);
                if track.vehicle == Some(number) || offset.norm_squared() > gate_m_squared {
                    return;
                }
                let innovation = track.motion.innovation(at, &seen.measurement, density);
                if innovation.distance_squared > gate {
                    return;
                }
                let likeness = track.likeness(seen.object);
                let spread = innovation.covariance.determinant().sqrt() / alone;
                let maturity = f64::from(track.hits.clamp(1, 10));
                let benefit = gate - innovation.distance_squared + (maturity * likeness.powi(2) / spread).ln();
                if benefit > 0.0 || likeness > OTHER_LABEL {
                    let benefit = benefit.max(0.01);
                    pairings.push(Pairing { detection: detection as u32, track: point.number, benefit });
                }
            });
        }
        assign(pairings)
    }

    /// The same for what is left and goes too fast for that: objects that are so new that their velocity may be any.
    fn associate_fast(&mut self, source: &Source, seen: &[Seen<'_>], at: Timestamp, chosen: &mut Vec<Pairing>) {
        if chosen.len() == seen.len() {
            return;
        }
        let speed_mps = self.config.max_speed_mps;
        let reach_m = speed_mps * FAST_WITHIN.as_secs_f64() + self.slack_m(at);
        let mut continued: Vec<u32> = chosen.iter().map(|pairing| pairing.track).collect();
        continued.sort_unstable();
        let mut matched = chosen.iter().map(|pairing| pairing.detection as usize).peekable();
        let left = seen.iter().enumerate().filter(|(detection, _)| matched.next_if_eq(detection).is_none());
        let is_likely = source.calibration.likely();
        let likely = left.filter(|(_, seen)| is_likely(seen.object.confidence));
        let mut pairings = Vec::new();
        for (detection, seen) in likely.take(MOST_FAST) {
            self.grid.around(&seen.measurement.position, reach_m, |&Point { number: track, .. }| {
                if continued.binary_search(&track).is_err()
                    && let Some(benefit) = self.benefit_if_fast(&self.tracks[track as usize], seen, at)
                {
                    pairings.push(Pairing { detection: detection as u32, track, benefit });
                }
            });
        }
        for pairing in assign(pairings) {
            self.tracks[pairing.track as usize].motion.doubt_velocity(speed_mps / 2.0);
            chosen.push(pairing);
        }
        chosen.sort_by_key(|pairing| pairing.detection);
    }

    /// What it is worth to take a detection for a new object of whatever velocity; `None` if it cannot be.
    fn benefit_if_fast(&self, track: &Track, seen: &Seen<'_>, at: Timestamp) -> Option<f64> {
        let passed = at.since(track.last_seen);
        let is_new = track.hits < SURE_HITS && track.vehicle.is_none();
        let offset = seen.measurement.position - track.motion.position_at(at);
        let speed_mps = self.config.max_speed_mps;
        if !is_new || passed > FAST_WITHIN || offset.norm() > speed_mps * passed.as_secs_f64() {
            return None;
        }
        let likeness = track.likeness(seen.object);
        let mut motion = track.motion.clone();
        motion.doubt_velocity(speed_mps / 2.0);
        let innovation = motion.innovation(at, &seen.measurement, self.config.density());
        let is_possible = innovation.distance_squared <= self.config.gate() && likeness > OTHER_LABEL;
        is_possible.then(|| (self.config.gate() - innovation.distance_squared + 2.0 * likeness.ln()).max(0.01))
    }

    /// An object was detected again.
    fn confirm(&mut self, taking: &mut Taking<'_>, shadows: &Shadows, track: u32, seen: &Seen<'_>) {
        let Taking { number, source, at, trust, sightings, .. } = taking;
        let (number, at, is_trusted, config) = (*number, *at, *trust > 0.0, &self.config);
        let index = track as usize;
        let track = &mut self.tracks[index];
        let density = config.density();
        if track.hits >= MATURE_HITS && track.vehicle.is_none() {
            let offset = seen.measurement.position - track.motion.position_at(at);
            let expected = track.motion.covariance_at(at, density).trace();
            source.noise.learn(seen.object, offset.norm_squared(), expected, config);
        }
        if track.hits >= SURE_HITS && track.vehicle.is_none() {
            let variance = seen.measurement.independent.trace() / 2.0;
            sightings.push(Sighting { track: index as u32, reported: seen.reported, variance });
        }
        let rates = source.view.rates_at(&seen.reported).filter(|_| !shadows.hide(&seen.reported));
        let witness = track.witnesses.get(number);
        let is_heard = witness.is_some() || track.witnesses.hears(number, at);
        let last = witness.filter(|witness| witness.was_hit).map(|witness| witness.log_odds);
        let was_hit = last.is_some();
        let is_sure = track.hits >= SURE_HITS && (was_hit || track.is_confirmed(number, at));
        if rates.is_some() && is_sure && is_heard {
            source.view.learn(&seen.reported, was_hit, true);
        }
        if is_trusted {
            track.motion.update(at, &seen.measurement, density);
            describe(track, source, seen, at, config);
        }
        self.fastest_mps = self.fastest_mps.max(track.motion.velocity.norm());
        if let Some(log_odds) = last {
            source.calibration.learn(log_odds, true);
        }
        let nats = source.calibration.nats(seen.log_odds);
        let seat = if is_trusted { track.witnesses.detecting(number, at) } else { track.witnesses.looking(number, at) };
        let Some(witness) = seat else { return };
        witness.hit(at, seen.measurement.position, nats, rates.unwrap_or(UNKNOWN), true);
        witness.log_odds = seen.log_odds;
        if let Some(said) = witness.settled(at) {
            self.settle(taking, index, &seen.reported, said);
        }
    }

    /// What is in the vehicle's view, where the index has it, and is none of the `detected`, by number: what the round's
    /// reports moved it by does not matter, unless it is somewhere else all at once.
    fn look(&mut self, taking: &mut Taking<'_>, shadows: &Shadows, detected: &[u32]) {
        let (number, at) = (taking.number, taking.at);
        let Some(centre) = taking.source.view.centre() else { return };
        let reach_m = taking.source.view.reach_m() + self.slack_m(at);
        let since_indexed_s = at.micros_from(self.indexed_at) as f64 * 1e-6;
        let mut in_view = Vec::new();
        self.grid.around(&centre, reach_m, |point| {
            let position = point.at + point.velocity * since_indexed_s;
            if detected.binary_search(&point.number).is_err()
                && let Some(rates) = taking.source.view.rates_at(&position).filter(|_| !shadows.hide(&position))
            {
                in_view.push((point.number, position, rates));
            }
        });
        for (candidate, position, rates) in in_view {
            let track = &mut self.tracks[candidate as usize];
            let has_gone_elsewhere = (track.motion.position_at(at) - position).norm() > self.config.gate_m;
            if track.vehicle == Some(number) || has_gone_elsewhere {
                continue;
            }
            let witness = track.witnesses.get(number);
            if witness.map_or(!track.witnesses.hears(number, at), |witness| witness.last_look >= at) {
                continue;
            }
            let was_hit = witness.is_some_and(|witness| witness.was_hit);
            if let Some(witness) = witness.filter(|witness| witness.was_hit) {
                taking.source.calibration.learn(witness.log_odds, false);
            }
            let knew_it = witness.is_some_and(|witness| witness.last_hit.is_some());
            let dt_s = witness.map_or(0.0, |witness| at.since(witness.last_look).as_secs_f64());
            if track.hits >= SURE_HITS && (was_hit || track.is_confirmed(number, at)) {
                taking.source.view.learn(&position, was_hit, false);
            }
            let settled = track.witnesses.looking(number, at).and_then(|witness| {
                witness.miss(at, rates);
                witness.settled(at)
            });
            if knew_it && taking.trust > 0.0 {
                track.overlooked(at, dt_s, rates.of(was_hit));
            }
            if let Some(said) = settled {
                self.settle(taking, candidate as usize, &position, said);
            }
        }
    }

    /// Holds what the vehicle `said` of an object for a while, (hits, looks), against the others' word.
    fn settle(&mut self, taking: &mut Taking<'_>, track: usize, reported: &Vector2<f64>, said: (u32, u32)) {
        let (number, at) = (taking.number, taking.at);
        let track = &self.tracks[track];
        let source = |number: u32| self.sources.get(number as usize).and_then(Option::as_ref);
        let trust = |other: u32| source(other).map_or(0.0, |source| source.trust(&self.reputation));
        let others = Others::of(&track.witnesses, number, at, trust);
        let Some(word) = judge(said, &others) else { return };
        let distance_m = taking.source.view.centre().map_or(0.0, |centre| (reported - centre).norm());
        if word != Word::Invented {
            self.fleet.learn(distance_m, word == Word::True);
        }
        if word == Word::Denied && !self.fleet.expects(distance_m) {
            return;
        }
        let correct = word == Word::True;
        taking.source.standing.count(correct, &self.reputation);
        if at >= self.recorded_from {
            self.evidence.push(Evidence {
                node: taking.source.node.clone(),
                label: track.label(&self.config),
                correct,
            });
        }
    }

    /// A detection that is none of the known objects is a new one.
    fn found(&mut self, taking: &Taking<'_>, seen: &Seen<'_>) {
        let (number, at) = (taking.number, taking.at);
        let mut track = Track::new(founding_id(taking.report, seen.index), at, &seen.measurement, &self.config);
        describe(&mut track, taking.source, seen, at, &self.config);
        let nats = taking.source.calibration.nats(seen.log_odds);
        if let Some(witness) = track.witnesses.detecting(number, at) {
            witness.hit(at, seen.measurement.position, nats, UNKNOWN, false);
            witness.log_odds = seen.log_odds;
        }
        self.add(track);
    }
}

/// Takes over what a detection says beside its place.
fn describe(track: &mut Track, source: &Source, seen: &Seen<'_>, at: Timestamp, config: &TracksConfig) {
    if let Some([x, y]) = seen.object.velocity_mps {
        let velocity = source.alignment.turned(&Vector2::new(x, y));
        track.motion.update_velocity(at, velocity, VELOCITY_SIGMA_MPS, config.density());
    }
    track.motion.limit_speed(config.max_speed_mps);
    let heading_rad = seen.object.heading_rad.map(|heading_rad| source.alignment.correct_heading(heading_rad));
    track.describe(seen.object, heading_rad);
    track.refresh(at);
}

/// The same for whoever hears of the founding detection: FNV-1a of 128 bits over what names it
/// (draft-eastlake-fnv), as a UUID of version 8.
fn founding_id(report: &ObjectReport, index: usize) -> Uuid {
    const OFFSET: u128 = 0x6c62_272e_07bb_0142_62b8_2175_6295_c58d;
    const PRIME: u128 = 0x0000_0000_0100_0000_0000_0000_0000_013b;
    let numbers = [report.captured_at_us.micros(), report.seq, index as u64];
    let bytes = report.node.as_str().bytes().chain([0]).chain(numbers.into_iter().flat_map(u64::to_be_bytes));
    let hash = bytes.fold(OFFSET, |hash, byte| (hash ^ u128::from(byte)).wrapping_mul(PRIME));
    Uuid::new_v8(hash.to_be_bytes())
}
