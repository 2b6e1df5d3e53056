//! One report as a scan: the detections of one vehicle at one instant, corrected and with their errors.

use nalgebra::Vector2;

use super::calibration::log_odds;
use super::class::ObjectClass;
use super::config::TracksConfig;
use super::handles::SensorId;
use super::kinematics::Measurement;
use super::occlusion::OcclusionMap;
use super::sensors::SensorModel;
use crate::wire::{ObjectReport, PerceivedObject};

/// Minimum weight of a vehicle's positions. The covariances of the positions are divided by the weight.
const MIN_WEIGHT: f64 = 0.05;

/// A detection of a report, corrected by the estimated pose bias.
#[derive(Debug)]
pub(super) struct ScannedDetection<'a> {
    /// Index into the objects of the report.
    pub(super) index: usize,
    pub(super) object: &'a PerceivedObject,
    pub(super) class: ObjectClass,
    /// Log-odds of the confidence.
    pub(super) log_odds: f64,
    /// Evidence of the confidence by the vehicle's calibration, nats.
    pub(super) confidence_nats: f64,
    /// Position as reported, metres.
    pub(super) reported: Vector2<f64>,
    pub(super) measurement: Measurement,
}

/// The detections of one report.
#[derive(Debug)]
pub(super) struct Scan<'a> {
    pub(super) sensor: SensorId,
    pub(super) report: &'a ObjectReport,
    /// Weight of the vehicle's evidence before the update, 0 to 1.
    pub(super) trust: f64,
    /// Correction of the report's stamp, seconds.
    pub(super) delay_s: f64,
    /// True if the vehicle has jumped to another place, which invalidates its earlier samples.
    pub(super) has_jumped: bool,
    pub(super) detections: Vec<ScannedDetection<'a>>,
    /// Directions that the detections hide. A hidden miss is not a statement of the vehicle; existences use only the
    /// rates.
    pub(super) occlusion: OcclusionMap,
}

impl<'a> Scan<'a> {
    /// The scan of a report. Detections of the vehicle itself are left out.
    pub(super) fn new(
        sensor: &SensorModel,
        report: &'a ObjectReport,
        trust: f64,
        config: &TracksConfig,
    ) -> Self {
        let own = report.pose.map(|pose| Vector2::new(pose.x_m, pose.y_m));
        let correct = sensor.pose_bias.corrector();
        let weight = (trust * sensor.pose_bias.consistency()).max(MIN_WEIGHT);
        let mut occlusion = OcclusionMap::new(sensor.coverage.position());
        let mut detections = Vec::with_capacity(report.objects.len());
        for (index, object) in report.objects.iter().enumerate() {
            let log_odds = log_odds(object.confidence);
            let reported = Vector2::new(object.x_m, object.y_m);
            if own.is_some_and(|own| (own - reported).norm() < config.vehicle_radius_m) {
                continue;
            }
            let confidence_nats = sensor.calibration.nats(log_odds);
            if confidence_nats > 0.0 {
                occlusion.add(object, config.vehicle_radius_m);
            }
            let class = ObjectClass::of(&object.label, config);
            let covariance = sensor.noise.covariance(object, own.as_ref(), config);
            detections.push(ScannedDetection {
                index,
                object,
                class,
                log_odds,
                confidence_nats,
                reported,
                measurement: Measurement {
                    position: correct(&reported),
                    independent: covariance / weight,
                    common_m: class.common_m,
                },
            });
        }
        Self {
            sensor: sensor.id,
            report,
            trust,
            delay_s: 0.0,
            has_jumped: false,
            detections,
            occlusion,
        }
    }

    /// Whether the report changes tracks. Statements of a distrusted vehicle are judged and have no other effect.
    pub(super) fn is_trusted(&self) -> bool {
        self.trust > 0.0
    }
}
