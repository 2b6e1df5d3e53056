//! Objects of received messages.

use std::collections::BTreeMap;

use c_its_parser::standards::cdd_2_2_1::etsi_its_cdd as cdd;
use c_its_parser::standards::cpm_2_1_1::cpm_pdu_descriptions as pdu;
use c_its_parser::standards::cpm_2_1_1::cpm_perceived_object_container::PerceivedObjectContainer;
use ecod::model::geometry::Covariance;
use ecod::model::names::Label;
use ecod::model::origin::GeographicOrigin;
use ecod::model::time::Timestamp;
use ecod::wire::{Limits, PerceivedObject};

use super::frame::MessageFrame;
use super::{
    COORDINATES_CM, CpmError, ITS_EPOCH_MS, MAX_BYTES, MESSAGE_ID, PROTOCOL_VERSION, ReceivedCpm,
    SIGMAS, UNSTATED_COORDINATE, classes,
};

/// Confidence of an object for which the station states none.
const UNSTATED_CONFIDENCE: f64 = 0.5;

/// Half width in metres of a coordinate's interval if the station states none: wide, so that other
/// reports have more weight.
const UNSTATED_HALF_WIDTH_M: f64 = 10.0;

/// Maximum time in milliseconds between a measurement and the reference time: the longest period of
/// messages. An object that was not measured for longer is an extrapolation of the station, and the
/// report would give it a new date.
const MAX_DELTA_MS: u16 = 1000;

/// Code of a speed's confidence that is out of range: the standard calls such a speed not valid.
const WIDE_SPEED: u8 = 126;

/// The objects of a message in the frame of a cell.
///
/// # Errors
/// Returns a [`CpmError`] if the bytes are not a CPM, or the message is not from the neighbourhood.
pub fn decode(bytes: &[u8], origin: &GeographicOrigin) -> Result<ReceivedCpm, CpmError> {
    if bytes.len() > MAX_BYTES {
        return Err(CpmError::TooLarge);
    }
    // The header first: other messages begin with the same.
    if !matches!(bytes, [PROTOCOL_VERSION, MESSAGE_ID, ..]) {
        return Err(CpmError::OtherMessage);
    }
    let message: pdu::CollectivePerceptionMessage = uper(bytes)?;
    let management = &message.payload.management_container;
    let time_ms = ITS_EPOCH_MS + management.reference_time.0;
    let frame = MessageFrame::of(origin, &management.reference_position)?;
    let position_error =
        frame.position_error(&management.reference_position.position_confidence_ellipse)?;
    let segment = management.segmentation_info.as_ref();
    let mut objects = Vec::new();
    let mut all = 0;
    for container in &message.payload.cpm_containers.0.0 {
        if container.container_id == pdu::PERCEIVED_OBJECT_CONTAINER {
            let container: PerceivedObjectContainer = uper(container.container_data.as_bytes())?;
            let listed = container.perceived_objects.0;
            all += listed.len();
            objects.extend(
                listed
                    .iter()
                    .filter_map(|object| perceived(object, &frame, position_error)),
            );
            if objects.len() > Limits::default().objects {
                return Err(CpmError::TooManyObjects);
            }
        }
    }
    Ok(ReceivedCpm {
        station_id: message.header.station_id.0,
        captured_at: Timestamp(time_ms * 1000),
        segment: segment.map(|segment| (segment.this_msg_no.0, segment.total_msg_no.0)),
        left_out: all - objects.len(),
        objects,
    })
}

fn uper<T: rasn::Decode>(bytes: &[u8]) -> Result<T, CpmError> {
    rasn::uper::decode(bytes).map_err(|_| CpmError::Malformed)
}

/// An object at the reference time; `None` without a usable place.
fn perceived(
    object: &cdd::PerceivedObject,
    frame: &MessageFrame,
    position_error: Covariance,
) -> Option<PerceivedObject> {
    let velocity = object.velocity.as_ref().and_then(velocity);
    let delta_ms = object.measurement_delta_time.0;
    if delta_ms.unsigned_abs() > MAX_DELTA_MS {
        return None;
    }
    let late_s = f64::from(delta_ms) / 1000.0;
    let [east_mps, north_mps] = velocity.unwrap_or_default();
    let east = &object.position.x_coordinate;
    let north = &object.position.y_coordinate;
    let [x_m, y_m] = frame.to_cell([
        metres(east)? - east_mps * late_s,
        metres(north)? - north_mps * late_s,
    ]);
    let covariance = frame.variances_to_cell([variance(east), variance(north)]) + position_error;
    let classes = object.classification.iter().flat_map(|classes| &classes.0);
    let mut scores = BTreeMap::<Label, f64>::new();
    let mut first = None;
    for class in classes {
        let label = classes::label(&class.object_class);
        first = first.or(Some(label));
        if class.confidence.0 <= 100 {
            let score = scores.entry(label.into()).or_default();
            *score = (*score + f64::from(class.confidence.0) / 100.0).min(1.0);
        }
    }
    let best = scores
        .iter()
        .max_by(|a, b| a.1.total_cmp(b.1))
        .map(|(label, score)| (label.clone(), *score));
    let (label, score) = best.unzip();
    let quality = object
        .object_perception_quality
        .as_ref()
        .map(|quality| f64::from(quality.0) / 15.0);
    let angle = object
        .angles
        .as_ref()
        .and_then(|angles| radians(&angles.z_angle));
    let size = object
        .object_dimension_x
        .as_ref()
        .and_then(dimension)
        .zip(object.object_dimension_y.as_ref().and_then(dimension));
    let confidence = quality.or(score).unwrap_or(UNSTATED_CONFIDENCE);
    let label = label.unwrap_or_else(|| first.unwrap_or("object").into());
    Some(PerceivedObject {
        covariance_m2: Some(covariance.into()),
        velocity_mps: velocity.map(|velocity| frame.velocity_to_cell(velocity)),
        heading_rad: angle.map(|angle| frame.heading_to_cell(angle)),
        size_m: size.map(|(length, width)| [length, width]),
        scores,
        ..PerceivedObject::new(label, confidence, x_m, y_m)
    })
}

/// A coordinate in metres; `None` for the out-of-range codes.
fn metres(coordinate: &cdd::CartesianCoordinateWithConfidence) -> Option<f64> {
    let centimetres = coordinate.value.0;
    COORDINATES_CM
        .contains(&centimetres)
        .then(|| f64::from(centimetres) / 100.0)
}

/// Variance of a coordinate in m². More than 40.94 m counts as 40.95 m.
fn variance(coordinate: &cdd::CartesianCoordinateWithConfidence) -> f64 {
    let half_width_m = match coordinate.confidence.0 {
        UNSTATED_COORDINATE => UNSTATED_HALF_WIDTH_M,
        centimetres => f64::from(centimetres) / 100.0,
    };
    (half_width_m / SIGMAS).powi(2)
}

fn velocity(velocity: &cdd::Velocity3dWithConfidence) -> Option<[f64; 2]> {
    match velocity {
        cdd::Velocity3dWithConfidence::cartesianVelocity(velocity) => {
            let component = |component: &cdd::VelocityComponent| {
                let is_value = (-16_382..=16_381).contains(&component.value.0)
                    && component.confidence.0 != WIDE_SPEED;
                is_value.then(|| f64::from(component.value.0) / 100.0)
            };
            component(&velocity.x_velocity)
                .zip(component(&velocity.y_velocity))
                .map(|(east, north)| [east, north])
        }
        cdd::Velocity3dWithConfidence::polarVelocity(velocity) => {
            let cdd::Speed {
                speed_value: cdd::SpeedValue(speed),
                speed_confidence,
            } = &velocity.velocity_magnitude;
            let (sin, cos) = radians(&velocity.velocity_direction)?.sin_cos();
            let is_value = *speed < 16_382 && speed_confidence.0 != WIDE_SPEED;
            is_value.then(|| {
                [
                    f64::from(*speed) / 100.0 * cos,
                    f64::from(*speed) / 100.0 * sin,
                ]
            })
        }
    }
}

fn radians(angle: &cdd::CartesianAngle) -> Option<f64> {
    (angle.value.0 < 3600).then(|| (f64::from(angle.value.0) / 10.0).to_radians())
}

fn dimension(dimension: &cdd::ObjectDimension) -> Option<f64> {
    (dimension.value.0 < 255).then(|| f64::from(dimension.value.0) / 10.0)
}

#[cfg(test)]
mod tests;
