//! The evidence that a starting fuser takes over from a ledger.

use std::time::Duration;

use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ecod::reputation::{Evidence, ReputationConfig, ReputationLedger};
use ecod::vote::{Vote, VoteConfig};
use ecod::wire::{ObjectReport, PerceivedObject};

const START: Timestamp = Timestamp(1_700_000_000_000_000);

fn name(node: &str) -> NodeName {
    NodeName::new(node).unwrap()
}

fn record(ledger: &mut ReputationLedger, node: &str, votes: usize, correct: bool) {
    let label = if correct { "cup" } else { "mouse" };
    for _ in 0..votes {
        ledger.record(
            1,
            &name("edge"),
            &Evidence {
                node: name(node),
                label: label.into(),
                correct,
            },
        );
    }
}

/// The label of a place that one vehicle takes for a mouse and others for a cup.
fn verdict(vote: &mut Vote, votes: &[(&str, &str)]) -> Option<String> {
    let at = START + Duration::from_millis(1);
    for (node, label) in votes {
        let object = PerceivedObject {
            landmark: Some("x".into()),
            ..PerceivedObject::new(*label, 0.8, 0.0, 0.0)
        };
        let report = ObjectReport {
            objects: vec![object],
            ..ObjectReport::new(name(node), 1, at)
        };
        vote.observe(&report, at).unwrap();
    }
    vote.close(at).verdicts[0]
        .label
        .as_deref()
        .map(str::to_owned)
}

#[test]
fn restart_distrusts_late_deceiver() {
    let mut ledger = ReputationLedger::default();
    record(&mut ledger, "turncoat", 10_000, true);
    record(&mut ledger, "turncoat", 600, false);
    record(&mut ledger, "honest", 300, true);
    let stored = serde_json::to_string(&ledger).unwrap();
    let ledger: ReputationLedger = serde_json::from_str(&stored).unwrap();
    let published = ledger.reputations(&ReputationConfig::default());
    assert!(published[&name("turncoat")].score < 0.35 && published[&name("honest")].score > 0.95);

    let mut vote = Vote::new(VoteConfig::default(), Vec::new());
    vote.adopt(&ledger);
    let trusted = vote.reputations();
    assert!(trusted[&name("turncoat")].score < 0.35, "{trusted:?}");
    assert!(trusted[&name("honest")].score > 0.9, "{trusted:?}");
    assert_eq!(
        verdict(&mut vote, &[("turncoat", "mouse"), ("honest", "cup")]).as_deref(),
        Some("cup")
    );
}

#[test]
fn exhausted_names_keep_earned_trust() {
    let mut ledger = ReputationLedger::default();
    record(&mut ledger, "zoe", 40, true);
    for number in 0..2000 {
        record(&mut ledger, &format!("a{number:04}"), 12, false);
        record(&mut ledger, &format!("b{number:04}"), 5, true);
    }
    let mut vote = Vote::new(VoteConfig::default(), Vec::new());
    vote.adopt(&ledger);
    assert!(vote.reputations().len() <= VoteConfig::default().max_vehicles);
    assert!(vote.reputations()[&name("zoe")].score > 0.85);
    // Two strangers weigh at most half of her.
    let votes = [("x1", "mouse"), ("x2", "mouse"), ("zoe", "cup")];
    assert_eq!(verdict(&mut vote, &votes).as_deref(), Some("cup"));
}

#[test]
fn standby_adopts_older_votes() {
    let mut vote = Vote::new(VoteConfig::default(), Vec::new());
    let mut ledger = ReputationLedger::default();
    record(&mut ledger, "a", 200, false);
    record(&mut ledger, "b", 200, true);
    let mut round = 0;
    while round < 40 {
        round += 1;
        let at = START + Duration::from_secs(3) * round;
        for node in ["a", "b", "c"] {
            let object = PerceivedObject {
                landmark: Some("x".into()),
                ..PerceivedObject::new("cup", 0.8, 0.0, 0.0)
            };
            let report = ObjectReport {
                objects: vec![object],
                ..ObjectReport::new(name(node), round.into(), at)
            };
            vote.observe(&report, at).unwrap();
        }
        vote.close(at)
            .evidence
            .iter()
            .for_each(|vote| ledger.record(2, &name("edge"), vote));
    }
    let before = vote.reputations();
    vote.adopt(&ledger);
    let after = vote.reputations();
    assert!(
        (before[&name("c")].score - after[&name("c")].score).abs() < 0.01,
        "all of c's votes were counted here"
    );
    assert!(
        after[&name("a")].score < before[&name("a")].score - 0.2,
        "{before:?} {after:?}"
    );
    assert!(
        after[&name("b")].score >= before[&name("b")].score,
        "{before:?} {after:?}"
    );
}

#[test]
fn withdrawn_evidence_stops_counting() {
    let mut forged = ReputationLedger::default();
    record(&mut forged, "liar", 1000, true);
    record(&mut forged, "a", 1000, false);
    record(&mut forged, "b", 1000, false);
    let mut vote = Vote::new(VoteConfig::default(), Vec::new());
    vote.adopt(&forged);
    assert!(vote.reputations()[&name("liar")].score > 0.9);
    vote.adopt(&ReputationLedger::default());
    let scores: Vec<f64> = vote
        .reputations()
        .into_values()
        .map(|vehicle| vehicle.score)
        .collect();
    assert!(
        scores.iter().all(|score| (score - scores[0]).abs() < 1e-9),
        "all are strangers again: {scores:?}"
    );
    assert_eq!(
        verdict(&mut vote, &[("liar", "mouse"), ("a", "cup"), ("b", "cup")]).as_deref(),
        Some("cup")
    );
}
