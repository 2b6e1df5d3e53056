//! Recent reports, for detecting duplicates: each report arrives over several brokers.

use std::collections::{BTreeMap, VecDeque};

use crate::model::names::NodeName;
use crate::model::time::Timestamp;
use crate::wire::{ObjectReport, ReportKind};

/// Marks of the latest reports of each vehicle and kind.
#[derive(Debug, Default)]
pub struct RecentReports(BTreeMap<(NodeName, ReportKind), VecDeque<(Timestamp, u64)>>);

/// Number of stored reports of one vehicle and kind, which covers the time difference between two
/// links.
const REMEMBERED: usize = 16;

/// Maximum number of vehicles and kinds; when it is exceeded, all entries are dropped.
const MAX_SENDERS: usize = 8192;

impl RecentReports {
    /// Records a report; returns false if it arrived before.
    pub fn is_new(&mut self, kind: ReportKind, report: &ObjectReport) -> bool {
        let sender = (report.node.clone(), kind);
        let mark = (report.captured_at_us, report.seq);
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
    fn two_brokers_count_report_once() {
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
