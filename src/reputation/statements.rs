//! Statements: the signed shares of one lane. Statements that are fully covered by later ones are
//! dropped from time to time.

use std::sync::Arc;

use crate::wire::{LedgerShare, MAX_SHARE_ENTRIES};

/// Number of statements of a lane, in addition to those left by the last clearing, at which it is
/// cleared again.
const MAX_NEW: usize = 16;

/// Maximum size of a lane's statements, in multiples of the lane's own size. If an aggregator signs
/// each vehicle's counts in a separate full statement, only a part of the statements is kept.
const MAX_COPIES: usize = 4;

/// The statements behind one lane.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(super) struct Statements {
    /// The latest last.
    pub(super) signed: Vec<Arc<LedgerShare>>,
    /// Number of statements at which redundant statements are dropped.
    clear_at: usize,
}

impl Statements {
    /// Adds a share to a lane that has `lane_size` counts and marks. `adds` merges a statement into
    /// initially empty evidence, the latest statement first, and returns true if that changed any.
    pub(super) fn push(
        &mut self,
        share: Arc<LedgerShare>,
        lane_size: usize,
        adds: impl FnMut(&LedgerShare) -> bool,
    ) {
        self.signed.push(share);
        if self.signed.len() >= self.clear_at.max(MAX_NEW) {
            self.clear(lane_size, adds);
        }
    }

    /// Drops the statements that are fully covered by later ones.
    fn clear(&mut self, lane_size: usize, mut adds: impl FnMut(&LedgerShare) -> bool) {
        let mut room = MAX_COPIES * (lane_size + MAX_SHARE_ENTRIES);
        let is_needed = |share: &Arc<LedgerShare>| {
            let size = share.entries.len() + share.marks.len();
            if size > room || !adds(share) {
                return false;
            }
            room -= size;
            true
        };
        let mut kept: Vec<_> = std::mem::take(&mut self.signed)
            .into_iter()
            .rev()
            .filter(is_needed)
            .collect();
        kept.reverse();
        self.clear_at = kept.len() * 2 + MAX_NEW;
        self.signed = kept;
    }
}
