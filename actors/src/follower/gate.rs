//! The gate of one topic: what was superseded does not pass, but nobody is shut out for good.

use std::time::Duration;

use ecod::epoch::{Epoch, EpochGate};
use ecod::time::Timestamp;
use ecod::wire::RejectReason;

/// How long the newest message outranks others after it came: an aggregator that starts anew with a clock set back, or
/// a message from a stranger with a huge epoch, silences the rest for no longer than this.
pub(super) const MEMORY: Duration = Duration::from_secs(3);

/// Admits messages in the order of epoch, aggregator and round.
#[derive(Debug, Default)]
pub(super) struct Gate {
    gate: EpochGate,
    newest_at: Option<Timestamp>,
}

impl Gate {
    /// Takes round `round` of `epoch`, or refuses it as superseded.
    pub(super) fn admit(&mut self, epoch: &Epoch, round: u64, received_at: Timestamp) -> Result<(), RejectReason> {
        if self.newest_at.is_some_and(|newest_at| received_at.since(newest_at) >= MEMORY) {
            self.gate = EpochGate::default();
        }
        self.gate.admit(epoch, round)?;
        self.newest_at = Some(received_at);
        Ok(())
    }
}
