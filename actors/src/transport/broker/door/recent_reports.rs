//! Recent reports, of which each passes the door once.

use std::collections::{BTreeMap, VecDeque};

use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ecod::wire::{ObjectReport, ReportKind};

/// Marks of the latest reports of each vehicle and kind.
#[derive(Debug, Default)]
pub(super) struct RecentReports(BTreeMap<(NodeName, ReportKind), VecDeque<(Timestamp, u64)>>);

/// Reports of one vehicle and kind that are remembered: what two links may lie apart.
const REMEMBERED: usize = 16;

/// Vehicles and kinds; beyond them, all are forgotten.
const MAX_SENDERS: usize = 8192;

impl RecentReports {
    /// Remembers a report; false if it came before.
    pub(super) fn is_new(&mut self, kind: ReportKind, report: &ObjectReport) -> bool {
        let (sender, mark) = ((report.node.clone(), kind), (report.captured_at_us, report.seq));
        if self.0.len() >= MAX_SENDERS && !self.0.contains_key(&sender) {
            self.0.clear();
        }
        let marks = self.0.entry(sender).or_default();
        if marks.contains(&mark) {
            return false;
        }
        if marks.len() >= REMEMBERED {
            marks.pop_front();
        }
        marks.push_back(mark);
        true
    }
}
