//! Looks on as the node goes, keeps the history, and makes pictures for whoever looks.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use bytes::Bytes;
use ecod::epoch::Epoch;
use ecod::time::Timestamp;
use tokio::sync::watch;
use tokio::time::{Instant, MissedTickBehavior, interval};

use super::history::{History, SAMPLE_PERIOD};
use super::latency::Latencies;
use super::picture::{API_VERSION, LeadershipFacts, Picture, Stamped, nodes};
use super::readiness::{Readiness, patience, readiness};
use super::sources::{Probe, Sources};
use crate::clock;
use crate::gateway::{GatewayMessage, LinkState};
use crate::leader_election::Position;

/// What requests are answered from.
#[derive(Debug)]
pub(super) struct Observer {
    sources: Sources,
    latencies: Latencies,
    pictures: watch::Sender<Bytes>,
    seen: Mutex<Seen>,
}

#[derive(Debug, Default)]
struct Seen {
    history: History,
    probe: Probe,
}

/// How often the parts are asked how they are.
const PROBE_PERIOD: Duration = Duration::from_millis(500);

/// How often browsers get a picture although nothing came in: they take a longer silence for a lost connection.
const HEARTBEAT: Duration = Duration::from_secs(1);

/// Pauses are at least so many times as long as making the picture took, so that large cells cost no more.
const PAUSE_FACTOR: u32 = 20;

/// A vehicle whose last report is older is no longer shown.
const FORGET_AFTER: Duration = Duration::from_secs(30);

impl Observer {
    pub(super) fn new(sources: Sources) -> Self {
        let seen = Mutex::default();
        Self { sources, latencies: Latencies::default(), pictures: watch::Sender::new(Bytes::new()), seen }
    }

    /// What the node tells.
    pub(super) fn sources(&self) -> &Sources {
        &self.sources
    }

    /// How late maps came.
    pub(super) fn latencies(&self) -> &Latencies {
        &self.latencies
    }

    /// What the node saw over time, with samples taken later than `time` only.
    pub(super) fn history_since(&self, time: Timestamp) -> History {
        self.seen().history.since(time)
    }

    /// How often the leader changed since the node started.
    pub(super) fn failovers(&self) -> u64 {
        self.seen().history.failovers
    }

    /// What gateway and broker answered last.
    pub(super) fn probe(&self) -> Probe {
        self.seen().probe.clone()
    }

    /// Pictures as server-sent events, the latest only, while anyone has such a receiver.
    pub(super) fn pictures(&self) -> watch::Receiver<Bytes> {
        self.pictures.subscribe()
    }

    /// How many browsers get pictures.
    pub(super) fn viewers(&self) -> usize {
        self.pictures.receiver_count()
    }

    /// Whether the node is ready.
    pub(super) fn readiness(&self) -> Readiness {
        let works = self.sources.broker_works(&self.seen().probe);
        let period = Duration::from_secs_f64(self.sources.node.round_period_s);
        let leadership = self.sources.leadership.borrow().clone();
        readiness(&leadership, self.sources.last_round().as_ref(), works, patience(period), clock::now())
    }

    /// What the node knows now.
    pub(super) fn picture(&self) -> Picture {
        let (sources, now) = (&self.sources, clock::now());
        let readiness = self.readiness();
        let seen = self.seen();
        let history = &seen.history;
        let since = history.reigns.back().filter(|reign| reign.until_us.is_none()).map(|reign| reign.from_us);
        let links = seen.probe.links.iter().flatten().map(|(broker, state)| (broker.to_string(), link_label(*state)));
        let newest_map = sources.newest.map.borrow().clone();
        Picture {
            schema: API_VERSION,
            now_us: now,
            node: sources.node.clone(),
            readiness,
            leadership: LeadershipFacts::new(&sources.leadership.borrow(), since, history.failovers),
            map: newest_map.map(|newest| Stamped { received_at_us: newest.received_at, message: newest.map }),
            verdicts: sources.newest.verdicts.borrow().clone().map(Stamped::from),
            reputations: sources.newest.reputations.borrow().clone().map(Stamped::from),
            vehicles: sources.feed.sightings_since(now - FORGET_AFTER),
            nodes: nodes(sources),
            links: links.collect(),
            counters: sources.counters.snapshot(),
        }
    }

    /// The picture as a server-sent event.
    pub(super) fn event(&self) -> Bytes {
        let mut event = b"event: picture\ndata: ".to_vec();
        if let Err(error) = serde_json::to_writer(&mut event, &self.picture()) {
            tracing::warn!(%error, "no picture for browsers");
            return Bytes::from_static(b": no picture\n\n");
        }
        event.extend_from_slice(b"\n\n");
        event.into()
    }

    /// Looks on; ends never.
    pub(super) async fn run(self: Arc<Self>, max_rate_hz: f64) {
        let mut leadership = self.sources.leadership.clone();
        let mut maps = self.sources.newest.map.subscribe();
        let mut verdicts = self.sources.newest.verdicts.subscribe();
        let [mut probes, mut samples] = [PROBE_PERIOD, SAMPLE_PERIOD].map(|period| {
            let mut ticks = interval(period);
            ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
            ticks
        });
        let least_pause = Duration::from_secs_f64(1.0 / max_rate_hz);
        let (mut next_picture, mut changed, mut pictured) = (Instant::now(), true, Instant::now());
        self.note_leadership();
        loop {
            let due = if changed { next_picture } else { (pictured + HEARTBEAT).max(next_picture) };
            tokio::select! {
                Ok(()) = leadership.changed() => {
                    leadership.mark_unchanged();
                    self.note_leadership();
                    self.watch_reports();
                    changed = true;
                }
                Ok(()) = maps.changed() => {
                    maps.mark_unchanged();
                    self.note_map();
                    changed = true;
                }
                Ok(()) = verdicts.changed() => {
                    verdicts.mark_unchanged();
                    self.note_verdicts();
                    changed = true;
                }
                _ = probes.tick() => {
                    let probe = self.sources.probe().await;
                    self.seen().probe = probe;
                    self.watch_reports();
                }
                _ = samples.tick() => self.sample(),
                () = tokio::time::sleep_until(due), if self.viewers() > 0 => {
                    let begun = Instant::now();
                    self.pictures.send_replace(self.event());
                    pictured = Instant::now();
                    next_picture = pictured + least_pause.max((pictured - begun) * PAUSE_FACTOR);
                    changed = false;
                }
            }
        }
    }

    fn note_leadership(&self) {
        let leadership = self.sources.leadership.borrow().clone();
        self.seen().history.note_leadership(&leadership, clock::now());
    }

    fn note_map(&self) {
        let Some(newest) = self.sources.newest.map.borrow().clone() else { return };
        let epoch = Epoch::new(newest.map.epoch, newest.map.aggregator.clone());
        self.latencies.observe(newest.map.oldest_capture_us, newest.map.fused_at_us, newest.received_at);
        self.seen().history.note_round(&epoch, newest.map.oldest_capture_us, newest.received_at);
    }

    /// A round's verdicts count for it in a cell without maps.
    fn note_verdicts(&self) {
        let Some(newest) = self.sources.newest.verdicts.borrow().clone() else { return };
        let map_at = self.sources.newest.map.borrow().as_ref().map(|map| map.received_at);
        if map_at.is_none_or(|map_at| newest.received_at.since(map_at) > HEARTBEAT) {
            let epoch = Epoch::new(newest.message.epoch, newest.message.aggregator.clone());
            self.seen().history.note_round(&epoch, None, newest.received_at);
        }
    }

    fn sample(&self) {
        let reputations = self.sources.newest.reputations.borrow().clone();
        self.seen().history.sample(reputations.as_ref().map(|newest| &*newest.message), clock::now());
    }

    /// A node that only follows takes the vehicles' reports while anyone looks.
    fn watch_reports(&self) {
        let wanted = self.viewers() > 0 && self.sources.leadership.borrow().position == Position::Following;
        if wanted || self.sources.feed.watches() {
            self.sources.feed.set_watches(wanted);
            self.sources.gateway.send(GatewayMessage::WatchReports { wanted });
        }
    }

    fn seen(&self) -> MutexGuard<'_, Seen> {
        self.seen.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

fn link_label(state: LinkState) -> &'static str {
    match state {
        LinkState::Up => "up",
        LinkState::Down => "down",
        LinkState::Refused => "refused",
    }
}

/// The age of something that came at `received_at`, in seconds.
pub(super) fn age_s(received_at: Timestamp) -> f64 {
    clock::now().since(received_at).as_secs_f64()
}
