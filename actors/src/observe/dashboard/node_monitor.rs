//! Looks on as the node goes, keeps the history, and makes pictures for whoever looks.

use std::collections::BTreeSet;
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use bytes::Bytes;
use ecod::epoch::Epoch;
use ecod::names::NodeName;
use ecod::time::Timestamp;
use tokio::sync::watch;
use tokio::time::{Instant, Interval, MissedTickBehavior, interval};

use super::history::{History, SAMPLE_PERIOD};
use super::map_latency::MapLatency;
use super::node_sources::NodeSources;
use super::response_cache::{CachedResponse, ResponseCache};
use super::snapshot::{API_VERSION, LeadershipFacts, Snapshot, Stamped, json, nodes};
use crate::messages::gateway::GatewayMessage;
use crate::messages::leadership::Position;
use crate::observe::readiness::{Probe, Readiness};
use crate::platform::clock;
use crate::transport::mqtt::LinkState;

/// What requests are answered from.
#[derive(Debug)]
pub(crate) struct NodeMonitor {
    sources: NodeSources,
    latencies: MapLatency,
    pictures: watch::Sender<Bytes>,
    seen: Mutex<Observed>,
    /// The latest snapshot as a server-sent event.
    event: ResponseCache<Bytes>,
}

#[derive(Debug, Default)]
struct Observed {
    history: History,
    probe: Probe,
    /// Nodes that answer, and those that did and of which brokers tell.
    met: BTreeSet<NodeName>,
}

/// How often the parts are asked how they are.
const PROBE_PERIOD: Duration = Duration::from_millis(500);

/// How often browsers get a snapshot although nothing came in: they take a longer silence for a lost connection.
const HEARTBEAT: Duration = Duration::from_secs(1);

/// Around the JSON of a snapshot in its event.
const EVENT_HEAD: &[u8] = b"event: picture\ndata: ";
const EVENT_END: &[u8] = b"\n\n";

/// A vehicle whose last report is older is no longer shown.
const FORGET_AFTER: Duration = Duration::from_secs(30);

impl NodeMonitor {
    pub(crate) fn new(sources: NodeSources, max_rate_hz: f64) -> Self {
        Self {
            sources,
            latencies: MapLatency::default(),
            pictures: watch::Sender::new(Bytes::new()),
            seen: Mutex::default(),
            event: ResponseCache::new(Duration::from_secs_f64(1.0 / max_rate_hz)),
        }
    }

    /// What the node tells.
    pub(crate) fn sources(&self) -> &NodeSources {
        &self.sources
    }

    /// How late maps came.
    pub(crate) fn latencies(&self) -> &MapLatency {
        &self.latencies
    }

    /// What the node saw over time as JSON, with samples taken later than `time` only.
    pub(crate) fn history_since(&self, time: Timestamp) -> Vec<u8> {
        self.seen().history.json_since(time)
    }

    /// How often the leader changed since the node started.
    pub(crate) fn failovers(&self) -> u64 {
        self.seen().history.failovers
    }

    /// What gateway and broker answered last.
    pub(crate) fn probe(&self) -> Probe {
        self.seen().probe.clone()
    }

    /// Pictures as server-sent events, the latest only, while anyone has such a receiver.
    pub(crate) fn pictures(&self) -> watch::Receiver<Bytes> {
        self.pictures.subscribe()
    }

    /// How many browsers get pictures.
    pub(crate) fn viewers(&self) -> usize {
        self.pictures.receiver_count()
    }

    /// Whether the node is ready.
    pub(crate) fn readiness(&self) -> Readiness {
        self.sources.vitals.readiness(&self.seen().probe)
    }

    /// What the node knows now.
    pub(crate) fn snapshot(&self) -> Snapshot {
        let (sources, now) = (&self.sources, clock::now());
        let readiness = self.readiness();
        let seen = self.seen();
        let history = &seen.history;
        let since = history.reigns.back().filter(|reign| reign.until_us.is_none()).map(|reign| reign.from_us);
        let links = seen.probe.links.iter().flatten().map(|(broker, state)| (broker.to_string(), link_label(*state)));
        let newest_map = sources.vitals.newest.map.borrow().clone();
        Snapshot {
            schema: API_VERSION,
            now_us: now,
            node: sources.node.clone(),
            readiness,
            leadership: LeadershipFacts::new(&sources.vitals.leadership.borrow(), since, history.failovers),
            map: newest_map.map(|newest| Stamped { received_at_us: newest.received_at, message: newest.map }),
            verdicts: sources.vitals.newest.verdicts.borrow().clone().map(Stamped::from),
            reputations: sources.vitals.newest.reputations.borrow().clone().map(Stamped::from),
            vehicles: sources.live_state.sightings_since(now - FORGET_AFTER),
            nodes: nodes(sources, &seen.met, seen.probe.links.as_ref()),
            links: links.collect(),
            counters: sources.counters.snapshot(),
        }
    }

    /// The latest snapshot as a server-sent event, made anew when the last one is old enough.
    pub(crate) fn event(&self) -> Bytes {
        self.made().value
    }

    /// The latest snapshot as JSON.
    pub(crate) fn json(&self) -> Bytes {
        let event = self.event();
        event.slice(EVENT_HEAD.len()..event.len() - EVENT_END.len())
    }

    fn made(&self) -> CachedResponse<Bytes> {
        self.event.get(|| [EVENT_HEAD, &json(&self.snapshot()), EVENT_END].concat().into())
    }

    /// Looks on; ends never.
    pub(crate) async fn run(&self) {
        tokio::join!(self.look_on(), self.ask_on());
    }

    async fn look_on(&self) {
        let mut leadership = self.sources.vitals.leadership.clone();
        let mut maps = self.sources.vitals.newest.map.subscribe();
        let mut verdicts = self.sources.vitals.newest.verdicts.subscribe();
        let mut members = self.sources.members.clone();
        let mut samples = ticks(SAMPLE_PERIOD);
        let (mut next_picture, mut changed, mut pictured) = (Instant::now(), true, Instant::now());
        self.note_leadership();
        self.note_members();
        loop {
            let due = if changed { next_picture } else { (pictured + HEARTBEAT).max(next_picture) };
            tokio::select! {
                Ok(()) = leadership.changed() => {
                    self.note_leadership();
                    self.watch_reports();
                    changed = true;
                }
                Ok(()) = maps.changed() => {
                    self.note_map();
                    changed = true;
                }
                Ok(()) = verdicts.changed() => {
                    self.note_verdicts();
                    changed = true;
                }
                Ok(()) = members.changed() => {
                    self.note_members();
                    changed = true;
                }
                _ = samples.tick() => self.sample(),
                () = tokio::time::sleep_until(due), if self.viewers() > 0 => {
                    let made = self.made();
                    self.pictures.send_replace(made.value);
                    (next_picture, pictured, changed) = (made.next, Instant::now(), false);
                }
            }
        }
    }

    /// Asks the parts how they are; one that does not answer holds up nothing else.
    async fn ask_on(&self) {
        let mut probes = ticks(PROBE_PERIOD);
        loop {
            probes.tick().await;
            let probe = self.sources.vitals.probe().await;
            self.seen().probe = probe;
            self.watch_reports();
        }
    }

    fn note_leadership(&self) {
        let leadership = self.sources.vitals.leadership.borrow().clone();
        self.seen().history.note_leadership(&leadership, clock::now());
    }

    fn note_members(&self) {
        let told = self.sources.live_state.statuses();
        let mut seen = self.seen();
        seen.met.retain(|name| told.contains_key(name));
        seen.met.extend(self.sources.members.borrow().iter().map(|member| member.name.clone()));
    }

    fn note_map(&self) {
        let Some(newest) = self.sources.vitals.newest.map.borrow().clone() else { return };
        let epoch = Epoch::new(newest.map.epoch, newest.map.aggregator.clone());
        self.latencies.observe(newest.map.oldest_capture_us, newest.map.fused_at_us, newest.received_at);
        self.seen().history.note_round(&epoch, newest.map.oldest_capture_us, newest.received_at);
    }

    /// A round's verdicts count for it in a cell without maps.
    fn note_verdicts(&self) {
        let Some(newest) = self.sources.vitals.newest.verdicts.borrow().clone() else { return };
        let map_at = self.sources.vitals.newest.map.borrow().as_ref().map(|map| map.received_at);
        if map_at.is_none_or(|map_at| newest.received_at.since(map_at) > HEARTBEAT) {
            let epoch = Epoch::new(newest.message.epoch, newest.message.aggregator.clone());
            self.seen().history.note_round(&epoch, None, newest.received_at);
        }
    }

    fn sample(&self) {
        let reputations = self.sources.vitals.newest.reputations.borrow().clone();
        self.seen().history.sample(reputations.as_ref().map(|newest| &*newest.message), clock::now());
    }

    /// A node that only follows takes the vehicles' reports while anyone looks.
    fn watch_reports(&self) {
        let wanted = self.viewers() > 0 && self.sources.vitals.leadership.borrow().position == Position::Following;
        if wanted || self.sources.live_state.wants_reports() {
            self.sources.live_state.set_wants_reports(wanted);
            self.sources.vitals.gateway.send(GatewayMessage::WatchReports { wanted });
        }
    }

    fn seen(&self) -> MutexGuard<'_, Observed> {
        self.seen.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

fn ticks(period: Duration) -> Interval {
    let mut ticks = interval(period);
    ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
    ticks
}

fn link_label(state: LinkState) -> &'static str {
    match state {
        LinkState::Up => "up",
        LinkState::Stalled => "stalled",
        LinkState::Down => "down",
        LinkState::Refused => "refused",
    }
}

/// The age of something that came at `received_at`, in seconds.
pub(crate) fn age_s(received_at: Timestamp) -> f64 {
    clock::now().since(received_at).as_secs_f64()
}
