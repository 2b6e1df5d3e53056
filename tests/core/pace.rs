//! What PACE promises: the paper's formulas in paper mode, and sound fusion by default.

use std::sync::Arc;

use ecod::model::names::{Label, NodeName};
use ecod::model::time::Timestamp;
use ecod::pace::{Pace, PaceConfig, PaceMode};
use ecod::perception::landmark::{Landmark, LandmarkIndex, VacancySign};
use ecod::wire::{FieldOfView, LandmarkState, ObjectReport, PerceivedObject, WirePose};
use nalgebra::Point2;
use proptest::prelude::*;

const START: Timestamp = Timestamp(1_732_154_400_000_000);

fn landmark(id: usize, x: f64, y: f64) -> Landmark {
    Landmark {
        id: format!("slot-{id}").into(),
        position: Point2::new(x, y),
        facing_rad: None,
        vacancy: None,
        synonyms: vec![],
    }
}

fn object(label: &str, confidence: f64, x_m: f64, y_m: f64) -> PerceivedObject {
    PerceivedObject::new(label, confidence, x_m, y_m)
}

fn report(node: &str, objects: Vec<PerceivedObject>, seen: &[&str]) -> ObjectReport {
    ObjectReport {
        objects,
        seen: Some(seen.iter().map(Label::new).collect()),
        ..ObjectReport::new(NodeName::new(node).unwrap(), 0, START)
    }
}

fn pace(config: PaceConfig, landmarks: Vec<Landmark>) -> Pace {
    config.validate().unwrap();
    let index = LandmarkIndex::new(landmarks, config.gate_m);
    Pace::new(config, Arc::new(index))
}

fn frame(n: u64) -> Timestamp {
    START.shifted(n as i64 * 100_000)
}

fn labels(states: &[LandmarkState]) -> Vec<Option<&str>> {
    states.iter().map(|state| state.label.as_deref()).collect()
}

/// Algorithm 2 of the paper, line by line.
fn paper_reference(
    config: &PaceConfig,
    landmarks: &[Landmark],
    reports: &[ObjectReport],
) -> Vec<(Option<Label>, f64, f64, f64)> {
    landmarks
        .iter()
        .map(|rho| {
            let near: Vec<&PerceivedObject> = reports
                .iter()
                .flat_map(|r| &r.objects)
                .filter(|o| (o.x_m - rho.position.x).hypot(o.y_m - rho.position.y) <= config.gate_m)
                .collect();
            if near.is_empty() {
                return (None, 0.0, rho.position.x, rho.position.y);
            }
            let score = |label: &Label| {
                near.iter()
                    .filter(|o| o.label == *label)
                    .map(|o| o.confidence)
                    .sum::<f64>()
            };
            let mut candidates: Vec<Label> = near.iter().map(|o| o.label.clone()).collect();
            candidates.sort();
            candidates.dedup();
            let best = candidates
                .iter()
                .rev()
                .max_by(|a, b| score(a).total_cmp(&score(b)))
                .unwrap();
            let (sum, squares): (f64, f64) = near.iter().fold((0.0, 0.0), |(s, q), o| {
                (s + o.confidence, q + o.confidence * o.confidence)
            });
            let n = near.len() as f64;
            (
                Some(best.clone()),
                if sum > 0.0 { squares / sum } else { 0.0 },
                near.iter().map(|o| o.x_m).sum::<f64>() / n,
                near.iter().map(|o| o.y_m).sum::<f64>() / n,
            )
        })
        .collect()
}

fn any_object() -> impl Strategy<Value = PerceivedObject> {
    (0..4usize, 0..=16u32, -3.0..3.0f64, -3.0..3.0f64).prop_map(|(label, c, x, y)| {
        object(
            ["car", "van", "cup", "mouse"][label],
            f64::from(c) / 16.0,
            x,
            y,
        )
    })
}

proptest! {
    #[test]
    fn paper_mode_equals_the_formulas(
        places in prop::collection::vec((-3.0..3.0f64, -3.0..3.0f64), 0..20),
        objects in prop::collection::vec(prop::collection::vec(any_object(), 0..12), 0..5),
        gate_m in 0.05..2.0f64,
    ) {
        let config = PaceConfig { mode: PaceMode::Paper, gate_m, ..PaceConfig::default() };
        let landmarks: Vec<_> = places.iter().enumerate().map(|(i, (x, y))| landmark(i, *x, *y)).collect();
        let reports: Vec<_> = objects.into_iter().enumerate().map(|(v, o)| report(&format!("v{v}"), o, &[])).collect();
        let mut pace = pace(config.clone(), landmarks.clone());
        for report in &reports {
            pace.observe(report, START);
        }
        let round = pace.close(START);
        for (state, (label, confidence, x, y)) in round.landmarks.iter().zip(paper_reference(&config, &landmarks, &reports)) {
            prop_assert_eq!(&state.label, &label);
            prop_assert!((state.confidence - confidence).abs() < 1e-12);
            prop_assert!((state.x_m - x).abs() < 1e-9 && (state.y_m - y).abs() < 1e-9);
        }
    }

    #[test]
    fn reported_labels_ignore_vehicle_order(
        objects in prop::collection::vec(prop::collection::vec(any_object(), 0..8), 1..5),
    ) {
        let landmarks: Vec<_> = (0..9).map(|i| landmark(i, f64::from(i as u32 % 3) * 2.0 - 2.0, f64::from(i as u32 / 3) * 2.0 - 2.0)).collect();
        let reports: Vec<_> = objects.iter().enumerate().map(|(v, o)| report(&format!("v{v}"), o.clone(), &[])).collect();
        let fuse = |order: &mut dyn Iterator<Item = &ObjectReport>| {
            let mut pace = pace(PaceConfig::default(), landmarks.clone());
            order.for_each(|report| pace.observe(report, START));
            pace.close(START)
        };
        let round = fuse(&mut reports.iter());
        prop_assert_eq!(&fuse(&mut reports.iter().rev()), &round, "the order of vehicles does not matter");
        for state in &round.landmarks {
            prop_assert!((0.0..=1.0).contains(&state.confidence));
            prop_assert_eq!(state.label.is_some(), !state.contributors.is_empty());
            if let Some(label) = &state.label {
                prop_assert!(objects.iter().flatten().any(|o| o.label == *label));
            }
        }
    }
}

#[test]
fn two_plates_cannot_share_spot() {
    let mut pace = pace(PaceConfig::default(), vec![landmark(0, 0.0, 0.0)]);
    pace.observe(
        &report(
            "a",
            vec![
                object("FAR", 0.99, 0.3, 0.0),
                object("NEAR", 0.9, 0.05, 0.0),
            ],
            &[],
        ),
        START,
    );
    assert_eq!(labels(&pace.close(START).landmarks), [Some("NEAR")]);
}

#[test]
fn car_row_keeps_order_despite_pose() {
    let config = PaceConfig {
        gate_m: 1.0,
        ..PaceConfig::default()
    };
    let mut pace = pace(
        config,
        (0..3)
            .map(|n| landmark(n, f64::from(n as u32), 0.0))
            .collect(),
    );
    let row = vec![
        object("A", 0.9, 0.55, 0.0),
        object("B", 0.9, 1.6, 0.0),
        object("C", 0.9, 1.9, 0.0),
    ];
    pace.observe(&report("a", row, &[]), START);
    assert_eq!(
        labels(&pace.close(START).landmarks),
        [Some("A"), Some("B"), Some("C")]
    );
    let row = vec![object("D", 0.9, 0.05, 0.0), object("E", 0.9, 0.4, 0.0)];
    pace.observe(&report("a", row, &[]), frame(20));
    assert_eq!(
        labels(&pace.close(frame(20)).landmarks),
        [Some("D"), Some("E"), None],
        "second choice"
    );
}

#[test]
fn detection_matches_one_landmark() {
    let mut pace = pace(
        PaceConfig::default(),
        vec![landmark(0, 0.0, 0.0), landmark(1, 0.6, 0.0)],
    );
    pace.observe(
        &report("a", vec![object("car", 0.9, 0.25, 0.0)], &[]),
        START,
    );
    assert_eq!(labels(&pace.close(START).landmarks), [Some("car"), None]);
}

#[test]
fn emptiness_needs_observer() {
    let mut pace = pace(
        PaceConfig::default(),
        vec![landmark(0, 0.0, 0.0), landmark(1, 5.0, 0.0)],
    );
    for n in 0..3 {
        pace.observe(&report("a", vec![], &["slot-0"]), frame(n));
    }
    let round = pace.close(frame(2));
    assert_eq!(labels(&round.landmarks), [None, None]);
    assert_eq!(
        round.landmarks[0].observers,
        [NodeName::new("a").unwrap()],
        "observed and empty"
    );
    assert!(round.landmarks[1].observers.is_empty(), "not observed");
    assert_eq!(round.landmarks[0].confidence, 0.0);
}

#[test]
fn label_survives_misses_until_departure() {
    let mut pace = pace(PaceConfig::default(), vec![landmark(0, 0.0, 0.0)]);
    for n in 0..5 {
        pace.observe(
            &report("a", vec![object("car", 0.9, 0.0, 0.0)], &["slot-0"]),
            frame(n),
        );
    }
    let mut lasted = 0;
    for n in 5..30 {
        pace.observe(&report("a", vec![], &["slot-0"]), frame(n));
        lasted += u32::from(pace.close(frame(n)).landmarks[0].label.is_some());
    }
    assert!(
        (5..=15).contains(&lasted),
        "kept for {lasted} frames of 100 ms after the object had left"
    );
}

#[test]
fn fresh_reading_outweighs_misses() {
    let mut pace = pace(PaceConfig::default(), vec![landmark(0, 0.0, 0.0)]);
    for n in 0..20 {
        for blind in ["b", "c", "d"] {
            pace.observe(&report(blind, vec![], &["slot-0"]), frame(n));
        }
        pace.observe(
            &report("a", vec![object("ABC", 0.95, 0.0, 0.0)], &["slot-0"]),
            frame(n),
        );
    }
    assert_eq!(labels(&pace.close(frame(19)).landmarks), [Some("ABC")]);
}

#[test]
fn silent_vehicle_is_dropped() {
    let mut pace = pace(PaceConfig::default(), vec![landmark(0, 0.0, 0.0)]);
    pace.observe(&report("a", vec![object("car", 0.9, 0.0, 0.0)], &[]), START);
    assert_eq!(labels(&pace.close(frame(9)).landmarks), [Some("car")]);
    assert_eq!(labels(&pace.close(frame(11)).landmarks), [None]);
}

#[test]
fn precise_vehicles_move_position_more() {
    let mut pace = pace(
        PaceConfig {
            position_floor_m: 0.01,
            gate_sigmas: 10.0,
            ..PaceConfig::default()
        },
        vec![landmark(0, 0.0, 0.0)],
    );
    let precise = PerceivedObject {
        covariance_m2: Some([1e-4, 0.0, 1e-4]),
        ..object("car", 0.9, 0.1, 0.0)
    };
    let vague = PerceivedObject {
        covariance_m2: Some([1e-1, 0.0, 1e-1]),
        ..object("car", 0.9, -0.1, 0.0)
    };
    pace.observe(&report("precise", vec![precise], &[]), START);
    pace.observe(&report("vague", vec![vague], &[]), START);
    let round = pace.close(START);
    assert!(round.landmarks[0].x_m > 0.09, "{}", round.landmarks[0].x_m);
}

#[test]
fn vacancy_sign_yields_to_car() {
    let spot = Landmark {
        vacancy: Some(VacancySign {
            label: "EMPTY".into(),
            position: Point2::new(-0.1, 0.0),
        }),
        ..landmark(0, 0.0, 0.0)
    };
    let config = PaceConfig {
        gate_m: 0.05,
        ..PaceConfig::default()
    };
    let sign = report("side", vec![object("EMPTY", 1.0, -0.1, 0.0)], &[]);
    let mut pace = pace(config, vec![spot]);
    pace.observe(&sign, START);
    assert_eq!(labels(&pace.close(START).landmarks), [Some("EMPTY")]);
    pace.observe(
        &report("front", vec![object("ABCD123", 0.6, 0.0, 0.0)], &[]),
        START,
    );
    assert_eq!(labels(&pace.close(START).landmarks), [Some("ABCD123")]);
}

#[test]
fn observed_empty_spot_gets_vacancy_label() {
    let spot = Landmark {
        vacancy: Some(VacancySign {
            label: "EMPTY".into(),
            position: Point2::new(-0.1, 0.0),
        }),
        ..landmark(0, 0.0, 0.0)
    };
    let mut pace = pace(PaceConfig::default(), vec![spot]);
    pace.observe(&report("a", vec![], &["slot-0"]), frame(0));
    assert_eq!(
        labels(&pace.close(frame(0)).landmarks),
        [None],
        "one look is not enough"
    );
    for n in 1..5 {
        pace.observe(&report("a", vec![], &["slot-0"]), frame(n));
    }
    assert_eq!(labels(&pace.close(frame(4)).landmarks), [Some("EMPTY")]);
}

#[test]
fn flicker_within_margin_keeps_label() {
    let mut pace = pace(PaceConfig::default(), vec![landmark(0, 0.0, 0.0)]);
    pace.observe(
        &report("a", vec![object("car", 0.80, 0.0, 0.0)], &[]),
        START,
    );
    assert_eq!(labels(&pace.close(START).landmarks), [Some("car")]);
    pace.observe(
        &report("b", vec![object("van", 0.85, 0.0, 0.0)], &[]),
        START,
    );
    assert_eq!(
        labels(&pace.close(START).landmarks),
        [Some("car")],
        "van leads by less than the lead"
    );
    pace.observe(
        &report("c", vec![object("van", 0.85, 0.0, 0.0)], &[]),
        START,
    );
    assert_eq!(labels(&pace.close(START).landmarks), [Some("van")]);
}

/// A car that one vehicle invents in a place that others observe as empty; the others list their observed landmarks, or
/// state their field of view.
#[test]
fn contradicted_sole_claim_is_unpublished() {
    let facing = |node: &str, listed: bool| {
        let seen = listed.then(|| vec!["slot-0".into()]);
        let pose = Some(WirePose::new(-5.0, 0.0, 0.0));
        let view = Some(FieldOfView {
            range_m: 30.0,
            angle_rad: 1.0,
        });
        ObjectReport {
            seen,
            pose,
            view,
            ..report(node, Vec::new(), &[])
        }
    };
    for (lookers, listed, expected) in [
        (1, true, Some("car")),
        (3, true, Some("car")),
        (4, true, None),
        (4, false, None),
        (0, true, Some("car")),
    ] {
        let mut pace = pace(PaceConfig::default(), vec![landmark(0, 0.0, 0.0)]);
        let mut published = Vec::new();
        for n in 0..30 {
            pace.observe(
                &report("mallory", vec![object("car", 1.0, 0.0, 0.0)], &["slot-0"]),
                frame(n),
            );
            for looker in 0..lookers {
                pace.observe(&facing(&format!("honest-{looker}"), listed), frame(n));
            }
            published = pace.close(frame(n)).landmarks;
        }
        assert_eq!(
            labels(&published),
            [expected],
            "{lookers} look, listed: {listed}"
        );
    }
}
