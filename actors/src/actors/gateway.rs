//! The actor that owns all MQTT connections of a node.
//!
//! It keeps a link to each configured broker, usually the aggregator's and its standby's: a change
//! of aggregator then needs no new connection. Every payload is encoded once and sent on every
//! link.
//!
//! ```text
//! other actors ── PublishReport, PublishMap, … ──> Gateway ── try_publish ──> link ── MQTT ──> broker
//!        ▲                                            │ own map, own report: in-process          │
//!        └───────────── Subscriber ◄──────────────────┴─── Inbox ◄── link task ◄── MQTT ─────────┘
//! ```
//!
//! - Publishing does not block: a link that is down or full refuses the message, which is counted.
//!   A new connection starts with an empty queue, so that old messages are not sent late.
//! - The link's own task decodes packets. A payload that cannot be used is counted and is not an
//!   error.
//! - The node's own messages reach its own receivers in-process. The broker's echo is dropped.
//! - `nodes/<node>` is published on every connection before anything else and has `offline` as last
//!   will.

use std::collections::{BTreeMap, BTreeSet};
use std::net::IpAddr;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use bytes::Bytes;
use ecod::diagnostics::TroubleKind;
use ecod::model::names::NodeName;
use ecod::wire::{Encoding, NodeState, NodeStatus, Payload, Topic, Topics, encode};
use ractor::{Actor, ActorProcessingErr, ActorRef};
use tracing::Span;
use uuid::Uuid;

pub use ecod::wire::ReportKind;

use crate::messages::gateway::GatewayMessage;
use crate::platform::cell_clock::CellClock;
use crate::platform::clock;
use crate::telemetry::counters::{Counters, Event};
use crate::transport::mqtt::connection::{LastWill, MaxQos, Retention, offline_payload};
use crate::transport::mqtt::inbox::Inbox;
use crate::transport::mqtt::link::{Link, LinkChange, LinkId, LinkSetup, LinkSink};
use crate::transport::mqtt::packet_sink::Via;
use crate::transport::mqtt::subscription_role::REPORTS;
use crate::transport::mqtt::{
    BrokerAddress, Incoming, LinkEvent, LinkState, MqttConfig, Security, Subscriber,
    SubscriptionRole,
};

/// Arguments of a [`Gateway`].
pub struct GatewayArguments {
    /// Name of the cell whose topics are used.
    pub cell: NodeName,
    /// Topics to subscribe to.
    pub role: SubscriptionRole,
    /// First status of the node. It holds the name and the id of this run.
    pub status: NodeStatus,
    /// Protocol, credentials and limits.
    pub mqtt: MqttConfig,
    /// Certificates for connections, and the signatures of rounds.
    pub security: Security,
    /// The cell's time, shared by the node's actors.
    pub clock: CellClock,
    /// Counters of the node, shared by its actors.
    pub counters: Arc<Counters>,
    /// Callback for every message.
    pub subscriber: Subscriber,
    /// Seed of the jitter between connection attempts.
    pub seed: u64,
    /// True if the node only observes: after it has stopped, the brokers have no status of it.
    pub only_observes: bool,
}

/// The only owner of MQTT clients.
#[derive(Debug, Default)]
pub struct Gateway;

/// The links and the node's status.
pub struct GatewayState {
    topics: Topics,
    role: SubscriptionRole,
    encoding: Encoding,
    report_brokers: Option<Vec<BrokerAddress>>,
    only_observes: bool,
    /// True if reports are subscribed to on every broker.
    watches_reports: bool,
    status: NodeStatus,
    status_topic: String,
    status_payload: Bytes,
    links: BTreeMap<LinkId, Link>,
    next_link: u64,
    /// Topics whose last payload was too large to be sent.
    too_large: BTreeSet<String>,
    /// Other running processes with this node's name.
    namesakes: BTreeSet<Uuid>,
    inbox: Arc<Inbox>,
    setup: Arc<LinkSetup>,
}

/// Time limit for sending the DISCONNECT of a link.
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
        let inbox = Arc::clone(&state.inbox);
        match message {
            GatewayMessage::SetBrokers { addresses } => state.set_brokers(addresses, &myself),
            GatewayMessage::Reconnect => state.reconnect(&myself),
            GatewayMessage::SetReportBrokers { addresses } => {
                state.report_brokers = Some(addresses);
            }
            GatewayMessage::WatchReports { wanted } => state.watch_reports(wanted),
            GatewayMessage::SetSubscriber { subscriber } => inbox.set_subscriber(subscriber),
            GatewayMessage::PublishReport { kind, report } => {
                publishing().in_scope(|| {
                    state.publish(
                        &kind.topic(report.node.clone()),
                        &*report,
                        Retention::Transient,
                    );
                });
                inbox.deliver_local(Incoming::Report { kind, report });
            }
            GatewayMessage::PublishMap { map } => {
                publishing().in_scope(|| {
                    state.publish(&Topic::GlobalDetections, &*map, Retention::Transient);
                });
                links_first().await;
                inbox.deliver_local(Incoming::Map(map));
            }
            GatewayMessage::PublishVerdicts { verdicts } => {
                publishing().in_scope(|| {
                    state.publish(&Topic::GlobalVerdicts, &*verdicts, Retention::Transient);
                });
                links_first().await;
                inbox.deliver_local(Incoming::Verdicts(verdicts));
            }
            GatewayMessage::PublishReputations { reputations } => {
                state.publish(&Topic::Reputations, &*reputations, Retention::Retained);
                inbox.deliver_local(Incoming::Reputations(reputations));
            }
            GatewayMessage::PublishDescription { description } => {
                state.publish(&Topic::Cell, &*description, Retention::Retained);
            }
            GatewayMessage::PublishShare { share } => {
                state.publish(
                    &Topic::Ledger(share.node.clone()),
                    &share,
                    Retention::Transient,
                );
            }
            GatewayMessage::PublishStatus { status } => state.set_status(status),
            GatewayMessage::Links { reply } => {
                let links = state
                    .links
                    .values()
                    .map(|link| (link.broker.clone(), link.state))
                    .collect();
                if reply.send(links).is_err() {
                    tracing::debug!("caller did not wait for the state of the links");
                }
            }
            GatewayMessage::LinkChanged { event } => state.link_changed(event),
        }
        Ok(())
    }

    async fn post_stop(
        &self,
        _myself: ActorRef<Self::Msg>,
        state: &mut Self::State,
    ) -> Result<(), ActorProcessingErr> {
        let gone = NodeStatus {
            state: NodeState::Offline,
            troubles: Vec::new(),
            dismissed: vec![state.status.node.clone()],
            ..state.status.clone()
        };
        state.set_status(gone);
        if state.only_observes {
            state.send(&state.status_topic, &Bytes::new(), Retention::Retained);
        }
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

/// Lets the links' tasks send the message before this node's own actors process it. This reduces
/// latency for other nodes; the order does not depend on it, because the message is in every link's
/// queue already.
async fn links_first() {
    tokio::task::yield_now().await;
}

impl GatewayState {
    fn new(arguments: GatewayArguments) -> Self {
        let GatewayArguments {
            cell,
            role,
            status,
            mqtt,
            security,
            clock,
            counters,
            subscriber,
            seed,
            only_observes,
        } = arguments;
        let topics = Topics::new(&cell);
        let encoding = mqtt.encoding;
        let status_topic = topics.path(&Topic::Nodes(status.node.clone()));
        let filters = role
            .filters()
            .iter()
            .map(|level| topics.filter(level))
            .collect();
        let seal = |payload| Bytes::from(security.seal(&status_topic, payload));
        let will = LastWill {
            topic: status_topic.clone(),
            payload: seal(offline_payload(&status, encoding)),
        };
        let status_payload = seal(encode(&status, encoding));
        let inbox = Inbox::new(
            &status,
            topics.clone(),
            &mqtt,
            security.clone(),
            clock,
            Arc::clone(&counters),
            subscriber,
        );
        // Each run has its own client id. With a shared id, a broker would end the old connection
        // before it accepts the new one, so that the last will comes before the new status.
        let client_id = format!("{}-{}", status.node, status.id.simple());
        let will = Mutex::new(will);
        let inbox = Arc::new(inbox);
        let sink = Arc::<Inbox>::clone(&inbox);
        let unreachable = TroubleKind::BrokerUnreachable;
        let setup = LinkSetup {
            client_id,
            filters,
            will,
            config: mqtt,
            security,
            sink,
            unreachable,
            counters,
            seed,
        };
        Self {
            inbox,
            only_observes,
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

    /// Keeps links to exactly these brokers. A link to another broker withdraws the node's status
    /// and closes in the background; existing links continue.
    fn set_brokers(&mut self, addresses: Vec<BrokerAddress>, myself: &ActorRef<GatewayMessage>) {
        let mut wanted: BTreeSet<_> = addresses.into_iter().collect();
        let gone: Vec<_> = self
            .links
            .extract_if(.., |_, link| !wanted.remove(&link.broker))
            .collect();
        for (_, link) in gone {
            // Deletes the retained status, because that broker would not receive later changes.
            link.publish(&self.status_topic, &Bytes::new(), Retention::Retained);
            tokio::spawn(link.leave(LEAVE_TIMEOUT));
        }
        for broker in wanted {
            self.link_to(broker, myself);
        }
    }

    /// Opens a link with a new id. It connects in a separate task, and its events are messages to
    /// this actor.
    fn link_to(&mut self, broker: BrokerAddress, myself: &ActorRef<GatewayMessage>) {
        let id = LinkId(self.next_link);
        self.next_link += 1;
        self.links.insert(
            id,
            Link::spawn(id, broker, Arc::clone(&self.setup), events_to(myself)),
        );
    }

    /// Replaces all links except those within this machine.
    fn reconnect(&mut self, myself: &ActorRef<GatewayMessage>) {
        let is_near = |broker: &BrokerAddress| {
            let host = broker.host().trim_matches(['[', ']']).parse::<IpAddr>();
            host.is_ok_and(|ip| ip.is_loopback() || ip.is_unspecified())
        };
        let dead: Vec<_> = self
            .links
            .extract_if(.., |_, link| !is_near(&link.broker))
            .collect();
        for (_, mut link) in dead {
            link.state = LinkState::Down;
            publish_state(&self.inbox, &link);
            self.link_to(link.broker.clone(), myself);
        }
    }

    /// The filters for a new connection to a broker: reports are included only if this node uses
    /// them there.
    fn filters(&self, broker: &BrokerAddress) -> Vec<String> {
        let reports = self.watches_reports || self.takes_reports_of(broker);
        let wanted = |level: &&&str| reports || !REPORTS.contains(*level);
        self.role
            .filters()
            .iter()
            .filter(wanted)
            .map(|level| self.topics.filter(level))
            .collect()
    }

    /// True if this node needs the reports on a broker for itself.
    fn takes_reports_of(&self, broker: &BrokerAddress) -> bool {
        match self.role {
            SubscriptionRole::Candidate => self
                .report_brokers
                .as_ref()
                .is_none_or(|brokers| brokers.contains(broker)),
            SubscriptionRole::Observer => true,
            SubscriptionRole::Follower => false,
        }
    }

    /// Starts or stops receiving reports for display, on links that carry no reports for this node.
    /// Later connections follow the same setting.
    fn watch_reports(&mut self, wanted: bool) {
        if self.watches_reports == wanted {
            return;
        }
        self.watches_reports = wanted;
        let reports = REPORTS.map(|level| self.topics.filter(level));
        for link in self
            .links
            .values()
            .filter(|link| !self.takes_reports_of(&link.broker))
        {
            let queued = link.client.as_ref().map(|client| {
                if wanted {
                    client.subscribe(&reports, MaxQos::AtLeastOnce)
                } else {
                    client.unsubscribe(&reports)
                }
            });
            tracing::debug!(broker = %link.broker, wanted, ?queued, "subscription to reports changed");
        }
    }

    /// Replaces the status: it is published on all links, retained, and the last will for later
    /// connections is derived from it.
    fn set_status(&mut self, status: NodeStatus) {
        let seal = |payload| Bytes::from(self.setup.security.seal(&self.status_topic, payload));
        self.status_payload = seal(encode(&status, self.encoding));
        let will = seal(offline_payload(&status, self.encoding));
        self.setup
            .will
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .payload = will;
        self.status = status;
        self.send(
            &self.status_topic,
            &self.status_payload,
            Retention::Retained,
        );
    }

    /// Encodes, signs if it is a round, seals and sends a message on all links. A payload that
    /// receivers would refuse is counted and dropped.
    fn publish<T: Payload>(&mut self, topic: &Topic, payload: &T, retention: Retention) {
        let path = self.topics.path(topic);
        let mut payload = encode(payload, self.encoding);
        if matches!(
            topic,
            Topic::GlobalDetections | Topic::GlobalVerdicts | Topic::Reputations
        ) {
            payload = self.setup.security.sign_round(&path, payload);
        }
        if self.fits::<T>(&path, payload.len()) {
            let payload = self.setup.security.seal(&path, payload).into();
            if matches!(topic, Topic::GlobalDetections | Topic::GlobalVerdicts) {
                self.inbox.record_published(&payload);
            }
            self.send(&path, &payload, retention);
            self.expect_echo(topic);
        }
    }

    /// Expects the echo of a message that was just sent. A link whose broker has sent no echo for
    /// too long counts as stalled.
    fn expect_echo(&mut self, topic: &Topic) {
        let now = clock::now();
        let of_all = matches!(topic, Topic::GlobalDetections | Topic::GlobalVerdicts);
        let of_one = matches!(topic, Topic::Detections(_) | Topic::VoteDetections(_))
            && self.role == SubscriptionRole::Candidate;
        let reports: Vec<_> = self
            .links
            .values()
            .map(|link| of_one && self.takes_reports_of(&link.broker))
            .collect();
        for (link, reports) in self.links.values_mut().zip(reports) {
            if (of_all || reports) && link.state == LinkState::Up && link.misses_echo(now) {
                link.state = LinkState::Stalled;
                publish_state(&self.inbox, link);
            }
        }
    }

    /// True if receivers with this node's limits accept a payload of this size. A larger one would
    /// break links or be dropped by every receiver. The first such payload of each topic is logged.
    fn fits<T: Payload>(&mut self, topic: &str, bytes: usize) -> bool {
        let limit = T::max_bytes(&self.setup.config.limits());
        if bytes <= limit {
            self.too_large.remove(topic);
            return true;
        }
        self.setup.counters.count(Event::PublishTooLarge);
        if self.too_large.insert(topic.to_owned()) {
            tracing::warn!(
                topic,
                bytes,
                limit,
                "payload too large to be sent, raise the limit in [mqtt]"
            );
        }
        false
    }

    /// Sends bytes on all links, and counts for each link whether its queue accepted them.
    fn send(&self, topic: &str, payload: &Bytes, retention: Retention) {
        for link in self.links.values() {
            let sent = link.publish(topic, payload, retention);
            self.setup.counters.count(if sent {
                Event::Published
            } else {
                Event::PublishRefused
            });
        }
    }

    /// Handles an event of a link's task; an event of a closed link is ignored. A new connection
    /// publishes the status and subscribes before it counts as up. The node's other parts get the
    /// link's new state if it has changed, and after each login: retained messages follow anew.
    ///
    /// # Example
    /// The broker of `edge` ends. `Lost(Down)` arrives: the link has no client and its state is
    /// `Down`. The next attempt is refused, and `Lost(Refused)` arrives: the election uses this
    /// state as proof that the process has ended.
    fn link_changed(&mut self, LinkEvent { link: id, change }: LinkEvent) {
        let filters = match &change {
            LinkChange::Accepted { .. } => self
                .links
                .get(&id)
                .map_or_else(Vec::new, |link| self.filters(&link.broker)),
            _ => Vec::new(),
        };
        let Some(link) = self.links.get_mut(&id) else {
            return;
        };
        let is_login = matches!(change, LinkChange::Accepted { .. });
        let state = match change {
            LinkChange::Accepted { client, node } => {
                // The queue of a new connection is empty, so that both fit.
                client.publish(
                    &self.status_topic,
                    &self.status_payload,
                    Retention::Retained,
                );
                client.subscribe(&filters, MaxQos::AtLeastOnce);
                link.client = Some(client);
                link.node = node;
                LinkState::Up
            }
            LinkChange::DeclaredOffline => {
                tracing::warn!(broker = %link.broker, "broker published the last will of this node, which is alive");
                link.publish(
                    &self.status_topic,
                    &self.status_payload,
                    Retention::Retained,
                );
                return;
            }
            LinkChange::Namesake(run) => {
                // One answer for each run: it warns the other run too, and ends the exchange.
                if self.namesakes.len() < MAX_NAMESAKES && self.namesakes.insert(run) {
                    let node = &self.status.node;
                    tracing::warn!(broker = %link.broker, %node, %run, "another living node has this node's name, rename one");
                    link.publish(
                        &self.status_topic,
                        &self.status_payload,
                        Retention::Retained,
                    );
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
        if link.state != state || is_login {
            link.state = state;
            publish_state(&self.inbox, link);
        }
    }
}

/// Callback that sends a link's events to the gateway itself.
fn events_to(gateway: &ActorRef<GatewayMessage>) -> LinkSink {
    let gateway = gateway.clone();
    Arc::new(move |event| gateway.cast(GatewayMessage::LinkChanged { event }).is_ok())
}

/// Delivers the new state of a link to this node's actors.
fn publish_state(inbox: &Inbox, link: &Link) {
    let broker = link.broker.clone();
    let state = link.state;
    tracing::info!(%broker, %state, "link changed");
    inbox.deliver_link(
        Via {
            address: &broker,
            node: link.node.as_ref(),
        },
        state,
    );
}

/// Maximum number of other runs with this node's name that are logged.
const MAX_NAMESAKES: usize = 16;
