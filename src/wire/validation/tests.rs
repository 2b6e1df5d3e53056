mod shares;

use proptest::collection::{btree_map, vec};
use proptest::prelude::*;
use uuid::Uuid;

use super::*;
use crate::model::epoch::Epoch;
use crate::model::names::{Label, NodeName};
use crate::wire::{
    Encoding, NeighbourObject, NodeState, Reputation, Role, decode, decode_entries, encode,
};

fn edge() -> NodeName {
    NodeName::from_static("edge")
}

fn map() -> GlobalMap {
    GlobalMap {
        oldest_capture_us: Some(Timestamp(1_732_154_400_000_000)),
        landmarks: vec![LandmarkState {
            id: "slot-0".into(),
            label: Some("ABCD123".into()),
            confidence: 0.93,
            x_m: 0.25,
            y_m: 0.48,
            contributors: vec![edge()],
            observers: vec![edge()],
            readings: Vec::new(),
        }],
        objects: vec![FusedObject {
            contributors: vec![edge()],
            existence: Some(0.9),
            scores: [("car".into(), 0.9), ("truck".into(), 0.1)].into(),
            velocity_mps: Some([3.0, -4.0]),
            heading_rad: Some(-0.9),
            size_m: Some([4.5, 1.8]),
            age_s: Some(0.1),
            first_seen_us: Some(Timestamp(1_732_154_390_000_000)),
            vehicle: Some(edge()),
            ..FusedObject::new(
                Uuid::nil(),
                "car",
                0.8,
                1.0,
                2.0,
                Covariance {
                    xx: 0.1,
                    xy: 0.0,
                    yy: 0.2,
                },
            )
        }],
        pose_corrections: [(
            edge(),
            PoseCorrection {
                about_m: [1.0, 2.0],
                dx_m: 0.2,
                dy_m: -0.1,
                dheading_rad: 0.01,
                pairs: 12.5,
            },
        )]
        .into(),
        ..GlobalMap::new(&Epoch::new(3, edge()), 88, Timestamp(1_732_154_400_123_456))
    }
}

fn cell_map() -> CellMap {
    CellMap {
        schema: SCHEMA_VERSION,
        cell: NodeName::from_static("lot-1"),
        sent_at_us: Timestamp(1_732_154_400_130_000),
        origin: GeographicOrigin {
            latitude_deg: 48.8,
            longitude_deg: 2.3,
            height_m: 30.0,
            rotation_deg: 5.0,
        },
        map: map(),
    }
}

fn verdicts() -> Verdicts {
    Verdicts {
        schema: SCHEMA_VERSION,
        aggregator: edge(),
        epoch: 3,
        round: 88,
        fused_at_us: Timestamp(1_732_154_400_123_456),
        verdicts: vec![Verdict {
            landmark: "ball".into(),
            label: Some("sports ball".into()),
            score: 2.45,
            margin: 0.61,
            votes: [("sports ball".into(), 2.45), ("cup".into(), 1.84)].into(),
            contributors: vec![edge()],
        }],
    }
}

fn reputations() -> Reputations {
    let reputation = Reputation {
        score: 0.62,
        correct: 410,
        incorrect: 22,
    };
    let reputations = [(edge(), reputation)].into();
    Reputations {
        schema: SCHEMA_VERSION,
        aggregator: Some(edge()),
        epoch: 3,
        round: 88,
        reputations,
    }
}

fn status() -> NodeStatus {
    NodeStatus {
        schema: SCHEMA_VERSION,
        node: edge(),
        id: Uuid::nil(),
        role: Role::Edge,
        state: NodeState::Aggregating,
        epoch: 3,
        aggregator: Some(edge()),
        fit: Some(true),
        version: "0.1.0".into(),
        description: None,
        troubles: vec![Trouble {
            kind: "clock_off".into(),
            about: Some("late".into()),
            cause: "refused, its clock is 5.0 s ahead".into(),
            remedy: "run a time service".into(),
        }],
        page: Some("[fe80::1]:8080".into()),
        dismissed: vec![NodeName::from_static("gauss")],
    }
}

/// Spoils an entry of a sound payload in every listed way and sends it: that entry alone is left
/// out, and its contributor named.
fn each_flawed_entry_is_left_out<T: Payload + PartialEq + std::fmt::Debug>(
    sound: impl Fn() -> T,
    without: impl Fn(&T) -> usize,
    flaws: &[Flaw<T>],
) {
    for encoding in [Encoding::Cbor, Encoding::Compact] {
        for (index, (spoil, expected)) in flaws.iter().enumerate() {
            let mut payload = sound();
            spoil(&mut payload);
            let sent = encode(&payload, encoding);
            let (received, invalid) = decode_entries::<T>(&sent, &Limits::default()).unwrap();
            let reasons: Vec<_> = invalid.iter().map(|entry| entry.reason).collect();
            assert_eq!(reasons, [*expected], "flaw {index} in {encoding:?}");
            assert_eq!(
                invalid[0].contributors,
                [edge()],
                "flaw {index} in {encoding:?}"
            );
            assert_eq!(
                without(&received) + 1,
                without(&sound()),
                "flaw {index} in {encoding:?}"
            );
        }
    }
}

/// A change that spoils a payload, and the reason that is then given.
type Flaw<T> = (fn(&mut T), RejectReason);

/// Spoils a sound payload in every listed way and sends it; CBOR, because JSON has no word for NaN.
fn each_flaw_has_its_reason<T: Payload>(sound: impl Fn() -> T, flaws: &[Flaw<T>]) {
    for encoding in [Encoding::Cbor, Encoding::Compact] {
        let received =
            |payload: &T| decode::<T>(&encode(payload, encoding), &Limits::default()).err();
        assert_eq!(received(&sound()), None);
        for (index, (spoil, expected)) in flaws.iter().enumerate() {
            let mut payload = sound();
            spoil(&mut payload);
            assert_eq!(
                received(&payload),
                Some(*expected),
                "flaw {index} in {encoding:?}"
            );
        }
    }
}

#[test]
fn map_flaws_have_reasons() {
    fn edge_of(map: &mut GlobalMap) -> &mut PoseCorrection {
        map.pose_corrections.get_mut(&edge()).unwrap()
    }
    each_flaw_has_its_reason(
        map,
        &[
            (|m| m.epoch = 1 << 53, RejectReason::OutOfRange),
            (|m| m.round = u64::MAX, RejectReason::OutOfRange),
            (
                |m| m.fused_at_us = Timestamp(u64::MAX),
                RejectReason::OutOfRange,
            ),
            (
                |m| m.oldest_capture_us = Some(Timestamp(1 << 53)),
                RejectReason::OutOfRange,
            ),
        ],
    );
    each_flawed_entry_is_left_out(
        map,
        |map| map.landmarks.len() + map.objects.len() + map.pose_corrections.len(),
        &[
            (|m| m.landmarks[0].x_m = f64::NAN, RejectReason::NotFinite),
            (|m| m.landmarks[0].y_m = 1e9, RejectReason::NotFinite),
            (
                |m| m.landmarks[0].confidence = 1.01,
                RejectReason::ConfidenceOutOfRange,
            ),
            (
                |m| m.landmarks[0].confidence = f64::NAN,
                RejectReason::NotFinite,
            ),
            (
                |m| m.landmarks[0].id = "".into(),
                RejectReason::InvalidLabel,
            ),
            (
                |m| m.landmarks[0].label = Some("a\tb".into()),
                RejectReason::InvalidLabel,
            ),
            (
                |m| m.objects[0].x_m = f64::NEG_INFINITY,
                RejectReason::NotFinite,
            ),
            (
                |m| m.objects[0].covariance_m2 = [-0.1, 0.0, 0.2],
                RejectReason::NotFinite,
            ),
            (
                |m| m.objects[0].covariance_m2 = [1e21, 0.0, 0.2],
                RejectReason::NotFinite,
            ),
            (
                |m| m.objects[0].covariance_m2[1] = f64::INFINITY,
                RejectReason::NotFinite,
            ),
            (
                |m| m.objects[0].confidence = -0.5,
                RejectReason::ConfidenceOutOfRange,
            ),
            (
                |m| m.objects[0].label = "x".repeat(65).into(),
                RejectReason::InvalidLabel,
            ),
            (
                |m| m.objects[0].existence = Some(1.5),
                RejectReason::ConfidenceOutOfRange,
            ),
            (
                |m| m.objects[0].scores = [("".into(), 0.5)].into(),
                RejectReason::InvalidLabel,
            ),
            (
                |m| m.objects[0].velocity_mps = Some([f64::NAN, 0.0]),
                RejectReason::NotFinite,
            ),
            (
                |m| m.objects[0].velocity_mps = Some([0.0, 1e9]),
                RejectReason::OutOfRange,
            ),
            (
                |m| m.objects[0].heading_rad = Some(f64::INFINITY),
                RejectReason::NotFinite,
            ),
            (
                |m| m.objects[0].size_m = Some([4.0, -1.0]),
                RejectReason::OutOfRange,
            ),
            (
                |m| m.objects[0].age_s = Some(-1.0),
                RejectReason::OutOfRange,
            ),
            (
                |m| m.objects[0].first_seen_us = Some(Timestamp(1 << 53)),
                RejectReason::OutOfRange,
            ),
            (
                |m| edge_of(m).dheading_rad = f64::NAN,
                RejectReason::NotFinite,
            ),
            (|m| edge_of(m).dx_m = f64::INFINITY, RejectReason::NotFinite),
            (|m| edge_of(m).pairs = -1.0, RejectReason::OutOfRange),
        ],
    );
}

#[test]
fn verdict_flaws_have_reasons() {
    each_flaw_has_its_reason(
        verdicts,
        &[
            (|v| v.epoch = 1 << 53, RejectReason::OutOfRange),
            (
                |v| v.fused_at_us = Timestamp(1 << 53),
                RejectReason::OutOfRange,
            ),
        ],
    );
    each_flawed_entry_is_left_out(
        verdicts,
        |verdicts| verdicts.verdicts.len(),
        &[
            (|v| v.verdicts[0].score = f64::NAN, RejectReason::NotFinite),
            (
                |v| v.verdicts[0].margin = f64::INFINITY,
                RejectReason::NotFinite,
            ),
            (|v| v.verdicts[0].margin = -0.02, RejectReason::OutOfRange),
            (|v| v.verdicts[0].score = 1e300, RejectReason::OutOfRange),
            (
                |v| v.verdicts[0].votes = [("cup".into(), f64::NAN)].into(),
                RejectReason::NotFinite,
            ),
            (
                |v| v.verdicts[0].votes = [("".into(), 1.0)].into(),
                RejectReason::InvalidLabel,
            ),
            (
                |v| v.verdicts[0].landmark = "".into(),
                RejectReason::InvalidLabel,
            ),
            (
                |v| v.verdicts[0].label = Some("".into()),
                RejectReason::InvalidLabel,
            ),
        ],
    );
}

#[test]
fn status_flaws_have_reasons() {
    fn edges(reputations: &mut Reputations) -> &mut Reputation {
        reputations.reputations.get_mut(&edge()).unwrap()
    }
    each_flaw_has_its_reason(
        reputations,
        &[(|r| r.round = 1 << 53, RejectReason::OutOfRange)],
    );
    each_flawed_entry_is_left_out(
        reputations,
        |reputations| reputations.reputations.len(),
        &[
            (|r| edges(r).score = f64::NAN, RejectReason::NotFinite),
            (|r| edges(r).score = 1.5, RejectReason::OutOfRange),
            (|r| edges(r).score = -0.1, RejectReason::OutOfRange),
            (|r| edges(r).correct = u64::MAX, RejectReason::OutOfRange),
            (|r| edges(r).incorrect = 1 << 53, RejectReason::OutOfRange),
        ],
    );
    each_flaw_has_its_reason(
        status,
        &[
            (|s| s.epoch = 1 << 53, RejectReason::OutOfRange),
            (|s| s.version = String::new(), RejectReason::InvalidLabel),
            (|s| s.version = "0".repeat(1000), RejectReason::InvalidLabel),
            (
                |s| s.troubles = vec![s.troubles[0].clone(); MAX_TROUBLES + 1],
                RejectReason::TooManyObjects,
            ),
            (
                |s| s.dismissed = vec![edge(); MAX_DISMISSED + 1],
                RejectReason::TooManyObjects,
            ),
            (
                |s| s.troubles[0].cause = "x".repeat(MAX_TROUBLE_TEXT + 1),
                RejectReason::TooLarge,
            ),
            (
                |s| s.troubles[0].remedy = "run\nthis".into(),
                RejectReason::InvalidLabel,
            ),
            (|s| s.troubles[0].kind.clear(), RejectReason::InvalidLabel),
            (
                |s| s.page = Some("javascript:1".into()),
                RejectReason::InvalidLabel,
            ),
            (
                |s| s.troubles[0].about = Some("a\u{202E}b".into()),
                RejectReason::InvalidLabel,
            ),
        ],
    );
}

#[test]
fn map_limit_exceeds_report_limit() {
    let limits = Limits {
        payload_bytes: 256,
        map_bytes: 4096,
        ..Limits::default()
    };
    let mut large = map();
    large.landmarks = vec![large.landmarks[0].clone(); 10];
    let bytes = encode(&large, Encoding::Json);
    assert!(bytes.len() > limits.payload_bytes);
    assert_eq!(decode(&bytes, &limits), Ok(large));
    assert_eq!(
        decode::<GlobalMap>(&[b' '; 4097], &limits),
        Err(RejectReason::TooLarge)
    );
    assert_eq!(
        decode::<NodeStatus>(&[b' '; 257], &limits),
        Err(RejectReason::TooLarge)
    );
}

#[test]
fn map_from_tomorrow_is_rejected() {
    let now = Timestamp(1_732_154_400_000_000);
    let hour = 3_600_000_000;
    assert_eq!(check_fused_at(now.shifted(hour - 1), now), Ok(()));
    assert_eq!(
        check_fused_at(now.shifted(hour), now),
        Err(RejectReason::FromTheFuture)
    );
    assert_eq!(
        check_fused_at(now.shifted(-30 * hour), now),
        Ok(()),
        "order is by epoch and round, not by time"
    );
}

/// Numbers as junk has them: any bit pattern, and the bounds.
fn number() -> impl Strategy<Value = f64> {
    prop_oneof![any::<f64>(), Just(0.5), Just(1e8), Just(f64::NAN)]
}

fn label() -> impl Strategy<Value = Label> {
    prop_oneof![Just(""), Just("cup"), Just("\u{7}")].prop_map(Label::from)
}

proptest! {
    /// Whatever passes holds only numbers that can be computed with.
    #[test]
    fn non_finite_numbers_are_rejected(
        (confidence, x_m, y_m, covariance_m2) in (number(), number(), number(), [number(), number(), number()]),
        (score, margin, votes) in (number(), number(), btree_map(label(), number(), 0..3)),
        (epoch, text, landmarks) in (any::<u64>(), label(), vec((number(), number()), 0..3)),
    ) {
        let mut map = GlobalMap { epoch, ..map() };
        map.objects[0] =
            FusedObject { confidence, x_m, y_m, covariance_m2, label: text.clone(), ..map.objects[0].clone() };
        let first = map.landmarks[0].clone();
        map.landmarks = landmarks.iter().map(|&(x_m, confidence)| LandmarkState { x_m, confidence, ..first.clone() }).collect();
        if let Ok(map) = decode::<GlobalMap>(&encode(&map, Encoding::Cbor), &Limits::default()) {
            prop_assert!(map.epoch <= MAX_INTEGER);
            for object in &map.objects {
                prop_assert!(!object.label.is_empty());
                prop_assert!(object.covariance_m2.iter().chain([&object.x_m, &object.y_m]).all(|n| n.is_finite()));
            }
            prop_assert!(map.landmarks.iter().all(|l| l.x_m.is_finite() && (0.0..=1.0).contains(&l.confidence)));
        }
        let mut verdicts = Verdicts { epoch, ..verdicts() };
        verdicts.verdicts[0] = Verdict { score, margin, votes, landmark: text, ..verdicts.verdicts[0].clone() };
        if let Ok(verdicts) = decode::<Verdicts>(&encode(&verdicts, Encoding::Cbor), &Limits::default()) {
            let numbers = verdicts.verdicts.iter().flat_map(|verdict| {
                verdict.votes.values().chain([&verdict.score, &verdict.margin])
            });
            prop_assert!(numbers.copied().all(f64::is_finite));
        }
    }
}

#[test]
fn cell_map_needs_position_on_earth() {
    let limits = Limits::default();
    for encoding in [Encoding::Json, Encoding::Cbor, Encoding::Compact] {
        decode::<CellMap>(&encode(&cell_map(), encoding), &limits).unwrap();
    }
    let rejected = |message: CellMap| message.check(&limits).unwrap_err();
    let origin = GeographicOrigin {
        latitude_deg: 91.0,
        ..cell_map().origin
    };
    assert_eq!(
        rejected(CellMap {
            origin,
            ..cell_map()
        }),
        RejectReason::OutOfRange
    );
    let origin = GeographicOrigin {
        longitude_deg: f64::NAN,
        ..cell_map().origin
    };
    assert_eq!(
        rejected(CellMap {
            origin,
            ..cell_map()
        }),
        RejectReason::NotFinite
    );
    let map = GlobalMap { schema: 2, ..map() };
    assert_eq!(
        rejected(CellMap { map, ..cell_map() }),
        RejectReason::UnknownSchema
    );
    let mut message = cell_map();
    let object = FusedObject {
        confidence: 2.0,
        ..message.map.objects[0].clone()
    };
    message.map.neighbour_objects = vec![NeighbourObject {
        cell: edge(),
        age_s: 0.1,
        object,
    }];
    let invalid = message.remove_invalid();
    assert_eq!(
        invalid,
        [InvalidEntry {
            reason: RejectReason::ConfidenceOutOfRange,
            contributors: vec![edge()]
        }]
    );
    assert_eq!(message.map, cell_map().map);
}

/// The compact encoding rounds numbers: a valid number must not become invalid.
#[test]
fn largest_numbers_survive_rounding() {
    let object = FusedObject {
        size_m: Some([SIZE_BOUND_M, SIZE_BOUND_M * (1.0 - 1e-9)]),
        velocity_mps: Some([SPEED_BOUND_MPS, -SPEED_BOUND_MPS]),
        heading_rad: Some(TURN_BOUND_RAD),
        age_s: Some(COUNT_BOUND),
        x_m: WORLD_BOUND_M,
        y_m: -WORLD_BOUND_M,
        covariance_m2: [VARIANCE_BOUND_M2, VARIANCE_BOUND_M2, VARIANCE_BOUND_M2],
        ..map().objects[0].clone()
    };
    let correction = PoseCorrection {
        about_m: [WORLD_BOUND_M, -WORLD_BOUND_M],
        dx_m: WORLD_BOUND_M,
        dy_m: -WORLD_BOUND_M,
        dheading_rad: -TURN_BOUND_RAD,
        pairs: COUNT_BOUND,
    };
    let map = GlobalMap {
        objects: vec![object],
        pose_corrections: [(edge(), correction)].into(),
        ..map()
    };
    let verdict = Verdict {
        score: SCORE_BOUND,
        margin: SCORE_BOUND,
        ..verdicts().verdicts[0].clone()
    };
    let verdicts = Verdicts {
        verdicts: vec![verdict],
        ..verdicts()
    };
    for encoding in [Encoding::Json, Encoding::Cbor, Encoding::Compact] {
        let limits = Limits::default();
        assert_eq!(
            decode_entries::<GlobalMap>(&encode(&map, encoding), &limits)
                .unwrap()
                .1,
            [],
            "{encoding:?}"
        );
        assert_eq!(
            decode_entries::<Verdicts>(&encode(&verdicts, encoding), &limits)
                .unwrap()
                .1,
            [],
            "{encoding:?}"
        );
    }
}

#[test]
fn azimuth_beyond_turn_is_refused() {
    let heading_rad =
        |azimuth_deg| WirePose::from_compass(0.0, 0.0, azimuth_deg).map(|pose| pose.heading_rad);
    assert_eq!(heading_rad(90.0), Ok(0.0));
    let text = heading_rad(450.0).unwrap_err().to_string();
    assert!(
        text.starts_with("`azimuth_deg`: 450 is not allowed"),
        "{text}"
    );
}
