//! Shares of the ledger: the evidence behind the reputations.

use minicbor::{Decode, Encode};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::compact::{Form, Text};
use crate::model::epoch::Epoch;
use crate::model::names::{Label, NodeName};
use crate::model::time::Timestamp;

/// A part of the evidence for reputations; receivers keep the larger of every count.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, Encode, Decode, JsonSchema)]
pub struct LedgerShare {
    /// Major version of the payload, as of every payload.
    #[n(0)]
    pub schema: u32,
    /// The sender; equals the last level of the topic.
    #[n(1)]
    pub node: NodeName,
    /// Term in which the sender's leadership began, even after it renewed its term; absent when it
    /// does not lead.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[n(2)]
    pub epoch: Option<u64>,
    /// Counts, at most 512.
    #[n(3)]
    pub entries: Vec<LedgerEntry>,
    /// Marks, at most 512. Without marks a receiver cannot determine which votes are recent.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    #[cbor(n(4), default)]
    pub marks: Vec<LedgerMark>,
    /// Signature of the aggregator that counted, in cells with certificates; all counts and marks
    /// must then be this aggregator's own, from one leadership.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[n(5)]
    pub signed: Option<LedgerSignature>,
    /// Time of the last reset of the cell's evidence, in cells without certificates; absent without
    /// a reset. Earlier evidence is invalid.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[n(6)]
    pub reset_at_us: Option<Timestamp>,
}

impl LedgerShare {
    /// The bytes that an aggregator signs: the compact encoding of
    /// `["ecod ledger 1", cell, entries, marks]`. Sender and term are not included, so that other
    /// nodes can pass the counts on.
    #[expect(clippy::expect_used, reason = "writing to memory does not fail")]
    pub fn signed_bytes(&self, cell: &NodeName) -> Vec<u8> {
        let content = ("ecod ledger 1", cell, &self.entries, &self.marks);
        minicbor::to_vec(content).expect("shares are written into memory")
    }

    /// The leadership to which these counts belong. `None` without counts and marks, and for counts
    /// of several leaderships.
    pub fn lane(&self) -> Option<Epoch> {
        let entries = self
            .entries
            .iter()
            .map(|entry| (entry.epoch, &entry.aggregator));
        let mut lanes = entries.chain(self.marks.iter().map(|mark| (mark.epoch, &mark.aggregator)));
        let (term, aggregator) = lanes.next()?;
        lanes
            .all(|lane| lane == (term, aggregator))
            .then(|| Epoch::new(term, aggregator.clone()))
    }

    /// True if there are no counts and no marks.
    pub fn is_empty(&self) -> bool {
        self.entries.is_empty() && self.marks.is_empty()
    }
}

/// Signature on the counts of one leadership, and the certificate to verify it.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, Encode, Decode, JsonSchema)]
pub struct LedgerSignature {
    /// The aggregator's X.509 certificate in DER, as base64.
    #[n(0)]
    pub certificate: String,
    /// ECDSA signature (P-256, SHA-256) in DER of the cell's name, the counts and the marks, as
    /// base64.
    #[n(1)]
    pub signature: String,
}

/// The numbers of right and wrong votes of one vehicle for one label under one leadership.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, Encode, Decode, JsonSchema)]
pub struct LedgerEntry {
    /// Term of the leadership that counted.
    #[n(0)]
    pub epoch: u64,
    /// Its aggregator.
    #[n(1)]
    pub aggregator: NodeName,
    /// The vehicle.
    #[n(2)]
    pub node: NodeName,
    /// The label that it stated.
    #[cbor(n(3), with = "Text")]
    pub label: Label,
    /// Number of votes that agreed with the verdict, since the leadership began.
    #[n(4)]
    pub correct: u64,
    /// Number of votes that disagreed with the verdict.
    #[n(5)]
    pub incorrect: u64,
}

/// Snapshot of one vehicle's counts, taken when the number of its votes under this leadership
/// reached a multiple of 32. A snapshot is not changed later.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, Encode, Decode, JsonSchema)]
pub struct LedgerMark {
    /// Term of the leadership that counted.
    #[n(0)]
    pub epoch: u64,
    /// Its aggregator.
    #[n(1)]
    pub aggregator: NodeName,
    /// The vehicle.
    #[n(2)]
    pub node: NodeName,
    /// The vehicle's number of votes at that time, divided by 32.
    #[n(3)]
    pub number: u64,
    /// Number of votes that agreed with the verdict.
    #[n(4)]
    pub correct: u64,
    /// Number of votes that did not agree with the verdict.
    #[n(5)]
    pub incorrect: u64,
}
