//! Time of a round of tracking; `make bench` runs it and collects the figures in `target/bench.json`.

mod figures;

use std::time::{Duration, Instant};

use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ecod::reputation::ReputationConfig;
use ecod::tracking::{Tracker, TracksConfig};
use ecod::wire::{ObjectReport, PerceivedObject, WirePose};

use figures::Figures;

const NOON: Timestamp = Timestamp(1_732_154_400_000_000);
/// Objects in a report.
const OBJECTS: usize = 50;
/// Distance between neighbouring objects in metres.
const SPACING_M: f64 = 8.0;
/// Objects along each side of the area, for each observer of the same row.
const PER_OBSERVER: f64 = 3.0;
/// Objects of the largest report.
const CROWD: usize = 1000;
/// Distance within which the largest report has all its objects, metres.
const CROWD_RADIUS_M: f64 = 20.0;

fn main() {
    let mut figures = Figures::new("tracks");
    println!(
        "{:>10} {:>10} {:>10} {:>12}",
        "observers", "objects", "round ms", "µs/report"
    );
    let costs =
        [10, 100, 1_000].map(|observers| round(&mut figures, observers) / f64::from(observers));
    figures.flat("tracks_cost_per_report", &costs);
    let round_ms = round(&mut figures, 200);
    figures.goal(
        "tracks_round_of_200_observers_50_objects",
        round_ms,
        20.0,
        " ms",
    );
    crowd(&mut figures);
    figures.save();
}

/// Prints and takes the median time of a round with the largest report of one vehicle: people that are packed within
/// [`CROWD_RADIUS_M`].
fn crowd(figures: &mut Figures) {
    let mut tracker = Tracker::new(TracksConfig::default(), ReputationConfig::default());
    let mut times: Vec<Duration> = (1..=40)
        .map(|frame| {
            let now = NOON + Duration::from_millis(100 * frame);
            let objects = (0..CROWD).map(|number| person(number, frame)).collect();
            let report = ObjectReport {
                objects,
                ..ObjectReport::new(NodeName::from_static("crowd"), frame, now)
            };
            elapsed(|| {
                tracker.observe(report, now);
                std::hint::black_box(tracker.close(now));
            })
        })
        .skip(15)
        .collect();
    times.sort();
    figures.goal(
        "tracks_report_of_1000_objects_within_20_m",
        times[times.len() / 2].as_secs_f64() * 1e3,
        5.0,
        " ms",
    );
}

/// A person of a crowd about a place; all sway by up to 2 m.
fn person(number: usize, frame: u64) -> PerceivedObject {
    let turn = std::f64::consts::TAU * (number * 89 % CROWD) as f64 / CROWD as f64;
    let range_m = number as f64 % CROWD_RADIUS_M;
    let sway_m = 0.3 * (frame % 7) as f64;
    let x_m = 40.0 + sway_m + range_m * turn.cos();
    PerceivedObject::new("person", 0.9, x_m, 40.0 + range_m * turn.sin())
}

/// Prints, takes and returns the median time of a round in milliseconds; the area grows with the observers.
fn round(figures: &mut Figures, observers: u32) -> f64 {
    let mut tracker = Tracker::new(TracksConfig::default(), ReputationConfig::default());
    let mut frame = 0;
    let mut times: Vec<Duration> = (0..40)
        .map(|_| {
            frame += 1;
            let now = NOON + Duration::from_millis(100 * frame);
            let reports: Vec<_> = (0..observers)
                .map(|observer| report(observer, observers, frame, now))
                .collect();
            elapsed(|| {
                for report in reports {
                    tracker.observe(report, now);
                }
                std::hint::black_box(tracker.close(now));
            })
        })
        .skip(15)
        .collect();
    times.sort();
    let least_ms = times[0].as_secs_f64() * 1e3;
    let median_ms = times[times.len() / 2].as_secs_f64() * 1e3;
    let report_us = median_ms * 1e3 / f64::from(observers);
    println!(
        "{observers:>10} {:>10} {median_ms:>10.2} {report_us:>12.1}",
        observers as usize * OBJECTS
    );
    figures.insert(
        format!("tracks_{observers}_observers"),
        serde_json::json!({ "round_ms": median_ms, "round_least_ms": least_ms, "us_per_report": report_us }),
    );
    median_ms
}

/// Report of an observer in a field of standing objects: the nearest around it, each a little off its place.
fn report(observer: u32, observers: u32, frame: u64, now: Timestamp) -> ObjectReport {
    let side = (f64::from(observers).sqrt() * PER_OBSERVER).ceil();
    let columns = (f64::from(observers)).sqrt().ceil() as u32;
    let step = side / f64::from(columns);
    let column = f64::from(observer % columns) * step;
    let row = f64::from(observer / columns) * step;
    let across = (OBJECTS as f64).sqrt().ceil() as usize;
    let object = |n: usize| {
        let jitter =
            ((observer as usize * 31 + n * 17 + frame as usize * 7) % 100) as f64 / 100.0 - 0.5;
        let x_m = (column.floor() + (n % across) as f64) * SPACING_M + 0.4 * jitter;
        let y_m = (row.floor() + (n / across) as f64) * SPACING_M - 0.4 * jitter;
        PerceivedObject::new("car", 0.5 + (n % 50) as f64 / 100.0, x_m, y_m)
    };
    let middle = across as f64 / 2.0 + 0.5;
    let pose = WirePose::new(
        (column + middle) * SPACING_M,
        (row + middle) * SPACING_M,
        0.0,
    );
    let node = NodeName::new(format!("v{observer}")).expect("a valid name");
    ObjectReport {
        pose: Some(pose),
        objects: (0..OBJECTS).map(object).collect(),
        ..ObjectReport::new(node, frame, now)
    }
}

#[expect(clippy::disallowed_methods, reason = "a benchmark reads the clock")]
fn elapsed(run: impl FnOnce()) -> Duration {
    let start = Instant::now();
    run();
    start.elapsed()
}
