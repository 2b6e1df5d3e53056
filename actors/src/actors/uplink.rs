//! The actor that connects the cell to a region of cells, while its node leads.
//!
//! ```text
//! watches of leadership and newest map ── Update ──> Uplink ── CellMap, CellDescription, NodeStatus ──> region's broker
//! LeaderElection ── SetStatus ───────────────────────> │ ▲
//! Node ── Configure ─────────────────────────────────> │ └── HandleRegionMessage ── RegionInbox ◄── maps of the tiles around ──┘
//!                                                      └── HandleNeighbours ──> Fuser
//! ```
//!
//! - The cell does not depend on the uplink: without the region the cell continues, and maps are
//!   not kept for later.
//! - Only the leader is connected. A new leader connects when it starts to lead, so that a last
//!   will always belongs to a leader.
//! - Retained messages of a former leader may come late. The current leader then repeats its own.

mod config;
mod pace;
mod region_link;

use std::sync::Arc;

use ecod::diagnostics::TroubleKind;
use ecod::leadership::Leadership;
use ecod::model::epoch::Epoch;
use ecod::model::names::NodeName;
use ecod::model::origin::GeographicOrigin;
use ecod::model::quadkey::Quadkey;
use ecod::model::time::Timestamp;
use ecod::neighbours::{MAX_AGE, Neighbours};
use ecod::wire::{
    CellDescription, CellMap, GlobalMap, NodeState, NodeStatus, RegionTopic, SCHEMA_VERSION,
};
use ractor::{Actor, ActorProcessingErr, ActorRef};
use tokio::sync::watch;
use tokio::task::JoinHandle;

pub use config::UplinkConfig;

use self::pace::MapPace;
use self::region_link::{RegionLink, RegionLinkSetup};
use crate::messages::actor_slot::ActorSlot;
use crate::messages::fuser::FuserMessage;
use crate::messages::newest::ReceivedMap;
use crate::messages::uplink::UplinkMessage;
use crate::platform::clock;
use crate::telemetry::counters::{Counters, Event};
use crate::transport::mqtt::link::{LinkId, LinkSink};
use crate::transport::mqtt::region_inbox::{RegionInbox, source};
use crate::transport::mqtt::{BrokerAddress, FromRegion, MqttConfig, Security};

/// Arguments of an uplink's start.
pub struct UplinkArguments {
    /// Name of the cell in the region.
    pub cell: NodeName,
    /// First status of the node. It holds the name and the id of this run.
    pub status: NodeStatus,
    /// Address of the region's broker.
    pub broker: BrokerAddress,
    /// Settings of the uplink, from which the rate of maps is used.
    pub config: UplinkConfig,
    /// Settings of the cell's own connections, for their limits.
    pub mqtt: MqttConfig,
    /// Protection of the connection.
    pub security: Security,
    /// The place of the cell's frame on Earth.
    pub origin: Option<GeographicOrigin>,
    /// The description of the cell.
    pub description: Option<Arc<CellDescription>>,
    /// The newest map of the cell.
    pub newest: watch::Receiver<Option<ReceivedMap>>,
    /// Leadership of the node, which is connected only while it leads.
    pub leadership: watch::Receiver<Leadership>,
    /// Receives the objects of neighbours.
    pub fuser: ActorSlot<FuserMessage>,
    /// Counters of the node, shared by its actors.
    pub counters: Arc<Counters>,
    /// Seed of the jitter between connection attempts.
    pub seed: u64,
}

/// The only owner of the connection to the region.
#[derive(Debug, Default)]
pub struct Uplink;

/// The link, if connected, and the state published on it.
pub struct UplinkState {
    /// Arguments with the current status, origin and description.
    setup: UplinkArguments,
    connection: MqttConfig,
    link: Option<RegionLink>,
    next_link: u64,
    pace: MapPace,
    /// Epoch and round of the map that was published last.
    published: Option<(u64, u64)>,
    /// Epoch and round of this cell's map that was processed last.
    seen: Option<(u64, u64)>,
    /// The neighbours of a cell that has a place on Earth.
    neighbours: Option<Neighbours>,
    /// True if a neighbour's map was accepted since the last message to the fuser.
    has_news: bool,
    watcher: JoinHandle<()>,
}

impl Actor for Uplink {
    type Msg = UplinkMessage;
    type State = UplinkState;
    type Arguments = UplinkArguments;

    async fn pre_start(
        &self,
        myself: ActorRef<Self::Msg>,
        arguments: Self::Arguments,
    ) -> Result<Self::State, ActorProcessingErr> {
        let watcher = tokio::spawn(watch_cell(
            arguments.leadership.clone(),
            arguments.newest.clone(),
            myself.clone(),
        ));
        let mut state = UplinkState::new(arguments, watcher);
        state.update(&myself);
        Ok(state)
    }

    async fn handle(
        &self,
        myself: ActorRef<Self::Msg>,
        message: Self::Msg,
        state: &mut Self::State,
    ) -> Result<(), ActorProcessingErr> {
        match message {
            UplinkMessage::Update => state.update(&myself),
            UplinkMessage::Reconnect => {
                if let Some(link) = &mut state.link {
                    link.reconnect(events_to(&myself));
                }
            }
            UplinkMessage::SetStatus { status } => {
                state.setup.status = status;
                state.publish_status();
            }
            UplinkMessage::Configure {
                origin,
                description,
            } => state.configure(origin, description, &myself),
            UplinkMessage::HandleRegionMessage { delivery } => match delivery.message {
                FromRegion::Map { topic, map } => {
                    state.on_map(&topic, *map, delivery.received_at);
                }
                FromRegion::Status(status) => state.on_neighbour_status(&status),
            },
            UplinkMessage::LinkChanged { event } => {
                let link = state.link.as_mut().filter(|link| link.id() == event.link);
                if link.is_some_and(|link| link.change(event.change)) {
                    state.introduce();
                }
            }
        }
        Ok(())
    }

    async fn post_stop(
        &self,
        _myself: ActorRef<Self::Msg>,
        state: &mut Self::State,
    ) -> Result<(), ActorProcessingErr> {
        state.watcher.abort();
        if let Some(link) = state.link.take() {
            link.close(state.farewell().as_ref()).await;
        }
        Ok(())
    }
}

impl UplinkState {
    fn new(setup: UplinkArguments, watcher: JoinHandle<()>) -> Self {
        Self {
            neighbours: setup
                .origin
                .map(|origin| Neighbours::new(setup.cell.clone(), origin)),
            has_news: false,
            seen: None,
            connection: setup.config.connection(&setup.mqtt),
            pace: MapPace::new(setup.config.max_hz),
            setup,
            link: None,
            next_link: 0,
            published: None,
            watcher,
        }
    }

    /// Connects, disconnects or publishes, depending on the leadership and the newest map.
    fn update(&mut self, myself: &ActorRef<UplinkMessage>) {
        let leads = self.setup.leadership.borrow().is_leading();
        let troubles = self.setup.counters.troubles();
        if leads && self.setup.origin.is_none() {
            troubles.record(TroubleKind::NoOrigin, NO_ORIGIN);
        } else {
            troubles.settle(TroubleKind::NoOrigin, None);
        }
        match (self.setup.origin.filter(|_| leads), self.link.take()) {
            (None, Some(link)) => self.leave(link),
            (Some(origin), None) => {
                self.link = Some(self.connect(Quadkey::of_cell(&origin), myself));
            }
            (Some(_), link) => self.link = link,
            (None, None) => {}
        }
        self.publish_map();
    }

    /// Opens a connection to the region's broker for the cell in this tile. Messages and events
    /// come back as messages to the actor.
    fn connect(&mut self, tile: Quadkey, myself: &ActorRef<UplinkMessage>) -> RegionLink {
        let receiver = myself.clone();
        // An uplink that has ended needs no events.
        let subscriber = Box::new(move |delivery| {
            _ = receiver.cast(UplinkMessage::HandleRegionMessage { delivery });
        });
        let limits = self.connection.limits();
        let counters = Arc::clone(&self.setup.counters);
        let sink = RegionInbox::new(
            self.setup.cell.clone(),
            tile,
            self.setup.status.id,
            limits,
            Arc::clone(&counters),
            subscriber,
        );
        let setup = RegionLinkSetup {
            cell: self.setup.cell.clone(),
            tile,
            config: self.connection.clone(),
            security: self.setup.security.clone(),
            sink: Arc::new(sink),
            counters,
            seed: self.setup.seed,
        };
        let id = LinkId(self.next_link);
        self.next_link += 1;
        self.pace = MapPace::new(self.setup.config.max_hz);
        RegionLink::open(
            id,
            self.setup.broker.clone(),
            setup,
            &self.own_status(),
            events_to(myself),
        )
    }

    /// Closes a link in the background, after a last status unless another node leads already.
    fn leave(&mut self, link: RegionLink) {
        let last = self.farewell();
        tokio::spawn(async move { link.close(last.as_ref()).await });
    }

    /// The last status of a node that leaves the region; `None` if another node leads, because that
    /// node has published its own status.
    fn farewell(&self) -> Option<NodeStatus> {
        let leadership = self.setup.leadership.borrow();
        let is_succeeded = leadership
            .leader()
            .is_some_and(|leader| *leader != self.setup.status.node);
        let gone = || NodeStatus {
            state: NodeState::Offline,
            troubles: Vec::new(),
            ..self.setup.status.clone()
        };
        (!is_succeeded).then(gone)
    }

    /// Publishes the initial messages on a new connection.
    fn introduce(&mut self) {
        self.publish_status();
        if let (Some(link), Some(description)) = (&mut self.link, &self.setup.description) {
            link.publish_description(description);
        }
        self.pace = MapPace::new(self.setup.config.max_hz);
        self.publish_map();
    }

    /// Publishes the node's own status, unless leadership was just lost: the status would contain
    /// the epoch of the next leader.
    fn publish_status(&mut self) {
        let status = self.own_status();
        let leads = self.setup.leadership.borrow().is_leading();
        if let Some(link) = self.link.as_mut().filter(|_| leads) {
            link.publish_status(&status);
        }
    }

    /// The status of the node as the leader.
    fn own_status(&self) -> NodeStatus {
        let leadership = self.setup.leadership.borrow();
        let epoch = leadership
            .epoch
            .as_ref()
            .map_or(self.setup.status.epoch, |epoch| epoch.term);
        let aggregator = Some(self.setup.status.node.clone());
        NodeStatus {
            state: NodeState::Aggregating,
            epoch,
            aggregator,
            ..self.setup.status.clone()
        }
    }

    /// Processes the newest map if it belongs to this leadership and is recent, and publishes it if
    /// it is new and due.
    fn publish_map(&mut self) {
        let now = clock::now();
        let Some(ReceivedMap { received_at, map }) = self.setup.newest.borrow().clone() else {
            return;
        };
        let epoch = Epoch::new(map.epoch, map.aggregator.clone());
        let is_own = map.aggregator == self.setup.status.node
            && self.setup.leadership.borrow().present_epoch() == Some(&epoch);
        if self.link.is_none() || !is_own || now.since(received_at) > MAX_AGE {
            return;
        }
        let order = Some((map.epoch, map.round));
        if order > std::mem::replace(&mut self.seen, order) {
            self.publish_to_neighbours(&map, now);
        }
        let (Some(link), Some(origin)) = (&mut self.link, self.setup.origin) else {
            return;
        };
        if order <= self.published || !self.pace.is_due(now) {
            return;
        }
        self.pace.advance(now);
        // Objects of neighbours are published by their own cells.
        let map = GlobalMap {
            neighbour_objects: Vec::new(),
            ..GlobalMap::clone(&map)
        };
        let schema = SCHEMA_VERSION;
        let cell = self.setup.cell.clone();
        if link.publish_map(
            &CellMap {
                schema,
                cell,
                sent_at_us: now,
                origin,
                map,
            },
            now,
        ) {
            self.published = order;
        }
    }

    /// Applies other settings. If the cell is in another tile now, its messages in the former tile
    /// are removed, if it is connected.
    fn configure(
        &mut self,
        origin: Option<GeographicOrigin>,
        description: Option<Arc<CellDescription>>,
        myself: &ActorRef<UplinkMessage>,
    ) {
        if std::mem::replace(&mut self.setup.origin, origin) != origin {
            self.neighbours = origin.map(|origin| Neighbours::new(self.setup.cell.clone(), origin));
        }
        self.setup.description = description;
        let tile = origin.map(|origin| Quadkey::of_cell(&origin));
        match self.link.take() {
            Some(link) if tile == Some(link.tile()) => self.link = Some(link),
            Some(link) => _ = tokio::spawn(link.withdraw()),
            None => {}
        }
        if let (Some(link), Some(description)) = (&mut self.link, &self.setup.description) {
            link.publish_description(description);
        }
        self.update(myself);
    }

    /// Repeats the node's own status if a last will or a former leader has replaced it.
    fn on_neighbour_status(&mut self, status: &NodeStatus) {
        let own = self.own_status();
        let is_former = (status.epoch, &status.node) < (own.epoch, &own.node);
        if status.state == NodeState::Offline || is_former {
            self.publish_status();
        }
    }

    /// Processes the map of another cell; a map that is not accepted is counted by its reason and
    /// cell.
    fn on_map(&mut self, topic: &RegionTopic, map: CellMap, received_at: Timestamp) {
        let Some(neighbours) = &mut self.neighbours else {
            return;
        };
        let losses = |neighbours: &Neighbours| {
            let losses = neighbours
                .losses()
                .get(&topic.cell)
                .copied()
                .unwrap_or_default();
            losses.outside + losses.refused
        };
        let before = losses(neighbours);
        match neighbours.accept(topic, map, received_at) {
            Ok(()) => {
                self.setup.counters.count(Event::CellMapAccepted);
                self.setup.counters.add(
                    Event::NeighbourRefused,
                    losses(neighbours).saturating_sub(before),
                );
                self.pace.record_neighbour(received_at);
                self.has_news = true;
            }
            Err(reason) => self
                .setup
                .counters
                .reject_message(reason, &source(&topic.cell), || {
                    format!(
                        "map of the cell {} not used: {}",
                        topic.cell,
                        reason.in_words()
                    )
                }),
        }
    }

    /// Sends the objects of other cells to the fuser, once for each own map, so that the next map
    /// contains them.
    fn publish_to_neighbours(&mut self, map: &GlobalMap, now: Timestamp) {
        let Some(neighbours) = &mut self.neighbours else {
            return;
        };
        neighbours.observe_own(map, now);
        if std::mem::take(&mut self.has_news) {
            let objects = neighbours.near(now).into();
            self.setup.fuser.send(FuserMessage::HandleNeighbours {
                objects,
                stated_at: now,
            });
        }
    }
}

/// The cause of [`TroubleKind::NoOrigin`].
const NO_ORIGIN: &str =
    "`uplink.broker` is set, but the cell has no origin: the region cannot place the cell";

/// Callback that sends a link's events to the uplink itself.
fn events_to(uplink: &ActorRef<UplinkMessage>) -> LinkSink {
    let uplink = uplink.clone();
    Arc::new(move |event| uplink.cast(UplinkMessage::LinkChanged { event }).is_ok())
}

/// Wakes the uplink when the leadership or the newest map changes. Ends with either.
async fn watch_cell(
    mut leadership: watch::Receiver<Leadership>,
    mut newest: watch::Receiver<Option<ReceivedMap>>,
    uplink: ActorRef<UplinkMessage>,
) {
    loop {
        let changed = tokio::select! {
            changed = leadership.changed() => changed,
            changed = newest.changed() => changed,
        };
        if changed.is_err() || uplink.cast(UplinkMessage::Update).is_err() {
            return;
        }
    }
}
