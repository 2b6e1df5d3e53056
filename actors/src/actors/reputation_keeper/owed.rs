//! What a follower has yet to tell its leader of what it knows.

use std::time::Duration;

use ecod::epoch::Epoch;
use ecod::reputation::ReputationLedger;
use ecod::time::Timestamp;
use ecod::wire::{LedgerEntry, LedgerMark};

/// Least time between two times that everything is sent to a leader that is new: leaders may come and go fast, or only
/// seem to.
const ALL_PAUSE: Duration = Duration::from_secs(5);

/// How often what a leader was not told is sent, in case that it was lost.
const REPEATS: u32 = 3;

/// Whoever has led tells a leader all at once when it first hears of it. Anyone else listens to what is shared for
/// longer than leaders take to share all they know, and sends what was not among it, each candidate at a time of its
/// own: what a leader learnt that is gone, for one.
#[derive(Debug, Default)]
pub(super) struct Owed {
    leader: Option<Epoch>,
    everything: bool,
    everything_sent: Option<Timestamp>,
    /// What was shared since the leader was first heard.
    shared: ReputationLedger,
    /// Ticks until what was not shared is sent.
    wait: u32,
    repeats: u32,
}

impl Owed {
    /// Notes whose share came; true if it leads and is heard for the first time.
    pub(super) fn is_first_of(&mut self, leader: Option<Epoch>, wait: u32) -> bool {
        let is_first = leader.is_some() && leader != self.leader;
        if is_first {
            (self.leader, self.shared) = (leader, ReputationLedger::default());
            (self.wait, self.repeats) = (wait.max(1), REPEATS);
        }
        is_first
    }

    /// The leader is to have everything.
    pub(super) fn owe_everything(&mut self, everything: bool) {
        self.everything = everything;
    }

    /// Whether to send everything now.
    pub(super) fn takes_everything(&mut self, now: Timestamp) -> bool {
        let due = self.everything && self.everything_sent.is_none_or(|at| now.since(at) >= ALL_PAUSE);
        if due {
            (self.everything, self.everything_sent) = (false, Some(now));
        }
        due
    }

    /// Notes what was shared with all candidates.
    pub(super) fn note(&mut self, entries: &[LedgerEntry], marks: &[LedgerMark]) {
        if self.repeats > 0 {
            self.shared.merge_entries(entries.iter().cloned(), self.leader.as_ref());
            self.shared.merge_marks(marks.iter().cloned(), self.leader.as_ref());
        }
    }

    /// To be called regularly while following; now and then returns what has been shared since the leader was first heard.
    pub(super) fn tick(&mut self, period: u32) -> Option<&ReputationLedger> {
        if self.repeats == 0 {
            self.shared = ReputationLedger::default();
            return None;
        }
        self.wait -= 1;
        if self.wait > 0 {
            return None;
        }
        (self.wait, self.repeats) = (period.max(1), self.repeats - 1);
        Some(&self.shared)
    }
}
