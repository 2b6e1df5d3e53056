//! Time per detection of the core's hot paths; `make bench` runs it and collects the figures in `target/bench.json`.

mod figures;

use std::sync::Arc;
use std::time::{Duration, Instant};

use ecod::model::detection::{BoundingBox, Detection};
use ecod::model::geometry::Pose;
use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ecod::pace::{Pace, PaceConfig, PaceMode};
use ecod::perception::camera::{Intrinsics, Mount};
use ecod::perception::landmark::{Landmark, LandmarkIndex};
use ecod::perception::projection::{
    Cut, ObjectSize, ObjectSizes, Projection, ProjectionConfig, Ranging,
};
use ecod::wire::{
    Encoding, Limits, ObjectReport, PerceivedObject, WirePose, decode_report, encode,
};
use nalgebra::Point2;

use figures::Figures;

const NOON: Timestamp = Timestamp(1_732_154_400_000_000);
/// Distance between neighbouring landmarks in metres.
const SPACING_M: f64 = 3.0;

fn main() {
    let mut figures = Figures::new("core");
    pace_rounds(&mut figures);
    projections(&mut figures);
    encodings(&mut figures);
    figures.save();
}

/// Rounds of 10² to 10⁶ detections, 32 a vehicle, on as many landmarks as an eighth of the detections.
fn pace_rounds(figures: &mut Figures) {
    println!(
        "{:<6} {:>10} {:>10} {:>10} {:>14}",
        "mode", "detections", "landmarks", "round ms", "ns/detection"
    );
    for (name, mode) in [("bayes", PaceMode::Bayes), ("paper", PaceMode::Paper)] {
        let costs = [100, 1_000, 10_000, 100_000, 1_000_000].map(|detections| {
            let (vehicles, objects) = if detections < 1_000 {
                (10, 10)
            } else {
                (detections / 32, 32)
            };
            let round_ms = round(figures, name, mode, vehicles, objects, detections / 8);
            round_ms / (vehicles * objects) as f64
        });
        figures.flat(&format!("pace_{name}_cost_per_detection"), &costs);
        let large = round(figures, name, mode, 1_000, 32, 4_096);
        figures.goal(
            &format!("pace_{name}_round_of_1000_vehicles_32_objects_4096_landmarks"),
            large,
            5.0,
            " ms",
        );
    }
}

/// Prints, takes and returns the least time of a round in milliseconds: what the machine allows when nothing disturbs.
fn round(
    figures: &mut Figures,
    name: &str,
    mode: PaceMode,
    vehicles: usize,
    objects: usize,
    landmarks: usize,
) -> f64 {
    let side = (landmarks as f64).sqrt().ceil() as usize;
    let index = Arc::new(LandmarkIndex::new(
        grid(landmarks, side),
        PaceConfig::default().gate_m,
    ));
    let reports: Vec<_> = (0..vehicles)
        .map(|v| report(v, objects, landmarks, side))
        .collect();
    let mut pace = Pace::new(
        PaceConfig {
            mode,
            ..PaceConfig::default()
        },
        index,
    );
    let mut now = NOON;
    let times = times(if vehicles * objects > 200_000 { 7 } else { 51 }, || {
        now = now + Duration::from_millis(100);
        for report in &reports {
            pace.observe(report, now);
        }
        std::hint::black_box(pace.close(now));
    });
    let detections = vehicles * objects;
    let least_ms = times[0].as_secs_f64() * 1e3;
    let median_ms = median(&times).as_secs_f64() * 1e3;
    let per_detection_ns = least_ms * 1e6 / detections as f64;
    println!(
        "{name:<6} {detections:>10} {landmarks:>10} {least_ms:>10.3} {per_detection_ns:>14.1}"
    );
    figures.insert(
        format!("pace_{name}_{detections}_detections_{landmarks}_landmarks"),
        serde_json::json!({
            "round_ms": least_ms,
            "round_median_ms": median_ms,
            "ns_per_detection": per_detection_ns,
        }),
    );
    least_ms
}

/// From boxes to positions and their covariances, 10² to 10⁶ of them.
fn projections(figures: &mut Figures) {
    let intrinsics =
        Intrinsics::from_field_of_view(640, 480, 62.2f64.to_radians(), 48.8f64.to_radians());
    let camera = Pose::new(0.6096, 0.4572, 2.8798);
    println!(
        "\n{:<10} {:>10} {:>14}",
        "ranging", "detections", "ns/detection"
    );
    for (name, ranging) in [
        ("box_height", Ranging::BoxHeight),
        ("box_width", Ranging::BoxWidth),
        ("paper", Ranging::Paper),
    ] {
        let size = ObjectSize {
            width_m: 1.8,
            height_m: 1.5,
            length_m: None,
            relative_sigma: 0.05,
        };
        let sizes = ObjectSizes {
            labels: [("car".into(), size)].into(),
            default: Some(size),
        };
        let projection = Projection::new(
            ProjectionConfig {
                ranging,
                sizes,
                ..ProjectionConfig::default()
            },
            intrinsics,
            Mount::default(),
        );
        let costs = [100, 1_000, 10_000, 100_000, 1_000_000].map(|count| {
            let detections: Vec<_> = (0..count).map(detection).collect();
            let times = times(if count > 100_000 { 7 } else { 51 }, || {
                for detection in &detections {
                    // A clipped box is left out, as by a projector.
                    std::hint::black_box(
                        projection
                            .place(detection, Cut::default(), None, &camera)
                            .ok(),
                    );
                }
            });
            let per_detection_ns = times[0].as_secs_f64() * 1e9 / count as f64;
            println!("{name:<10} {count:>10} {per_detection_ns:>14.1}");
            let figure = serde_json::json!({ "ns_per_detection": per_detection_ns });
            figures.insert(format!("projector_{name}_{count}_detections"), figure);
            per_detection_ns
        });
        figures.flat(&format!("projector_{name}_cost_per_detection"), &costs);
    }
}

/// A box somewhere in the image.
fn detection(index: usize) -> Detection {
    let x_min = 10.0 + (index % 500) as f64;
    let y_min = 100.0 + (index % 97) as f64;
    let width = 20.0 + (index % 80) as f64;
    let height = 30.0 + (index % 60) as f64;
    Detection {
        label: if index.is_multiple_of(10) {
            "truck".into()
        } else {
            "car".into()
        },
        confidence: 0.5 + (index % 50) as f64 / 100.0,
        bounding_box: BoundingBox {
            x_min,
            y_min,
            x_max: x_min + width,
            y_max: y_min + height,
        },
        corners: None,
    }
}

/// Every encoding, written and read, per 1000 objects, as reports and as votes; the compact one has goals.
fn encodings(figures: &mut Figures) {
    println!(
        "\n{:<14} {:>16} {:>16} {:>14}",
        "format", "encode µs/1000", "decode µs/1000", "bytes/object"
    );
    let formats = [
        ("json", Encoding::Json),
        ("cbor", Encoding::Cbor),
        ("compact", Encoding::Compact),
    ];
    for (name, encoding) in formats {
        encoding_of(figures, name, encoding, &report(7, 100, 10_000, 100));
        encoding_of(
            figures,
            &format!("{name}_votes"),
            encoding,
            &votes(7, 100, 10_000, 100),
        );
    }
}

fn encoding_of(figures: &mut Figures, name: &str, encoding: Encoding, report: &ObjectReport) {
    let limits = Limits::default();
    let bytes = encode(report, encoding);
    let encode_us = median(&times(301, || {
        drop(std::hint::black_box(encode(report, encoding)));
    }))
    .as_secs_f64()
        * 1e7;
    let decodings = times(301, || {
        drop(std::hint::black_box(decode_report(
            &bytes,
            &report.node,
            &limits,
        )));
    });
    let decode_us = median(&decodings).as_secs_f64() * 1e7;
    let size = bytes.len() as f64 / 100.0;
    println!("{name:<14} {encode_us:>16.1} {decode_us:>16.1} {size:>14.1}");
    figures.insert(
        format!("codec_{name}"),
        serde_json::json!({
            "encode_us_per_1000_objects": encode_us,
            "decode_us_per_1000_objects": decode_us,
            "bytes_per_object": size,
        }),
    );
    if encoding == Encoding::Compact {
        figures.goal(&format!("codec_{name}_bytes_per_object"), size, 40.0, "");
        figures.goal(
            &format!("codec_{name}_decode_per_object"),
            decodings[0].as_secs_f64() * 1e7,
            150.0,
            " ns",
        );
    }
}

/// The same objects as a vehicle votes on them: placards, each with its landmark.
fn votes(vehicle: usize, objects: usize, landmarks: usize, side: usize) -> ObjectReport {
    let mut report = report(vehicle, objects, landmarks, side);
    for (object, landmark) in report
        .objects
        .iter_mut()
        .zip(report.seen.take().into_iter().flatten())
    {
        object.label = "ABCD123".into();
        object.landmark = Some(landmark);
    }
    report
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
    Point2::new(
        (index % side) as f64 * SPACING_M,
        (index / side) as f64 * SPACING_M,
    )
}

/// A vehicle that sees `objects` neighbouring landmarks, each a little off its place.
fn report(vehicle: usize, objects: usize, landmarks: usize, side: usize) -> ObjectReport {
    let first = vehicle.wrapping_mul(2_654_435_761) % landmarks;
    let object = |n: usize| {
        let landmark = (first + n) % landmarks;
        let position = place(landmark, side);
        let jitter = ((vehicle * 31 + n * 17) % 100) as f64 / 100.0 - 0.5;
        PerceivedObject {
            covariance_m2: Some([0.01, 0.001, 0.02]),
            ..PerceivedObject::new(
                if (vehicle + n).is_multiple_of(10) {
                    "truck"
                } else {
                    "car"
                },
                0.5 + ((vehicle + n) % 50) as f64 / 100.0,
                position.x + 0.2 * jitter,
                position.y - 0.2 * jitter,
            )
        }
    };
    ObjectReport {
        pose: Some(WirePose::new(0.6096, 0.4572, 2.8798)),
        objects: (0..objects).map(object).collect(),
        seen: Some(
            (0..objects)
                .map(|n| format!("l{}", (first + n) % landmarks).into())
                .collect(),
        ),
        ..ObjectReport::new(
            NodeName::new(format!("v{vehicle}")).expect("a valid name"),
            1,
            NOON,
        )
    }
}

/// Ascending, without the first run.
#[expect(clippy::disallowed_methods, reason = "a benchmark reads the clock")]
fn times(runs: usize, mut run: impl FnMut()) -> Vec<Duration> {
    run();
    let mut times: Vec<Duration> = (0..runs)
        .map(|_| {
            let start = Instant::now();
            run();
            start.elapsed()
        })
        .collect();
    times.sort();
    times
}

fn median(times: &[Duration]) -> Duration {
    times[times.len() / 2]
}
