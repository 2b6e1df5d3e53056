//! Every receiver accepts all messages of an aggregator, for all valid reports.

use proptest::collection::vec;
use proptest::option;
use proptest::prelude::*;

use super::*;
use crate::model::geometry::TURN_BOUND_RAD;
use crate::tracking::TracksConfig;
use crate::wire::{Encoding, FieldOfView, Limits, Payload, WirePose, decode_entries, encode};

/// Ordinary numbers, both bounds, and numbers next to them.
fn number(bound: f64) -> impl Strategy<Value = f64> {
    prop_oneof![
        -bound..=bound,
        -10.0..=10.0f64,
        Just(bound),
        Just(-bound),
        Just(bound * (1.0 - 1e-9)),
        Just(0.0),
        Just(f64::MIN_POSITIVE),
    ]
}

fn positive(bound: f64) -> impl Strategy<Value = f64> {
    number(bound).prop_map(f64::abs)
}

/// Largest variance that is accepted.
const VARIANCE: f64 = (1u128 << 66) as f64;

fn covariance() -> impl Strategy<Value = [f64; 3]> {
    (
        positive(VARIANCE),
        positive(VARIANCE),
        prop_oneof![-1.0..=1.0f64, Just(1.0), Just(-1.0)],
    )
        .prop_map(|(xx, yy, correlation)| [xx, correlation * xx.sqrt() * yy.sqrt(), yy])
}

prop_compose! {
    fn object()(
        (x_m, y_m, confidence) in (number(1e8), number(1e8), prop_oneof![0.0..=1.0f64, Just(0.0), Just(1.0)]),
        covariance_m2 in option::of(covariance()),
        velocity_mps in option::of([number(1e4), number(1e4)]),
        heading_rad in option::of(-TURN_BOUND_RAD..=TURN_BOUND_RAD),
        size_m in option::of([positive(102_400.0), positive(102_400.0)]),
        landmark in option::of(Just("ball".into())),
        scores in proptest::collection::btree_map(Just("cup".into()), 0.0..=1.0f64, 0..2),
    ) -> PerceivedObject {
        PerceivedObject {
            covariance_m2, velocity_mps, heading_rad, size_m, landmark, scores,
            ..PerceivedObject::new("cup", confidence, x_m, y_m)
        }
    }
}

prop_compose! {
    fn extreme_report()(
        objects in vec(object(), 1..5),
        pose in option::of((number(1e8), number(1e8), -TURN_BOUND_RAD..=TURN_BOUND_RAD)),
        view in option::of((positive(102_400.0), 0.0..=TURN_BOUND_RAD)),
        frame_yaw_rate_radps in option::of(number(100.0)),
        moving in option::of(any::<bool>()),
    ) -> ObjectReport {
        ObjectReport {
            pose: pose.map(|(x_m, y_m, heading_rad)| WirePose::new(x_m, y_m, heading_rad)),
            view: view.map(|(range_m, angle_rad)| FieldOfView { range_m, angle_rad }),
            objects, frame_yaw_rate_radps, moving,
            ..ObjectReport::new(NodeName::from_static("mallory"), 0, at(0))
        }
    }
}

/// Fails if a receiver refuses the message or leaves out a part of it, in any encoding.
fn check_accepted<T: Payload>(message: &T) -> Result<(), TestCaseError> {
    for encoding in [Encoding::Json, Encoding::Cbor, Encoding::Compact] {
        let received = decode_entries::<T>(&encode(message, encoding), &Limits::default());
        let left_out = received.map(|(_, invalid)| invalid);
        prop_assert_eq!(left_out, Ok(Vec::new()), "{:?}", encoding);
    }
    Ok(())
}

/// One honest car that every map must have.
fn honest_report(captured_ms: u64) -> Arc<ObjectReport> {
    Arc::new(ObjectReport {
        objects: vec![PerceivedObject::new("car", 0.9, 20.0, 5.0)],
        pose: Some(WirePose::new(0.0, 0.0, 0.0)),
        ..ObjectReport::new(
            NodeName::from_static("euclid"),
            captured_ms,
            at(captured_ms),
        )
    })
}

proptest! {
    #[test]
    fn valid_reports_make_acceptable_rounds(reports in vec(extreme_report(), 1..6)) {
        for report in &reports {
            prop_assert_eq!(report.validate(&Limits::default()), Ok(()));
        }
        let tracks = TracksConfig { mode: TracksMode::On, ..TracksConfig::default() };
        let mut cell = leader(FusionConfig { tracks, ..FusionConfig::default() });
        for round in 1..=20 {
            let now = at(round * 100);
            let _ = cell.report(Detections, &honest_report(round * 100 - 20), now - Duration::from_millis(10));
            let extreme = &reports[round as usize % reports.len()];
            let extreme = ObjectReport { seq: round, captured_at_us: at(round * 100 - 15), ..extreme.clone() };
            let extreme = Arc::new(extreme);
            let mut closed = Vec::new();
            for kind in [Detections, VoteDetections] {
                closed.extend(cell.report(kind, &extreme, now - Duration::from_millis(5)).ok().flatten());
            }
            closed.extend(cell.tick(now));
            for fused in closed {
                let map = fused.map.as_ref().unwrap();
                check_accepted(map)?;
                if let Some(verdicts) = &fused.verdicts {
                    check_accepted(verdicts)?;
                }
                let is_there = map.objects.iter().any(|object| {
                    object.label == "car" && (object.x_m - 20.0).hypot(object.y_m - 5.0) < 1.0
                });
                let turns = reports.iter().any(|report| report.frame_yaw_rate_radps.is_some());
                prop_assert!(is_there || turns || round < 3, "round {} has lost the honest car", round);
            }
        }
    }

    #[test]
    fn object_beyond_bounds_is_omitted(steps in 1u64..30) {
        let tracks = TracksConfig { mode: TracksMode::On, ..TracksConfig::default() };
        let mut cell = leader(FusionConfig { tracks, ..FusionConfig::default() });
        let edge_of_the_world = PerceivedObject {
            velocity_mps: Some([70.0, 0.0]),
            ..PerceivedObject::new("car", 0.9, 1e8, 0.0)
        };
        let report = ObjectReport {
            objects: vec![edge_of_the_world],
            ..ObjectReport::new(NodeName::from_static("mallory"), 1, at(0))
        };
        cell.report(Detections, &Arc::new(report), at(1)).unwrap();
        let mut left_out = Vec::new();
        for round in 1..=steps {
            let fused = cell.tick(at(round * 100)).unwrap();
            check_accepted(fused.map.as_ref().unwrap())?;
            left_out.extend(fused.left_out);
        }
        prop_assert!(!left_out.is_empty());
        for entry in left_out {
            prop_assert_eq!(entry.contributors, [NodeName::from_static("mallory")]);
        }
    }
}
