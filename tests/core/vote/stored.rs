//! VOTE over votes that are kept: labels by annotators, and passes over them.

use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ecod::vote::{Vote, VoteConfig, WeightedConfig};
use ecod::wire::{ObjectReport, PerceivedObject, Verdict};

const AT: Timestamp = Timestamp(1_700_000_000_000_000);

fn vote_as(vote: &mut Vote, node: &str, seq: u64, votes: &[(&str, &str)]) {
    let object = |&(landmark, label): &(&str, &str)| PerceivedObject {
        landmark: Some(landmark.into()),
        ..PerceivedObject::new(label, 0.8, 0.0, 0.0)
    };
    let objects = votes.iter().map(object).collect();
    let report = ObjectReport {
        objects,
        ..ObjectReport::new(NodeName::new(node).unwrap(), seq, AT)
    };
    vote.observe(&report, AT).unwrap();
}

fn on<'a>(verdicts: &'a [Verdict], landmark: &str) -> &'a Verdict {
    verdicts
        .iter()
        .find(|verdict| verdict.landmark.as_str() == landmark)
        .unwrap()
}

#[test]
fn corrected_answer_counts_once() {
    let weighted = WeightedConfig {
        freshness_s: 1e9,
        smoothing_share: 0.0,
        ..WeightedConfig::default()
    };
    let config = VoteConfig {
        weighted,
        ..VoteConfig::default()
    };
    let answers = |labels: &[&str]| {
        let mut vote = Vote::new(config.clone(), Vec::new());
        vote_as(&mut vote, "b", 1, &[("y", "cup"), ("z", "mouse")]);
        (1..)
            .zip(labels)
            .for_each(|(seq, label)| vote_as(&mut vote, "a", seq, &[("x", label)]));
        let online = on(&vote.close(AT).verdicts, "x").clone();
        (
            online,
            on(&vote.refine(10).collect::<Vec<_>>(), "x").clone(),
        )
    };
    let once = answers(&["mouse"]);
    for labels in [
        &["cup", "mouse"][..],
        &["cup", "cup", "mouse"],
        &["mouse", "mouse"],
    ] {
        let corrected = answers(labels);
        for (now, once) in [(corrected.0, &once.0), (corrected.1, &once.1)] {
            assert_eq!(now.label.as_deref(), Some("mouse"), "{labels:?}");
            assert!(
                (now.score - once.score).abs() < 1e-9,
                "{labels:?}: {} instead of {}",
                now.score,
                once.score
            );
        }
    }
}

#[test]
fn wavering_landmark_leaves_others_counting() {
    let mut vote = Vote::new(VoteConfig::default(), Vec::new());
    for (node, first, second) in [
        ("a", "cup", "mouse"),
        ("b", "mouse", "cup"),
        ("f", "cup", "mouse"),
    ] {
        let place = if node == "f" { "alone" } else { "x" };
        vote_as(&mut vote, node, 1, &[(place, first)]);
        vote_as(&mut vote, node, 2, &[(place, second)]);
    }
    for (node, y, z) in [
        ("a", "cup", "mouse"),
        ("b", "cup", "mouse"),
        ("c", "cup", "mouse"),
        ("d", "mouse", "cup"),
        ("e", "mouse", "cup"),
    ] {
        vote_as(&mut vote, node, 3, &[("y", y), ("z", z)]);
    }
    let verdicts = vote.refine(1).collect::<Vec<_>>();
    let labels = ["y", "z"].map(|place| on(&verdicts, place).label.as_deref());
    assert_eq!(labels, [Some("cup"), Some("mouse")]);
    assert!(
        verdicts
            .iter()
            .flat_map(|verdict| verdict.votes.values())
            .all(|score| score.is_finite()),
        "{verdicts:?}"
    );
    assert!(
        vote.reputations()
            .values()
            .all(|reputation| reputation.score.is_finite())
    );
}
