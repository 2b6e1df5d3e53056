//! Replication of the evidence about vehicles between the candidates of a cell.
//!
//! - The leader records in the lane of its own epoch. What changed it shares after the round, and everything in every
//!   snapshot period. Receivers keep the larger count, so that shares may come late, twice, or in any order.
//! - A node that has led sends a leader all it knows when it first hears it. Every other candidate listens for longer than
//!   leaders take to share all they know, and then sends what nobody has shared, each at a time of its own. So evidence of
//!   leaders that are gone is kept, too, when a split heals.
//! - Evidence is accepted of candidates, and of terms that the election knows.
//!
//! Nothing is sent here: methods return the shares to publish. Time is counted in ticks of the publication period.

use std::collections::BTreeSet;

use crate::leadership::timers::FULL_RESYNC_PAUSE;
use crate::leadership::view::Leadership;
use crate::model::epoch::Epoch;
use crate::model::names::NodeName;
use crate::model::time::Timestamp;
use crate::reputation::{EntryKey, Evidence, ReputationLedger};
use crate::wire::{LedgerEntry, LedgerMark, LedgerShare, MAX_SHARE_ENTRIES, RejectReason, SCHEMA_VERSION};

/// Number of times that a leader is sent what it was not told, in case it was lost.
const REPEATS: u32 = 3;

/// One node's part in the replication of evidence.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LedgerResync {
    name: NodeName,
    ticks_per_snapshot: u32,
    /// The node's own leadership, while it leads.
    leads: Option<Epoch>,
    has_led: bool,
    /// Ticks since the last snapshot.
    ticks: u32,
    /// The leader that was heard last.
    leader: Option<Epoch>,
    /// Whether it is to have everything.
    owes_everything: bool,
    everything_sent_at: Option<Timestamp>,
    /// Evidence shared since it was first heard.
    shared: ReputationLedger,
    /// Ticks until what was not shared is sent to it.
    wait: u32,
    /// Number of times that this will still happen.
    repeats: u32,
}

/// Outcome of a share that was merged.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Merged {
    /// Whether the ledger changed.
    pub is_news: bool,
    /// Whether entries of terms that the election does not know were left out.
    pub has_unknown_terms: bool,
    /// Shares to publish.
    pub shares: Vec<LedgerShare>,
}

impl LedgerResync {
    /// The part of the node of this name; everything is shared each `ticks_per_snapshot` calls of [`Self::tick`].
    pub fn new(name: NodeName, ticks_per_snapshot: u32) -> Self {
        Self {
            name,
            ticks_per_snapshot,
            leads: None,
            has_led: false,
            ticks: 0,
            leader: None,
            owes_everything: false,
            everything_sent_at: None,
            shared: ReputationLedger::default(),
            wait: 0,
            repeats: 0,
        }
    }

    /// The node's own leadership, while it leads.
    pub fn leads(&self) -> Option<&Epoch> {
        self.leads.as_ref()
    }

    /// Begins a leadership of this node. Share [`Self::snapshot`] next.
    pub fn lead(&mut self, epoch: Epoch) {
        self.leads = Some(epoch);
        self.has_led = true;
    }

    /// Ends the leadership of this node.
    pub fn step_down(&mut self) {
        self.leads = None;
    }

    /// Records what a round of the node's own leadership says about vehicles.
    pub fn record(&mut self, epoch: &Epoch, evidence: &[Evidence], ledger: &mut ReputationLedger) -> Vec<LedgerShare> {
        let key = |evidence: &Evidence| {
            let Evidence { node, label, .. } = evidence.clone();
            EntryKey { lane: epoch.clone(), node, label }
        };
        let keys: BTreeSet<_> = evidence.iter().map(key).collect();
        for evidence in evidence {
            ledger.record(epoch.term, &epoch.leader, evidence);
        }
        let changed = ledger.entries_of(&keys);
        let reached = ledger.marks_reached(epoch.term, &epoch.leader, evidence);
        self.leads = Some(epoch.clone());
        self.shares(&changed, &reached)
    }

    /// Takes in another candidate's share. `candidates` are the other nodes that may lead.
    ///
    /// # Errors
    /// [`RejectReason::NotCandidate`] for the share of a node that may not lead; nothing is changed.
    pub fn merge(
        &mut self,
        share: &LedgerShare,
        ledger: &mut ReputationLedger,
        candidates: &[NodeName],
        leadership: &Leadership,
        now: Timestamp,
    ) -> Result<Merged, RejectReason> {
        if !candidates.contains(&share.node) {
            return Err(RejectReason::NotCandidate);
        }
        let terms = share.entries.iter().map(|entry| entry.epoch).chain(share.marks.iter().map(|mark| mark.epoch));
        let has_unknown_terms = terms.max().is_some_and(|term| !leadership.knows_term(term));
        let is_own = |term: u64, leader: &NodeName| {
            self.leads.as_ref().is_some_and(|own| own.term == term && own.leader == *leader)
        };
        let is_usable = |term: u64, leader: &NodeName| leadership.knows_term(term) && !is_own(term, leader);
        let entries = share.entries.iter().filter(|entry| is_usable(entry.epoch, &entry.aggregator));
        let marks = share.marks.iter().filter(|mark| is_usable(mark.epoch, &mark.aggregator));
        let (entries, marks): (Vec<_>, Vec<_>) = (entries.cloned().collect(), marks.cloned().collect());
        let leader = share.epoch.filter(|term| leadership.knows_term(*term));
        self.hear(leader.map(|term| Epoch::new(term, share.node.clone())), ledger, candidates);
        if self.repeats > 0 {
            self.shared.merge_entries(entries.iter().cloned(), self.leader.as_ref());
            self.shared.merge_marks(marks.iter().cloned(), self.leader.as_ref());
        }
        let present = self.leads.as_ref().or(leadership.epoch.as_ref());
        let is_news = ledger.merge_entries(entries, present) | ledger.merge_marks(marks, present);
        Ok(Merged { is_news, has_unknown_terms, shares: self.take_everything(ledger, now) })
    }

    /// Lets a publication period pass.
    pub fn tick(&mut self, ledger: &ReputationLedger, leadership: &Leadership, now: Timestamp) -> Vec<LedgerShare> {
        let mut shares = self.take_everything(ledger, now);
        shares.extend(self.take_unshared(ledger, leadership));
        self.ticks += 1;
        if self.ticks >= self.ticks_per_snapshot {
            self.ticks = 0;
            if self.leads.is_some() {
                shares.extend(self.snapshot(ledger));
            }
        }
        shares
    }

    /// All evidence, or one share that says that there is none: a node that takes over waits for it, and a node that has
    /// some answers it.
    pub fn snapshot(&self, ledger: &ReputationLedger) -> Vec<LedgerShare> {
        let (entries, marks): (Vec<_>, Vec<_>) = (ledger.entries().collect(), ledger.marks().collect());
        let mut shares = Vec::new();
        if entries.is_empty() {
            shares.push(self.share_of(&[], &[]));
        }
        shares.extend(self.shares(&entries, &marks));
        shares
    }

    /// Notes the leader whose share came; one that is heard for the first time may be told something.
    fn hear(&mut self, leader: Option<Epoch>, ledger: &ReputationLedger, candidates: &[NodeName]) {
        if leader.is_none() || leader == self.leader {
            return;
        }
        (self.leader, self.shared) = (leader, ReputationLedger::default());
        (self.wait, self.repeats) = (self.ticks_to_listen(candidates).max(1), REPEATS);
        self.owes_everything = self.has_led || ledger.entries().any(|entry| entry.aggregator == self.name);
    }

    /// Ticks for which a new leader is listened to before it is told what it has not shared. It shares everything in two
    /// thirds of that. Candidates speak in the order of their names.
    fn ticks_to_listen(&self, candidates: &[NodeName]) -> u32 {
        let earlier = candidates.iter().filter(|name| **name < self.name).count();
        let period = self.ticks_per_snapshot;
        period + period.div_ceil(2) + u32::try_from(earlier).unwrap_or(u32::MAX) % period.max(1)
    }

    /// Everything, if the leader is to have it and did not get it a moment ago.
    fn take_everything(&mut self, ledger: &ReputationLedger, now: Timestamp) -> Vec<LedgerShare> {
        let is_due = self.everything_sent_at.is_none_or(|at| now.since(at) >= FULL_RESYNC_PAUSE);
        if !self.owes_everything || !is_due {
            return Vec::new();
        }
        (self.owes_everything, self.everything_sent_at) = (false, Some(now));
        let (entries, marks): (Vec<_>, Vec<_>) = (ledger.entries().collect(), ledger.marks().collect());
        self.shares(&entries, &marks)
    }

    /// Evidence that nobody has shared with the leader, if it is time to send it.
    fn take_unshared(&mut self, ledger: &ReputationLedger, leadership: &Leadership) -> Vec<LedgerShare> {
        if self.leads.is_some() {
            return Vec::new();
        }
        if self.repeats == 0 {
            self.shared = ReputationLedger::default();
            return Vec::new();
        }
        self.wait -= 1;
        if self.wait > 0 {
            return Vec::new();
        }
        (self.wait, self.repeats) = (self.ticks_per_snapshot.max(1), self.repeats - 1);
        let (mut entries, mut marks) = ledger.beyond(&self.shared);
        entries.retain(|entry| leadership.knows_term(entry.epoch));
        marks.retain(|mark| leadership.knows_term(mark.epoch));
        self.shares(&entries, &marks)
    }

    fn shares(&self, entries: &[LedgerEntry], marks: &[LedgerMark]) -> Vec<LedgerShare> {
        let entries = entries.chunks(MAX_SHARE_ENTRIES).map(|entries| self.share_of(entries, &[]));
        entries.chain(marks.chunks(MAX_SHARE_ENTRIES).map(|marks| self.share_of(&[], marks))).collect()
    }

    fn share_of(&self, entries: &[LedgerEntry], marks: &[LedgerMark]) -> LedgerShare {
        LedgerShare {
            schema: SCHEMA_VERSION,
            node: self.name.clone(),
            epoch: self.leads.as_ref().map(|epoch| epoch.term),
            entries: entries.to_vec(),
            marks: marks.to_vec(),
        }
    }
}

#[cfg(test)]
mod tests;
