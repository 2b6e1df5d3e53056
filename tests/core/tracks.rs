//! Tracking through the aggregator and the replay: what comes out of a cell for what its vehicles report.

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
    Encoding, GlobalMap, ObjectReport, PerceivedObject, RejectReason, ReportKind, encode,
};
use nalgebra::Point2;

const START: u64 = 1_732_154_400_000_000;

fn report(node: &str, frame: u64, at: Timestamp, objects: Vec<PerceivedObject>) -> ObjectReport {
    ObjectReport {
        objects,
        ..ObjectReport::new(NodeName::new(node).unwrap(), frame, at)
    }
}

/// A car that goes east at 8 m/s and one that stands, as two vehicles see them.
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
        FusedLine::Verdicts(verdicts) => panic!("nobody voted: {verdicts:?}"),
    };
    (output.into_iter().map(map).collect(), summary)
}

/// One map for every frame, at its time, with the cars where they are, whatever the phase of the rounds.
#[test]
fn a_recording_without_landmarks_is_tracked_frame_by_frame() {
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
fn a_vehicle_that_misses_frames_does_not_shift_the_others_maps() {
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
fn beside_known_locations_only_the_rest_is_tracked_and_only_if_asked_for() {
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
fn a_standby_leads_on_with_the_same_identities() {
    let open = || Aggregator::new_standby(FusionConfig::default(), Vec::new(), Timestamp(START));
    let (mut leader, mut standby) = (open(), open());
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

/// Detections of `euclid` in frames that were overtaken by the next are in the map too, once each; one that comes later than
/// the bound is not, and is counted.
#[test]
fn overtaken_reports_count_for_tracks_within_the_bound_and_not_for_known_locations() {
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
