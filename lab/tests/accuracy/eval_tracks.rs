//! Figures of tracks against those of published implementations on the same output.
//!
//! `eval_tracks/expected.json` was written by TrackEval 1.3.0 and motmetrics 1.4.0:
//! `RECORD=lab/tests/accuracy/eval_tracks/expected.json packaging/check-eval-tracks`. Truth and maps are late fusion of the
//! first two seconds of generated traffic:
//! `eval_tracks --seeds tuning --count 1 --observers 4 --seconds 2 --recordings DIR`.

use ecod::wire::GlobalMap;
use ecod_lab::eval::tracks::{TrackEvaluation, TrackTruth};
use serde_json::Value;

const TRUTH: &str = include_str!("eval_tracks/truth.json");
const MAPS: &str = include_str!("eval_tracks/maps.jsonl");
const EXPECTED: &str = include_str!("eval_tracks/expected.json");

/// Compares all numbers of `expected` with the numbers of the same name, and returns how many there are.
fn compare(path: &str, found: &Value, expected: &Value) -> usize {
    match expected {
        Value::Object(fields) => fields
            .iter()
            .map(|(key, value)| compare(&format!("{path}.{key}"), &found[key], value))
            .sum(),
        Value::Array(values) => values
            .iter()
            .enumerate()
            .map(|(place, value)| compare(&format!("{path}[{place}]"), &found[place], value))
            .sum(),
        expected => {
            let found = found.as_f64();
            let expected = expected.as_f64().unwrap();
            assert!(
                found.is_some_and(|found| (found - expected).abs() < 1e-6),
                "{path}: {found:?} is not {expected}"
            );
            1
        }
    }
}

#[test]
fn figures_match_trackeval_and_motmetrics() {
    let mut evaluation = TrackEvaluation::new(TrackTruth::parse(TRUTH).unwrap());
    for line in MAPS.lines() {
        evaluation.map(&serde_json::from_str::<GlobalMap>(line).unwrap());
    }
    let scores = evaluation.result();
    let found = serde_json::to_value(&scores).unwrap();
    let mut expected: Value = serde_json::from_str(EXPECTED).unwrap();
    for (name, at) in [
        ("at_best_f1", scores.at_best_f1),
        ("at_default", scores.at_default),
    ] {
        let other = expected[name]
            .as_object_mut()
            .unwrap()
            .remove("motmetrics")
            .unwrap();
        let near = |key: &str, found: f64, tolerance: f64| {
            let expected = other[key].as_f64().unwrap();
            assert!(
                (found - expected).abs() <= tolerance,
                "{name}.{key}: {found} is not {expected}"
            );
        };
        near("mota", at.mota_pct.unwrap() / 100.0, 1e-3);
        near("idf1", at.idf1_pct.unwrap() / 100.0, 1e-3);
        // Where as many pairs can be made in several ways, it chooses by distance alone.
        near("motp", at.motp_m.unwrap(), 1e-3);
    }
    let threshold = expected
        .as_object_mut()
        .unwrap()
        .remove("best_f1_threshold")
        .unwrap();
    assert_eq!(Some(scores.at_best_f1.threshold), threshold.as_f64());
    assert_eq!(compare("", &found, &expected), 6 + 2 * 14);
    assert!(scores.at_best_f1.id_switches > 0 && scores.at_best_f1.false_alarms > 0);
}
