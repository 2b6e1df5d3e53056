//! Confidences of every kind: informative confidences are used, and false confidences do no harm.

use std::time::Duration;

use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ecod::vote::{Vote, VoteConfig};
use ecod::wire::{ObjectReport, PerceivedObject, Verdict};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

const START: Timestamp = Timestamp(1_700_000_000_000_000);
const ITEMS: usize = 400;
const VEHICLES: usize = 8;
const LABELS: usize = 4;

/// Items right in percent, online in one pass and after refinement, over two seeds, where a vote that is right with
/// probability `p` states the confidence that `state` gives for (vehicle, p, a random number).
fn accuracy(state: impl Fn(usize, f64, f64) -> f64) -> (f64, f64) {
    let mut online = 0;
    let mut refined = 0;
    let right = |v: &Verdict, truths: &[usize]| {
        let item: usize = v.landmark.as_str().parse().unwrap();
        v.label.as_deref() == Some(truths[item].to_string().as_str())
    };
    for seed in 0..2 {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let skills: Vec<f64> = (0..VEHICLES)
            .map(|_| rng.random_range(0.45..0.85))
            .collect();
        let mut config = VoteConfig::default();
        config.weighted.freshness_s = 1e9;
        let mut vote = Vote::new(config, Vec::new());
        let mut truths = Vec::new();
        for item in 0..ITEMS {
            let at = START + Duration::from_secs(item as u64);
            let truth = rng.random_range(0..LABELS);
            truths.push(truth);
            for (vehicle, skill) in skills.iter().enumerate() {
                let p = (skill + rng.random_range(-0.4..0.4)).clamp(0.05, 0.99);
                let wrong = (truth + rng.random_range(1..LABELS)) % LABELS;
                let label = if rng.random_bool(p) { truth } else { wrong };
                let object = PerceivedObject {
                    landmark: Some(item.to_string().into()),
                    ..PerceivedObject::new(
                        label.to_string(),
                        state(vehicle, p, rng.random_range(0.0..1.0)),
                        0.0,
                        0.0,
                    )
                };
                let report = ObjectReport {
                    objects: vec![object],
                    ..ObjectReport::new(
                        NodeName::new(format!("v{vehicle}")).unwrap(),
                        item as u64,
                        at,
                    )
                };
                vote.observe(&report, at).unwrap();
            }
            let at_once = vote.close(at).verdicts;
            online += at_once
                .iter()
                .filter(|v| v.landmark.as_str() == item.to_string() && right(v, &truths))
                .count();
        }
        refined += vote.refine(10).filter(|v| right(v, &truths)).count();
    }
    let percent = |n: usize| 100.0 * n as f64 / (2 * ITEMS) as f64;
    (percent(online), percent(refined))
}

#[test]
fn confidences_help_or_are_harmless() {
    let (online, refined) = accuracy(|_, _, _| 1.0);
    assert!(online > 85.0 && refined > 85.0, "{online} {refined}");
    // A confidence that all vehicles share contains no information, whatever its value.
    let (same_online, same_refined) = accuracy(|_, _, _| 0.37);
    assert!((same_online - online).abs() < 0.2 && (same_refined - refined).abs() < 0.2);
    type Statement = fn(usize, f64, f64) -> f64;
    let informative: [(&str, Statement); 3] = [
        ("calibrated", |_, p, _| p),
        ("overconfident", |_, p, _| p.powf(0.25)),
        ("on scales of their own", |vehicle, p, _| {
            p * (0.3 + 0.1 * vehicle as f64).min(1.0)
        }),
    ];
    for (name, state) in informative {
        let (informative_online, informative_refined) = accuracy(state);
        assert!(
            informative_online > online + 0.5 && informative_refined > refined + 0.5,
            "{name}: {informative_online} {online} {informative_refined} {refined}"
        );
    }
    let useless: [(&str, Statement); 3] = [
        ("saturated", |_, p, _| if p > 0.1 { 1.0 } else { 0.99 }),
        ("random", |_, _, noise| noise.max(0.01)),
        ("reversed", |_, p, _| 1.0 - p),
    ];
    for (name, state) in useless {
        let (useless_online, useless_refined) = accuracy(state);
        assert!(
            useless_online > online - 0.5 && useless_refined > refined - 0.5,
            "{name}: {useless_online} {online} {useless_refined} {refined}"
        );
    }
}
