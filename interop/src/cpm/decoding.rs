//! Objects of received messages.

use c_its_parser::standards::cdd_2_2_1::etsi_its_cdd as cdd;
use c_its_parser::standards::cpm_2_1_1::cpm_pdu_descriptions as pdu;
use c_its_parser::standards::cpm_2_1_1::cpm_perceived_object_container::PerceivedObjectContainer;
use ecod::model::origin::GeographicOrigin;
use ecod::model::time::Timestamp;
use ecod::wire::PerceivedObject;

use super::frame::MessageFrame;
use super::{CpmError, ITS_EPOCH_MS, MAX_BYTES, MESSAGE_ID, PROTOCOL_VERSION, ReceivedCpm, SIGMAS, classes};

/// Confidence of an object of which the station states none.
const UNSTATED_CONFIDENCE: f64 = 0.5;

/// The objects of a message in the frame of a cell.
///
/// # Errors
/// [`CpmError`] for what is no CPM, or is not in the neighbourhood.
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
    let segment = management.segmentation_info.as_ref();
    let mut objects = Vec::new();
    for container in &message.payload.cpm_containers.0.0 {
        if container.container_id == pdu::PERCEIVED_OBJECT_CONTAINER {
            let container: PerceivedObjectContainer = uper(container.container_data.as_bytes())?;
            objects.extend(container.perceived_objects.0.iter().map(|object| perceived(object, &frame)));
        }
    }
    Ok(ReceivedCpm {
        station_id: message.header.station_id.0,
        captured_at: Timestamp(time_ms * 1000),
        segment: segment.map(|segment| (segment.this_msg_no.0, segment.total_msg_no.0)),
        objects,
    })
}

fn uper<T: rasn::Decode>(bytes: &[u8]) -> Result<T, CpmError> {
    rasn::uper::decode(bytes).map_err(|_| CpmError::Malformed)
}

fn perceived(object: &cdd::PerceivedObject, frame: &MessageFrame) -> PerceivedObject {
    let velocity = object.velocity.as_ref().and_then(velocity);
    let late_s = f64::from(object.measurement_delta_time.0) / 1000.0;
    let [east_mps, north_mps] = velocity.unwrap_or_default();
    let (east, north) = (&object.position.x_coordinate, &object.position.y_coordinate);
    let metres = |coordinate: &cdd::CartesianCoordinateWithConfidence| f64::from(coordinate.value.0) / 100.0;
    let [x_m, y_m] = frame.to_cell([metres(east) - east_mps * late_s, metres(north) - north_mps * late_s]);
    let scores: Vec<_> = object.classification.iter().flat_map(|classes| &classes.0).collect();
    let best = scores.iter().max_by_key(|class| class.confidence.0 % 101);
    let score = |class: &cdd::ObjectClassWithConfidence| {
        (class.confidence.0 <= 100).then(|| f64::from(class.confidence.0) / 100.0)
    };
    let quality = object.object_perception_quality.as_ref().map(|quality| f64::from(quality.0) / 15.0);
    let angle = object.angles.as_ref().and_then(|angles| radians(&angles.z_angle));
    let size = object
        .object_dimension_x
        .as_ref()
        .and_then(dimension)
        .zip(object.object_dimension_y.as_ref().and_then(dimension));
    let confidence = quality.or_else(|| score(best?)).unwrap_or(UNSTATED_CONFIDENCE);
    let label = best.map_or("object", |class| classes::label(&class.object_class));
    PerceivedObject {
        covariance_m2: variance(east).zip(variance(north)).map(|(east, north)| frame.variances_to_cell([east, north])),
        velocity_mps: velocity.map(|velocity| frame.velocity_to_cell(velocity)),
        heading_rad: angle.map(|angle| frame.heading_to_cell(angle)),
        size_m: size.map(|(length, width)| [length, width]),
        scores: scores
            .iter()
            .filter_map(|class| Some((classes::label(&class.object_class).into(), score(class)?)))
            .collect(),
        ..PerceivedObject::new(label, confidence, x_m, y_m)
    }
}

fn variance(coordinate: &cdd::CartesianCoordinateWithConfidence) -> Option<f64> {
    let half_width = coordinate.confidence.0;
    (half_width <= 4095).then(|| (f64::from(half_width) / 100.0 / SIGMAS).powi(2))
}

fn velocity(velocity: &cdd::Velocity3dWithConfidence) -> Option<[f64; 2]> {
    match velocity {
        cdd::Velocity3dWithConfidence::cartesianVelocity(velocity) => {
            let component = |component: &cdd::VelocityComponent| {
                (component.value.0.abs() < 16_383).then(|| f64::from(component.value.0) / 100.0)
            };
            component(&velocity.x_velocity).zip(component(&velocity.y_velocity)).map(|(east, north)| [east, north])
        }
        cdd::Velocity3dWithConfidence::polarVelocity(velocity) => {
            let speed = velocity.velocity_magnitude.speed_value.0;
            let (sin, cos) = radians(&velocity.velocity_direction)?.sin_cos();
            (speed < 16_383).then(|| [f64::from(speed) / 100.0 * cos, f64::from(speed) / 100.0 * sin])
        }
    }
}

fn radians(angle: &cdd::CartesianAngle) -> Option<f64> {
    (angle.value.0 < 3600).then(|| (f64::from(angle.value.0) / 10.0).to_radians())
}

fn dimension(dimension: &cdd::ObjectDimension) -> Option<f64> {
    (dimension.value.0 < 256).then(|| f64::from(dimension.value.0) / 10.0)
}
