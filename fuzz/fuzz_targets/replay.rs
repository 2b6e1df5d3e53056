//! Lines of a recording, through the whole aggregator; equal inputs give equal outputs.

#![no_main]

use ecod::replay::{FusedLine, Replay, ReplayConfig, Summary};
use libfuzzer_sys::fuzz_target;

fuzz_target!(|text: &[u8]| {
    let (lines, summary) = replay(text);
    assert!(summary.used() <= summary.lines);
    assert_eq!((lines, summary), replay(text));
});

fn replay(text: &[u8]) -> (Vec<FusedLine>, Summary) {
    let mut replay = Replay::new(ReplayConfig::default());
    let mut fused: Vec<_> = text
        .split(|byte| *byte == b'\n')
        .flat_map(|line| replay.line(line))
        .collect();
    let (last, summary) = replay.finish();
    fused.extend(last);
    (fused, summary)
}
