//! Recent reports: each comes by several brokers.

use std::collections::{BTreeMap, VecDeque};

use crate::model::names::NodeName;
use crate::model::time::Timestamp;
use crate::wire::{ObjectReport, ReportKind};

/// Marks of the latest reports of each vehicle and kind.
#[derive(Debug, Default)]
pub struct RecentReports(BTreeMap<(NodeName, ReportKind), VecDeque<(Timestamp, u64)>>);

/// Reports of one vehicle and kind that are remembered: what two links may lie apart.
const REMEMBERED: usize = 16;

/// Vehicles and kinds; beyond them, all are forgotten.
const MAX_SENDERS: usize = 8192;

impl RecentReports {
    /// Remembers a report; false if it came before.
    pub fn is_new(&mut self, kind: ReportKind, report: &ObjectReport) -> bool {
        let (sender, mark) = (
            (report.node.clone(), kind),
            (report.captured_at_us, report.seq),
        );
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_comes_by_two_brokers_is_new_once() {
        let mut recent = RecentReports::default();
        let report =
            |seq: u64| ObjectReport::new(NodeName::from_static("euclid"), seq, Timestamp(seq));
        let by_two = [1, 2, 2, 1, 3, 4, 3, 4];
        let new = by_two.map(|seq| recent.is_new(ReportKind::Detections, &report(seq)));
        assert_eq!(new, [true, true, false, false, true, true, false, false]);
        assert!(
            recent.is_new(ReportKind::VoteDetections, &report(4)),
            "another kind"
        );
    }
}
