use proptest::prelude::*;

use super::*;

fn ledger() -> impl Strategy<Value = ReputationLedger> {
    let vote = (0u64..3, 0usize..2, 0usize..3, 0usize..2, any::<bool>());
    let repeated = (vote, 1usize..200);
    proptest::collection::vec(repeated, 0..40).prop_map(|votes| {
        let name = |prefix: &str, n: usize| NodeName::new(format!("{prefix}{n}")).unwrap();
        let mut ledger = ReputationLedger::default();
        for ((epoch, aggregator, node, label, correct), times) in votes {
            let evidence = Evidence {
                node: name("v", node),
                label: format!("l{label}").into(),
                correct,
            };
            (0..times).for_each(|_| ledger.record(epoch, &name("a", aggregator), &evidence));
        }
        ledger
    })
}

fn merged(a: &ReputationLedger, b: &ReputationLedger) -> ReputationLedger {
    let mut merged = a.clone();
    merged.merge(b);
    merged
}

proptest! {
    #[test]
    fn merging_is_a_join_semilattice(a in ledger(), b in ledger(), c in ledger()) {
        prop_assert_eq!(merged(&a, &a), a.clone());
        prop_assert_eq!(merged(&a, &b), merged(&b, &a));
        prop_assert_eq!(merged(&merged(&a, &b), &c), merged(&a, &merged(&b, &c)));
    }

    #[test]
    fn scores_are_bounded_and_snapshots_restore(a in ledger()) {
        for reputation in a.reputations(&ReputationConfig::default()).values() {
            prop_assert!((0.30..=1.00).contains(&reputation.score));
        }
        let snapshot = serde_json::to_string(&a).unwrap();
        prop_assert_eq!(serde_json::from_str::<ReputationLedger>(&snapshot).unwrap(), a);
    }
}

#[test]
fn new_evidence_displaces_old() {
    let name = |n: &str| NodeName::new(n).unwrap();
    let config = ReputationConfig::default();
    let vote = |correct| Evidence {
        node: name("euclid"),
        label: "cup".into(),
        correct,
    };
    let mut ledger = ReputationLedger::default();
    (0..2000).for_each(|_| ledger.record(1, &name("edge"), &vote(true)));
    let score = |ledger: &ReputationLedger| ledger.reputations(&config)[&name("euclid")].score;
    let before = score(&ledger);
    ledger.record(1_732_154_400, &name("gauss"), &vote(true));
    assert!(
        (score(&ledger) - before).abs() < 1e-9,
        "{} {before}",
        score(&ledger)
    );
    (0..400).for_each(|_| ledger.record(1_732_154_400, &name("gauss"), &vote(false)));
    assert!(score(&ledger) < 0.35, "{}", score(&ledger));
}

#[test]
fn partition_counts_merge_to_sum() {
    let name = |n: &str| NodeName::new(n).unwrap();
    let evidence = Evidence {
        node: name("euclid"),
        label: "cup".into(),
        correct: true,
    };
    let mut common = ReputationLedger::default();
    common.record(1, &name("edge"), &evidence);
    let mut left = common.clone();
    let mut right = common;
    left.record(2, &name("left"), &evidence);
    right.record(2, &name("right"), &evidence);
    left.merge(&right);
    assert_eq!(left.totals()[&name("euclid")], (3, 0));
}

/// 10,000 right votes, followed by wrong ones, in one lane.
fn turncoat(wrong: u64) -> ReputationLedger {
    let mut ledger = ReputationLedger::default();
    for number in 0..10_000 + wrong {
        let label = if number % 3 == 0 { "cup" } else { "vase" }.into();
        let evidence = Evidence {
            node: NodeName::from_static("turncoat"),
            label,
            correct: number < 10_000,
        };
        ledger.record(1, &NodeName::from_static("edge"), &evidence);
    }
    ledger
}

#[test]
fn long_correct_deceiver_is_detected() {
    let score = |wrong| {
        let reputations = turncoat(wrong).reputations(&ReputationConfig::default());
        let entry = reputations[&NodeName::from_static("turncoat")];
        assert_eq!((entry.correct, entry.incorrect), (10_000, wrong));
        entry.score
    };
    assert!(score(0) > 0.98);
    assert!((0.65..0.85).contains(&score(125)), "{}", score(125));
    assert!(score(300) < 0.5, "{}", score(300));
    assert!(score(700) < 0.31, "{}", score(700));
}

#[test]
fn million_votes_have_few_marks() {
    let mut marks = marks::Marks::default();
    (1..=31_250).for_each(|number| {
        assert!(marks.insert(
            number,
            Counts {
                correct: 32 * number,
                incorrect: 0
            }
        ));
    });
    assert!((20..=32).contains(&marks.len()), "{}", marks.len());
}

#[test]
fn lost_marks_are_harmless() {
    let ledger = turncoat(700);
    let score = |ledger: &ReputationLedger| {
        ledger.reputations(&ReputationConfig::default())[&NodeName::from_static("turncoat")].score
    };
    let mut copy = ReputationLedger::default();
    copy.merge_marks(ledger.marks(), None);
    copy.merge_entries(ledger.entries(), None);
    assert_eq!(copy, ledger);
    let mut lost = ReputationLedger::default();
    lost.merge_entries(ledger.entries(), None);
    assert!(score(&lost) > 0.9, "as ledgers without marks always were");
    assert!(lost.merge_marks(ledger.marks(), None));
    assert!(score(&lost) < 0.31);
}

#[test]
fn snapshot_without_marks_is_read() {
    let text = r#"{"lanes":{"3":{"edge":{"euclid":{"cup":{"correct":410,"incorrect":22}}}}}}"#;
    let ledger: ReputationLedger = serde_json::from_str(text).unwrap();
    assert_eq!(ledger.totals()[&NodeName::from_static("euclid")], (410, 22));
    assert_eq!(serde_json::to_string(&ledger).unwrap(), text);
}

#[test]
fn remembered_votes_exclude_local_ones() {
    let ledger = turncoat(700);
    let remembered = |own| -> (f64, f64) {
        let votes = ledger.remembered(500.0, |_| own);
        let labels = votes[&NodeName::from_static("turncoat")].values();
        labels.fold((0.0, 0.0), |sum, votes| (sum.0 + votes.0, sum.1 + votes.1))
    };
    // The beginning of the 500 votes lies between two marks.
    let (correct, incorrect) = remembered(0);
    assert!(
        correct < 10.0 && (correct + incorrect - 500.0).abs() < 1e-6,
        "{correct} {incorrect}"
    );
    let (correct, incorrect) = remembered(1500);
    assert!(
        incorrect < 1.0 && (correct - 500.0).abs() < 1.0,
        "{correct} {incorrect}"
    );
}
