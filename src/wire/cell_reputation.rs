//! Messages that cells send to each other about vehicles.

use minicbor::{Decode, Encode};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::compact::{Form, Half};
use crate::model::names::NodeName;
use crate::model::time::Timestamp;

/// A cell's own evidence about one vehicle, for other cells. Receivers keep the larger of every
/// count.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, Encode, Decode, JsonSchema)]
pub struct CellReputation {
    /// Major version of the payload, [`super::SCHEMA_VERSION`].
    #[n(0)]
    pub schema: u32,
    /// The cell that counted; equals the last level of the topic.
    #[n(1)]
    pub cell: NodeName,
    /// The vehicle; equals the second-last level of the topic.
    #[n(2)]
    pub vehicle: NodeName,
    /// Number of votes in all leaderships that agreed with the verdict.
    #[n(3)]
    pub correct: u64,
    /// Number of votes that disagreed.
    #[n(4)]
    pub incorrect: u64,
    /// Number of the votes that agreed and that the cell has already dropped.
    #[n(5)]
    pub old_correct: u64,
    /// Number of such votes that disagreed.
    #[n(6)]
    pub old_incorrect: u64,
    /// Time of the last reset of the cell's evidence; absent without a reset. Earlier counts are
    /// invalid.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[n(7)]
    pub reset_at_us: Option<Timestamp>,
}

/// Votes of other cells about a vehicle with their weight in this cell. They are not whole numbers.
#[derive(
    Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize, Encode, Decode, JsonSchema,
)]
pub struct ForeignVotes {
    /// Votes that agreed with the verdict.
    #[cbor(n(0), with = "Half")]
    pub correct: f64,
    /// Votes that did not.
    #[cbor(n(1), with = "Half")]
    pub incorrect: f64,
}

impl ForeignVotes {
    /// All votes.
    pub fn total(self) -> f64 {
        self.correct + self.incorrect
    }
}
