//! What passes through the node and is not kept elsewhere: the latest reports of each vehicle, what nodes say of
//! themselves.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::atomic::Ordering::Relaxed;
use std::sync::atomic::{AtomicBool, AtomicU64};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use ecod::names::NodeName;
use ecod::time::Timestamp;
use ecod::wire::{NodeState, NodeStatus, ObjectReport, ReportKind};
use serde::Serialize;

use crate::transport::mqtt::{BrokerAddress, Incoming, LinkState};

/// Written on the links' tasks and read by the dashboard; the later replaces the earlier, so that neither waits for the
/// other.
#[derive(Debug, Default)]
pub struct LiveState {
    reports: [AtomicU64; ReportKind::COUNT],
    wants_reports: AtomicBool,
    held: Mutex<Latest>,
}

#[derive(Debug, Default)]
struct Latest {
    sightings: BTreeMap<(NodeName, ReportKind), LatestReport>,
    statuses: BTreeMap<NodeName, ReportedStatus>,
}

/// What a node said of itself last, or a broker of it.
#[derive(Debug, Clone)]
pub(crate) struct ReportedStatus {
    /// The status.
    pub status: Arc<NodeStatus>,
    /// The brokers that passed on what it said, while the links to them hold.
    pub via: BTreeSet<BrokerAddress>,
    at: Timestamp,
}

/// A vehicle's latest report of a kind.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct LatestReport {
    /// What it is for.
    pub kind: ReportKind,
    /// When it came, by this node's clock.
    #[serde(rename = "received_at_us")]
    pub received_at: Timestamp,
    /// The report.
    pub report: Arc<ObjectReport>,
}

/// Most vehicles and most nodes that are kept. Further ones are shown in place of vehicles that have been silent, and
/// of nodes that are offline or, if none is, spoke longest ago.
pub const MAX_SHOWN: usize = 256;

/// From when on a vehicle that does not report gives way to another.
const SILENCE: Duration = Duration::from_secs(10);

impl LiveState {
    /// Notes what came in or was published by this node.
    pub fn note(&self, message: &Incoming, received_at: Timestamp) {
        match message {
            Incoming::Report { kind, report } => {
                self.reports[*kind as usize].fetch_add(1, Relaxed);
                let sighting = LatestReport { kind: *kind, received_at, report: Arc::clone(report) };
                put(&mut self.held().sightings, (report.node.clone(), *kind), sighting, |held| {
                    let (key, oldest) = held.iter().min_by_key(|(_, old)| old.received_at)?;
                    (received_at.since(oldest.received_at) > SILENCE).then(|| key.clone())
                });
            }
            Incoming::Status { status, via: broker } => {
                let mut held = self.held();
                let mut via = held.statuses.remove(&status.node).map(|told| told.via).unwrap_or_default();
                via.insert(broker.clone());
                let told = ReportedStatus { status: Arc::clone(status), via, at: received_at };
                put(&mut held.statuses, status.node.clone(), told, |held| {
                    let rank = |told: &ReportedStatus| (told.status.state != NodeState::Offline, told.at);
                    held.iter().min_by_key(|(_, told)| rank(told)).map(|(name, _)| name.clone())
                });
            }
            Incoming::Link { broker, state: LinkState::Down | LinkState::Refused } => {
                self.held().statuses.values_mut().for_each(|told| {
                    told.via.remove(broker);
                });
            }
            _ => {}
        }
    }

    /// How many reports of this kind came in.
    pub fn reports(&self, kind: ReportKind) -> u64 {
        self.reports[kind as usize].load(Relaxed)
    }

    /// Whether reports are taken only to be looked at, where the node does not need them itself.
    pub fn wants_reports(&self) -> bool {
        self.wants_reports.load(Relaxed)
    }

    pub(crate) fn set_wants_reports(&self, wants_reports: bool) {
        self.wants_reports.store(wants_reports, Relaxed);
    }

    /// The latest reports received at or after a time, by vehicle and kind; older ones are forgotten.
    pub(crate) fn sightings_since(&self, time: Timestamp) -> Vec<LatestReport> {
        let mut held = self.held();
        held.sightings.retain(|_, sighting| sighting.received_at >= time);
        held.sightings.values().cloned().collect()
    }

    /// What nodes said of themselves last.
    pub(crate) fn statuses(&self) -> BTreeMap<NodeName, ReportedStatus> {
        self.held().statuses.clone()
    }

    fn held(&self) -> MutexGuard<'_, Latest> {
        self.held.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Keeps a value; where there is no room, in place of the one that `gives_way` names.
fn put<K: Ord, T>(held: &mut BTreeMap<K, T>, key: K, value: T, gives_way: impl FnOnce(&BTreeMap<K, T>) -> Option<K>) {
    if held.len() >= MAX_SHOWN
        && !held.contains_key(&key)
        && let Some(oldest) = gives_way(held)
    {
        held.remove(&oldest);
    }
    if held.len() < MAX_SHOWN || held.contains_key(&key) {
        held.insert(key, value);
    }
}

/// The first level of a kind's topic.
pub(crate) fn kind_label(kind: ReportKind) -> &'static str {
    match kind {
        ReportKind::Detections => "detections",
        ReportKind::VoteDetections => "vote_detections",
    }
}

#[cfg(test)]
mod tests {
    use ecod::wire::Role;
    use uuid::Uuid;

    use super::*;

    fn report(node: &str, seq: u64) -> Incoming {
        let report = ObjectReport::new(NodeName::new(node).unwrap(), seq, Timestamp(seq));
        Incoming::Report { kind: ReportKind::Detections, report: Arc::new(report) }
    }

    fn broker(address: &str) -> BrokerAddress {
        address.parse().unwrap()
    }

    #[test]
    fn the_latest_report_is_kept_and_strangers_find_no_room() {
        let live_state = LiveState::default();
        for seq in 1..=3 {
            live_state.note(&report("euclid", seq), Timestamp(seq));
        }
        for stranger in 0..2 * MAX_SHOWN {
            live_state.note(&report(&format!("stranger-{stranger}"), 9), Timestamp(2));
        }
        live_state.note(&report("euclid", 4), Timestamp(4));
        assert_eq!(live_state.sightings_since(Timestamp(0)).len(), MAX_SHOWN);
        let fresh = live_state.sightings_since(Timestamp(4));
        assert_eq!(fresh.iter().map(|s| (s.report.node.as_str(), s.report.seq)).collect::<Vec<_>>(), [("euclid", 4)]);
        assert_eq!(live_state.reports(ReportKind::Detections), 4 + 2 * MAX_SHOWN as u64);
        live_state.note(&report("gauss", 1), Timestamp(5));
        assert_eq!(live_state.sightings_since(Timestamp(5)).len(), 1, "there is room when old ones are forgotten");
    }

    #[test]
    fn nodes_that_left_and_vehicles_that_fell_silent_give_way() {
        let live_state = LiveState::default();
        let status = |node: String, state| {
            let starting = NodeStatus::starting(NodeName::new(node).unwrap(), Uuid::nil(), Role::Cav, "0.1.0");
            Incoming::Status { status: Arc::new(NodeStatus { state, ..starting }), via: broker("10.0.0.2:1883") }
        };
        for n in 0..MAX_SHOWN {
            let state = if n % 2 == 0 { NodeState::Following } else { NodeState::Offline };
            live_state.note(&status(format!("node-{n}"), state), Timestamp(n as u64));
            live_state.note(&report(&format!("node-{n}"), 1), Timestamp(n as u64));
        }
        let later = Timestamp(0) + SILENCE * 2;
        live_state.note(&status("late".into(), NodeState::Following), later);
        live_state.note(&report("late", 1), later);
        let statuses = live_state.statuses();
        let shown = |name: &'static str| statuses.contains_key(&NodeName::from_static(name));
        assert_eq!((shown("late"), shown("node-1"), shown("node-0"), shown("node-3")), (true, false, true, true));
        assert_eq!((statuses.len(), live_state.sightings_since(later).len()), (MAX_SHOWN, 1));
    }
}
