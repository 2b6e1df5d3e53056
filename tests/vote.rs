//! VOTE as a driver sees it.

use std::time::Duration;

use ecod::names::NodeName;
use ecod::time::Timestamp;
use ecod::vote::{Vote, VoteConfig, VoteMode};
use ecod::wire::{ObjectReport, PerceivedObject, RejectReason, SCHEMA_VERSION, WirePose};
use proptest::prelude::*;

const START: Timestamp = Timestamp(1_700_000_000_000_000);

fn report(node: &str, seq: u64, at: Timestamp, votes: &[(&str, &str, f64)]) -> ObjectReport {
    let object = |&(landmark, label, confidence): &(&str, &str, f64)| PerceivedObject {
        label: label.into(),
        confidence,
        x_m: 0.0,
        y_m: 0.0,
        covariance_m2: None,
        landmark: Some(landmark.into()),
    };
    ObjectReport {
        schema: SCHEMA_VERSION,
        node: NodeName::new(node).expect("test names are valid"),
        seq,
        captured_at_us: at,
        pose: None,
        objects: votes.iter().map(object).collect(),
        seen: None,
    }
}

#[test]
fn a_report_that_comes_twice_is_rejected_and_changes_nothing() {
    let mut vote = Vote::new(VoteConfig::default(), Vec::new());
    let first = report("a", 1, START, &[("x", "cup", 0.9)]);
    vote.observe(&first, START).unwrap();
    assert_eq!(vote.observe(&first, START), Err(RejectReason::OutOfOrder));
    assert_eq!(vote.close(START).verdicts[0].contributors.len(), 1);
}

#[test]
fn a_vehicle_has_one_vote_however_often_it_publishes() {
    let mut vote = Vote::new(VoteConfig::default(), Vec::new());
    for n in 0..10 {
        let at = START + Duration::from_millis(n);
        vote.observe(&report("loud", n, at, &[("x", "mouse", 0.8)]), at).unwrap();
    }
    for node in ["a", "b"] {
        vote.observe(&report(node, 1, START, &[("x", "cup", 0.8)]), START).unwrap();
    }
    assert_eq!(vote.close(START + Duration::from_millis(20)).verdicts[0].label.as_deref(), Some("cup"));
}

#[test]
fn silence_and_votes_without_weight_leave_no_verdict() {
    let mut vote = Vote::new(VoteConfig::default(), Vec::new());
    assert!(vote.close(START).verdicts.is_empty());
    vote.observe(&report("a", 1, START, &[("x", "cup", 0.0)]), START).unwrap();
    let mut far = report("b", 1, START, &[("x", "cup", 0.9)]);
    far.pose = Some(WirePose { x_m: 50.0, y_m: 0.0, heading_rad: 0.0 });
    vote.observe(&far, START).unwrap();
    assert_eq!(vote.ignored(), 2);
    assert!(vote.close(START).verdicts.is_empty());
}

#[test]
fn a_verdict_ends_when_its_votes_are_stale() {
    let mut vote = Vote::new(VoteConfig::default(), Vec::new());
    vote.observe(&report("a", 1, START, &[("x", "cup", 0.9)]), START).unwrap();
    assert_eq!(vote.close(START).verdicts[0].label.as_deref(), Some("cup"));
    let round = vote.close(START + Duration::from_secs(3));
    assert_eq!((&round.verdicts[0].label, round.verdicts[0].score), (&None, 0.0));
    assert!(round.evidence[0].correct);
}

#[test]
fn paper_mode_sums_the_printed_products_and_never_clears() {
    let mut vote = Vote::new(VoteConfig { mode: VoteMode::Paper, ..VoteConfig::default() }, Vec::new());
    let mut expected = 0.0;
    let mut reputation = 0.5;
    for n in 0..20 {
        let at = START + Duration::from_millis(n);
        vote.observe(&report("a", n, at, &[("x", "cup", 0.9)]), at).unwrap();
        expected += reputation * 0.9;
        let verdict = vote.close(at).verdicts.remove(0);
        reputation = (reputation + 0.01f64).min(1.0);
        assert!((verdict.score - expected).abs() < 1e-12);
    }
    let score = vote.reputations()[&NodeName::new("a").unwrap()].score;
    assert!((score - reputation).abs() < 1e-12);
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]
    #[test]
    fn refined_labels_were_voted_for_and_do_not_depend_on_order(
        votes in proptest::collection::btree_map((0usize..6, 0usize..5), 0usize..3, 1..30),
        seed in any::<u64>(),
    ) {
        let labels = ["cup", "mouse", "vase"];
        let run = |order: Vec<((usize, usize), usize)>| {
            let mut vote = Vote::new(VoteConfig::default(), Vec::new());
            for (n, ((landmark, node), label)) in order.iter().enumerate() {
                let said = [(&*format!("x{landmark}"), labels[*label], 0.8)];
                let said = report(&format!("v{node}"), n as u64, START + Duration::from_micros(n as u64), &said);
                vote.observe(&said, START).unwrap();
            }
            vote.close(START);
            vote.refine(5)
        };
        let forward: Vec<_> = votes.clone().into_iter().collect();
        let mut turned = forward.clone();
        turned.rotate_left((seed % forward.len() as u64) as usize);
        let (a, b) = (run(forward), run(turned));
        prop_assert_eq!(a.len(), b.len());
        for (a, b) in a.iter().zip(&b) {
            let label = a.label.as_ref().unwrap();
            prop_assert!(a.votes.contains_key(label) && a.votes.len() <= 5);
            prop_assert!((a.score - b.score).abs() < 1e-6);
            prop_assert!(label == b.label.as_ref().unwrap() || a.margin.abs() < 1e-6);
        }
    }
}
