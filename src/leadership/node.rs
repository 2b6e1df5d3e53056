//! The leadership of one node: a machine without clocks or sockets that decides what its actors
//! carry out.
//!
//! # Call order
//!
//! Call [`LeadershipNode::new`] with the saved term, then pass [`Input::OwnBroker`] if the node has
//! a broker. From then on call [`LeadershipNode::handle`] with every input, and with
//! [`Input::Wake`] at [`LeadershipNode::next_deadline`]. Carry out the [`Effect`]s in order, before
//! the next input. Equal inputs give equal effects.
//!
//! # Parts
//!
//! [`Election`] selects the leader. [`HealthMonitor`] decides whether the node is fit to lead, and
//! [`Links`] which brokers it needs. This machine passes inputs to these parts and returns their
//! effects. It also prepares handovers, and detects that a process has ended when an established
//! link broke and a new connection is refused.
//!
//! Rounds are not checked here. [`RoundFilter`](crate::leadership::round_filter::RoundFilter)
//! checks them where they arrive, using the [`Leadership`] that this machine publishes.

mod interface;
mod members;

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::time::Duration;

use uuid::Uuid;

pub use interface::{Effect, Input, NodeSettings, Notice, SeenMember};

use crate::leadership::address::BrokerAddress;
use crate::leadership::election::{
    Body, Election, ElectionEffect, ElectionInput, ElectionMessage, Health,
};
use crate::leadership::health::HealthMonitor;
use crate::leadership::links::{Brokers, LinkState, Links};
use crate::leadership::logins::Logins;
use crate::leadership::rights::Rights;
use crate::leadership::timers::{
    DRAIN_TIME, LATE_WAKE, LEDGER_TIMEOUT, PREPARATION_STEP, VEHICLE_CONNECT_TIME,
};
use crate::leadership::view::Leadership;
use crate::model::epoch::Epoch;
use crate::model::names::NodeName;
use crate::model::time::Timestamp;
use crate::wire::{DescriptionStamp, DescriptionStatus, NodeState, NodeStatus};
use members::Members;

/// Maximum number of nodes whose runs are stored, because brokers may report any number of names.
const MAX_RUNS: usize = 4096;

/// State machine of one node's leadership: the election, the health of the node's parts, and the
/// links that follow from the leader.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct LeadershipNode {
    election: Election,
    is_vehicle_only: bool,
    keeps_reputations: bool,
    round_period: Duration,
    members: Members,
    monitor: HealthMonitor,
    /// State of the parts as last reported to the election.
    health: Health,
    was_out_of_reach: bool,
    links: Links,
    logins: Logins,
    /// Followers that could not log in at this leader's broker at the last look.
    without_login: usize,
    /// True if these were all of its followers.
    is_deserted: bool,
    own_broker: Option<SocketAddr>,
    /// Last run of each node that was online, as reported through brokers.
    runs: BTreeMap<NodeName, Uuid>,
    /// Leaders that were ended by a broker's report, with their runs according to the membership.
    disconnected: BTreeMap<NodeName, Option<u64>>,
    preparation: Option<Preparation>,
    /// Epoch of the last accepted round. A node without messages from the election reports that it
    /// follows this epoch.
    accepted: Option<Epoch>,
    /// The leadership as last published.
    leadership: Leadership,
    status: NodeStatus,
    /// True if the current status was sent to the gateway.
    is_status_published: bool,
    deadline: Timestamp,
    /// True if sockets are read before timers run, after a late wake-up.
    is_draining: bool,
    effects: Vec<Effect>,
}

/// A handover to this node under way.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
struct Preparation {
    leader: NodeName,
    since: Timestamp,
    has_evidence: bool,
    check_at: Timestamp,
}

impl LeadershipNode {
    /// Creates the leadership of a node that starts. `saved_term` is the term of the last
    /// [`Effect::PersistTerm`] of earlier runs, or 0. `before` is the leadership that an earlier
    /// machine of this process published: it may have led in that term, and the disk may not
    /// contain it.
    pub fn new(
        settings: NodeSettings,
        saved_term: u64,
        before: &Leadership,
        now: Timestamp,
    ) -> Self {
        let is_vehicle_only = settings.is_vehicle_only();
        let NodeSettings {
            election,
            plane,
            round_period,
            keeps_reputations,
            status,
        } = settings;
        let told_term = before
            .epoch
            .as_ref()
            .map_or(0, |epoch| epoch.term.saturating_add(1));
        Self {
            election: Election::new(
                election,
                status.node.clone(),
                saved_term.max(told_term),
                now,
            ),
            is_vehicle_only,
            keeps_reputations,
            round_period,
            members: Members::default(),
            monitor: HealthMonitor::new(now),
            health: Health::default(),
            was_out_of_reach: false,
            links: Links::new(plane),
            logins: Logins::default(),
            without_login: 0,
            is_deserted: false,
            own_broker: None,
            runs: BTreeMap::new(),
            disconnected: BTreeMap::new(),
            preparation: None,
            accepted: status
                .aggregator
                .clone()
                .map(|aggregator| Epoch::new(status.epoch, aggregator)),
            leadership: before.clone(),
            status,
            is_status_published: false,
            deadline: now,
            is_draining: false,
            effects: Vec::new(),
        }
    }

    /// Processes an input; returns the effects to carry out.
    pub fn handle(&mut self, input: Input, now: Timestamp) -> Vec<Effect> {
        if let Input::Wake = input {
            if now.since(self.deadline) > LATE_WAKE && !self.is_draining {
                self.is_draining = true;
                self.deadline = now + DRAIN_TIME;
                return Vec::new();
            }
            self.is_draining = false;
            let effects = self.election.tick(now);
            self.carry_out(effects, now);
        } else {
            self.handle_input(input, now);
        }
        self.run_timers(now);
        self.publish_changes(now);
        if !self.is_draining {
            let preparation = self
                .preparation
                .as_ref()
                .map(|preparation| preparation.check_at);
            let deadline = self
                .election
                .next_deadline()
                .min(self.monitor.next_deadline());
            self.deadline = preparation.map_or(deadline, |check_at| check_at.min(deadline));
        }
        std::mem::take(&mut self.effects)
    }

    /// Time at which to pass [`Input::Wake`].
    pub fn next_deadline(&self) -> Timestamp {
        self.deadline
    }

    /// Stamp of the cell's description that the node has; version 0 without one.
    pub fn description(&self) -> DescriptionStamp {
        self.status
            .description
            .as_ref()
            .map(DescriptionStatus::stamp)
            .unwrap_or_default()
    }

    /// Read access to the election.
    pub fn election(&self) -> &Election {
        &self.election
    }

    /// Dispatches an input to the part that handles it. Two kinds of election messages are stopped
    /// here: messages under another node's name, and `Ready` from a challenger whose broker does
    /// not serve this node. For example, `MemberDown` removes the member and informs the election.
    fn handle_input(&mut self, input: Input, now: Timestamp) {
        match input {
            Input::Wake => {}
            Input::Receive { from, message, .. } if message.from != from => {
                self.log(Notice::Misattributed {
                    from,
                    claimed: message.from,
                });
            }
            Input::Receive { from, message, .. }
                if message.body == Body::Ready && !self.is_served_by(&from) =>
            {
                self.log(Notice::NotServed { challenger: from });
            }
            Input::Receive {
                rights, message, ..
            } => self.receive(message, rights, now),
            Input::MemberAlive { member } => self.member_up(member, now),
            Input::MemberChanged { member } => {
                self.members.place(member);
                self.update_health(now);
            }
            Input::MemberSuspected { name } => {
                self.feed(ElectionInput::PeerSuspected { peer: name }, now);
            }
            Input::MemberDown { name } => self.member_down(name, now),
            Input::OwnBroker { address } => self.own_broker = address,
            Input::BrokerProven { broker, node } => self.monitor.record_node(broker, node),
            Input::LinkChanged { broker, state } => self.on_link(&broker, state, now),
            Input::StatusReceived { status } => self.on_status(&status, now),
            Input::RoundAccepted { epoch, round } => self.on_round(epoch, round, now),
            Input::EvidenceReceived { from } => {
                if let Some(preparation) = self
                    .preparation
                    .as_mut()
                    .filter(|preparation| preparation.leader == from)
                {
                    preparation.has_evidence = true;
                }
            }
            Input::Observed {
                rounds_due,
                load_percent,
                members,
            } => {
                self.on_check(rounds_due, load_percent, members, now);
            }
            Input::PartsAnswered { sample } => {
                self.monitor.record_sample(sample);
                self.update_health(now);
            }
            Input::FuserRestarted => {
                // A new fuser does not lead: the leadership is over.
                if self.election.is_leading() {
                    self.set_health(
                        Health {
                            fuser: false,
                            ..self.health
                        },
                        now,
                    );
                }
            }
            Input::GatewayRestarted => {
                self.links.clear_wanted();
                self.monitor.drop_links();
                self.is_status_published = false;
                self.update_health(now);
            }
            Input::Described {
                description,
                round_period,
                keeps_reputations,
            } => {
                self.round_period = round_period;
                self.keeps_reputations = keeps_reputations;
                if self.status.description != description {
                    self.status.description = description;
                    self.is_status_published = false;
                    self.feed(ElectionInput::Greet, now);
                }
            }
            Input::StatusParts {
                troubles,
                page,
                dismissed,
            } => {
                let status = NodeStatus {
                    troubles,
                    page,
                    dismissed,
                    ..self.status.clone()
                };
                self.is_status_published &= status == self.status;
                self.status = status;
            }
            Input::Leave => self.feed(ElectionInput::Leave, now),
        }
    }

    /// Requests a check of the node's parts if one is due, and continues a preparation.
    fn run_timers(&mut self, now: Timestamp) {
        if self.monitor.is_due(now) {
            self.effects.push(Effect::Observe);
            // A vehicle only checks whether a login of unclear state is present.
            if !self.is_vehicle_only || self.logins.is_doubtful() {
                self.effects.push(Effect::AskParts);
            }
        }
        self.check_preparation(now);
    }

    /// Passes one input to the election, and carries out its effects before it returns.
    fn feed(&mut self, input: ElectionInput, now: Timestamp) {
        let effects = self.election.handle(input, now);
        self.carry_out(effects, now);
    }

    /// Converts the election's effects to effects of the node. For example, `Prepare` starts the
    /// preparation of a handover here instead of in the caller.
    fn carry_out(&mut self, effects: Vec<ElectionEffect>, now: Timestamp) {
        for effect in effects {
            let effect = match effect {
                ElectionEffect::PersistTerm { term } => Effect::PersistTerm { term },
                ElectionEffect::Send { to, message } => Effect::Send { to, message },
                ElectionEffect::HoldRound => Effect::HoldRound,
                ElectionEffect::StopPublishing { epoch } => Effect::StopPublishing { epoch },
                ElectionEffect::SendSnapshot { to } => Effect::SendSnapshot { to },
                ElectionEffect::CountImplausible { from } => Effect::CountImplausible { from },
                ElectionEffect::Lead {
                    epoch,
                    first_round,
                    first,
                } => {
                    self.preparation = None;
                    self.publish_leadership();
                    Effect::Lead {
                        epoch,
                        first_round,
                        first,
                    }
                }
                ElectionEffect::Prepare { leader } => {
                    self.preparation = Some(Preparation {
                        leader: leader.clone(),
                        since: now,
                        has_evidence: !self.keeps_reputations,
                        check_at: now + VEHICLE_CONNECT_TIME,
                    });
                    Effect::Log {
                        notice: Notice::Preparing { leader },
                    }
                }
            };
            self.effects.push(effect);
        }
    }

    /// Passes a message to the election after limiting it to the sender's rights. A message that
    /// declares a higher role or priority is not dropped: the permitted part is still used.
    fn receive(&mut self, message: ElectionMessage, rights: Rights, now: Timestamp) {
        let from = message.from.clone();
        let declared = message.candidacy;
        // Every follower vouches for its leader when it is asked; that counts only from a candidate.
        let vouches = matches!(message.body, Body::LeaderEvidence { .. });
        let limited = rights.limit(message);
        if limited
            .as_ref()
            .map_or(!vouches, |message| message.candidacy != declared)
        {
            self.log(Notice::Overreached {
                from,
                role: declared.role,
                priority: declared.priority,
                rights,
            });
        }
        if let Some(message) = limited {
            self.feed(ElectionInput::Receive { message }, now);
        }
    }

    /// Handles a member that was found or restarted: its former login is dropped, the
    /// election greets it, and the own broker must be reachable for it.
    fn member_up(&mut self, member: SeenMember, now: Timestamp) {
        let peer = member.name.clone();
        self.members.place(member);
        self.remove_login(&peer, now);
        self.feed(ElectionInput::PeerAlive { peer }, now);
        self.update_health(now);
    }

    /// Handles a member that the membership gave up: the election decides by the leader's beats
    /// whether it is lost.
    fn member_down(&mut self, name: NodeName, now: Timestamp) {
        self.members.member_down(&name, now);
        self.remove_login(&name, now);
        self.feed(ElectionInput::PeerDown { peer: name }, now);
    }

    /// Handles a changed link: updates the node's fitness. A link that was up and is now refused
    /// proves that the broker's process has ended, and with it each member that has this broker.
    ///
    /// # Example
    /// The leader `edge` is killed. Its connection breaks (`Down`), and the next attempt is refused
    /// (`Refused`): the node logs `ProcessGone` and passes `PeerGone` to the election, which
    /// replaces `edge` before its beats count as missing.
    fn on_link(&mut self, broker: &BrokerAddress, state: LinkState, now: Timestamp) {
        let is_gone = self.monitor.record_link(broker, state);
        self.update_health(now);
        // A broker that belongs to no node gives no evidence about any node.
        if is_gone && self.links.plane().external.as_ref() != Some(broker) {
            for peer in self.members.at(broker, now) {
                self.log(Notice::ProcessGone {
                    peer: peer.clone(),
                    broker: broker.clone(),
                });
                self.feed(ElectionInput::PeerGone { peer }, now);
            }
        }
    }

    /// Processes a status. If all nodes use one broker, the broker's report that the leader's
    /// connection broke is the fastest evidence of the leader's end. Any member can forge this
    /// report, so it ends the leader only once per run; later reports make this node ask about the
    /// leader.
    ///
    /// # Example
    /// All nodes use one external broker, which publishes the last will of the leader `edge`. The
    /// first will of this run ends `edge`'s leadership (`PeerGone`). A second will of the same run
    /// may be forged: it only makes the node query `edge` (`PeerSuspected`).
    fn on_status(&mut self, status: &NodeStatus, now: Timestamp) {
        let peer = status.node.clone();
        if status.state != NodeState::Offline {
            let has_room = self.runs.len() < MAX_RUNS && peer.vehicle() == peer;
            if has_room || self.runs.contains_key(&peer) {
                self.runs.insert(peer, status.id);
            }
            return;
        }
        let has_ended = self.runs.remove(&peer) == Some(status.id);
        if has_ended && !self.links.plane().embedded && self.election.leader() == Some(&peer) {
            self.log(Notice::LeaderDisconnected { peer: peer.clone() });
            let run = self.members.run_of(&peer);
            let is_first = self.disconnected.insert(peer.clone(), run) != Some(run);
            let input = if is_first {
                ElectionInput::PeerGone { peer }
            } else {
                ElectionInput::PeerSuspected { peer }
            };
            self.feed(input, now);
        }
    }

    /// Records an accepted round. Only rounds of the election's own epoch are evidence, because any
    /// client of a broker can publish rounds of other epochs.
    fn on_round(&mut self, epoch: Epoch, round: u64, now: Timestamp) {
        if self.election.epoch() == Some(&epoch) {
            self.feed(
                ElectionInput::Round {
                    epoch: epoch.clone(),
                    round,
                },
                now,
            );
        }
        self.accepted = Some(epoch);
    }

    /// Processes a check. The list of members compensates for events before the start, and for
    /// members that a restarted membership lost without an event.
    fn on_check(
        &mut self,
        rounds_due: u64,
        load_percent: u8,
        members: Vec<SeenMember>,
        now: Timestamp,
    ) {
        if !self.is_vehicle_only {
            self.monitor.record_load(rounds_due, load_percent, now);
            self.update_health(now);
        }
        for name in self.members.long_missing(&members, now) {
            self.member_down(name, now);
        }
        for member in members {
            if !self.members.contains(&member) {
                self.member_up(member, now);
            }
        }
        self.check_logins(now);
    }

    /// Checks whether this node is logged in at the brokers of leader and standby. With an external
    /// broker this is not required.
    fn check_logins(&mut self, now: Timestamp) {
        let plane = self.links.plane();
        let needs_none = !plane.embedded
            || plane
                .external
                .as_ref()
                .is_some_and(|at| self.monitor.is_logged_in(at));
        let used = [self.leadership.leader(), self.leadership.standby.as_ref()]
            .into_iter()
            .flatten();
        let others = used
            .chain(self.logins.missing())
            .filter(|name| *name != self.election.name());
        let is_at = |name: &NodeName| {
            Some(
                needs_none
                    || self
                        .monitor
                        .is_logged_in_at(name, &self.members.broker_of(name)?),
            )
        };
        let brokers = others.filter_map(|name| Some((name.clone(), is_at(name)?)));
        if self.logins.record(&brokers.collect()) {
            self.report_logins(now);
        }
        let (without_login, followers) = self.election.followers_without_login();
        let without_login = if self.election.is_leading() {
            without_login
        } else {
            0
        };
        if without_login > self.without_login {
            self.log(Notice::Deserted {
                without_login,
                followers,
            });
        }
        self.without_login = without_login;
        self.is_deserted = without_login > 0 && without_login == followers;
    }

    /// Removes the record of a login at a node's broker, because the node left or restarted;
    /// reports the change if the login was missing.
    fn remove_login(&mut self, name: &NodeName, now: Timestamp) {
        if self.logins.remove(name) {
            self.report_logins(now);
        }
    }

    /// Logs the brokers without a login and passes their nodes to the election.
    fn report_logins(&mut self, now: Timestamp) {
        let at: Vec<_> = self.logins.missing().cloned().collect();
        self.log(Notice::NoLogin { at: at.clone() });
        self.feed(ElectionInput::NoLogin { at }, now);
    }

    /// Ends the preparation of a handover when its time has come: vehicles had time to connect, the
    /// leader's evidence has arrived or its timeout has passed, and the node is fit. Otherwise
    /// checks again after [`PREPARATION_STEP`].
    fn check_preparation(&mut self, now: Timestamp) {
        let Some(preparation) = &mut self.preparation else {
            return;
        };
        // A clock that was set back does not put the check off.
        preparation.check_at = preparation.check_at.min(now + VEHICLE_CONNECT_TIME);
        if now < preparation.check_at {
            return;
        }
        if (preparation.has_evidence || now.since(preparation.since) >= LEDGER_TIMEOUT)
            && self.health.is_fit()
        {
            self.preparation = None;
            self.feed(ElectionInput::Prepared, now);
        } else {
            preparation.check_at = now + PREPARATION_STEP;
        }
    }

    /// Computes the node's fitness anew from links, parts and reachability, and passes a change to
    /// the election. Settings count as valid while there is no leader.
    fn update_health(&mut self, now: Timestamp) {
        let no_other = self.election.is_leading() && self.election.standby().is_none();
        let plane = self.links.plane();
        let brokers = self.links.brokers();
        let health = self
            .monitor
            .health(plane, brokers, no_other, self.round_period);
        let is_reached = self.is_reached(no_other);
        let settings = health.settings || self.election.leader().is_none();
        self.set_health(
            Health {
                broker: health.broker && is_reached,
                settings,
                ..health
            },
            now,
        );
    }

    /// True if this node is logged in at a broker with which the challenger would lead: the
    /// challenger's own broker, or an external broker. If no such broker admits this node, a
    /// handover would silence the cell. The challenger repeats its `Ready` message.
    fn is_served_by(&self, challenger: &NodeName) -> bool {
        let plane = self.links.plane();
        !plane.embedded
            || plane
                .external
                .as_ref()
                .is_some_and(|broker| self.monitor.is_logged_in(broker))
            || self
                .members
                .broker_of(challenger)
                .is_some_and(|at| self.monitor.is_logged_in_at(challenger, &at))
    }

    /// True if the members reach the broker that this node would lead with; the first time that
    /// they do not is logged.
    fn is_reached(&mut self, no_other: bool) -> bool {
        let is_private = self
            .own_broker
            .is_some_and(|broker| broker.ip().is_loopback());
        let is_reached = self.members.elsewhere().next().is_none()
            || self
                .monitor
                .reaches_others(self.links.plane(), is_private, no_other);
        if !is_reached && !std::mem::replace(&mut self.was_out_of_reach, true) {
            self.log(Notice::OutOfReach {
                members: self.members.elsewhere().cloned().collect(),
            });
        }
        is_reached
    }

    /// Logs the change between fit and unfit, and passes every change to the election. A vehicle
    /// that cannot lead has no fitness.
    fn set_health(&mut self, health: Health, now: Timestamp) {
        if self.is_vehicle_only || health == self.health {
            return;
        }
        let was_fit = self.health.is_fit();
        if health.is_fit() && !was_fit {
            self.log(Notice::Fit);
        } else if was_fit && !health.is_fit() {
            self.log(Notice::Unfit { health });
        }
        self.health = health;
        self.feed(ElectionInput::Health { health }, now);
    }

    /// Returns effects for leadership, links and status if they changed.
    fn publish_changes(&mut self, now: Timestamp) {
        self.publish_leadership();
        let broker = |name: Option<&NodeName>| match name {
            Some(name) if name == self.election.name() => self.own_broker.map(BrokerAddress::from),
            Some(name) => self.members.broker_of(name),
            None => None,
        };
        let own = self.own_broker.map(BrokerAddress::from);
        let brokers = match self.leadership.leader() {
            Some(leader) => {
                let missing = self
                    .logins
                    .missing()
                    .filter_map(|name| self.members.broker_of(name))
                    .collect();
                let standby = broker(self.leadership.standby.as_ref());
                Brokers {
                    own,
                    leader: broker(Some(leader)),
                    standby,
                    missing,
                }
            }
            None => Brokers {
                own,
                ..self.links.brokers().clone()
            },
        };
        if let Some(links) = self.links.update(brokers, now) {
            self.monitor.drop_links_except(&links.brokers);
            self.effects.push(Effect::SetLinks { links });
        }
        self.publish_status();
    }

    /// Adds [`Effect::PublishLeadership`] if this node's view of the leadership has changed.
    fn publish_leadership(&mut self) {
        let leadership = Leadership::of(&self.election, self.is_deserted);
        if leadership != self.leadership {
            self.leadership = leadership.clone();
            self.effects.push(Effect::PublishLeadership { leadership });
        }
    }

    /// Adds [`Effect::PublishStatus`] if state, epoch, aggregator or fitness have changed, or if
    /// other parts of the status have changed since the last publication. A node that seeks states
    /// the epoch of the last accepted round.
    fn publish_status(&mut self) {
        let epoch = self.leadership.present_epoch().or(self.accepted.as_ref());
        let state = if self.leadership.is_leading() {
            NodeState::Aggregating
        } else {
            NodeState::Following
        };
        let term = epoch.map_or(0, |epoch| epoch.term);
        let aggregator = epoch.map(|epoch| &epoch.leader);
        let fit = (!self.is_vehicle_only).then(|| self.health.is_fit());
        let published = (
            self.status.state,
            self.status.epoch,
            self.status.aggregator.as_ref(),
            self.status.fit,
        );
        if !self.is_status_published || published != (state, term, aggregator, fit) {
            let aggregator = aggregator.cloned();
            self.status = NodeStatus {
                state,
                epoch: term,
                aggregator,
                fit,
                ..self.status.clone()
            };
            self.is_status_published = true;
            self.effects.push(Effect::PublishStatus {
                status: self.status.clone(),
            });
        }
    }

    fn log(&mut self, notice: Notice) {
        self.effects.push(Effect::Log { notice });
    }
}

#[cfg(test)]
mod tests;
