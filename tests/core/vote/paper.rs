//! `paper` mode against a second implementation, written down from the paper's formulas alone.

use std::collections::BTreeMap;
use std::time::Duration;

use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ecod::perception::landmark::Landmark;
use ecod::vote::{Vote, VoteConfig, VoteMode};
use ecod::wire::{ObjectReport, PerceivedObject, WirePose};
use nalgebra::Point2;
use proptest::prelude::*;

const START: Timestamp = Timestamp(1_700_000_000_000_000);
const LABELS: [&str; 3] = ["cup", "mouse", "vase"];
const PLACES: [(f64, f64); 3] = [(0.0, 0.0), (1.0, 0.5), (2.0, -1.0)];

/// One detection: landmark, label, confidence.
type Detection = (usize, usize, f64);

/// One report: vehicle, pose (x, y, heading), detections.
type Report = (usize, (f64, f64, f64), Vec<Detection>);

/// S(ρ,l) += r_v · c_ω · (p_d (1 − d/d_max) + (1 − p_d) θ/360°); after a verdict r_v += 0.01 (correct − incorrect)/all,
/// held between 0.30 and 1.00.
#[derive(Default)]
struct Reference {
    scores: BTreeMap<(usize, usize), f64>,
    reputations: BTreeMap<usize, f64>,
    votes: BTreeMap<usize, Vec<(usize, usize)>>,
}

impl Reference {
    fn observe(&mut self, (vehicle, (x, y, heading), detections): &Report) {
        let reputation = *self.reputations.entry(*vehicle).or_insert(0.5);
        for &(place, label, confidence) in detections {
            let dx = PLACES[place].0 - x;
            let dy = PLACES[place].1 - y;
            let distance = (dx * dx + dy * dy).sqrt();
            if distance > 2.54 || confidence <= 0.0 {
                continue;
            }
            let turn = (dy.atan2(dx) - heading).to_degrees().rem_euclid(360.0);
            let angle = turn.min(360.0 - turn);
            let visibility = 0.7 * (1.0 - distance / 2.54) + 0.3 * angle / 360.0;
            *self.scores.entry((place, label)).or_insert(0.0) +=
                reputation * confidence * visibility;
            self.votes.entry(*vehicle).or_default().push((place, label));
        }
    }

    fn verdict(&self, place: usize) -> Option<usize> {
        let mut best: Option<(usize, f64)> = None;
        for label in 0..LABELS.len() {
            if let Some(&score) = self.scores.get(&(place, label))
                && best.is_none_or(|(_, most)| score > most)
            {
                best = Some((label, score));
            }
        }
        best.map(|(label, _)| label)
    }

    fn close(&mut self) {
        let verdicts: Vec<_> = (0..PLACES.len()).map(|place| self.verdict(place)).collect();
        for (vehicle, votes) in std::mem::take(&mut self.votes) {
            let correct = votes
                .iter()
                .filter(|(place, label)| verdicts[*place] == Some(*label))
                .count() as f64;
            let incorrect = votes.len() as f64 - correct;
            let reputation = self.reputations.entry(vehicle).or_insert(0.5);
            *reputation =
                (*reputation + 0.01 * (correct - incorrect) / votes.len() as f64).clamp(0.3, 1.0);
        }
    }
}

fn landmark(place: usize) -> Landmark {
    Landmark {
        id: format!("place-{place}").into(),
        position: Point2::new(PLACES[place].0, PLACES[place].1),
        facing_rad: None,
        vacancy: None,
        synonyms: Vec::new(),
    }
}

fn wire((vehicle, (x_m, y_m, heading_rad), detections): &Report, seq: u64) -> ObjectReport {
    let object = |&(place, label, confidence): &Detection| PerceivedObject {
        landmark: Some(format!("place-{place}").into()),
        ..PerceivedObject::new(LABELS[label], confidence, PLACES[place].0, PLACES[place].1)
    };
    ObjectReport {
        pose: Some(WirePose::new(*x_m, *y_m, *heading_rad)),
        objects: detections.iter().map(object).collect(),
        ..ObjectReport::new(
            NodeName::new(format!("v{vehicle}")).unwrap(),
            seq,
            START + Duration::from_millis(seq),
        )
    }
}

fn report() -> impl Strategy<Value = Report> {
    let confidence = prop_oneof![Just(0.0), 0.01..1.0, Just(1.0)];
    let detections =
        proptest::collection::vec((0..PLACES.len(), 0..LABELS.len(), confidence), 0..6);
    (0usize..4, (-2.0..2.0, -2.0..2.0, -3.0..3.0), detections)
}

proptest! {
    #[test]
    fn paper_mode_matches_printed_formulas(rounds in proptest::collection::vec(proptest::collection::vec(report(), 0..6), 1..30)) {
        let config = VoteConfig { mode: VoteMode::Paper, ..VoteConfig::default() };
        let mut vote = Vote::new(config, (0..PLACES.len()).map(landmark).collect());
        let mut reference = Reference::default();
        let mut seq = 0;
        for round in &rounds {
            for report in round {
                seq += 1;
                let report_on_wire = wire(report, seq);
                vote.observe(&report_on_wire, report_on_wire.captured_at_us).unwrap();
                reference.observe(report);
            }
            let verdicts = vote.close(START + Duration::from_millis(seq)).verdicts;
            prop_assert_eq!(verdicts.len(), PLACES.len());
            for (place, verdict) in verdicts.iter().enumerate() {
                for (label, name) in LABELS.iter().enumerate() {
                    let expected = reference.scores.get(&(place, label)).copied().unwrap_or(0.0);
                    let score = verdict.votes.get(*name).copied().unwrap_or(0.0);
                    prop_assert!((score - expected).abs() < 1e-9 * (1.0 + expected), "{} {}", score, expected);
                }
                let expected = reference.verdict(place).map(|label| LABELS[label]);
                // Rounding may decide between scores that are equal in theory.
                prop_assert!(verdict.label.as_deref() == expected || verdict.margin.abs() < 1e-9);
                prop_assume!(verdict.label.as_deref() == expected);
            }
            reference.close();
            for (node, reputation) in vote.reputations() {
                let vehicle: usize = node.as_str()[1..].parse().unwrap();
                let expected = reference.reputations[&vehicle];
                prop_assert!((reputation.score - expected).abs() < 1e-9);
                prop_assert!((0.3..=1.0).contains(&reputation.score));
            }
        }
    }
}

#[test]
fn visibility_grows_off_axis() {
    let score = |heading: f64| {
        let config = VoteConfig {
            mode: VoteMode::Paper,
            ..VoteConfig::default()
        };
        let mut vote = Vote::new(config, vec![landmark(0)]);
        vote.observe(
            &wire(&(0, (-1.0, 0.0, heading), vec![(0, 0, 1.0)]), 1),
            START,
        )
        .unwrap();
        vote.close(START).verdicts[0].score
    };
    assert!(score(1.0) > score(0.0));
    assert!((score(1.0) - score(-1.0)).abs() < 1e-12);
}
