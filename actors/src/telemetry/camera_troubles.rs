//! The current troubles of one camera of a node.

use std::sync::Arc;

use ecod::diagnostics::TroubleKind;
use ecod::model::names::NodeName;

use crate::telemetry::counters::Counters;

/// The troubles of one camera: a vehicle's only one is the node itself, others are parts of it.
#[derive(Debug, Clone)]
pub struct CameraTroubles {
    counters: Arc<Counters>,
    part: Option<NodeName>,
}

impl CameraTroubles {
    /// The troubles of a camera that reports as a part, or as the node itself.
    pub fn new(counters: Arc<Counters>, part: Option<NodeName>) -> Self {
        Self { counters, part }
    }

    /// Records that a trouble of the camera was observed now, and its cause.
    pub fn record(&self, kind: TroubleKind, cause: &str) {
        match &self.part {
            Some(part) => self
                .counters
                .troubles()
                .record_about(part.as_str(), kind, cause),
            None => self.counters.troubles().record(kind, cause),
        }
    }

    /// Records that a trouble is over.
    pub fn settle(&self, kind: TroubleKind) {
        self.counters
            .troubles()
            .settle(kind, self.part.as_ref().map(NodeName::as_str));
    }
}
