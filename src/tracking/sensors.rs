//! Owner of the sensor models: what is learnt of each vehicle. The only module that creates a [`SensorId`].

use std::collections::BTreeMap;
use std::time::Duration;

use hashbrown::HashMap;
use nalgebra::{Matrix2, Vector2};

use super::calibration::DetectionCalibration;
use super::config::TracksConfig;
use super::coverage::Coverage;
use super::existence::{ClutterRates, DetectionRates, LookRates, SensorQuality, USUAL_LOOKS_HZ};
use super::handles::SensorId;
use super::pose_bias::PoseBias;
use super::trust::{DormantCounts, Fleet, TrustCounts};
use crate::model::geometry::Covariance;
use crate::model::names::NodeName;
use crate::model::time::Timestamp;
use crate::reputation::{Evidence, ReputationConfig, ReputationLedger};
use crate::wire::{ForeignVotes, ObjectReport, PerceivedObject, WirePose};

/// Distance of a vehicle from where it was, as a share of its range, up to which it stays. Without a pose, it is that of the
/// median of its detections.
const STAYS: f64 = 0.25;
/// The same of the detections of a vehicle that declares to stand: they come and go.
const DECLARED_STAYS: f64 = 1.0;
/// Range in metres that counts at least: that of a vehicle that detects nothing shrinks.
const MIN_RANGE_M: f64 = 10.0;

/// Time after which a vehicle that states no pose and stays is known to stand.
const STAYS_FOR: Duration = Duration::from_secs(120);

/// Bounds of the time between two reports in seconds, and the weight of the latest in its mean.
const MIN_INTERVAL_S: f64 = 0.02;
const MAX_INTERVAL_S: f64 = 1.0;
const INTERVAL_GAIN: f64 = 0.2;

/// Models of the vehicles that are heard, and the trust in all.
#[derive(Debug, Clone)]
pub(super) struct Sensors {
    models: Vec<Option<Box<SensorModel>>>,
    ids: HashMap<NodeName, SensorId>,
    pub(super) fleet: Fleet,
    pub(super) dormant: DormantCounts,
    /// Votes of other cells, also about vehicles that are not heard yet.
    foreign: BTreeMap<NodeName, ForeignVotes>,
}

impl Sensors {
    /// No vehicles.
    pub(super) fn new(reputation: ReputationConfig) -> Self {
        Self {
            models: Vec::new(),
            ids: HashMap::new(),
            fleet: Fleet::new(reputation),
            dormant: DormantCounts::default(),
            foreign: BTreeMap::new(),
        }
    }

    /// The model of a vehicle that reports, created if it is new, and the trust in all.
    pub(super) fn hear(
        &mut self,
        node: &NodeName,
        at: Timestamp,
        config: &TracksConfig,
    ) -> (&mut SensorModel, &mut Fleet) {
        let number = match self.ids.get(node) {
            Some(id) => id.number(),
            None => self
                .models
                .iter()
                .position(Option::is_none)
                .unwrap_or(self.models.len()),
        };
        if number == self.models.len() {
            self.models.push(None);
        }
        let model = self.models[number].get_or_insert_with(|| {
            let id = SensorId(number as u32);
            let counts = self.dormant.of(node);
            self.ids.insert(node.clone(), id);
            self.fleet.set_foreign(
                id,
                self.foreign.get(node).copied().unwrap_or_default(),
                &counts,
            );
            Box::new(SensorModel::new(id, node.clone(), at, counts, config))
        });
        (model, &mut self.fleet)
    }

    /// The model of a vehicle that is heard.
    pub(super) fn get(&self, id: SensorId) -> Option<&SensorModel> {
        self.models.get(id.number())?.as_deref()
    }

    /// The same, mutable.
    pub(super) fn get_mut(&mut self, id: SensorId) -> Option<&mut SensorModel> {
        self.models.get_mut(id.number())?.as_deref_mut()
    }

    /// The model of a vehicle that is heard, by name.
    pub(super) fn by_name(&self, node: &NodeName) -> Option<&SensorModel> {
        self.get(*self.ids.get(node)?)
    }

    /// The models of all vehicles that are heard.
    pub(super) fn iter(&self) -> impl Iterator<Item = &SensorModel> {
        self.models.iter().flatten().map(Box::as_ref)
    }

    /// The same, mutable.
    pub(super) fn iter_mut(&mut self) -> impl Iterator<Item = &mut SensorModel> {
        self.models.iter_mut().flatten().map(Box::as_mut)
    }

    /// Properties of all vehicles that their evidence depends on, by number.
    pub(super) fn qualities(&self) -> Vec<SensorQuality> {
        let quality = |model: &SensorModel| model.quality(self.fleet.trust(model.id));
        self.models
            .iter()
            .map(|slot| slot.as_deref().map(quality).unwrap_or_default())
            .collect()
    }

    /// Takes the counts of all vehicles from a ledger: of the latest votes that are remembered. Vehicles that are not in
    /// it have none.
    pub(super) fn adopt(&mut self, ledger: &ReputationLedger) {
        let config = self.fleet.reputation();
        let votes = ledger
            .remembered(config.memory_votes, |_| 0)
            .into_iter()
            .map(|(node, labels)| {
                let (correct, incorrect) = labels
                    .values()
                    .fold((0.0, 0.0), |sum, votes| (sum.0 + votes.0, sum.1 + votes.1));
                (node, TrustCounts::new(correct, incorrect, config))
            });
        let mut votes: BTreeMap<_, _> = votes.collect();
        for sensor in self.models.iter_mut().flatten() {
            sensor.counts = votes.remove(&sensor.node).unwrap_or_default();
            self.fleet.set_counts(sensor.id, &sensor.counts);
        }
        self.dormant = DormantCounts::default();
        self.dormant.keep(votes);
    }

    /// Takes all votes of other cells.
    pub(super) fn set_foreign(&mut self, votes: BTreeMap<NodeName, ForeignVotes>) {
        self.foreign = votes;
        for sensor in self.models.iter().flatten() {
            let foreign = self.foreign.get(&sensor.node).copied().unwrap_or_default();
            self.fleet.set_foreign(sensor.id, foreign, &sensor.counts);
        }
    }

    /// Counts evidence about vehicles that are heard.
    pub(super) fn learn(&mut self, evidence: &[Evidence]) {
        for Evidence { node, correct, .. } in evidence {
            if let Some(sensor) = self
                .ids
                .get(node)
                .and_then(|id| self.models[id.number()].as_deref_mut())
            {
                self.fleet.count(sensor.id, &mut sensor.counts, *correct);
            }
        }
    }

    /// Forgets the vehicles whose last report is before `limit`, but for their counts; true if there were any.
    pub(super) fn forget_silent(&mut self, limit: Timestamp) -> bool {
        let is_silent = |model: &mut Box<SensorModel>| model.last_report < limit;
        let mut silent = Vec::new();
        for sensor in self
            .models
            .iter_mut()
            .filter_map(|slot| slot.take_if(is_silent))
        {
            self.ids.remove(&sensor.node);
            self.fleet.forget(sensor.id);
            silent.push((sensor.node, sensor.counts));
        }
        let is_any_silent = !silent.is_empty();
        self.dormant.keep(silent);
        is_any_silent
    }
}

/// Learnt properties of one vehicle's sensor.
#[derive(Debug, Clone)]
pub(super) struct SensorModel {
    pub(super) id: SensorId,
    pub(super) node: NodeName,
    last_report: Timestamp,
    /// Fading mean of the time between two reports, seconds; none before the second.
    interval_s: Option<f64>,
    pose: Option<WirePose>,
    /// Place about which the median of its detections stays, metres, and since when.
    place: (Vector2<f64>, Timestamp),
    pub(super) pose_bias: PoseBias,
    pub(super) noise: NoiseModel,
    pub(super) calibration: DetectionCalibration,
    pub(super) coverage: Coverage,
    pub(super) clutter: ClutterRates,
    pub(super) counts: TrustCounts,
}

impl SensorModel {
    fn new(
        id: SensorId,
        node: NodeName,
        at: Timestamp,
        counts: TrustCounts,
        config: &TracksConfig,
    ) -> Self {
        Self {
            id,
            node,
            last_report: at,
            interval_s: None,
            pose: None,
            place: (Vector2::zeros(), at),
            pose_bias: PoseBias::new(at, &config.bias_prior()),
            noise: NoiseModel::default(),
            calibration: DetectionCalibration::new(config.even_confidence),
            coverage: Coverage::default(),
            clutter: ClutterRates::default(),
            counts,
        }
    }

    /// Properties that its evidence of any object depends on, with its trust.
    fn quality(&self, trust: f64) -> SensorQuality {
        let looks_hz = self
            .interval_s
            .map_or(USUAL_LOOKS_HZ, |interval_s| 1.0 / interval_s);
        SensorQuality {
            trust,
            looks_hz,
            even_excess: self.calibration.even_excess(),
        }
    }

    /// Rates at a look, with those of an object.
    pub(super) fn look_rates(&self, object: DetectionRates) -> LookRates {
        LookRates {
            object,
            clutter: self.clutter.rates(),
            is_view_stated: self.coverage.is_stated(),
        }
    }

    /// Updates time, place and field of view from a report; true if the vehicle has jumped to another place.
    pub(super) fn observe(
        &mut self,
        report: &ObjectReport,
        at: Timestamp,
        config: &TracksConfig,
    ) -> bool {
        let passed_s = at.since(self.last_report).as_secs_f64();
        self.last_report = self.last_report.max(at);
        if passed_s > 0.0 {
            let passed_s = passed_s.clamp(MIN_INTERVAL_S, MAX_INTERVAL_S);
            let mean_s = self.interval_s.unwrap_or(passed_s);
            self.interval_s = Some(mean_s + INTERVAL_GAIN * (passed_s - mean_s));
        }
        let is_placed = self.coverage.centre().is_some();
        let has_jumped = self.coverage.observe(report);
        if has_jumped {
            self.pose_bias = PoseBias::new(at, &config.bias_prior());
        }
        let stands = self.stands(report, at);
        self.pose_bias.stand(stands.then_some(passed_s));
        self.pose = report.pose;
        if let Some(centre) = self
            .coverage
            .centre()
            .filter(|_| !stands || !is_placed || has_jumped)
        {
            self.pose_bias.set_pivot(centre);
        }
        has_jumped
    }

    /// True if the vehicle is known to be where it was at the report before. It declares that it does not move, as long as
    /// that agrees with its places. Or it states the same pose: estimates of one that drives, and even waits, differ from
    /// report to report. Or, without a pose, its detections stay about a place for longer than any signal is red.
    fn stands(&mut self, report: &ObjectReport, at: Timestamp) -> bool {
        let (place, since) = self.place;
        let centre = self.coverage.centre().unwrap_or(place);
        let is_declared = report.moving == Some(false);
        let stays = if is_declared && report.pose.is_none() {
            DECLARED_STAYS
        } else {
            STAYS
        };
        if (centre - place).norm() > stays * self.coverage.range_m().max(MIN_RANGE_M) {
            self.place = (centre, at);
        }
        let is_still = match (report.pose, self.pose) {
            (None, None) => at.since(since) > STAYS_FOR,
            (pose, before) => pose == before,
        };
        self.place.1 == since && (is_declared || is_still)
    }
}

/// Scatter of reported positions about their tracks, as a multiple of the stated covariance.
#[derive(Debug, Clone)]
pub(super) struct NoiseModel {
    scale: f64,
    weight: f64,
}

impl Default for NoiseModel {
    fn default() -> Self {
        Self {
            scale: 1.0,
            weight: 30.0,
        }
    }
}

impl NoiseModel {
    /// Weight beyond which older detections are forgotten.
    const MEMORY: f64 = 500.0;

    /// Covariance of a reported position, m².
    pub(super) fn covariance(
        &self,
        object: &PerceivedObject,
        config: &TracksConfig,
    ) -> Matrix2<f64> {
        let floor = Matrix2::identity() * (config.noise_floor_m * config.noise_floor_m);
        stated(object, config).matrix() * self.scale + floor
    }

    /// Learns from the squared distance of a detection from a well-known track, m²; `expected` is the track's part of it.
    pub(super) fn learn(
        &mut self,
        object: &PerceivedObject,
        squared: f64,
        expected: f64,
        config: &TracksConfig,
    ) {
        let stated = stated(object, config);
        let ratio = ((squared - expected) / (stated.xx + stated.yy)).clamp(0.0, 25.0);
        self.weight = (self.weight + 1.0).min(Self::MEMORY);
        self.scale += (ratio - self.scale) / self.weight;
        // A stated covariance is a lower bound.
        let min = if object.covariance_m2.is_some() {
            1.0
        } else {
            0.05
        };
        self.scale = self.scale.max(min);
    }
}

fn stated(object: &PerceivedObject, config: &TracksConfig) -> Covariance {
    object
        .covariance()
        .unwrap_or_else(|| Covariance::isotropic(config.noise_m))
}
