//! A cell's aggregator receives sequences of valid reports, however contrary; what it publishes is valid.

#![no_main]

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use ecod::aggregator::round::FirstRound;
use ecod::aggregator::{Aggregator, Fused, FusionConfig};
use ecod::model::epoch::Epoch;
use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ecod::pace::PaceMode;
use ecod::perception::landmark::Landmark;
use ecod::tracking::TracksMode;
use ecod::vote::VoteMode;
use ecod::wire::{
    Encoding, FieldOfView, Limits, ObjectReport, Payload, PerceivedObject, ReportKind, WirePose,
    decode_entries, encode,
};
use libfuzzer_sys::arbitrary::{self, Arbitrary};
use libfuzzer_sys::fuzz_target;

#[derive(Debug, Arbitrary)]
struct Cell {
    paper: bool,
    tracks: bool,
    landmarks: u8,
    steps: Vec<Step>,
}

#[derive(Debug, Arbitrary)]
enum Step {
    Report {
        votes: bool,
        vehicle: u8,
        age_ms: i16,
        pose: Option<[i16; 3]>,
        view: Option<(u16, u8)>,
        objects: Vec<Object>,
        seen: Vec<u8>,
    },
    Wait {
        ms: u16,
    },
    StepDown,
    Lead,
}

#[derive(Debug, Arbitrary)]
struct Object {
    label: u8,
    confidence: u8,
    at: [i16; 2],
    spread: Option<(u16, u16, i8)>,
    landmark: Option<u8>,
    velocity: Option<[i8; 2]>,
    heading: Option<i8>,
    scores: Vec<(u8, u8)>,
    /// Ten to this power is the unit of lengths.
    scale: u8,
}

fuzz_target!(|cell: Cell| {
    let mut config = FusionConfig::default();
    if cell.paper {
        config.pace.mode = PaceMode::Paper;
        config.vote.mode = VoteMode::Paper;
    }
    config.tracks.mode = if cell.tracks {
        TracksMode::On
    } else {
        TracksMode::Off
    };
    let mut now = Timestamp(1_732_154_400_000_000);
    let landmarks = (0..cell.landmarks % 8).map(landmark).collect();
    let mut aggregator = Aggregator::new(NodeName::from_static("edge"), 1, config, landmarks, now);
    let mut epoch = 1;
    for (seq, step) in (1..).zip(cell.steps) {
        match step {
            Step::Report {
                votes,
                vehicle,
                age_ms,
                pose,
                view,
                objects,
                seen,
            } => {
                let report = ObjectReport {
                    pose: pose.map(|[x, y, heading]| {
                        WirePose::new(x.into(), y.into(), f64::from(heading) / 100.0)
                    }),
                    view: view.map(|(range, angle)| FieldOfView {
                        range_m: range.into(),
                        angle_rad: f64::from(angle) / 40.0,
                    }),
                    objects: objects.iter().map(object).collect(),
                    seen: Some(
                        seen.into_iter()
                            .map(|id| format!("l{}", id % 9).into())
                            .collect(),
                    ),
                    ..ObjectReport::new(
                        name(vehicle % 6),
                        seq,
                        now.shifted(-1000 * i64::from(age_ms)),
                    )
                };
                assert_valid(&report);
                let kind = if votes {
                    ReportKind::VoteDetections
                } else {
                    ReportKind::Detections
                };
                aggregator
                    .report(kind, &Arc::new(report), now)
                    .ok()
                    .flatten()
                    .iter()
                    .for_each(check);
            }
            Step::Wait { ms } => {
                now = now + Duration::from_millis(ms.into());
                aggregator.tick(now).iter().for_each(check);
            }
            Step::StepDown => aggregator.step_down(),
            Step::Lead => {
                epoch += 1;
                aggregator.lead(
                    Epoch::new(epoch, NodeName::from_static("edge")),
                    1,
                    FirstRound::OnTime,
                    now,
                );
            }
        }
    }
});

fn check(fused: &Fused) {
    fused.map.iter().for_each(assert_valid);
    fused.verdicts.iter().for_each(assert_valid);
}

/// Whether every node of the cell would take the payload, in every encoding.
fn assert_valid<T: Payload + std::fmt::Debug>(payload: &T) {
    for encoding in [Encoding::Json, Encoding::Cbor, Encoding::Compact] {
        match decode_entries::<T>(&encode(payload, encoding), &Limits::default()) {
            Ok((_, left_out)) => assert!(left_out.is_empty(), "{left_out:?}: {payload:?}"),
            Err(reason) => panic!("{reason}: {payload:?}"),
        }
    }
}

fn landmark(index: u8) -> Landmark {
    Landmark {
        id: format!("l{index}").into(),
        position: [f64::from(index) * 3.0, 0.0].into(),
        facing_rad: index.is_multiple_of(2).then_some(1.5),
        vacancy: None,
        synonyms: Vec::new(),
    }
}

fn object(object: &Object) -> PerceivedObject {
    let unit = 10f64.powi(i32::from(object.scale % 8) - 3);
    // Up to the bounds of the wire format.
    let [x_m, y_m] = object
        .at
        .map(|length| (f64::from(length) * unit).clamp(-1e8, 1e8));
    let spread = |(xx, yy, correlation): (u16, u16, i8)| {
        let xx = f64::from(xx) * unit * unit;
        let yy = f64::from(yy) * unit * unit;
        [xx, f64::from(correlation) / 128.0 * (xx * yy).sqrt(), yy]
    };
    let scores: BTreeMap<_, _> = object
        .scores
        .iter()
        .map(|&(l, score)| (label(l), f64::from(score) / 255.0))
        .collect();
    PerceivedObject {
        covariance_m2: object.spread.map(spread),
        landmark: object.landmark.map(|id| format!("l{}", id % 9).into()),
        velocity_mps: object.velocity.map(|velocity| velocity.map(f64::from)),
        heading_rad: object.heading.map(|heading| f64::from(heading) / 20.0),
        size_m: None,
        scores,
        ..PerceivedObject::new(
            label(object.label),
            f64::from(object.confidence) / 255.0,
            x_m,
            y_m,
        )
    }
}

fn label(index: u8) -> ecod::model::names::Label {
    ["car", "truck", "cup", "EMPTY", "ABCD123"][usize::from(index % 5)].into()
}

fn name(vehicle: u8) -> NodeName {
    NodeName::new(format!("v{vehicle}")).expect("a valid name")
}
