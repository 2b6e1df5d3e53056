//! What passes through the node and is not kept elsewhere: the latest reports of each vehicle, what nodes say of
//! themselves.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering::Relaxed};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use ecod::names::NodeName;
use ecod::time::Timestamp;
use ecod::wire::{NodeStatus, ObjectReport, ReportKind};
use serde::Serialize;

use crate::gateway::Incoming;

/// Written on the links' tasks and read by the dashboard; the later replaces the earlier, so that neither waits for the
/// other.
#[derive(Debug, Default)]
pub struct Feed {
    reports: [AtomicU64; ReportKind::COUNT],
    watches: AtomicBool,
    held: Mutex<Held>,
}

#[derive(Debug, Default)]
struct Held {
    sightings: BTreeMap<(NodeName, ReportKind), Sighting>,
    statuses: BTreeMap<NodeName, Arc<NodeStatus>>,
}

/// A vehicle's latest report of a kind.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Sighting {
    /// What it is for.
    pub kind: ReportKind,
    /// When it came, by this node's clock.
    #[serde(rename = "received_at_us")]
    pub received_at: Timestamp,
    /// The report.
    pub report: Arc<ObjectReport>,
}

/// Most vehicles and most nodes that are kept; further ones are not shown.
pub const MAX_SHOWN: usize = 256;

impl Feed {
    /// Notes what came in or was published by this node.
    pub fn note(&self, message: &Incoming, received_at: Timestamp) {
        match message {
            Incoming::Report { kind, report } => {
                self.reports[*kind as usize].fetch_add(1, Relaxed);
                let sighting = Sighting { kind: *kind, received_at, report: Arc::clone(report) };
                put(&mut self.held().sightings, (report.node.clone(), *kind), sighting);
            }
            Incoming::Status(status) => put(&mut self.held().statuses, status.node.clone(), Arc::clone(status)),
            _ => {}
        }
    }

    /// How many reports of this kind came in.
    pub fn reports(&self, kind: ReportKind) -> u64 {
        self.reports[kind as usize].load(Relaxed)
    }

    /// Whether reports are taken only to be looked at, where the node does not need them itself.
    pub fn watches(&self) -> bool {
        self.watches.load(Relaxed)
    }

    pub(super) fn set_watches(&self, watches: bool) {
        self.watches.store(watches, Relaxed);
    }

    /// The latest reports received at or after a time, by vehicle and kind; older ones are forgotten.
    pub(super) fn sightings_since(&self, time: Timestamp) -> Vec<Sighting> {
        let mut held = self.held();
        held.sightings.retain(|_, sighting| sighting.received_at >= time);
        held.sightings.values().cloned().collect()
    }

    /// What nodes said of themselves last.
    pub(super) fn statuses(&self) -> BTreeMap<NodeName, Arc<NodeStatus>> {
        self.held().statuses.clone()
    }

    fn held(&self) -> MutexGuard<'_, Held> {
        self.held.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

fn put<K: Ord, T>(held: &mut BTreeMap<K, T>, key: K, value: T) {
    if held.len() < MAX_SHOWN || held.contains_key(&key) {
        held.insert(key, value);
    }
}

/// The first level of a kind's topic.
pub(super) fn kind_label(kind: ReportKind) -> &'static str {
    match kind {
        ReportKind::Detections => "detections",
        ReportKind::VoteDetections => "vote_detections",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn report(node: &str, seq: u64) -> Incoming {
        let report = ObjectReport::new(NodeName::new(node).unwrap(), seq, Timestamp(seq));
        Incoming::Report { kind: ReportKind::Detections, report: Arc::new(report) }
    }

    #[test]
    fn the_latest_report_is_kept_and_strangers_find_no_room() {
        let feed = Feed::default();
        for seq in 1..=3 {
            feed.note(&report("euclid", seq), Timestamp(seq));
        }
        for stranger in 0..2 * MAX_SHOWN {
            feed.note(&report(&format!("stranger-{stranger}"), 9), Timestamp(2));
        }
        feed.note(&report("euclid", 4), Timestamp(4));
        assert_eq!(feed.sightings_since(Timestamp(0)).len(), MAX_SHOWN);
        let fresh = feed.sightings_since(Timestamp(4));
        assert_eq!(fresh.iter().map(|s| (s.report.node.as_str(), s.report.seq)).collect::<Vec<_>>(), [("euclid", 4)]);
        assert_eq!(feed.reports(ReportKind::Detections), 4 + 2 * MAX_SHOWN as u64);
        feed.note(&report("gauss", 1), Timestamp(5));
        assert_eq!(feed.sightings_since(Timestamp(5)).len(), 1, "there is room when old ones are forgotten");
    }
}
