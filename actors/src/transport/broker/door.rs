//! The local broker of a node: programs on the node's machine exchange messages with the cell
//! through it, independent of which node leads.
//!
//! ```text
//! Follower, Gateway ── what the node accepted ──> Door ──> `$door/` + topic ──> programs
//! program ── SUBSCRIBE a filter ────────────────> `$door/` + filter
//! program ── report in the node's name ─────────> checked ──> Gateway ──> leader, standby, this node
//! program ── boxes ───> projected to a report ──> Gateway, or this broker for a vehicle without a node
//! ```
//!
//! The brokers of leader and standby also carry the raw messages of all nodes. Programs have their
//! own topics there: the broker puts `$door/` in front of their filters and removes it from the
//! messages that it delivers. Wildcards of other clients don't match these topics.

mod programs;
mod refusals;

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use bytes::Bytes;
use ecod::admission::recent_reports::RecentReports;
use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ecod::perception::box_projection::ProjectedBoxes;
use ecod::wire::{
    BoxReport, CellDescription, Encoding, Limits, NodeStatus, ObjectReport, Payload, ReportKind,
    Reputations, Topic, Topics, encode,
};
use rmqtt::codec::v5::PublishProperties;
use rmqtt::context::ServerContext;
use rmqtt::session::SessionState;
use rmqtt::types::{ClientId, CodecPublish, From, Id, QoS, TopicFilter};
use tokio::sync::mpsc;

use self::refusals::Refusals;
use crate::platform::clock;
use crate::platform::throttle::{KeyedThrottle, TokenBucket};
use crate::telemetry::counters::{Counters, Event};

pub(super) use self::programs::{BoxRoute, DoorHooks, TopicPlace};
pub(super) use self::refusals::DoorRefusal;

/// The node of a local broker, and its connections to the cell.
pub struct DoorSetup {
    /// Name of the node.
    pub node: NodeName,
    /// Client id of the node's own gateway.
    pub gateway_id: String,
    /// Topics of the cell, by which messages are routed.
    pub topics: Topics,
    /// Limits of the messages that the node accepts.
    pub limits: Limits,
    /// Encoding of messages to programs.
    pub encoding: Encoding,
    /// Maximum number of reports of a vehicle and kind that the cell accepts per second. Half of
    /// them are for programs.
    pub max_report_hz: u32,
    /// True if other nodes have links to this broker.
    pub serves_nodes: bool,
    /// True if the node only follows, so that its broker does not carry the cell's reports.
    pub follows: Arc<dyn Fn() -> bool + Send + Sync>,
    /// True if the cell uses reports of this kind.
    pub fuses: Arc<dyn Fn(ReportKind) -> bool + Send + Sync>,
    /// True if another node has this name.
    pub is_member: Arc<dyn Fn(&NodeName) -> bool + Send + Sync>,
    /// Projects the boxes in a program's image.
    pub project: Arc<dyn Fn(&BoxReport) -> ProjectedBoxes + Send + Sync>,
    /// Processes a program's report for the cell.
    pub report: Arc<dyn Fn(ReportKind, Arc<ObjectReport>) + Send + Sync>,
    /// Sets the cell's description, given as TOML, or returns the reason for refusing it.
    pub describe: Arc<dyn Fn(String) -> Result<(), String> + Send + Sync>,
    /// Dismisses a missing node for the whole cell, or returns the reason for refusing it.
    pub dismiss: Arc<dyn Fn(NodeName) -> Result<(), String> + Send + Sync>,
    /// Starts or stops receiving the reports of all vehicles.
    pub watch_reports: Arc<dyn Fn(bool) + Send + Sync>,
    /// Counters of the node, shared by its actors.
    pub counters: Arc<Counters>,
}

/// Handle of a node's local broker. By default there is none, and all messages are dropped.
#[derive(Clone, Default)]
pub struct Door(Option<Arc<DoorState>>);

struct DoorState {
    setup: DoorSetup,
    /// Queue to the broker's current run.
    queue: Mutex<Option<mpsc::Sender<Publication>>>,
    /// Last message of each topic that is retained, for the broker's next run.
    retained: Mutex<BTreeMap<String, Bytes>>,
    /// Topics of these that are missing in the broker's current run because its queue was full.
    unsent: Mutex<BTreeSet<String>>,
    /// Filters of programs, and whether they match reports.
    filters: Mutex<BTreeMap<(ClientId, TopicFilter), bool>>,
    has_readers: AtomicBool,
    wants_reports: AtomicBool,
    watches_reports: AtomicBool,
    recent_reports: Mutex<RecentReports>,
    throttles: [Mutex<TokenBucket>; ReportKind::COUNT],
    /// Limits the boxes of vehicles without a node.
    nodeless_boxes: Mutex<KeyedThrottle<NodeName>>,
    descriptions: Mutex<TokenBucket>,
    /// Parts of the node that report, and when they last did.
    parts: Mutex<BTreeMap<NodeName, Timestamp>>,
    /// Vehicles without a node whose status is retained.
    nodeless: Mutex<BTreeSet<NodeName>>,
    refusals: Mutex<Refusals>,
}

/// A message that the broker itself publishes.
struct Publication {
    place: TopicPlace,
    topic: String,
    payload: Bytes,
    retain: bool,
}

/// Messages that wait for the broker's thread; more are dropped and counted.
const MAX_WAITING: usize = 256;

/// Minimum time between two descriptions from programs, beyond a burst: each is checked, saved and
/// sent to all nodes.
const DESCRIPTION_INTERVAL: Duration = Duration::from_secs(1);

const DESCRIPTION_BURST: u32 = 8;

/// Time after which a silent part may be replaced by another.
const PART_RETENTION: Duration = Duration::from_secs(10);

/// Maximum number of vehicles without a node whose statuses are retained. Programs may use any
/// number of names.
const MAX_NODELESS: usize = 256;

/// Maximum number of topics whose last message is retained: enough for all nodes of a cell.
const MAX_RETAINED: usize = 8192;

impl Door {
    /// Creates the handle of a node's local broker.
    pub fn new(setup: DoorSetup) -> Self {
        let per_second = (setup.max_report_hz / 2).max(1);
        let interval = Duration::from_secs(1) / per_second;
        let now = clock::now();
        Self(Some(Arc::new(DoorState {
            throttles: std::array::from_fn(|_| {
                Mutex::new(TokenBucket::new(per_second, interval, now))
            }),
            descriptions: Mutex::new(TokenBucket::new(
                DESCRIPTION_BURST,
                DESCRIPTION_INTERVAL,
                now,
            )),
            nodeless_boxes: Mutex::new(KeyedThrottle::per_second(setup.max_report_hz)),
            setup,
            queue: Mutex::default(),
            retained: Mutex::default(),
            unsent: Mutex::default(),
            filters: Mutex::default(),
            has_readers: AtomicBool::new(false),
            wants_reports: AtomicBool::new(false),
            watches_reports: AtomicBool::new(false),
            recent_reports: Mutex::default(),
            parts: Mutex::default(),
            nodeless: Mutex::default(),
            refusals: Mutex::default(),
        })))
    }

    /// Forwards a map or verdicts that the node accepted.
    pub fn publish_round<T: Payload>(&self, topic: &Topic, round: &T) {
        let Some(door) = &self.0 else { return };
        if door.has_readers.load(Ordering::Relaxed) {
            door.send(door.publication(topic, round, false));
        }
    }

    /// Forwards reputations that the node accepted; the last ones are retained.
    pub fn publish_reputations(&self, reputations: &Reputations) {
        self.publish_state(&Topic::Reputations, reputations);
    }

    /// Forwards the node's current description of the cell; the last one is retained.
    pub fn publish_description(&self, description: &CellDescription) {
        self.publish_state(&Topic::Cell, description);
    }

    /// Forwards the status of a node; the last status of each node is retained.
    pub fn publish_status(&self, status: &NodeStatus) {
        self.publish_state(&Topic::Nodes(status.node.clone()), status);
    }

    /// Forwards a vehicle's report once, although it may arrive over two links.
    pub fn publish_report(&self, kind: ReportKind, report: &ObjectReport) {
        let Some(door) = self
            .0
            .as_ref()
            .filter(|door| door.wants_reports.load(Ordering::Relaxed))
        else {
            return;
        };
        if lock(&door.recent_reports).is_new(kind, report) {
            door.send(door.publication(&kind.topic(report.node.clone()), report, false));
        }
    }

    /// Makes a node that only follows receive reports while a program reads them. Called
    /// repeatedly, because the gateway may have been restarted.
    pub fn request_reports(&self, follows: bool) {
        let Some(door) = &self.0 else { return };
        let wanted = follows && door.wants_reports.load(Ordering::Relaxed);
        if door.watches_reports.swap(wanted, Ordering::Relaxed) || wanted {
            (door.setup.watch_reports)(wanted);
        }
    }

    fn publish_state<T: Payload>(&self, topic: &Topic, state: &T) {
        if let Some(door) = &self.0 {
            door.retain(door.publication(topic, state, true));
        }
    }

    /// Publishes to the broker's current run, on the broker's thread; does not return.
    pub(super) async fn run(self, context: ServerContext) {
        let Some(door) = self.0 else {
            return std::future::pending().await;
        };
        let (sender, mut queue) = mpsc::channel(MAX_WAITING);
        *lock(&door.queue) = Some(sender);
        let before: Vec<_> = lock(&door.retained).clone().into_iter().collect();
        let from = From::from_system(Id::new(
            context.node.id(),
            0,
            None,
            None,
            "door".into(),
            None,
        ));
        let publish = async |Publication {
                                 place,
                                 topic,
                                 payload,
                                 retain,
                             }| {
            let topic = place.topic(&topic).into();
            let qos = QoS::AtMostOnce;
            // See `InFlightMeter`.
            let properties = Some(PublishProperties::default());
            let packet = CodecPublish {
                dup: false,
                retain,
                qos,
                topic,
                packet_id: None,
                payload,
                properties,
            };
            if let Err(error) =
                SessionState::forwards(&context, from.clone(), packet.into(), false, None).await
            {
                tracing::debug!(%error, "not published at the door");
            }
        };
        for (topic, payload) in before {
            publish(Publication {
                place: TopicPlace::Door,
                topic,
                payload,
                retain: true,
            })
            .await;
        }
        while let Some(publication) = queue.recv().await {
            publish(publication).await;
            while queue.is_empty()
                && let Some(late) = door.next_unsent()
            {
                publish(late).await;
            }
        }
        std::future::pending::<()>().await;
    }
}

impl fmt::Debug for Door {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("Door")
            .field(&self.0.as_ref().map(|door| &door.setup.node))
            .finish()
    }
}

impl DoorState {
    fn publication<T: Payload>(&self, topic: &Topic, payload: &T, retain: bool) -> Publication {
        let payload = encode(payload, self.setup.encoding).into();
        Publication {
            place: TopicPlace::Door,
            topic: self.setup.topics.path(topic),
            payload,
            retain,
        }
    }

    /// Publishes a state that differs from the last one. One vehicle may have any number of parts,
    /// so parts use at most half of the room.
    fn retain(&self, publication: Publication) {
        let mut retained = lock(&self.retained);
        let is_known = retained.contains_key(&publication.topic);
        let topic = self.setup.topics.parse(&publication.topic);
        let is_of_part = matches!(topic, Some(Topic::Nodes(name)) if name.vehicle() != name);
        let room = if is_of_part {
            MAX_RETAINED / 2
        } else {
            MAX_RETAINED
        };
        if retained.get(&publication.topic) == Some(&publication.payload)
            || (!is_known && retained.len() >= room)
        {
            return;
        }
        let topic = publication.topic.clone();
        retained.insert(topic.clone(), publication.payload.clone());
        if !self.send(publication) {
            lock(&self.unsent).insert(topic);
        }
    }

    /// The next retained message that could not be sent before, with its current content.
    fn next_unsent(&self) -> Option<Publication> {
        let topic = lock(&self.unsent).pop_first()?;
        let payload = lock(&self.retained).get(&topic)?.clone();
        Some(Publication {
            place: TopicPlace::Door,
            topic,
            payload,
            retain: true,
        })
    }

    /// Passes a message to the broker's current run, if there is one; returns false if it has no
    /// room.
    fn send(&self, publication: Publication) -> bool {
        let queue = lock(&self.queue);
        let has_room = queue
            .as_ref()
            .is_none_or(|queue| queue.try_send(publication).is_ok());
        if !has_room {
            self.setup.counters.count(Event::PublishRefused);
        }
        has_room
    }

    /// Records the filters of programs, so that messages without a reader are not even encoded.
    fn change_filters(&self, change: impl FnOnce(&mut BTreeMap<(ClientId, TopicFilter), bool>)) {
        let mut filters = lock(&self.filters);
        change(&mut filters);
        self.has_readers
            .store(!filters.is_empty(), Ordering::Relaxed);
        let wants_reports = filters.values().any(|of_reports| *of_reports);
        if self.wants_reports.swap(wants_reports, Ordering::Relaxed) && !wants_reports {
            *lock(&self.recent_reports) = RecentReports::default();
        }
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
