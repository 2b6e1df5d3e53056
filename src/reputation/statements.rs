//! Signed evidence: the shares that aggregators have signed, kept beside the counts that come from them.
//!
//! A node that passes a lane on sends the signed shares of its aggregator. When the certificate of an aggregator is
//! revoked, its statements go, and the counts with them.

use std::sync::Arc;

use super::ledger::ReputationLedger;
use crate::model::epoch::Epoch;
use crate::wire::{LedgerShare, MAX_SHARE_ENTRIES};

/// Number of statements of a lane beyond those of the last clearing at which it is cleared again.
const MAX_NEW: usize = 16;

/// Maximum size of a lane's statements, in multiples of the lane's own. An aggregator that signs each vehicle's counts
/// apart in full statements is kept in part only.
const MAX_COPIES: usize = 4;

/// The statements behind one lane.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(super) struct Statements {
    /// The latest last.
    signed: Vec<Arc<LedgerShare>>,
    /// Number of statements at which those that add nothing are dropped.
    clear_at: usize,
}

impl Statements {
    fn push(&mut self, share: Arc<LedgerShare>, lane_size: usize) {
        self.signed.push(share);
        if self.signed.len() >= self.clear_at.max(MAX_NEW) {
            self.clear(lane_size);
        }
    }

    /// Drops the statements to which later ones leave nothing to add.
    fn clear(&mut self, lane_size: usize) {
        let mut later = ReputationLedger::default();
        let mut room = MAX_COPIES * (lane_size + MAX_SHARE_ENTRIES);
        let is_needed = |share: &Arc<LedgerShare>| {
            let size = share.entries.len() + share.marks.len();
            if size > room || !later.merge_share(share, None) {
                return false;
            }
            room -= size;
            true
        };
        let mut kept: Vec<_> = std::mem::take(&mut self.signed).into_iter().rev().filter(is_needed).collect();
        kept.reverse();
        self.clear_at = kept.len() * 2 + MAX_NEW;
        self.signed = kept;
    }
}

impl ReputationLedger {
    /// Takes in the counts and marks of a share; true when that changed anything.
    pub fn merge_share(&mut self, share: &LedgerShare, present: Option<&Epoch>) -> bool {
        self.merge_entries(share.entries.iter().cloned(), present)
            | self.merge_marks(share.marks.iter().cloned(), present)
    }

    /// Takes in a share that its aggregator signed, and keeps it. The signature is verified before; the share is of one
    /// lane. True when that changed any count or mark.
    pub fn merge_statement(&mut self, share: &Arc<LedgerShare>, present: Option<&Epoch>) -> bool {
        let changed = self.merge_share(share, present);
        if let Some(lane) = share.lane().filter(|lane| self.lanes.contains_key(lane)) {
            let size = self.size_of(&lane);
            self.statements.entry(lane).or_default().push(Arc::clone(share), size);
        }
        changed
    }

    /// The signed shares behind the lanes of other aggregators.
    pub fn statements(&self) -> impl Iterator<Item = &Arc<LedgerShare>> {
        self.statements.values().flat_map(|lane| &lane.signed)
    }

    /// Whether the counts of a lane come from signed shares. Those that this node counted itself do not.
    pub fn is_stated(&self, lane: &Epoch) -> bool {
        self.statements.contains_key(lane)
    }

    /// Drops the signed shares that are not valid, and the counts that came by them alone; true if there were any.
    pub fn retain_statements(&mut self, mut is_valid: impl FnMut(&LedgerShare) -> bool) -> bool {
        let mut has_dropped = false;
        for lane in self.statements.keys().cloned().collect::<Vec<_>>() {
            let Some(Statements { signed, .. }) = self.statements.get(&lane) else { continue };
            let kept: Vec<_> = signed.iter().filter(|share| is_valid(share)).cloned().collect();
            if kept.len() == signed.len() {
                continue;
            }
            self.forget(&lane);
            for share in &kept {
                self.merge_statement(share, None);
            }
            has_dropped = true;
        }
        has_dropped
    }
}
