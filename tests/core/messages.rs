//! Each message of the wire as JSON, with every field that it can have.
//!
//! Other programs read these. A change is accepted by `INSTA_UPDATE=always make snapshots`.

use std::collections::BTreeMap;
use std::fmt::Debug;

use ecod::model::names::NodeName;
use ecod::model::origin::GeographicOrigin;
use ecod::model::time::Timestamp;
use ecod::wire::{
    BoxCamera, BoxReport, CellDescription, CellMap, ClientRefusal, ClientRefusals, ContentHash,
    DescriptionStatus, FieldOfView, FusedObject, GlobalMap, LabelReading, LandmarkState,
    LedgerEntry, LedgerMark, LedgerShare, LedgerSignature, NeighbourObject, NodeState, NodeStatus,
    ObjectReport, PerceivedObject, PixelBox, PoseCorrection, Reputation, Reputations, Role,
    Trouble, Verdict, Verdicts, WirePose,
};
use serde::Serialize;
use serde::de::DeserializeOwned;
use uuid::Uuid;

const ID: Uuid = Uuid::from_u128(0x018f_0000_0000_7000_8000_0000_0000_0001);
const AT: Timestamp = Timestamp(1_732_154_400_123_456);

/// Compares the message as JSON with its snapshot; it must be the same message when it is read.
fn check<T: Serialize + DeserializeOwned + PartialEq + Debug>(snapshot: &str, message: &T) {
    let text = serde_json::to_string_pretty(message).unwrap();
    assert_eq!(&serde_json::from_str::<T>(&text).unwrap(), message);
    insta::with_settings!({ omit_expression => true }, {
        insta::assert_snapshot!(snapshot, text);
    });
}

fn name(text: &'static str) -> NodeName {
    NodeName::from_static(text)
}

fn origin() -> GeographicOrigin {
    GeographicOrigin {
        latitude_deg: 52.2,
        longitude_deg: 21.0,
        height_m: 113.0,
        rotation_deg: 40.0,
    }
}

fn fused_object() -> FusedObject {
    FusedObject {
        id: ID,
        label: "car".into(),
        confidence: 0.93,
        x_m: 12.5,
        y_m: -3.25,
        covariance_m2: [0.02, 0.001, 0.03],
        contributors: vec![name("euclid"), name("gauss")],
        existence: Some(0.98),
        scores: BTreeMap::from([("car".into(), 0.93), ("truck".into(), 0.07)]),
        velocity_mps: Some([1.5, 0.25]),
        heading_rad: Some(0.165),
        size_m: Some([4.5, 1.8]),
        age_s: Some(0.1),
        first_seen_us: Some(AT),
        vehicle: Some(name("gauss")),
    }
}

fn map() -> GlobalMap {
    GlobalMap {
        schema: 1,
        aggregator: name("edge"),
        epoch: 3,
        round: 17,
        fused_at_us: AT,
        oldest_capture_us: Some(Timestamp(AT.0 - 80_000)),
        landmarks: vec![LandmarkState {
            id: "slot-0".into(),
            label: Some("ABC123".into()),
            confidence: 0.9,
            x_m: 2.0,
            y_m: 1.0,
            contributors: vec![name("euclid")],
            observers: vec![name("euclid"), name("gauss")],
            readings: vec![LabelReading {
                label: "ABC128".into(),
                nodes: vec![name("gauss")],
            }],
        }],
        objects: vec![fused_object()],
        pose_corrections: BTreeMap::from([(
            name("euclid"),
            PoseCorrection {
                about_m: [1.0, 6.0],
                dx_m: 0.2,
                dy_m: -0.1,
                dheading_rad: 0.01,
                pairs: 5.5,
            },
        )]),
        neighbour_objects: vec![NeighbourObject {
            cell: name("lot-2"),
            age_s: 0.3,
            object: fused_object(),
        }],
    }
}

#[test]
fn report() {
    check(
        "report",
        &ObjectReport {
            schema: 1,
            node: name("euclid"),
            seq: 42,
            captured_at_us: AT,
            pose: Some(WirePose {
                x_m: 1.0,
                y_m: 6.0,
                heading_rad: -1.57,
                height_m: Some(0.5),
                pitch_rad: Some(0.02),
                roll_rad: Some(-0.01),
            }),
            objects: vec![PerceivedObject {
                label: "car".into(),
                confidence: 0.9,
                x_m: 12.5,
                y_m: -3.25,
                covariance_m2: Some([0.02, 0.001, 0.03]),
                landmark: Some("slot-0".into()),
                velocity_mps: Some([1.5, 0.25]),
                heading_rad: Some(0.165),
                size_m: Some([4.5, 1.8]),
                scores: BTreeMap::from([("car".into(), 0.9), ("truck".into(), 0.1)]),
            }],
            seen: Some(vec!["slot-0".into(), "slot-1".into()]),
            view: Some(FieldOfView {
                range_m: 30.0,
                angle_rad: 1.05,
            }),
            clock_error_us: Some(1500),
            frame_yaw_rate_radps: Some(0.1),
            moving: Some(true),
        },
    );
}

#[test]
fn box_report() {
    check(
        "box_report",
        &BoxReport {
            schema: 1,
            node: name("euclid--yolo"),
            seq: 42,
            captured_at_us: AT,
            pose: WirePose {
                height_m: Some(1.3),
                pitch_rad: Some(0.07),
                ..WirePose::new(1.0, 6.0, -1.57)
            },
            camera: BoxCamera {
                width_px: 640,
                height_px: 480,
                fx: Some(500.0),
                fy: Some(501.0),
                cx: Some(320.0),
                cy: Some(240.0),
                distortion: vec![-0.1, 0.01, 0.0, 0.0],
                pixel_sigma_px: Some(2.0),
                heading_sigma_rad: Some(0.02),
                tilt_sigma_rad: Some(0.01),
                height_sigma_m: Some(0.05),
                position_sigma_m: Some(0.1),
                ..BoxCamera::default()
            },
            boxes: vec![PixelBox {
                label: "person".into(),
                confidence: 0.93,
                x_min: 300.0,
                y_min: 120.5,
                x_max: 340.0,
                y_max: 260.0,
            }],
            moving: Some(false),
        },
    );
}

#[test]
fn shortest_report() {
    check(
        "shortest_report",
        &ObjectReport::new(name("euclid"), 42, AT),
    );
}

#[test]
fn global_map() {
    check("global_map", &map());
}

#[test]
fn cell_map() {
    check(
        "cell_map",
        &CellMap {
            schema: 1,
            cell: name("lot-1"),
            sent_at_us: AT,
            origin: origin(),
            map: GlobalMap {
                landmarks: Vec::new(),
                objects: Vec::new(),
                pose_corrections: BTreeMap::new(),
                neighbour_objects: Vec::new(),
                ..map()
            },
        },
    );
}

#[test]
fn verdicts() {
    check(
        "verdicts",
        &Verdicts {
            schema: 1,
            aggregator: name("edge"),
            epoch: 3,
            round: 17,
            fused_at_us: AT,
            verdicts: vec![Verdict {
                landmark: "ball".into(),
                label: Some("cup".into()),
                score: 1.6,
                margin: 0.9,
                votes: BTreeMap::from([("cup".into(), 1.6), ("dog".into(), 0.7)]),
                contributors: vec![name("euclid"), name("gauss")],
            }],
        },
    );
}

#[test]
fn reputations() {
    check(
        "reputations",
        &Reputations {
            schema: 1,
            aggregator: Some(name("edge")),
            epoch: 3,
            round: 17,
            reputations: BTreeMap::from([(
                name("euclid"),
                Reputation {
                    score: 0.8,
                    correct: 40,
                    incorrect: 2,
                },
            )]),
        },
    );
}

#[test]
fn ledger_share() {
    check(
        "ledger_share",
        &LedgerShare {
            schema: 1,
            node: name("gauss"),
            epoch: Some(3),
            entries: vec![LedgerEntry {
                epoch: 3,
                aggregator: name("edge"),
                node: name("euclid"),
                label: "cup".into(),
                correct: 40,
                incorrect: 2,
            }],
            marks: vec![LedgerMark {
                epoch: 3,
                aggregator: name("edge"),
                node: name("euclid"),
                number: 7,
                correct: 38,
                incorrect: 2,
            }],
            signed: Some(LedgerSignature {
                certificate: "Y2VydGlmaWNhdGU=".into(),
                signature: "c2lnbmF0dXJl".into(),
            }),
            reset_at_us: Some(AT),
        },
    );
}

#[test]
fn node_status() {
    check(
        "node_status",
        &NodeStatus {
            schema: 1,
            node: name("edge"),
            id: ID,
            role: Role::Edge,
            state: NodeState::Aggregating,
            epoch: 3,
            aggregator: Some(name("edge")),
            fit: Some(true),
            version: "0.1.0".into(),
            description: Some(DescriptionStatus {
                version: 2,
                hash: ContentHash([0xab; 32]),
                problem: Some("landmarks[0].x_m must be finite".into()),
            }),
            troubles: vec![Trouble {
                kind: "clock".into(),
                about: Some("gauss".into()),
                cause: "its clock is 3 s ahead".into(),
                remedy: "synchronise it by NTP".into(),
            }],
            page: Some("http://192.0.2.1:8080/".into()),
            dismissed: vec![name("riemann")],
        },
    );
}

#[test]
fn cell_description() {
    check(
        "cell_description",
        &CellDescription {
            schema: 1,
            version: 2,
            hash: ContentHash([0xab; 32]),
            set_by: name("edge"),
            text: "[[landmarks]]\nid = \"slot-0\"\nx_m = 0\ny_m = 0\n".into(),
        },
    );
}

#[test]
fn client_refusals() {
    check(
        "client_refusals",
        &ClientRefusals {
            schema: 1,
            node: name("edge"),
            refused: vec![ClientRefusal {
                client: "edge--page".into(),
                reason: "not_permitted".into(),
                topic: "ecod/v1/lot-1/global_detections".into(),
                text: "only the leader publishes maps".into(),
                times: 3,
            }],
        },
    );
}

/// A message without a snapshot would be changed unseen.
#[test]
fn every_message_has_a_snapshot() {
    let tested = [
        "BoxReport",
        "CellDescription",
        "CellMap",
        "ClientRefusals",
        "GlobalMap",
        "LedgerShare",
        "NodeStatus",
        "ObjectReport",
        "Reputations",
        "Verdicts",
    ];
    assert!(ecod::wire::schemas().into_keys().eq(tested));
}
