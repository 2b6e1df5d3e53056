//! Tracking through the aggregator and the replay: the outputs of a cell for the reports of its vehicles.

use std::sync::Arc;
use std::time::Duration;

use ecod::aggregator::round::FirstRound;
use ecod::aggregator::{Aggregator, FusionConfig};
use ecod::model::epoch::Epoch;
use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ecod::perception::landmark::Landmark;
use ecod::replay::{FusedLine, Replay, ReplayConfig, Summary};
use ecod::tracking::{TracksConfig, TracksMode};
use ecod::wire::{
    Encoding, FieldOfView, GlobalMap, ObjectReport, PerceivedObject, RejectReason, ReportKind,
    WirePose, encode,
};
use nalgebra::Point2;

const START: u64 = 1_732_154_400_000_000;

fn report(node: &str, frame: u64, at: Timestamp, objects: Vec<PerceivedObject>) -> ObjectReport {
    ObjectReport {
        objects,
        ..ObjectReport::new(NodeName::new(node).unwrap(), frame, at)
    }
}

/// A car that drives east at 8 m/s and a standing car, as two vehicles detect them.
fn cars(frame: u64) -> Vec<PerceivedObject> {
    vec![
        PerceivedObject::new("car", 0.9, 0.8 * frame as f64, 0.0),
        PerceivedObject::new("car", 0.8, 10.0, 8.0),
    ]
}

fn replayed(lines: &[ObjectReport]) -> (Vec<GlobalMap>, Summary) {
    let mut replay = Replay::new(ReplayConfig::default());
    let mut output: Vec<_> = lines
        .iter()
        .flat_map(|line| replay.line(&encode(line, Encoding::Json)))
        .collect();
    let (rest, summary) = replay.finish();
    output.extend(rest);
    let map = |line| match line {
        FusedLine::Map(map) => map,
        FusedLine::Verdicts(verdicts) => panic!("there are no votes: {verdicts:?}"),
    };
    (output.into_iter().map(map).collect(), summary)
}

/// One map for every frame, at its time, with the cars where they are, whatever the phase of the rounds.
#[test]
fn recording_without_landmarks_is_tracked() {
    for jitter_us in [0, 300, 4_000] {
        let time =
            |frame: u64| Timestamp(START + frame * 100_000 + (frame * 7_919) % (2 * jitter_us + 1));
        let lines: Vec<_> = (0..60)
            .flat_map(|frame| {
                ["euclid", "gauss"].map(|node| report(node, frame, time(frame), cars(frame)))
            })
            .collect();
        let (maps, summary) = replayed(&lines);
        assert_eq!(summary.used(), 120);
        let mut id = None;
        for frame in 5..59 {
            let map = maps.iter().find(|map| map.fused_at_us == time(frame));
            let map = map.unwrap_or_else(|| panic!("no map at frame {frame}, jitter {jitter_us}"));
            assert_eq!(map.oldest_capture_us, Some(time(frame)));
            let moving = map
                .objects
                .iter()
                .find(|object| object.y_m.abs() < 2.0)
                .unwrap();
            assert!(
                (moving.x_m - 0.8 * frame as f64).abs() < 0.3,
                "{frame}: {moving:?}"
            );
            assert_eq!(
                (*id.get_or_insert(moving.id), map.objects.len()),
                (moving.id, 2)
            );
        }
        assert!(maps.len() <= 62, "{} maps of 60 frames", maps.len());
    }
}

#[test]
fn missed_frames_shift_no_other_maps() {
    let time = |frame: u64| Timestamp(START + frame * 100_000);
    let lines: Vec<_> = (0..60)
        .flat_map(|frame| ["euclid", "gauss"].map(|node| (frame, node)))
        .filter(|(frame, node)| *node == "euclid" || frame % 3 != 0)
        .map(|(frame, node)| report(node, frame, time(frame), cars(frame)))
        .collect();
    let (maps, _) = replayed(&lines);
    for frame in 5..59 {
        // The vehicle that misses the frame is waited for as long as reports are still coming in.
        let in_time = time(frame)..=time(frame) + Duration::from_millis(10);
        let map = maps
            .iter()
            .find(|map| in_time.contains(&map.fused_at_us))
            .unwrap();
        assert_eq!(map.oldest_capture_us, Some(time(frame)), "frame {frame}");
    }
}

fn landmark() -> Landmark {
    let position = Point2::new(10.0, 8.0);
    Landmark {
        id: "slot".into(),
        position,
        facing_rad: None,
        vacancy: None,
        synonyms: vec![],
    }
}

#[test]
fn landmarks_leave_rest_to_optional_tracks() {
    for (mode, expected) in [
        (TracksMode::Auto, 0),
        (TracksMode::Off, 0),
        (TracksMode::On, 1),
    ] {
        let tracks = TracksConfig {
            mode,
            ..TracksConfig::default()
        };
        let config = FusionConfig {
            tracks,
            ..FusionConfig::default()
        };
        let name = NodeName::from_static("edge");
        let mut cell = Aggregator::new(name, 1, config, vec![landmark()], Timestamp(START));
        let mut last = None;
        for frame in 1..20 {
            let now = Timestamp(START + frame * 100_000);
            let fused = cell
                .report(
                    ReportKind::Detections,
                    &Arc::new(report("euclid", frame, now, cars(frame))),
                    now,
                )
                .unwrap();
            last = fused.or_else(|| cell.tick(now)).or(last);
        }
        let map = last.unwrap().map.unwrap();
        assert_eq!(map.objects.len(), expected, "{mode:?}: {:?}", map.objects);
        assert_eq!(map.landmarks[0].label.as_deref(), Some("car"));
    }
}

#[test]
fn standby_keeps_identities() {
    let open = || Aggregator::new_standby(FusionConfig::default(), Vec::new(), Timestamp(START));
    let mut leader = open();
    let mut standby = open();
    leader.lead(
        Epoch::new(1, NodeName::from_static("edge")),
        1,
        FirstRound::OnTime,
        Timestamp(START),
    );
    let mut map = None;
    for frame in 1..30 {
        let now = Timestamp(START + frame * 100_000);
        for cell in [&mut leader, &mut standby] {
            let fused = cell
                .report(
                    ReportKind::Detections,
                    &Arc::new(report("euclid", frame, now, cars(frame))),
                    now,
                )
                .unwrap();
            map = fused
                .or_else(|| cell.tick(now))
                .and_then(|fused| fused.map)
                .or(map);
        }
    }
    let now = Timestamp(START + 3_000_000);
    standby.lead(
        Epoch::new(2, NodeName::from_static("gauss")),
        30,
        FirstRound::Overdue,
        now,
    );
    let next = standby.tick(now).unwrap().map.unwrap();
    let ids = |map: &GlobalMap| {
        map.objects
            .iter()
            .map(|object| object.id)
            .collect::<Vec<_>>()
    };
    assert_eq!(ids(&next), ids(&map.unwrap()));
}

/// The map contains each detection of `euclid` once, including detections in frames that arrive after the next frame. A
/// frame later than the bound is discarded and counted.
#[test]
fn overtaken_reports_count_for_tracks_only() {
    let tracks = TracksConfig {
        mode: TracksMode::On,
        ..TracksConfig::default()
    };
    let config = FusionConfig {
        tracks,
        ..FusionConfig::default()
    };
    let mut cell = Aggregator::new(
        NodeName::from_static("edge"),
        1,
        config,
        vec![landmark()],
        Timestamp(START),
    );
    let time = |frame: u64| Timestamp(START + frame * 100_000);
    let mut last = None;
    for frame in (2..40).step_by(2) {
        let now = time(frame) + Duration::from_millis(20);
        let standing = PerceivedObject::new("car", 0.8, 10.0, 8.0);
        let in_time = Arc::new(report("euclid", frame, time(frame), vec![standing]));
        let moving = PerceivedObject::new("car", 0.9, 0.8 * (frame - 1) as f64, 0.0);
        let truck = PerceivedObject::new("truck", 0.99, 10.0, 8.0);
        let overtaken = Arc::new(report(
            "euclid",
            frame - 1,
            time(frame - 1),
            vec![moving, truck],
        ));
        last = cell
            .report(ReportKind::Detections, &in_time, now)
            .unwrap()
            .or(last);
        assert_eq!(
            cell.report(ReportKind::Detections, &overtaken, now),
            Ok(None)
        );
        for again in [&in_time, &overtaken] {
            assert_eq!(
                cell.report(ReportKind::Detections, again, now),
                Err(RejectReason::OutOfOrder)
            );
        }
        last = cell.tick(time(frame + 2)).or(last);
    }
    let map = last.unwrap().map.unwrap();
    let moving = map
        .objects
        .iter()
        .find(|object| object.y_m.abs() < 1.0)
        .unwrap_or_else(|| panic!("{map:?}"));
    assert!((moving.x_m - 0.8 * 40.0).abs() < 0.5, "{moving:?}");
    assert_eq!(
        map.landmarks[0].label.as_deref(),
        Some("car"),
        "known locations go by the latest report"
    );
    assert_eq!((cell.overtaken(), cell.tracks_losses().late), (19, 0));
    let late = Arc::new(report("euclid", 32, Timestamp(START + 3_250_000), cars(32)));
    assert_eq!(
        cell.report(ReportKind::Detections, &late, time(40)),
        Err(RejectReason::OutOfOrder)
    );
    assert_eq!((cell.overtaken(), cell.tracks_losses().late), (19, 1));
}

/// One vehicle among four states the place of each object `shift_m` away and nearly without error; the others are right,
/// within 0.3 m. The largest error of an object's mean place in the map, in metres.
fn dragged_by(shift_m: f64, stated_sigma_m: f64, has_pose: bool) -> f64 {
    let places = [(20.0, 0.0), (0.0, 20.0), (-20.0, 5.0), (5.0, -20.0)];
    let mut noise = 0x2545_f491_4f6c_dd1d_u64;
    let mut error_m = || {
        // Xorshift: Marsaglia 2003. A sum of four uniform numbers, with a standard deviation of 0.3 m.
        let mut sum = 0.0;
        for _ in 0..4 {
            noise ^= noise << 13;
            noise ^= noise >> 7;
            noise ^= noise << 17;
            sum += noise as f64 / u64::MAX as f64 - 0.5;
        }
        0.3 * sum / (4.0_f64 / 12.0).sqrt()
    };
    let lines: Vec<_> = (0..300)
        .flat_map(|frame| {
            let at = Timestamp(START + frame * 100_000);
            ["ada", "euclid", "gauss", "mallory"].map(|node| {
                let (shift_m, sigma_m) = match node {
                    "mallory" => (shift_m, stated_sigma_m),
                    _ => (0.0, 0.3),
                };
                let objects = places.map(|(x_m, y_m)| PerceivedObject {
                    covariance_m2: Some([sigma_m * sigma_m, 0.0, sigma_m * sigma_m]),
                    ..match node {
                        "mallory" => PerceivedObject::new("car", 0.9, x_m + shift_m, y_m),
                        _ => PerceivedObject::new("car", 0.9, x_m + error_m(), y_m + error_m()),
                    }
                });
                ObjectReport {
                    pose: has_pose.then(|| WirePose::new(2.0, 3.0, 0.0)),
                    ..report(node, frame, at, objects.into())
                }
            })
        })
        .collect();
    let (maps, _) = replayed(&lines);
    let late = &maps[maps.len() / 2..];
    let drag = |(x_m, y_m): (f64, f64)| {
        let near = late.iter().flat_map(|map| &map.objects);
        let near = near.filter(|object| (object.x_m - x_m).hypot(object.y_m - y_m) < 3.0);
        let shifts: Vec<_> = near
            .map(|object| (object.x_m - x_m, object.y_m - y_m))
            .collect();
        assert!(shifts.len() >= late.len(), "an object is missing");
        let mean = |sum: f64| sum / shifts.len() as f64;
        let dx_m = mean(shifts.iter().map(|shift| shift.0).sum());
        let dy_m = mean(shifts.iter().map(|shift| shift.1).sum());
        dx_m.hypot(dy_m)
    };
    places.into_iter().map(drag).fold(0.0, f64::max)
}

/// Its shift is estimated as its pose error, against the majority of the others.
#[test]
fn precise_shifted_vehicle_hardly_moves_map() {
    for has_pose in [false, true] {
        let honest_m = dragged_by(0.0, 0.3, has_pose);
        let dragged_m = [0.5, 1.0, 1.5].map(|shift_m| dragged_by(shift_m, 0.01, has_pose));
        println!(
            "{honest_m:.3} m if all are right, {dragged_m:.3?} m with one shifted by 0.5, 1.0 and 1.5 m, poses: {has_pose}"
        );
        assert!(honest_m < 0.03 && dragged_m.iter().all(|drag_m| *drag_m < 0.05));
    }
}

/// Share of the maps in which a car that one vehicle invents has a probability above 0.5, while four vehicles that have
/// its place in view report no car: at a landmark, and elsewhere.
#[test]
fn contradicted_invention_is_no_fact() {
    let place = Landmark {
        id: "slot-0".into(),
        position: Point2::new(20.0, 0.0),
        facing_rad: None,
        vacancy: None,
        synonyms: vec![],
    };
    let mut shares = Vec::new();
    for location in [Some(place), None] {
        let fusion = FusionConfig {
            tracks: TracksConfig {
                mode: TracksMode::On,
                ..TracksConfig::default()
            },
            ..FusionConfig::default()
        };
        let landmarks = location.clone().into_iter().collect();
        let mut cell = Aggregator::new(
            NodeName::from_static("edge"),
            1,
            fusion,
            landmarks,
            Timestamp(START),
        );
        let mut maps = 0;
        let mut accepted = 0;
        for frame in 1..=200 {
            let at = Timestamp(START + frame * 100_000);
            let mut fused = Vec::new();
            for (index, node) in ["ada", "euclid", "gauss", "noether"]
                .into_iter()
                .enumerate()
            {
                let looks = ObjectReport {
                    pose: Some(WirePose::new(0.0, index as f64 - 1.5, 0.0)),
                    view: Some(FieldOfView {
                        range_m: 60.0,
                        angle_rad: 2.0,
                    }),
                    seen: location.as_ref().map(|place| vec![place.id.clone()]),
                    ..report(
                        node,
                        frame,
                        at,
                        vec![PerceivedObject::new("car", 0.9, 30.0, 12.0)],
                    )
                };
                fused.extend(
                    cell.report(ReportKind::Detections, &Arc::new(looks), at)
                        .unwrap(),
                );
            }
            let mut invented = PerceivedObject::new("car", 0.99, 20.0, 0.0);
            invented.landmark = location.as_ref().map(|place| place.id.clone());
            let invents = report("mallory", frame, at, vec![invented]);
            fused.extend(
                cell.report(ReportKind::Detections, &Arc::new(invents), at)
                    .unwrap(),
            );
            fused.extend(cell.tick(at + Duration::from_millis(50)));
            for map in fused.into_iter().filter_map(|fused| fused.map) {
                maps += 1;
                let known = map
                    .landmarks
                    .iter()
                    .any(|place| place.label.is_some() && place.confidence > 0.5);
                let tracked = map.objects.iter().any(|object| {
                    (object.x_m - 20.0).hypot(object.y_m) < 3.0
                        && object.existence.unwrap_or(1.0) > 0.5
                });
                accepted += u32::from(known || tracked);
            }
        }
        shares.push(f64::from(accepted) / f64::from(maps));
    }
    println!("{shares:.3?} of the maps at a known location, and elsewhere");
    assert!(shares.iter().all(|share| *share < 0.05), "{shares:?}");
}
