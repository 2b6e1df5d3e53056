//! Settings that change while an aggregator runs.

use super::*;
use crate::pace::PaceMode;
use crate::perception::landmark::LandmarkConfig;

fn place(id: &str, x_m: f64) -> LandmarkConfig {
    LandmarkConfig::at(id, x_m, 0.0)
}

fn known(places: &[LandmarkConfig]) -> Vec<Landmark> {
    places.iter().map(Landmark::from).collect()
}

fn settings(pace: PaceMode) -> FusionConfig {
    let mut fusion = FusionConfig::default();
    fusion.pace.mode = pace;
    fusion.tracks.mode = TracksMode::On;
    fusion.round.close = RoundClose::Periodic;
    fusion
}

/// Two vehicles see a label at each of two places, and a car elsewhere.
fn seen_by(node: &str, ms: u64) -> Arc<ObjectReport> {
    let at_place = |id: &str, label, x_m| PerceivedObject {
        landmark: Some(id.into()),
        ..PerceivedObject::new(label, 0.9, x_m, 0.0)
    };
    let car = PerceivedObject::new("car", 0.9, 40.0, 7.0);
    Arc::new(ObjectReport {
        objects: vec![at_place("a", "cup", 0.0), at_place("b", "vase", 10.0), car],
        ..ObjectReport::new(NodeName::new(node).unwrap(), ms, at(ms))
    })
}

fn running(fusion: &FusionConfig) -> (Aggregator, Fused) {
    let places = known(&[place("a", 0.0), place("b", 10.0)]);
    let mut cell = Aggregator::new(
        NodeName::from_static("edge"),
        7,
        fusion.clone(),
        places,
        at(0),
    );
    let mut last = None;
    for round in 1..=20 {
        for kind in [Detections, VoteDetections] {
            for node in ["euclid", "gauss"] {
                cell.report(kind, &seen_by(node, round * 100 - 20), at(round * 100 - 10))
                    .unwrap();
            }
        }
        last = cell.tick(at(round * 100));
    }
    (cell, last.unwrap())
}

fn labels(fused: &Fused) -> Vec<(&str, Option<&str>)> {
    let map = fused.map.as_ref().unwrap();
    map.landmarks
        .iter()
        .map(|state| (&*state.id, state.label.as_deref()))
        .collect()
}

fn verdicts(fused: &Fused) -> Vec<(&str, Option<&str>)> {
    let verdicts = fused.verdicts.as_ref().unwrap();
    verdicts
        .verdicts
        .iter()
        .map(|verdict| (&*verdict.landmark, verdict.label.as_deref()))
        .collect()
}

#[test]
fn change_keeps_remaining_landmarks() {
    for mode in [PaceMode::Bayes, PaceMode::Paper] {
        let (mut cell, before) = running(&settings(mode));
        assert_eq!(labels(&before), [("a", Some("cup")), ("b", Some("vase"))]);
        let reputations = cell.reputations();
        let car = before.map.as_ref().unwrap().objects[0].id;
        let mut fusion = settings(mode);
        fusion.round.period_s = 0.05;
        fusion.tracks.gate_m = 3.0;
        let landmarks = vec![place("new", 20.0), place("b", 10.2)];
        let change = Command::Configure {
            fusion: Box::new(fusion),
            landmarks,
        };
        assert_eq!(cell.command(&change, at(2010)), None);
        let after = cell
            .tick(at(2050))
            .expect("the shorter period holds at once");
        assert_eq!(
            (after.epoch.term, after.round),
            (7, before.round + 1),
            "the leadership goes on"
        );
        assert_eq!(
            labels(&after),
            [("new", None), ("b", Some("vase"))],
            "{mode:?}"
        );
        assert_eq!(verdicts(&after), [("b", Some("vase")), ("new", None)]);
        assert_eq!(after.map.as_ref().unwrap().objects[0].id, car);
        assert_eq!(
            cell.reputations().keys().collect::<Vec<_>>(),
            reputations.keys().collect::<Vec<_>>()
        );
        assert!(
            cell.reputations()
                .iter()
                .all(|(node, now)| (now.score - reputations[node].score).abs() < 0.05)
        );
    }
}

#[test]
fn switched_algorithm_starts_or_ends() {
    let (mut cell, _) = running(&settings(PaceMode::Bayes));
    let places = [place("a", 0.0), place("b", 10.0)];
    let only_votes = FusionConfig {
        algorithms: Algorithms::Vote,
        ..settings(PaceMode::Bayes)
    };
    cell.configure(only_votes, known(&places));
    let fused = cell.tick(at(2100)).unwrap();
    assert!(fused.map.is_none() && verdicts(&fused)[0] == ("a", Some("cup")));
    assert_eq!(
        cell.report(Detections, &seen_by("euclid", 2150), at(2150)),
        Err(RejectReason::NotFused)
    );
    cell.configure(settings(PaceMode::Bayes), known(&places));
    cell.report(Detections, &seen_by("euclid", 2180), at(2180))
        .unwrap();
    assert_eq!(
        labels(&cell.tick(at(2200)).unwrap()),
        [("a", Some("cup")), ("b", Some("vase"))]
    );
}

#[test]
fn removing_last_landmark_resumes_learning() {
    let (mut cell, _) = running(&settings(PaceMode::Bayes));
    cell.configure(settings(PaceMode::Bayes), Vec::new());
    cell.report(VoteDetections, &seen_by("euclid", 2050), at(2050))
        .unwrap();
    let fused = cell.tick(at(2100)).unwrap();
    assert_eq!(verdicts(&fused), [("a", Some("cup")), ("b", Some("vase"))]);
    assert_eq!(labels(&fused), []);
}
