//! Instructions that the core's hot paths take, counted by Callgrind: the same on a busy machine as on a quiet one.

#![allow(missing_docs, reason = "the macros write items without")]

use std::hint::black_box;
use std::sync::Arc;

use ecod::leadership::election::{Election, ElectionEffect};
use ecod::pace::Pace;
use ecod::perception::projection::{Cut, Projection};
use ecod::tracking::Tracker;
use ecod::vote::Vote;
use ecod::wire::{Encoding, Limits, ObjectReport, decode_report};
use ecod_instructions::{self as workload, Boxes, Following, Payload, Round};
use gungraun::{library_benchmark, library_benchmark_group, main};

#[library_benchmark]
#[bench::of_1000_boxes(workload::boxes())]
fn projection(boxes: Boxes) -> Projection {
    let projection = boxes.projection;
    for detection in &boxes.detections {
        black_box(
            projection
                .place(detection, Cut::default(), None, &boxes.camera)
                .ok(),
        );
    }
    projection
}

#[library_benchmark]
#[bench::of_1024_objects(workload::pace())]
fn pace_round(round: Round<Pace, ObjectReport>) -> Pace {
    let mut pace = round.algorithm;
    for report in &round.reports {
        pace.observe(report, round.now);
    }
    black_box(pace.close(round.now));
    pace
}

#[library_benchmark]
#[bench::of_1024_objects(workload::tracks())]
fn tracks_round(round: Round<Tracker, Arc<ObjectReport>>) -> Tracker {
    let mut tracker = round.algorithm;
    for report in round.reports {
        black_box(tracker.observe(report, round.now));
    }
    black_box(tracker.close(round.now));
    tracker
}

#[library_benchmark]
#[bench::of_1024_votes(workload::vote())]
fn vote_round(round: Round<Vote, ObjectReport>) -> Vote {
    let mut vote = round.algorithm;
    for report in &round.reports {
        black_box(vote.observe(report, round.now).ok());
    }
    black_box(vote.close(round.now));
    vote
}

#[library_benchmark]
#[bench::json(workload::payload(Encoding::Json))]
#[bench::cbor(workload::payload(Encoding::Cbor))]
#[bench::compact(workload::payload(Encoding::Compact))]
fn decode_32_objects(payload: Payload) -> Option<ObjectReport> {
    let Payload { bytes, node } = payload;
    decode_report(&bytes, &node, &Limits::default()).ok()
}

#[library_benchmark]
#[bench::of_a_beat(workload::following())]
fn election_step(following: Following) -> (Election, Vec<ElectionEffect>) {
    let mut election = following.election;
    let effects = election.handle(following.beat, following.now);
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
