use ecod::wire::{PerceivedObject, SCHEMA_VERSION, Verdict, Verdicts};

use super::*;

fn verdicts(round: u64, entries: &[(&str, Option<&str>)]) -> FusedLine {
    let verdict = |&(landmark, label): &(&str, Option<&str>)| Verdict {
        landmark: landmark.into(),
        label: label.map(Label::new),
        score: 0.0,
        margin: 0.0,
        votes: BTreeMap::new(),
        contributors: Vec::new(),
    };
    FusedLine::Verdicts(Verdicts {
        schema: SCHEMA_VERSION,
        aggregator: NodeName::from_static("edge"),
        epoch: 1,
        round,
        fused_at_us: Timestamp(round),
        verdicts: entries.iter().map(verdict).collect(),
    })
}

fn report(node: &str, at: u64, votes: &[(&str, &str)]) -> ObjectReport {
    let object = |&(landmark, label): &(&str, &str)| PerceivedObject {
        landmark: Some(landmark.into()),
        ..PerceivedObject::new(label, 1.0, 0.0, 0.0)
    };
    ObjectReport {
        objects: votes.iter().map(object).collect(),
        ..ObjectReport::new(NodeName::new(node).unwrap(), at, Timestamp(at))
    }
}

/// Five items, computed by hand: a is right, b wrong, c unlabelled, d empty and labelled so, e
/// without truth.
#[test]
fn figures_match_hand_calculation() {
    let truth = Truth::parse(r#"{"landmarks": {"a": "cup", "b": "cup", "c": "mouse", "d": null}}"#)
        .unwrap();
    let mut evaluation = Evaluation::new(truth);
    evaluation.fused(&verdicts(
        1,
        &[("a", Some("mouse")), ("b", Some("cup")), ("e", Some("x"))],
    ));
    evaluation.fused(&verdicts(2, &[("a", Some("cup")), ("b", Some("mouse"))]));
    evaluation.fused(&verdicts(3, &[("a", None), ("d", Some("cup"))]));
    evaluation.fused(&verdicts(4, &[("c", None), ("d", None)]));
    for (node, votes) in [
        (
            "v1",
            &[("a", "cup"), ("b", "mouse"), ("d", "cup"), ("e", "x")][..],
        ),
        ("v2", &[("a", "cup"), ("b", "cup")]),
        ("v3", &[("a", "mouse")]),
    ] {
        evaluation.report(ReportKind::VoteDetections, &report(node, 1, votes));
    }
    let result = evaluation.result();
    assert!(result.pace.is_none());
    let vote = result.vote.unwrap();
    assert_eq!((vote.lines, vote.items), (4, 4));
    assert_eq!(vote.accuracy_pct, Some(50.0), "a and d of four");
    assert_eq!(vote.labelled_accuracy_pct, Some(50.0), "a of a and b");
    assert!(
        (vote.coverage_pct.unwrap() - 200.0 / 3.0).abs() < 1e-9,
        "a and b of a, b and c"
    );
    assert_eq!(
        (vote.rounds.entries, vote.rounds.right),
        (8, 3),
        "b once, a once, d once"
    );
    let recall: Vec<_> = vote
        .recall
        .iter()
        .map(|c| (c.truth.as_deref(), c.items, c.recall_pct))
        .collect();
    assert_eq!(
        recall,
        [
            (None, 1, Some(100.0)),
            (Some("cup"), 2, Some(50.0)),
            (Some("mouse"), 1, Some(0.0))
        ]
    );
    assert_eq!(
        vote.mean_recall_pct,
        Some(50.0),
        "of no label, cup and mouse"
    );
    assert_eq!(
        vote.majority_accuracy_pct,
        Some(37.5),
        "a whole and b half of four"
    );
    let v1 = &vote.vehicles[&NodeName::from_static("v1")];
    assert_eq!((v1.votes, v1.accuracy_pct), (3, Some(25.0)));
    assert!((v1.vote_accuracy_pct.unwrap() - 100.0 / 3.0).abs() < 1e-9);
    assert!((v1.coverage_pct.unwrap() - 200.0 / 3.0).abs() < 1e-9);
    let v3 = &vote.vehicles[&NodeName::from_static("v3")];
    assert_eq!(
        (v3.votes, v3.accuracy_pct),
        (1, Some(25.0)),
        "wrong on a, silent and right on d"
    );
    let cell = |truth: Option<&str>, said: Option<&str>| {
        let find = |c: &&ConfusionCell| c.truth.as_deref() == truth && c.said.as_deref() == said;
        vote.confusion.iter().find(find).map_or(0, |c| c.count)
    };
    assert_eq!(
        (
            cell(Some("cup"), Some("cup")),
            cell(Some("cup"), Some("mouse"))
        ),
        (1, 1)
    );
    assert_eq!((cell(Some("mouse"), None), cell(None, None)), (1, 1));
    assert_eq!(vote.confusion.iter().map(|c| c.count).sum::<u64>(), 4);
}

#[test]
fn changing_truth_makes_separate_items() {
    let truth = Truth::parse(
        r#"{"a": [{"from_us": 0, "label": "cup"}, {"from_us": 10, "label": "mouse"}]}"#,
    )
    .unwrap();
    let mut evaluation = Evaluation::new(truth);
    evaluation.fused(&verdicts(5, &[("a", Some("cup"))]));
    evaluation.fused(&verdicts(15, &[("a", Some("cup"))]));
    evaluation.report(ReportKind::VoteDetections, &report("v", 5, &[("a", "cup")]));
    evaluation.report(
        ReportKind::VoteDetections,
        &report("v", 15, &[("a", "mouse")]),
    );
    let vote = evaluation.result().vote.unwrap();
    assert_eq!(
        (vote.items, vote.accuracy_pct, vote.majority_accuracy_pct),
        (2, Some(50.0), Some(100.0))
    );
}

#[test]
fn unnamed_locations_are_placed_and_translated() {
    use ecod::perception::landmark::{Landmark, Synonym};
    let ball = Landmark {
        id: "ball".into(),
        position: nalgebra::Point2::new(1.0, 0.0),
        facing_rad: None,
        vacancy: None,
        synonyms: vec![Synonym {
            from: "vase".into(),
            label: "sports ball".into(),
        }],
    };
    let gate = LandmarkGate {
        radius_m: 0.5,
        sigmas: 4.0,
        floor_m: 0.05,
    };
    let truth = Truth::parse(r#"{"ball": "sports ball"}"#).unwrap();
    let mut evaluation =
        Evaluation::new(truth).with_landmarks(LandmarkIndex::new(vec![ball], 0.5), gate);
    let mut unnamed = report("v", 1, &[("", "vase"), ("", "vase")]);
    for (object, x_m) in unnamed.objects.iter_mut().zip([1.1, 3.0]) {
        object.landmark = None;
        object.x_m = x_m;
    }
    evaluation.report(ReportKind::Detections, &unnamed);
    let pace = evaluation.result().pace.unwrap();
    assert_eq!(
        (
            pace.vehicles[&unnamed.node].votes,
            pace.majority_accuracy_pct
        ),
        (1, Some(100.0))
    );
}

#[test]
fn synonyms_apply_without_landmarks() {
    let truth = Truth::parse(r#"{"ball": "sports ball"}"#).unwrap();
    let mut evaluation =
        Evaluation::new(truth).with_synonyms([("vase".into(), "sports ball".into())].into());
    for kind in [ReportKind::VoteDetections, ReportKind::Detections] {
        evaluation.report(kind, &report("v", 1, &[("ball", "vase")]));
    }
    let EvalResult { pace, vote } = evaluation.result();
    assert_eq!(vote.unwrap().majority_accuracy_pct, Some(100.0));
    assert_eq!(
        pace.unwrap().majority_accuracy_pct,
        Some(0.0),
        "PACE has no synonyms"
    );
}

#[test]
fn unmatched_landmarks_are_listed() {
    let truth = || Truth::parse(r#"{"landmarks": {"a": "cup"}}"#).unwrap();
    for (id, matches) in [("a", true), ("A", false)] {
        let mut evaluation = Evaluation::new(truth());
        evaluation.fused(&verdicts(1, &[(id, Some("cup"))]));
        assert_eq!(evaluation.matches_truth(), matches, "{id}");
    }
}
