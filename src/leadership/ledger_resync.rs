//! Replication of the evidence about vehicles between the candidates of a cell.
//!
//! - The leader records evidence in the lane of the epoch in which its leadership began, even after
//!   it has renewed its term. It shares changes after each round, and all evidence once per
//!   snapshot period. Receivers keep the larger count, so shares may arrive late, twice, or in any
//!   order.
//! - A node that has led sends all its evidence to a new leader when it first receives that leader.
//!   Every other candidate waits for longer than leaders take to share all their evidence, and then
//!   sends the evidence that no other candidate has shared. Each candidate sends at its own time.
//!   In this way the evidence of former leaders survives, also when a split heals.
//! - Evidence is accepted from candidates, for terms that the election has seen, and only in
//!   plausible steps. The current leader's lane is accepted from the leader alone.
//!
//! # Signed evidence
//!
//! In a cell with certificates every share contains one lane and is signed by the lane's
//! aggregator. Other nodes pass on the same bytes. A signature proves which node counted, but not
//! that this node led. Therefore a lane must come from the leader that this node follows or
//! followed until recently, or from a candidate other than the lane's aggregator. Candidates apply
//! the same rule to the evidence that they accept, so a lane that a candidate has invented for
//! itself does not spread.
//!
//! A node that starts may first receive a false claimant, and follows it until the true leader
//! renews its term. For this reason an aggregator's own evidence is on probation until its
//! leadership has been followed for [`EVIDENCE_PROBATION`]. Until then it counts on this node only,
//! because leadership may be handed to this node. It is dropped when the node follows another
//! leader, which shares the evidence of its predecessors. If an honest leader led only for a short
//! time, it shares its counts when it leads again.
//!
//! This module does not send messages: its methods return the shares to publish. The caller signs
//! the shares of the node's own lanes. Time is counted in ticks of the publication period.

mod growth;

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use crate::leadership::timers::{
    EVIDENCE_PROBATION, FULL_RESYNC_PAUSE, LAST_WORD_TIME, MAX_RESET_AHEAD,
};
use crate::leadership::view::Leadership;
use crate::model::epoch::Epoch;
use crate::model::names::NodeName;
use crate::model::time::Timestamp;
use crate::reputation::{EntryKey, Evidence, MAX_ENTRIES, ReputationLedger};
use crate::wire::{
    LedgerEntry, LedgerMark, LedgerShare, MAX_SHARE_ENTRIES, RejectReason, SCHEMA_VERSION,
};
use growth::GrowthLimit;
pub use growth::is_plausible;

/// Number of times that missing evidence is sent to a leader, in case messages are lost.
const REPEATS: u32 = 3;

/// State of the replication on one node.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LedgerResync {
    name: NodeName,
    /// True if evidence is signed.
    is_signed: bool,
    ticks_per_snapshot: u32,
    /// The node's own leadership, while it leads.
    leads: Option<Epoch>,
    /// The epoch in which that leadership began: followers can make a leader renew its term.
    lane: Option<Epoch>,
    has_led: bool,
    /// Ticks since the last snapshot.
    ticks: u32,
    /// The leader whose messages were received last.
    leader: Option<Epoch>,
    /// True if this node must send all its evidence to that leader.
    owes_everything: bool,
    everything_sent_at: Option<Timestamp>,
    /// Evidence shared by any candidate since that leader was first received.
    shared: ReputationLedger,
    /// Ticks until this node sends the evidence that has not been shared.
    wait: u32,
    /// Number of times that this will still happen.
    repeats: u32,
    followed: BTreeMap<NodeName, Followed>,
    growth: GrowthLimit,
}

/// The current leader, or a leader that was followed until recently.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Followed {
    /// Since when, without another leader.
    since: Timestamp,
    last: Timestamp,
}

/// Outcome of a share that was merged, or of a period that passed.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Merged {
    /// True if the ledger, or its part to be saved, has changed.
    pub is_news: bool,
    /// Reasons why entries were left out.
    pub refused: Vec<RejectReason>,
    /// Shares to publish now, in this order; empty if all evidence has been shared.
    pub shares: Vec<LedgerShare>,
}

impl LedgerResync {
    /// As [`Self::new`], for a cell with certificates. The caller of [`Self::merge`] must verify
    /// signatures first.
    pub fn signed(name: NodeName, ticks_per_snapshot: u32) -> Self {
        Self {
            is_signed: true,
            ..Self::new(name, ticks_per_snapshot)
        }
    }

    /// The part of the node of this name; everything is shared each `ticks_per_snapshot` calls of
    /// [`Self::tick`].
    pub fn new(name: NodeName, ticks_per_snapshot: u32) -> Self {
        Self {
            name,
            is_signed: false,
            ticks_per_snapshot,
            leads: None,
            lane: None,
            has_led: false,
            ticks: 0,
            leader: None,
            owes_everything: false,
            everything_sent_at: None,
            shared: ReputationLedger::default(),
            wait: 0,
            repeats: 0,
            followed: BTreeMap::new(),
            growth: GrowthLimit::default(),
        }
    }

    /// Restores the ledger of earlier runs: counts continue from there, with the same growth
    /// limits.
    pub fn resume(&mut self, ledger: &ReputationLedger, now: Timestamp) {
        self.growth = GrowthLimit::of(ledger, now);
    }

    /// The node's own leadership, while it leads.
    pub fn leads(&self) -> Option<&Epoch> {
        self.leads.as_ref()
    }

    /// Begins a leadership of this node, or renews its term. Share [`Self::snapshot`] next.
    pub fn lead(&mut self, epoch: Epoch) {
        self.lane.get_or_insert_with(|| epoch.clone());
        self.leads = Some(epoch);
        self.has_led = true;
    }

    /// Ends the leadership of this node.
    pub fn step_down(&mut self) {
        self.leads = None;
        self.lane = None;
    }

    /// The lane in which this node counts when it leads in `epoch`: the lane of its first epoch,
    /// unless there is evidence of a later leadership. The latest votes count most.
    pub fn lane_in(&mut self, epoch: &Epoch, ledger: &ReputationLedger) -> Epoch {
        self.lead(epoch.clone());
        let lane = self.lane.get_or_insert_with(|| epoch.clone());
        if ledger.has_later_than(lane) && !ledger.has_later_than(epoch) {
            lane.clone_from(epoch);
        }
        lane.clone()
    }

    /// Records the evidence about vehicles from a round of the node's own leadership.
    pub fn record(
        &mut self,
        epoch: &Epoch,
        evidence: &[Evidence],
        ledger: &mut ReputationLedger,
    ) -> Vec<LedgerShare> {
        let lane = self.lane_in(epoch, ledger);
        let key = |evidence: &Evidence| {
            let Evidence { node, label, .. } = evidence.clone();
            EntryKey {
                lane: lane.clone(),
                node,
                label,
            }
        };
        let keys: BTreeSet<_> = evidence.iter().map(key).collect();
        for evidence in evidence {
            ledger.record(lane.term, &lane.leader, evidence);
        }
        let changed = ledger.entries_of(&keys);
        let reached = ledger.marks_reached(lane.term, &lane.leader, evidence);
        self.shares(ledger, &changed, &reached)
    }

    /// True if a broker vouches for the senders of shares. It vouches for its own node, for this
    /// node, and for a leader that is followed or was followed until recently. `broker` is the node
    /// whose certificate the broker has proven, if any.
    pub fn is_vouched_for(
        &self,
        broker: Option<&NodeName>,
        share: &LedgerShare,
        leadership: &Leadership,
    ) -> bool {
        let is_of_leader = |broker: &NodeName| {
            leadership.leader() == Some(broker) || self.followed.contains_key(broker)
        };
        broker.is_none_or(|broker| {
            [&share.node, &self.name].contains(&broker) || is_of_leader(broker)
        })
    }

    /// Checks the path on which a share arrived. A broker may let any client publish under any
    /// name, so evidence that its sender has not signed itself is accepted only over a broker that
    /// vouches for the sender.
    ///
    /// # Errors
    /// Returns an error if the share must not be used: [`RejectReason::Unattested`] if it contains
    /// new evidence, `None` if all of its evidence is already in the ledger.
    pub fn check_way(
        &self,
        broker: Option<&NodeName>,
        share: &LedgerShare,
        ledger: &ReputationLedger,
        leadership: &Leadership,
    ) -> Result<(), Option<RejectReason>> {
        let is_signed_by_sender = share.lane().is_some_and(|lane| lane.leader == share.node);
        if share.is_empty() || is_signed_by_sender || self.is_vouched_for(broker, share, leadership)
        {
            return Ok(());
        }
        let is_news = share.entries.iter().any(|entry| ledger.lacks_entry(entry))
            || share.marks.iter().any(|mark| ledger.lacks_mark(mark));
        Err(is_news.then_some(RejectReason::Unattested))
    }

    /// Merges another candidate's share. `candidates` are the other nodes that may lead, `date` is
    /// `now` in the cell's time.
    ///
    /// # Errors
    /// Returns [`RejectReason::NotCandidate`] for a share of a node that may not lead, and
    /// [`RejectReason::BadSignature`] for a share that lacks a required signature. The state is
    /// unchanged in both cases.
    pub fn merge(
        &mut self,
        share: &LedgerShare,
        ledger: &mut ReputationLedger,
        candidates: &[NodeName],
        leadership: &Leadership,
        now: Timestamp,
        date: Timestamp,
    ) -> Result<Merged, RejectReason> {
        if !candidates.contains(&share.node) {
            return Err(RejectReason::NotCandidate);
        }
        if self.is_signed && !share.is_empty() && (share.signed.is_none() || share.lane().is_none())
        {
            return Err(RejectReason::BadSignature);
        }
        let has_judged = self.record_leader(ledger, leadership, now);
        let is_reset = self.on_reset(share, ledger, date);
        let is_over = !self.is_signed && share.reset_at_us.unwrap_or_default() < ledger.reset_at();
        let (mut taken, refused) = if is_over {
            (share.clone(), Vec::new())
        } else {
            self.judge(share, ledger, leadership, now)
        };
        // A signed share is accepted as a whole or not at all, because it is passed on unchanged.
        let is_whole =
            taken.entries.len() == share.entries.len() && taken.marks.len() == share.marks.len();
        if is_over || (self.is_signed && !is_whole) {
            taken.entries = Vec::new();
            taken.marks = Vec::new();
        }
        // A candidate may claim to lead while the election names another leader. The true leader
        // repeats its evidence.
        let is_leader = leadership
            .leader()
            .is_none_or(|leader| *leader == share.node);
        let leader = share
            .epoch
            .filter(|term| is_leader && leadership.has_term(*term));
        self.receive(
            leader.map(|term| Epoch::new(term, share.node.clone())),
            ledger,
            candidates,
        );
        // The sender has not received the reset yet.
        self.owes_everything |= is_over;
        if self.repeats > 0 {
            self.shared.merge_share(&taken, self.leader.as_ref());
        }
        let present_lane = self
            .lane_of_leader(leadership)
            .or(leadership.epoch.as_ref())
            .cloned();
        let present = present_lane.as_ref();
        let taken = Arc::new(taken);
        let is_statement = self.is_signed
            && taken
                .lane()
                .is_some_and(|lane| !self.has_counted(&lane, ledger));
        let probation_ends_at = self
            .probation_end(&share.node, now)
            .filter(|_| taken.lane().is_some_and(|lane| lane.leader == share.node));
        let is_merged = match probation_ends_at {
            Some(ends_at) if is_statement => ledger.merge_on_probation(&taken, present, ends_at),
            None if is_statement => ledger.merge_statement(&taken, present),
            Some(_) | None => ledger.merge_share(&taken, present),
        };
        self.growth.record(&taken, ledger, now);
        let is_news = is_merged | is_reset | has_judged;
        Ok(Merged {
            is_news,
            refused,
            shares: self.share_everything(ledger, now),
        })
    }

    /// The part of a share that is evidence for this node, and the reasons to leave out the rest.
    fn judge(
        &self,
        share: &LedgerShare,
        ledger: &ReputationLedger,
        leadership: &Leadership,
        now: Timestamp,
    ) -> (LedgerShare, Vec<RejectReason>) {
        let mut refused = BTreeSet::new();
        let mut is_usable = |lane: Epoch, is_plausible: bool, is_news: &dyn Fn() -> bool| {
            if self.lane.as_ref() == Some(&lane) {
                // Only this node has its current counts.
                return false;
            }
            let reason = if !leadership.has_term(lane.term) {
                RejectReason::UnknownTerm
            } else if !self.may_share(&share.node, &lane, leadership) {
                RejectReason::Unattested
            } else if !is_plausible {
                RejectReason::Implausible
            } else {
                return true;
            };
            // Candidates may repeat evidence that all nodes have.
            if is_news() {
                refused.insert(reason);
            }
            false
        };
        let lane = |term: u64, aggregator: &NodeName| Epoch::new(term, aggregator.clone());
        let mut taken = share.clone();
        taken.entries.retain(|entry| {
            let is_plausible = self.growth.admits(entry, now);
            is_usable(lane(entry.epoch, &entry.aggregator), is_plausible, &|| {
                ledger.lacks_entry(entry)
            })
        });
        taken.marks.retain(|mark| {
            let is_plausible = self.growth.admits_mark(mark, now);
            is_usable(lane(mark.epoch, &mark.aggregator), is_plausible, &|| {
                ledger.lacks_mark(mark)
            })
        });
        (taken, refused.into_iter().collect())
    }

    /// True if this node counted all evidence of a lane, and therefore signs it.
    fn has_counted(&self, lane: &Epoch, ledger: &ReputationLedger) -> bool {
        lane.leader == self.name && ledger.has_lane(lane) && !ledger.is_stated(lane)
    }

    /// The lane in which the leader counts: this node's own, or by the leader's shares.
    fn lane_of_leader(&self, leadership: &Leadership) -> Option<&Epoch> {
        let is_of_leader = |lane: &&Epoch| {
            leadership
                .epoch
                .as_ref()
                .is_some_and(|now| now.leader == lane.leader && **lane <= *now)
        };
        self.lane
            .as_ref()
            .or(self.leader.as_ref().filter(is_of_leader))
    }

    /// True if a candidate may share the evidence of a lane.
    fn may_share(&self, sender: &NodeName, lane: &Epoch, leadership: &Leadership) -> bool {
        let is_counting =
            |present: &Epoch| present == lane || self.lane_of_leader(leadership) == Some(lane);
        if leadership.present_epoch().is_some_and(is_counting) {
            return *sender == lane.leader;
        }
        !self.is_signed || *sender != lane.leader || self.followed.contains_key(sender)
    }

    /// Records the current leader; returns true if evidence left probation. The last share of an
    /// old leader may arrive when another node already leads.
    fn record_leader(
        &mut self,
        ledger: &mut ReputationLedger,
        leadership: &Leadership,
        now: Timestamp,
    ) -> bool {
        let leader = leadership.leader();
        if let Some(leader) = leader {
            let latest = self
                .followed
                .iter()
                .max_by_key(|(_, followed)| followed.last);
            let since = latest
                .filter(|(latest, _)| *latest == leader)
                .map_or(now, |(_, followed)| followed.since);
            self.followed
                .insert(leader.clone(), Followed { since, last: now });
        }
        self.followed
            .retain(|_, followed| now.since(followed.last) < LAST_WORD_TIME);
        let has_failed = |lane: &Epoch| {
            leader.is_some_and(|leader| ![&lane.leader, &self.name].contains(&leader))
        };
        let judged = ledger.end_probations(now, has_failed);
        if judged
            .iter()
            .any(|(lane, is_evidence)| *is_evidence && self.leader.as_ref() != Some(lane))
        {
            // A leader that stopped and leads again may have lost its counts.
            self.wait = self.wait.max(1);
            self.repeats = REPEATS;
        }
        !judged.is_empty()
    }

    /// End of the probation of a leader's own evidence, or `None` if it has ended.
    fn probation_end(&self, leader: &NodeName, now: Timestamp) -> Option<Timestamp> {
        self.followed
            .get(leader)
            .map(|followed| followed.since + EVIDENCE_PROBATION)
            .filter(|ends_at| *ends_at > now)
    }

    /// Drops all evidence if the share contains a later reset than this node's; returns true in
    /// that case.
    fn on_reset(
        &mut self,
        share: &LedgerShare,
        ledger: &mut ReputationLedger,
        date: Timestamp,
    ) -> bool {
        let later = share
            .reset_at_us
            .filter(|at| *at > ledger.reset_at() && at.since(date) < MAX_RESET_AHEAD);
        let Some(reset_at) = later.filter(|_| !self.is_signed) else {
            return false;
        };
        *ledger = ReputationLedger::reset(reset_at);
        self.shared = ReputationLedger::default();
        self.growth = GrowthLimit::default();
        true
    }

    /// Lets a publication period pass.
    pub fn tick(
        &mut self,
        ledger: &mut ReputationLedger,
        leadership: &Leadership,
        now: Timestamp,
    ) -> Merged {
        let is_news = self.record_leader(ledger, leadership, now);
        if self.growth.len() > 2 * MAX_ENTRIES {
            self.growth.retain(|lane| ledger.has_lane(lane));
        }
        let mut shares = self.share_everything(ledger, now);
        shares.extend(self.share_unshared(ledger, leadership));
        self.ticks += 1;
        if self.ticks >= self.ticks_per_snapshot {
            self.ticks = 0;
            if self.leads.is_some() {
                shares.extend(self.snapshot(ledger));
            }
        }
        Merged {
            is_news,
            refused: Vec::new(),
            shares,
        }
    }

    /// All evidence, or a single empty share if there is none: a node that takes over waits for it,
    /// and a node that has evidence answers it.
    pub fn snapshot(&self, ledger: &ReputationLedger) -> Vec<LedgerShare> {
        let mut shares = self.everything(ledger, None);
        if shares.iter().all(|share| share.entries.is_empty()) {
            shares.insert(0, self.share_of(ledger, &[], &[]));
        }
        shares
    }

    /// Records the leader whose share arrived; if the leader is new, schedules evidence to be sent
    /// to it.
    fn receive(
        &mut self,
        leader: Option<Epoch>,
        ledger: &ReputationLedger,
        candidates: &[NodeName],
    ) {
        if leader.is_none() || leader == self.leader {
            return;
        }
        self.leader = leader;
        self.shared = ReputationLedger::default();
        self.wait = self.ticks_to_listen(candidates).max(1);
        self.repeats = REPEATS;
        self.owes_everything =
            self.has_led || ledger.entries().any(|entry| entry.aggregator == self.name);
    }

    /// Number of ticks for which this node waits before it sends missing evidence to a new leader.
    /// The leader shares everything in two thirds of that time. Candidates send in the order of
    /// their names.
    fn ticks_to_listen(&self, candidates: &[NodeName]) -> u32 {
        let earlier = candidates.iter().filter(|name| **name < self.name).count();
        let period = self.ticks_per_snapshot;
        period + period.div_ceil(2) + u32::try_from(earlier).unwrap_or(u32::MAX) % period.max(1)
    }

    /// All evidence, if the leader should have it and has not received it recently.
    fn share_everything(&mut self, ledger: &ReputationLedger, now: Timestamp) -> Vec<LedgerShare> {
        let is_due = self
            .everything_sent_at
            .is_none_or(|at| now.since(at) >= FULL_RESYNC_PAUSE);
        if !self.owes_everything || !is_due {
            return Vec::new();
        }
        self.owes_everything = false;
        self.everything_sent_at = Some(now);
        let mut shares = self.everything(ledger, self.leader.as_ref());
        if shares.is_empty() && ledger.reset_at() > Timestamp::default() {
            // The news is the reset.
            shares.push(self.share_of(ledger, &[], &[]));
        }
        shares
    }

    /// All evidence except one lane. If evidence is signed, a node's own counts are not used while
    /// it does not lead.
    fn everything(&self, ledger: &ReputationLedger, except: Option<&Epoch>) -> Vec<LedgerShare> {
        let is_shared = |term: u64, aggregator: &NodeName| {
            let lane = Epoch::new(term, aggregator.clone());
            except != Some(&lane)
                && (!self.is_signed || (self.leads.is_some() && self.has_counted(&lane, ledger)))
        };
        let entries: Vec<_> = ledger
            .entries()
            .filter(|entry| is_shared(entry.epoch, &entry.aggregator))
            .collect();
        let marks: Vec<_> = ledger
            .marks()
            .filter(|mark| is_shared(mark.epoch, &mark.aggregator))
            .collect();
        let mut shares = self.shares(ledger, &entries, &marks);
        let statements = ledger
            .statements()
            .filter(|share| share.lane().as_ref() != except);
        shares.extend(statements.map(|share| self.passed_on(share)));
        shares
    }

    /// Evidence that no candidate has shared with the leader, if it is time to send it.
    fn share_unshared(
        &mut self,
        ledger: &ReputationLedger,
        leadership: &Leadership,
    ) -> Vec<LedgerShare> {
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
        self.wait = self.ticks_per_snapshot.max(1);
        self.repeats -= 1;
        let is_shared = |term: u64, aggregator: &NodeName| {
            let is_leaders = self
                .leader
                .as_ref()
                .is_some_and(|lane| lane.term == term && lane.leader == *aggregator);
            leadership.has_term(term) && !is_leaders
        };
        let (mut entries, mut marks) = ledger.beyond(&self.shared);
        entries.retain(|entry| is_shared(entry.epoch, &entry.aggregator));
        marks.retain(|mark| is_shared(mark.epoch, &mark.aggregator));
        if !self.is_signed {
            return self.shares(ledger, &entries, &marks);
        }
        let unsent = ledger.statements().filter(|share| {
            share.entries.iter().any(|entry| entries.contains(entry))
                || share.marks.iter().any(|mark| marks.contains(mark))
        });
        unsent.map(|share| self.passed_on(share)).collect()
    }

    /// Splits counts and marks into shares of at most [`MAX_SHARE_ENTRIES`]. A signed share
    /// contains entries of one lane only.
    fn shares(
        &self,
        ledger: &ReputationLedger,
        entries: &[LedgerEntry],
        marks: &[LedgerMark],
    ) -> Vec<LedgerShare> {
        let share =
            |entries: &[LedgerEntry], marks: &[LedgerMark]| self.share_of(ledger, entries, marks);
        if !entries.is_empty() && entries.len() + marks.len() <= MAX_SHARE_ENTRIES {
            let together = share(entries, marks);
            if !self.is_signed || together.lane().is_some() {
                return vec![together];
            }
        }
        // Evidence can be signed only if it belongs to one lane.
        let is_together =
            |one: (u64, &NodeName), next: (u64, &NodeName)| !self.is_signed || one == next;
        let lanes = entries
            .chunk_by(|a, b| is_together((a.epoch, &a.aggregator), (b.epoch, &b.aggregator)));
        let marks =
            marks.chunk_by(|a, b| is_together((a.epoch, &a.aggregator), (b.epoch, &b.aggregator)));
        let entries = lanes
            .flat_map(|lane| lane.chunks(MAX_SHARE_ENTRIES))
            .map(|entries| share(entries, &[]));
        entries
            .chain(
                marks
                    .flat_map(|lane| lane.chunks(MAX_SHARE_ENTRIES))
                    .map(|marks| share(&[], marks)),
            )
            .collect()
    }

    /// One unsigned share with these counts and marks, under this node's name.
    fn share_of(
        &self,
        ledger: &ReputationLedger,
        entries: &[LedgerEntry],
        marks: &[LedgerMark],
    ) -> LedgerShare {
        LedgerShare {
            schema: SCHEMA_VERSION,
            node: self.name.clone(),
            epoch: self.lane.as_ref().map(|lane| lane.term),
            entries: entries.to_vec(),
            marks: marks.to_vec(),
            signed: None,
            reset_at_us: Some(ledger.reset_at()).filter(|at| *at > Timestamp::default()),
        }
    }

    /// A share of another aggregator as this node sends it.
    fn passed_on(&self, share: &LedgerShare) -> LedgerShare {
        let epoch = self.lane.as_ref().map(|lane| lane.term);
        LedgerShare {
            node: self.name.clone(),
            epoch,
            ..share.clone()
        }
    }
}

#[cfg(test)]
mod tests;
