//! Owner of the sensor models: the estimated properties of each vehicle. The only module that creates a [`SensorId`].

use std::collections::BTreeMap;
use std::time::Duration;

use hashbrown::HashMap;
use nalgebra::{Matrix2, Vector2};

use super::calibration::DetectionCalibration;
use super::config::TracksConfig;
use super::coverage::Coverage;
use super::existence::{DetectionRates, ObservationRates, ObservationState};
use super::fading_mean::FadingMean;
use super::handles::SensorId;
use super::population::{Births, LeavingRates, Population};
use super::pose_bias::PoseBias;
use super::trust::{DormantCounts, Fleet, TrustCounts};
use crate::model::names::NodeName;
use crate::model::time::Timestamp;
use crate::reputation::{Evidence, ReputationConfig, ReputationLedger};
use crate::wire::{ObjectReport, PerceivedObject, WirePose};

/// Maximum distance of a standing vehicle from its earlier position, as a share of its range. Without a pose, the
/// position is the median of its detections.
const STAYS: f64 = 0.25;
/// Maximum distance of the median for a vehicle that declares to stand, because its detections appear and disappear.
const DECLARED_STAYS: f64 = 1.0;
/// Lower bound of the range in this comparison, metres, because the range shrinks without detections.
const MIN_RANGE_M: f64 = 10.0;

/// Time after which a vehicle without a pose whose detections stay in place counts as standing.
const STAYS_FOR: Duration = Duration::from_secs(120);

/// The positions that a vehicle reports are judged if the consistency of its pose errors with the errors of most other
/// vehicles is below this value.
const MIN_CONSISTENCY: f64 = 0.1;

/// Normalised squared error, of two dimensions, that 1 % of the places exceed.
const CERTAIN_SQUARED: f64 = 9.21;

/// Models of all vehicles that report, and their trust.
#[derive(Debug, Clone)]
pub(super) struct Sensors {
    models: Vec<Option<Box<SensorModel>>>,
    ids: HashMap<NodeName, SensorId>,
    pub(super) fleet: Fleet,
    pub(super) dormant: DormantCounts,
}

impl Sensors {
    /// A store without vehicles.
    pub(super) fn new(reputation: ReputationConfig) -> Self {
        Self {
            models: Vec::new(),
            ids: HashMap::new(),
            fleet: Fleet::new(reputation),
            dormant: DormantCounts::default(),
        }
    }

    /// The model of a reporting vehicle, created for a new vehicle, and the fleet.
    pub(super) fn receive(
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
            self.fleet.set_counts(id, &counts);
            Box::new(SensorModel::new(id, node.clone(), at, counts, config))
        });
        (model, &mut self.fleet)
    }

    /// The model of a reporting vehicle.
    pub(super) fn get(&self, id: SensorId) -> Option<&SensorModel> {
        self.models.get(id.number())?.as_deref()
    }

    /// The model of a reporting vehicle, mutable.
    pub(super) fn get_mut(&mut self, id: SensorId) -> Option<&mut SensorModel> {
        self.models.get_mut(id.number())?.as_deref_mut()
    }

    /// The model of a reporting vehicle, mutable, and the fleet.
    pub(super) fn with_fleet(&mut self, id: SensorId) -> Option<(&mut SensorModel, &mut Fleet)> {
        let model = self.models.get_mut(id.number())?.as_deref_mut()?;
        Some((model, &mut self.fleet))
    }

    /// The model of a reporting vehicle, by name.
    pub(super) fn by_name(&self, node: &NodeName) -> Option<&SensorModel> {
        self.get(*self.ids.get(node)?)
    }

    /// The models of all reporting vehicles.
    pub(super) fn iter(&self) -> impl Iterator<Item = &SensorModel> {
        self.models.iter().flatten().map(Box::as_ref)
    }

    /// The models of all reporting vehicles, mutable.
    pub(super) fn iter_mut(&mut self) -> impl Iterator<Item = &mut SensorModel> {
        self.models.iter_mut().flatten().map(Box::as_mut)
    }

    /// Adopts the counts of all vehicles from a ledger, limited to its latest votes. Vehicles missing in the ledger start
    /// without counts.
    pub(super) fn adopt(&mut self, ledger: &ReputationLedger) {
        let config = self.fleet.reputation();
        let mut votes: BTreeMap<NodeName, TrustCounts> = ledger
            .latest(config.memory_votes)
            .into_iter()
            .map(|(node, (correct, incorrect))| {
                (node.clone(), TrustCounts::new(correct, incorrect, config))
            })
            .collect();
        for sensor in self.models.iter_mut().flatten() {
            sensor.counts = votes.remove(&sensor.node).unwrap_or_default();
            self.fleet.set_counts(sensor.id, &sensor.counts);
        }
        self.dormant = DormantCounts::default();
        self.dormant.keep(votes);
    }

    /// Counts evidence about reporting vehicles.
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

    /// Counts whether a track that a vehicle began became an object.
    pub(super) fn settle(&mut self, spawned_by: Option<SensorId>, is_object: bool) {
        if let Some(sensor) = spawned_by.and_then(|vehicle| self.get_mut(vehicle)) {
            sensor.births.settle(is_object);
        }
    }

    /// Rates at which objects leave; undetected ones also leave after a mean time of `life_s` seconds.
    pub(super) fn leaving(&self, life_s: f64) -> LeavingRates {
        let leaving_hz = Population::leaving_hz(self.iter().map(|sensor| &sensor.population));
        LeavingRates::new(leaving_hz, life_s)
    }

    /// Sets the pose biases of all vehicles to zero.
    pub(super) fn reset_pose_biases(&mut self, at: Timestamp, config: &TracksConfig) {
        for sensor in self.iter_mut() {
            sensor.pose_bias = PoseBias::new(at, &config.bias_prior());
        }
    }

    /// Removes the vehicles whose last report is before `limit`, and keeps their counts; true if a vehicle was removed.
    pub(super) fn drop_silent(&mut self, limit: Timestamp) -> bool {
        let is_silent = |model: &mut Box<SensorModel>| model.last_report < limit;
        let mut silent = Vec::new();
        for sensor in self
            .models
            .iter_mut()
            .filter_map(|slot| slot.take_if(is_silent))
        {
            self.ids.remove(&sensor.node);
            self.fleet.remove(sensor.id);
            silent.push((sensor.node, sensor.counts));
        }
        let is_any_silent = !silent.is_empty();
        self.dormant.keep(silent);
        is_any_silent
    }
}

/// Estimated properties of one vehicle's sensor.
#[derive(Debug, Clone)]
pub(super) struct SensorModel {
    pub(super) id: SensorId,
    pub(super) node: NodeName,
    last_report: Timestamp,
    pose: Option<WirePose>,
    /// Position about which the median of the vehicle's detections stays, metres, and since when.
    place: (Vector2<f64>, Timestamp),
    pub(super) pose_bias: PoseBias,
    pub(super) noise: NoiseModel,
    pub(super) calibration: DetectionCalibration,
    pub(super) coverage: Coverage,
    pub(super) clutter: DetectionRates,
    pub(super) births: Births,
    /// Time for which the objects stay whose tracks the vehicle began.
    pub(super) population: Population,
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
            pose: None,
            place: (Vector2::zeros(), at),
            pose_bias: PoseBias::new(at, &config.bias_prior()),
            noise: NoiseModel::default(),
            calibration: DetectionCalibration::new(config.even_confidence),
            coverage: Coverage::default(),
            clutter: DetectionRates::clutter(),
            births: Births::default(),
            population: Population::default(),
            counts,
        }
    }

    /// Rates at an observation of a reported position in this state; `None` outside the field of view.
    pub(super) fn observation_rates(
        &self,
        reported: &Vector2<f64>,
        state: ObservationState,
    ) -> Option<ObservationRates> {
        let object = self.coverage.rates_at(reported)?;
        Some(self.rates(object, state))
    }

    /// Rates at a detection in this state, which may be outside the field of view.
    pub(super) fn hit_rates(
        &self,
        reported: &Vector2<f64>,
        state: ObservationState,
    ) -> ObservationRates {
        self.observation_rates(reported, state)
            .unwrap_or_else(|| self.rates_out_of_view(state))
    }

    /// Rates at a detection in this state outside the field of view.
    pub(super) fn rates_out_of_view(&self, state: ObservationState) -> ObservationRates {
        self.rates(&DetectionRates::object(), state)
    }

    /// Rates at an observation in this state, by the detection rates of objects at its place.
    pub(super) fn rates(
        &self,
        object: &DetectionRates,
        state: ObservationState,
    ) -> ObservationRates {
        ObservationRates {
            object: object.rate(state),
            clutter: self.clutter.rate(state),
            has_pose: self.coverage.position().is_some(),
        }
    }

    /// True if a reported position is wrong by more than the vehicle states, and the vehicle's pose errors disagree
    /// with the errors of most other vehicles.
    pub(super) fn shifts(&self, object: &PerceivedObject, config: &TracksConfig) -> bool {
        let Some(stated) = object.covariance() else {
            return false;
        };
        let reported = Vector2::new(object.x_m, object.y_m);
        let error = self.pose_bias.corrector()(&reported) - reported;
        let variance =
            stated.matrix().trace() / 2.0 + config.noise_floor_m.powi(2) + config.common_m.powi(2);
        self.pose_bias.consistency() < MIN_CONSISTENCY
            && error.norm_squared() > CERTAIN_SQUARED * variance
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

    /// True if the vehicle stands. It declares that it does not move, and its positions agree with this. Or it repeats
    /// one pose: estimates of a moving or waiting vehicle differ from report to report. Or it has no pose, and its
    /// detections have stayed about one position for longer than any red traffic light.
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

/// Noise of a vehicle's positions, estimated by distance along and across the line of sight.
///
/// Reported covariances are scaled by an estimate: the ratio of the squared residuals to the reported covariance.
/// Without reported covariances, the variances themselves are estimated, from a prior that grows with the distance.
#[derive(Debug, Clone, Default)]
pub(super) struct NoiseModel {
    scale: FadingMean,
    bins: [NoiseBin; Self::BINS],
}

/// Variances at one distance, m².
#[derive(Debug, Clone, Copy, Default)]
struct NoiseBin {
    along: FadingMean,
    across: FadingMean,
}

/// Residual of a detection from its track.
#[derive(Debug, Clone, Copy)]
pub(super) struct Residual {
    /// Measured less estimated position, metres.
    pub(super) offset: Vector2<f64>,
    /// Variance of the estimate in each direction, m²: positive if the detection contributed to the estimate.
    pub(super) variance: f64,
}

impl NoiseModel {
    /// Bins of distance and their width in metres.
    const BINS: usize = 6;
    const BIN_M: f64 = 10.0;

    /// Number of residuals as which the prior counts.
    const PRIOR: f64 = 30.0;

    /// Increase of the prior's standard deviation with the distance, and the share of it across the line of sight.
    const PER_METRE: f64 = 0.012;
    const ACROSS: f64 = 0.5;

    /// Maximum ratio of a squared residual to the present variance for a residual to be used.
    const MAX_RATIO: f64 = 16.0;

    /// Variances along and across the line of sight at a distance, m².
    fn variances(&self, distance_m: f64, config: &TracksConfig) -> [f64; 2] {
        let prior = |share: f64| (config.noise_m + share * Self::PER_METRE * distance_m).powi(2);
        let NoiseBin { along, across } = &self.bins[Self::bin(distance_m)];
        [
            along.mean_with(prior(1.0), Self::PRIOR),
            across.mean_with(prior(Self::ACROSS), Self::PRIOR),
        ]
    }

    fn bin(distance_m: f64) -> usize {
        ((distance_m / Self::BIN_M) as usize).min(Self::BINS - 1)
    }

    /// Ratio of the squared residuals to the stated covariance, which is a lower bound.
    fn scale(&self) -> f64 {
        self.scale.mean_with(1.0, Self::PRIOR).max(1.0)
    }

    /// Covariance of a reported position, m², of a vehicle at `origin`.
    pub(super) fn covariance(
        &self,
        object: &PerceivedObject,
        origin: Option<&Vector2<f64>>,
        config: &TracksConfig,
    ) -> Matrix2<f64> {
        let floor = Matrix2::identity() * (config.noise_floor_m * config.noise_floor_m);
        if let Some(stated) = object.covariance() {
            return stated.matrix() * self.scale() + floor;
        }
        let Some(origin) = origin else {
            let [along, across] = self.variances(0.0, config);
            return Matrix2::identity() * ((along + across) / 2.0) + floor;
        };
        let offset = Vector2::new(object.x_m, object.y_m) - origin;
        let [along, across] = self.variances(offset.norm(), config);
        let sight = sight(&offset);
        Matrix2::identity() * across + sight * sight.transpose() * (along - across) + floor
    }

    /// Updates the noise with the residual of a detection of a certain track.
    pub(super) fn learn(
        &mut self,
        object: &PerceivedObject,
        origin: Option<&Vector2<f64>>,
        residual: &Residual,
        config: &TracksConfig,
    ) {
        let bounded = |squared: f64, mean: f64| {
            (squared + residual.variance).clamp(0.0, Self::MAX_RATIO * mean)
        };
        let offset = &residual.offset;
        if let Some(stated) = object.covariance() {
            let stated = (stated.xx + stated.yy) / 2.0;
            let squared = bounded(offset.norm_squared() / 2.0, self.scale() * stated);
            if stated > 0.0 {
                self.scale.add(squared / stated, 1.0);
            }
            return;
        }
        let from = origin.map(|origin| Vector2::new(object.x_m, object.y_m) - origin);
        let distance_m = from.map_or(0.0, |from| from.norm());
        let squares = match from.map(|from| sight(&from)) {
            Some(sight) => [sight.dot(offset).powi(2), sight.perp(offset).powi(2)],
            None => [offset.norm_squared() / 2.0; 2],
        };
        let variances = self.variances(distance_m, config);
        let NoiseBin { along, across } = &mut self.bins[Self::bin(distance_m)];
        along.add(bounded(squares[0], variances[0]), 1.0);
        across.add(bounded(squares[1], variances[1]), 1.0);
    }
}

/// Unit vector of a line of sight.
fn sight(offset: &Vector2<f64>) -> Vector2<f64> {
    offset.try_normalize(1e-6).unwrap_or_else(Vector2::x)
}
