//! `ecod-work NAME TIMES`: one of the workloads done once or, with 0, only prepared, for counters that take whole programs. A detector
//! prepares itself at its first picture: it is done once or twice.

#[cfg(feature = "detectors")]
mod detectors;

use std::hint::black_box;

use ecod::perception::projection::Cut;
use ecod::wire::{Encoding, Limits, decode_report};
use ecod_instructions::{self as workload, Boxes, Payload, Round};

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [name, times] = &arguments[..] else {
        panic!("usage: ecod-work NAME 0|1|2")
    };
    #[cfg(feature = "detectors")]
    if detectors::detect(name, times.parse().expect("a number of times")) {
        return;
    }
    let is_done = times != "0";
    match name.as_str() {
        "projection" => {
            let Boxes {
                projection,
                camera,
                detections,
            } = workload::boxes();
            for detection in detections.iter().filter(|_| is_done) {
                black_box(
                    projection
                        .place(detection, Cut::default(), None, &camera)
                        .ok(),
                );
            }
        }
        "pace_round" => {
            let Round {
                algorithm: mut pace,
                reports,
                now,
            } = workload::pace();
            if is_done {
                for report in &reports {
                    pace.observe(report, now);
                }
                black_box(pace.close(now));
            }
        }
        "vote_round" => {
            let Round {
                algorithm: mut vote,
                reports,
                now,
            } = workload::vote();
            if is_done {
                for report in &reports {
                    black_box(vote.observe(report, now).ok());
                }
                black_box(vote.close(now));
            }
        }
        "decode_compact" => {
            let Payload { bytes, node } = workload::payload(Encoding::Compact);
            if is_done {
                black_box(decode_report(&bytes, &node, &Limits::default()).ok());
            }
        }
        _ => panic!("no workload {name}: projection, pace_round, vote_round or decode_compact"),
    }
}
