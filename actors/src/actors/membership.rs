//! The actor that owns the gossip socket: liveness of nodes, independent of MQTT, and small
//! datagrams between nodes.
//!
//! ```text
//! LeaderElection ── Send ──> Membership <──── UDP ────> other nodes
//!                                └──> MembershipEvent, watch of all members
//! ```

#![deny(clippy::indexing_slicing)]

mod renewal;

use std::io;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use ecod::diagnostics::TroubleKind;
use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ecod::wire::Role;
use ractor::{Actor, ActorProcessingErr, ActorRef};
use ring::rand::{SecureRandom, SystemRandom};
use rustls::pki_types::UnixTime;
use tokio::sync::{Notify, watch};
use tokio::task::JoinSet;
use tokio::time::timeout;

use crate::messages::membership::{MembershipMessage, RenewalOutcome};
use crate::platform::clock;
use crate::transport::gossip::handshake::Identity;
use crate::transport::gossip::key::{CellKey, SessionNonce};
use crate::transport::gossip::machine::{GossipMachine, GossipOutput, GossipSetup};
use crate::transport::gossip::node_id::NodeId;
use crate::transport::gossip::socket::{GossipSocket, is_of_this_machine, source_towards};
use crate::transport::gossip::{
    EventSink, FrameCounters, FrameEvent, MAX_PAYLOAD_BYTES, Member, MembershipConfig,
    MembershipEvent, MulticastConfig,
};
use crate::transport::pki::{Credentials, Distrust, RenewalMessage};
use renewal::{RenewalStep, Renewals};

/// Arguments of a [`Membership`].
pub struct MembershipArguments {
    /// Name of this node, unique in its cell.
    pub name: NodeName,
    /// The cell. Nodes of other cells are ignored.
    pub cell: NodeName,
    /// Time of the node's start in Unix microseconds.
    pub run: u64,
    /// The role it was started with.
    pub role: Role,
    /// Address of the node's broker, if it has one. Other nodes replace 0.0.0.0 by the address from
    /// which the node's packets arrive.
    pub broker: Option<SocketAddr>,
    /// The node's certificates. If set, every node of the cell must prove its certificate.
    pub credentials: Option<Arc<Credentials>>,
    /// Timings, seeds and limits.
    pub config: MembershipConfig,
    /// Callback for every event.
    pub events: EventSink,
    /// All living nodes except this one, by name.
    pub members: watch::Sender<Vec<Member>>,
    /// The counters of the gossip socket.
    pub counters: Arc<FrameCounters>,
}

/// Owns the gossip socket.
#[derive(Debug, Default)]
pub struct Membership;

/// The membership and its socket.
pub struct MembershipState {
    machine: GossipMachine,
    socket: Arc<GossipSocket>,
    deadline: watch::Sender<Option<Timestamp>>,
    /// Notifies the socket's task that a [`MembershipMessage::Wake`] was handled.
    handled: Arc<Notify>,
    events: EventSink,
    members: watch::Sender<Vec<Member>>,
    counters: Arc<FrameCounters>,
    certificates: Option<CertificateWatch>,
    renewals: Option<Renewals>,
    /// True if the node's address belonged to this machine at the last check. Behind address
    /// translation the address belongs to another machine.
    has_own_address: bool,
    name: NodeName,
    myself: ActorRef<MembershipMessage>,
    /// Tasks that end with the actor.
    tasks: JoinSet<()>,
}

impl Actor for Membership {
    type Msg = MembershipMessage;
    type State = MembershipState;
    type Arguments = MembershipArguments;

    async fn pre_start(
        &self,
        myself: ActorRef<Self::Msg>,
        arguments: Self::Arguments,
    ) -> Result<Self::State, ActorProcessingErr> {
        let MembershipArguments {
            name,
            cell,
            run,
            role,
            broker,
            credentials,
            config,
            events,
            members,
            counters,
        } = arguments;
        let key = CellKey::load(&config, &cell)?;
        let socket = Arc::new(GossipSocket::bind(&config)?);
        let address = socket.address();
        log_admission(&config, credentials.is_some(), address);
        let mut certificates = credentials.clone().map(CertificateWatch::new);
        let identity = certificates.as_mut().map(CertificateWatch::identity);
        let renewals = credentials
            .clone()
            .map(|credentials| Renewals::new(credentials, name.clone()));
        let now = clock::now();
        let own_name = name.clone();
        let gossip = config.advertise.unwrap_or(address);
        let own = NodeId {
            name,
            run,
            life: run.max(now.micros()),
            role,
            gossip,
            broker,
        };
        let (session, secret, seed) = draw_secrets()?;
        let setup = GossipSetup {
            own,
            cell,
            key,
            session,
            identity,
            secret,
            seed,
            counters: Arc::clone(&counters),
        };
        let machine = GossipMachine::new(setup, &config, now);
        let (deadline, deadlines) = watch::channel(machine.next_deadline());
        let handled = Arc::new(Notify::new());
        let mut tasks = JoinSet::new();
        tasks.spawn(watch_socket(
            Arc::clone(&socket),
            deadlines,
            Arc::clone(&handled),
            myself.clone(),
        ));
        if let Some(credentials) = credentials {
            tasks.spawn(check_certificates(credentials, myself.clone()));
        }
        if gossip.ip().is_unspecified() {
            tasks.spawn(check_address(myself.clone()));
        }
        if !join_group(&socket, &config.multicast) {
            tasks.spawn(join_later(Arc::clone(&socket), config.multicast.clone()));
        }
        if !config.seeds.is_empty() {
            let report = Arc::clone(&events);
            let trouble = move |seed: &str, error: &io::Error| {
                let cause = format!("cannot be resolved: {error}");
                report(MembershipEvent::Troubled {
                    about: seed.to_owned(),
                    kind: TroubleKind::Unresolved,
                    cause,
                });
            };
            let membership = myself.clone();
            let set_seeds = move |addresses| {
                membership
                    .cast(MembershipMessage::SetSeeds { addresses })
                    .is_ok()
            };
            tasks.spawn(crate::transport::gossip::seeds::resolve(
                config.seeds,
                address.is_ipv4(),
                trouble,
                set_seeds,
            ));
        }
        members.send_replace(Vec::new());
        Ok(MembershipState {
            machine,
            socket,
            deadline,
            handled,
            events,
            members,
            counters,
            certificates,
            renewals,
            has_own_address: false,
            name: own_name,
            myself,
            tasks,
        })
    }

    async fn post_stop(
        &self,
        _myself: ActorRef<Self::Msg>,
        state: &mut Self::State,
    ) -> Result<(), ActorProcessingErr> {
        state.machine.leave(clock::now());
        state.carry_out();
        // The tasks hold the socket: once the actor has ended, its address is free.
        state.tasks.shutdown().await;
        Ok(())
    }

    async fn handle(
        &self,
        _myself: ActorRef<Self::Msg>,
        message: Self::Msg,
        state: &mut Self::State,
    ) -> Result<(), ActorProcessingErr> {
        let now = clock::now();
        match message {
            MembershipMessage::Send { to, payload } => state.machine.send(&to, &payload, now),
            MembershipMessage::SetSeeds { addresses } => state.machine.set_seeds(addresses),
            MembershipMessage::Address { reply } => drop(reply.send(state.socket.address())),
            MembershipMessage::CheckCertificates => {
                if let Some(identity) = state.certificates.as_mut().map(CertificateWatch::identity)
                {
                    state.machine.set_identity(identity, now);
                    // Nodes may have shown renewed certificates, for which there is no event.
                    state.publish_members();
                }
                let renewals = state.renewals.as_mut();
                let step = renewals.and_then(|renewals| renewals.check(now));
                state.on_renewal_step(step);
            }
            MembershipMessage::Renewal { outcome } => {
                if matches!(outcome, RenewalOutcome::Answered { answer: Err(_), .. }) {
                    state.counters.count(FrameEvent::RenewalRefused);
                }
                let renewals = state.renewals.as_mut();
                let step = renewals.and_then(|renewals| renewals.on_outcome(outcome));
                state.on_renewal_step(step);
            }
            MembershipMessage::CheckAddress => state.check_address(now),
            MembershipMessage::Wake => state.wake(),
        }
        state.carry_out();
        Ok(())
    }
}

impl MembershipState {
    /// Processes waiting datagrams before due timers: after a stall, signs of life come before
    /// suspicions.
    fn wake(&mut self) {
        let mut buffer = [0; 2 * MAX_PAYLOAD_BYTES];
        for _ in 0..MAX_DATAGRAMS_PER_WAKE {
            let Some((length, from)) = self.socket.receive(&mut buffer) else {
                break;
            };
            self.machine
                .receive(buffer.get(..length).unwrap_or_default(), from, clock::now());
            self.carry_out();
        }
        self.machine.tick(clock::now());
        self.handled.notify_one();
    }

    /// Switches to another local address when this machine has lost the current one, for example
    /// after a new DHCP lease.
    fn check_address(&mut self, now: Timestamp) {
        let own = self.machine.own_address().ip();
        if is_of_this_machine(own) {
            self.has_own_address = !own.is_unspecified();
            return;
        }
        let members = self.machine.members().into_iter();
        let source = members.map(|member| member.gossip).find_map(source_towards);
        if let Some(ip) = source.filter(|ip| self.has_own_address && *ip != own) {
            tracing::info!(address = %ip, before = %own, "this node has another address");
            self.machine.move_to(ip, now);
        }
    }

    /// Carries out all outputs of the machine: sends frames, delivers events and starts steps of
    /// renewals. Then publishes the list of members if it has changed, and the next deadline.
    fn carry_out(&mut self) {
        let mut changed = false;
        while let Some(output) = self.machine.poll() {
            let sent = match output {
                GossipOutput::Send { to, frame } => Some(self.socket.send(&frame, to)),
                GossipOutput::Multicast { frame } => self.socket.multicast(&frame),
                GossipOutput::Event(event) => {
                    changed |= !matches!(
                        event,
                        MembershipEvent::Received { .. } | MembershipEvent::Troubled { .. }
                    );
                    (self.events)(event);
                    None
                }
                GossipOutput::Renewal {
                    from,
                    certificate,
                    body,
                } => {
                    self.on_renewal(from, &certificate, &body);
                    None
                }
            };
            match sent {
                Some(Ok(())) => self.counters.count(FrameEvent::Sent),
                Some(Err(error)) => {
                    self.counters.count(FrameEvent::SendFailed);
                    tracing::debug!(%error, "gossip frame not sent");
                }
                None => (),
            }
        }
        if changed {
            self.publish_members();
        }
        self.deadline.send_replace(self.machine.next_deadline());
    }

    /// Processes a message about a renewed certificate.
    fn on_renewal(&mut self, from: NodeName, certificate: &[u8], body: &[u8]) {
        let Ok(message) = postcard::from_bytes(body) else {
            return self.counters.count(FrameEvent::Malformed);
        };
        let renewals = self.renewals.as_mut();
        let step = renewals
            .and_then(|renewals| renewals.on_message(from, certificate, message, clock::now()));
        self.on_renewal_step(step);
    }

    /// Carries out one step of a renewal: sends a message to a node or to all nodes, or runs work
    /// in another thread, whose outcome comes back as a message. A message to this node itself is
    /// processed at once. `None` has no effect.
    fn on_renewal_step(&mut self, step: Option<RenewalStep>) {
        match step {
            Some(RenewalStep::Send(to, message)) if to == self.name => {
                let renewals = self.renewals.as_mut();
                let step = renewals
                    .and_then(|renewals| renewals.on_message(to, &[], message, clock::now()));
                self.on_renewal_step(step);
            }
            Some(RenewalStep::Send(to, message)) => self.send_renewal(&to, &message),
            Some(RenewalStep::SendToAll(message)) => {
                let nodes = self.machine.members().into_iter();
                for node in nodes.filter(|member| !member.name.is_part()) {
                    self.send_renewal(&node.name, &message);
                }
            }
            Some(RenewalStep::Work(work)) => {
                let membership = self.myself.clone();
                tokio::task::spawn_blocking(move || {
                    // A membership that has ended needs no outcome.
                    _ = membership.cast(MembershipMessage::Renewal { outcome: work() });
                });
            }
            None => {}
        }
    }

    /// Sends a message about a renewed certificate; a message that is too large is counted instead.
    fn send_renewal(&mut self, to: &NodeName, message: &RenewalMessage) {
        match postcard::to_allocvec(message) {
            Ok(body) if body.len() <= MAX_PAYLOAD_BYTES => {
                self.machine.send_renewal(to, &body, clock::now());
            }
            _ => self.counters.count(FrameEvent::Oversized),
        }
    }

    /// Publishes the list of living members if it has changed.
    fn publish_members(&self) {
        let members = self.machine.members();
        self.members.send_if_modified(|published| {
            let has_changed = *published != members;
            *published = members;
            has_changed
        });
    }
}

/// The node's certificates, and whether its own certificate was valid at the last check.
struct CertificateWatch {
    credentials: Arc<Credentials>,
    own: Option<Distrust>,
}

impl CertificateWatch {
    fn new(credentials: Arc<Credentials>) -> Self {
        Self {
            credentials,
            own: None,
        }
    }

    /// The current certificates and time. Logs when the node's own certificate becomes valid or
    /// invalid, for example after a change of the clock.
    fn identity(&mut self) -> Identity {
        let credentials = self.credentials.current();
        let wall = UnixTime::now();
        let own = credentials
            .verify_node(credentials.certificate(), wall)
            .err();
        match (&self.own, &own) {
            (None, Some(cause)) => tracing::warn!(
                %cause,
                "this node's certificate is not valid, so that no node admits it: waiting. Set this machine's clock, or \
                 issue a certificate by `ecod-node pki issue`"
            ),
            (Some(_), None) => tracing::info!("this node's certificate is valid now"),
            _ => {}
        }
        self.own = own;
        Identity { credentials, wall }
    }
}

/// Time between two checks of the certificates against the clock.
const CERTIFICATE_PERIOD: Duration = Duration::from_millis(500);

/// Time between two checks of this node's address: about as long as a leader may be silent.
const ADDRESS_PERIOD: Duration = Duration::from_millis(100);

async fn check_address(membership: ActorRef<MembershipMessage>) {
    while membership.cast(MembershipMessage::CheckAddress).is_ok() {
        tokio::time::sleep(ADDRESS_PERIOD).await;
    }
}

async fn check_certificates(
    credentials: Arc<Credentials>,
    membership: ActorRef<MembershipMessage>,
) {
    let mut known = credentials.current();
    loop {
        known = timeout(CERTIFICATE_PERIOD, credentials.changed(&known))
            .await
            .unwrap_or(known);
        if membership
            .cast(MembershipMessage::CheckCertificates)
            .is_err()
        {
            return;
        }
    }
}

/// Maximum datagrams before due timers run, even in a flood.
const MAX_DATAGRAMS_PER_WAKE: usize = 1024;

/// Wakes the actor when datagrams wait or a timer is due; the next `Wake` follows only after the
/// actor has handled this one.
async fn watch_socket(
    socket: Arc<GossipSocket>,
    mut deadline: watch::Receiver<Option<Timestamp>>,
    handled: Arc<Notify>,
    membership: ActorRef<MembershipMessage>,
) {
    loop {
        let due = *deadline.borrow_and_update();
        let wait = due.map_or(Duration::MAX, |due| due.since(clock::now()));
        tokio::select! {
            _ = socket.readable() => (),
            () = tokio::time::sleep(wait.min(MAX_SLEEP)) => (),
            changed = deadline.changed() => match changed {
                Ok(()) => continue,
                Err(_) => return,
            },
        }
        if membership.cast(MembershipMessage::Wake).is_err() {
            return;
        }
        handled.notified().await;
    }
}

/// Time between two attempts to join the multicast group.
const REJOIN_PERIOD: Duration = Duration::from_secs(5);

/// Joins the multicast group, if enabled; returns false if that fails.
fn join_group(socket: &GossipSocket, config: &MulticastConfig) -> bool {
    if config.enabled && socket.address().is_ipv6() {
        tracing::warn!(
            "`membership.bind` is an IPv6 address: multicast discovery is unavailable, set `membership.seeds`"
        );
    }
    match socket.join(config) {
        Ok(()) => true,
        Err(error) => {
            tracing::warn!(%error, group = %config.group, "no discovery by multicast, tried again");
            false
        }
    }
}

/// Joins the multicast group later: the network of a starting machine may come up after its node.
async fn join_later(socket: Arc<GossipSocket>, config: MulticastConfig) {
    loop {
        tokio::time::sleep(REJOIN_PERIOD).await;
        if socket.join(&config).is_ok() {
            return tracing::info!(group = %config.group, "discovery by multicast works");
        }
    }
}

const MAX_SLEEP: Duration = Duration::from_secs(60);

fn draw_secrets() -> Result<(SessionNonce, [u8; 32], u64), ActorProcessingErr> {
    let random = SystemRandom::new();
    let mut session = SessionNonce::default();
    let mut secret = [0; 32];
    let mut seed = [0; 8];
    let drawn = random
        .fill(&mut session)
        .and_then(|()| random.fill(&mut secret))
        .and_then(|()| random.fill(&mut seed));
    drawn.map_err(|_| "the system gives no random numbers")?;
    Ok((session, secret, u64::from_le_bytes(seed)))
}

fn log_admission(config: &MembershipConfig, proves: bool, address: SocketAddr) {
    if config.has_key() && proves {
        tracing::info!(%address, "looking for nodes that have the cell's key and a certificate");
    } else if config.has_key() {
        tracing::info!(%address, "looking for nodes that have the cell's key; certificates are not required");
    } else if address.ip().is_loopback() {
        tracing::info!(%address, "looking for nodes on this machine only: no cell key is set");
    } else if proves {
        tracing::warn!(%address, "looking for nodes that have a certificate; no cell key is set");
    } else {
        tracing::warn!(%address, "accepting any node: no cell key is set");
    }
}
