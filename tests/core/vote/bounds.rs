//! Properties of the default mode that are independent of the vehicles' statements.

use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use ecod::model::names::{Label, LandmarkId, NodeName};
use ecod::model::time::Timestamp;
use ecod::vote::{REPUTATION_RANGE, Vote, VoteConfig, VoteMode};
use ecod::wire::{ObjectReport, PerceivedObject, Verdict, WirePose};
use proptest::prelude::*;

const START: Timestamp = Timestamp(1_700_000_000_000_000);

/// (vehicle, landmark, label, confidence, distance)
type Statement = (usize, usize, usize, f64, f64);

fn statement() -> impl Strategy<Value = Statement> {
    (0usize..6, 0usize..3, 0usize..4, 0.0f64..=1.0, 0.0f64..60.0)
}

fn rounds() -> impl Strategy<Value = Vec<(u64, Vec<Statement>)>> {
    let gap_ms = prop_oneof![Just(100u64), Just(700), Just(2500)];
    proptest::collection::vec(
        (gap_ms, proptest::collection::vec(statement(), 0..20)),
        1..12,
    )
}

/// The reports of a round, each vehicle's statements in one.
fn reports(seq: u64, at: Timestamp, statements: &[Statement], scale: f64) -> Vec<ObjectReport> {
    let mut objects: BTreeMap<usize, (f64, Vec<PerceivedObject>)> = BTreeMap::new();
    for &(vehicle, landmark, label, confidence, distance) in statements {
        let object = PerceivedObject {
            landmark: Some(format!("place-{landmark}").into()),
            ..PerceivedObject::new(
                format!("label-{label}").as_str(),
                confidence * scale,
                0.0,
                0.0,
            )
        };
        objects
            .entry(vehicle)
            .or_insert_with(|| (distance, Vec::new()))
            .1
            .push(object);
    }
    let report =
        |(vehicle, (distance, objects)): (usize, (f64, Vec<PerceivedObject>))| ObjectReport {
            objects,
            pose: Some(WirePose::new(-distance, 0.0, 0.0)),
            ..ObjectReport::new(NodeName::new(format!("v{vehicle}")).unwrap(), seq, at)
        };
    objects.into_iter().map(report).collect()
}

fn labels(verdicts: &[Verdict]) -> BTreeMap<LandmarkId, Option<Label>> {
    verdicts
        .iter()
        .map(|v| (v.landmark.clone(), v.label.clone()))
        .collect()
}

proptest! {
    #[test]
    fn labels_and_numbers_stay_in_bounds(rounds in rounds()) {
        let mut vote = Vote::new(VoteConfig::default(), Vec::new());
        let mut said: BTreeSet<(LandmarkId, Label)> = BTreeSet::new();
        let mut now = START;
        for (seq, (gap_ms, statements)) in (1u64..).zip(&rounds) {
            now = now + Duration::from_millis(*gap_ms);
            for report in reports(seq, now, statements, 1.0) {
                let objects = report.objects.iter();
                said.extend(objects.map(|o| (o.landmark.clone().unwrap(), o.label.clone())));
                vote.observe(&report, now).unwrap();
            }
            let round = vote.close(now);
            for verdict in &round.verdicts {
                for label in verdict.votes.keys().chain(&verdict.label) {
                    prop_assert!(said.contains(&(verdict.landmark.clone(), label.clone())), "{verdict:?}");
                }
                prop_assert!(verdict.label.is_some() != verdict.contributors.is_empty(), "{verdict:?}");
                let sum: f64 = verdict.votes.values().sum();
                prop_assert!(verdict.votes.values().all(|s| s.is_finite() && *s >= 0.0), "{verdict:?}");
                prop_assert!(sum <= 3.0 * verdict.contributors.len() as f64 + 1e-9, "{verdict:?}");
                prop_assert!(verdict.margin >= 0.0 && verdict.margin <= sum + 1e-9, "{verdict:?}");
            }
            for reputation in vote.reputations().values() {
                prop_assert!((REPUTATION_RANGE.0..=REPUTATION_RANGE.1).contains(&reputation.score), "{reputation:?}");
            }
            for evidence in &round.evidence {
                prop_assert!(said.iter().any(|(_, label)| *label == evidence.label));
            }
        }
    }

    #[test]
    fn report_order_does_not_matter(
        (statements, order) in proptest::collection::vec(statement(), 1..30)
            .prop_flat_map(|s| (Just(s), Just((0..6).collect::<Vec<usize>>()).prop_shuffle())),
    ) {
        let all = reports(1, START, &statements, 1.0);
        let shuffled: Vec<_> = order.iter().filter_map(|&place| all.get(place)).collect();
        prop_assert_eq!(shuffled.len(), all.len());
        let run = |reports: &[&ObjectReport]| {
            let mut vote = Vote::new(VoteConfig::default(), Vec::new());
            reports.iter().for_each(|report| vote.observe(report, START).unwrap());
            vote.close(START).verdicts
        };
        let one = run(&all.iter().collect::<Vec<_>>());
        let other = run(&shuffled);
        let other: BTreeMap<_, _> = other.into_iter().map(|v| (v.landmark.clone(), v)).collect();
        for verdict in one {
            let again = &other[&verdict.landmark];
            for (label, score) in &verdict.votes {
                prop_assert!((score - again.votes[label]).abs() < 1e-9, "{verdict:?} {again:?}");
            }
            if verdict.margin > 1e-6 {
                prop_assert_eq!(&verdict.label, &again.label);
            }
        }
    }

    #[test]
    fn common_confidence_does_not_matter(rounds in rounds(), power in 1i32..5) {
        let run = |confidence: f64| {
            let mut vote = Vote::new(VoteConfig::default(), Vec::new());
            let mut now = START;
            let mut labels_by_round = Vec::new();
            for (seq, (gap_ms, statements)) in (1u64..).zip(&rounds) {
                now = now + Duration::from_millis(*gap_ms);
                let near = statements.iter().map(|&(v, place, label, ..)| (v, place, label, confidence, 1.0));
                let reports = reports(seq, now, &near.collect::<Vec<_>>(), 1.0);
                reports.iter().for_each(|report| vote.observe(report, now).unwrap());
                labels_by_round.push(labels(&vote.close(now).verdicts));
            }
            labels_by_round
        };
        // Powers of two scale without rounding.
        prop_assert_eq!(run(1.0), run(0.5f64.powi(power)));
    }

    #[test]
    fn paper_mode_ignores_confidence_scale(rounds in rounds(), power in 1i32..6) {
        let run = |scale: f64| {
            let mut vote = Vote::new(VoteConfig { mode: VoteMode::Paper, ..VoteConfig::default() }, Vec::new());
            let mut now = START;
            for (seq, (gap_ms, statements)) in (1u64..).zip(&rounds) {
                now = now + Duration::from_millis(*gap_ms);
                let reports = reports(seq, now, statements, scale);
                reports.iter().for_each(|report| vote.observe(report, now).unwrap());
                vote.close(now);
            }
            labels(&vote.verdicts().collect::<Vec<_>>())
        };
        prop_assert_eq!(run(1.0), run(0.5f64.powi(power)));
    }
}
