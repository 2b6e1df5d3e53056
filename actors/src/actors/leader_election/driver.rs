//! From what happens in a node to the election's inputs, and from its effects to the node's parts.

use crate::messages::leader_election::{HealthSample, LeaderElectionMessage};
use crate::messages::leadership::Leadership;

mod effects;
mod members;

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use ecod::election::{Election, ElectionMessage, Health, Input};
use ecod::epoch::Epoch;
use ecod::names::NodeName;
use ecod::time::Timestamp;
use ecod::wire::{NodeState, NodeStatus, Role};
use ractor::{ActorProcessingErr, ActorRef};
use tokio::sync::watch;
use tokio::task::AbortHandle;
use tracing::field::display;
use uuid::Uuid;

use super::health::{self, HealthMonitor};
use super::routes::{Brokers, Routes};
use super::terms::{TermWriter, saved_term};
use super::{LeaderElectionArguments, Parts};
use crate::messages::gateway::GatewayMessage;
use crate::platform::clock;
use crate::telemetry::counters::Counters;
use crate::transport::gossip::{Member, MembershipEvent};
use crate::transport::mqtt::{BrokerAddress, LinkState};

/// The election, what it was told last, and what came of it.
pub struct ElectionDriver {
    election: Election,
    name: NodeName,
    role: Role,
    terms: TermWriter,
    round_period: Duration,
    members: BTreeMap<NodeName, Member>,
    /// Members on other machines, which do not reach a broker on this one's loopback.
    elsewhere: BTreeSet<NodeName>,
    /// Nodes that the membership gave up a moment ago, their brokers, and until when those may prove them gone.
    departed: BTreeMap<NodeName, (BrokerAddress, Timestamp)>,
    all_members: watch::Receiver<Vec<Member>>,
    /// Since when the membership does not know of a member: it was started anew.
    missing_since: Option<Timestamp>,
    own_broker: watch::Receiver<Option<SocketAddr>>,
    monitor: HealthMonitor,
    health: Health,
    routes: Routes,
    /// The last living run of each node, as brokers tell it.
    runs: HashMap<NodeName, Uuid>,
    status: NodeStatus,
    told_out_of_reach: bool,
    /// Whether the gateway knows the status.
    status_told: bool,
    /// The epoch of the last round, which a node without word from the election says it follows.
    taken: Option<Epoch>,
    preparing: Option<Preparing>,
    parts: Parts,
    leadership: watch::Sender<Leadership>,
    /// The highest term known.
    term: watch::Sender<u64>,
    counters: Arc<Counters>,
    alarm: Timestamp,
    timer: Option<AbortHandle>,
    drained: bool,
    myself: ActorRef<LeaderElectionMessage>,
}

/// A handover to this node under way.
#[derive(Debug)]
struct Preparing {
    leader: NodeName,
    since: Timestamp,
    has_state: bool,
}

/// How long vehicles are given to connect to a broker that is about to be the leader's.
const CONNECT_TIME: Duration = Duration::from_millis(300);

/// How long the old leader's state is waited for.
const STATE_PATIENCE: Duration = Duration::from_millis(1000);

/// Time between two looks at what a handover waits for.
const PREPARE_STEP: Duration = Duration::from_millis(50);

/// Most nodes whose runs are remembered: brokers may tell of any number of names.
const MAX_RUNS: usize = 4096;

/// A timer later than this was overslept; what waits in the sockets is then dealt with first, for as long as below.
const OVERSLEPT: Duration = Duration::from_millis(20);
const DRAIN_TIME: Duration = Duration::from_millis(10);

impl ElectionDriver {
    pub(super) fn new(arguments: LeaderElectionArguments, myself: ActorRef<LeaderElectionMessage>) -> Self {
        let LeaderElectionArguments { config, status, term_file, plane, parts, leadership, term, counters, .. } =
            arguments;
        let (name, role) = (status.node.clone(), config.role);
        // A run of this actor before may have led in the term of the watch, and there may be no disk that tells.
        let told = leadership.borrow().epoch.as_ref().map_or(0, |epoch| epoch.term.saturating_add(1));
        let least_term = saved_term(term_file.as_ref()).max(told);
        Self {
            election: Election::new(config, name.clone(), least_term, clock::now()),
            name,
            role,
            terms: TermWriter::new(term_file),
            round_period: arguments.round_period,
            members: BTreeMap::new(),
            elsewhere: BTreeSet::new(),
            departed: BTreeMap::new(),
            all_members: arguments.members,
            missing_since: None,
            own_broker: arguments.own_broker,
            monitor: HealthMonitor::new(clock::now()),
            health: Health::default(),
            routes: Routes::new(plane),
            runs: HashMap::new(),
            taken: status.aggregator.clone().map(|aggregator| Epoch::new(status.epoch, aggregator)),
            status,
            told_out_of_reach: false,
            status_told: false,
            preparing: None,
            parts,
            leadership,
            term,
            counters,
            alarm: Timestamp(u64::MAX),
            timer: None,
            drained: false,
            myself,
        }
    }

    pub(super) async fn take_event(&mut self, event: MembershipEvent) -> Result<(), ActorProcessingErr> {
        match event {
            MembershipEvent::Alive { member } => self.meet(member).await,
            MembershipEvent::Changed { member } => {
                self.place(member);
                self.update_health().await
            }
            MembershipEvent::Suspected { name } => self.feed(Input::PeerSuspected { peer: name }).await,
            MembershipEvent::Down { name } => {
                self.part_with(&name);
                self.feed(Input::PeerDown { peer: name }).await
            }
            MembershipEvent::Received { from, payload, .. } => match ElectionMessage::decode(&payload) {
                Ok(message) if message.from == from => self.feed(Input::Receive { message }).await,
                Ok(message) => {
                    tracing::debug!(%from, claimed = %message.from, "election message in another's name dropped");
                    Ok(())
                }
                Err(reason) => {
                    self.counters.reject(reason);
                    tracing::debug!(%from, %reason, "election message dropped");
                    Ok(())
                }
            },
            MembershipEvent::NameTaken { name } => {
                tracing::error!(%name, "two nodes have this name; the election cannot tell them apart");
                Ok(())
            }
        }
    }

    pub(super) async fn take_link(
        &mut self,
        broker: &BrokerAddress,
        link: LinkState,
    ) -> Result<(), ActorProcessingErr> {
        let gone = self.monitor.note_link(broker, link);
        self.update_health().await?;
        // A broker that belongs to no node says nothing about any.
        if gone && self.routes.plane().external.as_ref() != Some(broker) {
            for peer in self.nodes_at(broker) {
                tracing::info!(%peer, %broker, "process is gone");
                self.feed(Input::PeerGone { peer }).await?;
            }
        }
        Ok(())
    }

    /// Where all use one broker, its word that the leader's connection broke is the quickest news of the leader's end.
    pub(super) async fn take_status(&mut self, status: &NodeStatus) -> Result<(), ActorProcessingErr> {
        let peer = status.node.clone();
        if status.state != NodeState::Offline {
            if self.runs.len() < MAX_RUNS || self.runs.contains_key(&peer) {
                self.runs.insert(peer, status.id);
            }
            return Ok(());
        }
        let ended = self.runs.remove(&peer) == Some(status.id);
        if ended && !self.routes.plane().embedded && self.election.leader() == Some(&peer) {
            tracing::info!(%peer, "connection of the leader broke");
            self.feed(Input::PeerGone { peer }).await?;
        }
        Ok(())
    }

    /// Rounds of other epochs than the election's own prove nothing: whoever reaches a broker can publish some.
    pub(super) async fn note_round(&mut self, epoch: Epoch, round: u64) -> Result<(), ActorProcessingErr> {
        if self.election.epoch() == Some(&epoch) {
            self.feed(Input::Round { epoch: epoch.clone(), round }).await?;
        }
        self.taken = Some(epoch);
        Ok(())
    }

    pub(super) fn note_state(&mut self, from: &NodeName) {
        if let Some(preparing) = self.preparing.as_mut().filter(|preparing| preparing.leader == *from) {
            preparing.has_state = true;
        }
    }

    /// A fuser that was started anew does not lead: the leadership is over.
    pub(super) async fn note_fuser_restart(&mut self) -> Result<(), ActorProcessingErr> {
        if self.election.is_leading() {
            self.set_health(Health { fuser: false, ..self.health }).await?;
        }
        Ok(())
    }

    pub(super) async fn note_gateway_restart(&mut self) -> Result<(), ActorProcessingErr> {
        self.routes.forget();
        self.monitor.forget_links();
        self.status_told = false;
        self.update_health().await
    }

    pub(super) async fn note_health(&mut self, sample: HealthSample) -> Result<(), ActorProcessingErr> {
        self.monitor.note_probe(sample);
        self.update_health().await
    }

    pub(super) async fn check_health(&mut self) -> Result<(), ActorProcessingErr> {
        if self.role != Role::Cav {
            self.monitor.look(&self.counters, clock::now());
            health::probe(&self.parts, self.myself.clone());
            self.update_health().await?;
        }
        // Events from before this actor's start went nowhere, nor does a membership started anew tell of whom it lost.
        let members = self.all_members.borrow().clone();
        for peer in self.long_missing(&members) {
            self.part_with(&peer);
            self.feed(Input::PeerDown { peer }).await?;
        }
        for member in members {
            if self.members.get(&member.name).is_none_or(|known| known.run != member.run) {
                self.meet(member).await?;
            }
        }
        Ok(())
    }

    pub(super) async fn check_prepared(&mut self) -> Result<(), ActorProcessingErr> {
        let Some(preparing) = &self.preparing else { return Ok(()) };
        let waited = clock::now().since(preparing.since);
        let complete = waited >= CONNECT_TIME && (preparing.has_state || waited >= STATE_PATIENCE);
        if complete && self.health.is_fit() {
            self.preparing = None;
            return self.feed(Input::Prepared).await;
        }
        self.myself.send_after(PREPARE_STEP, || LeaderElectionMessage::CheckPrepared);
        Ok(())
    }

    pub(super) async fn wake(&mut self) -> Result<(), ActorProcessingErr> {
        let now = clock::now();
        if now.since(self.alarm) > OVERSLEPT && !self.drained {
            self.drained = true;
            self.timer = None;
            self.set_timer(DRAIN_TIME);
            return Ok(());
        }
        self.drained = false;
        self.alarm = Timestamp(u64::MAX);
        let effects = self.election.tick(now);
        self.carry_out(effects).await
    }

    /// Gives up the lead, if this node has it, so that the next one need not find out.
    pub(super) async fn leave(&mut self) -> Result<(), ActorProcessingErr> {
        self.feed(Input::Leave).await?;
        self.terms.settle(u64::MAX).await;
        Ok(())
    }

    /// Makes links, status, watch and timer what the election says now.
    pub(super) fn reflect(&mut self) {
        let leadership = self.tell_leadership();
        self.reflect_links(&leadership);
        self.reflect_status(&leadership);
        let due = self.election.next_deadline();
        if due != self.alarm && !self.drained {
            self.alarm = due;
            self.set_timer(due.since(clock::now()));
        }
    }

    /// Makes the watch what the election says now.
    fn tell_leadership(&self) -> Leadership {
        let term = self.election.term();
        self.term.send_if_modified(|known| std::mem::replace(known, term) != term);
        let leadership = Leadership::of(&self.election, &self.name);
        if *self.leadership.borrow() != leadership {
            let Leadership { position, epoch, standby } = &leadership;
            let (epoch, standby) = (epoch.as_ref().map(display), standby.as_ref().map(display));
            tracing::info!(?position, epoch, standby, "leadership");
            self.leadership.send_replace(leadership.clone());
        }
        leadership
    }

    fn reflect_links(&mut self, leadership: &Leadership) {
        let broker = |name: Option<&NodeName>| match name {
            Some(name) if *name == self.name => self.own_broker.borrow().map(BrokerAddress::from),
            Some(name) => self.members.get(name)?.broker.map(BrokerAddress::from),
            None => None,
        };
        let own = broker(Some(&self.name));
        let brokers = match leadership.leader() {
            Some(leader) => Brokers { own, leader: broker(Some(leader)), standby: broker(leadership.standby.as_ref()) },
            None => Brokers { own, ..self.routes.brokers().clone() },
        };
        if let Some(addresses) = self.routes.update(brokers, clock::now()) {
            let own = self.routes.brokers().own.iter().chain(&self.routes.plane().external).cloned().collect();
            self.parts.gateway.send(GatewayMessage::SetReportBrokers { addresses: own });
            self.parts.gateway.send(GatewayMessage::SetBrokers { addresses });
        }
    }

    fn reflect_status(&mut self, leadership: &Leadership) {
        let epoch = leadership.leader().and(leadership.epoch.as_ref()).or(self.taken.as_ref());
        let state = if leadership.is_leading() { NodeState::Aggregating } else { NodeState::Following };
        let status = NodeStatus {
            state,
            epoch: epoch.map_or(0, |epoch| epoch.term),
            aggregator: epoch.map(|epoch| epoch.leader.clone()),
            fit: (self.role != Role::Cav).then(|| self.health.is_fit()),
            ..self.status.clone()
        };
        if status != self.status || !self.status_told {
            self.status = status.clone();
            self.status_told = true;
            self.parts.gateway.send(GatewayMessage::PublishStatus { status });
        }
    }

    async fn meet(&mut self, member: Member) -> Result<(), ActorProcessingErr> {
        let peer = member.name.clone();
        self.place(member);
        self.feed(Input::PeerAlive { peer }).await?;
        self.update_health().await
    }

    async fn update_health(&mut self) -> Result<(), ActorProcessingErr> {
        let (plane, brokers) = (self.routes.plane(), self.routes.brokers());
        let no_other = self.election.is_leading() && self.election.standby().is_none();
        let health = self.monitor.health(plane, brokers, no_other, self.round_period);
        let is_reached = self.is_reached(no_other);
        self.set_health(Health { broker: health.broker && is_reached, ..health }).await
    }

    async fn set_health(&mut self, health: Health) -> Result<(), ActorProcessingErr> {
        if self.role == Role::Cav || health == self.health {
            return Ok(());
        }
        let Health { broker, fuser, gateway, .. } = health;
        match (self.health.is_fit(), health.is_fit()) {
            (false, true) => tracing::info!("fit to lead"),
            (true, false) => tracing::warn!(broker, fuser, gateway, "not fit to lead"),
            _ => {}
        }
        self.health = health;
        self.feed(Input::Health { health }).await
    }

    async fn feed(&mut self, input: Input) -> Result<(), ActorProcessingErr> {
        let effects = self.election.handle(input, clock::now());
        self.carry_out(effects).await
    }

    fn set_timer(&mut self, after: Duration) {
        let timer = self.myself.send_after(after, || LeaderElectionMessage::Wake);
        if let Some(superseded) = self.timer.replace(timer.abort_handle()) {
            superseded.abort();
        }
    }
}
