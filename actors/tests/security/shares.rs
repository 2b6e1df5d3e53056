//! Forged evidence about vehicles.

use ecod::model::names::NodeName;
use ecod::wire::{LedgerEntry, LedgerShare, SCHEMA_VERSION};

/// Plausible number of votes of one vehicle: only the way of the evidence gives it away.
const VOTES: u64 = 50_000;

/// A node's share in which the malicious vehicle is always right and the honest vehicle always wrong.
pub(crate) fn inverted(sender: &str, epoch: u64, aggregator: &str) -> LedgerShare {
    let name = |name: &str| NodeName::new(name).unwrap();
    let entry = |node: &str, correct, incorrect| {
        let aggregator = name(aggregator);
        let node = name(node);
        let label = "cup".into();
        LedgerEntry {
            epoch,
            aggregator,
            node,
            label,
            correct,
            incorrect,
        }
    };
    LedgerShare {
        schema: SCHEMA_VERSION,
        node: name(sender),
        epoch: None,
        entries: vec![entry("honest", 0, VOTES), entry("liar", VOTES, 0)],
        marks: Vec::new(),
        signed: None,
        reset_at_us: None,
    }
}
