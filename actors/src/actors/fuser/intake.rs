//! Reports on their way to the fuser: of each vehicle and kind the latest.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ecod::wire::{ObjectReport, ReportKind};

use crate::transport::mqtt::Delivery;

/// Takes reports where they come in, on the links' tasks, and keeps them until the fuser is free. However many come, at
/// most one of each vehicle and kind waits, so that no vehicle's reports wait behind a heap of another's.
#[derive(Debug, Clone, Default)]
pub struct Intake(Arc<Mutex<Waiting>>);

#[derive(Debug, Default)]
struct Waiting {
    next: u64,
    /// In the order of their coming.
    reports: BTreeMap<u64, Delivery>,
    /// Place and capture time of each vehicle's.
    places: BTreeMap<(NodeName, ReportKind), (u64, Timestamp)>,
}

/// What became of a report that was put in.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Put {
    /// Nothing waited before: the fuser has to be told.
    pub is_first: bool,
    /// An older report of the vehicle gave way, or this one to a newer.
    pub has_replaced: bool,
}

impl Intake {
    /// Takes a vehicle's report, which is what is delivered.
    pub fn put(&self, kind: ReportKind, report: &ObjectReport, delivery: Delivery) -> Put {
        let mut waiting = self.waiting();
        let is_first = waiting.reports.is_empty();
        let (key, captured_at) = ((report.node.clone(), kind), report.captured_at_us);
        if waiting.places.get(&key).is_some_and(|(_, known)| *known > captured_at) {
            return Put { is_first, has_replaced: true };
        }
        let place = waiting.next;
        waiting.next += 1;
        waiting.reports.insert(place, delivery);
        let older = waiting.places.insert(key, (place, captured_at));
        let has_replaced = older.is_some_and(|(older, _)| waiting.reports.remove(&older).is_some());
        Put { is_first, has_replaced }
    }

    /// All that wait, in the order of their coming.
    pub fn take_all(&self) -> Vec<Delivery> {
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
    use crate::transport::mqtt::Incoming;

    #[test]
    fn the_latest_of_each_vehicle_and_kind_waits() {
        let intake = Intake::default();
        let put = |node: &str, kind, seq| {
            let report = Arc::new(ObjectReport::new(NodeName::new(node).unwrap(), seq, Timestamp(seq)));
            let message = Incoming::Report { kind, report: Arc::clone(&report) };
            intake.put(kind, &report, Delivery::local(message, Timestamp(seq)))
        };
        use ReportKind::{Detections, VoteDetections};
        assert_eq!(put("mallory", Detections, 0), Put { is_first: true, has_replaced: false });
        assert_eq!(put("euclid", Detections, 1), Put { is_first: false, has_replaced: false });
        for seq in 2..1000 {
            assert_eq!(put("mallory", Detections, seq), Put { is_first: false, has_replaced: true });
        }
        put("mallory", VoteDetections, 1000);
        let taken: Vec<_> = intake.take_all().iter().map(|delivery| delivery.received_at.micros()).collect();
        assert_eq!(taken, [1, 999, 1000]);
        assert!(put("euclid", Detections, 1001).is_first);
        assert!(put("euclid", Detections, 1000).has_replaced, "the later capture stays, whichever came first");
        assert_eq!(intake.take_all()[0].received_at.micros(), 1001);
    }
}
