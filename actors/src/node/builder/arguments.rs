//! Arguments of each part at its start.

use std::sync::{Arc, Mutex, PoisonError};

use ecod::admission::recent_reports::RecentReports;
use ecod::aggregator::Aggregator;
use ecod::leadership::Position;
use ecod::leadership::election::ElectionConfig;
use ecod::leadership::node::{Input, NodeSettings};
use ecod::model::epoch::Epoch;
use ecod::replay::JournalEvent;
use ecod::wire::{NodeState as NodeCondition, NodeStatus, ReportKind, Topics};
use ractor::{ActorCell, ActorRef};

use super::NodeBuilder;
use crate::actors::dashboard::DashboardArguments;
use crate::actors::description_keeper::DescriptionKeeperArguments;
use crate::actors::follower::FollowerArguments;
use crate::actors::fuser::{FuserArguments, QueuedReport};
use crate::actors::gateway::GatewayArguments;
use crate::actors::leader_election::{LeaderElectionArguments, Parts, saved_term};
use crate::actors::membership::MembershipArguments;
use crate::actors::recorder::RecorderArguments;
use crate::actors::reputation_keeper::ReputationKeeperArguments;
use crate::messages::actor_slot::ActorSlot;
use crate::messages::broker::BrokerMessage;
use crate::messages::description_keeper::DescriptionKeeperMessage;
use crate::messages::follower::FollowerMessage;
use crate::messages::fuser::FuserMessage;
use crate::messages::gateway::GatewayMessage;
use crate::messages::leader_election::LeaderElectionMessage;
use crate::messages::reputation_keeper::ReputationKeeperMessage;
use crate::node::config::NodeConfig;
use crate::node::slots::ActorKind;
use crate::node::{ActorSlots, NodeError, NodeMessage};
use crate::observe::dashboard::{NodeFacts, NodeSources};
use crate::observe::readiness::Vitals;
use crate::observe::recorder::{LogIdentity, LogItem};
use crate::platform::clock;
use crate::platform::state_file::StateFile;
use crate::telemetry::counters::ShedReason;
use crate::transport::broker::{Door, DoorSetup};
use crate::transport::gossip::{EventSink, MembershipConfig, MembershipEvent};
use crate::transport::mqtt::{Incoming, LinkState, Subscriber, SubscriptionRole};

impl NodeBuilder {
    pub(super) fn membership_arguments(&self) -> MembershipArguments {
        let election = self.slots.election.clone();
        let failed = self.failed.clone();
        let taken = NodeError::NameTaken {
            name: self.name.clone(),
            cell: self.config.cell.clone(),
        };
        let events: EventSink = Arc::new(move |event| {
            if event == MembershipEvent::Excluded {
                failed.send_replace(Some(taken.clone()));
            }
            election.send(LeaderElectionMessage::Membership { event });
        });
        let membership = &self.config.membership;
        MembershipArguments {
            name: self.name.clone(),
            cell: self.config.cell.clone(),
            run: clock::now().micros(),
            role: self.config.role,
            broker: *self.broker_address.borrow(),
            credentials: self.security.credentials.clone(),
            // Other nodes expect the membership at its former address.
            config: MembershipConfig {
                bind: self.gossip_address.borrow().or(membership.bind),
                ..membership.clone()
            },
            events,
            members: self.members.clone(),
            counters: self.frames(),
        }
    }

    pub(super) fn gateway_arguments(&self) -> GatewayArguments {
        GatewayArguments {
            cell: self.config.cell.clone(),
            role: self.gateway_part(),
            status: self.status(),
            mqtt: self.config.mqtt.clone(),
            security: self.security.clone().with_members(self.members()),
            clock: self.clock.clone(),
            counters: self.counters(),
            subscriber: self.subscriber(),
            seed: self.run.as_u64_pair().1,
            only_observes: self.config.only_observes(),
        }
    }

    fn gateway_part(&self) -> SubscriptionRole {
        if self.config.may_lead() {
            SubscriptionRole::Candidate
        } else if self
            .config
            .record
            .as_ref()
            .is_some_and(|record| record.reports)
        {
            SubscriptionRole::Observer
        } else {
            SubscriptionRole::Follower
        }
    }

    /// The identity of the node's log; `record.name` replaces the node's name if it is set.
    fn log_identity(&self) -> LogIdentity {
        let NodeConfig {
            cell,
            fusion,
            landmarks,
            record,
            ..
        } = &self.config;
        let named = record.as_ref().and_then(|record| record.name.clone());
        let node = named.unwrap_or_else(|| self.name.clone());
        LogIdentity::new(
            node,
            self.run,
            cell.clone(),
            fusion.clone(),
            landmarks.clone(),
        )
    }

    pub(super) fn recorder_arguments(&self) -> Option<RecorderArguments> {
        Some(RecorderArguments {
            config: self.config.record.clone()?,
            identity: self.log_identity(),
            recording: self.recording.clone(),
            leadership: self.leadership(),
            counters: self.counters(),
        })
    }

    /// Passes incoming messages to the responsible parts. Reports are recorded by the fuser if
    /// there is one, in the order in which they are fused.
    fn subscriber(&self) -> Subscriber {
        let ActorSlots {
            fuser,
            follower,
            keeper,
            election,
            description,
            ..
        } = self.slots.clone();
        let name = self.name.clone();
        let live_state = Arc::clone(&self.live_state);
        let leadership = self.leadership();
        let recording = self.recording.clone();
        let fuses = self.config.may_lead();
        let report_queue = self.report_queue.clone();
        let counters = self.counters();
        let door = self.door.clone();
        let recent_reports = Mutex::<RecentReports>::default();
        Arc::new(move |delivery| {
            let at = delivery.received_at;
            live_state.update(&delivery.message, at);
            match &delivery.message {
                Incoming::Report { kind, report } => door.publish_report(*kind, report),
                Incoming::Status { status, .. } => door.publish_status(status),
                _ => {}
            }
            match &delivery.message {
                Incoming::Report { kind, report } if !fuses => {
                    let mut recent_reports = recent_reports
                        .lock()
                        .unwrap_or_else(PoisonError::into_inner);
                    if recent_reports.is_new(*kind, report) {
                        recording.send(at, LogItem::Report(*kind, Arc::clone(report)));
                    }
                    true
                }
                // Evidence is for current and future leaders; other nodes that receive it only
                // display it.
                Incoming::Report { report, .. }
                    if live_state.wants_reports()
                        && report.node.vehicle() != name
                        && leadership.borrow().position == Position::Following =>
                {
                    true
                }
                Incoming::Report { kind, report } => {
                    let kind = *kind;
                    let report = Arc::clone(report);
                    let node = report.node.clone();
                    let outcome =
                        report_queue.push(delivery.map(|_| QueuedReport { kind, report }));
                    if outcome.has_replaced {
                        counters.shed(ShedReason::ReportReplaced, node.as_str());
                    }
                    if outcome.is_over_budget {
                        counters.shed(ShedReason::ObjectsThrottled, node.vehicle().as_str());
                        return;
                    }
                    !outcome.is_first || fuser.send(FuserMessage::HandleReports)
                }
                Incoming::Map(map) => {
                    let map = Arc::clone(map);
                    follower.send(FollowerMessage::HandleMap {
                        delivery: delivery.map(|_| map),
                    })
                }
                Incoming::Verdicts(verdicts) => {
                    let verdicts = Arc::clone(verdicts);
                    follower.send(FollowerMessage::HandleVerdicts {
                        delivery: delivery.map(|_| verdicts),
                    })
                }
                Incoming::Reputations(reputations) => {
                    let reputations = Arc::clone(reputations);
                    follower.send(FollowerMessage::HandleReputations {
                        delivery: delivery.map(|_| reputations),
                    })
                }
                Incoming::Description(body) => {
                    let body = Arc::clone(body);
                    description.send(DescriptionKeeperMessage::HandleDescription {
                        delivery: delivery.map(|_| body),
                    })
                }
                Incoming::Ledger(share) if !fuses => {
                    recording.send(at, LogItem::Share(Arc::clone(share)));
                    true
                }
                Incoming::Ledger(share) => {
                    recording.send(at, LogItem::Share(Arc::clone(share)));
                    let share = Arc::clone(share);
                    keeper.send(ReputationKeeperMessage::Merge {
                        delivery: delivery.map(|_| share),
                    })
                }
                Incoming::Link { broker, state } => {
                    recording.send(at, LogItem::Link(broker.clone(), *state));
                    if *state == LinkState::Up {
                        description.send(DescriptionKeeperMessage::Connected);
                    }
                    if let Some(node) = delivery.broker.clone() {
                        let input = Input::BrokerProven {
                            broker: broker.clone(),
                            node,
                        };
                        election.send(LeaderElectionMessage::Record { input });
                    }
                    let input = Input::LinkChanged {
                        broker: broker.clone(),
                        state: *state,
                    };
                    election.send(LeaderElectionMessage::Record { input })
                }
                // Only pages use it.
                Incoming::StatusWithdrawn { .. } => true,
                Incoming::Status { status, .. } => {
                    recording.send(at, LogItem::Status(Arc::clone(status)));
                    let status = Arc::clone(status);
                    election.send(LeaderElectionMessage::HandleStatus {
                        delivery: delivery.map(|_| status),
                    })
                }
            };
        })
    }

    pub(super) fn follower_arguments(&self) -> FollowerArguments {
        FollowerArguments {
            newest: self.newest.clone(),
            log: self.config.map_log.clone(),
            cell: self.config.cell.clone(),
            present_cell: self.vehicle.present_cell.subscribe(),
            recording: self.recording.clone(),
            saved_term: saved_term(self.state_file("term").as_ref()),
            leadership: self.leadership(),
            election: self.slots.election.clone(),
            fuser: self.slots.fuser.clone(),
            door: self.door.clone(),
            clock: self.clock.clone(),
            counters: self.counters(),
            spans: self.spans(),
        }
    }

    pub(super) fn description_arguments(
        &self,
        supervisor: ActorCell,
    ) -> DescriptionKeeperArguments {
        let supervisor = ActorRef::<NodeMessage>::from(supervisor);
        DescriptionKeeperArguments {
            name: self.name.clone(),
            may_lead: self.config.may_lead(),
            held: self.held.description.clone(),
            file: self.state_file("description"),
            credentials: self.security.credentials.clone(),
            // A supervisor that has ended needs no settings.
            apply: Arc::new(move |description| {
                _ = supervisor.cast(NodeMessage::Describe { description });
            }),
            members: self.members(),
            leadership: self.leadership(),
            gateway: self.slots.gateway.clone(),
            counters: self.counters(),
        }
    }

    pub(super) fn keeper_arguments(&self) -> ReputationKeeperArguments {
        ReputationKeeperArguments {
            name: self.name.clone(),
            cell: self.config.cell.clone(),
            reputation: self.config.fusion.reputation.clone(),
            config: self.config.reputations.clone(),
            reputations: self.reputations.clone(),
            file: self.state_file("reputations"),
            credentials: self.security.credentials.clone(),
            newest: self.newest.reputations.subscribe(),
            members: self.members(),
            leadership: self.leadership(),
            gateway: self.slots.gateway.clone(),
            fuser: self.slots.fuser.clone(),
            election: self.slots.election.clone(),
            clock: self.clock.clone(),
            counters: self.counters(),
        }
    }

    /// A fuser starts with the keeper's evidence, and continues with the objects of the newest map.
    pub(super) fn fuser_arguments(&self) -> FuserArguments {
        let fusion = self.config.fusion.clone();
        let landmarks = self.config.landmarks();
        let now = clock::now();
        let ledger = Arc::new(self.reputations.open().ledger.clone());
        let mut aggregator = Aggregator::new_standby(fusion, landmarks, now);
        aggregator.adopt(&ledger);
        self.recording
            .send(now, LogItem::Journal(JournalEvent::Start { ledger }));
        FuserArguments {
            aggregator,
            recording: self.recording.clone(),
            report_queue: self.report_queue.clone(),
            newest: self
                .newest
                .map
                .borrow()
                .as_ref()
                .map(|newest| (Arc::clone(&newest.map), newest.received_at)),
            clock: self.clock.clone(),
            gateway: self.slots.gateway.clone(),
            keeper: self.slots.keeper.clone(),
            counters: self.counters(),
            spans: self.spans(),
        }
    }

    pub(super) fn election_arguments(&self) -> LeaderElectionArguments {
        let ActorSlots {
            membership,
            gateway,
            fuser,
            keeper,
            description,
            uplink,
            ..
        } = self.slots.clone();
        let broker = self.cell_broker();
        let door = self.door.clone();
        LeaderElectionArguments {
            settings: NodeSettings {
                election: ElectionConfig {
                    role: self.config.role,
                    ..self.config.election.clone()
                },
                plane: self.config.data_plane(),
                round_period: self.round_period(),
                keeps_reputations: self.parts().contains(&ActorKind::ReputationKeeper),
                status: self.status(),
            },
            term_file: self.state_file("term"),
            own_broker: self.broker_address(),
            page: self.dashboard_address(),
            members: self.members(),
            parts: Parts {
                membership,
                gateway,
                fuser,
                keeper,
                description,
                uplink,
                broker,
                door,
                recording: self.recording.clone(),
                shared: self.shared.subscribe(),
            },
            leadership: self.leadership.clone(),
            cell: self.config.cell.clone(),
            credentials: self.security.credentials.clone(),
            clock: self.clock.clone(),
            counters: self.counters(),
            live_state: self.live_state(),
            is_visitor: self.moves_on(),
        }
    }

    pub(super) fn dashboard_arguments(&self) -> DashboardArguments {
        let node = NodeFacts {
            name: self.name.clone(),
            cell: self.config.cell.clone(),
            role: self.config.role,
            camera: !self.vehicle.shown_cameras.is_empty(),
            cameras: self
                .vehicle
                .shown_cameras
                .iter()
                .map(|camera| camera.name.clone())
                .collect(),
            pictures: Vec::new(),
            floor_plan: self.floor_plan.as_ref().map(|plan| plan.facts.clone()),
            origin: self.config.origin,
            version: env!("CARGO_PKG_VERSION"),
            started_at_us: self.started_at,
            round_period_s: self.config.fusion.round.period_s,
            door: *self.vehicle.listens_at.borrow(),
            guide: self.config.reporting(*self.vehicle.listens_at.borrow()),
            certificate_ends_us: None,
        };
        let sources = NodeSources {
            node,
            vitals: self.vitals(),
            members: self.members(),
            counters: self.counters(),
            frames: self.frames(),
            live_state: Arc::clone(&self.live_state),
            cameras: self.vehicle.shown_cameras.clone(),
            further_cameras: self.vehicle.further_cameras.subscribe(),
            floor_plan: self.floor_plan.clone(),
        };
        DashboardArguments {
            config: self.config.dashboard.clone(),
            sources,
            bound: self.vehicle.dashboard_address.clone(),
        }
    }

    /// Facts on which the node's readiness is judged.
    pub(in crate::node) fn vitals(&self) -> Vitals {
        Vitals {
            newest: self.newest.clone(),
            leadership: self.leadership(),
            clock: self.clock.clone(),
            plane: self.config.data_plane(),
            shared: self.shared.subscribe(),
            security: self.security.clone(),
            counters: self.counters(),
            fuser: self.slots.fuser.clone(),
            gateway: self.slots.gateway.clone(),
            broker: self.cell_broker(),
        }
    }

    /// The node's broker, if it may carry the cell's data.
    fn cell_broker(&self) -> ActorSlot<BrokerMessage> {
        if self.config.serves_nodes() {
            self.slots.broker.clone()
        } else {
            ActorSlot::default()
        }
    }

    /// The connection of local programs to the cell.
    pub(super) fn new_door(&self) -> Door {
        if !self.config.broker.door {
            return Door::default();
        }
        let leadership = self.leadership();
        let members = self.members();
        let credentials = self.security.credentials.clone();
        let own_config = self.own_config.clone();
        let description = self.slots.description.clone();
        let shared = self.shared.subscribe();
        let to_project = self.shared.subscribe();
        let may_lead = self.config.may_lead();
        let to_dismiss = self.live_state();
        let gateway = self.slots.gateway.clone();
        let to_watch = self.slots.gateway.clone();
        let live_state = Arc::clone(&self.live_state);
        Door::new(DoorSetup {
            node: self.name.clone(),
            gateway_id: format!("{}-{}", self.name, self.run.simple()),
            topics: Topics::new(&self.config.cell),
            limits: self.config.mqtt.limits(),
            encoding: self.config.mqtt.encoding,
            max_report_hz: self.config.mqtt.max_report_hz,
            serves_nodes: self.config.serves_nodes(),
            follows: Arc::new(move || leadership.borrow().position == Position::Following),
            fuses: Arc::new(move |kind| match kind {
                ReportKind::Detections => shared.borrow().algorithms.pace(),
                ReportKind::VoteDetections => shared.borrow().algorithms.vote(),
            }),
            is_member: Arc::new(move |name| {
                members.borrow().iter().any(|member| member.name == *name)
            }),
            project: Arc::new(move |report| {
                let boxes = Arc::clone(&to_project.borrow().boxes);
                boxes.project(report)
            }),
            report: Arc::new(move |kind, report| {
                gateway.send(GatewayMessage::PublishReport { kind, report });
            }),
            describe: Arc::new(move |text| {
                if !own_config.may_lead() {
                    return Err("this node never leads and only follows: set the description at one that may".into());
                }
                if credentials
                    .as_ref()
                    .is_some_and(|credentials| !credentials.may_describe())
                {
                    let remedy = "set it at an operator's node, such as that of the machine where `ecod-node init` was run";
                    return Err(format!(
                        "the certificate of this node does not let it describe the cell: {remedy}, or issue a certificate by \
                         `ecod-node pki issue --operator`"
                    ));
                }
                own_config
                    .described(&text)
                    .map_err(|error| error.to_string())?;
                let is_sent = description.send(DescriptionKeeperMessage::Set { text });
                if is_sent {
                    Ok(())
                } else {
                    Err("the node is just starting: try again".into())
                }
            }),
            dismiss: Arc::new(move |name| {
                if !may_lead {
                    return Err("this node never leads and only follows: dismiss the node at one that may lead".into());
                }
                let is_dismissed = to_dismiss.dismiss(&name, clock::now());
                is_dismissed.then_some(()).ok_or_else(|| {
                    format!("{name} answers, or this node has not seen it as a member; a node that answers leaves when it is stopped")
                })
            }),
            watch_reports: Arc::new(move |wanted| {
                live_state.set_programs_want_reports(wanted);
                to_watch.send(GatewayMessage::WatchReports {
                    wanted: live_state.wants_reports(),
                });
            }),
            counters: self.counters(),
        })
    }

    fn state_file(&self, what: &str) -> Option<StateFile> {
        let directory = self.config.state_dir.as_deref()?;
        Some(StateFile::new(
            directory,
            &self.config.cell,
            &self.name,
            what,
        ))
    }

    /// The node's status when a part starts or restarts: it follows the same leader as before.
    pub(super) fn status(&self) -> NodeStatus {
        let newest = self.newest.map.borrow();
        let taken = newest
            .as_ref()
            .map(|received| Epoch::new(received.map.epoch, received.map.aggregator.clone()));
        let leadership = self.leadership.borrow();
        let epoch = leadership
            .epoch
            .clone()
            .filter(|_| leadership.leader().is_some())
            .or(taken);
        NodeStatus {
            state: if leadership.is_leading() {
                NodeCondition::Aggregating
            } else {
                NodeCondition::Following
            },
            epoch: epoch.as_ref().map_or(0, |epoch| epoch.term),
            aggregator: epoch.map(|epoch| epoch.leader),
            fit: self.config.may_lead().then_some(false),
            description: self.held.status(),
            ..NodeStatus::starting(
                self.name.clone(),
                self.run,
                self.config.role,
                env!("CARGO_PKG_VERSION"),
            )
        }
    }
}

#[cfg(test)]
mod tests {
    use ecod::model::time::Timestamp;
    use ecod::wire::{GlobalMap, Role};

    use ecod::model::names::NodeName;
    use tokio::sync::watch;

    use super::*;
    use crate::messages::newest::ReceivedMap;
    use crate::node::config::NodeConfig;
    use crate::node::description::HeldDescription;
    use crate::node::presence::{Presence, VehicleParts};
    use crate::transport::mqtt::Security;

    fn builder(config: NodeConfig) -> NodeBuilder {
        let vehicle = VehicleParts::new(&config);
        let held = HeldDescription::default();
        NodeBuilder::new(
            vehicle,
            Presence::Active,
            config,
            Security::default(),
            held,
            watch::Sender::new(None),
        )
    }

    #[test]
    fn rating_candidate_keeps_reputations() {
        use ecod::aggregator::Algorithms::{Both, Pace};
        use ecod::tracking::TracksMode::{Auto, Off, On};
        let spot = toml::from_str("id = \"slot\"\nx_m = 0.0\ny_m = 0.0").unwrap();
        for (algorithms, mode, landmarks, expected) in [
            (Both, Off, vec![], true),
            (Pace, Auto, vec![], true),
            (Pace, On, vec![spot], true),
            (Pace, Off, vec![], false),
        ] {
            let mut config = NodeConfig {
                role: Role::Edge,
                landmarks,
                ..NodeConfig::default()
            };
            config.fusion.algorithms = algorithms;
            config.fusion.tracks.mode = mode;
            let builder = builder(config);
            let keeps = builder
                .parts()
                .contains(&crate::node::slots::ActorKind::ReputationKeeper);
            assert_eq!(keeps, expected, "{algorithms:?} {mode:?}");
        }
    }

    #[test]
    fn restarted_part_still_reports_aggregator() {
        let config = NodeConfig {
            role: Role::Cav,
            ..NodeConfig::default()
        };
        let builder = builder(config);
        assert_eq!(
            (builder.status().epoch, builder.status().aggregator),
            (0, None)
        );
        let map = GlobalMap::new(
            &Epoch::new(7, NodeName::from_static("edge")),
            1,
            Timestamp(0),
        );
        builder.newest.map.send_replace(Some(ReceivedMap {
            received_at: Timestamp(0),
            map: Arc::new(map),
        }));
        assert_eq!(
            (
                builder.status().epoch,
                builder.status().aggregator.as_ref().map(NodeName::as_str)
            ),
            (7, Some("edge"))
        );
    }
}
