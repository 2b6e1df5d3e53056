//! CLEAR MOT (Bernardin and Stiefelhagen, EURASIP J. Image and Video Processing 2008) and the
//! detection accuracy and precision that go with it (Kasturi et al., IEEE TPAMI 2009).
//!
//! In every frame, pairs that matched in the previous frame and are still near enough match again;
//! the others match so that the sum of their similarities is greatest. If a true object matches
//! another identity than in its last match, this is a switch. If it matches again after frames
//! without a match, this is a fragment. Equal to `trackeval.metrics.CLEAR` at a threshold of 0.5,
//! including for frames without reported objects, which do not end a pair.

use hashbrown::HashMap;

use super::matching::{MatchedPair, best, near_pairs};
use super::{MATCH_DISTANCE_M, ScoredFrame, ZERO_DISTANCE_M};

/// Counts of a whole sequence.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(super) struct Clear {
    pub(super) matches: u64,
    pub(super) false_alarms: u64,
    pub(super) misses: u64,
    pub(super) id_switches: u64,
    pub(super) fragments: u64,
    pub(super) distance_sum_m: f64,
}

/// Bonus of a continued pair, in addition to its similarity of at most 1: more than the sum of all
/// others in a frame.
const GOES_ON: f64 = 1000.0;

pub(super) fn judge(frames: &[ScoredFrame]) -> Clear {
    let mut clear = Clear::default();
    // By true identity the identity it matched in the frame before, and at last.
    let (mut before, mut last): (HashMap<u32, u32>, HashMap<u32, u32>) = Default::default();
    for frame in frames {
        let ids = |pair: &MatchedPair| (frame.truth[pair.truth].id, frame.said[pair.said].id);
        let mut pairs = near_pairs(frame, MATCH_DISTANCE_M);
        for pair in &mut pairs {
            let (truth, said) = ids(pair);
            let goes_on = before.get(&truth) == Some(&said);
            pair.value = 1.0 - pair.value / ZERO_DISTANCE_M + if goes_on { GOES_ON } else { 0.0 };
        }
        let matched = best(&pairs);
        clear.matches += matched.len() as u64;
        clear.false_alarms += (frame.said.len() - matched.len()) as u64;
        clear.misses += (frame.truth.len() - matched.len()) as u64;
        if frame.said.is_empty() || frame.truth.is_empty() {
            continue;
        }
        let followed = std::mem::take(&mut before);
        for pair in &matched {
            let (truth, said) = ids(pair);
            before.insert(truth, said);
            let earlier = last.insert(truth, said);
            clear.id_switches += u64::from(earlier.is_some_and(|earlier| earlier != said));
            clear.fragments += u64::from(earlier.is_some() && !followed.contains_key(&truth));
            clear.distance_sum_m +=
                (frame.truth[pair.truth].position - frame.said[pair.said].position).norm();
        }
    }
    clear
}
