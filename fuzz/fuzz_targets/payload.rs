//! Every payload in every encoding. What is taken can be sent on: it is taken again, unchanged where nothing is
//! rounded.
//!
//! The first byte of an input chooses the payload, the rest is what came from the network.

#![no_main]

use std::fmt::Debug;

use ecod::leadership::election::ElectionMessage;
use ecod::wire::{
    CellDescription, Encoding, GlobalMap, LedgerShare, Limits, NodeStatus, ObjectReport, Payload,
    Reputations, Verdicts, decode, encode,
};
use libfuzzer_sys::fuzz_target;

fuzz_target!(|input: &[u8]| {
    let Some((kind, bytes)) = input.split_first() else {
        return;
    };
    match kind % 8 {
        0 => take::<ObjectReport>(bytes),
        1 => take::<GlobalMap>(bytes),
        2 => take::<Verdicts>(bytes),
        3 => take::<Reputations>(bytes),
        4 => take::<LedgerShare>(bytes),
        5 => take::<NodeStatus>(bytes),
        6 => drop(ElectionMessage::decode(bytes)),
        _ => take::<CellDescription>(bytes),
    }
});

fn take<T: Payload + PartialEq + Debug>(bytes: &[u8]) {
    let limits = Limits {
        payload_bytes: 1 << 20,
        ..Limits::default()
    };
    let Ok(payload) = decode::<T>(bytes, &limits) else {
        return;
    };
    for encoding in [Encoding::Json, Encoding::Cbor] {
        assert_eq!(
            decode::<T>(&encode(&payload, encoding), &limits).as_ref(),
            Ok(&payload),
            "{encoding:?}"
        );
    }
    let compact = encode(&payload, Encoding::Compact);
    let rounded =
        decode::<T>(&compact, &limits).unwrap_or_else(|reason| panic!("{payload:?}: {reason}"));
    assert_eq!(
        encode(&rounded, Encoding::Compact),
        compact,
        "rounding twice is rounding once"
    );
}
