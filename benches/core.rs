//! Time per detection of the core's hot paths; `make bench` runs it and collects the figures in `target/bench.json`.

use std::sync::Arc;
use std::time::{Duration, Instant};

use ecod::landmark::{Landmark, LandmarkIndex};
use ecod::names::NodeName;
use ecod::pace::{Pace, PaceConfig, PaceMode};
use ecod::time::Timestamp;
use ecod::wire::{Encoding, Limits, ObjectReport, PerceivedObject, SCHEMA_VERSION, WirePose, decode_report, encode};
use nalgebra::Point2;

const NOON: Timestamp = Timestamp(1_732_154_400_000_000);
/// Distance between neighbouring landmarks in metres.
const SPACING_M: f64 = 3.0;

fn main() {
    let mut figures = serde_json::Map::new();
    pace_rounds(&mut figures);
    encodings(&mut figures);
    let path = std::env::var("BENCH_JSON").unwrap_or_else(|_| "target/bench-core.json".into());
    std::fs::write(&path, serde_json::to_vec_pretty(&figures).expect("figures are plain numbers"))
        .unwrap_or_else(|error| panic!("cannot write {path}: {error}"));
}

type Figures = serde_json::Map<String, serde_json::Value>;

/// Rounds of 10² to 10⁶ detections, 32 a vehicle, on as many landmarks as an eighth of the detections.
fn pace_rounds(figures: &mut Figures) {
    println!("{:<8} {:>10} {:>10} {:>12} {:>14}", "mode", "detections", "landmarks", "round ms", "ns/detection");
    for (name, mode) in [("bayes", PaceMode::Bayes), ("paper", PaceMode::Paper)] {
        for detections in [100, 1_000, 10_000, 100_000, 1_000_000] {
            let (vehicles, objects) = if detections < 1_000 { (10, 10) } else { (detections / 32, 32) };
            round(figures, name, mode, vehicles, objects, (detections / 8).max(64));
        }
        round(figures, name, mode, 1_000, 32, 4_096);
    }
}

fn round(figures: &mut Figures, name: &str, mode: PaceMode, vehicles: usize, objects: usize, landmarks: usize) {
    let side = (landmarks as f64).sqrt().ceil() as usize;
    let index = Arc::new(LandmarkIndex::new(grid(landmarks, side), PaceConfig::default().gate_m));
    let reports: Vec<_> = (0..vehicles).map(|v| report(v, objects, landmarks, side)).collect();
    let mut pace = Pace::new(PaceConfig { mode, ..PaceConfig::default() }, index);
    let mut now = NOON;
    let elapsed = median(if vehicles * objects > 200_000 { 5 } else { 31 }, || {
        now = now + Duration::from_millis(100);
        for report in &reports {
            pace.observe(report, now);
        }
        std::hint::black_box(pace.close(now));
    });
    let detections = vehicles * objects;
    let per_detection_ns = elapsed.as_secs_f64() * 1e9 / detections as f64;
    let round_ms = elapsed.as_secs_f64() * 1e3;
    println!("{name:<8} {detections:>10} {landmarks:>10} {round_ms:>12.3} {per_detection_ns:>14.1}");
    figures.insert(
        format!("pace_{name}_{detections}_detections_{landmarks}_landmarks"),
        serde_json::json!({ "round_ms": round_ms, "ns_per_detection": per_detection_ns }),
    );
}

/// JSON and CBOR, written and read, per 1000 objects.
fn encodings(figures: &mut Figures) {
    let report = report(7, 100, 10_000, 100);
    let limits = Limits::default();
    println!("\n{:<8} {:>16} {:>16} {:>14}", "format", "encode µs/1000", "decode µs/1000", "bytes/object");
    for (name, encoding) in [("json", Encoding::Json), ("cbor", Encoding::Cbor)] {
        let bytes = encode(&report, encoding);
        let encode_us = median(301, || drop(std::hint::black_box(encode(&report, encoding)))).as_secs_f64() * 1e7;
        let decode_us = median(301, || drop(std::hint::black_box(decode_report(&bytes, &report.node, &limits))))
            .as_secs_f64()
            * 1e7;
        let size = bytes.len() as f64 / 100.0;
        println!("{name:<8} {encode_us:>16.1} {decode_us:>16.1} {size:>14.1}");
        figures.insert(
            format!("codec_{name}"),
            serde_json::json!({
                "encode_us_per_1000_objects": encode_us,
                "decode_us_per_1000_objects": decode_us,
                "bytes_per_object": size,
            }),
        );
    }
}

fn grid(landmarks: usize, side: usize) -> Vec<Landmark> {
    let at = |index: usize| Landmark {
        id: format!("l{index}").into(),
        position: place(index, side),
        facing_rad: None,
        vacancy: None,
        synonyms: Vec::new(),
    };
    (0..landmarks).map(at).collect()
}

fn place(index: usize, side: usize) -> Point2<f64> {
    Point2::new((index % side) as f64 * SPACING_M, (index / side) as f64 * SPACING_M)
}

/// A vehicle that sees `objects` neighbouring landmarks, each a little off its place.
fn report(vehicle: usize, objects: usize, landmarks: usize, side: usize) -> ObjectReport {
    let first = vehicle.wrapping_mul(2_654_435_761) % landmarks;
    let object = |n: usize| {
        let landmark = (first + n) % landmarks;
        let position = place(landmark, side);
        let jitter = ((vehicle * 31 + n * 17) % 100) as f64 / 100.0 - 0.5;
        PerceivedObject {
            label: if (vehicle + n).is_multiple_of(10) { "truck".into() } else { "car".into() },
            confidence: 0.5 + ((vehicle + n) % 50) as f64 / 100.0,
            x_m: position.x + 0.2 * jitter,
            y_m: position.y - 0.2 * jitter,
            covariance_m2: Some([0.01, 0.001, 0.02]),
            landmark: None,
        }
    };
    ObjectReport {
        schema: SCHEMA_VERSION,
        node: NodeName::new(format!("v{vehicle}")).expect("a valid name"),
        seq: 1,
        captured_at_us: NOON,
        pose: Some(WirePose { x_m: 0.6096, y_m: 0.4572, heading_rad: 2.8798 }),
        objects: (0..objects).map(object).collect(),
        seen: Some((0..objects).map(|n| format!("l{}", (first + n) % landmarks).into()).collect()),
    }
}

#[expect(clippy::disallowed_methods, reason = "a benchmark reads the clock")]
fn median(runs: usize, mut run: impl FnMut()) -> Duration {
    run();
    let mut times: Vec<Duration> = (0..runs)
        .map(|_| {
            let start = Instant::now();
            run();
            start.elapsed()
        })
        .collect();
    times.sort();
    times[runs / 2]
}
