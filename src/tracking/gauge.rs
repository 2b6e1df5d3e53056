//! Gauge of the registration: a shift, a rotation and a delay that the errors of all observers have in common.
//!
//! Observers estimate their errors relative to each other. A motion common to all observers changes no residual and would
//! drift because of unequal gains. A round therefore keeps the mean error of each connected group (observers that
//! correspond, directly or through others) and lets only this mean decay, so that an observer that joins or leaves does
//! not shift the map at once. If each error decayed separately, the remaining observers would take over the errors of the
//! others. The mean of a group is the [`Consensus`] of most observers, which excludes the errors of a minority.

use nalgebra::{Matrix3, Vector2, Vector3, Vector4};

use super::handles::SensorId;
use super::pose_bias::BiasPrior;
use super::sensors::{SensorModel, Sensors};

/// Errors before a round, and the groups of observers that correspond.
#[derive(Debug, Default)]
pub(super) struct Gauge {
    /// By sensor: the next one towards the representative of its group.
    towards: Vec<usize>,
    /// By sensor that reported: its error before the round, and the part of an error that remains after decay.
    before: Vec<Option<(Vector4<f64>, f64)>>,
}

impl Gauge {
    /// Puts two observers into one group.
    #[inline]
    pub(super) fn join(&mut self, one: SensorId, other: SensorId) {
        let [one, other] = [one, other].map(SensorId::number);
        let towards = [self.towards.get(one), self.towards.get(other)];
        // Most pairs correspond in every report; only the first time needs a search.
        if !matches!(towards, [Some(one), Some(other)] if one == other) {
            self.unite(one, other);
        }
    }

    fn unite(&mut self, one: usize, other: usize) {
        let one = self.group(one);
        let other = self.group(other);
        self.towards[one] = other;
    }

    /// Records an observer's error before the estimate is updated, and the part of it that remains after decay.
    pub(super) fn record(&mut self, sensor: SensorId, error: Vector4<f64>, kept: f64) {
        self.group(sensor.number());
        self.before[sensor.number()].get_or_insert((error, 1.0)).1 *= kept;
    }

    /// Removes the change of the common motion of each group.
    pub(super) fn hold(mut self, sensors: &mut Sensors, prior: &BiasPrior) {
        let known = self.towards.len();
        let observers = || sensors.iter().filter(|sensor| sensor.id.number() < known);
        let weight =
            |sensor: &SensorModel| sensors.fleet.trust(sensor.id) * sensor.pose_bias.weight(prior);
        // The errors of observers without a report have not decayed yet.
        let before = |before: &[Option<(Vector4<f64>, f64)>], sensor: &SensorModel| {
            before[sensor.id.number()].unwrap_or((sensor.pose_bias.error(), 1.0))
        };
        let mut kept = vec![(0.0, 0.0); known];
        for sensor in observers() {
            let group = self.group(sensor.id.number());
            let weight = weight(sensor);
            let (_, of_sensor) = before(&self.before, sensor);
            kept[group] = (kept[group].0 + weight * of_sensor, kept[group].1 + weight);
        }
        let mut members: Vec<Vec<GroupMember>> = vec![Vec::new(); known];
        for sensor in observers() {
            let group = self.group(sensor.id.number());
            let kept = kept[group].0 / kept[group].1.max(f64::MIN_POSITIVE);
            let (error, _) = before(&self.before, sensor);
            members[group].push(GroupMember {
                sensor: sensor.id,
                pivot: sensor.pose_bias.pivot(),
                before: error * kept,
                after: sensor.pose_bias.error(),
                trust: sensors.fleet.trust(sensor.id),
                weight: weight(sensor),
            });
        }
        for members in members.iter().filter(|members| members.len() > 1) {
            let before = Consensus::of(members, |member| member.before, prior);
            let after = Consensus::of(members, |member| member.after, prior);
            let (Some(before), Some(after)) = (before, after) else {
                continue;
            };
            let common = after.motion.less(&before.motion);
            for (number, member) in members.iter().enumerate() {
                if let Some(sensor) = sensors.get_mut(member.sensor) {
                    let part = common.at(&member.pivot);
                    sensor.pose_bias.take_back(&part, prior);
                    if let Some(consistency) = after.consistencies.get(number) {
                        sensor.pose_bias.set_consistency(*consistency);
                    }
                }
            }
        }
    }

    /// The representative of an observer's group. Halves the path to it.
    fn group(&mut self, mut sensor: usize) -> usize {
        let known = self.towards.len();
        if sensor >= known {
            self.towards.extend(known..=sensor);
            self.before.resize(sensor + 1, None);
        }
        while self.towards[sensor] != sensor {
            self.towards[sensor] = self.towards[self.towards[sensor]];
            sensor = self.towards[sensor];
        }
        sensor
    }
}

/// One observer of a group in a round.
#[derive(Debug, Clone)]
struct GroupMember {
    sensor: SensorId,
    pivot: Vector2<f64>,
    /// Error before the round, decayed, and after the round.
    before: Vector4<f64>,
    after: Vector4<f64>,
    /// Weight in the choice of the majority; standing vehicles have no higher weight here.
    trust: f64,
    /// Weight in the estimate of the common motion.
    weight: f64,
}

/// Shift, rotation and delay of all observers together.
#[derive(Debug)]
struct Motion {
    about: Vector2<f64>,
    shift: Vector2<f64>,
    rotation_rad: f64,
    delay_s: f64,
}

/// The common motion of most observers of a group.
#[derive(Debug)]
struct Consensus {
    motion: Motion,
    /// By member, how well its error agrees with the motion: 0 to 1; empty without a majority.
    consistencies: Vec<f64>,
}

impl Consensus {
    /// Minimum number of observers for a majority.
    const MIN_MEMBERS: usize = 3;

    /// Number of reweighting steps.
    const ITERATIONS: usize = 20;

    /// Minimum of the median residual, in standard deviations of the errors.
    const MIN_MEDIAN: f64 = 0.05;

    /// Residual in robust standard deviations at which the weight of an observer falls to 1/e.
    const OUTLYING: f64 = 2.5;

    /// The consensus on errors; `None` without weight.
    ///
    /// Reweighted least squares (Rousseeuw, Leroy, "Robust Regression and Outlier Detection", 1987, chapter 5): a fit that
    /// a minority cannot move, here Huber's M-estimate with the median of the residuals as scale, then least squares
    /// with weights by the residuals from that fit. Errors within the group's usual spread therefore weigh nearly the same.
    fn of(
        members: &[GroupMember],
        error: impl Fn(&GroupMember) -> Vector4<f64>,
        prior: &BiasPrior,
    ) -> Option<Self> {
        let fit = |weights: &[f64]| {
            let mut sums = MotionSums::default();
            for (member, weight) in members.iter().zip(weights) {
                sums.add(&member.pivot, &error(member), *weight, prior);
            }
            sums.motion()
        };
        let trusted = members.iter().filter(|member| member.trust > 0.0).count();
        if trusted < Self::MIN_MEMBERS {
            let weights: Vec<f64> = members.iter().map(|member| member.weight).collect();
            return Some(Self {
                motion: fit(&weights)?,
                consistencies: Vec::new(),
            });
        }
        let mut weights: Vec<f64> = members.iter().map(|member| member.trust).collect();
        let mut residuals = vec![0.0; members.len()];
        let mut sorted = Vec::with_capacity(members.len());
        let mut median = 0.0;
        for _ in 0..Self::ITERATIONS {
            let motion = fit(&weights)?;
            for (residual, member) in residuals.iter_mut().zip(members) {
                *residual = prior.deviations(&(error(member) - motion.at(&member.pivot)));
            }
            median = weighted_median(members, &residuals, &mut sorted).max(Self::MIN_MEDIAN);
            for ((weight, residual), member) in weights.iter_mut().zip(&residuals).zip(members) {
                *weight = member.trust * (median / residual).min(1.0);
            }
        }
        let scale = Self::OUTLYING * deviation(median, trusted);
        let consistencies: Vec<f64> = residuals
            .iter()
            .map(|residual| (-(residual / scale).powi(2)).exp())
            .collect();
        for ((weight, consistency), member) in weights.iter_mut().zip(&consistencies).zip(members) {
            *weight = consistency * member.weight;
        }
        Some(Self {
            motion: fit(&weights)?,
            consistencies,
        })
    }
}

/// Standard deviation by the median of so many residuals, with the correction for few of them (Rousseeuw, Leroy 1987,
/// section 5.1).
fn deviation(median: f64, residuals: usize) -> f64 {
    1.4826 * (1.0 + 5.0 / (residuals as f64 - 1.0)) * median
}

impl Motion {
    /// The change from an earlier motion to this motion about the same point.
    fn less(&self, before: &Self) -> Self {
        Self {
            about: self.about,
            shift: self.shift - before.shift,
            rotation_rad: self.rotation_rad - before.rotation_rad,
            delay_s: self.delay_s - before.delay_s,
        }
    }

    /// The part of this motion in the error of an observer: offset, rotation and delay.
    fn at(&self, pivot: &Vector2<f64>) -> Vector4<f64> {
        let offset = self.shift + quarter_turn(&(pivot - self.about)) * self.rotation_rad;
        Vector4::new(offset.x, offset.y, self.rotation_rad, self.delay_s)
    }
}

/// Weighted sums for the motion that is nearest to the errors of a group, in standard deviations of the errors.
#[derive(Debug, Clone, Default)]
struct MotionSums {
    about: Option<Vector2<f64>>,
    normal: Matrix3<f64>,
    gradient: Vector3<f64>,
    delay_s: f64,
    weight: f64,
}

impl MotionSums {
    /// Adds the error of one observer at the place `pivot`.
    fn add(&mut self, pivot: &Vector2<f64>, error: &Vector4<f64>, weight: f64, prior: &BiasPrior) {
        let arm = quarter_turn(&(pivot - *self.about.get_or_insert(*pivot)));
        let offset = weight / (prior.offset_m * prior.offset_m);
        let rotation = weight / (prior.heading_rad * prior.heading_rad);
        let both = arm * offset;
        self.normal += Matrix3::new(
            offset,
            0.0,
            both.x,
            0.0,
            offset,
            both.y,
            both.x,
            both.y,
            both.dot(&arm) + rotation,
        );
        let turned = both.dot(&error.xy()) + rotation * error.z;
        self.gradient += Vector3::new(offset * error.x, offset * error.y, turned);
        self.delay_s += weight * error.w;
        self.weight += weight;
    }

    /// The motion; `None` without weight.
    fn motion(&self) -> Option<Motion> {
        let solution = self.normal.try_inverse()? * self.gradient;
        Some(Motion {
            about: self.about?,
            shift: solution.xy(),
            rotation_rad: solution.z,
            delay_s: self.delay_s / self.weight,
        })
    }
}

/// Median of the residuals, weighted by the trust in the members; `sorted` is a buffer.
fn weighted_median(
    members: &[GroupMember],
    residuals: &[f64],
    sorted: &mut Vec<(f64, f64)>,
) -> f64 {
    sorted.clear();
    let trusts = members.iter().map(|member| member.trust);
    sorted.extend(residuals.iter().copied().zip(trusts));
    sorted.sort_by(|a, b| a.0.total_cmp(&b.0));
    let half = sorted.iter().map(|(_, weight)| weight).sum::<f64>() / 2.0;
    let mut below = 0.0;
    let median = sorted.iter().find(|(_, weight)| {
        below += weight;
        below >= half
    });
    median.map_or(0.0, |(residual, _)| *residual)
}

fn quarter_turn(offset: &Vector2<f64>) -> Vector2<f64> {
    Vector2::new(-offset.y, offset.x)
}
