//! Messages of maps and reports.

use std::collections::BTreeMap;

use c_its_parser::standards::cdd_2_2_1::etsi_its_cdd as cdd;
use c_its_parser::standards::cpm_2_1_1::cpm_originating_station_containers::{
    OriginatingRsuContainer, OriginatingVehicleContainer,
};
use c_its_parser::standards::cpm_2_1_1::cpm_pdu_descriptions as pdu;
use c_its_parser::standards::cpm_2_1_1::cpm_perceived_object_container::{
    PerceivedObjectContainer, PerceivedObjects,
};
use ecod::model::time::Timestamp;
use ecod::wire::{FusedObject, GlobalMap, ObjectReport};
use rasn::types::Any;
use uuid::Uuid;

use super::frame::MessageFrame;
use super::identifiers::ObjectIds;
use super::{
    COORDINATES_CM, CpmCell, CpmError, EncodedCpm, ITS_EPOCH_MS, MESSAGE_ID, PROTOCOL_VERSION,
    SIGMAS, UNSTATED_COORDINATE, WIDE_COORDINATE, classes,
};
use crate::object::CellObject;

/// Maximum number of objects in a message.
const MAX_OBJECTS: usize = 255;

/// Width of a tile in metres: from its centre to the far corner of the next is less than a message
/// can state.
const TILE_M: f64 = 600.0;

/// Greatest age that a message states, in milliseconds: at least so old.
const MAX_AGE_MS: u16 = 1500;

/// A map as the message of a roadside unit: its objects, and landmarks at which a road user stands.
/// `is_sighted` returns for a position (metres) whether the cell itself has detected an object
/// there; other objects are left out.
///
/// # Errors
/// Returns [`CpmError::NoTime`] before 2004, [`CpmError::TooFar`] if all objects are far from the
/// origin, or [`CpmError::Unencodable`].
pub fn encode_map(
    map: &GlobalMap,
    cell: &CpmCell,
    station_id: u32,
    ids: &mut ObjectIds,
    is_sighted: impl Fn([f64; 2]) -> bool,
) -> Result<EncodedCpm, CpmError> {
    let sighted = map
        .objects
        .iter()
        .filter(|object| is_sighted([object.x_m, object.y_m]));
    let objects = sighted.map(|object| {
        let age_ms = age_ms(object, map);
        let delta_ms = delta_ms(object);
        (
            object.id,
            CpmObject {
                age_ms,
                delta_ms,
                ..CpmObject::now(object.into())
            },
        )
    });
    let at_places = map
        .landmarks
        .iter()
        .filter(|place| is_sighted([place.x_m, place.y_m]))
        .filter_map(|place| {
            let object = CellObject::at(place)?;
            classes::road_user(object.label)?;
            Some((
                Uuid::new_v5(&Uuid::NAMESPACE_OID, place.id.as_bytes()),
                CpmObject::now(object),
            ))
        });
    let all: Vec<_> = objects
        .chain(at_places)
        .filter(|(_, source)| !cell.vacancy_signs.contains(source.object.label))
        .collect();
    let numbers = ids.assign(&all.iter().map(|(id, _)| *id).collect::<Vec<_>>());
    let numbered = all.into_iter().map(|(id, source)| CpmObject {
        number: numbers.get(&id).copied(),
        ..source
    });
    let sources: Vec<_> = numbered.collect();
    let (x_m, y_m) = centre(&sources);
    let frame = MessageFrame::at(&cell.origin, x_m, y_m)?;
    let rsu = uper(&OriginatingRsuContainer::new(None))?;
    encode(
        station_id,
        map.fused_at_us,
        &frame,
        container(pdu::ORIGINATING_RSU_CONTAINER, rsu),
        sources,
    )
}

/// A vehicle's report as its message. A report without a pose becomes the message of a roadside
/// unit. Detections are not tracks: an object has a new number in every message, for 256 reports.
///
/// # Errors
/// Returns the errors of [`encode_map`].
pub fn encode_report(
    report: &ObjectReport,
    cell: &CpmCell,
    station_id: u32,
) -> Result<EncodedCpm, CpmError> {
    let first = (report.seq as u16).wrapping_mul(256);
    let numbers = (0..=u16::MAX).map(|index| first.wrapping_add(index));
    let objects = report
        .objects
        .iter()
        .filter(|object| !cell.vacancy_signs.contains(&object.label))
        .zip(numbers);
    let numbered = objects.map(|(object, number)| CpmObject {
        number: Some(number),
        ..CpmObject::now(object.into())
    });
    let sources: Vec<_> = numbered.collect();
    let (x_m, y_m) = report
        .pose
        .map_or_else(|| centre(&sources), |pose| (pose.x_m, pose.y_m));
    let frame = MessageFrame::at(&cell.origin, x_m, y_m)?;
    let station = match report.pose {
        Some(pose) => {
            let azimuth_deg = 90.0 - frame.heading_to_message(pose.heading_rad).to_degrees();
            let value = cdd::Wgs84AngleValue(tenth_degrees(azimuth_deg));
            let confidence = cdd::Wgs84AngleConfidence(127);
            let vehicle = OriginatingVehicleContainer::new(
                cdd::Wgs84Angle { value, confidence },
                None,
                None,
                None,
            );
            container(pdu::ORIGINATING_VEHICLE_CONTAINER, uper(&vehicle)?)
        }
        None => container(
            pdu::ORIGINATING_RSU_CONTAINER,
            uper(&OriginatingRsuContainer::new(None))?,
        ),
    };
    encode(station_id, report.captured_at_us, &frame, station, sources)
}

/// An object with the additional data of a message.
#[derive(Debug)]
struct CpmObject<'a> {
    object: CellObject<'a>,
    number: Option<u16>,
    /// Time since the first detection.
    age_ms: Option<u16>,
    /// Time of the last detection after the reference time; not positive.
    delta_ms: i16,
}

/// Age of an object on a map, as far as a message states it.
fn age_ms(object: &FusedObject, map: &GlobalMap) -> Option<u16> {
    let age = map.fused_at_us.since(object.first_seen_us?).as_millis();
    Some(u16::try_from(age).unwrap_or(MAX_AGE_MS).min(MAX_AGE_MS))
}

/// Time of an object's last detection relative to the time of the map. Its minimum value also means
/// "or earlier".
fn delta_ms(object: &FusedObject) -> i16 {
    (object.age_s.unwrap_or(0.0) * -1000.0)
        .round()
        .clamp(-2048.0, 0.0) as i16
}

impl<'a> CpmObject<'a> {
    /// An object that is detected at the reference time.
    fn now(object: CellObject<'a>) -> Self {
        Self {
            object,
            number: None,
            age_ms: None,
            delta_ms: 0,
        }
    }

    /// The object in a message's form, at the place of its last detection; `None` if that is too
    /// far from the reference position.
    fn perceived(&self, frame: &MessageFrame) -> Option<cdd::PerceivedObject> {
        let [x_m, y_m] = self.object.position_m;
        let [east_mps, north_mps] = self.object.velocity_mps.unwrap_or_default();
        let delta_s = f64::from(self.delta_ms) / 1000.0;
        let [east_m, north_m] =
            frame.to_message(x_m + east_mps * delta_s, y_m + north_mps * delta_s);
        let variances = self
            .object
            .covariance_m2
            .map(|covariance| frame.variances_to_message(covariance));
        let position = cdd::CartesianPosition3dWithConfidence {
            x_coordinate: coordinate(east_m, variances.map(|[east, _]| east))?,
            y_coordinate: coordinate(north_m, variances.map(|[_, north]| north))?,
            z_coordinate: None,
        };
        let velocity = self.object.velocity_mps.map(|velocity| {
            let [east_mps, north_mps] = frame.velocity_to_message(velocity);
            cdd::Velocity3dWithConfidence::cartesianVelocity(cdd::VelocityCartesian {
                x_velocity: velocity_component(east_mps),
                y_velocity: velocity_component(north_mps),
                z_velocity: None,
            })
        });
        let angles = self.object.heading_rad.map(|heading_rad| {
            let value = cdd::CartesianAngleValue(tenth_degrees(
                frame.heading_to_message(heading_rad).to_degrees(),
            ));
            let z_angle = cdd::CartesianAngle {
                value,
                confidence: cdd::AngleConfidence(127),
            };
            cdd::EulerAnglesWithConfidence {
                z_angle,
                y_angle: None,
                x_angle: None,
            }
        });
        // Without a heading the box would be one along east.
        let size_m = self.object.size_m.filter(|_| angles.is_some());
        let [length, width] =
            size_m.map_or([None, None], |[length, width]| [Some(length), Some(width)]);
        Some(cdd::PerceivedObject::new(
            self.number.map(cdd::Identifier2B),
            cdd::DeltaTimeMilliSecondSigned(self.delta_ms),
            position,
            velocity,
            None,
            angles,
            None,
            None,
            None,
            width.map(dimension),
            length.map(dimension),
            self.age_ms
                .map(|age| cdd::DeltaTimeMilliSecondSigned(age as i16)),
            Some(cdd::ObjectPerceptionQuality(
                (self.object.confidence * 15.0).round().clamp(0.0, 15.0) as u8,
            )),
            None,
            Some(self.classification()),
            None,
        ))
    }

    /// The eight most probable classes, or the only one without a confidence. Labels of one class
    /// add up.
    fn classification(&self) -> cdd::ObjectClassDescription {
        let mut classes: Vec<(cdd::ObjectClass, f64)> = Vec::new();
        for (label, score) in self.object.scores {
            let class = classes::of_label(label);
            match classes.iter_mut().find(|(other, _)| *other == class) {
                Some((_, sum)) => *sum += score,
                None => classes.push((class, *score)),
            }
        }
        classes.sort_by(|(_, a), (_, b)| b.total_cmp(a));
        let mut described: Vec<_> = classes
            .into_iter()
            .take(8)
            .map(|(class, sum)| (class, (sum * 100.0).round().clamp(1.0, 100.0) as u8))
            .collect();
        if described.is_empty() {
            described.push((classes::of_label(self.object.label), 101));
        }
        let described =
            described
                .into_iter()
                .map(|(object_class, percent)| cdd::ObjectClassWithConfidence {
                    object_class,
                    confidence: cdd::ConfidenceLevel(percent),
                });
        cdd::ObjectClassDescription(described.collect())
    }
}

fn encode(
    station_id: u32,
    time: Timestamp,
    frame: &MessageFrame,
    station: pdu::WrappedCpmContainer,
    mut sources: Vec<CpmObject<'_>>,
) -> Result<EncodedCpm, CpmError> {
    let reference_time = (time.micros() / 1000)
        .checked_sub(ITS_EPOCH_MS)
        .ok_or(CpmError::NoTime)?;
    let all = sources.len();
    sources.sort_by(|a, b| b.object.confidence.total_cmp(&a.object.confidence));
    let mut perceived: Vec<_> = sources
        .iter()
        .filter_map(|source| source.perceived(frame))
        .collect();
    perceived.truncate(MAX_OBJECTS);
    let left_out = all - perceived.len();
    let number = cdd::CardinalNumber1B(u8::try_from(all).unwrap_or(u8::MAX));
    let objects = uper(&PerceivedObjectContainer::new(
        number,
        PerceivedObjects(perceived),
    ))?;
    let containers = vec![station, container(pdu::PERCEIVED_OBJECT_CONTAINER, objects)];
    let constrained = pdu::ConstraintWrappedCpmContainers(pdu::WrappedCpmContainers(containers));
    let position = frame.reference_position();
    let management =
        pdu::ManagementContainer::new(cdd::TimestampIts(reference_time), position, None, None);
    let header = cdd::ItsPduHeader {
        protocol_version: cdd::OrdinalNumber1B(PROTOCOL_VERSION),
        message_id: cdd::MessageId(MESSAGE_ID),
        station_id: cdd::StationId(station_id),
    };
    let message = pdu::CollectivePerceptionMessage::new(
        header,
        pdu::CpmPayload::new(management, constrained),
    );
    Ok(EncodedCpm {
        bytes: uper(&message)?,
        left_out,
    })
}

/// A container of a message, from its encoded content.
fn container(id: pdu::CpmContainerId, content: Vec<u8>) -> pdu::WrappedCpmContainer {
    pdu::WrappedCpmContainer::new(id, Any::new(content))
}

fn uper<T: rasn::Encode>(value: &T) -> Result<Vec<u8>, CpmError> {
    rasn::uper::encode(value).map_err(|_| CpmError::Unencodable)
}

/// The centre of the tile that, with its neighbours, holds most objects; of several, the nearest to
/// the origin. All objects of these nine tiles are near enough for a message.
fn centre(sources: &[CpmObject<'_>]) -> (f64, f64) {
    let mut counts: BTreeMap<(i64, i64), usize> = BTreeMap::new();
    for [x_m, y_m] in sources.iter().map(|source| source.object.position_m) {
        let [column, row] = [x_m, y_m].map(|metres| (metres / TILE_M).round() as i64);
        for near in (0..9).map(|place| (column + place % 3 - 1, row + place / 3 - 1)) {
            *counts.entry(near).or_default() += 1;
        }
    }
    let from_origin = |(column, row): (i64, i64)| (column as f64).hypot(row as f64);
    let best = counts.into_iter().max_by(|(at, count), (other, most)| {
        count
            .cmp(most)
            .then_with(|| from_origin(*other).total_cmp(&from_origin(*at)))
    });
    let (column, row) = best.map_or((0, 0), |(at, _)| at);
    (column as f64 * TILE_M, row as f64 * TILE_M)
}

fn coordinate(
    metres: f64,
    variance_m2: Option<f64>,
) -> Option<cdd::CartesianCoordinateWithConfidence> {
    let centimetres = (metres * 100.0).round() as i32;
    let confidence = variance_m2.map_or(UNSTATED_COORDINATE, |variance| {
        let half_width_cm = SIGMAS * variance.max(0.0).sqrt() * 100.0;
        half_width_cm.ceil().clamp(1.0, f64::from(WIDE_COORDINATE)) as u16
    });
    COORDINATES_CM
        .contains(&centimetres)
        .then_some(cdd::CartesianCoordinateWithConfidence {
            value: cdd::CartesianCoordinateLarge(centimetres),
            confidence: cdd::CoordinateConfidence(confidence),
        })
}

/// A component of a velocity; out of range, the corresponding code.
fn velocity_component(mps: f64) -> cdd::VelocityComponent {
    let value =
        cdd::VelocityComponentValue((mps * 100.0).round().clamp(-16_383.0, 16_382.0) as i16);
    cdd::VelocityComponent {
        value,
        confidence: cdd::SpeedConfidence(127),
    }
}

/// A dimension; out of range, the corresponding code.
fn dimension(metres: f64) -> cdd::ObjectDimension {
    let value = cdd::ObjectDimensionValue((metres * 10.0).round().clamp(1.0, 255.0) as u16);
    cdd::ObjectDimension {
        value,
        confidence: cdd::ObjectDimensionConfidence(32),
    }
}

/// Tenths of a degree from 0 to 3599.
fn tenth_degrees(degrees: f64) -> u16 {
    ((degrees.rem_euclid(360.0) * 10.0).round() as u16) % 3600
}
