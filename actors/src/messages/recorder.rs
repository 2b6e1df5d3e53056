//! Messages to the actor of this name.

/// What the recorder is asked to do.
#[derive(Debug)]
pub enum RecorderMessage {
    /// Record who leads now.
    NoteLeadership,
    /// Record the counters, and look after the writer.
    Tick,
}
