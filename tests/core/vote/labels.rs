//! A vehicle that invents labels does not displace labels of other vehicles.

use std::time::Duration;

use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ecod::perception::landmark::{Landmark, Synonym};
use ecod::reputation::{Evidence, ReputationLedger};
use ecod::vote::{Vote, VoteConfig, VoteMode};
use ecod::wire::{ObjectReport, PerceivedObject};
use nalgebra::Point2;

const START: Timestamp = Timestamp(1_700_000_000_000_000);
const ROUND: Duration = Duration::from_millis(500);

fn report(node: &str, seq: u64, votes: &[(String, String)]) -> (ObjectReport, Timestamp) {
    let at = START + ROUND * u32::try_from(seq).unwrap();
    let object = |(landmark, label): &(String, String)| PerceivedObject {
        landmark: Some(landmark.as_str().into()),
        ..PerceivedObject::new(label.as_str(), 0.8, 0.0, 0.0)
    };
    let objects = votes.iter().map(object).collect();
    (
        ObjectReport {
            objects,
            ..ObjectReport::new(NodeName::new(node).unwrap(), seq, at)
        },
        at,
    )
}

fn vote_as(vote: &mut Vote, node: &str, seq: u64, votes: &[(String, String)]) {
    let (report, at) = report(node, seq, votes);
    vote.observe(&report, at).unwrap();
}

fn vote_for(landmark: &str, label: &str) -> (String, String) {
    (landmark.to_owned(), label.to_owned())
}

/// A vehicle's round of `count` new labels, each at a separate place.
fn inventions(round: u64, count: usize) -> Vec<(String, String)> {
    (0..count)
        .map(|n| (format!("nowhere-{n}"), format!("invented-{round}-{n}")))
        .collect()
}

#[test]
fn new_labels_survive_label_flood() {
    let mut vote = Vote::new(VoteConfig::default(), Vec::new());
    for round in 1..40 {
        // The malicious vehicle reports first, last, and also at the place of the others.
        vote_as(&mut vote, "liar", 2 * round, &inventions(2 * round, 300));
        let new = format!("thing-{}", round / 10);
        for honest in ["a", "b", "c"] {
            let votes = [vote_for("known", "cup"), vote_for("changing", &new)];
            vote_as(&mut vote, honest, 2 * round, &votes);
        }
        let mut false_votes = inventions(2 * round + 1, 300);
        false_votes.push(vote_for("known", &format!("invented-{round}")));
        vote_as(&mut vote, "liar", 2 * round + 1, &false_votes);
        let verdicts = vote
            .close(START + ROUND * u32::try_from(2 * round + 1).unwrap())
            .verdicts;
        let label = |landmark: &str| {
            verdicts
                .iter()
                .find(|v| v.landmark.as_str() == landmark)
                .and_then(|v| v.label.as_deref().map(str::to_owned))
        };
        assert_eq!(label("known").as_deref(), Some("cup"), "round {round}");
        if round % 10 >= 5 {
            assert_eq!(label("changing"), Some(new), "round {round}");
        }
    }
    let honest = vote.reputations()[&NodeName::from_static("a")];
    assert!(honest.score > 0.7 && honest.correct > 20, "{honest:?}");
}

/// Votes that no other vehicle can check do not make a label frequent elsewhere.
#[test]
fn sole_votes_favour_no_label() {
    let mut vote = Vote::new(VoteConfig::default(), Vec::new());
    for round in 1..10 {
        let mut invented: Vec<_> = (0..900)
            .map(|place| vote_for(&format!("nowhere-{place}"), "invented"))
            .collect();
        invented.push(vote_for("known", "invented"));
        vote_as(&mut vote, "liar", round, &invented);
        for honest in ["a", "b"] {
            vote_as(&mut vote, honest, round, &[vote_for("known", "cup")]);
        }
        let verdicts = vote
            .close(START + ROUND * u32::try_from(round).unwrap())
            .verdicts;
        let known = verdicts.iter().find(|v| v.landmark.as_str() == "known");
        let label = known.and_then(|verdict| verdict.label.as_deref());
        assert_eq!(label, Some("cup"), "round {round}");
    }
}

#[test]
fn lone_vehicle_keeps_latest_labels() {
    let mut vote = Vote::new(
        VoteConfig {
            max_labels: 16,
            ..VoteConfig::default()
        },
        Vec::new(),
    );
    for round in 0..100 {
        vote_as(
            &mut vote,
            "a",
            round,
            &[
                vote_for("x", &format!("thing-{}", round / 5)),
                vote_for("y", "cup"),
            ],
        );
        let verdicts = vote
            .close(START + ROUND * u32::try_from(round).unwrap())
            .verdicts;
        assert_eq!(verdicts[1].label.as_deref(), Some("cup"));
        if round % 5 == 4 {
            assert_eq!(
                verdicts[0].label,
                Some(format!("thing-{}", round / 5).into())
            );
        }
    }
    assert_eq!(vote.ignored(), 0);
}

#[test]
fn full_ledger_admits_cell_labels() {
    let mut ledger = ReputationLedger::default();
    for number in 0..300 {
        let label = format!("invented-{number:03}").into();
        let evidence = Evidence {
            node: NodeName::from_static("liar"),
            label,
            correct: false,
        };
        ledger.record(1, &NodeName::from_static("edge"), &evidence);
    }
    for mode in [VoteMode::Weighted, VoteMode::Paper] {
        let mut vote = Vote::new(
            VoteConfig {
                mode,
                ..VoteConfig::default()
            },
            Vec::new(),
        );
        vote.adopt(&ledger);
        ["a", "b"]
            .iter()
            .for_each(|node| vote_as(&mut vote, node, 1, &[vote_for("x", "zebra")]));
        assert_eq!(
            vote.close(START + ROUND).verdicts[0].label.as_deref(),
            Some("zebra")
        );
    }
}

#[test]
fn evicted_votes_are_counted() {
    let mut vote = Vote::new(
        VoteConfig {
            max_labels: 8,
            ..VoteConfig::default()
        },
        Vec::new(),
    );
    vote_as(&mut vote, "a", 1, &inventions(1, 20));
    let lost = vote
        .close(START + ROUND)
        .verdicts
        .iter()
        .filter(|verdict| verdict.label.is_none())
        .count();
    assert!(lost >= 12, "{lost} of 20 labels lost");
    assert_eq!(vote.ignored(), lost as u64);
}

#[test]
fn landmark_synonyms_override_cell_synonyms() {
    for mode in [VoteMode::Weighted, VoteMode::Paper] {
        let synonyms = [("vase".into(), "sports ball".into())].into();
        let config = VoteConfig {
            mode,
            synonyms,
            ..VoteConfig::default()
        };
        let landmark = |id: &str, own: &[(&str, &str)]| Landmark {
            id: id.into(),
            position: Point2::origin(),
            facing_rad: None,
            vacancy: None,
            synonyms: own
                .iter()
                .map(|&(from, label)| Synonym {
                    from: from.into(),
                    label: label.into(),
                })
                .collect(),
        };
        let known = vec![
            landmark("x", &[("vase", "bottle")]),
            landmark("y", &[("mug", "cup")]),
        ];
        for landmarks in [known, Vec::new()] {
            let own = if landmarks.is_empty() {
                "sports ball"
            } else {
                "bottle"
            };
            let mut vote = Vote::new(config.clone(), landmarks);
            vote_as(
                &mut vote,
                "a",
                1,
                &[vote_for("x", "vase"), vote_for("y", "vase")],
            );
            let verdicts = vote.close(START + ROUND).verdicts;
            let labels: Vec<_> = verdicts
                .iter()
                .map(|verdict| verdict.label.as_deref())
                .collect();
            assert_eq!(labels, [Some(own), Some("sports ball")], "{mode:?}");
        }
    }
}
