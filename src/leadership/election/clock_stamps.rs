//! Stamps that election messages carry, for [`crate::leadership::cell_time`].

use minicbor::{Decode, Encode};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::model::time::Timestamp;
use crate::wire::MAX_INTEGER;

/// Stamps of one message, for the comparison of two clocks (RFC 5905, section 8).
#[derive(
    Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize, Encode, Decode, JsonSchema,
)]
pub struct ClockStamps {
    /// Time of sending, by the sender's steady clock.
    #[n(0)]
    pub sent_us: Timestamp,
    /// Stamps of the addressee's last message, if the sender received one recently.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[n(1)]
    pub answers: Option<AnsweredStamps>,
    /// Time of sending, by the sender's wall clock; absent if that clock was never set.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[n(2)]
    pub wall_us: Option<Timestamp>,
    /// Time of sending, by the sender's estimate of the cell's time.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[n(3)]
    pub cell_us: Option<Timestamp>,
}

/// Stamps of an earlier message in the other direction.
#[derive(
    Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize, Encode, Decode, JsonSchema,
)]
pub struct AnsweredStamps {
    /// Time at which that message was sent, by its sender's steady clock.
    #[n(0)]
    pub sent_us: Timestamp,
    /// Time at which it was received, by its receiver's steady clock.
    #[n(1)]
    pub received_us: Timestamp,
}

impl ClockStamps {
    /// True if all stamps are integers that a node sends.
    pub(super) fn is_plausible(&self) -> bool {
        let answered = self
            .answers
            .map(|answered| [answered.sent_us, answered.received_us]);
        let stamps = [Some(self.sent_us), self.wall_us, self.cell_us]
            .into_iter()
            .flatten();
        stamps
            .chain(answered.into_iter().flatten())
            .all(|stamp| stamp.micros() <= MAX_INTEGER)
    }
}
