//! Instructions that the core's hot paths take, counted by Callgrind: the same on a busy machine as on a quiet one.

#![allow(missing_docs, reason = "the macros write items without")]

use std::hint::black_box;
use std::sync::Arc;

use ecod::leadership::election::{Election, ElectionEffect, ElectionInput};
use ecod::model::detection::Detection;
use ecod::model::geometry::Pose;
use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ecod::pace::Pace;
use ecod::perception::projection::{Cut, Projection};
use ecod::tracking::Tracker;
use ecod::vote::Vote;
use ecod::wire::{Encoding, Limits, ObjectReport, decode_report};
use ecod_instructions as workload;
use gungraun::{library_benchmark, library_benchmark_group, main};

#[library_benchmark]
#[bench::of_1000_boxes(workload::boxes())]
fn projection((projection, camera, detections): (Projection, Pose, Vec<Detection>)) -> Projection {
    for detection in &detections {
        black_box(
            projection
                .place(detection, Cut::default(), None, &camera)
                .ok(),
        );
    }
    projection
}

#[library_benchmark]
#[bench::of_1024_objects(workload::pace())]
fn pace_round((mut pace, reports, now): (Pace, Vec<ObjectReport>, Timestamp)) -> Pace {
    for report in &reports {
        pace.observe(report, now);
    }
    black_box(pace.close(now));
    pace
}

#[library_benchmark]
#[bench::of_1024_objects(workload::tracks())]
fn tracks_round(
    (mut tracker, reports, now): (Tracker, Vec<Arc<ObjectReport>>, Timestamp),
) -> Tracker {
    for report in reports {
        black_box(tracker.observe(report, now));
    }
    black_box(tracker.close(now));
    tracker
}

#[library_benchmark]
#[bench::of_1024_votes(workload::vote())]
fn vote_round((mut vote, reports, now): (Vote, Vec<ObjectReport>, Timestamp)) -> Vote {
    for report in &reports {
        black_box(vote.observe(report, now).ok());
    }
    black_box(vote.close(now));
    vote
}

#[library_benchmark]
#[bench::json(workload::payload(Encoding::Json))]
#[bench::cbor(workload::payload(Encoding::Cbor))]
#[bench::compact(workload::payload(Encoding::Compact))]
fn decode_32_objects((bytes, node): (Vec<u8>, NodeName)) -> Option<ObjectReport> {
    decode_report(&bytes, &node, &Limits::default()).ok()
}

#[library_benchmark]
#[bench::of_a_beat(workload::following())]
fn election_step(
    (mut election, beat, now): (Election, ElectionInput, Timestamp),
) -> (Election, Vec<ElectionEffect>) {
    let effects = election.handle(beat, now);
    (election, effects)
}

library_benchmark_group!(
    name = core,
    benchmarks = [
        projection,
        pace_round,
        tracks_round,
        vote_round,
        decode_32_objects,
        election_step
    ]
);
main!(library_benchmark_groups = core);
