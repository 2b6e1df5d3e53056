//! Observation of the node: its history, its health, and the snapshots that browsers get.

use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use bytes::Bytes;
use ecod::leadership::Position;
use ecod::leadership::readiness::Readiness;
use ecod::model::epoch::Epoch;
use tokio::sync::watch;
use tokio::time::{Instant, Interval, MissedTickBehavior, interval};

use super::history::{History, SAMPLE_PERIOD};
use super::map_latency::MapLatency;
use super::node_sources::NodeSources;
use super::response_cache::{CachedResponse, ResponseCache};
use super::snapshot::{API_VERSION, LeadershipFacts, Snapshot, TroubleEntry, json, nodes};
use super::timeline::TimelineFrame;
use crate::messages::gateway::GatewayMessage;
use crate::messages::newest::Received;
use crate::observe::readiness::Probe;
use crate::platform::clock;

/// Source of all answers to browsers.
#[derive(Debug)]
pub(crate) struct NodeMonitor {
    /// Inputs from the node.
    pub(crate) sources: NodeSources,
    /// Latency of all maps so far.
    pub(crate) map_latency: MapLatency,
    snapshots: watch::Sender<Bytes>,
    observed: Mutex<Observed>,
    /// The latest snapshot as a server-sent event.
    event: ResponseCache<Bytes>,
}

/// The stored observations of the monitor.
#[derive(Debug, Default)]
pub(crate) struct Observed {
    /// Terms of leadership and samples.
    pub(crate) history: History,
    /// Latest answers of gateway and broker.
    pub(crate) probe: Probe,
}

/// Time between two probes of gateway and broker.
const PROBE_PERIOD: Duration = Duration::from_millis(500);

/// Maximum time between two snapshots: browsers take a longer silence for a lost connection.
const HEARTBEAT: Duration = Duration::from_secs(1);

/// Time between two updates of the timeline.
const CHECK_PERIOD: Duration = Duration::from_secs(1);

/// Frame of a server-sent event around the JSON of a snapshot.
const EVENT_HEAD: &[u8] = b"event: picture\ndata: ";
const EVENT_END: &[u8] = b"\n\n";

/// Age of a vehicle's last report from which the vehicle is not shown any more.
pub(crate) const MAX_REPORT_AGE: Duration = Duration::from_secs(30);

impl NodeMonitor {
    pub(crate) fn new(sources: NodeSources, max_rate_hz: f64) -> Self {
        Self {
            sources,
            map_latency: MapLatency::default(),
            snapshots: watch::Sender::new(Bytes::new()),
            observed: Mutex::default(),
            event: ResponseCache::new(Duration::from_secs_f64(1.0 / max_rate_hz)),
        }
    }

    /// Latest snapshot as a server-sent event, updated while any such receiver exists.
    pub(crate) fn snapshots(&self) -> watch::Receiver<Bytes> {
        self.snapshots.subscribe()
    }

    /// Number of browsers that receive snapshots.
    pub(crate) fn viewers(&self) -> usize {
        self.snapshots.receiver_count()
    }

    /// Readiness of the node.
    pub(crate) fn readiness(&self) -> Readiness {
        self.sources.vitals.readiness(&self.observed().probe)
    }

    /// The latest snapshot as a server-sent event; a new snapshot is taken once the old one has
    /// expired.
    pub(crate) fn event(&self) -> Bytes {
        self.cached_event().value
    }

    /// The latest snapshot as JSON.
    pub(crate) fn json(&self) -> Bytes {
        let event = self.event();
        event.slice(EVENT_HEAD.len()..event.len() - EVENT_END.len())
    }

    /// Observes the node; does not return.
    pub(crate) async fn run(&self) {
        tokio::join!(self.follow_changes(), self.poll_probes());
    }

    fn cached_event(&self) -> CachedResponse<Bytes> {
        self.event.get(|| {
            [EVENT_HEAD, &json(&self.snapshot()), EVENT_END]
                .concat()
                .into()
        })
    }

    fn snapshot(&self) -> Snapshot {
        let sources = &self.sources;
        let now = clock::now();
        let readiness = self.readiness();
        let newest = &sources.vitals.newest;
        let leadership = sources.vitals.leadership.borrow().clone();
        let map = newest.map.borrow().clone();
        let observed = self.observed();
        let Observed { history, probe } = &*observed;
        let since = history
            .terms
            .back()
            .filter(|term| term.until_us.is_none())
            .map(|term| term.from_us);
        let links = probe
            .links
            .iter()
            .flatten()
            .map(|(broker, state)| (broker.to_string(), state.to_string()));
        Snapshot {
            schema: API_VERSION,
            now_us: now,
            node: sources.node_facts(),
            readiness,
            leadership: LeadershipFacts {
                position: leadership.position,
                leader: leadership.leader().cloned(),
                epoch: leadership.epoch.as_ref().map(|epoch| epoch.term),
                standby: leadership.standby.clone(),
                since_us: since.filter(|_| leadership.leader().is_some()),
                failovers: history.failovers,
            },
            map: map.map(|newest| Received {
                received_at: newest.received_at,
                message: newest.map,
            }),
            verdicts: newest.verdicts.borrow().clone(),
            reputations: newest.reputations.borrow().clone(),
            vehicles: sources.live_state.reports_since(now - MAX_REPORT_AGE),
            nodes: nodes(sources, probe.links.as_ref()),
            links: links.collect(),
            troubles: self.troubles(),
            counters: sources.counters.snapshot(),
        }
    }

    fn troubles(&self) -> Vec<TroubleEntry> {
        let NodeSources {
            node,
            counters,
            live_state,
            vitals,
            ..
        } = &self.sources;
        let leader = vitals.leadership.borrow().leader().cloned();
        let all = live_state
            .troubles(&node.name, leader.as_ref(), counters.troubles().present())
            .into_iter();
        all.map(|(by, trouble)| TroubleEntry {
            told_by: by.unwrap_or_else(|| node.name.clone()),
            trouble,
        })
        .collect()
    }

    async fn follow_changes(&self) {
        let mut leadership = self.sources.vitals.leadership.clone();
        let mut maps = self.sources.vitals.newest.map.subscribe();
        let mut verdicts = self.sources.vitals.newest.verdicts.subscribe();
        let mut members = self.sources.members.clone();
        let mut samples = ticks(SAMPLE_PERIOD);
        let mut checks = ticks(CHECK_PERIOD);
        let mut next_snapshot = Instant::now();
        let mut changed = true;
        let mut sent_at = Instant::now();
        self.on_leadership();
        loop {
            let due = if changed {
                next_snapshot
            } else {
                (sent_at + HEARTBEAT).max(next_snapshot)
            };
            tokio::select! {
                Ok(()) = leadership.changed() => {
                    self.on_leadership();
                    self.request_reports();
                    changed = true;
                }
                Ok(()) = maps.changed() => {
                    self.on_map();
                    changed = true;
                }
                Ok(()) = verdicts.changed() => {
                    self.on_verdicts();
                    changed = true;
                }
                Ok(()) = members.changed() => changed = true,
                _ = samples.tick() => self.sample(),
                _ = checks.tick() => self.extend_timeline(),
                () = tokio::time::sleep_until(due), if self.viewers() > 0 => {
                    let event = self.cached_event();
                    self.snapshots.send_replace(event.value);
                    next_snapshot = event.expires_at;
                    sent_at = Instant::now();
                    changed = false;
                }
            }
        }
    }

    /// Probes gateway and broker. A part that does not answer does not delay other work.
    async fn poll_probes(&self) {
        let mut probes = ticks(PROBE_PERIOD);
        loop {
            probes.tick().await;
            let probe = self.sources.vitals.probe().await;
            self.observed().probe = probe;
            self.request_reports();
        }
    }

    /// Handles a change of the node's leadership: the history gets the new position and epoch, so that
    /// the page shows failovers and gaps.
    fn on_leadership(&self) {
        let leadership = self.sources.vitals.leadership.borrow().clone();
        self.observed()
            .history
            .add_leadership(&leadership, clock::now());
    }

    /// Handles an accepted map: adds its latency to the metrics and its round to the history. Capture
    /// times are converted from the cell's time to the node's clock.
    fn on_map(&self) {
        let Some(newest) = self.sources.vitals.newest.map.borrow().clone() else {
            return;
        };
        let epoch = Epoch::new(newest.map.epoch, newest.map.aggregator.clone());
        let clock = &self.sources.vitals.clock;
        let oldest_capture = newest.map.oldest_capture_us;
        self.map_latency.observe(
            oldest_capture,
            newest.map.fused_at_us,
            clock.date(newest.received_at),
        );
        let captured_at = oldest_capture.map(|date| clock.undate(date));
        self.observed()
            .history
            .add_round(&epoch, captured_at, newest.received_at);
    }

    /// In a cell without maps, verdicts count as the round.
    fn on_verdicts(&self) {
        let Some(newest) = self.sources.vitals.newest.verdicts.borrow().clone() else {
            return;
        };
        let map_at = self
            .sources
            .vitals
            .newest
            .map
            .borrow()
            .as_ref()
            .map(|map| map.received_at);
        if map_at.is_none_or(|map_at| newest.received_at.since(map_at) > HEARTBEAT) {
            let epoch = Epoch::new(newest.message.epoch, newest.message.aggregator.clone());
            self.observed()
                .history
                .add_round(&epoch, None, newest.received_at);
        }
    }

    fn sample(&self) {
        let reputations = self.sources.vitals.newest.reputations.borrow().clone();
        self.observed().history.sample(
            reputations.as_ref().map(|newest| &*newest.message),
            clock::now(),
        );
    }

    /// Adds new events and the newest map to the timeline.
    fn extend_timeline(&self) {
        let sources = &self.sources;
        let now = clock::now();
        let troubles = self.troubles();
        let newest = &sources.vitals.newest;
        let map = newest.map.borrow().clone().map(|newest| Received {
            received_at: newest.received_at,
            message: newest.map,
        });
        let verdicts = newest.verdicts.borrow().clone();
        let received = [
            map.as_ref().map(|map| map.received_at),
            verdicts.as_ref().map(|it| it.received_at),
        ];
        let mut observed = self.observed();
        let Observed { history, probe } = &mut *observed;
        let nodes = nodes(sources, probe.links.as_ref())
            .into_iter()
            .filter(|node| node.alive);
        history
            .timeline
            .nodes(nodes.map(|node| node.name).collect(), now);
        history.timeline.troubles(
            troubles
                .iter()
                .map(|entry| (&entry.told_by, &entry.trouble)),
            now,
        );
        if let Some(reputations) = &*newest.reputations.borrow() {
            history.timeline.reputations(&reputations.message, now);
        }
        if let Some(now_us) = received.into_iter().flatten().max() {
            let vehicles = || sources.live_state.reports_since(now - MAX_REPORT_AGE);
            let frame = || {
                json(&TimelineFrame {
                    now_us,
                    map,
                    verdicts,
                    vehicles: vehicles(),
                })
            };
            history.timeline.frames.push(now_us, frame);
        }
    }

    /// Makes a node that only follows receive the vehicles' reports while a browser shows them.
    fn request_reports(&self) {
        let wanted = self.viewers() > 0
            && self.sources.vitals.leadership.borrow().position == Position::Following;
        if wanted || self.sources.live_state.wants_reports() {
            self.sources.live_state.set_wants_reports(wanted);
            let wanted = self.sources.live_state.wants_reports();
            self.sources
                .vitals
                .gateway
                .send(GatewayMessage::WatchReports { wanted });
        }
    }

    /// Locks the memory; not to be held across an await.
    pub(crate) fn observed(&self) -> MutexGuard<'_, Observed> {
        self.observed.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

fn ticks(period: Duration) -> Interval {
    let mut ticks = interval(period);
    ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
    ticks
}
