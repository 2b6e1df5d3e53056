//! Signed evidence: counts that come from the signed shares of their aggregators.
//!
//! A node that passes a lane on sends the signed shares of the lane's aggregator. When the
//! certificate of an aggregator is revoked, its statements are dropped together with their counts.
//! Statements on probation count, but are not passed on or saved.

use std::collections::BTreeSet;
use std::sync::Arc;

use super::ledger::ReputationLedger;
use super::statements::Statements;
use crate::model::epoch::Epoch;
use crate::model::names::NodeName;
use crate::model::time::Timestamp;
use crate::wire::LedgerShare;

impl ReputationLedger {
    /// Merges the counts and marks of a share; returns true if that changed any.
    pub fn merge_share(&mut self, share: &LedgerShare, present: Option<&Epoch>) -> bool {
        self.merge_entries(share.entries.iter().cloned(), present)
            | self.merge_marks(share.marks.iter().cloned(), present)
    }

    /// Merges and stores a share signed by its aggregator. The caller has verified the signature;
    /// the share contains one lane. Returns true if that changed any count or mark.
    pub fn merge_statement(&mut self, share: &Arc<LedgerShare>, present: Option<&Epoch>) -> bool {
        let changed = self.merge_share(share, present);
        if let Some(lane) = share.lane().filter(|lane| self.lanes.contains_key(lane)) {
            let size = self.size_of(&lane);
            keep(self.statements.entry(lane).or_default(), share, size);
        }
        changed
    }

    /// As [`Self::merge_statement`], on probation until `ends_at`.
    pub fn merge_on_probation(
        &mut self,
        share: &Arc<LedgerShare>,
        present: Option<&Epoch>,
        ends_at: Timestamp,
    ) -> bool {
        let changed = self.merge_share(share, present);
        if let Some(lane) = share.lane().filter(|lane| self.lanes.contains_key(lane)) {
            let size = self.size_of(&lane);
            let on_probation = self.on_probation.entry(lane).or_default();
            keep(&mut on_probation.0, share, size);
            on_probation.1 = ends_at;
        }
        changed
    }

    /// Ends probations: of the lanes that `has_failed` selects, whose shares and counts are
    /// dropped, and of those whose time is over. Returns these lanes, and whether each is evidence
    /// now.
    pub fn end_probations(
        &mut self,
        now: Timestamp,
        has_failed: impl Fn(&Epoch) -> bool,
    ) -> Vec<(Epoch, bool)> {
        let mut ended = Vec::new();
        for (lane, (tried, ends_at)) in std::mem::take(&mut self.on_probation) {
            if has_failed(&lane) {
                let kept = self
                    .statements
                    .get(&lane)
                    .map(|statements| statements.signed.clone())
                    .unwrap_or_default();
                self.drop_lane(&lane);
                kept.iter()
                    .for_each(|share| _ = self.merge_statement(share, None));
                ended.push((lane, false));
            } else if now >= ends_at {
                tried
                    .signed
                    .iter()
                    .for_each(|share| _ = self.merge_statement(share, None));
                ended.push((lane, true));
            } else {
                self.on_probation.insert(lane, (tried, ends_at));
            }
        }
        ended
    }

    /// The signed shares of other aggregators' lanes, without those on probation.
    pub fn statements(&self) -> impl Iterator<Item = &Arc<LedgerShare>> {
        self.statements.values().flat_map(|lane| &lane.signed)
    }

    /// True if the counts of a lane come from signed shares. This node's own counts do not.
    pub fn is_stated(&self, lane: &Epoch) -> bool {
        self.statements.contains_key(lane) || self.on_probation.contains_key(lane)
    }

    /// Drops this node's own counts, under the name `aggregator`; returns true if there were any.
    pub fn drop_own(&mut self, aggregator: &NodeName) -> bool {
        let is_own = |lane: &&Epoch| lane.leader == *aggregator && !self.is_stated(lane);
        let own: Vec<_> = self.lanes.keys().filter(is_own).cloned().collect();
        own.iter().for_each(|lane| self.drop_lane(lane));
        !own.is_empty()
    }

    /// Drops the signed shares that are invalid, and counts that come only from them; returns true
    /// if there were any.
    pub fn retain_statements(&mut self, mut is_valid: impl FnMut(&LedgerShare) -> bool) -> bool {
        let mut has_dropped = false;
        let lanes: BTreeSet<_> = self
            .statements
            .keys()
            .chain(self.on_probation.keys())
            .cloned()
            .collect();
        for lane in lanes {
            let signed = self
                .statements
                .get(&lane)
                .map(|lane| lane.signed.clone())
                .unwrap_or_default();
            let (tried, ends_at) = self.on_probation.get(&lane).cloned().unwrap_or_default();
            if signed
                .iter()
                .chain(&tried.signed)
                .all(|share| is_valid(share))
            {
                continue;
            }
            self.drop_lane(&lane);
            for share in signed.iter().filter(|share| is_valid(share)) {
                self.merge_statement(share, None);
            }
            for share in tried.signed.iter().filter(|share| is_valid(share)) {
                self.merge_on_probation(share, None, ends_at);
            }
            has_dropped = true;
        }
        has_dropped
    }
}

/// Keeps a share among the statements of a lane that has `lane_size` counts and marks.
fn keep(statements: &mut Statements, share: &Arc<LedgerShare>, lane_size: usize) {
    let mut later = ReputationLedger::default();
    statements.push(Arc::clone(share), lane_size, |share| {
        later.merge_share(share, None)
    });
}
