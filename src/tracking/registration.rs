//! Registration: pose biases of vehicles, estimated from objects that other vehicles detect too.
//!
//! An error that all vehicles share is not observable. Updates do not change this error ([`Gauge`]), and it decays.

use std::time::Duration;

use nalgebra::Vector2;

use super::config::TracksConfig;
use super::gauge::Gauge;
use super::handles::{SensorId, TrackIndex};
use super::pose_bias::Correspondence;
use super::sensors::Sensors;
use super::store::TrackStore;
use crate::model::time::Timestamp;

/// Maximum time between two corresponding detections of an object.
const SIMULTANEOUS: Duration = Duration::from_millis(300);

/// Detections of one report, for correspondences with other vehicles.
#[derive(Debug)]
pub(super) struct RegistrationFrame {
    pub(super) sensor: SensorId,
    /// Time of capture: the stamp less `delay_s`, the estimate at that time.
    pub(super) at: Timestamp,
    pub(super) delay_s: f64,
    /// True if the vehicle has jumped to another place, which invalidates its earlier frames.
    pub(super) has_jumped: bool,
    pub(super) samples: Vec<RegistrationSample>,
}

/// One detection of an established track.
#[derive(Debug, Clone, Copy)]
pub(super) struct RegistrationSample {
    pub(super) track: TrackIndex,
    /// Position as the vehicle reported it, metres.
    pub(super) reported: Vector2<f64>,
    /// Variance of the detection in each direction, m².
    pub(super) variance: f64,
}

/// Updates the pose bias of every vehicle that reported, from the frames of a round.
///
/// Uses simultaneous detections only, so that filter lag is not mistaken for pose bias.
pub(super) fn register(
    frames: Vec<RegistrationFrame>,
    tracks: &TrackStore,
    sensors: &mut Sensors,
    config: &TracksConfig,
) {
    let prior = config.bias_prior();
    let mut pairs: Vec<Correspondence> = Vec::new();
    let mut gauge = Gauge::default();
    for frame in frames {
        pairs.clear();
        let samples = frame.samples.iter();
        pairs.extend(
            samples.filter_map(|sample| {
                Correspondence::of(sample, &frame, tracks, sensors, &mut gauge)
            }),
        );
        if let Some(sensor) = sensors.get_mut(frame.sensor) {
            let error = sensor.pose_bias.error();
            let kept = sensor
                .pose_bias
                .observe(frame.at, frame.delay_s, &pairs, &prior);
            gauge.record(frame.sensor, error, kept);
        }
    }
    gauge.hold(sensors, &prior);
}

impl Correspondence {
    /// Compares a detection with the mean of the other vehicles' positions, weighted by trust.
    fn of(
        sample: &RegistrationSample,
        frame: &RegistrationFrame,
        tracks: &TrackStore,
        sensors: &Sensors,
        gauge: &mut Gauge,
    ) -> Option<Self> {
        let track = &tracks[sample.track];
        let velocity = track.state.velocity;
        let mut sum = Vector2::zeros();
        let mut weight = 0.0;
        let mut common = 0.0;
        for other in track
            .seen_by(frame.at - SIMULTANEOUS)
            .filter(|history| history.sensor != frame.sensor)
        {
            let (Some(hit), Some(theirs)) = (other.last_hit, sensors.get(other.sensor)) else {
                continue;
            };
            let passed_us = frame.at.micros_from(hit);
            let trust = sensors.fleet.trust(other.sensor);
            if passed_us.unsigned_abs() > SIMULTANEOUS.as_micros() as u64 || trust <= 0.0 {
                continue;
            }
            sum += (other.position + velocity * (passed_us as f64 * 1e-6)) * trust;
            common += theirs.pose_bias.variance_at(&sample.reported, &velocity) * trust;
            weight += trust;
            gauge.join(frame.sensor, other.sensor);
        }
        (weight > 0.0).then(|| Self {
            reported: sample.reported,
            reference: sum / weight,
            velocity,
            variance: sample.variance * (1.0 + 1.0 / weight),
            common: common / weight,
            of_object: 2.0 * track.state.class.common_m.powi(2),
        })
    }
}
