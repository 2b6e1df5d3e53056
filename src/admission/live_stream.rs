//! Proof that a stream is live: its stamps advance as fast as its messages arrive.

use std::time::Duration;

use crate::model::time::Timestamp;

/// Candidate for the clock of a sender whose stamps contradict the current estimate.
///
/// Messages that waited in a queue arrive faster than they were made. A stream that keeps its delay
/// for a second is live, even if its clock is wrong.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct LiveStream {
    since: Timestamp,
    first_us: i64,
    least_us: i64,
    messages: u32,
    last_stamp: Timestamp,
}

impl LiveStream {
    /// Processes the next message. Returns the least delay in microseconds once the stream in
    /// `candidate` is live. A delay that changed by more than `tolerance_us` starts a new
    /// candidate.
    pub fn observe(
        candidate: &mut Option<Self>,
        stamp: Timestamp,
        received_at: Timestamp,
        tolerance_us: i64,
    ) -> Option<i64> {
        let delay_us = received_at.micros_from(stamp);
        match candidate {
            // A duplicate carries no information.
            Some(stream) if stream.last_stamp == stamp => return None,
            Some(stream)
                if stamp > stream.last_stamp
                    && delay_us.saturating_sub(stream.first_us).saturating_abs()
                        <= tolerance_us =>
            {
                stream.least_us = stream.least_us.min(delay_us);
                stream.messages += 1;
                stream.last_stamp = stamp;
                let is_live =
                    stream.messages >= MIN_MESSAGES && received_at.since(stream.since) >= MIN_TIME;
                return is_live.then_some(stream.least_us);
            }
            _ => {}
        }
        *candidate = Some(Self {
            since: received_at,
            first_us: delay_us,
            least_us: delay_us,
            messages: 1,
            last_stamp: stamp,
        });
        None
    }
}

/// Time for which the delay must stay the same.
const MIN_TIME: Duration = Duration::from_secs(1);

/// Number of messages in this time.
const MIN_MESSAGES: u32 = 3;
