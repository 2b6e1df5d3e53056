//! Shares of the ledger: the largest one fits, and each flaw has its reason.

use crate::model::names::NodeName;
use crate::model::time::Timestamp;
use crate::wire::{
    Encoding, LedgerEntry, LedgerShare, LedgerSignature, Limits, MAX_INTEGER, MAX_SHARE_ENTRIES,
    RejectReason, SCHEMA_VERSION, decode_share, encode,
};

fn share() -> LedgerShare {
    let name = |name: &str| NodeName::new(name).unwrap();
    let entry = LedgerEntry {
        epoch: 3,
        aggregator: name(&"a".repeat(64)),
        node: name(&"n".repeat(64)),
        label: "\"".repeat(64).into(),
        correct: MAX_INTEGER,
        incorrect: MAX_INTEGER,
    };
    LedgerShare {
        schema: SCHEMA_VERSION,
        node: name("edge"),
        epoch: Some(3),
        entries: vec![entry; MAX_SHARE_ENTRIES],
        marks: Vec::new(),
        signed: Some(LedgerSignature {
            certificate: "A".repeat(4096),
            signature: "A".repeat(96),
        }),
        reset_at_us: Some(Timestamp(MAX_INTEGER)),
    }
}

fn reason(share: &LedgerShare) -> Option<RejectReason> {
    let read = |encoding| {
        decode_share(
            &encode(share, encoding),
            &NodeName::from_static("edge"),
            &Limits::default(),
        )
    };
    assert_eq!(read(Encoding::Json), read(Encoding::Cbor));
    assert_eq!(read(Encoding::Json), read(Encoding::Compact));
    read(Encoding::Json).err()
}

#[test]
fn largest_share_fits_and_flaws_fail() {
    assert_eq!(reason(&share()), None);
    type Flaw = (fn(&mut LedgerShare), RejectReason);
    let flaws: [Flaw; 7] = [
        (|s| s.schema = 2, RejectReason::UnknownSchema),
        (
            |s| s.node = NodeName::from_static("gauss"),
            RejectReason::NodeMismatch,
        ),
        (|s| s.entries.truncate(1), RejectReason::TooManyObjects),
        (|s| s.entries[7].incorrect += 1, RejectReason::OutOfRange),
        (
            |s| s.entries[7].label = "".into(),
            RejectReason::InvalidLabel,
        ),
        (
            |s| s.reset_at_us = Some(Timestamp(MAX_INTEGER + 1)),
            RejectReason::OutOfRange,
        ),
        (
            |s| s.signed.as_mut().unwrap().certificate.push('A'),
            RejectReason::TooLarge,
        ),
    ];
    for (spoil, expected) in flaws {
        let mut share = share();
        if expected == RejectReason::TooManyObjects {
            share
                .entries
                .iter_mut()
                .for_each(|entry| entry.label = "cup".into());
            share.entries.push(share.entries[0].clone());
        } else {
            spoil(&mut share);
        }
        assert_eq!(reason(&share), Some(expected));
    }
}
