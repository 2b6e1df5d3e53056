//! Replay of the committed recording. Debug and release builds run this test: all must give the bytes of these digests.
//!
//! A change of fusion changes the digests. The author of such a change replaces them by the digests that the test
//! prints.

use ecod::aggregator::FusionConfig;
use ecod::perception::landmark::{Landmark, LandmarkConfig};
use ecod::replay::{FusedLine, Replay, ReplayConfig};
use serde::Deserialize;
use uuid::Uuid;

/// The part of `lot.toml` that fusion needs.
#[derive(Deserialize)]
struct Lot {
    name: String,
    fusion: FusionConfig,
    landmarks: Vec<LandmarkConfig>,
}

fn lot() -> ReplayConfig {
    let Lot {
        name,
        fusion,
        landmarks,
    } = toml::from_str(include_str!("../../examples/recordings/lot.toml")).unwrap();
    let landmarks = landmarks.iter().map(Landmark::from).collect();
    ReplayConfig {
        aggregator: name.parse().unwrap(),
        fusion,
        landmarks,
        ..ReplayConfig::default()
    }
}

/// Digest of all lines of output.
fn digest(config: ReplayConfig) -> String {
    let mut replay = Replay::new(config);
    let recording = include_str!("../../examples/recordings/lot.jsonl");
    let mut rounds: Vec<FusedLine> = recording
        .lines()
        .flat_map(|line| replay.line(line.as_bytes()))
        .collect();
    rounds.extend(replay.finish().0);
    let lines: Vec<_> = rounds
        .iter()
        .map(|round| serde_json::to_string(round).unwrap())
        .collect();
    assert!(!lines.is_empty());
    Uuid::new_v5(&Uuid::NAMESPACE_OID, lines.join("\n").as_bytes()).to_string()
}

#[track_caller]
fn check(config: ReplayConfig, expected: &str) {
    let found = digest(config.clone());
    assert_eq!(found, digest(config), "two runs differ");
    assert_eq!(found, expected);
}

#[test]
fn closed_cell_replays_to_byte() {
    check(lot(), "894d6a04-1c9c-56be-b53d-e205bb7ad342");
}

#[test]
fn learning_cell_replays_to_byte() {
    check(
        ReplayConfig::default(),
        "40920db4-e22d-5107-ba9d-d4df6ef41630",
    );
}

#[test]
fn passes_replay_to_byte() {
    check(
        ReplayConfig {
            passes: Some(20),
            ..ReplayConfig::default()
        },
        "d4afea86-74d2-52d1-bc4d-f50945bf5c68",
    );
}
