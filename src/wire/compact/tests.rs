use super::*;
use crate::model::geometry::Covariance;
use crate::model::origin::GeographicOrigin;
use crate::wire::{
    CellDescription, CellMap, ContentHash, DescriptionStatus, Encoding, FieldOfView, FusedObject,
    GlobalMap, LabelReading, LandmarkState, Limits, NeighbourObject, NodeState, NodeStatus,
    ObjectReport, Payload, PerceivedObject, PoseCorrection, Reputation, Reputations, Role,
    SCHEMA_VERSION, Trouble, Verdict, Verdicts, WirePose, decode, encode,
};

fn report() -> ObjectReport {
    ObjectReport {
        pose: Some(WirePose::new(0.61, 0.46, 2.88)),
        objects: vec![PerceivedObject {
            covariance_m2: Some([0.0004, 0.0, 0.0001]),
            landmark: Some("slot-0".into()),
            ..PerceivedObject::new("ABCD123", 0.93, 0.25, -70.0)
        }],
        seen: Some(vec!["slot-0".into(), "slot-1".into()]),
        ..ObjectReport::new(
            NodeName::from_static("euclid"),
            412,
            Timestamp(1_732_154_400_123_456),
        )
    }
}

/// Other programs rely on every place.
#[test]
fn a_report_keeps_its_form() {
    let expected = "87 01 66 65 75 63 6c 69 64 19 01 9c 1b 00 06 27 62 9f b7 2a 40 \
        81 86 67 41 42 43 44 31 32 33 f9 3b 71 18 fa 3a 00 01 11 6f 83 f9 0e 8e 00 f9 06 8e 66 73 6c 6f 74 2d 30 \
        83 19 02 62 19 01 cc fa 40 38 51 ec 82 66 73 6c 6f 74 2d 30 66 73 6c 6f 74 2d 31";
    let written: Vec<String> = encode(&report(), Encoding::Compact)
        .iter()
        .map(|byte| format!("{byte:02x}"))
        .collect();
    assert_eq!(written.join(" "), expected);
}

#[track_caller]
fn survives<T: Payload + PartialEq + std::fmt::Debug>(payload: &T) {
    let bytes = encode(payload, Encoding::Compact);
    assert!(is_compact(bytes[0]));
    assert_eq!(
        decode::<T>(&bytes, &Limits::default()).as_ref(),
        Ok(payload)
    );
    assert!(
        bytes.len() * 2 < encode(payload, Encoding::Json).len(),
        "less than half of the JSON"
    );
}

/// With numbers that need no rounding.
#[test]
fn every_field_survives() {
    let node = NodeName::from_static;
    survives(&ObjectReport {
        pose: Some(WirePose {
            height_m: Some(2.5),
            pitch_rad: Some(0.25),
            roll_rad: Some(-0.125),
            ..WirePose::new(0.61, 0.46, 2.875)
        }),
        view: Some(FieldOfView {
            range_m: 60.0,
            angle_rad: 6.25,
        }),
        frame_yaw_rate_radps: Some(-0.375),
        moving: Some(false),
        ..report_without_rounding()
    });
    let fused_at_us = Timestamp(1_732_154_400_123_456);
    let map = GlobalMap {
        schema: SCHEMA_VERSION,
        aggregator: node("edge"),
        epoch: 3,
        round: 88,
        fused_at_us,
        oldest_capture_us: Some(Timestamp(1_732_154_400_000_000)),
        landmarks: vec![
            LandmarkState {
                id: "slot-0".into(),
                label: Some("ABCD123".into()),
                confidence: 0.9375,
                x_m: 0.25,
                y_m: 123_456.789,
                contributors: vec![node("edge")],
                observers: vec![node("edge"), node("euclid")],
                readings: vec![LabelReading {
                    label: "EMPTY".into(),
                    nodes: vec![NodeName::from_static("galileo")],
                }],
            },
            LandmarkState {
                id: "slot-1".into(),
                label: None,
                confidence: 0.0,
                x_m: -0.001,
                y_m: 0.0,
                contributors: vec![],
                observers: vec![],
                readings: Vec::new(),
            },
        ],
        objects: vec![FusedObject {
            id: Uuid::from_u128(7),
            label: "car".into(),
            confidence: 0.75,
            x_m: 12.4,
            y_m: -3.1,
            covariance_m2: [0.0625, -0.03125, 1.0],
            contributors: vec![node("euclid"), node("gauss")],
            existence: Some(0.5),
            scores: [("car".into(), 0.75), ("truck".into(), 0.25)].into(),
            velocity_mps: Some([8.25, -0.125]),
            heading_rad: Some(-0.5),
            size_m: Some([4.5, 1.875]),
            age_s: Some(0.0625),
            first_seen_us: Some(fused_at_us),
            vehicle: Some(node("gauss")),
        }],
        pose_corrections: [(
            node("gauss"),
            PoseCorrection {
                about_m: [1.0, 2.0],
                dx_m: 0.2,
                dy_m: -0.1,
                dheading_rad: 0.015625,
                pairs: 12.5,
            },
        )]
        .into(),
        neighbour_objects: vec![NeighbourObject {
            cell: node("lot-2"),
            age_s: 0.125,
            object: FusedObject::new(
                Uuid::max(),
                "car",
                0.5,
                7.5,
                -1.25,
                Covariance {
                    xx: 0.25,
                    xy: 0.0,
                    yy: 0.5,
                },
            ),
        }],
    };
    survives(&map);
    survives(&CellMap {
        schema: SCHEMA_VERSION,
        cell: node("lot-1"),
        sent_at_us: fused_at_us,
        origin: GeographicOrigin {
            latitude_deg: 48.8584,
            longitude_deg: 2.2945,
            height_m: 30.5,
            rotation_deg: -5.0,
        },
        map,
    });
    survives(&Verdicts {
        schema: SCHEMA_VERSION,
        aggregator: node("edge"),
        epoch: 3,
        round: 88,
        fused_at_us,
        verdicts: vec![Verdict {
            landmark: "ball".into(),
            label: Some("sports ball".into()),
            score: 1.84375,
            margin: 0.625,
            votes: [("sports ball".into(), 1.84375), ("cup".into(), 2.46875)].into(),
            contributors: vec![node("euclid")],
        }],
    });
    let reputation = Reputation {
        score: 0.625,
        correct: 410,
        incorrect: 22,
    };
    let reputations = [(node("euclid"), reputation)].into();
    survives(&Reputations {
        schema: SCHEMA_VERSION,
        aggregator: Some(node("edge")),
        epoch: 3,
        round: 88,
        reputations,
    });
    let text = "[[landmarks]]\n".to_owned();
    survives(&CellDescription {
        schema: SCHEMA_VERSION,
        version: 7,
        hash: ContentHash([9; 32]),
        set_by: node("edge"),
        text,
    });
    survives(&NodeStatus {
        state: NodeState::Aggregating,
        epoch: 3,
        aggregator: Some(node("edge")),
        fit: Some(true),
        description: Some(DescriptionStatus {
            version: 7,
            hash: ContentHash([9; 32]),
            problem: Some("no".into()),
        }),
        troubles: vec![Trouble {
            kind: "clock_off".into(),
            about: Some("late".into()),
            cause: "its clock is 5.0 s ahead".into(),
            remedy: "run a time service".into(),
        }],
        page: Some("10.0.0.2:8080".into()),
        dismissed: vec![node("gauss")],
        ..NodeStatus::starting(node("edge"), Uuid::from_u128(7), Role::Edge, "0.1.0")
    });
}

fn report_without_rounding() -> ObjectReport {
    let object = PerceivedObject {
        covariance_m2: Some([0.0625, 0.0, 1.0]),
        velocity_mps: Some([30.0, -0.5]),
        heading_rad: Some(-3.0),
        size_m: Some([4.5, 1.875]),
        scores: [("car".into(), 0.75), ("truck".into(), 0.25)].into(),
        ..PerceivedObject::new("car", 0.75, 99_999_999.999, -0.001)
    };
    ObjectReport {
        objects: vec![object],
        pose: None,
        ..report()
    }
}

/// Encodings by other programs: floats of any width in place of integers, arrays of indefinite
/// length, and more indices than this version has.
#[test]
fn what_others_write_is_read() {
    let mut bytes = Vec::new();
    let mut e = Encoder::new(&mut bytes);
    let object =
        |e: &mut Encoder<&mut Vec<u8>>| -> Result<(), encode::Error<std::convert::Infallible>> {
            e.array(11)?.str("car")?.f64(0.5)?.f64(1500.0)?.i64(-20)?;
            e.array(3)?.f32(0.25)?.u8(0)?.f16(0.5)?;
            e.null()?
                .null()?
                .null()?
                .null()?
                .map(0)?
                .array(1)?
                .str("of a later version")?
                .ok()
        };
    e.begin_array()
        .unwrap()
        .u8(1)
        .unwrap()
        .str("euclid")
        .unwrap()
        .u8(7)
        .unwrap()
        .u32(5)
        .unwrap();
    e.begin_array().unwrap();
    object(&mut e).unwrap();
    e.end()
        .unwrap()
        .null()
        .unwrap()
        .null()
        .unwrap()
        .null()
        .unwrap()
        .null()
        .unwrap()
        .null()
        .unwrap();
    e.bool(true).unwrap().end().unwrap();
    let report: ObjectReport = decode(&bytes, &Limits::default()).unwrap();
    let expected = PerceivedObject {
        covariance_m2: Some([0.25, 0.0, 0.5]),
        ..PerceivedObject::new("car", 0.5, 1.5, -0.02)
    };
    assert_eq!((report.seq, report.objects), (7, vec![expected]));
}
