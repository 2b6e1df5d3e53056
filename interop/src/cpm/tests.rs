#![allow(clippy::indexing_slicing, clippy::unwrap_used, clippy::expect_used, clippy::panic)]

use std::f64::consts::{PI, TAU};

use ecod::model::epoch::Epoch;
use ecod::model::geometry::{Covariance, wrap_angle};
use ecod::model::names::NodeName;
use ecod::model::origin::GeographicOrigin;
use ecod::wire::{FusedObject, GlobalMap, LandmarkState, Limits, ObjectReport, SCHEMA_VERSION, WirePose};
use proptest::prelude::*;
use uuid::Uuid;

use super::*;

const NOW: Timestamp = Timestamp(1_795_239_882_123_000);

fn origin(rotation_deg: f64) -> GeographicOrigin {
    GeographicOrigin { latitude_deg: 52.2296756, longitude_deg: 21.0122287, height_m: 113.0, rotation_deg }
}

fn report(objects: Vec<PerceivedObject>) -> ObjectReport {
    ObjectReport { objects, ..ObjectReport::new(NodeName::from_static("euclid"), 1, NOW) }
}

fn map(objects: Vec<FusedObject>, landmarks: Vec<LandmarkState>) -> GlobalMap {
    let Epoch { term, leader } = Epoch::new(7, NodeName::from_static("edge"));
    GlobalMap {
        schema: SCHEMA_VERSION,
        aggregator: leader,
        epoch: term,
        round: 1,
        fused_at_us: NOW,
        oldest_capture_us: None,
        landmarks,
        objects,
        pose_corrections: Default::default(),
        neighbour_objects: Vec::new(),
    }
}

fn fused(id: u128, x_m: f64) -> FusedObject {
    FusedObject::new(Uuid::from_u128(id), "car", 0.8, x_m, 0.0, Covariance::isotropic(0.04))
}

fn detection() -> impl Strategy<Value = PerceivedObject> {
    let position = (-500.0..500.0, -500.0..500.0);
    let motion = proptest::option::of([-60.0..60.0, -60.0..60.0]);
    let label =
        prop_oneof![Just("car"), Just("bus"), Just("person"), Just("bicycle"), Just("motorcycle"), Just("object")];
    let shape = proptest::option::of([0.2..25.0, 0.2..25.0]);
    (label, 0.0..1.0, position, proptest::option::of(0.0001..9.0), motion, proptest::option::of(-PI..PI), shape)
        .prop_map(|(label, confidence, (x_m, y_m), variance, velocity_mps, heading_rad, size_m)| PerceivedObject {
            covariance_m2: variance.map(|variance: f64| [variance, 0.0, variance]),
            velocity_mps,
            heading_rad,
            size_m,
            ..PerceivedObject::new(label, confidence, x_m, y_m)
        })
}

proptest! {
    #[test]
    fn a_report_comes_back_within_the_resolution_of_the_standard(
        objects in proptest::collection::vec(detection(), 0..40),
        pose in proptest::option::of((-400.0..400.0, -400.0..400.0, -PI..PI)),
        rotation_deg in -180.0..180.0,
        station in any::<u32>(),
    ) {
        let pose = pose.map(|(x_m, y_m, heading_rad)| WirePose::new(x_m, y_m, heading_rad));
        let sent = ObjectReport { pose, ..report(objects) };
        let message = encode_report(&sent, &origin(rotation_deg), station).unwrap();
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
            prop_assert_eq!(other.covariance_m2.is_some(), object.covariance_m2.is_some());
            if let (Some([xx, xy, yy]), Some([variance, ..])) = (other.covariance_m2, object.covariance_m2) {
                let coarser = (variance.sqrt() + 0.01 / SIGMAS).powi(2) + 1e-9;
                prop_assert!(xx >= variance - 1e-9 && yy >= variance - 1e-9, "no certainty is gained");
                prop_assert!(xx <= coarser && yy <= coarser && xy.abs() < 1e-9);
            }
            prop_assert_eq!(other.velocity_mps.is_some(), object.velocity_mps.is_some());
            for (got, was) in other.velocity_mps.iter().flatten().zip(object.velocity_mps.iter().flatten()) {
                prop_assert!((got - was).abs() < 0.0072, "{} {}", got, was);
            }
            prop_assert_eq!(other.heading_rad.is_some(), object.heading_rad.is_some());
            for (got, was) in other.heading_rad.iter().zip(object.heading_rad) {
                prop_assert!(wrap_angle(got - was).abs() < TAU / 7200.0 + 1e-6);
            }
            prop_assert_eq!(other.size_m.is_some(), object.size_m.is_some());
            for (got, was) in other.size_m.iter().flatten().zip(object.size_m.iter().flatten()) {
                prop_assert!((got - was).abs() < 0.0501);
            }
        }
    }

    #[test]
    fn hostile_bytes_are_refused_or_become_a_valid_report(
        mut tail in proptest::collection::vec(any::<u8>(), 0..400),
        flips in proptest::collection::vec((0usize..200, any::<u8>()), 0..6),
    ) {
        let objects = vec![PerceivedObject::new("car", 0.9, 4.0, 5.0); 3];
        let mut bytes = encode_report(&report(objects), &origin(0.0), 9).unwrap().bytes;
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
fn an_object_keeps_its_number_and_two_never_share_one() {
    let mut ids = ObjectIds::default();
    // The first two bytes of all are equal.
    let all: Vec<_> = (1..=3).map(Uuid::from_u128).collect();
    let first = ids.assign(&all);
    assert_eq!(all.iter().map(|id| first[id]).collect::<Vec<_>>(), [0, 1, 2]);
    let second = ids.assign(&[all[2], Uuid::from_u128(4), all[1]]);
    assert_eq!((second[&all[1]], second[&all[2]], second[&Uuid::from_u128(4)]), (1, 2, 0));
}

#[test]
fn a_node_has_the_same_station_number_in_every_run() {
    let numbers = || StationIds::new(NodeName::from_static("lot-1"));
    let (euclid, gauss) = (NodeName::from_static("euclid"), NodeName::from_static("gauss"));
    let (mut one, mut other) = (numbers(), numbers());
    let of_gauss = one.of(&gauss).unwrap();
    assert_ne!(of_gauss, one.of(&euclid).unwrap());
    assert_eq!(one.of(&euclid), other.of(&euclid));
    assert!(one.is_own(of_gauss) && !other.is_own(of_gauss));
}

#[test]
fn a_map_has_its_objects_and_the_road_users_at_known_locations() {
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
    let places = vec![at("a", Some("truck")), at("b", Some("EMPTY")), at("c", None)];
    let message = encode_map(&map(vec![fused(1, 12.0)], places), &origin(0.0), 3, &mut ObjectIds::default()).unwrap();
    let objects = decode(&message.bytes, &origin(0.0)).unwrap().objects;
    let labels: Vec<_> = objects.iter().map(|object| (object.label.as_str(), object.x_m.round())).collect();
    assert_eq!(labels, [("truck", 5.0), ("car", 12.0)]);
}

#[test]
fn of_too_many_objects_the_surest_are_sent() {
    let objects =
        (0..300_u16).map(|number| FusedObject { confidence: f64::from(number) / 300.0, ..fused(number.into(), 1.0) });
    let large = map(objects.collect(), Vec::new());
    let message = encode_map(&large, &origin(0.0), 3, &mut ObjectIds::default()).unwrap();
    assert_eq!(message.left_out, 45);
    let received = decode(&message.bytes, &origin(0.0)).unwrap();
    assert!(received.objects.len() == 255 && received.objects.iter().all(|object| object.confidence > 0.13));
    assert!(message.bytes.len() < MAX_BYTES / 2, "{}", message.bytes.len());
}

#[test]
fn a_map_far_from_the_origin_has_its_reference_position_among_its_objects() {
    let far = map(vec![fused(1, 5000.0), fused(2, 5800.0), fused(3, 9000.0)], Vec::new());
    let message = encode_map(&far, &origin(30.0), 3, &mut ObjectIds::default()).unwrap();
    assert_eq!(message.left_out, 2, "the middle is 2 km from the outermost");
    let near = map(vec![fused(1, 5000.0), fused(2, 5800.0)], Vec::new());
    let message = encode_map(&near, &origin(30.0), 3, &mut ObjectIds::default()).unwrap();
    let objects = decode(&message.bytes, &origin(30.0)).unwrap().objects;
    assert!((objects[0].x_m - 5000.0).abs() < 0.01 && (objects[1].x_m - 5800.0).abs() < 0.01);
}

#[test]
fn messages_that_are_not_for_here_are_refused_by_reason() {
    let message = encode_report(&report(Vec::new()), &origin(0.0), 1).unwrap().bytes;
    let there = GeographicOrigin { latitude_deg: 48.0, ..origin(0.0) };
    assert_eq!(decode(&message, &there), Err(CpmError::TooFar));
    assert_eq!(decode(&message[..12], &origin(0.0)), Err(CpmError::Malformed));
    assert_eq!(decode(&[2, 2, 0, 0], &origin(0.0)), Err(CpmError::OtherMessage));
    assert_eq!(decode(&vec![0; MAX_BYTES + 1], &origin(0.0)), Err(CpmError::TooLarge));
    let early = ObjectReport { captured_at_us: Timestamp(5), ..report(Vec::new()) };
    assert_eq!(encode_report(&early, &origin(0.0), 1), Err(CpmError::NoTime));
}

#[test]
fn a_covariance_turns_with_the_frames() {
    // The cell's x axis points north.
    let quarter = origin(90.0);
    let object = PerceivedObject { covariance_m2: Some([4.0, 0.0, 1.0]), ..PerceivedObject::new("car", 0.9, 3.0, 2.0) };
    let message = encode_report(&report(vec![object]), &quarter, 1).unwrap().bytes;
    let there = decode(&message, &quarter).unwrap().objects.remove(0);
    let [along_x, _, along_y] = there.covariance_m2.unwrap();
    assert!((along_x - 4.0).abs() < 0.03 && (along_y - 1.0).abs() < 0.03, "{along_x} {along_y}");
    let by_east = decode(&message, &origin(0.0)).unwrap().objects.remove(0);
    let [east, _, north] = by_east.covariance_m2.unwrap();
    assert!((east - 1.0).abs() < 0.03 && (north - 4.0).abs() < 0.03, "{east} {north}");
}
