//! Queue of reports before the fuser: the latest of each vehicle and kind.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ecod::wire::{ObjectReport, ReportKind};

use crate::transport::mqtt::Delivery;

/// Queue filled on the links' tasks and emptied by the fuser. It holds at most one report of each vehicle and kind, so
/// that a flood from one vehicle delays no other.
#[derive(Debug, Clone, Default)]
pub struct LatestReportQueue(Arc<Mutex<Waiting>>);

#[derive(Debug, Default)]
struct Waiting {
    next: u64,
    /// In order of arrival.
    reports: BTreeMap<u64, Delivery<QueuedReport>>,
    /// Place and capture time of each vehicle's report.
    places: BTreeMap<(NodeName, ReportKind), (u64, Timestamp)>,
}

/// A report and the algorithm that it is for.
#[derive(Debug)]
pub struct QueuedReport {
    /// The algorithm.
    pub kind: ReportKind,
    /// The report.
    pub report: Arc<ObjectReport>,
}

/// Outcome of adding a report.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PushOutcome {
    /// The queue was empty: the fuser has to be told.
    pub is_first: bool,
    /// An older report of the vehicle was dropped for this one, or this one for a newer.
    pub has_replaced: bool,
}

impl LatestReportQueue {
    /// Adds a vehicle's report.
    pub fn push(&self, delivery: Delivery<QueuedReport>) -> PushOutcome {
        let QueuedReport { kind, report } = &delivery.message;
        let mut waiting = self.waiting();
        let is_first = waiting.reports.is_empty();
        let (key, captured_at) = ((report.node.clone(), *kind), report.captured_at_us);
        if waiting.places.get(&key).is_some_and(|(_, known)| *known > captured_at) {
            return PushOutcome { is_first, has_replaced: true };
        }
        let place = waiting.next;
        waiting.next += 1;
        waiting.reports.insert(place, delivery);
        let older = waiting.places.insert(key, (place, captured_at));
        let has_replaced = older.is_some_and(|(older, _)| waiting.reports.remove(&older).is_some());
        PushOutcome { is_first, has_replaced }
    }

    /// Empties the queue, in order of arrival.
    pub fn drain(&self) -> Vec<Delivery<QueuedReport>> {
        let mut waiting = self.waiting();
        waiting.places.clear();
        std::mem::take(&mut waiting.reports).into_values().collect()
    }

    fn waiting(&self) -> MutexGuard<'_, Waiting> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_latest_of_each_vehicle_and_kind_waits() {
        let queue = LatestReportQueue::default();
        let push = |node: &str, kind, seq| {
            let report = Arc::new(ObjectReport::new(NodeName::new(node).unwrap(), seq, Timestamp(seq)));
            queue.push(Delivery::local(QueuedReport { kind, report }, Timestamp(seq)))
        };
        use ReportKind::{Detections, VoteDetections};
        assert_eq!(push("mallory", Detections, 0), PushOutcome { is_first: true, has_replaced: false });
        assert_eq!(push("euclid", Detections, 1), PushOutcome { is_first: false, has_replaced: false });
        for seq in 2..1000 {
            assert_eq!(push("mallory", Detections, seq), PushOutcome { is_first: false, has_replaced: true });
        }
        push("mallory", VoteDetections, 1000);
        let taken: Vec<_> = queue.drain().iter().map(|delivery| delivery.received_at.micros()).collect();
        assert_eq!(taken, [1, 999, 1000]);
        assert!(push("euclid", Detections, 1001).is_first);
        assert!(push("euclid", Detections, 1000).has_replaced, "the later capture stays, whichever came first");
        assert_eq!(queue.drain()[0].received_at.micros(), 1001);
    }
}
