//! Plausible growth of counts: votes are cast one after the other, and no lane leaps.

use std::collections::BTreeMap;

use crate::leadership::election::MAX_FIRST_TERM;
use crate::model::epoch::Epoch;
use crate::model::time::Timestamp;
use crate::reputation::{EntryKey, ReputationLedger};
use crate::wire::{LedgerEntry, LedgerMark, LedgerShare, Limits, Payload};

/// Maximum number of votes of a vehicle for one label in a leadership when this node first receives
/// the count: 100 million, which is three years at one vote per second.
pub(super) const MAX_FIRST_VOTES: u64 = 100_000_000;

/// Maximum number of votes of a vehicle for one label in a second, from then on: 1024 objects in
/// ten reports.
const MAX_VOTES_PER_S: u64 = 10_240;

/// Votes by which a count may be ahead of [`MAX_VOTES_PER_S`].
const ALLOWANCE: u64 = 1024;

/// Votes from one mark to the next.
const MARK_VOTES: u64 = 32;

/// True for saved evidence within the bounds of evidence that is received for the first time.
pub fn is_plausible(share: &LedgerShare) -> bool {
    let unknown = GrowthLimit::default();
    let never = Timestamp::default();
    let mut terms = share
        .entries
        .iter()
        .map(|entry| entry.epoch)
        .chain(share.marks.iter().map(|mark| mark.epoch));
    share.check(&Limits::default()).is_ok()
        && terms.all(|term| term <= MAX_FIRST_TERM)
        && share
            .entries
            .iter()
            .all(|entry| unknown.admits(entry, never))
        && share
            .marks
            .iter()
            .all(|mark| unknown.admits_mark(mark, never))
}

/// Number of votes of each count when this node first received it, with the time.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(super) struct GrowthLimit {
    /// Marks have no label.
    first: BTreeMap<EntryKey, (Timestamp, u64)>,
}

impl GrowthLimit {
    /// The limit of a node that starts with a ledger. Votes that it missed may arrive at the rate
    /// of the fastest votes, because no clock measures how long the node was down.
    pub(super) fn of(ledger: &ReputationLedger, now: Timestamp) -> Self {
        let mut limit = Self::default();
        ledger
            .entries()
            .for_each(|entry| limit.record_entry(&entry, now));
        ledger
            .marks()
            .for_each(|mark| limit.record_mark(&mark, ledger, now));
        limit
    }

    /// True if a count is plausible. [`Self::record`] records the first count of a vehicle and label.
    pub(super) fn admits(&self, entry: &LedgerEntry, now: Timestamp) -> bool {
        self.admits_votes(
            &key_of(entry),
            entry.correct.saturating_add(entry.incorrect),
            now,
        )
    }

    /// True if a mark is plausible.
    pub(super) fn admits_mark(&self, mark: &LedgerMark, now: Timestamp) -> bool {
        let votes = mark.correct.saturating_add(mark.incorrect);
        votes == mark.number.saturating_mul(MARK_VOTES)
            && self.admits_votes(&key_of_mark(mark), votes, now)
    }

    /// Records the counts of a share that the ledger has now.
    pub(super) fn record(
        &mut self,
        share: &LedgerShare,
        ledger: &ReputationLedger,
        now: Timestamp,
    ) {
        for entry in share
            .entries
            .iter()
            .filter(|entry| !ledger.lacks_entry(entry))
        {
            self.record_entry(entry, now);
        }
        for mark in share.marks.iter().filter(|mark| !ledger.lacks_mark(mark)) {
            self.record_mark(mark, ledger, now);
        }
    }

    fn record_entry(&mut self, entry: &LedgerEntry, now: Timestamp) {
        self.first
            .entry(key_of(entry))
            .or_insert((now, entry.correct.saturating_add(entry.incorrect)));
    }

    /// Records a mark with the counts of the ledger, because a recently received lane may have old
    /// marks.
    fn record_mark(&mut self, mark: &LedgerMark, ledger: &ReputationLedger, now: Timestamp) {
        let votes = mark
            .correct
            .saturating_add(mark.incorrect)
            .max(ledger.votes_of(mark));
        self.first.entry(key_of_mark(mark)).or_insert((now, votes));
    }

    /// Removes the lanes for which `is_known` is false.
    pub(super) fn retain(&mut self, is_known: impl Fn(&Epoch) -> bool) {
        self.first.retain(|key, _| is_known(&key.lane));
    }

    /// Number of counts that are noted.
    pub(super) fn len(&self) -> usize {
        self.first.len()
    }

    fn admits_votes(&self, key: &EntryKey, votes: u64, now: Timestamp) -> bool {
        let Some((at, first)) = self.first.get(key) else {
            return votes <= MAX_FIRST_VOTES;
        };
        votes <= first + ALLOWANCE + now.since(*at).as_millis() as u64 * MAX_VOTES_PER_S / 1000
    }
}

fn key_of(entry: &LedgerEntry) -> EntryKey {
    let lane = Epoch::new(entry.epoch, entry.aggregator.clone());
    EntryKey {
        lane,
        node: entry.node.clone(),
        label: entry.label.clone(),
    }
}

fn key_of_mark(mark: &LedgerMark) -> EntryKey {
    let lane = Epoch::new(mark.epoch, mark.aggregator.clone());
    EntryKey {
        lane,
        node: mark.node.clone(),
        label: Default::default(),
    }
}
