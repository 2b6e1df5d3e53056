//! The gate of one topic: what was superseded does not pass, but nobody is shut out for good.

use std::time::Duration;

use ecod::epoch::{Epoch, EpochGate};
use ecod::time::Timestamp;

/// How long the newest message outranks others after it came: one from a stranger with a huge epoch silences the elected
/// leader, or where there is no election whoever publishes, for no longer than this.
pub(super) const MEMORY: Duration = Duration::from_secs(3);

/// Why a message did not pass.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Refusal {
    /// It or a later one of the same leadership has passed: the same message came another way.
    Repeated,
    /// A later leadership's have passed.
    Superseded,
}

/// Admits messages in the order of epoch, aggregator and round.
#[derive(Debug)]
pub(super) struct Gate {
    gate: EpochGate,
    newest_at: Option<Timestamp>,
}

impl Gate {
    /// A gate that refuses terms below `least_term` at first.
    pub(super) fn new(least_term: u64) -> Self {
        Self { gate: EpochGate::new(least_term), newest_at: None }
    }

    /// Takes round `round` of `epoch`, or refuses it. `may_lead` says that nobody else is known to lead.
    pub(super) fn admit(
        &mut self,
        epoch: &Epoch,
        round: u64,
        received_at: Timestamp,
        may_lead: bool,
    ) -> Result<(), Refusal> {
        let quiet = self.newest_at.is_some_and(|newest_at| received_at.since(newest_at) >= MEMORY);
        let mut admitted = self.gate.admit(epoch, round);
        if admitted.is_err() && quiet && may_lead {
            self.gate = EpochGate::default();
            admitted = self.gate.admit(epoch, round);
        }
        admitted.map_err(|_| match self.gate.latest() {
            Some((latest, _)) if latest == epoch => Refusal::Repeated,
            _ => Refusal::Superseded,
        })?;
        self.newest_at = Some(received_at);
        Ok(())
    }
}
