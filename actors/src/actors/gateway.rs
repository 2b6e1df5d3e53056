//! The actor that owns all MQTT connections of a node.
//!
//! A link is kept to every broker it is told of: usually the aggregator's and its standby's, so that a change of
//! aggregator costs no connecting. Every payload is encoded once and sent on every link.
//!
//! ```text
//! other actors ── PublishReport, PublishMap, … ──> Gateway ── try_publish ──> link ── MQTT ──> broker
//!        ▲                                            │ own map, own report: in-process          │
//!        └───────────── Subscriber ◄──────────────────┴─── Inbox ◄── link task ◄── MQTT ─────────┘
//! ```
//!
//! - Nothing waits: a link that is down or full refuses, which is counted. A new connection starts with an empty queue,
//!   so nothing old is delivered late.
//! - Packets are decoded on the link's own task; a payload that cannot be used is a counter, never an error.
//! - What a node publishes and also subscribes to reaches its own receivers in-process; the broker's echo is dropped.
//! - `nodes/<node>` is published on every connection before anything else and has `offline` as last will.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use bytes::Bytes;
use ecod::names::NodeName;
use ecod::wire::{Encoding, NodeState, NodeStatus, Payload, Topic, Topics, encode};
use ractor::{Actor, ActorProcessingErr, ActorRef};
use tracing::Span;
use uuid::Uuid;

pub use ecod::wire::ReportKind;

use crate::messages::gateway::GatewayMessage;
use crate::platform::clock;
use crate::telemetry::counters::{Counters, Event};
use crate::transport::mqtt::connection::{LastWill, Retention, offline_payload};
use crate::transport::mqtt::inbox::Inbox;
use crate::transport::mqtt::link::{Link, LinkChange, LinkId, LinkSetup, LinkSink};
use crate::transport::mqtt::subscription_role::REPORTS;
use crate::transport::mqtt::{
    BrokerAddress, Incoming, LinkEvent, LinkState, MqttConfig, Security, Subscriber, SubscriptionRole,
};

/// What a gateway needs to know at its start.
pub struct GatewayArguments {
    /// The cell's name.
    pub cell: NodeName,
    /// Which topics to take.
    pub role: SubscriptionRole,
    /// What the node says about itself until told otherwise; names the node and this run of it.
    pub status: NodeStatus,
    /// Protocol, credentials and limits.
    pub mqtt: MqttConfig,
    /// Certificates and signatures.
    pub security: Security,
    /// The node's counters.
    pub counters: Arc<Counters>,
    /// Gets every message.
    pub subscriber: Subscriber,
    /// Seed of the jitter of reconnecting.
    pub seed: u64,
}

/// The only owner of MQTT clients.
#[derive(Debug, Default)]
pub struct Gateway;

/// The links and what is sent on them.
#[derive(Debug)]
pub struct GatewayState {
    topics: Topics,
    role: SubscriptionRole,
    encoding: Encoding,
    report_brokers: Option<Vec<BrokerAddress>>,
    /// Whether reports are taken from every broker.
    watches_reports: bool,
    status: NodeStatus,
    status_topic: String,
    status_payload: Bytes,
    links: BTreeMap<LinkId, Link>,
    next_link: u64,
    /// Topics whose last payload was not sent for its size.
    too_large: BTreeSet<String>,
    /// Other living runs of this node's name.
    namesakes: BTreeSet<Uuid>,
    setup: Arc<LinkSetup>,
}

/// How long a broker may take to accept the farewell.
const LEAVE_TIMEOUT: Duration = Duration::from_millis(300);

impl Actor for Gateway {
    type Msg = GatewayMessage;
    type State = GatewayState;
    type Arguments = GatewayArguments;

    async fn pre_start(
        &self,
        _myself: ActorRef<Self::Msg>,
        arguments: Self::Arguments,
    ) -> Result<Self::State, ActorProcessingErr> {
        arguments.mqtt.validate()?;
        Ok(GatewayState::new(arguments))
    }

    async fn handle(
        &self,
        myself: ActorRef<Self::Msg>,
        message: Self::Msg,
        state: &mut Self::State,
    ) -> Result<(), ActorProcessingErr> {
        let inbox = Arc::clone(&state.setup.inbox);
        match message {
            GatewayMessage::SetBrokers { addresses } => state.set_brokers(addresses, &myself),
            GatewayMessage::SetReportBrokers { addresses } => state.report_brokers = Some(addresses),
            GatewayMessage::WatchReports { wanted } => state.watch_reports(wanted),
            GatewayMessage::SetSubscriber { subscriber } => inbox.set_subscriber(subscriber),
            GatewayMessage::PublishReport { kind, report } => {
                publishing().in_scope(|| state.publish(&kind.topic(report.node.clone()), &*report, Retention::Transient));
                inbox.deliver_local(Incoming::Report { kind, report });
            }
            GatewayMessage::PublishMap { map } => {
                publishing().in_scope(|| state.publish(&Topic::GlobalDetections, &*map, Retention::Transient));
                links_first().await;
                inbox.deliver_local(Incoming::Map(map));
            }
            GatewayMessage::PublishVerdicts { verdicts } => {
                publishing().in_scope(|| state.publish(&Topic::GlobalVerdicts, &*verdicts, Retention::Transient));
                links_first().await;
                inbox.deliver_local(Incoming::Verdicts(verdicts));
            }
            GatewayMessage::PublishReputations { reputations } => {
                state.publish(&Topic::Reputations, &*reputations, Retention::Retained);
                inbox.deliver_local(Incoming::Reputations(reputations));
            }
            GatewayMessage::PublishShare { share } => {
                state.publish(&Topic::Ledger(share.node.clone()), &share, Retention::Transient);
            }
            GatewayMessage::PublishStatus { status } => state.set_status(status),
            GatewayMessage::Links { reply } => {
                let links = state.links.values().map(|link| (link.broker.clone(), link.state)).collect();
                if reply.send(links).is_err() {
                    tracing::debug!("nobody waited for the state of the links");
                }
            }
            GatewayMessage::LinkChanged { event } => state.link_changed(event),
        }
        Ok(())
    }

    async fn post_stop(&self, _myself: ActorRef<Self::Msg>, state: &mut Self::State) -> Result<(), ActorProcessingErr> {
        state.set_status(NodeStatus { state: NodeState::Offline, ..state.status.clone() });
        for link in std::mem::take(&mut state.links).into_values() {
            link.leave(LEAVE_TIMEOUT).await;
        }
        Ok(())
    }
}

/// Encoding and handing to the links, as part of a frame's or a round's way.
fn publishing() -> Span {
    tracing::info_span!("publish")
}

/// Lets the links' tasks send what was just published before this node's own parts work on it.
async fn links_first() {
    tokio::task::yield_now().await;
}

impl GatewayState {
    fn new(arguments: GatewayArguments) -> Self {
        let GatewayArguments { cell, role, status, mqtt, security, counters, subscriber, seed } = arguments;
        let topics = Topics::new(&cell);
        let encoding = mqtt.encoding;
        let status_topic = topics.path(&Topic::Nodes(status.node.clone()));
        let filters = role.filters().iter().map(|level| topics.filter(level)).collect();
        let seal = |payload: Bytes| sealed(&security, &status_topic, payload);
        let will = LastWill { topic: status_topic.clone(), payload: seal(offline_payload(&status, encoding)) };
        let status_payload = seal(encode(&status, encoding).into());
        let inbox = Inbox::new(
            (status.node.clone(), status.id),
            topics.clone(),
            (mqtt.limits(), security.signing.clone()),
            (mqtt.inbox, mqtt.max_report_hz),
            Arc::clone(&counters),
            subscriber,
        );
        // One id for a run of the node: a broker that still holds the last connection ends it before it takes the next,
        // so that the will comes before the new status.
        let client_id = format!("{}-{}", status.node, status.id.simple());
        let (will, inbox) = (Mutex::new(will), Arc::new(inbox));
        let setup = LinkSetup { client_id, filters, will, config: mqtt, security, inbox, counters, seed };
        Self {
            report_brokers: None,
            watches_reports: false,
            topics,
            role,
            encoding,
            status_payload,
            status,
            status_topic,
            links: BTreeMap::new(),
            next_link: 0,
            too_large: BTreeSet::new(),
            namesakes: BTreeSet::new(),
            setup: Arc::new(setup),
        }
    }

    fn set_brokers(&mut self, addresses: Vec<BrokerAddress>, myself: &ActorRef<GatewayMessage>) {
        let mut wanted: BTreeSet<_> = addresses.into_iter().collect();
        let gone: Vec<_> = self.links.extract_if(.., |_, link| !wanted.remove(&link.broker)).collect();
        for (_, link) in gone {
            // The status is taken back: this node lives on, but that broker will not hear of it.
            if let Some(client) = &link.client {
                client.publish(&self.status_topic, &Bytes::new(), Retention::Retained);
            }
            tokio::spawn(link.leave(LEAVE_TIMEOUT));
        }
        for broker in wanted {
            let id = LinkId(self.next_link);
            self.next_link += 1;
            self.links.insert(id, Link::spawn(id, broker, Arc::clone(&self.setup), events_to(myself)));
        }
    }

    fn filters(&self, broker: &BrokerAddress) -> Vec<String> {
        let reports = self.watches_reports || self.takes_reports_of(broker);
        let wanted = |level: &&&str| reports || !REPORTS.contains(*level);
        self.role.filters().iter().filter(wanted).map(|level| self.topics.filter(level)).collect()
    }

    /// Whether this node needs the reports that go to this broker, whoever else watches them.
    fn takes_reports_of(&self, broker: &BrokerAddress) -> bool {
        match self.role {
            SubscriptionRole::Candidate => self.report_brokers.as_ref().is_none_or(|brokers| brokers.contains(broker)),
            SubscriptionRole::Observer => true,
            SubscriptionRole::Follower => false,
        }
    }

    fn watch_reports(&mut self, wanted: bool) {
        if self.watches_reports == wanted {
            return;
        }
        self.watches_reports = wanted;
        let reports = REPORTS.map(|level| self.topics.filter(level));
        for link in self.links.values().filter(|link| !self.takes_reports_of(&link.broker)) {
            let told = link.client.as_ref().map(|client| match wanted {
                true => client.subscribe(&self.filters(&link.broker)),
                false => client.unsubscribe(&reports),
            });
            tracing::debug!(broker = %link.broker, wanted, ?told, "reports to be looked at");
        }
    }

    fn set_status(&mut self, status: NodeStatus) {
        let seal = |payload: Bytes| sealed(&self.setup.security, &self.status_topic, payload);
        self.status_payload = seal(encode(&status, self.encoding).into());
        let will = seal(offline_payload(&status, self.encoding));
        self.setup.will.lock().unwrap_or_else(PoisonError::into_inner).payload = will;
        self.status = status;
        self.send(&self.status_topic, &self.status_payload, Retention::Retained);
    }

    fn publish<T: Payload>(&mut self, topic: &Topic, payload: &T, retention: Retention) {
        let payload = Bytes::from(encode(payload, self.encoding));
        let path = self.topics.path(topic);
        if self.fits::<T>(&path, &payload) {
            let payload = sealed(&self.setup.security, &path, payload);
            self.send(&path, &payload, retention);
            self.expect_back(topic);
        }
    }

    /// Notes on which links what was just sent should come back, and which broker passes nothing on any more.
    fn expect_back(&mut self, topic: &Topic) {
        let now = clock::now();
        let of_all = matches!(topic, Topic::GlobalDetections | Topic::GlobalVerdicts);
        let of_one = matches!(topic, Topic::Detections(_) | Topic::VoteDetections(_))
            && self.role == SubscriptionRole::Candidate;
        let reports: Vec<_> = self.links.values().map(|link| of_one && self.takes_reports_of(&link.broker)).collect();
        for (link, reports) in self.links.values_mut().zip(reports) {
            if (of_all || reports) && link.state == LinkState::Up && link.misses_echo(now) {
                link.state = LinkState::Stalled;
                tell_state(&self.setup.inbox, link);
            }
        }
    }

    /// Whether receivers with this node's limits take the payload. One beyond them would cost links, or be dropped by
    /// every receiver without a word here; the first in a row is told of.
    fn fits<T: Payload>(&mut self, topic: &str, payload: &Bytes) -> bool {
        let limit = T::max_bytes(&self.setup.config.limits());
        if payload.len() <= limit {
            self.too_large.remove(topic);
            return true;
        }
        self.setup.counters.count(Event::PublishTooLarge);
        if self.too_large.insert(topic.to_owned()) {
            tracing::warn!(
                topic,
                bytes = payload.len(),
                limit,
                "payload too large to be sent, raise the limit in [mqtt]"
            );
        }
        false
    }

    fn send(&self, topic: &str, payload: &Bytes, retention: Retention) {
        for link in self.links.values() {
            let sent = link.client.as_ref().is_some_and(|client| client.publish(topic, payload, retention));
            self.setup.counters.count(if sent { Event::Published } else { Event::PublishRefused });
        }
    }

    fn link_changed(&mut self, LinkEvent { link: id, change }: LinkEvent) {
        // Computed for the one event that needs them.
        let filters = match &change {
            LinkChange::Accepted(_) => self.links.get(&id).map_or_else(Vec::new, |link| self.filters(&link.broker)),
            _ => Vec::new(),
        };
        let Some(link) = self.links.get_mut(&id) else { return };
        let state = match change {
            LinkChange::Accepted(client) => {
                // The queue of a new connection is empty, so that both fit.
                client.publish(&self.status_topic, &self.status_payload, Retention::Retained);
                client.subscribe(&filters);
                link.client = Some(client);
                LinkState::Up
            }
            LinkChange::DeclaredOffline => {
                tracing::warn!(broker = %link.broker, "broker took this node for dead");
                if let Some(client) = &link.client {
                    client.publish(&self.status_topic, &self.status_payload, Retention::Retained);
                }
                return;
            }
            LinkChange::Namesake(run) => {
                // Answered once for each, so that both know and neither goes on for ever.
                if self.namesakes.len() < MAX_NAMESAKES && self.namesakes.insert(run) {
                    let node = &self.status.node;
                    tracing::warn!(broker = %link.broker, %node, %run, "another living node has this node's name, rename one");
                    if let Some(client) = &link.client {
                        client.publish(&self.status_topic, &self.status_payload, Retention::Retained);
                    }
                }
                return;
            }
            LinkChange::Answered if link.state == LinkState::Stalled => LinkState::Up,
            LinkChange::Answered => return,
            LinkChange::Lost(state) => {
                link.client = None;
                state
            }
        };
        if link.state != state {
            link.state = state;
            tell_state(&self.setup.inbox, link);
        }
    }
}

/// Hands the events of a link to the gateway itself.
fn events_to(gateway: &ActorRef<GatewayMessage>) -> LinkSink {
    let gateway = gateway.clone();
    Arc::new(move |event| gateway.cast(GatewayMessage::LinkChanged { event }).is_ok())
}

/// Tells this node's parts that a link is no longer as it was.
fn tell_state(inbox: &Inbox, link: &Link) {
    let (broker, state) = (link.broker.clone(), link.state);
    tracing::info!(%broker, ?state, "link changed");
    inbox.deliver_local(Incoming::Link { broker, state });
}

/// The payload with its signature, where payloads are signed.
fn sealed(security: &Security, topic: &str, payload: Bytes) -> Bytes {
    match &security.signing {
        Some(key) => key.seal(topic, &payload).into(),
        None => payload,
    }
}

/// Most runs of this node's name that are told of.
const MAX_NAMESAKES: usize = 16;
