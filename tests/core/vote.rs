//! VOTE as a driver sees it.

mod bounds;
mod confidence;
mod generated;
mod labels;
mod ledger;
mod paper;
mod still;
mod stored;

use std::collections::BTreeMap;
use std::time::Duration;

use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ecod::perception::landmark::{Landmark, Synonym};
use ecod::reputation::{Evidence, ReputationLedger};
use ecod::vote::{Vote, VoteConfig, VoteMode, WeightedConfig};
use ecod::wire::{ObjectReport, PerceivedObject, RejectReason, WirePose};
use nalgebra::Point2;
use proptest::prelude::*;

const START: Timestamp = Timestamp(1_700_000_000_000_000);

fn report(node: &str, seq: u64, at: Timestamp, votes: &[(&str, &str, f64)]) -> ObjectReport {
    let object = |&(landmark, label, confidence): &(&str, &str, f64)| PerceivedObject {
        landmark: Some(landmark.into()),
        ..PerceivedObject::new(label, confidence, 0.0, 0.0)
    };
    ObjectReport {
        objects: votes.iter().map(object).collect(),
        ..ObjectReport::new(NodeName::new(node).expect("test names are valid"), seq, at)
    }
}

#[test]
fn repeated_report_is_rejected() {
    let mut vote = Vote::new(VoteConfig::default(), Vec::new());
    let first = report("a", 1, START, &[("x", "cup", 0.9)]);
    vote.observe(&first, START).unwrap();
    assert_eq!(vote.observe(&first, START), Err(RejectReason::OutOfOrder));
    assert_eq!(vote.close(START).verdicts[0].contributors.len(), 1);
}

#[test]
fn uncounted_reports_order_by_time() {
    let mut vote = Vote::new(VoteConfig::default(), Vec::new());
    for (ms, label) in [(0, "cup"), (100, "mouse")] {
        let at = START + Duration::from_millis(ms);
        vote.observe(&report("a", 0, at, &[("x", label, 0.9)]), at)
            .unwrap();
        assert_eq!(vote.close(at).verdicts[0].label.as_deref(), Some(label));
    }
}

#[test]
fn vehicle_has_one_vote() {
    let mut vote = Vote::new(VoteConfig::default(), Vec::new());
    for n in 0..10 {
        let at = START + Duration::from_millis(n);
        vote.observe(&report("loud", n, at, &[("x", "mouse", 0.8)]), at)
            .unwrap();
    }
    for node in ["a", "b"] {
        vote.observe(&report(node, 1, START, &[("x", "cup", 0.8)]), START)
            .unwrap();
    }
    assert_eq!(
        vote.close(START + Duration::from_millis(20)).verdicts[0]
            .label
            .as_deref(),
        Some("cup")
    );
}

#[test]
fn weightless_votes_give_no_verdict() {
    let mut vote = Vote::new(VoteConfig::default(), Vec::new());
    assert!(vote.close(START).verdicts.is_empty());
    vote.observe(&report("a", 1, START, &[("x", "cup", 0.0)]), START)
        .unwrap();
    let mut far = report("b", 1, START, &[("x", "cup", 0.9)]);
    far.pose = Some(WirePose::new(60.0, 0.0, 0.0));
    vote.observe(&far, START).unwrap();
    assert_eq!(vote.ignored(), 2);
    assert!(vote.close(START).verdicts.is_empty());
}

#[test]
fn verdict_ends_with_stale_votes() {
    let mut vote = Vote::new(VoteConfig::default(), Vec::new());
    vote.observe(&report("a", 1, START, &[("x", "cup", 0.9)]), START)
        .unwrap();
    assert_eq!(vote.close(START).verdicts[0].label.as_deref(), Some("cup"));
    vote.observe(&report("b", 1, START, &[("x", "cup", 0.9)]), START)
        .unwrap();
    vote.close(START);
    let round = vote.close(START + Duration::from_secs(3));
    assert_eq!(
        (&round.verdicts[0].label, round.verdicts[0].score),
        (&None, 0.0)
    );
    assert!(round.evidence.len() == 2 && round.evidence.iter().all(|e| e.correct));
}

#[test]
fn paper_mode_sums_printed_products() {
    let mut vote = Vote::new(
        VoteConfig {
            mode: VoteMode::Paper,
            ..VoteConfig::default()
        },
        Vec::new(),
    );
    let mut expected = 0.0;
    let mut reputation = 0.5;
    for n in 0..20 {
        let at = START + Duration::from_millis(n);
        vote.observe(&report("a", n, at, &[("x", "cup", 0.9)]), at)
            .unwrap();
        expected += reputation * 0.9;
        let verdict = vote.close(at).verdicts.remove(0);
        reputation = (reputation + 0.01f64).min(1.0);
        assert!((verdict.score - expected).abs() < 1e-12);
    }
    let score = vote.reputations()[&NodeName::new("a").unwrap()].score;
    assert!((score - reputation).abs() < 1e-12);
}

fn landmark(id: &str, synonyms: &[(&str, &str)]) -> Landmark {
    Landmark {
        id: id.into(),
        position: Point2::origin(),
        facing_rad: None,
        vacancy: None,
        synonyms: synonyms
            .iter()
            .map(|&(from, to)| Synonym {
                from: from.into(),
                label: to.into(),
            })
            .collect(),
    }
}

fn name(node: &str) -> NodeName {
    NodeName::new(node).unwrap()
}

#[test]
fn closed_cell_judges_only_landmarks() {
    let mut vote = Vote::new(
        VoteConfig::default(),
        vec![landmark("x", &[]), landmark("y", &[])],
    );
    vote.observe(
        &report(
            "a",
            1,
            START,
            &[("x", "cup", 0.9), ("elsewhere", "cup", 0.9)],
        ),
        START,
    )
    .unwrap();
    let verdicts = vote.close(START).verdicts;
    assert_eq!(
        verdicts
            .iter()
            .map(|v| v.landmark.as_str())
            .collect::<Vec<_>>(),
        ["x", "y"]
    );
    assert_eq!(
        (verdicts[0].label.as_deref(), &verdicts[1].label),
        (Some("cup"), &None)
    );
    assert_eq!(vote.ignored(), 1);
}

#[test]
fn cell_without_reports_closes_rounds() {
    let mut vote = Vote::new(VoteConfig::default(), vec![landmark("x", &[])]);
    for second in 0..5 {
        let round = vote.close(START + Duration::from_secs(second));
        assert!(
            round
                .verdicts
                .iter()
                .all(|v| v.label.is_none() && v.score == 0.0 && v.contributors.is_empty())
        );
        assert!(round.evidence.is_empty());
    }
    assert!(vote.refine(3).all(|verdict| verdict.label.is_none()));
    assert!(vote.reputations().is_empty());
}

#[test]
fn older_later_report_is_rejected() {
    let mut vote = Vote::new(VoteConfig::default(), Vec::new());
    let later = START + Duration::from_millis(100);
    vote.observe(&report("a", 2, later, &[("x", "cup", 0.9)]), later)
        .unwrap();
    let late = vote.observe(&report("a", 1, START, &[("x", "mouse", 0.9)]), later);
    assert_eq!(late, Err(RejectReason::OutOfOrder));
    assert_eq!(vote.close(later).verdicts[0].label.as_deref(), Some("cup"));
}

#[test]
fn negative_confidence_rejects_report() {
    let mut vote = Vote::new(VoteConfig::default(), Vec::new());
    assert!(
        vote.observe(&report("a", 1, START, &[("x", "cup", -0.5)]), START)
            .is_err()
    );
    assert!(vote.close(START).verdicts.is_empty());
}

#[test]
fn surer_of_two_labels_counts() {
    let mut vote = Vote::new(VoteConfig::default(), Vec::new());
    vote.observe(
        &report("a", 1, START, &[("x", "cup", 0.4), ("x", "mouse", 0.8)]),
        START,
    )
    .unwrap();
    let verdict = vote.close(START).verdicts.remove(0);
    assert_eq!(
        (verdict.label.as_deref(), verdict.votes.len()),
        (Some("mouse"), 1)
    );
    assert_eq!(vote.ignored(), 1);
}

#[test]
fn synonyms_count_as_one_label() {
    let mut vote = Vote::new(
        VoteConfig::default(),
        vec![landmark("ball", &[("vase", "sports ball")])],
    );
    for (node, label) in [("a", "vase"), ("b", "sports ball"), ("c", "cup")] {
        vote.observe(&report(node, 1, START, &[("ball", label, 0.8)]), START)
            .unwrap();
    }
    assert_eq!(
        vote.close(START).verdicts[0].label.as_deref(),
        Some("sports ball")
    );
}

#[test]
fn label_holds_until_clear_lead() {
    let mut vote = Vote::new(VoteConfig::default(), Vec::new());
    let shown = |vote: &mut Vote, seq: u64, votes: &[(&str, &str)]| {
        let at = START + Duration::from_millis(seq);
        for (node, label) in votes {
            vote.observe(&report(node, seq, at, &[("x", label, 0.8)]), at)
                .unwrap();
        }
        vote.close(at).verdicts.remove(0).label.unwrap()
    };
    assert_eq!(shown(&mut vote, 1, &[("a", "mouse")]), "mouse");
    // A draw would otherwise go to the first in alphabetical order.
    assert_eq!(shown(&mut vote, 2, &[("b", "cup")]), "mouse");
    assert_eq!(shown(&mut vote, 3, &[("c", "cup"), ("d", "cup")]), "cup");
}

#[test]
fn excess_vehicles_are_ignored() {
    let config = VoteConfig {
        max_vehicles: 2,
        max_landmarks: 2,
        ..VoteConfig::default()
    };
    let mut vote = Vote::new(config, Vec::new());
    vote.observe(
        &report("a", 1, START, &[("x", "cup", 0.9), ("y", "mouse", 0.9)]),
        START,
    )
    .unwrap();
    vote.observe(&report("b", 1, START, &[("x", "vase", 0.9)]), START)
        .unwrap();
    let third = vote.observe(&report("c", 1, START, &[("x", "mouse", 0.9)]), START);
    assert_eq!(third, Err(RejectReason::TooManyVehicles));
    vote.observe(&report("b", 2, START, &[("z", "mouse", 0.9)]), START)
        .unwrap();
    let landmarks: Vec<_> = vote
        .close(START)
        .verdicts
        .into_iter()
        .map(|v| v.landmark)
        .collect();
    assert_eq!(landmarks, ["y", "z"]);
}

#[test]
fn invented_locations_displace_no_votes() {
    let mut vote = Vote::new(VoteConfig::default(), Vec::new());
    for seq in 1..50 {
        let at = START + Duration::from_millis(100 * seq);
        let names: Vec<_> = (0..1000).map(|place| format!("{seq}-{place}")).collect();
        let invented: Vec<_> = names.iter().map(|name| (&**name, "cup", 0.9)).collect();
        for node in ["a", "b"] {
            vote.observe(&report(node, seq, at, &[("x", "vase", 0.9)]), at)
                .unwrap();
        }
        vote.observe(&report("c", seq, at, &invented), at).unwrap();
        let verdicts = vote.close(at).verdicts;
        let honest = verdicts.iter().find(|verdict| verdict.landmark == "x");
        assert_eq!(honest.unwrap().contributors.len(), 2, "in round {seq}");
    }
}

#[test]
fn adopted_ledger_restores_class_trust() {
    let mut ledger = ReputationLedger::default();
    for n in 0..200 {
        for (node, label, correct) in [
            ("a", "cup", true),
            ("a", "mouse", n % 5 == 0),
            ("b", "cup", n % 5 == 0),
            ("b", "mouse", true),
        ] {
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
    let verdict = |votes: [(&str, &str); 2]| {
        let mut vote = Vote::new(VoteConfig::default(), Vec::new());
        vote.adopt(&ledger);
        vote.adopt(&ledger);
        for (node, label) in votes {
            vote.observe(&report(node, 1, START, &[("x", label, 0.8)]), START)
                .unwrap();
        }
        let verdict = vote.close(START).verdicts.remove(0);
        assert!(
            vote.reputations()
                .values()
                .all(|r| (0.3..=1.0).contains(&r.score))
        );
        verdict.label.unwrap()
    };
    // Each vehicle states one label that it always reads correctly and one label that it mostly misreads.
    assert_eq!(verdict([("a", "cup"), ("b", "cup")]), "cup");
    let mut vote = Vote::new(VoteConfig::default(), Vec::new());
    vote.adopt(&ledger);
    for node in ["a", "c"] {
        vote.observe(
            &report(
                node,
                1,
                START,
                &[("x", if node == "a" { "cup" } else { "mouse" }, 0.8)],
            ),
            START,
        )
        .unwrap();
    }
    let trusted = vote.close(START).verdicts.remove(0);
    vote.observe(&report("a", 2, START, &[("y", "mouse", 0.8)]), START)
        .unwrap();
    vote.observe(&report("c", 2, START, &[("y", "cup", 0.8)]), START)
        .unwrap();
    let doubted = vote.close(START).verdicts.remove(0);
    assert!(trusted.votes["cup"] > doubted.votes["mouse"]);
}

#[test]
fn newcomers_cannot_outvote_proven_pair() {
    let mut ledger = ReputationLedger::default();
    for _ in 0..100 {
        for node in ["a", "b"] {
            ledger.record(
                1,
                &name("edge"),
                &Evidence {
                    node: name(node),
                    label: "cup".into(),
                    correct: true,
                },
            );
        }
    }
    let mut vote = Vote::new(VoteConfig::default(), Vec::new());
    vote.adopt(&ledger);
    for node in ["a", "b"] {
        vote.observe(&report(node, 1, START, &[("x", "cup", 0.8)]), START)
            .unwrap();
    }
    for n in 0..50 {
        vote.observe(
            &report(&format!("new-{n}"), 1, START, &[("x", "mouse", 0.8)]),
            START,
        )
        .unwrap();
    }
    assert_eq!(vote.close(START).verdicts[0].label.as_deref(), Some("cup"));
}

#[test]
fn unwitnessed_vote_earns_no_reputation() {
    let mut vote = Vote::new(VoteConfig::default(), Vec::new());
    let mut evidence = 0;
    for n in 0..100 {
        let at = START + Duration::from_secs(3 * n);
        vote.observe(&report("a", n, at, &[("x", "cup", 0.9)]), at)
            .unwrap();
        evidence += vote.close(at).evidence.len();
    }
    assert_eq!(evidence, 0);
}

#[test]
fn majority_holds_in_any_order() {
    for order in [
        [0, 1, 2],
        [0, 2, 1],
        [1, 0, 2],
        [1, 2, 0],
        [2, 0, 1],
        [2, 1, 0],
    ] {
        let mut vote = Vote::new(VoteConfig::default(), Vec::new());
        for frame in 0..60 {
            for (place, vehicle) in (0..).zip(order) {
                let at = START + Duration::from_millis(100 * frame + 3 * place);
                let (node, label) = [("a", "cup"), ("b", "cup"), ("c", "mouse")][vehicle];
                vote.observe(
                    &report(node, frame, at, &[("x", label, 0.9), ("y", "ball", 0.9)]),
                    at,
                )
                .unwrap();
                // A round may close between any two reports.
                let verdicts = vote.close(at).verdicts;
                let x = verdicts
                    .iter()
                    .find(|verdict| verdict.landmark == "x")
                    .unwrap();
                let all_spoke = x.contributors.len() == 3;
                assert!(
                    !all_spoke || x.label.as_deref() == Some("cup"),
                    "{order:?} frame {frame}: {x:?}"
                );
            }
        }
    }
}

/// One vehicle reports the truth while it is alone, and another label everywhere as soon as others come, one every ten
/// seconds. All landmarks, or nearly all, have one label, so that agreement beyond chance contains no information.
#[test]
fn later_majority_outvotes_first() {
    for rare in [0, 1, 3] {
        let truth = |place: usize| if place < rare { "van" } else { "car" };
        let names: Vec<String> = (0..12).map(|place| format!("slot-{place}")).collect();
        let mut vote = Vote::new(VoteConfig::default(), Vec::new());
        let mut wrong = [0; 8];
        let mut refuted = BTreeMap::<NodeName, i64>::new();
        for frame in 0..1100 {
            let at = START + Duration::from_millis(100 * frame);
            let honest = (frame.saturating_sub(200) / 100).min(7) as usize;
            let mut say = |node: &str, label: &dyn Fn(usize) -> &'static str| {
                let votes: Vec<_> = (0..12).map(|at| (&*names[at], label(at), 0.9)).collect();
                vote.observe(&report(node, frame, at, &votes), at).unwrap();
            };
            say("first", &|place| {
                if frame < 200 { truth(place) } else { "bus" }
            });
            for vehicle in 0..honest {
                say(&format!("v{vehicle}"), &truth);
            }
            let round = vote.close(at);
            for evidence in round.evidence {
                *refuted.entry(evidence.node).or_default() += if evidence.correct { -1 } else { 1 };
            }
            for verdict in round.verdicts {
                let place: usize = verdict.landmark["slot-".len()..].parse().unwrap();
                wrong[honest] += u32::from(verdict.label.as_deref() != Some(truth(place)));
            }
        }
        assert_eq!(wrong[3..], [0; 5], "{rare} rare: {wrong:?}");
        // Two need some seconds, of ten.
        assert!(wrong[2] < 600, "{rare} rare: {wrong:?}");
        let is_refuted =
            |(node, votes): (&NodeName, &i64)| (node.as_str() == "first") == (*votes > 0);
        assert!(refuted.iter().all(is_refuted), "{rare} rare: {refuted:?}");
    }
}

/// Two vehicles that are always right agree as closely as copies do.
#[test]
fn two_right_outvote_wrong_third() {
    let weighted = WeightedConfig {
        freshness_s: 1e9,
        ..WeightedConfig::default()
    };
    let config = VoteConfig {
        weighted,
        ..VoteConfig::default()
    };
    let mut vote = Vote::new(config, Vec::new());
    for item in 0..120u64 {
        let at = START + Duration::from_millis(100 * item);
        let [right, wrong] = if item % 2 == 0 {
            ["cup", "mouse"]
        } else {
            ["mouse", "cup"]
        };
        let third = if item % 5 == 0 { right } else { wrong };
        for (node, label) in [("a", right), ("b", right), ("c", third)] {
            let name = format!("item-{item}");
            let report = report(node, item, at, &[(&name, label, 0.8)]);
            vote.observe(&report, at).unwrap();
        }
        vote.close(at);
    }
    for verdict in vote.verdicts() {
        let item: u64 = verdict.landmark["item-".len()..].parse().unwrap();
        let right = if item.is_multiple_of(2) {
            "cup"
        } else {
            "mouse"
        };
        assert_eq!(
            verdict.label.as_deref(),
            Some(right),
            "{}",
            verdict.landmark
        );
    }
}

#[test]
fn four_copying_vehicles_are_detected() {
    let mut vote = Vote::new(VoteConfig::default(), Vec::new());
    let labels = ["car", "cup", "mouse", "sports ball", "vase"];
    let mut state = 1u64;
    let mut random = |below: u64| {
        state = state
            .wrapping_mul(6_364_136_223_846_793_005)
            .wrapping_add(1_442_695_040_888_963_407);
        ((state >> 33) % below) as usize
    };
    let mut right = 0;
    for round in 0..200 {
        let at = START + Duration::from_secs(3 * round);
        let truths: Vec<usize> = (0..6).map(|_| random(5)).collect();
        let lies: Vec<usize> = truths.iter().map(|t| (t + 1 + random(4)) % 5).collect();
        for vehicle in 0..9 {
            let places: Vec<String> = (0..6).map(|p| format!("x{p}")).collect();
            let votes: Vec<_> = (0..6)
                .map(|p| {
                    let honest = if random(5) == 0 {
                        (truths[p] + 1 + random(4)) % 5
                    } else {
                        truths[p]
                    };
                    (
                        places[p].as_str(),
                        labels[if vehicle < 4 { lies[p] } else { honest }],
                        0.8,
                    )
                })
                .collect();
            vote.observe(&report(&format!("v{vehicle}"), round, at, &votes), at)
                .unwrap();
        }
        for verdict in vote.close(at).verdicts {
            let place: usize = verdict.landmark.as_str()[1..].parse().unwrap();
            right += usize::from(
                round >= 100 && verdict.label.as_deref() == Some(labels[truths[place]]),
            );
        }
    }
    assert!(right >= 540, "{right} of 600");
    let reputations = vote.reputations();
    assert!((0..4).all(|v| reputations[&name(&format!("v{v}"))].score < 0.5));
    assert!((4..9).all(|v| reputations[&name(&format!("v{v}"))].score > 0.6));
}

#[test]
fn exhausted_names_block_no_newcomers() {
    let mut vote = Vote::new(
        VoteConfig {
            max_vehicles: 8,
            ..VoteConfig::default()
        },
        Vec::new(),
    );
    let minute = |n: u64| START + Duration::from_secs(60 * n);
    let mut round = |n: u64, node: &str, label: &str| {
        let at = minute(n);
        let result = vote.observe(&report(node, n, at, &[("x", label, 0.9)]), at);
        if node == "c" {
            vote.close(at);
        }
        (
            result,
            vote.reputations().keys().cloned().collect::<Vec<_>>(),
        )
    };
    for n in 0..20 {
        for node in ["a", "b", "c"] {
            round(n, node, "cup").0.unwrap();
        }
    }
    // One minute later each, an attacker comes under one name after the other.
    for n in 20..60 {
        round(n, &format!("new-{n}"), "mouse").0.unwrap();
    }
    let (_, known) = round(60, "newcomer", "cup");
    assert!(
        known.len() <= 8
            && ["a", "b", "c", "newcomer"]
                .iter()
                .all(|node| known.contains(&name(node))),
        "{known:?}"
    );
    // All at once, they must wait for silence.
    let last = (0..9)
        .map(|n| round(61, &format!("rush-{n}"), "mouse").0)
        .last();
    assert_eq!(last, Some(Err(RejectReason::TooManyVehicles)));
}

#[test]
fn reused_vehicle_index_starts_empty() {
    let config = VoteConfig {
        max_vehicles: 3,
        ..VoteConfig::default()
    };
    let mut vote = Vote::new(config, Vec::new());
    for n in 0..50 {
        let at = START + Duration::from_secs(3 * n);
        for (node, label) in [("liar", "mouse"), ("a", "cup"), ("b", "cup")]
            .into_iter()
            .skip(usize::from(n == 49))
        {
            vote.observe(&report(node, n, at, &[("x", label, 0.9)]), at)
                .unwrap();
        }
        vote.close(at);
    }
    let at = START + Duration::from_secs(1000);
    for (node, label) in [("fresh", "cup"), ("a", "cup"), ("b", "cup")] {
        vote.observe(&report(node, 99, at, &[("x", label, 0.9)]), at)
            .unwrap();
    }
    vote.close(at);
    let reputations = vote.reputations();
    assert_eq!(reputations.len(), 3);
    let fresh = &reputations[&name("fresh")];
    assert!(fresh.incorrect == 0 && fresh.score > 0.5, "{fresh:?}");
}

#[test]
fn backward_clock_keeps_voting() {
    let mut vote = Vote::new(VoteConfig::default(), Vec::new());
    let at = |s: u64| START + Duration::from_secs(s);
    vote.observe(&report("a", 7, at(3600), &[("x", "cup", 0.9)]), at(0))
        .unwrap();
    vote.observe(&report("a", 8, at(1), &[("x", "mouse", 0.9)]), at(1))
        .unwrap();
    assert_eq!(
        vote.close(at(1)).verdicts[0].label.as_deref(),
        Some("mouse")
    );
    // Restarted besides, it also counts from the start.
    vote.observe(&report("b", 7, at(3600), &[("y", "cup", 0.9)]), at(1))
        .unwrap();
    vote.observe(&report("b", 1, at(1), &[("y", "mouse", 0.9)]), at(1))
        .unwrap();
    let verdicts = vote.close(at(1)).verdicts;
    assert_eq!(
        verdicts
            .iter()
            .find(|v| v.landmark.as_str() == "y")
            .unwrap()
            .label
            .as_deref(),
        Some("mouse")
    );
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]
    #[test]
    fn refined_labels_ignore_vote_order(
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
            vote.refine(5).collect::<Vec<_>>()
        };
        let forward: Vec<_> = votes.clone().into_iter().collect();
        let mut turned = forward.clone();
        turned.rotate_left((seed % forward.len() as u64) as usize);
        let a = run(forward);
        let b = run(turned);
        prop_assert_eq!(a.len(), b.len());
        for (a, b) in a.iter().zip(&b) {
            let label = a.label.as_ref().unwrap();
            prop_assert!(a.votes.contains_key(label) && a.votes.len() <= 5);
            prop_assert!((a.score - b.score).abs() < 1e-6);
            prop_assert!(label == b.label.as_ref().unwrap() || a.margin.abs() < 1e-6);
        }
    }
}
