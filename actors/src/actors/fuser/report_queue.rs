//! Queue of reports before the fuser: the latest of each vehicle and kind, and of each vehicle a
//! bounded number of objects.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ecod::wire::{ObjectReport, ReportKind};

use crate::platform::throttle::KeyedThrottle;
use crate::transport::mqtt::Delivery;

/// Maximum number of objects per second of one vehicle including its parts: reports of 600 objects
/// at 10 Hz. More would take the processor time of other vehicles.
const MAX_OBJECTS_HZ: u32 = 6_000;

/// Maximum number of objects at once, unless one report may have more. More would delay the round.
const OBJECT_BURST: u32 = 1_024;

/// Bytes of the names of seen locations that count as one object: they cost less processor time,
/// but as much space in a recording.
const SEEN_BYTES_PER_OBJECT: usize = 64;

/// Queue filled by the links' tasks and emptied by the fuser. It holds at most one report of each
/// vehicle and kind, so that a flood from one vehicle does not delay other vehicles, and accepts at
/// most `MAX_OBJECTS_HZ` objects per second of each vehicle.
#[derive(Debug, Clone)]
pub struct LatestReportQueue(Arc<Mutex<Waiting>>);

#[derive(Debug)]
struct Waiting {
    objects: KeyedThrottle<NodeName>,
    next: u64,
    /// In order of arrival.
    reports: BTreeMap<u64, Delivery<QueuedReport>>,
    /// Place and capture time of each vehicle's report.
    places: BTreeMap<(NodeName, ReportKind), (u64, Timestamp)>,
}

/// A report and its algorithm.
#[derive(Debug)]
pub struct QueuedReport {
    /// Algorithm for which the report was sent.
    pub kind: ReportKind,
    /// The report, decoded and within the limits.
    pub report: Arc<ObjectReport>,
}

/// Outcome of adding a report.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PushOutcome {
    /// The queue was empty: the caller must notify the fuser.
    pub is_first: bool,
    /// An older report of the vehicle was dropped for this report, or this report for a newer one.
    pub has_replaced: bool,
    /// The report was dropped because its vehicle has recently sent too many objects.
    pub is_over_budget: bool,
}

impl LatestReportQueue {
    /// An empty queue for reports of up to `max_objects` objects.
    pub fn new(max_objects: usize) -> Self {
        let burst = OBJECT_BURST.max(u32::try_from(max_objects).unwrap_or(u32::MAX));
        Self(Arc::new(Mutex::new(Waiting {
            objects: KeyedThrottle::new(burst, Duration::from_secs(1) / MAX_OBJECTS_HZ),
            next: 0,
            reports: BTreeMap::new(),
            places: BTreeMap::new(),
        })))
    }

    /// Adds a vehicle's report.
    pub fn push(&self, delivery: Delivery<QueuedReport>) -> PushOutcome {
        let QueuedReport { kind, report } = &delivery.message;
        let mut waiting = self.waiting();
        let is_first = waiting.reports.is_empty();
        let key = (report.node.clone(), *kind);
        let captured_at = report.captured_at_us;
        if waiting
            .places
            .get(&key)
            .is_some_and(|(_, known)| *known > captured_at)
        {
            return PushOutcome {
                is_first,
                has_replaced: true,
                is_over_budget: false,
            };
        }
        let count = objects_in(report);
        let received_at = delivery.received_at;
        if count > 0
            && !waiting
                .objects
                .allow_many(&key.0.vehicle(), count, received_at)
        {
            return PushOutcome {
                is_first: false,
                has_replaced: false,
                is_over_budget: true,
            };
        }
        let place = waiting.next;
        waiting.next += 1;
        waiting.reports.insert(place, delivery);
        let older = waiting.places.insert(key, (place, captured_at));
        let has_replaced = older.is_some_and(|(older, _)| waiting.reports.remove(&older).is_some());
        PushOutcome {
            is_first,
            has_replaced,
            is_over_budget: false,
        }
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

/// Number of objects as which a report counts. Names alone do not exceed the burst, so that the
/// vehicle can send the report at all.
fn objects_in(report: &ObjectReport) -> u32 {
    let seen = report.seen.iter().flatten().map(|id| id.len());
    let names = seen.sum::<usize>() / SEEN_BYTES_PER_OBJECT;
    let count = |objects: usize| u32::try_from(objects).unwrap_or(u32::MAX);
    let objects = count(report.objects.len());
    count(report.objects.len() + names).min(objects.max(OBJECT_BURST))
}

#[cfg(test)]
mod tests {
    use ecod::wire::PerceivedObject;

    use super::*;

    #[test]
    fn latest_report_per_vehicle_waits() {
        let queue = LatestReportQueue::new(1_024);
        let push = |node: &str, kind, seq| {
            let report = Arc::new(ObjectReport::new(
                NodeName::new(node).unwrap(),
                seq,
                Timestamp(seq),
            ));
            queue.push(Delivery::local(
                QueuedReport { kind, report },
                Timestamp(seq),
            ))
        };
        use ReportKind::{Detections, VoteDetections};
        assert_eq!(
            push("mallory", Detections, 0),
            PushOutcome {
                is_first: true,
                has_replaced: false,
                is_over_budget: false
            }
        );
        assert_eq!(
            push("euclid", Detections, 1),
            PushOutcome {
                is_first: false,
                has_replaced: false,
                is_over_budget: false
            }
        );
        for seq in 2..1000 {
            assert_eq!(
                push("mallory", Detections, seq),
                PushOutcome {
                    is_first: false,
                    has_replaced: true,
                    is_over_budget: false
                }
            );
        }
        push("mallory", VoteDetections, 1000);
        let taken: Vec<_> = queue
            .drain()
            .iter()
            .map(|delivery| delivery.received_at.micros())
            .collect();
        assert_eq!(taken, [1, 999, 1000]);
        assert!(push("euclid", Detections, 1001).is_first);
        assert!(
            push("euclid", Detections, 1000).has_replaced,
            "the later capture stays, whichever came first"
        );
        assert_eq!(queue.drain()[0].received_at.micros(), 1001);
    }

    #[test]
    fn vehicle_parts_share_object_budget() {
        let queue = LatestReportQueue::new(1_024);
        let push = |node: &str, at_us: u64, objects: usize| {
            let object = PerceivedObject::new("car", 0.5, 0.0, 0.0);
            let report = ObjectReport {
                objects: vec![object; objects],
                ..ObjectReport::new(NodeName::new(node).unwrap(), at_us, Timestamp(at_us))
            };
            let delivery = QueuedReport {
                kind: ReportKind::Detections,
                report: Arc::new(report),
            };
            !queue
                .push(Delivery::local(delivery, Timestamp(at_us)))
                .is_over_budget
        };
        let start = 1_000_000_000;
        let of_parts = (0..100)
            .filter(|part| push(&format!("mallory--{part}"), start + part, 1000))
            .count();
        assert_eq!(of_parts, OBJECT_BURST as usize / 1000);
        assert!(
            push("mallory", start + 200, 0),
            "a report without objects has no cost"
        );
        assert!(push("euclid", start + 200, 1000));
        assert!(push("mallory", start + 200_000, 1000), "it earns new ones");
        for round in 0..50 {
            let at_us = start + round * 100_000;
            assert!(
                push("noether--left", at_us, 300) && push("noether--right", at_us, 300),
                "an honest vehicle with many objects at 10 Hz is not limited"
            );
        }
    }

    #[test]
    fn seen_locations_cost_budget() {
        let queue = LatestReportQueue::new(1_024);
        let push = |node: &str, at_us: u64, seen: &str| {
            let report = ObjectReport {
                seen: Some(vec![seen.into(); 1024]),
                ..ObjectReport::new(NodeName::new(node).unwrap(), at_us, Timestamp(at_us))
            };
            let delivery = QueuedReport {
                kind: ReportKind::Detections,
                report: Arc::new(report),
            };
            !queue
                .push(Delivery::local(delivery, Timestamp(at_us)))
                .is_over_budget
        };
        let start = 1_000_000_000;
        let long = "x".repeat(64);
        let accepted = (0..100)
            .filter(|number| push("mallory", start + number * 10_000, &long))
            .count();
        assert!((5..8).contains(&accepted), "{accepted} in a second");
        let all = (0..100).all(|number| push("euclid", start + number * 100_000, "slot-1023"));
        assert!(all, "short names of all places at 10 Hz are not limited");
    }
}
