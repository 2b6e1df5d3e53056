//! Gauge of the registration: a shift, a rotation and a delay that the errors of all observers have in common.
//!
//! Observers find their errors relative to each other. A motion of all together changes no residual, so nothing but
//! unequal gains decides on it, and it would wander without end. Therefore a round leaves the common motion of
//! observers that correspond, directly or through others, as it was. It only fades with the mean of the errors: those of
//! observers that leave or join do not move the map at once. If each faded by itself, those that last would take over
//! the errors of those that fade.

use nalgebra::{Matrix3, Vector2, Vector3, Vector4};

use super::handles::SensorId;
use super::pose_bias::BiasPrior;
use super::sensors::{SensorModel, Sensors};

/// Errors before a round, and the groups of observers that correspond.
#[derive(Debug, Default)]
pub(super) struct Gauge {
    /// By sensor: the next one towards the representative of its group.
    towards: Vec<usize>,
    /// By sensor that reported: its error before, and the part of an error that is left after that time.
    before: Vec<Option<(Vector4<f64>, f64)>>,
}

impl Gauge {
    /// Puts two observers into one group.
    pub(super) fn join(&mut self, one: SensorId, other: SensorId) {
        let one = self.group(one.number());
        let other = self.group(other.number());
        self.towards[one] = other;
    }

    /// Notes an observer's error before it is estimated anew, and the part of it that is left after that time.
    pub(super) fn note(&mut self, sensor: SensorId, error: Vector4<f64>, kept: f64) {
        self.group(sensor.number());
        self.before[sensor.number()].get_or_insert((error, 1.0)).1 *= kept;
    }

    /// Takes the common motion of each group back.
    pub(super) fn hold(mut self, sensors: &mut Sensors, prior: &BiasPrior) {
        let known = self.towards.len();
        let observers = || sensors.iter().filter(|sensor| sensor.id.number() < known);
        let weight =
            |sensor: &SensorModel| sensors.fleet.trust(sensor.id) * sensor.pose_bias.weight(prior);
        // Those that were silent have not faded yet.
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
        let mut sums = vec![MotionSums::default(); known];
        for sensor in observers() {
            let group = self.group(sensor.id.number());
            let pose_bias = &sensor.pose_bias;
            let kept = kept[group].0 / kept[group].1.max(f64::MIN_POSITIVE);
            let (error, _) = before(&self.before, sensor);
            sums[group].add(
                &pose_bias.pivot(),
                &(pose_bias.error() - error * kept),
                weight(sensor),
                prior,
            );
        }
        let common: Vec<Option<Motion>> = sums.iter().map(MotionSums::motion).collect();
        for sensor in sensors
            .iter_mut()
            .filter(|sensor| sensor.id.number() < known)
        {
            if let Some(common) = &common[self.group(sensor.id.number())] {
                let part = common.at(&sensor.pose_bias.pivot());
                sensor.pose_bias.take_back(&part, prior);
            }
        }
    }

    /// The representative of an observer's group. Halves the way to it.
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

/// Shift, rotation and delay of all observers together.
#[derive(Debug)]
struct Motion {
    about: Vector2<f64>,
    shift: Vector2<f64>,
    rotation_rad: f64,
    delay_s: f64,
}

impl Motion {
    /// Its part of the error of an observer: offset, rotation and delay.
    fn at(&self, pivot: &Vector2<f64>) -> Vector4<f64> {
        let offset = self.shift + quarter_turn(&(pivot - self.about)) * self.rotation_rad;
        Vector4::new(offset.x, offset.y, self.rotation_rad, self.delay_s)
    }
}

/// Weighted sums for the motion that is nearest to the changes of a group, in standard deviations of the errors.
#[derive(Debug, Clone, Default)]
struct MotionSums {
    about: Option<Vector2<f64>>,
    normal: Matrix3<f64>,
    gradient: Vector3<f64>,
    delay_s: f64,
    weight: f64,
}

impl MotionSums {
    fn add(&mut self, pivot: &Vector2<f64>, change: &Vector4<f64>, weight: f64, prior: &BiasPrior) {
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
        let turned = both.dot(&change.xy()) + rotation * change.z;
        self.gradient += Vector3::new(offset * change.x, offset * change.y, turned);
        self.delay_s += weight * change.w;
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

fn quarter_turn(offset: &Vector2<f64>) -> Vector2<f64> {
    Vector2::new(-offset.y, offset.x)
}
