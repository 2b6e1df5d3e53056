//! How fast a recording is replayed, from lines to lines; `make bench` runs it and collects the figures in
//! `target/bench.json`.

mod figures;

use std::time::Instant;

use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ecod::replay::{Replay, ReplayConfig};
use ecod::wire::{ObjectReport, PerceivedObject, WirePose};
use serde_json::json;

use figures::Figures;

const VEHICLES: u64 = 20;
const FRAMES: u64 = 500;
const OBJECTS: u64 = 8;
const LANDMARKS: u64 = 64;

fn main() {
    let mut figures = Figures::new("replay");
    println!(
        "{:<16} {:>10} {:>12} {:>14} {:>12}",
        "topic", "reports", "reports/s", "lines written", "MB/s read"
    );
    for topic in ["detections", "vote_detections"] {
        let lines = recording(topic);
        let read: usize = lines.iter().map(String::len).sum();
        let runs: Vec<(f64, u64)> = (0..5).map(|_| run(&lines)).collect();
        let (seconds, written) = runs
            .into_iter()
            .min_by(|a, b| a.0.total_cmp(&b.0))
            .unwrap_or_default();
        let rate = lines.len() as f64 / seconds;
        let megabytes = read as f64 / seconds / 1e6;
        println!(
            "{topic:<16} {:>10} {rate:>12.0} {written:>14} {megabytes:>12.1}",
            lines.len()
        );
        figures.insert(
            topic,
            json!({"reports": lines.len(), "objects_per_report": OBJECTS, "reports_per_second": rate,
                "megabytes_read_per_second": megabytes, "lines_written": written}),
        );
    }
    figures.save();
}

/// Seconds and lines written.
#[expect(clippy::disallowed_methods, reason = "a benchmark reads the clock")]
fn run(lines: &[String]) -> (f64, u64) {
    let start = Instant::now();
    let mut replay = Replay::new(ReplayConfig::default());
    let write = |fused: Vec<ecod::replay::FusedLine>| {
        for line in fused {
            std::hint::black_box(line.to_json());
        }
    };
    for line in lines {
        write(replay.line(line.as_bytes()));
    }
    let (rest, summary) = replay.finish();
    write(rest);
    assert_eq!(summary.used(), lines.len() as u64, "{:?}", summary.rejected);
    (start.elapsed().as_secs_f64(), summary.written)
}

/// Vehicles that each see some of the cell's locations, ten times a second, and misread one in ten.
fn recording(topic: &str) -> Vec<String> {
    let mut lines = Vec::new();
    for frame in 0..FRAMES {
        for vehicle in 0..VEHICLES {
            let object = |n: u64| {
                let place = (vehicle * 3 + n) % LANDMARKS;
                PerceivedObject {
                    covariance_m2: Some([0.01, 0.001, 0.02]),
                    landmark: Some(format!("slot-{place}").into()),
                    ..PerceivedObject::new(
                        if (frame + vehicle + n).is_multiple_of(10) {
                            "truck"
                        } else {
                            "car"
                        },
                        0.5 + ((vehicle + n) % 50) as f64 / 100.0,
                        3.0 * place as f64 + 0.01 * (vehicle % 7) as f64,
                        0.02 * (frame % 5) as f64,
                    )
                }
            };
            let report = ObjectReport {
                pose: (topic == "detections").then_some(WirePose::new(0.6096, 0.4572, 2.8798)),
                objects: (0..OBJECTS).map(object).collect(),
                ..ObjectReport::new(
                    NodeName::new(format!("v{vehicle}")).expect("a valid name"),
                    frame,
                    Timestamp(1_732_154_400_000_000 + frame * 100_000 + vehicle * 1_000),
                )
            };
            let mut line = serde_json::to_value(&report).expect("plain json");
            line["topic"] = topic.into();
            lines.push(line.to_string());
        }
    }
    lines
}
