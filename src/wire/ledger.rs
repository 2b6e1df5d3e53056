//! Bounds of the shares in which evidence is replicated.

use super::{LedgerShare, Limits, RejectReason, decode};
use crate::names::NodeName;

/// Most counts in one share: it stays below the default of [`Limits::payload_bytes`].
pub const MAX_SHARE_ENTRIES: usize = 512;

/// Reads a share and checks every value in it; `topic_node` is the node named by its topic.
///
/// # Errors
/// The first reason found; see [`RejectReason`].
pub fn decode_share(bytes: &[u8], topic_node: &NodeName, limits: &Limits) -> Result<LedgerShare, RejectReason> {
    let share: LedgerShare = decode(bytes, limits)?;
    if share.node != *topic_node {
        return Err(RejectReason::NodeMismatch);
    }
    Ok(share)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::wire::{Encoding, LedgerEntry, MAX_INTEGER, SCHEMA_VERSION, encode};

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
        }
    }

    fn reason(share: &LedgerShare) -> Option<RejectReason> {
        let read =
            |encoding| decode_share(&encode(share, encoding), &NodeName::from_static("edge"), &Limits::default());
        assert_eq!(read(Encoding::Json), read(Encoding::Cbor));
        assert_eq!(read(Encoding::Json), read(Encoding::Compact));
        read(Encoding::Json).err()
    }

    #[test]
    fn the_largest_share_fits_and_each_flaw_has_its_reason() {
        assert_eq!(reason(&share()), None);
        type Flaw = (fn(&mut LedgerShare), RejectReason);
        let flaws: [Flaw; 5] = [
            (|s| s.schema = 2, RejectReason::UnknownSchema),
            (|s| s.node = NodeName::from_static("gauss"), RejectReason::NodeMismatch),
            (|s| s.entries.truncate(1), RejectReason::TooManyObjects),
            (|s| s.entries[7].incorrect += 1, RejectReason::OutOfRange),
            (|s| s.entries[7].label = "".into(), RejectReason::InvalidLabel),
        ];
        for (spoil, expected) in flaws {
            let mut share = share();
            if expected == RejectReason::TooManyObjects {
                share.entries.iter_mut().for_each(|entry| entry.label = "cup".into());
                share.entries.push(share.entries[0].clone());
            } else {
                spoil(&mut share);
            }
            assert_eq!(reason(&share), Some(expected));
        }
    }
}
