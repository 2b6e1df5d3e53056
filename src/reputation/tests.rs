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
    fn scores_stay_within_bounds_and_snapshots_come_back(a in ledger()) {
        for reputation in a.reputations(&ReputationConfig::default()).values() {
            prop_assert!((0.30..=1.00).contains(&reputation.score));
        }
        let snapshot = serde_json::to_string(&a).unwrap();
        prop_assert_eq!(serde_json::from_str::<ReputationLedger>(&snapshot).unwrap(), a);
    }
}

#[test]
fn a_new_epoch_alone_changes_no_score_and_new_evidence_displaces_old() {
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
fn partitions_that_counted_apart_merge_to_their_sum() {
    let name = |n: &str| NodeName::new(n).unwrap();
    let evidence = Evidence {
        node: name("euclid"),
        label: "cup".into(),
        correct: true,
    };
    let mut common = ReputationLedger::default();
    common.record(1, &name("edge"), &evidence);
    let (mut left, mut right) = (common.clone(), common);
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
fn who_was_right_for_long_and_turns_is_found_out_within_what_is_remembered() {
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
fn a_ledger_of_a_million_votes_has_few_marks() {
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
fn marks_that_come_before_their_counts_or_are_lost_do_no_harm() {
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
fn a_snapshot_from_before_there_were_marks_is_read() {
    let text = r#"{"lanes":{"3":{"edge":{"euclid":{"cup":{"correct":410,"incorrect":22}}}}}}"#;
    let ledger: ReputationLedger = serde_json::from_str(text).unwrap();
    assert_eq!(ledger.totals()[&NodeName::from_static("euclid")], (410, 22));
    assert_eq!(serde_json::to_string(&ledger).unwrap(), text);
}

#[test]
fn what_is_remembered_before_ones_own_votes_is_the_others() {
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

fn name(name: &str) -> NodeName {
    NodeName::new(name).unwrap()
}

fn counts(correct: u64, incorrect: u64) -> CellCounts {
    CellCounts {
        all: Counts { correct, incorrect },
        ..CellCounts::default()
    }
}

/// The initial score of a vehicle, given some cells' counts.
fn start_score(said: &[CellCounts], trust: f64) -> f64 {
    let config = ReputationConfig::default();
    let mut foreign = ForeignReputations::default();
    for (number, counts) in said.iter().enumerate() {
        foreign.merge(&name(&format!("cell-{number}")), &name("v"), *counts);
    }
    let votes = foreign
        .votes(config.initial_votes, |_| trust)
        .remove(&name("v"))
        .unwrap_or_default();
    config.mean_with(0.0, 0.0, votes)
}

prop_compose! {
    fn cell_counts()(
        (second, correct, incorrect) in (0u64..3, 0u64..9, 0u64..9),
        (old_correct, old_incorrect) in (0u64..9, 0u64..9),
    ) -> CellCounts {
        let old = Counts { correct: old_correct, incorrect: old_incorrect };
        CellCounts { reset_at: crate::model::time::Timestamp(second), old, ..counts(correct, incorrect) }
    }
}

proptest! {
    /// Messages arrive late, twice, or in any order, and more cells send counts than are kept.
    #[test]
    fn what_cells_say_is_the_same_in_any_order(
        said in proptest::collection::vec((0u64..24, 0u64..3, 1u64..6), 0..80),
        split in 0usize..80,
    ) {
        // The counts of a cell only grow.
        let message = |&(cell, vehicle, time): &(u64, u64, u64)| {
            let old = Counts { correct: time, incorrect: 0 };
            (name(&format!("cell-{cell}")), name(&format!("v{vehicle}")), CellCounts { old, ..counts(time * cell, 3 * time) })
        };
        let said: Vec<_> = said.iter().map(message).collect();
        let merged = |order: &mut dyn Iterator<Item = &(NodeName, NodeName, CellCounts)>| {
            let mut foreign = ForeignReputations::default();
            order.for_each(|(cell, vehicle, counts)| _ = foreign.merge(cell, vehicle, *counts));
            foreign
        };
        let split = split.min(said.len());
        let forward = merged(&mut said.iter());
        prop_assert_eq!(&forward, &merged(&mut said.iter().rev()));
        prop_assert_eq!(&forward, &merged(&mut said[split..].iter().chain(&said).chain(&said[..split])));
    }

    #[test]
    fn counts_of_one_cell_are_a_join_over_resets(a in cell_counts(), b in cell_counts(), c in cell_counts()) {
        let merged = |counts: &[CellCounts]| {
            let mut merged = CellCounts::default();
            counts.iter().for_each(|counts| _ = merged.merge(*counts));
            merged
        };
        prop_assert_eq!(merged(&[a, a]), merged(&[a]));
        prop_assert_eq!(merged(&[a, b, c]), merged(&[c, b, a]));
        prop_assert_eq!(merged(&[a, merged(&[b, c])]), merged(&[merged(&[a, b]), c]));
    }

    /// With any counts in any number of messages of one cell, a newcomer's score moves by a sixth
    /// at most, and stays above the score that tracking treats as worthless.
    #[test]
    fn one_cell_alone_moves_a_start_by_a_bounded_amount(correct in 0..=crate::wire::MAX_INTEGER, incorrect in 0..=crate::wire::MAX_INTEGER) {
        let score = start_score(&[counts(correct, incorrect)], 1.0);
        prop_assert!((1.0 / 3.0 - 1e-9..=2.0 / 3.0 + 1e-9).contains(&score), "{}", score);
    }
}

#[test]
fn a_liar_that_moves_on_starts_below_a_newcomer_and_a_proven_vehicle_above() {
    let liar = start_score(&[counts(10, 90)], 1.0);
    let known_to_four = start_score(&[counts(10, 90); 4], 1.0);
    let proven = start_score(&[counts(450, 10)], 1.0);
    let hardly_known = start_score(&[counts(0, 2)], 1.0);
    let disputed = start_score(&[counts(400, 4), counts(0, 1_000_000)], 1.0);
    println!(
        "starts: liar {liar:.2}, of four cells {known_to_four:.2}, proven {proven:.2}, two wrong votes {hardly_known:.2}, \
         proven and slandered {disputed:.2}"
    );
    assert!(liar < 0.4 && known_to_four < 0.3 && proven > 0.65);
    assert!((0.45..0.5).contains(&hardly_known));
    assert!((disputed - 0.5).abs() < 0.01);
    assert_eq!(
        start_score(&[counts(10, 90)], 0.0),
        0.5,
        "a cell that nobody believes says nothing"
    );
    // The vehicle was right for long and then wrong, and the cell keeps the latest votes.
    let turned = CellCounts {
        old: Counts {
            correct: 9_900,
            incorrect: 0,
        },
        ..counts(10_000, 400)
    };
    assert!(start_score(&[turned], 1.0) < 0.45);
}

#[test]
fn a_cell_whose_word_the_own_evidence_contradicts_is_believed_less() {
    let (liar, honest, newcomer) = (name("liar"), name("honest"), name("newcomer"));
    let judged = |vehicles: usize, own: Counts| {
        let mut foreign = ForeignReputations::default();
        for vehicle in (0..8).map(|number| name(&format!("v{number}"))) {
            foreign.merge(&liar, &vehicle, counts(1, 90));
            foreign.merge(&honest, &vehicle, counts(80, 10));
        }
        [&liar, &honest]
            .into_iter()
            .for_each(|cell| _ = foreign.merge(cell, &newcomer, counts(0, 90)));
        let is_known = |vehicle: &NodeName| {
            (0..vehicles).any(|number| *vehicle == name(&format!("v{number}")))
        };
        let is_news = foreign.judge(|vehicle| is_known(vehicle).then_some(own));
        let alone = |cell: &NodeName| {
            let votes = foreign.votes(2.0, |other| f64::from(u8::from(other == cell)));
            votes.get(&newcomer).map_or(0.0, |votes| votes.incorrect)
        };
        (is_news, alone(&liar) / alone(&honest))
    };
    let right = Counts {
        correct: 90,
        incorrect: 10,
    };
    assert_eq!(judged(0, right), (false, 1.0), "nobody can be judged");
    assert_eq!(
        judged(
            8,
            Counts {
                correct: 12,
                incorrect: 1
            }
        ),
        (false, 1.0),
        "by so few votes neither"
    );
    let weights = [1, 2, 8].map(|vehicles| judged(vehicles, right).1);
    println!("weight of the word of a cell that slandered 1, 2, 8 vehicles: {weights:.2?}");
    assert!((0.6..0.7).contains(&weights[0]) && weights[1..] == [0.5, 0.5]);
}

#[test]
fn own_evidence_soon_outweighs_what_all_others_say() {
    let config = ReputationConfig::default();
    let mut foreign = ForeignReputations::default();
    (0..16).for_each(|cell| {
        _ = foreign.merge(
            &name(&format!("cell-{cell}")),
            &name("v"),
            counts(0, 100_000),
        );
    });
    let votes = foreign.votes(config.initial_votes, |_| 1.0)[&name("v")];
    let needed = (0..500)
        .find(|own| config.mean_with(f64::from(*own), 0.0, votes) > 0.5)
        .unwrap();
    println!("{needed} right votes make up for what sixteen cells say");
    assert!(needed <= 25, "{needed}");
    assert!(config.mean_with(200.0, 0.0, votes) > 0.85);
}

#[test]
fn cells_are_told_of_votes_that_are_remembered_and_of_older_ones() {
    let mut ledger = ReputationLedger::default();
    let vote = |correct| Evidence {
        node: name("v"),
        label: "cup".into(),
        correct,
    };
    (0..2000).for_each(|_| ledger.record(1, &name("edge"), &vote(true)));
    (0..300).for_each(|_| ledger.record(2, &name("gauss"), &vote(false)));
    let told = ledger.cell_counts(500.0)[&name("v")];
    assert_eq!(
        told.all,
        Counts {
            correct: 2000,
            incorrect: 300
        }
    );
    assert_eq!(
        told.remembered(),
        Counts {
            correct: 200,
            incorrect: 300
        }
    );
    let message = told.message(name("lot-1"), name("v"));
    assert_eq!(CellCounts::from(&message), told);
    let beside = ledger.reputations_beside(
        &ReputationConfig::default(),
        &[(name("w"), Default::default())].into(),
    );
    assert_eq!(
        (beside[&name("w")].score, beside[&name("w")].correct),
        (0.5, 0),
        "others' word is enough to be listed"
    );
}
