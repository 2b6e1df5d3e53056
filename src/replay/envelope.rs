//! The fields of a recorded line that are not part of its report.

use serde::Deserialize;

use crate::model::time::Timestamp;

/// The optional fields of a line that are not part of its report.
#[derive(Debug, Deserialize)]
pub(super) struct Envelope {
    #[serde(default)]
    pub(super) topic: Option<String>,
    #[serde(default)]
    pub(super) received_at_us: Option<Timestamp>,
}
