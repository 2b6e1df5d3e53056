//! Messages to the recorder.

/// Requests to the recorder.
#[derive(Debug)]
pub enum RecorderMessage {
    /// Record the current leadership.
    RecordLeadership,
    /// Record the counters, and check that the writer runs.
    Tick,
}
