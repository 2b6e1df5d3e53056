#![allow(
    clippy::indexing_slicing,
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic
)]

use std::f64::consts::{PI, TAU};
use std::time::{Duration, Instant};

use c_its_parser::standards::cdd_2_2_1::etsi_its_cdd as cdd;
use c_its_parser::standards::cpm_2_1_1::cpm_pdu_descriptions::{
    CollectivePerceptionMessage, PERCEIVED_OBJECT_CONTAINER,
};
use c_its_parser::standards::cpm_2_1_1::cpm_perceived_object_container::PerceivedObjectContainer;
use ecod::model::epoch::Epoch;
use ecod::model::geometry::{Covariance, wrap_angle};
use ecod::model::names::NodeName;
use ecod::wire::{FusedObject, GlobalMap, LandmarkState, Limits, ObjectReport, WirePose};
use proptest::prelude::*;
use uuid::Uuid;

use super::*;

const NOW: Timestamp = Timestamp(1_795_239_882_123_000);

fn origin(rotation_deg: f64) -> GeographicOrigin {
    GeographicOrigin {
        latitude_deg: 52.2296756,
        longitude_deg: 21.0122287,
        height_m: 113.0,
        rotation_deg,
    }
}

/// A cell with the sign "EMPTY".
fn cell(rotation_deg: f64) -> CpmCell {
    CpmCell {
        origin: origin(rotation_deg),
        vacancy_signs: BTreeSet::from(["EMPTY".into()]),
    }
}

fn report(objects: Vec<PerceivedObject>) -> ObjectReport {
    ObjectReport {
        objects,
        ..ObjectReport::new(NodeName::from_static("euclid"), 1, NOW)
    }
}

fn map(objects: Vec<FusedObject>, landmarks: Vec<LandmarkState>) -> GlobalMap {
    let epoch = Epoch::new(7, NodeName::from_static("edge"));
    GlobalMap {
        landmarks,
        objects,
        ..GlobalMap::new(&epoch, 1, NOW)
    }
}

fn fused(id: u128, x_m: f64) -> FusedObject {
    FusedObject::new(
        Uuid::from_u128(id),
        "car",
        0.8,
        x_m,
        0.0,
        Covariance::isotropic(0.04),
    )
}

fn detection() -> impl Strategy<Value = PerceivedObject> {
    let position = (-500.0..500.0, -500.0..500.0);
    let motion = proptest::option::of([-60.0..60.0, -60.0..60.0]);
    let label = prop_oneof![
        Just("car"),
        Just("bus"),
        Just("person"),
        Just("bicycle"),
        Just("motorcycle"),
        Just("object")
    ];
    let shape = proptest::option::of([0.2..25.0, 0.2..25.0]);
    (
        label,
        0.0..1.0,
        position,
        proptest::option::of(prop_oneof![0.0001..9.0, 9.0..1e5]),
        motion,
        proptest::option::of(-PI..PI),
        shape,
    )
        .prop_map(
            |(label, confidence, (x_m, y_m), variance, velocity_mps, heading_rad, size_m)| {
                PerceivedObject {
                    covariance_m2: variance.map(|variance: f64| [variance, 0.0, variance]),
                    velocity_mps,
                    heading_rad,
                    size_m,
                    ..PerceivedObject::new(label, confidence, x_m, y_m)
                }
            },
        )
}

/// A number within a bound of the wire format, often at it.
fn up_to(bound: f64) -> impl Strategy<Value = f64> {
    prop_oneof![-bound..=bound, -10.0..=10.0, Just(bound), Just(-bound)]
}

fn extreme_detection() -> impl Strategy<Value = PerceivedObject> {
    (
        (up_to(1e8), up_to(1e8), 0.0..=1.0),
        proptest::option::of(up_to(7e19).prop_map(f64::abs)),
        proptest::option::of([up_to(1e4), up_to(1e4)]),
        proptest::option::of(-TAU..=TAU),
        proptest::option::of([
            up_to(102_400.0).prop_map(f64::abs),
            up_to(102_400.0).prop_map(f64::abs),
        ]),
    )
        .prop_map(
            |((x_m, y_m, confidence), variance, velocity_mps, heading_rad, size_m)| {
                PerceivedObject {
                    covariance_m2: variance.map(|variance| [variance, 0.0, variance]),
                    velocity_mps,
                    heading_rad,
                    size_m,
                    ..PerceivedObject::new("car", confidence, x_m, y_m)
                }
            },
        )
}

fn extreme_object() -> impl Strategy<Value = FusedObject> {
    let times = (
        proptest::option::of(up_to(4e15).prop_map(f64::abs)),
        proptest::option::of(0..(1u64 << 53)),
    );
    (any::<u64>(), extreme_detection(), times).prop_map(|(id, seen, (age_s, first_seen))| {
        let covariance = seen.covariance_m2.unwrap_or([0.04, 0.0, 0.04]);
        FusedObject {
            confidence: seen.confidence,
            y_m: seen.y_m,
            covariance_m2: covariance,
            velocity_mps: seen.velocity_mps,
            heading_rad: seen.heading_rad,
            size_m: seen.size_m,
            age_s,
            first_seen_us: first_seen.map(Timestamp),
            ..fused(u128::from(id) + 100, seen.x_m)
        }
    })
}

proptest! {
    #[test]
    fn extreme_objects_drop_no_others(
        extreme in proptest::collection::vec(extreme_detection(), 0..4),
        rotation_deg in -180.0..180.0,
    ) {
        let ordinary = (0..5).map(|number| PerceivedObject::new("car", 0.9, 12.0 + 3.0 * f64::from(number), 5.0));
        let sent = report(ordinary.chain(extreme).collect());
        prop_assert!(sent.validate(&Limits::default()).is_ok());
        let message = encode_report(&sent, &cell(rotation_deg), 7).unwrap();
        let received = decode(&message.bytes, &origin(rotation_deg)).unwrap();
        prop_assert_eq!(received.objects.len() + message.left_out, sent.objects.len());
        for object in &sent.objects[..5] {
            let is_it = |other: &PerceivedObject| (other.x_m - object.x_m).hypot(other.y_m - object.y_m) < 0.009;
            prop_assert!(received.objects.iter().any(is_it), "{:?} is missing", object);
        }
    }

    #[test]
    fn extreme_positions_drop_no_others(
        extreme in proptest::collection::vec(extreme_object(), 0..6),
        places in proptest::collection::vec((up_to(1e8), up_to(1e8), 0.0..=1.0), 0..4),
        rotation_deg in -180.0..180.0,
    ) {
        let ordinary = (1..6).map(|number| fused(number, 12.0 + 3.0 * number as f64));
        let places = places.into_iter().map(|(x_m, y_m, confidence)| LandmarkState {
            id: "far".into(),
            label: Some("car".into()),
            confidence,
            x_m,
            y_m,
            contributors: Vec::new(),
            observers: Vec::new(),
            readings: Vec::new(),
        });
        let sent = map(ordinary.chain(extreme).collect(), places.collect());
        let valid = ecod::wire::encode(&sent, ecod::wire::Encoding::Cbor);
        let (_, invalid) = ecod::wire::decode_entries::<GlobalMap>(&valid, &Limits::default()).unwrap();
        prop_assert_eq!(invalid, Vec::new());
        let message = encode_map(&sent, &cell(rotation_deg), 7, &mut ObjectIds::default(), |_| true).unwrap();
        let received = decode(&message.bytes, &origin(rotation_deg)).unwrap();
        // Objects that were last detected over a second ago are not used.
        let all = sent.objects.len() + sent.landmarks.len();
        let old = sent.objects.iter().filter(|object| object.age_s.unwrap_or(0.0) > 1.0).count();
        let counted = received.objects.len() + message.left_out;
        prop_assert!((all - old..=all).contains(&counted), "{} of {}, {} old", counted, all, old);
        for object in &sent.objects[..5] {
            let is_it = |other: &PerceivedObject| (other.x_m - object.x_m).hypot(other.y_m - object.y_m) < 0.009;
            prop_assert!(received.objects.iter().any(is_it), "{:?} is missing", object);
        }
    }

    #[test]
    fn any_pose_is_encoded_or_refused(
        (x_m, y_m) in (up_to(1e8), up_to(1e8)),
        heading_rad in -TAU..=TAU,
        objects in proptest::collection::vec(extreme_detection(), 0..4),
        seq in any::<u64>(),
    ) {
        let sent = ObjectReport { pose: Some(WirePose::new(x_m, y_m, heading_rad)), seq, ..report(objects) };
        prop_assert!(sent.validate(&Limits::default()).is_ok());
        if let Ok(message) = encode_report(&sent, &cell(0.0), 7) {
            let received = decode(&message.bytes, &origin(0.0));
            prop_assert!(received.is_ok(), "{:?}", received.err());
        }
    }

    #[test]
    fn report_round_trips_within_resolution(
        objects in proptest::collection::vec(detection(), 0..40),
        pose in proptest::option::of((-400.0..400.0, -400.0..400.0, -PI..PI)),
        rotation_deg in -180.0..180.0,
        station in any::<u32>(),
    ) {
        let pose = pose.map(|(x_m, y_m, heading_rad)| WirePose::new(x_m, y_m, heading_rad));
        let sent = ObjectReport { pose, ..report(objects) };
        let message = encode_report(&sent, &cell(rotation_deg), station).unwrap();
        prop_assert_eq!(message.left_out, 0);
        let received = decode(&message.bytes, &origin(rotation_deg)).unwrap();
        prop_assert_eq!((received.station_id, received.captured_at, received.segment), (station, NOW, None));
        prop_assert_eq!(received.objects.len(), sent.objects.len());
        let mut left = received.objects;
        for object in &sent.objects {
            let is_it = |other: &PerceivedObject| (other.x_m - object.x_m).hypot(other.y_m - object.y_m) < 0.009;
            let place = left.iter().position(|other| is_it(other) && other.label == object.label);
            let other = left.swap_remove(place.expect("it is within a centimetre"));
            prop_assert!((other.confidence - object.confidence).abs() < 0.5 / 15.0 + 1e-9);
            // The reference position's own error is unavailable; values above 41 m are only limited
            // from below.
            let [xx, xy, yy] = other.covariance_m2.unwrap();
            let own = (5.0_f64 / 2.4477).powi(2);
            let wide = (40.95 / SIGMAS).powi(2);
            let variance = object.covariance_m2.map_or((10.0 / SIGMAS).powi(2), |[variance, ..]| variance).min(wide);
            let coarser = (variance.sqrt() + 0.01 / SIGMAS).powi(2) + own + 1e-6;
            prop_assert!(xx >= variance + own - 1e-6 && yy >= variance + own - 1e-6, "no certainty is gained");
            prop_assert!(xx <= coarser && yy <= coarser && xy.abs() < 1e-6);
            prop_assert_eq!(other.velocity_mps.is_some(), object.velocity_mps.is_some());
            for (got, was) in other.velocity_mps.iter().flatten().zip(object.velocity_mps.iter().flatten()) {
                prop_assert!((got - was).abs() < 0.0072, "{} {}", got, was);
            }
            prop_assert_eq!(other.heading_rad.is_some(), object.heading_rad.is_some());
            for (got, was) in other.heading_rad.iter().zip(object.heading_rad) {
                prop_assert!(wrap_angle(got - was).abs() < TAU / 7200.0 + 1e-6);
            }
            prop_assert_eq!(other.size_m.is_some(), object.size_m.is_some() && object.heading_rad.is_some());
            for (got, was) in other.size_m.iter().flatten().zip(object.size_m.iter().flatten()) {
                prop_assert!((got - was).abs() < 0.0501);
            }
        }
    }

    #[test]
    fn hostile_bytes_give_no_invalid_report(
        mut tail in proptest::collection::vec(any::<u8>(), 0..400),
        flips in proptest::collection::vec((0usize..200, any::<u8>()), 0..6),
    ) {
        let objects = vec![PerceivedObject::new("car", 0.9, 4.0, 5.0); 3];
        let mut bytes = encode_report(&report(objects), &cell(0.0), 9).unwrap().bytes;
        for (place, value) in flips {
            let length = bytes.len();
            bytes[place % length] = value;
        }
        tail.splice(0..0, [PROTOCOL_VERSION, MESSAGE_ID]);
        for hostile in [bytes, tail] {
            if let Ok(received) = decode(&hostile, &origin(0.0)) {
                let taken = ObjectReport { captured_at_us: received.captured_at, ..report(received.objects) };
                prop_assert!(taken.validate(&Limits::default()).is_ok(), "{:?}", taken);
            }
        }
    }
}

#[test]
fn object_numbers_stay_unique() {
    let mut ids = ObjectIds::default();
    // The first two bytes of all are equal.
    let all: Vec<_> = (1..=3).map(Uuid::from_u128).collect();
    let first = ids.assign(&all);
    assert_eq!(
        all.iter().map(|id| first[id]).collect::<Vec<_>>(),
        [0, 1, 2]
    );
    let second = ids.assign(&[all[2], Uuid::from_u128(4), all[1]]);
    assert_eq!(
        (
            second[&all[1]],
            second[&all[2]],
            second[&Uuid::from_u128(4)]
        ),
        (1, 2, 0)
    );
}

#[test]
fn station_number_survives_runs() {
    let numbers = || StationIds::new(NodeName::from_static("lot-1"));
    let euclid = NodeName::from_static("euclid");
    let gauss = NodeName::from_static("gauss");
    let mut one = numbers();
    let mut other = numbers();
    let now = Instant::now();
    let of_gauss = one.of(&gauss, now).unwrap();
    assert_ne!(of_gauss, one.of(&euclid, now).unwrap());
    assert_eq!(one.of(&euclid, now), other.of(&euclid, now));
    assert!(one.contains(of_gauss, now) && !other.contains(of_gauss, now));
}

#[test]
fn map_includes_landmark_road_users() {
    let at = |id: &str, label: Option<&str>| LandmarkState {
        id: id.into(),
        label: label.map(Into::into),
        confidence: 0.9,
        x_m: 5.0,
        y_m: -2.0,
        contributors: Vec::new(),
        observers: Vec::new(),
        readings: Vec::new(),
    };
    let places = vec![
        at("a", Some("truck")),
        at("b", Some("EMPTY")),
        at("c", None),
    ];
    let message = encode_map(
        &map(vec![fused(1, 12.0)], places),
        &cell(0.0),
        3,
        &mut ObjectIds::default(),
        |_| true,
    )
    .unwrap();
    let objects = decode(&message.bytes, &origin(0.0)).unwrap().objects;
    let labels: Vec<_> = objects
        .iter()
        .map(|object| (object.label.as_str(), object.x_m.round()))
        .collect();
    assert_eq!(labels, [("truck", 5.0), ("car", 12.0)]);
}

#[test]
fn surest_objects_fit_first() {
    let objects = (0..300_u16).map(|number| FusedObject {
        confidence: f64::from(number) / 300.0,
        ..fused(number.into(), 1.0)
    });
    let large = map(objects.collect(), Vec::new());
    let message = encode_map(&large, &cell(0.0), 3, &mut ObjectIds::default(), |_| true).unwrap();
    assert_eq!(message.left_out, 45);
    let received = decode(&message.bytes, &origin(0.0)).unwrap();
    assert!(
        received.objects.len() == 255
            && received
                .objects
                .iter()
                .all(|object| object.confidence > 0.13)
    );
    assert!(
        message.bytes.len() < MAX_BYTES / 2,
        "{}",
        message.bytes.len()
    );
}

#[test]
fn reference_position_fits_most_objects() {
    let sent = |places: &[f64]| {
        let objects = (1..).zip(places).map(|(id, x_m)| fused(id, *x_m)).collect();
        let message = encode_map(
            &map(objects, Vec::new()),
            &cell(45.0),
            3,
            &mut ObjectIds::default(),
            |_| true,
        )
        .unwrap();
        let objects = decode(&message.bytes, &origin(45.0)).unwrap().objects;
        (
            objects
                .iter()
                .map(|object| object.x_m.round())
                .collect::<Vec<_>>(),
            message.left_out,
        )
    };
    assert_eq!(
        sent(&[5000.0, 5800.0, 9000.0]),
        (vec![5000.0, 5800.0], 1),
        "far from the origin"
    );
    assert_eq!(
        sent(&[-890.0, 20.0, 890.0]),
        (vec![-890.0, 20.0, 890.0], 0),
        "all about the origin"
    );
    for far_m in [3000.0, -3000.0, 1e8] {
        assert_eq!(
            sent(&[far_m, 0.0]),
            (vec![0.0], 1),
            "one object that is far costs no other its place"
        );
    }
}

#[test]
fn unsuitable_messages_name_refusal_reason() {
    let message = encode_report(&report(Vec::new()), &cell(0.0), 1)
        .unwrap()
        .bytes;
    let there = GeographicOrigin {
        latitude_deg: 48.0,
        ..origin(0.0)
    };
    assert_eq!(decode(&message, &there), Err(CpmError::TooFar));
    assert_eq!(
        decode(&message[..12], &origin(0.0)),
        Err(CpmError::Malformed)
    );
    assert_eq!(
        decode(&[2, 2, 0, 0], &origin(0.0)),
        Err(CpmError::OtherMessage)
    );
    assert_eq!(
        decode(&vec![0; MAX_BYTES + 1], &origin(0.0)),
        Err(CpmError::TooLarge)
    );
    let early = ObjectReport {
        captured_at_us: Timestamp(5),
        ..report(Vec::new())
    };
    assert_eq!(encode_report(&early, &cell(0.0), 1), Err(CpmError::NoTime));
    let late = ObjectReport {
        captured_at_us: Timestamp((1 << 53) - 1),
        ..report(Vec::new())
    };
    assert_eq!(
        encode_report(&late, &cell(0.0), 1),
        Err(CpmError::Unencodable),
        "the year 2255"
    );
}

#[test]
fn covariance_rotates_with_frame() {
    // The cell's x axis points north.
    let quarter = origin(90.0);
    let object = PerceivedObject {
        covariance_m2: Some([4.0, 0.0, 1.0]),
        ..PerceivedObject::new("car", 0.9, 3.0, 2.0)
    };
    let message = encode_report(&report(vec![object]), &cell(90.0), 1)
        .unwrap()
        .bytes;
    let there = decode(&message, &quarter).unwrap().objects.remove(0);
    let [along_x, _, along_y] = there.covariance_m2.unwrap();
    let own = (5.0_f64 / 2.4477).powi(2);
    assert!(
        (along_x - own - 4.0).abs() < 0.03 && (along_y - own - 1.0).abs() < 0.03,
        "{along_x} {along_y}"
    );
    let by_east = decode(&message, &origin(0.0)).unwrap().objects.remove(0);
    let [east, _, north] = by_east.covariance_m2.unwrap();
    assert!(
        (east - own - 1.0).abs() < 0.03 && (north - own - 4.0).abs() < 0.03,
        "{east} {north}"
    );
}

/// The only object of a message as the standard has it.
fn perceived(message: &EncodedCpm) -> cdd::PerceivedObject {
    let whole: CollectivePerceptionMessage = rasn::uper::decode(&message.bytes).unwrap();
    let containers = &whole.payload.cpm_containers.0.0;
    let container = containers
        .iter()
        .find(|container| container.container_id == PERCEIVED_OBJECT_CONTAINER)
        .unwrap();
    let container: PerceivedObjectContainer =
        rasn::uper::decode(container.container_data.as_bytes()).unwrap();
    assert_eq!(container.perceived_objects.0.len(), 1);
    container.perceived_objects.0[0].clone()
}

fn written(object: PerceivedObject) -> cdd::PerceivedObject {
    perceived(&encode_report(&report(vec![object]), &cell(0.0), 1).unwrap())
}

#[test]
fn excess_values_become_codes() {
    let car = PerceivedObject::new("car", 0.9, 4.0, 5.0);
    let wide = written(PerceivedObject {
        covariance_m2: Some([20.9 * 20.9, 0.0, 1e5]),
        velocity_mps: Some([170.0, -170.0]),
        heading_rad: Some(0.0),
        size_m: Some([40.0, 25.4]),
        ..car.clone()
    });
    assert_eq!(
        (
            wide.position.x_coordinate.confidence.0,
            wide.position.y_coordinate.confidence.0
        ),
        (4095, 4095)
    );
    let Some(cdd::Velocity3dWithConfidence::cartesianVelocity(velocity)) = wide.velocity else {
        panic!()
    };
    assert_eq!(
        (velocity.x_velocity.value.0, velocity.y_velocity.value.0),
        (16_382, -16_383)
    );
    assert_eq!(wide.object_dimension_x.map(|size| size.value.0), Some(255));
    assert_eq!(wide.object_dimension_y.map(|size| size.value.0), Some(254));
    // At the last centimetre, and at the codes beyond it.
    let here = WirePose::new(0.0, 0.0, 0.0);
    let places = [1310.70, 1310.71, -1310.71, -1310.72].map(|x_m| PerceivedObject {
        x_m,
        y_m: 0.0,
        ..car.clone()
    });
    let sent = ObjectReport {
        pose: Some(here),
        ..report(places.into())
    };
    let message = encode_report(&sent, &cell(0.0), 1).unwrap();
    let objects = decode(&message.bytes, &origin(0.0)).unwrap().objects;
    assert_eq!((message.left_out, objects.len()), (2, 2));
}

#[test]
fn no_heading_gives_no_box() {
    let car = PerceivedObject {
        size_m: Some([4.5, 1.8]),
        ..PerceivedObject::new("car", 0.9, 4.0, 5.0)
    };
    let turned = written(PerceivedObject {
        heading_rad: Some(1.0),
        ..car.clone()
    });
    assert!(turned.object_dimension_x.is_some() && turned.object_dimension_y.is_some());
    let unknown = written(car);
    assert!(
        unknown.object_dimension_x.is_none()
            && unknown.object_dimension_y.is_none()
            && unknown.angles.is_none()
    );
}

#[test]
fn labels_of_one_class_sum() {
    let scores = [
        ("car".into(), 0.4),
        ("dog".into(), 0.25),
        ("cat".into(), 0.25),
        ("cup".into(), 0.1),
    ]
    .into();
    let classes = written(PerceivedObject {
        scores,
        ..PerceivedObject::new("car", 0.4, 1.0, 0.0)
    })
    .classification;
    let percents: Vec<_> = classes
        .unwrap()
        .0
        .iter()
        .map(|class| class.confidence.0)
        .collect();
    assert_eq!(percents, [50, 40, 10]);
}

#[test]
fn unseen_object_keeps_last_position() {
    let coasting = |age_s| FusedObject {
        age_s: Some(age_s),
        velocity_mps: Some([10.0, 0.0]),
        ..fused(1, 50.0)
    };
    let message = |age_s| {
        let map = map(vec![coasting(age_s)], Vec::new());
        encode_map(&map, &cell(0.0), 3, &mut ObjectIds::default(), |_| true).unwrap()
    };
    let old = perceived(&message(0.8));
    assert_eq!(
        (
            old.measurement_delta_time.0,
            old.position.x_coordinate.value.0
        ),
        (-800, 4200)
    );
    let there = decode(&message(0.8).bytes, &origin(0.0))
        .unwrap()
        .objects
        .remove(0);
    assert!((there.x_m - 50.0).abs() < 0.01, "{there:?}");
    assert_eq!(perceived(&message(30.0)).measurement_delta_time.0, -2048);
    let ghost = decode(&message(1.2).bytes, &origin(0.0)).unwrap();
    assert_eq!((ghost.objects.len(), ghost.left_out), (0, 1));
}

#[test]
fn foreign_objects_are_omitted() {
    let map = map(vec![fused(1, 10.0), fused(2, 20.0)], Vec::new());
    let message = encode_map(
        &map,
        &cell(0.0),
        3,
        &mut ObjectIds::default(),
        |[x_m, _]| x_m > 15.0,
    )
    .unwrap();
    let objects = decode(&message.bytes, &origin(0.0)).unwrap().objects;
    assert_eq!(
        (objects.len(), objects[0].x_m.round(), message.left_out),
        (1, 20.0, 0)
    );
}

#[test]
fn vacancy_signs_are_no_objects() {
    let read = |label: &str| PerceivedObject::new(label, 0.9, 4.0, 5.0);
    let sent = report(vec![read("EMPTY"), read("MNOP101"), read("car")]);
    let message = encode_report(&sent, &cell(0.0), 1).unwrap();
    let labels: Vec<_> = decode(&message.bytes, &origin(0.0))
        .unwrap()
        .objects
        .into_iter()
        .map(|object| object.label)
        .collect();
    assert_eq!(
        (labels, message.left_out),
        (vec!["object".into(), "car".into()], 0)
    );
    let stray = FusedObject {
        label: "EMPTY".into(),
        ..fused(1, 3.0)
    };
    let message = encode_map(
        &map(vec![stray], Vec::new()),
        &cell(0.0),
        3,
        &mut ObjectIds::default(),
        |_| true,
    )
    .unwrap();
    assert!(
        decode(&message.bytes, &origin(0.0))
            .unwrap()
            .objects
            .is_empty()
    );
}

#[test]
fn receiver_parts_are_recognised() {
    let is_received = |name: &'static str| is_received(&NodeName::from_static(name));
    assert!(is_received("edge--cpm-4711"));
    assert!(
        ![
            "edge",
            "edge--cpm",
            "edge--ros2",
            "cpm-1",
            "euclid--cpmlike"
        ]
        .into_iter()
        .any(is_received)
    );
}

#[test]
fn station_numbers_are_bounded() {
    let mut numbers = StationIds::new(NodeName::from_static("lot-1"));
    let start = Instant::now();
    let name = |index: u32| NodeName::new(format!("node-{index}")).unwrap();
    let all: BTreeSet<_> = (0..4096)
        .map(|index| numbers.of(&name(index), start).unwrap())
        .collect();
    assert_eq!((all.len(), numbers.of(&name(4096), start)), (4096, None));
    let later = start + Duration::from_secs(59);
    let of_seven = numbers.of(&name(7), later).unwrap();
    let much_later = start + Duration::from_secs(61);
    assert!(
        numbers.of(&name(4096), much_later).is_some(),
        "silent nodes make room"
    );
    assert!(numbers.contains(of_seven, much_later));
    assert!(
        !numbers.contains(of_seven, later + Duration::from_secs(61)),
        "a silent node's number is no echo"
    );
}

#[test]
fn invented_parts_take_no_numbers() {
    let mut numbers = StationIds::new(NodeName::from_static("lot-1"));
    let now = Instant::now();
    let part = |index: u32| NodeName::new(format!("evil--{index}")).unwrap();
    assert_eq!(
        (0..500)
            .filter_map(|index| numbers.of(&part(index), now))
            .count(),
        17
    );
    assert!(numbers.of(&NodeName::from_static("euclid"), now).is_some());
}
