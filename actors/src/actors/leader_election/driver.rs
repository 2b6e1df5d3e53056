//! Converts messages to inputs of the node's leadership, and carries out its effects on the node's
//! parts.

use std::collections::{BTreeSet, VecDeque};
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use chrono::DateTime;
use ecod::diagnostics::{MISSING_TIMEOUT, MissingNode, TroubleKind, in_words};
use ecod::leadership::cell_time::{CellTime, ClockEvent, WrongClock};
use ecod::leadership::election::{ElectionMessage, Health};
use ecod::leadership::node::{self, Effect, Input, LeadershipNode, Notice};
use ecod::leadership::{BrokerAddress, Leadership};
use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ecod::wire::{Encoding, MAX_DISMISSED, NodeStatus, RejectReason, Role, Trouble};
use ractor::ActorRef;
use tokio::sync::watch;
use tokio::task::AbortHandle;
use tracing::field::display;

use super::life_signs::LifeSigns;
use super::term_writer::{TermState, TermWriter, saved_term};
use super::{LeaderElectionArguments, Parts, probe};
use crate::messages::description_keeper::DescriptionKeeperMessage;
use crate::messages::fuser::FuserMessage;
use crate::messages::gateway::GatewayMessage;
use crate::messages::leader_election::LeaderElectionMessage;
use crate::messages::membership::MembershipMessage;
use crate::messages::reputation_keeper::ReputationKeeperMessage;
use crate::messages::uplink::UplinkMessage;
use crate::observe::dashboard::LiveState;
use crate::observe::recorder::LogItem;
use crate::platform::cell_clock::CellClock;
use crate::platform::clock;
use crate::telemetry::counters::{Counters, Event};
use crate::telemetry::troubles::Troubles;
use crate::transport::gossip::{Member, MembershipEvent, is_of_this_machine};
use crate::transport::pki::{Credentials, DEFAULT_DAYS};

/// The node's leadership and the destinations of its effects.
pub struct ElectionDriver {
    machine: LeadershipNode,
    cell_time: CellTime,
    clock: CellClock,
    terms: TermWriter,
    members: watch::Receiver<Vec<Member>>,
    own_broker: watch::Receiver<Option<SocketAddr>>,
    page: watch::Receiver<Option<SocketAddr>>,
    parts: Parts,
    leadership: watch::Sender<Leadership>,
    counters: Arc<Counters>,
    life_signs: LifeSigns,
    live_state: Arc<LiveState>,
    /// True for a vehicle that moves from cell to cell.
    is_visitor: bool,
    /// Nodes whose absence is a trouble.
    missing: BTreeSet<NodeName>,
    /// Holders of certificates that declared more than these allow, as themselves or as a part.
    overreached: BTreeSet<NodeName>,
    name: NodeName,
    /// The leader's last complaint about this node: the leader and the trouble.
    complaint: Option<(NodeName, Trouble)>,
    /// Nodes at whose brokers this one has no login.
    no_login: Vec<NodeName>,
    /// The deadline for which the timer is set.
    alarm: Timestamp,
    timer: Option<AbortHandle>,
    myself: ActorRef<LeaderElectionMessage>,
}

impl ElectionDriver {
    pub(super) fn new(
        arguments: LeaderElectionArguments,
        myself: ActorRef<LeaderElectionMessage>,
    ) -> Self {
        let LeaderElectionArguments {
            settings,
            term_file,
            mut own_broker,
            page,
            members,
            parts,
            leadership,
            clock,
            cell,
            credentials,
            counters,
            live_state,
            is_visitor,
        } = arguments;
        let saved_term = saved_term(term_file.as_ref());
        own_broker.mark_changed();
        let cell_time = CellTime::new(settings.election.role);
        let name = settings.status.node.clone();
        let machine = LeadershipNode::new(settings, saved_term, &leadership.borrow(), clock::now());
        Self {
            machine,
            cell_time,
            clock,
            terms: TermWriter::new(term_file),
            members,
            own_broker,
            page,
            parts,
            leadership,
            counters,
            life_signs: LifeSigns::new(cell, credentials),
            live_state,
            is_visitor,
            missing: BTreeSet::new(),
            overreached: BTreeSet::new(),
            name,
            complaint: None,
            no_login: Vec::new(),
            alarm: Timestamp(u64::MAX),
            timer: None,
            myself,
        }
    }

    /// Handles an event of the membership. Most events become an input of the leadership. A
    /// datagram is decoded first; a false sign of life or an invalid message is counted and
    /// dropped, and stamps for the cell's time and the description are passed to their parts. An
    /// expelled node and a change of this machine's address concern other actors.
    pub(super) async fn on_membership_event(&mut self, event: MembershipEvent) {
        if let MembershipEvent::Alive { member } | MembershipEvent::Changed { member } = &event {
            self.life_signs.member_up(member);
        }
        let input = match event {
            MembershipEvent::Alive { member } => Input::MemberAlive {
                member: as_seen(&member),
            },
            MembershipEvent::Changed { member } => Input::MemberChanged {
                member: as_seen(&member),
            },
            MembershipEvent::Suspected { name } => Input::MemberSuspected { name },
            MembershipEvent::Expelled { name } => {
                self.cell_time.remove(&name);
                self.life_signs.remove(&name);
                self.parts.fuser.send(FuserMessage::Expel { node: name });
                return;
            }
            MembershipEvent::Down { name } => Input::MemberDown { name },
            MembershipEvent::Received {
                from,
                rights,
                payload,
                ..
            } => match ElectionMessage::decode(&payload) {
                Ok(message) => {
                    if !self.life_signs.is_proven(&message) {
                        self.counters
                            .reject(RejectReason::Unattested, from.as_str());
                        return tracing::debug!(%from, "a sign of life without its leader's signature");
                    }
                    if message.from == from {
                        if let Some(stamp) = message.description.as_deref().copied() {
                            let may_lead = rights.limit_role(message.candidacy.role) != Role::Cav;
                            let may_describe = may_lead && rights.may_describe;
                            self.parts
                                .description
                                .send(DescriptionKeeperMessage::HandleStamp {
                                    from: from.clone(),
                                    may_lead,
                                    may_describe,
                                    stamp,
                                });
                        }
                        self.cell_time.receive(&message, rights, clock::now());
                    }
                    Input::Receive {
                        from,
                        rights,
                        message,
                    }
                }
                Err(reason) => {
                    self.counters.reject(reason, from.as_str());
                    return tracing::debug!(%from, %reason, "election message dropped");
                }
            },
            MembershipEvent::Troubled { about, kind, cause } => {
                return self.counters.troubles().record_about(&about, kind, &cause);
            }
            MembershipEvent::Moved => {
                self.parts.gateway.send(GatewayMessage::Reconnect);
                self.parts.uplink.send(UplinkMessage::Reconnect);
                return;
            }
            // The node ends with this error.
            MembershipEvent::Excluded => return,
        };
        self.handle(input).await;
    }

    /// Processes another node's status: its own state, and the leader's complaints about this node.
    pub(super) async fn on_status(&mut self, status: &NodeStatus) {
        if self.leadership.borrow().leader() == Some(&status.node) && status.node != self.name {
            let of_this = |trouble: &&Trouble| {
                let about = trouble
                    .about
                    .as_ref()
                    .and_then(|about| NodeName::new(about).ok());
                let refuses =
                    TroubleKind::named(&trouble.kind).is_some_and(TroubleKind::refuses_reports);
                refuses && about.is_some_and(|about| about.vehicle() == self.name)
            };
            let complaint = status.troubles.iter().find(of_this).cloned();
            self.complaint = complaint.map(|trouble| (status.node.clone(), trouble));
        }
        self.handle(Input::StatusReceived {
            status: status.clone(),
        })
        .await;
    }

    /// Passes an input to the leadership, and carries out its effects before the next input.
    ///
    /// # Example
    /// The timer fires: the input is [`Input::Wake`]. The leadership returns a beat for `gauss`,
    /// which goes to the membership, and [`Effect::Observe`], whose answers are the inputs
    /// [`Input::Observed`] and [`Input::StatusParts`]. Both are processed, and the timer is set for the
    /// next deadline.
    pub(super) async fn handle(&mut self, input: Input) {
        if input == Input::Wake {
            self.alarm = Timestamp(u64::MAX);
        }
        let mut inputs = VecDeque::from([input]);
        if self.own_broker.has_changed().unwrap_or(false) {
            inputs.push_front(Input::OwnBroker {
                address: *self.own_broker.borrow_and_update(),
            });
        }
        while let Some(input) = inputs.pop_front() {
            for effect in self.machine.handle(input, clock::now()) {
                inputs.extend(self.carry_out(effect).await);
            }
        }
        self.cell_time
            .follow(&self.leadership.borrow(), clock::now());
        self.clock.show(self.cell_time.reading());
        self.set_timer();
    }

    /// Resigns, and waits until the last term is on disk.
    pub(super) async fn leave(&mut self) {
        self.handle(Input::Leave).await;
        self.terms.wait_for(u64::MAX).await;
    }

    /// Carries out an effect of the leadership; returns inputs that must be passed back at once.
    async fn carry_out(&mut self, effect: Effect) -> Vec<Input> {
        match effect {
            Effect::PersistTerm { term } => self.terms.save(term),
            Effect::Send { to, mut message } => {
                message.description = Some(Box::new(self.machine.description()));
                self.life_signs.sign(&mut message);
                message.clock = Some(Box::new(self.cell_time.stamps(&to, clock::now())));
                let payload = message.encode(Encoding::Cbor).into();
                self.parts
                    .membership
                    .send(MembershipMessage::Send { to, payload });
            }
            Effect::PublishLeadership { leadership } => self.publish_leadership(leadership),
            Effect::Lead {
                epoch,
                first_round,
                first,
            } => {
                let term = self.terms.wait_for(epoch.term).await;
                tracing::info!(%epoch, first_round, term_is_saved = term == TermState::Saved, "this node leads");
                self.parts.fuser.send(FuserMessage::Lead {
                    epoch,
                    first_round,
                    first,
                });
            }
            Effect::HoldRound => {
                self.parts.fuser.send(FuserMessage::HoldRound);
            }
            Effect::StopPublishing { epoch } => {
                tracing::info!(%epoch, "no longer leading");
                self.parts.fuser.send(FuserMessage::StopPublishing);
            }
            Effect::SetLinks { links } => {
                self.parts.gateway.send(GatewayMessage::SetReportBrokers {
                    addresses: links.report_brokers,
                });
                self.parts.gateway.send(GatewayMessage::SetBrokers {
                    addresses: links.brokers,
                });
            }
            Effect::PublishStatus { status } => {
                self.parts.door.publish_status(&status);
                self.parts
                    .recording
                    .send(clock::now(), LogItem::Status(Arc::new(status.clone())));
                self.parts.uplink.send(UplinkMessage::SetStatus {
                    status: status.clone(),
                });
                self.parts
                    .gateway
                    .send(GatewayMessage::PublishStatus { status });
            }
            Effect::SendSnapshot { to } => {
                self.parts
                    .keeper
                    .send(ReputationKeeperMessage::SendSnapshot { to });
            }
            Effect::Observe => {
                let events = self.cell_time.read_wall(
                    clock::wall_offset_us(),
                    &self.leadership.borrow(),
                    clock::now(),
                );
                events.into_iter().for_each(log_clock);
                self.live_state
                    .check_members(&self.members.borrow(), clock::now());
                self.update_troubles();
                let mut dismissed = self.live_state.expected().dismissed();
                if self.is_visitor {
                    dismissed.truncate(MAX_DISMISSED - 1);
                    dismissed.push(self.name.clone());
                }
                let observed = Input::Observed {
                    rounds_due: self.counters.events(Event::RoundDue),
                    load_percent: probe::load_percent().unwrap_or(0),
                    members: self.members.borrow().iter().map(as_seen).collect(),
                };
                let page = self.page.borrow().map(|page| page.to_string());
                let troubles = self.counters.troubles().present();
                return vec![
                    observed,
                    Input::StatusParts {
                        troubles,
                        page,
                        dismissed,
                    },
                ];
            }
            Effect::AskParts => {
                let certificate_ends = self.life_signs.credentials().is_some_and(probe::ends_soon);
                probe::ask_parts(&self.parts, certificate_ends, self.myself.clone());
            }
            Effect::CountImplausible { from } => self
                .counters
                .reject(RejectReason::OutOfRange, from.as_str()),
            Effect::Log {
                notice:
                    Notice::Overreached {
                        from,
                        role,
                        priority,
                        rights,
                    },
            } => {
                self.counters.count(Event::Overreached);
                self.counters
                    .reject(RejectReason::NotPermitted, from.as_str());
                if self.overreached.insert(from.vehicle()) {
                    tracing::warn!(
                        %from, %role, priority, allowed_role = %rights.role, allowed_priority = rights.priority,
                        "a node declares more than its certificate allows; the role and priority of the certificate \
                         apply; issue it a certificate by `ecod-node pki issue`, or lower its `role` or `election.priority`"
                    );
                }
            }
            Effect::Log {
                notice: Notice::NoLogin { at },
            } => {
                if at.is_empty() {
                    tracing::info!("logged in at all brokers in use again");
                }
                self.no_login = at;
            }
            Effect::Log { notice } => log(notice),
        }
        Vec::new()
    }

    /// Records troubles: wrong clocks, missing nodes, the leader's complaint, the end of the node's
    /// own certificate, and an unused description of the cell.
    fn update_troubles(&mut self) {
        let troubles = self.counters.troubles();
        let leadership = self.leadership.borrow();
        let mut is_clock_wrong = false;
        for clock in self.cell_time.wrong_clocks(clock::now()) {
            is_clock_wrong |= clock.node.is_none();
            if clock.node.is_none() || leadership.is_leading() {
                let about = clock.node.map(NodeName::as_str);
                troubles.record_with_remedy(
                    about,
                    TroubleKind::ClockOff,
                    &clock_words(&clock),
                    clock_remedy(&clock),
                );
            }
        }
        for name in &self.no_login {
            let cause =
                "it answers, but logins at its broker fail: this node or others may miss its maps";
            troubles.record_about(name.as_str(), TroubleKind::BrokerUnreachable, cause);
        }
        let missing = report_missing_nodes(&self.live_state.expected().missing(), troubles);
        for returned in self.missing.difference(&missing) {
            troubles.settle(TroubleKind::NodeMissing, Some(returned.as_str()));
        }
        let complaint = self
            .complaint
            .as_ref()
            .filter(|(leader, _)| leadership.leader() == Some(leader));
        if let Some((leader, Trouble { cause, remedy, .. })) = complaint {
            let cause = format!("reported by {leader}: {cause}");
            troubles.record_with_remedy(None, TroubleKind::ReportsRefused, &cause, remedy);
        }
        if let Some(credentials) = self.life_signs.credentials() {
            credentials.set_clock_wrong(is_clock_wrong);
            report_certificates(credentials, troubles);
        }
        match &self.parts.shared.borrow().problem {
            Some(problem) => troubles.record(TroubleKind::Description, problem),
            None => troubles.settle(TroubleKind::Description, None),
        }
        drop(leadership);
        self.missing = missing;
    }

    /// Publishes the leadership; a change of only the highest term does not notify readers.
    fn publish_leadership(&self, leadership: Leadership) {
        let Leadership {
            position,
            epoch,
            standby,
            ..
        } = leadership.clone();
        let has_moved = self.leadership.send_if_modified(|known| {
            let has_moved =
                (known.position, &known.epoch, &known.standby) != (position, &epoch, &standby);
            *known = leadership;
            has_moved
        });
        if has_moved {
            let epoch = epoch.as_ref().map(display);
            let standby = standby.as_ref().map(display);
            tracing::info!(
                %position,
                leader = epoch,
                standby,
                "the leader or the standby has changed"
            );
        }
    }

    /// Sets the timer for the leadership's next deadline, in place of the timer that was set
    /// before.
    fn set_timer(&mut self) {
        let due = self.machine.next_deadline();
        if due == self.alarm {
            return;
        }
        self.alarm = due;
        let wake = || LeaderElectionMessage::Record { input: Input::Wake };
        let timer = self.myself.send_after(due.since(clock::now()), wake);
        if let Some(superseded) = self.timer.replace(timer.abort_handle()) {
            superseded.abort();
        }
    }
}

/// Names in one text.
fn list(names: &[NodeName]) -> String {
    let names: Vec<_> = names.iter().map(NodeName::as_str).collect();
    names.join(", ")
}

/// Converts a member to the form that the node's leadership needs.
fn as_seen(member: &Member) -> node::SeenMember {
    node::SeenMember {
        name: member.name.clone(),
        run: member.run,
        broker: member.broker.map(BrokerAddress::from),
        is_on_this_machine: is_of_this_machine(member.gossip.ip()),
    }
}

/// Records the nodes that have been missing for long enough; returns their names.
fn report_missing_nodes(nodes: &[MissingNode], troubles: &Troubles) -> BTreeSet<NodeName> {
    let now = clock::now();
    let missing = nodes
        .iter()
        .filter(|node| now.since(node.last_seen) >= MISSING_TIMEOUT);
    missing
        .map(|node| {
            let cause = missing_words(now.since(node.last_seen), clock::wall());
            troubles.record_about(node.name.as_str(), TroubleKind::NodeMissing, &cause);
            node.name.clone()
        })
        .collect()
}

/// The absence of a node as text.
fn missing_words(absence: Duration, wall: Timestamp) -> String {
    let last_seen = wall - absence;
    let at = i64::try_from(last_seen.micros())
        .ok()
        .and_then(DateTime::from_timestamp_micros)
        .map_or_else(String::new, |at| {
            at.format(", last seen %Y-%m-%d %H:%M:%S UTC").to_string()
        });
    format!("gone for {}{at}", in_words(absence))
}

/// Records that the node's certificate ends soon and is not renewed, and that the cell's CA ends.
fn report_certificates(credentials: &Credentials, troubles: &Troubles) {
    let current = credentials.current();
    let now = clock::wall();
    let left = current.identity.due_for_renewal(now);
    match left.zip(credentials.unrenewed()) {
        Some((left, why)) => {
            let cause = format!("{}: {why}", ending("this node's certificate", left));
            troubles.record(TroubleKind::CertificateEnds, &cause);
        }
        None => troubles.settle(TroubleKind::CertificateEnds, None),
    }
    match current.ca_validity.remaining_within(CA_MARGIN, now) {
        Some(left) => troubles.record(TroubleKind::CaEnds, &ending("the cell's CA", left)),
        None => troubles.settle(TroubleKind::CaEnds, None),
    }
}

/// Remaining validity of the CA below which certificates that it issues end with it: their default
/// validity.
const CA_MARGIN: Duration = Duration::from_secs(DEFAULT_DAYS as u64 * 86_400);

/// The remaining validity of a certificate as text.
fn ending(what: &str, left: Duration) -> String {
    let count = |number: u64, unit: &str| {
        let plural = if number == 1 { "" } else { "s" };
        format!("{what} ends in {number} {unit}{plural}")
    };
    match left.as_secs() {
        0 => format!("{what} has ended"),
        seconds @ ..60 => count(seconds, "second"),
        seconds @ ..3600 => count(seconds / 60, "minute"),
        seconds @ ..86_400 => count(seconds / 3600, "hour"),
        seconds => count(seconds / 86_400, "day"),
    }
}

/// The error of a clock as text.
fn clock_words(clock: &WrongClock<'_>) -> String {
    let seconds = clock.error_us.unsigned_abs() as f64 / 1e6;
    let side = if clock.error_us > 0 {
        "ahead of"
    } else {
        "behind"
    };
    let others = if clock.is_cell_wrong {
        "the other clocks, and the cell uses it"
    } else {
        "the cell's time"
    };
    format!("its clock is {seconds:.1} s {side} {others}")
}

/// The remedy for the wrong clock or, if it is unclear which clock is wrong, for both.
fn clock_remedy(clock: &WrongClock<'_>) -> &'static str {
    if clock.is_certain {
        TroubleKind::ClockOff.remedy()
    } else {
        "no two clocks of the cell agree, so that another one may be wrong: run a time service on all nodes, such as chrony"
    }
}

/// Logs a step of a clock.
fn log_clock(event: ClockEvent) {
    let seconds = |micros: i64| micros as f64 / 1e6;
    match event {
        ClockEvent::WallStepped(step_us) => {
            tracing::info!(step_s = seconds(step_us), "this machine's clock was set");
        }
        ClockEvent::CellJumped(jump_us) => {
            tracing::info!(jump_s = seconds(jump_us), "the cell's time jumps");
        }
    };
}

/// Logs a notice of the leadership, at the level that it has for the operator.
fn log(notice: Notice) {
    match notice {
        Notice::Fit => tracing::info!("this node's parts work: it can lead"),
        Notice::Unfit {
            health:
                Health {
                    broker,
                    fuser,
                    gateway,
                    reports,
                    settings,
                    load_percent: _,
                },
        } => {
            tracing::warn!(
                broker,
                fuser,
                gateway,
                reports,
                settings,
                "this node cannot lead: a part does not work, or its settings or certificate do not allow it"
            );
        }
        Notice::OutOfReach { members } => tracing::warn!(
            members = list(&members),
            "other machines do not reach this node's broker: it does not lead; give the nodes certificates in [tls], \
             or set broker.allow_plaintext, or an external mqtt.broker that is there"
        ),
        Notice::ProcessGone { peer, broker } => {
            tracing::info!(%peer, %broker, "the process of another node has ended");
        }
        Notice::LeaderDisconnected { peer } => {
            tracing::info!(%peer, "the leader's connection to this node broke");
        }
        Notice::Preparing { leader } => tracing::info!(%leader, "preparing to take over"),
        Notice::NotServed { challenger } => {
            tracing::debug!(%challenger, "the lead is not handed over yet: no login at the challenger's broker");
        }
        Notice::Deserted {
            without_login,
            followers,
        } => tracing::warn!(
            without_login,
            followers,
            "followers cannot log in at this node's broker: check its certificate, `listen` and the firewall; if they \
             are more than half, the lead goes to another candidate"
        ),
        // Reported where these effects are carried out.
        Notice::Overreached { .. } | Notice::NoLogin { .. } => {}
        Notice::Misattributed { from, claimed } => {
            tracing::debug!(%from, %claimed, "election message in another's name dropped");
        }
    }
}
