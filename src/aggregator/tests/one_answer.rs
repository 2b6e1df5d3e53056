//! Where PACE and VOTE both run, the map has one answer for each place.

use super::*;
use crate::perception::landmark::{Synonym, VacancySign};

/// A cell with one place that has a vacancy sign, and reports of both kinds ten times a second.
struct Lot {
    cell: Aggregator,
    ms: u64,
}

impl Lot {
    fn new() -> Self {
        let sign = VacancySign {
            label: "EMPTY".into(),
            position: Point2::new(0.9, 0.0),
        };
        let synonyms = vec![Synonym {
            from: "VACANT".into(),
            label: "EMPTY".into(),
        }];
        let landmarks = vec![Landmark {
            vacancy: Some(sign),
            synonyms,
            ..landmarks()[0].clone()
        }];
        let round = RoundConfig {
            close: RoundClose::Periodic,
            ..RoundConfig::default()
        };
        let config = FusionConfig {
            round,
            ..FusionConfig::default()
        };
        Self {
            cell: Aggregator::new(NodeName::from_static("edge"), 7, config, landmarks, at(0)),
            ms: 0,
        }
    }

    /// Each vehicle reads its label for some seconds; returns the last round.
    fn read(&mut self, seconds: u64, vehicles: &[(&str, &str)]) -> Fused {
        let mut last = None;
        for _ in 0..seconds * 10 {
            self.ms += 100;
            for (node, label) in vehicles {
                for kind in [Detections, VoteDetections] {
                    let report = report(node, label, self.ms - 10);
                    self.cell.report(kind, &report, at(self.ms - 5)).unwrap();
                }
            }
            last = self.cell.tick(at(self.ms));
            let verdicts = last.as_ref().and_then(|fused| fused.verdicts.as_ref());
            assert!(verdicts.is_none_or(|verdicts| {
                verdicts
                    .verdicts
                    .iter()
                    .all(|verdict| verdict.margin >= 0.0)
            }));
        }
        last.unwrap()
    }

    fn wrong(&self, node: &'static str) -> u64 {
        self.cell
            .reputations()
            .get(&NodeName::from_static(node))
            .map_or(0, |reputation| reputation.incorrect)
    }
}

fn readings(fused: &Fused) -> Vec<(String, Vec<String>)> {
    let readings = &fused.map.as_ref().unwrap().landmarks[0].readings;
    let names = |reading: &crate::wire::LabelReading| {
        reading.nodes.iter().map(NodeName::to_string).collect()
    };
    readings
        .iter()
        .map(|reading| (reading.label.to_string(), names(reading)))
        .collect()
}

/// A vehicle at the side reads the sign behind a plate: this is not a vote against the plate, and
/// the vehicle does not count as wrong.
#[test]
fn sign_behind_plate_is_no_contradiction() {
    let mut lot = Lot::new();
    let fused = lot.read(30, &[("euclid", "MNOP101"), ("galileo", "EMPTY")]);
    assert_eq!(shown(&fused), (Some("MNOP101"), Some("MNOP101")));
    assert_eq!(
        readings(&fused),
        [
            ("EMPTY".into(), vec!["galileo".into()]),
            ("MNOP101".to_owned(), vec!["euclid".to_owned()])
        ]
    );
    assert!(lot.wrong("galileo") <= 1, "{:?}", lot.cell.reputations());
}

/// Maps are sent ten times a second, so a label on which all agree is stated only once.
#[test]
fn only_differing_readings_are_listed() {
    let names = ["euclid", "gauss", "galileo", "noether"];
    let agreeing = Lot::new().read(5, &names.map(|name| (name, "MNOP101")));
    assert_eq!(
        (shown(&agreeing), readings(&agreeing)),
        ((Some("MNOP101"), Some("MNOP101")), Vec::new())
    );
    assert_eq!(agreeing.map.unwrap().landmarks[0].contributors.len(), 4);
    let [first, second, third, fourth] = names;
    let voters = [
        (first, "MNOP101"),
        (second, "MNOP101"),
        (third, "MNOP101"),
        (fourth, "XYZ"),
    ];
    assert_eq!(readings(&Lot::new().read(5, &voters)).len(), 2);
}

#[test]
fn invented_plate_cannot_outvote_sign() {
    let mut lot = Lot::new();
    let honest = [
        ("euclid", "EMPTY"),
        ("gauss", "EMPTY"),
        ("galileo", "EMPTY"),
    ];
    let fused = lot.read(
        20,
        &[honest[0], honest[1], honest[2], ("mallory", "MNOP101")],
    );
    assert_eq!(shown(&fused), (Some("EMPTY"), Some("EMPTY")));
    assert!(
        lot.wrong("mallory") > 5 && lot.wrong("gauss") == 0,
        "{:?}",
        lot.cell.reputations()
    );
}

#[test]
fn distrusted_vehicle_cannot_outvote_reader() {
    let mut lot = Lot::new();
    lot.read(
        20,
        &[
            ("euclid", "EMPTY"),
            ("gauss", "EMPTY"),
            ("galileo", "EMPTY"),
            ("mallory", "MNOP101"),
        ],
    );
    let fused = lot.read(10, &[("euclid", "EMPTY"), ("mallory", "MNOP101")]);
    assert_eq!(shown(&fused), (Some("EMPTY"), Some("EMPTY")));
}

/// A vehicle states the sign by a synonym: it is still no vote against the plate before it.
#[test]
fn sign_synonym_is_no_contradiction() {
    let mut lot = Lot::new();
    let fused = lot.read(30, &[("euclid", "MNOP101"), ("galileo", "VACANT")]);
    assert_eq!(shown(&fused), (Some("MNOP101"), Some("MNOP101")));
    assert_eq!(
        readings(&fused)[0],
        ("EMPTY".into(), vec!["galileo".into()])
    );
}

/// Map and verdict give the same answer, independent of earlier reputation: when the car leaves,
/// when another arrives, and when two vehicles differ.
#[test]
fn map_and_verdict_agree() {
    let mut lot = Lot::new();
    let all = |label: &'static str| [("euclid", label), ("gauss", label), ("galileo", label)];
    for label in ["MNOP101", "EMPTY", "QRST202", "EMPTY"] {
        let fused = lot.read(5, &all(label));
        assert_eq!(shown(&fused), (Some(label), Some(label)));
        let confidence = fused.map.unwrap().landmarks[0].confidence;
        assert!((0.8..=1.0).contains(&confidence), "{label} {confidence}");
    }
    let fused = lot.read(
        20,
        &[
            ("euclid", "MNOP101"),
            ("gauss", "MNOP101"),
            ("galileo", "MNOP1O1"),
        ],
    );
    assert_eq!(shown(&fused), (Some("MNOP101"), Some("MNOP101")));
}
