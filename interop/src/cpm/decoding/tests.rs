//! Messages of other stations, made of ETSI's types without the encoder of this crate.

#![allow(clippy::indexing_slicing, clippy::unwrap_used)]

use c_its_parser::standards::cpm_2_1_1::cpm_perceived_object_container::PerceivedObjects;
use ecod::model::geometry::wrap_angle;
use rasn::types::Any;

use super::*;
use crate::cpm::Segments;

/// 2026-11-21T05:44:42.123Z in milliseconds of TAI since 2004-01-01.
const TIME: u64 = 1_795_239_882_123 - 1_072_915_200_000 + 5_000;

const ORIGIN: GeographicOrigin = GeographicOrigin {
    latitude_deg: 52.2296756,
    longitude_deg: 21.0122287,
    height_m: 113.0,
    rotation_deg: 0.0,
};

/// Semi-axes of 1.22 m, about half a metre of standard deviation, and no direction.
const HALF_METRE: Ellipse = Ellipse {
    major: 122,
    minor: 122,
    direction: 3601,
};

/// Confidence ellipse of a reference position, in the units of a CPM.
#[derive(Debug, Clone, Copy)]
struct Ellipse {
    major: u16,
    minor: u16,
    direction: u16,
}

/// Number of a segment, from 1, and of all segments.
#[derive(Debug, Clone, Copy)]
struct SegmentNumber {
    this: u8,
    total: u8,
}

fn coordinate(value: i32, confidence: u16) -> cdd::CartesianCoordinateWithConfidence {
    cdd::CartesianCoordinateWithConfidence {
        value: cdd::CartesianCoordinateLarge(value),
        confidence: cdd::CoordinateConfidence(confidence),
    }
}

/// An object 10 m east and 20 m north, measured at the reference time, without optional fields.
fn object() -> cdd::PerceivedObject {
    let x_coordinate = coordinate(1000, 196);
    let y_coordinate = coordinate(2000, 98);
    let position = cdd::CartesianPosition3dWithConfidence {
        x_coordinate,
        y_coordinate,
        z_coordinate: None,
    };
    let mut object = cdd::PerceivedObject::new(
        None,
        cdd::DeltaTimeMilliSecondSigned(0),
        position,
        None,
        None,
        None,
        None,
        None,
        None,
        None,
        None,
        None,
        None,
        None,
        None,
        None,
    );
    object.object_id = Some(cdd::Identifier2B(7));
    object
}

/// The same object with a change.
fn with(change: impl FnOnce(&mut cdd::PerceivedObject)) -> cdd::PerceivedObject {
    let mut object = object();
    change(&mut object);
    object
}

fn at(x: i32, y: i32) -> cdd::PerceivedObject {
    with(|object| {
        object.position.x_coordinate.value.0 = x;
        object.position.y_coordinate.value.0 = y;
    })
}

fn message(
    objects: Vec<cdd::PerceivedObject>,
    error: Ellipse,
    segment: Option<SegmentNumber>,
    time: u64,
) -> Vec<u8> {
    message_of(vec![objects], error, segment, time)
}

/// A message with these containers of objects.
fn message_of(
    containers: Vec<Vec<cdd::PerceivedObject>>,
    error: Ellipse,
    segment: Option<SegmentNumber>,
    time: u64,
) -> Vec<u8> {
    let position = cdd::ReferencePosition {
        latitude: cdd::Latitude(522_296_756),
        longitude: cdd::Longitude(210_122_287),
        position_confidence_ellipse: cdd::PosConfidenceEllipse {
            semi_major_confidence: cdd::SemiAxisLength(error.major),
            semi_minor_confidence: cdd::SemiAxisLength(error.minor),
            semi_major_orientation: cdd::HeadingValue(error.direction),
        },
        altitude: cdd::Altitude {
            altitude_value: cdd::AltitudeValue(800_001),
            altitude_confidence: cdd::AltitudeConfidence::unavailable,
        },
    };
    let segment = segment.map(|SegmentNumber { this, total }| {
        cdd::MessageSegmentationInfo::new(cdd::CardinalNumber3b(total), cdd::OrdinalNumber3b(this))
    });
    let management =
        pdu::ManagementContainer::new(cdd::TimestampIts(time), position, segment, None);
    let containers = containers.into_iter().map(|objects| {
        let container =
            PerceivedObjectContainer::new(cdd::CardinalNumber1B(9), PerceivedObjects(objects));
        let data = Any::new(rasn::uper::encode(&container).unwrap());
        pdu::WrappedCpmContainer::new(pdu::PERCEIVED_OBJECT_CONTAINER, data)
    });
    let containers =
        pdu::ConstraintWrappedCpmContainers(pdu::WrappedCpmContainers(containers.collect()));
    let header = cdd::ItsPduHeader {
        protocol_version: cdd::OrdinalNumber1B(2),
        message_id: cdd::MessageId(14),
        station_id: cdd::StationId(4711),
    };
    let payload = pdu::CpmPayload::new(management, containers);
    rasn::uper::encode(&pdu::CollectivePerceptionMessage::new(header, payload)).unwrap()
}

fn received(objects: Vec<cdd::PerceivedObject>) -> ReceivedCpm {
    decode(&message(objects, HALF_METRE, None, TIME), &ORIGIN).unwrap()
}

fn only(object: cdd::PerceivedObject) -> PerceivedObject {
    let mut objects = received(vec![object]).objects;
    assert_eq!(objects.len(), 1);
    objects.remove(0)
}

fn cartesian(x: i16, y: i16, confidence: u8) -> Option<cdd::Velocity3dWithConfidence> {
    let component = |value| {
        cdd::VelocityComponent::new(
            cdd::VelocityComponentValue(value),
            cdd::SpeedConfidence(confidence),
        )
    };
    let x_velocity = component(x);
    let y_velocity = component(y);
    let velocity = cdd::VelocityCartesian {
        x_velocity,
        y_velocity,
        z_velocity: None,
    };
    Some(cdd::Velocity3dWithConfidence::cartesianVelocity(velocity))
}

fn polar(speed: u16, tenth_degrees: u16) -> Option<cdd::Velocity3dWithConfidence> {
    let magnitude = cdd::Speed::new(cdd::SpeedValue(speed), cdd::SpeedConfidence(127));
    let direction = angle(tenth_degrees);
    Some(cdd::Velocity3dWithConfidence::polarVelocity(
        cdd::VelocityPolarWithZ::new(magnitude, direction, None),
    ))
}

fn angle(tenth_degrees: u16) -> cdd::CartesianAngle {
    cdd::CartesianAngle::new(
        cdd::CartesianAngleValue(tenth_degrees),
        cdd::AngleConfidence(127),
    )
}

fn yaw(tenth_degrees: u16) -> Option<cdd::EulerAnglesWithConfidence> {
    Some(cdd::EulerAnglesWithConfidence {
        z_angle: angle(tenth_degrees),
        y_angle: None,
        x_angle: None,
    })
}

fn dimension(value: u16) -> Option<cdd::ObjectDimension> {
    let confidence = cdd::ObjectDimensionConfidence(32);
    Some(cdd::ObjectDimension {
        value: cdd::ObjectDimensionValue(value),
        confidence,
    })
}

fn classes(all: &[(cdd::ObjectClass, u8)]) -> Option<cdd::ObjectClassDescription> {
    let class = |(class, percent): &(cdd::ObjectClass, u8)| cdd::ObjectClassWithConfidence {
        object_class: class.clone(),
        confidence: cdd::ConfidenceLevel(*percent),
    };
    Some(cdd::ObjectClassDescription(all.iter().map(class).collect()))
}

fn vehicle(kind: u8) -> cdd::ObjectClass {
    cdd::ObjectClass::vehicleSubClass(cdd::TrafficParticipantType(kind))
}

#[track_caller]
fn assert_near<const N: usize>(got: [f64; N], expected: [f64; N], tolerance: f64) {
    let is_near = got
        .iter()
        .zip(&expected)
        .all(|(got, expected)| (got - expected).abs() <= tolerance);
    assert!(is_near, "{got:?} is not {expected:?}");
}

#[test]
fn early_measurement_is_extrapolated() {
    let moving = |delta_ms| {
        with(|object| {
            object.measurement_delta_time.0 = delta_ms;
            object.velocity = cartesian(500, -200, 127);
        })
    };
    for (delta_ms, place) in [(-400, [12.0, 19.2]), (400, [8.0, 20.8]), (0, [10.0, 20.0])] {
        let object = only(moving(delta_ms));
        assert_near([object.x_m, object.y_m], place, 1e-6);
    }
    // An extrapolation of the station is not a measurement; the ends of the range also stand for
    // all values beyond.
    let old = received(vec![
        moving(-1001),
        moving(-1000),
        moving(-2048),
        moving(2047),
    ]);
    assert_eq!((old.objects.len(), old.left_out), (1, 3));
    assert_eq!(old.captured_at, Timestamp(1_795_239_882_123_000));
}

#[test]
fn polar_velocity_is_accepted() {
    let velocity = |velocity| only(with(|object| object.velocity = velocity)).velocity_mps;
    assert_near(velocity(polar(1000, 900)).unwrap(), [0.0, 10.0], 1e-6);
    assert_near(velocity(polar(1000, 1800)).unwrap(), [-10.0, 0.0], 1e-6);
    assert_near(velocity(polar(16_381, 0)).unwrap(), [163.81, 0.0], 1e-6);
    assert_near(
        velocity(cartesian(-16_382, 16_381, 127)).unwrap(),
        [-163.82, 163.81],
        1e-6,
    );
    let codes = [
        polar(16_382, 0),
        polar(16_383, 0),
        polar(1000, 3601),
        cartesian(-16_383, 0, 127),
        cartesian(0, 16_382, 127),
        cartesian(16_383, 0, 127),
        // A confidence out of range means that the value is not valid (by the standard).
        cartesian(100, 0, 126),
    ];
    for code in codes {
        assert_eq!(velocity(code.clone()), None, "{code:?}");
    }
}

#[test]
fn angles_are_tenth_degrees() {
    let component = cdd::AccelerationComponent::new(
        cdd::AccelerationValue(150),
        cdd::AccelerationConfidence(102),
    );
    let acceleration = cdd::AccelerationCartesian::new(component.clone(), component, None);
    let turned = only(with(|object| {
        object.angles = yaw(2255);
        object.acceleration = Some(cdd::Acceleration3dWithConfidence::cartesianAcceleration(
            acceleration,
        ));
    }));
    assert!(
        wrap_angle(turned.heading_rad.unwrap() - 225.5_f64.to_radians()).abs() < 1e-6,
        "{turned:?}"
    );
    assert_near([turned.x_m, turned.y_m], [10.0, 20.0], 1e-6);
    for code in [3600, 3601] {
        assert_eq!(
            only(with(|object| object.angles = yaw(code))).heading_rad,
            None
        );
    }
}

#[test]
fn object_out_of_range_skipped() {
    let received = received(vec![
        at(-131_072, 0),
        at(0, 131_071),
        at(-131_071, 131_070),
        at(0, 0),
    ]);
    assert_eq!((received.objects.len(), received.left_out), (2, 2));
    assert_near(
        [received.objects[0].x_m, received.objects[0].y_m],
        [-1310.71, 1310.70],
        1e-6,
    );
}

#[test]
fn unavailable_confidence_widens_covariance() {
    let variance = |confidence| {
        only(with(|object| {
            object.position.x_coordinate.confidence.0 = confidence;
        }))
        .covariance_m2
        .unwrap()[0]
    };
    let own = (1.22_f64 / 2.4477).powi(2);
    for (confidence, half_width_m) in [(196, 1.96), (4094, 40.94), (4095, 40.95), (4096, 10.0)] {
        assert_near(
            [variance(confidence)],
            [(half_width_m / 1.96_f64).powi(2) + own],
            1e-6,
        );
    }
}

#[test]
fn reference_error_adds_to_object_error() {
    let covariance = |major, minor, direction| {
        let ellipse = Ellipse {
            major,
            minor,
            direction,
        };
        let received = decode(&message(vec![object()], ellipse, None, TIME), &ORIGIN).unwrap();
        received.objects[0].covariance_m2.unwrap()
    };
    // Standard deviations of 1.6342 m and 0.8171 m, to the north-east, then to the east.
    let along = (4.0_f64 / 2.4477).powi(2);
    let across = (2.0_f64 / 2.4477).powi(2);
    let mean = (along + across) / 2.0;
    let half = (along - across) / 2.0;
    assert_near(
        covariance(400, 200, 450),
        [1.0 + mean, half, 0.25 + mean],
        1e-6,
    );
    assert_near(
        covariance(400, 200, 900),
        [1.0 + along, 0.0, 0.25 + across],
        1e-6,
    );
    assert_near(
        covariance(400, 200, 3601),
        [1.0 + along, 0.0, 0.25 + along],
        1e-6,
    );
    let usual = (5.0_f64 / 2.4477).powi(2);
    assert_near(
        covariance(4095, 200, 900),
        [1.0 + usual, 0.0, 0.25 + usual],
        1e-6,
    );
    assert_near(
        covariance(4095, 4095, 3601),
        [1.0 + usual, 0.0, 0.25 + usual],
        1e-6,
    );
    let ellipse = Ellipse {
        major: 4094,
        minor: 4094,
        direction: 3601,
    };
    let wide = message(vec![object()], ellipse, None, TIME);
    assert_eq!(decode(&wide, &ORIGIN), Err(CpmError::NoPosition));
}

#[test]
fn unavailable_dimension_gives_no_size() {
    let size = |length, width| {
        let boxed = with(|object| {
            object.angles = yaw(0);
            object.object_dimension_x = dimension(length);
            object.object_dimension_y = dimension(width);
        });
        only(boxed).size_m
    };
    assert_eq!(size(120, 25), Some([12.0, 2.5]));
    assert_eq!(size(254, 25), Some([25.4, 2.5]));
    assert_eq!(
        (size(255, 25), size(256, 25), size(45, 256)),
        (None, None, None)
    );
}

#[test]
fn classes_of_one_label_sum() {
    let classification = classes(&[
        (vehicle(5), 40),
        (vehicle(8), 30),
        (vehicle(10), 20),
        (vehicle(8), 30),
    ]);
    let truck = only(with(|object| object.classification = classification));
    assert_eq!((truck.label.as_str(), truck.confidence), ("truck", 0.6));
    assert_eq!(
        truck.scores,
        [
            ("car".into(), 0.4),
            ("special vehicle".into(), 0.2),
            ("truck".into(), 0.6)
        ]
        .into()
    );
    let classification = classes(&[(vehicle(6), 101), (vehicle(5), 101)]);
    let unsure = only(with(|object| object.classification = classification));
    assert_eq!(
        (
            unsure.label.as_str(),
            unsure.confidence,
            unsure.scores.len()
        ),
        ("bus", 0.5, 0)
    );
    let unknown = only(object());
    assert_eq!(
        (unknown.label.as_str(), unknown.confidence),
        ("object", 0.5)
    );
}

#[test]
fn road_user_profiles_match_standard() {
    use cdd::VruProfileAndSubprofile::{
        animal, bicyclistAndLightVruVehicle, motorcyclist, pedestrian,
    };
    let light = |profile| bicyclistAndLightVruVehicle(cdd::VruSubProfileBicyclist(profile));
    let motor = |profile| motorcyclist(cdd::VruSubProfileMotorcyclist(profile));
    let expected = [
        (pedestrian(cdd::VruSubProfilePedestrian(2)), "person"),
        (light(0), "bicycle"),
        (light(1), "bicycle"),
        (light(2), "person"),
        (light(3), "animal"),
        (light(4), "person"),
        (light(5), "person"),
        (light(6), "person"),
        (light(7), "bicycle"),
        (light(10), "bicycle"),
        (motor(0), "motorcycle"),
        (motor(1), "moped"),
        (motor(4), "motorcycle"),
        (animal(cdd::VruSubProfileAnimal(1)), "animal"),
    ];
    for (profile, label) in expected {
        let classification = classes(&[(cdd::ObjectClass::vruSubClass(profile.clone()), 90)]);
        assert_eq!(
            only(with(|object| object.classification = classification)).label,
            label,
            "{profile:?}"
        );
    }
}

#[test]
fn incomplete_segments_are_dropped() {
    let segment = |x, this, time| {
        decode(
            &message(
                vec![at(x, 0), at(131_071, 0)],
                HALF_METRE,
                Some(SegmentNumber { this, total: 2 }),
                time,
            ),
            &ORIGIN,
        )
        .unwrap()
    };
    let mut segments = Segments::default();
    assert_eq!(segments.join(segment(100, 1, TIME)), Ok(None));
    assert_eq!(
        segments.join(segment(300, 2, TIME + 100)),
        Ok(None),
        "the first of this time is missing"
    );
    let whole = segments.join(segment(200, 1, TIME + 100)).unwrap().unwrap();
    let places: Vec<_> = whole
        .objects
        .iter()
        .map(|object| object.x_m.round())
        .collect();
    assert_eq!((places, whole.left_out), (vec![2.0, 3.0], 2));
    assert_eq!(
        segments.join(segment(100, 2, TIME)),
        Ok(None),
        "what was joined is gone"
    );
    let single = decode(&message(vec![at(500, 0)], HALF_METRE, None, TIME), &ORIGIN).unwrap();
    assert_eq!(segments.join(single.clone()), Ok(Some(single)));
}

#[test]
fn oversized_segments_are_dropped() {
    let objects = |number: usize| vec![at(100, 0); number];
    let segment = |this, number| {
        decode(
            &message(
                objects(number),
                HALF_METRE,
                Some(SegmentNumber { this, total: 8 }),
                TIME,
            ),
            &ORIGIN,
        )
        .unwrap()
    };
    let mut segments = Segments::default();
    for this in 1..=4 {
        assert_eq!(segments.join(segment(this, 255)), Ok(None));
    }
    assert_eq!(segments.join(segment(5, 4)), Ok(None), "1024 objects");
    assert_eq!(segments.join(segment(6, 1)), Err(CpmError::TooManyObjects));
    let joined: Vec<_> = (1..=8)
        .map(|this| segments.join(segment(this, 1)).unwrap())
        .collect();
    assert_eq!(
        joined.last().unwrap().as_ref().unwrap().objects.len(),
        8,
        "those before are gone"
    );
    let containers = |number| message_of(vec![objects(255); number], HALF_METRE, None, TIME);
    assert_eq!(
        decode(&containers(4), &ORIGIN).map(|received| received.objects.len()),
        Ok(1020)
    );
    assert_eq!(
        decode(&containers(5), &ORIGIN),
        Err(CpmError::TooManyObjects)
    );
}
