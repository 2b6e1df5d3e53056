//! Tracking of generated traffic: better than late fusion, and better with the detectors' values beside positions.

use std::collections::BTreeMap;
use std::sync::Arc;

use ecod::aggregator::{Aggregator, Algorithms, FusionConfig};
use ecod::model::names::NodeName;
use ecod::wire::{FusedObject, GlobalMap, ObjectReport, ReportKind};
use ecod_lab::eval::baselines::{LatestReports, NearestTracker, found, suppressed};
use ecod_lab::eval::tracks::{TrackEvaluation, TrackTruth};
use ecod_lab::traffic::{
    ArrivedReport, ReportedFields, SensorConfig, TrafficConfig, TrafficRecording, TruthFrame,
    generate,
};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

const SEED: u64 = 2001;

fn recording_of(config: &TrafficConfig) -> TrafficRecording {
    recording_by(SEED, config)
}

fn recording_by(seed: u64, config: &TrafficConfig) -> TrafficRecording {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    generate(config, &mut || rng.random())
}

/// The maps of an aggregator; `each` gets every report and every map as they come.
fn fuse(recording: &TrafficRecording, each: impl FnMut(Option<&ObjectReport>, Option<&GlobalMap>)) {
    fuse_by(FusionConfig::default(), recording, each);
}

fn fuse_by(
    config: FusionConfig,
    recording: &TrafficRecording,
    mut each: impl FnMut(Option<&ObjectReport>, Option<&GlobalMap>),
) {
    let config = FusionConfig {
        algorithms: Algorithms::Pace,
        ..config
    };
    let time = |n: usize| {
        recording.reports[n]
            .received_at_us
            .unwrap_or(recording.reports[n].report.captured_at_us)
    };
    let mut cell = Aggregator::new(
        NodeName::from_static("edge"),
        1,
        config,
        Vec::new(),
        time(0),
    );
    for (n, arrived) in recording.reports.iter().enumerate() {
        while cell.deadline() <= time(n) {
            each(
                None,
                cell.tick(cell.deadline())
                    .and_then(|fused| fused.map)
                    .as_ref(),
            );
        }
        each(Some(&arrived.report), None);
        let fused = cell
            .report(
                ReportKind::Detections,
                &Arc::new(arrived.report.clone()),
                time(n),
            )
            .unwrap_or_default();
        each(None, fused.and_then(|fused| fused.map).as_ref());
    }
}

#[test]
fn tracking_beats_late_fusion() {
    let town = TrafficConfig {
        observers: 8,
        duration_s: 12.0,
        ..TrafficConfig::default()
    };
    let two = TrafficConfig {
        duration_s: 12.0,
        ..TrafficConfig::two_vehicle_recording()
    };
    for (config, floor) in [(town, FLOOR_TOWN), (two, FLOOR_TWO)] {
        let recording = recording_of(&config);
        let truth = TrackTruth::parse(&serde_json::to_string(&recording.truth).unwrap()).unwrap();
        let mut ours = TrackEvaluation::new(truth.clone());
        let mut late = TrackEvaluation::new(truth);
        let mut latest = LatestReports::default();
        let mut tracker = NearestTracker::default();
        fuse(&recording, |report, map| {
            report.into_iter().for_each(|report| latest.report(report));
            if let Some(map) = map {
                ours.map(map);
                let at = map.fused_at_us;
                late.add_objects(at, &tracker.track(at, &suppressed(latest.union(at))));
            }
        });
        let figures = [ours, late].map(|judge| {
            let scores = judge.result();
            [
                scores.ap_pct[2].unwrap(),
                scores.at_best_f1.moda_pct.unwrap(),
            ]
        });
        let [ours, late] = figures;
        for figure in 0..2 {
            assert!(
                ours[figure] > late[figure].max(floor[figure]),
                "{} observers: AP@2 and MODA are {ours:?}, of late fusion {late:?}",
                config.observers
            );
        }
    }
}

/// AP@2 m and MODA in percent that are not to be lost.
const FLOOR_TOWN: [f64; 2] = [82.0, 70.0];
const FLOOR_TWO: [f64; 2] = [88.0, 76.0];

/// Of cars that drive, over the second half: mean error of velocity in metres per second, share of those whose heading
/// is not known to 0.15 rad, and mean error of length in metres, where it is known.
fn errors(said: &ReportedFields) -> [f64; 3] {
    let mut sums = [(0.0, 0.0); 3];
    for seed in SEED..SEED + 6 {
        let recording = recording_by(
            seed,
            &TrafficConfig {
                observers: 6,
                duration_s: 8.0,
                said: said.clone(),
                ..TrafficConfig::default()
            },
        );
        add_errors(&recording, &mut sums);
    }
    sums.map(|(sum, count)| sum / count)
}

/// Adds the errors in the maps of a recording and their numbers.
fn add_errors(recording: &TrafficRecording, sums: &mut [(f64, f64); 3]) {
    let frames = &recording.truth.frames;
    fuse(recording, |_, map| {
        let Some(map) = map else { return };
        let Some(place) = frames
            .iter()
            .position(|frame| frame.t_us >= map.fused_at_us)
            .filter(|n| *n > 40)
        else {
            return;
        };
        let objects = || {
            map.objects
                .iter()
                .filter(|object| object.confidence > 0.5 && object.label == "car")
        };
        for (x_m, y_m, velocity) in driving(&frames[place - 1], &frames[place]) {
            let distance = |object: &&FusedObject| (object.x_m - x_m).hypot(object.y_m - y_m);
            let Some(object) = objects().min_by(|a, b| distance(a).total_cmp(&distance(b))) else {
                continue;
            };
            if distance(&object) > 1.5 {
                continue;
            }
            let [x, y] = object.velocity_mps.unwrap_or_default();
            let turn = object
                .heading_rad
                .map(|heading| heading - velocity[1].atan2(velocity[0]));
            let is_turned = turn.is_none_or(|turn| turn.sin().atan2(turn.cos()).abs() > 0.15);
            let length = object.size_m.map(|[length, _]| (length - 4.5).abs());
            let off = [
                Some((x - velocity[0]).hypot(y - velocity[1])),
                Some(f64::from(u8::from(is_turned))),
                length,
            ];
            for ((sum, count), off) in sums.iter_mut().zip(off) {
                *sum += off.unwrap_or_default();
                *count += f64::from(u8::from(off.is_some()));
            }
        }
    });
}

/// Where cars are that go faster than 2 m/s, and how fast.
fn driving(before: &TruthFrame, now: &TruthFrame) -> Vec<(f64, f64, [f64; 2])> {
    let dt_s = now.t_us.since(before.t_us).as_secs_f64();
    let cars = now.objects.iter().filter(|object| object.label == "car");
    let moved = cars.filter_map(|car| {
        let earlier = before.objects.iter().find(|object| object.id == car.id)?;
        Some((
            car.x_m,
            car.y_m,
            [
                (car.x_m - earlier.x_m) / dt_s,
                (car.y_m - earlier.y_m) / dt_s,
            ],
        ))
    });
    moved.filter(|(_, _, [x, y])| x.hypot(*y) > 2.0).collect()
}

#[test]
fn stated_velocities_headings_sizes_improve_maps() {
    let plain = errors(&ReportedFields::default());
    let rich = ReportedFields {
        velocities_mps: Some(0.6),
        headings_rad: Some(0.1),
        sizes_m: Some(0.3),
        ..ReportedFields::default()
    };
    let rich = errors(&rich);
    assert!(
        rich[0] < 0.9 * plain[0],
        "velocities are off by {} and {} m/s",
        rich[0],
        plain[0]
    );
    assert!(
        rich[1] < 0.5 * plain[1],
        "{} and {} of the headings are unknown",
        rich[1],
        plain[1]
    );
    assert!(
        plain[2].is_nan() && rich[2] < 1.0,
        "lengths are off by {} m",
        rich[2]
    );
}

/// Average precision and greatest MODA at 0.5, 1 and 2 m in percent, of each: aggregators with and without `align`, late
/// fusion, and the best of the vehicles alone in each figure.
fn aligned_or_not(recording: &TrafficRecording) -> [[f64; 6]; 4] {
    let truth = TrackTruth::parse(&serde_json::to_string(&recording.truth).unwrap()).unwrap();
    let figures = |judge: TrackEvaluation| {
        let scores = judge.result();
        let [a, b, c, _] = scores.ap_pct.map(Option::unwrap);
        let [d, e, f, _] = scores.best_moda_pct.map(Option::unwrap);
        [a, b, c, d, e, f]
    };
    let mut alone: BTreeMap<NodeName, (TrackEvaluation, NearestTracker)> = BTreeMap::new();
    for ArrivedReport { report, .. } in &recording.reports {
        let (judge, tracker) = alone.entry(report.node.clone()).or_insert_with(|| {
            (
                TrackEvaluation::new(truth.clone()),
                NearestTracker::default(),
            )
        });
        judge.add_objects(
            report.captured_at_us,
            &tracker.track(report.captured_at_us, &found(report)),
        );
    }
    let alone = alone.into_values().map(|(judge, _)| figures(judge));
    let best = alone
        .reduce(|a, b| [0, 1, 2, 3, 4, 5].map(|figure| a[figure].max(b[figure])))
        .unwrap();
    let mut late = TrackEvaluation::new(truth.clone());
    let mut latest = LatestReports::default();
    let mut tracker = NearestTracker::default();
    let ours = [true, false].map(|align| {
        let mut config = FusionConfig::default();
        config.tracks.align = align;
        let mut ours = TrackEvaluation::new(truth.clone());
        fuse_by(config, recording, |report, map| {
            report
                .into_iter()
                .filter(|_| align)
                .for_each(|report| latest.report(report));
            if let Some(map) = map {
                ours.map(map);
                let at = map.fused_at_us;
                if align {
                    late.add_objects(at, &tracker.track(at, &suppressed(latest.union(at))));
                }
            }
        });
        figures(ours)
    });
    [ours[0], ours[1], figures(late), best]
}

/// The same, means of twelve scenes: four of 20 s are too few to distinguish half a point.
fn means(scene: impl Fn(u64) -> TrafficRecording) -> [[f64; 6]; 4] {
    let scenes: [_; 12] =
        std::array::from_fn(|number| aligned_or_not(&scene(SEED + number as u64)));
    [0, 1, 2, 3].map(|method| {
        [0, 1, 2, 3, 4, 5].map(|figure| {
            scenes
                .iter()
                .map(|scene| scene[method][figure])
                .sum::<f64>()
                / scenes.len() as f64
        })
    })
}

/// Two cameras on posts, whose positions are off by `pose_m` and as much again at 40 m by their headings.
fn two_posts(seed: u64, pose_m: f64) -> TrafficRecording {
    let sensor = SensorConfig {
        pose_m,
        pose_rad: pose_m / 40.0,
        lures: 0.1,
        ..SensorConfig::default()
    };
    let recording = TrafficConfig::two_vehicle_recording();
    let config = TrafficConfig {
        fixed: true,
        duration_s: 20.0,
        said: ReportedFields::default(),
        sensor,
        ..recording
    };
    config.validate().unwrap();
    recording_by(seed, &config)
}

/// Two vehicles, one of which stamps its captures 100 ms late.
fn stamped_late(seed: u64) -> TrafficRecording {
    let recording = TrafficConfig::two_vehicle_recording();
    let sensor = SensorConfig {
        stamped_late_s: 0.1,
        ..recording.sensor.clone()
    };
    let config = TrafficConfig {
        sensor,
        duration_s: 20.0,
        ..recording
    };
    config.validate().unwrap();
    recording_by(seed, &config)
}

/// Alignment costs at most half a point, and no vehicle alone and no late fusion is better.
fn assert_best(scene: &str, [aligned, unaligned, late, alone]: [[f64; 6]; 4]) {
    let is_best = |figure: usize| {
        let others = late[figure].max(alone[figure]);
        aligned[figure] > unaligned[figure] - 0.5 && aligned[figure] > others
    };
    assert!(
        (0..6).all(is_best),
        "{scene}: {aligned:?} aligned, {unaligned:?} not, {late:?} by late fusion, {alone:?} alone"
    );
}

/// Alignment gains places besides.
fn assert_better(scene: &str, figures: [[f64; 6]; 4]) {
    assert_best(scene, figures);
    let [aligned, unaligned, ..] = figures;
    assert!(
        aligned[0] > unaligned[0],
        "{scene}: AP@0.5 is {} aligned, {} not",
        aligned[0],
        unaligned[0]
    );
}

#[test]
fn alignment_costs_correct_cameras_little() {
    assert_best("0.02 m", means(|seed| two_posts(seed, 0.02)));
}

#[test]
fn alignment_improves_fixed_cameras() {
    for pose_m in [0.1, 0.35] {
        assert_better(
            &format!("{pose_m} m"),
            means(|seed| two_posts(seed, pose_m)),
        );
    }
}

#[test]
fn alignment_corrects_differing_stamps() {
    assert_better("stamps", means(stamped_late));
}

/// Calibration error of confidences and F1 that is lost at 0.5 beside the best threshold, in percent, means of four scenes.
fn calibration(config: &TrafficConfig) -> [f64; 2] {
    let mut sums = [0.0; 2];
    for seed in SEED..SEED + 4 {
        let recording = recording_by(seed, config);
        let mut judge = TrackEvaluation::new(
            TrackTruth::parse(&serde_json::to_string(&recording.truth).unwrap()).unwrap(),
        );
        fuse(&recording, |_, map| {
            map.into_iter().for_each(|map| judge.map(map));
        });
        let scores = judge.result();
        let at = &scores.at_default;
        let f1 = 200.0 * at.matches as f64 / (2 * at.matches + at.false_alarms + at.misses) as f64;
        sums[0] += scores.calibration.confidence.ece_pct.unwrap();
        sums[1] += scores.best_f1_pct.unwrap() - f1;
    }
    sums.map(|sum| sum / 4.0)
}

#[test]
fn confidences_match_observed_frequencies() {
    let town = TrafficConfig {
        duration_s: 15.0,
        ..TrafficConfig::default()
    };
    let slow = SensorConfig {
        rate_hz: 2.0,
        ..SensorConfig::default()
    };
    let towns = [1, 4].map(|observers| TrafficConfig {
        observers,
        ..town.clone()
    });
    let slow = TrafficConfig {
        observers: 4,
        sensor: slow,
        ..town.clone()
    };
    for config in towns.into_iter().chain([
        slow,
        TrafficConfig {
            fixed: true,
            observers: 4,
            ..town
        },
    ]) {
        let [error, lost] = calibration(&config);
        assert!(
            error < 5.0 && lost < 1.5,
            "{config:?}: calibration error {error} %, 0.5 loses {lost} of F1"
        );
    }
}
