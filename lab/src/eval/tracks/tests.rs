use ecod::model::epoch::Epoch;
use ecod::model::geometry::Covariance;
use ecod::model::names::NodeName;
use ecod::wire::FusedObject;

use super::matching::MatchedPair;
use super::*;

fn truth(id: u32, x: f64) -> TrueObject {
    TrueObject {
        id,
        label: "car".into(),
        position: Point2::new(x, 0.0),
    }
}

fn said(id: u32, x: f64, score: f64) -> ReportedObject {
    ReportedObject {
        id,
        label: "car".into(),
        score,
        existence: None,
        position: Point2::new(x, 0.0),
    }
}

fn near(found: Option<f64>, expected: f64) {
    assert!(
        found.is_some_and(|found| (found - expected).abs() < 1e-9),
        "{found:?} is not {expected}"
    );
}

#[test]
fn perfect_tracking_scores_hundred_percent() {
    let frame = |at: f64| ScoredFrame {
        truth: vec![truth(0, at), truth(1, 10.0 + at)],
        said: vec![said(5, 10.0 + at, 0.9), said(6, at, 0.8)],
    };
    let scores = score(&[frame(0.0), frame(1.0), frame(2.0)]);
    scores
        .ap_pct
        .iter()
        .chain(&scores.best_moda_pct)
        .chain([&scores.best_f1_pct])
        .for_each(|share| near(*share, 100.0));
    assert_eq!(scores.at_best_f1.threshold, 0.8);
    for at in [scores.at_best_f1, scores.at_default] {
        let shares = [
            at.moda_pct,
            at.modp_pct,
            at.mota_pct,
            at.idf1_pct,
            at.hota_pct,
            at.deta_pct,
            at.assa_pct,
            at.loca_pct,
        ];
        shares.into_iter().for_each(|share| near(share, 100.0));
        assert_eq!(
            (at.matches, at.false_alarms, at.misses, at.id_switches),
            (6, 0, 0, 0)
        );
    }
}

#[test]
fn empty_output_and_empty_truth_differ() {
    let silent = score(&[ScoredFrame {
        truth: vec![truth(0, 0.0)],
        said: vec![],
    }]);
    assert_eq!((silent.ap_pct, silent.best_f1_pct), ([Some(0.0); 4], None));
    let at = silent.at_default;
    assert_eq!(
        (at.misses, at.moda_pct, at.mota_pct, at.modp_pct),
        (1, Some(0.0), Some(0.0), None)
    );
    assert_eq!((at.idf1_pct, at.hota_pct), (Some(0.0), Some(0.0)));
    let empty = score(&[ScoredFrame {
        truth: vec![],
        said: vec![said(0, 0.0, 0.9)],
    }]);
    assert_eq!(
        (empty.ap_pct, empty.best_f1_pct, empty.at_default.hota_pct),
        ([None; 4], None, None)
    );
    assert_eq!(empty.at_default.false_alarms, 1);
}

/// Two objects in one frame; of three reported ones the best and the last are right: precision 1,
/// 1/2, 2/3 at recall 1/2, 1/2, 1.
#[test]
fn average_precision_matches_hand_calculation() {
    let frame = ScoredFrame {
        truth: vec![truth(0, 0.0), truth(1, 20.0)],
        said: vec![said(0, 0.3, 0.9), said(1, 50.0, 0.8), said(2, 21.5, 0.7)],
    };
    let scores = score(&[frame]);
    near(scores.ap_pct[0], 50.0);
    near(scores.ap_pct[1], 50.0);
    near(scores.ap_pct[2], 100.0 * (0.5 + 0.5 * 2.0 / 3.0));
    near(scores.best_f1_pct, 80.0);
    scores
        .best_moda_pct
        .iter()
        .for_each(|moda_pct| near(*moda_pct, 50.0));
    assert_eq!(scores.at_best_f1.threshold, 0.7);
    near(scores.at_best_f1.moda_pct, 50.0);
    near(scores.at_best_f1.modp_pct, 100.0 * (0.85 + 0.25) / 2.0);
    near(scores.at_best_f1.motp_m, 0.9);
}

#[test]
fn equal_confidences_enter_together() {
    let frame = |wrong_first: bool| {
        let mut said = vec![said(0, 0.0, 0.5), said(1, 50.0, 0.5)];
        if wrong_first {
            said.reverse();
        }
        ScoredFrame {
            truth: vec![truth(0, 0.0)],
            said,
        }
    };
    let [one, other] = [false, true].map(|wrong_first| score(&[frame(wrong_first)]).ap_pct[0]);
    assert_eq!((one, other), (Some(50.0), Some(50.0)));
}

#[test]
fn another_label_is_another_object() {
    let mut frame = ScoredFrame {
        truth: vec![truth(0, 0.0), truth(1, 9.0)],
        said: vec![said(0, 0.0, 0.9), said(1, 9.0, 0.9)],
    };
    frame.truth[1].label = "person".into();
    let scores = score(&[frame]);
    assert_eq!(scores.class_ap_pct.len(), 2);
    near(scores.class_ap_pct[&Label::new_static("person")][3], 0.0);
    near(scores.class_ap_pct[&Label::new_static("car")][3], 50.0);
    near(scores.ap_pct[3], 25.0);
    assert_eq!(
        (scores.at_default.matches, scores.at_default.false_alarms),
        (1, 1)
    );
}

/// One object over four frames, two with one identity and two with another.
#[test]
fn one_switch_has_expected_cost() {
    let frame = |id| ScoredFrame {
        truth: vec![truth(0, 0.0)],
        said: vec![said(id, 0.0, 0.9)],
    };
    let at = score(&[frame(1), frame(1), frame(2), frame(2)]).at_default;
    assert_eq!(at.id_switches, 1);
    near(at.moda_pct, 100.0);
    near(at.mota_pct, 75.0);
    near(at.idf1_pct, 100.0 * 2.0 * 2.0 / 8.0);
    near(at.deta_pct, 100.0);
    near(at.assa_pct, 50.0);
    near(at.hota_pct, 100.0 * 0.5f64.sqrt());
}

/// One object over six frames, missed in two runs, found by another identity at last.
#[test]
fn rediscovered_object_is_fragment() {
    let frame = |id: Option<u32>| ScoredFrame {
        truth: vec![truth(0, 0.0)],
        said: id.map_or_else(|| vec![said(9, 50.0, 0.9)], |id| vec![said(id, 0.0, 0.9)]),
    };
    let at = score(&[None, Some(1), None, Some(1), None, Some(2)].map(frame)).at_default;
    assert_eq!(
        (at.fragments, at.id_switches, at.misses, at.matches),
        (2, 1, 3, 3)
    );
    let switched = score(&[Some(1), Some(2)].map(frame)).at_default;
    assert_eq!(
        (switched.fragments, switched.id_switches),
        (0, 1),
        "the object is always tracked"
    );
}

/// Five reported objects: 0.95 right, 0.9 and 1.0 where 1.0 is wrong, 0.55 wrong, 0.05 right. Bins:
/// 0.9 to 1 states 0.95 and 2 of 3 are right, 0.55 with zero right, 0.05 with one.
#[test]
fn calibration_matches_hand_calculation() {
    let frame = ScoredFrame {
        truth: vec![truth(0, 0.0), truth(1, 10.0), truth(2, 20.0)],
        said: vec![
            said(0, 1.4, 0.95),
            said(1, 10.0, 0.9),
            said(2, 50.0, 1.0),
            said(3, 12.0, 0.55),
            said(4, 21.0, 0.05),
        ],
    };
    let ReliabilityBins {
        confidence,
        existence,
    } = score(&[frame]).calibration;
    assert_eq!(existence, None);
    near(
        confidence.ece_pct,
        100.0 * (3.0 * (0.95 - 2.0 / 3.0) + 0.55 + 0.95) / 5.0,
    );
    let bins: Vec<_> = confidence
        .bins
        .iter()
        .map(|bin| (bin.stated_pct.round(), bin.right_pct.round(), bin.objects))
        .collect();
    assert_eq!(bins, [(5.0, 100.0, 1), (55.0, 0.0, 1), (95.0, 67.0, 3)]);

    let mut exists = said(0, 3.0, 0.5);
    exists.existence = Some(1.0);
    let frame = ScoredFrame {
        truth: vec![truth(0, 0.0)],
        said: vec![exists, said(1, 50.0, 0.1)],
    };
    let ReliabilityBins {
        confidence,
        existence,
    } = score(&[frame]).calibration;
    near(confidence.ece_pct, 30.0);
    near(existence.unwrap().ece_pct, 0.0);
    assert_eq!(score(&[]).calibration.confidence.ece_pct, None);
}

/// A continued pair keeps its match although another is nearer now.
#[test]
fn match_is_kept_while_near() {
    let frames = [
        ScoredFrame {
            truth: vec![truth(0, 0.0)],
            said: vec![said(1, 0.0, 0.9)],
        },
        ScoredFrame {
            truth: vec![truth(0, 0.0)],
            said: vec![said(1, 1.9, 0.9), said(2, 0.1, 0.9)],
        },
        ScoredFrame {
            truth: vec![truth(0, 0.0)],
            said: vec![said(1, 2.1, 0.9), said(2, 0.1, 0.9)],
        },
    ];
    let switches = |frames: &[ScoredFrame]| score(frames).at_default.id_switches;
    assert_eq!((switches(&frames[..2]), switches(&frames)), (0, 1));
}

#[test]
fn matching_maximises_sum() {
    let pair = |truth, said, value| MatchedPair { truth, said, value };
    let pairs = [
        pair(0, 0, 0.9),
        pair(0, 1, 0.8),
        pair(1, 0, 0.8), // 0.8 + 0.8 beats 0.9
        pair(5, 9, 0.1),
        pair(6, 9, 0.4),
        pair(7, 9, 0.3), // more true than reported
        pair(8, 20, 0.0),
    ];
    let mut chosen: Vec<_> = matching::best(&pairs)
        .iter()
        .map(|pair| (pair.truth, pair.said))
        .collect();
    chosen.sort_unstable();
    assert_eq!(chosen, [(0, 1), (1, 0), (6, 9)]);
}

fn map(at: u64, objects: &[(u128, f64)]) -> GlobalMap {
    let covariance = Covariance::isotropic(1.0);
    let object = |&(id, x_m): &(u128, f64)| {
        FusedObject::new(Uuid::from_u128(id), "car", 0.9, x_m, 0.0, covariance)
    };
    let epoch = Epoch::new(1, NodeName::from_static("edge"));
    GlobalMap {
        objects: objects.iter().map(object).collect(),
        ..GlobalMap::new(&epoch, at, Timestamp(at))
    }
}

/// An object at ten metres a frame, evaluated by maps about the frames, with one lost.
#[test]
fn nearest_map_judges_frame() {
    let frames: Vec<_> = (0..6)
        .map(|n| serde_json::json!({"t_us": n * 100, "objects": [{"id": 1, "label": "car", "x_m": n * 10, "y_m": 0}]}))
        .collect();
    let truth = TrackTruth::parse(&serde_json::json!({ "frames": frames }).to_string()).unwrap();
    let mut evaluation = TrackEvaluation::new(truth);
    for (at, x) in [
        (0, 0.0),
        (40, 99.0),
        (130, 13.0),
        (170, 17.0),
        (330, 33.0),
        (330, 33.5),
    ] {
        evaluation.map(&map(at, &[(7, x)]));
    }
    let scores = evaluation.result();
    assert_eq!(
        (
            scores.frames,
            scores.frames_with_map,
            scores.objects,
            scores.said
        ),
        (6, 5, 6, 5)
    );
    let at = scores.at_default;
    assert_eq!((at.matches, at.misses), (5, 1), "{scores:?}");
    near(at.motp_m, (0.5 + 0.5) / 5.0);
}

#[test]
fn unmatched_classes_are_listed() {
    let text = r#"{"frames": [{"t_us": 100, "objects": [{"id": 1, "label": "car", "x_m": 1, "y_m": 2}]}]}"#;
    let with = |labels: &[&str]| {
        let mut evaluation = TrackEvaluation::new(TrackTruth::parse(text).unwrap());
        let objects: Vec<ReportedObject> = labels
            .iter()
            .map(|label| ReportedObject {
                label: Label::new(label),
                ..said(0, 1.0, 0.9)
            })
            .collect();
        evaluation.add_objects(Timestamp(100), &objects);
        evaluation.labels_without_match()
    };
    assert_eq!(with(&["person", "car"]), None);
    assert_eq!(with(&[]), None);
    let apart = (r#""Car", "person""#.to_owned(), r#""car""#.to_owned());
    assert_eq!(with(&["person", "Car"]), Some(apart));
}
