//! The actor that accepts the cell's maps, verdicts and reputations.
//!
//! ```text
//! Gateway ── HandleMap, HandleVerdicts, … ──> Follower ──> watch channels with the newest message of each kind; maps also to an optional log file
//!                                                  ├── RoundAccepted ──> LeaderElection
//!                                                  ├── HandleMap ──> Fuser
//!                                                  └── everything accepted ──> Door ──> programs beside the node
//! ```
//!
//! It owns the node's [`RoundFilter`], which decides by the current leadership. Each map is
//! therefore checked where it arrives, without another hop and without a lock.

mod map_log;

use std::path::PathBuf;
use std::sync::Arc;

use ecod::leadership::node::Input;
use ecod::leadership::round_filter::{AcceptedRound, Refusal, RoundFilter};
use ecod::leadership::{Leadership, Position};
use ecod::model::names::NodeName;
use ecod::wire::{GlobalMap, RejectReason, Reputations, Topic, Verdicts};
use ractor::{Actor, ActorProcessingErr, ActorRef};
use tokio::sync::watch;

use map_log::MapLog;

use crate::messages::actor_slot::ActorSlot;
use crate::messages::follower::FollowerMessage;
use crate::messages::fuser::FuserMessage;
use crate::messages::leader_election::LeaderElectionMessage;
use crate::messages::newest::{Newest, Received, ReceivedMap};
use crate::observe::recorder::{LogItem, LogSender};
use crate::platform::cell_clock::CellClock;
use crate::platform::clock;
use crate::telemetry::counters::{Counters, Event, OTHERS};
use crate::telemetry::spans::Spans;
use crate::transport::broker::Door;
use crate::transport::mqtt::Delivery;

/// Arguments of a follower's start.
pub struct FollowerArguments {
    /// Receives the newest map, verdicts and reputations.
    pub newest: Newest,
    /// A file to which every accepted map is appended with its time of receipt, one JSON
    /// object a line.
    pub log: Option<PathBuf>,
    /// Name of the cell whose rounds are accepted.
    pub cell: NodeName,
    /// The cell in which the vehicle is present: maps of other cells are not logged.
    pub present_cell: watch::Receiver<NodeName>,
    /// Records all accepted messages.
    pub recording: LogSender,
    /// The last term that an earlier run of the node wrote to disk.
    pub saved_term: u64,
    /// The leadership, as it changes.
    pub leadership: watch::Receiver<Leadership>,
    /// Receives the accepted rounds.
    pub election: ActorSlot<LeaderElectionMessage>,
    /// Continues from the accepted maps when the node leads.
    pub fuser: ActorSlot<FuserMessage>,
    /// Forwards all accepted messages to local programs.
    pub door: Door,
    /// The cell's time, shared by the node's actors.
    pub clock: CellClock,
    /// Counters of the node, shared by its actors.
    pub counters: Arc<Counters>,
    /// Tracing spans of the node, shared by its actors.
    pub spans: Spans,
}

/// Keeps the newest map, verdicts and reputations.
#[derive(Debug, Default)]
pub struct Follower;

/// The newest messages and their destinations.
pub struct FollowerState {
    newest: Newest,
    filter: RoundFilter,
    log: Option<MapLog>,
    recording: LogSender,
    leadership: watch::Receiver<Leadership>,
    election: ActorSlot<LeaderElectionMessage>,
    fuser: ActorSlot<FuserMessage>,
    door: Door,
    clock: CellClock,
    counters: Arc<Counters>,
    spans: Spans,
}

impl Actor for Follower {
    type Msg = FollowerMessage;
    type State = FollowerState;
    type Arguments = FollowerArguments;

    async fn pre_start(
        &self,
        _myself: ActorRef<Self::Msg>,
        arguments: Self::Arguments,
    ) -> Result<Self::State, ActorProcessingErr> {
        Ok(FollowerState::new(arguments))
    }

    async fn handle(
        &self,
        _myself: ActorRef<Self::Msg>,
        message: Self::Msg,
        state: &mut Self::State,
    ) -> Result<(), ActorProcessingErr> {
        let (taken, sender) = match message {
            FollowerMessage::HandleMap { delivery } => (
                state.on_map(&delivery),
                Some(delivery.message.aggregator.clone()),
            ),
            FollowerMessage::HandleVerdicts { delivery } => (
                state.on_verdicts(&delivery),
                Some(delivery.message.aggregator.clone()),
            ),
            FollowerMessage::HandleReputations { delivery } => (
                state.on_reputations(&delivery),
                delivery.message.aggregator.clone(),
            ),
        };
        match taken.map_err(Refusal::reject_reason) {
            Ok(()) => {}
            Err(Some(reason)) => {
                let sender = sender.as_ref().map_or(OTHERS, NodeName::as_str);
                match reason {
                    RejectReason::BadSignature => state.counters.reject_if_lasting(reason, sender),
                    _ => state.counters.reject(reason, sender),
                }
            }
            Err(None) => state.counters.count(Event::Repeated),
        }
        Ok(())
    }
}

impl FollowerState {
    fn new(arguments: FollowerArguments) -> Self {
        let FollowerArguments {
            newest,
            log,
            cell,
            present_cell,
            recording,
            saved_term,
            leadership,
            election,
            fuser,
            door,
            clock,
            counters,
            spans,
        } = arguments;
        let filter = RoundFilter::new(saved_term, clock::now());
        let log = log.map(|path| MapLog::new(path, cell, present_cell));
        Self {
            newest,
            filter,
            log,
            recording,
            leadership,
            election,
            fuser,
            door,
            clock,
            counters,
            spans,
        }
    }

    /// Handles a map from a link or from this node's fuser. An accepted map goes to the fuser,
    /// which continues from it if its term is confirmed; then to election, log, recording, watchers
    /// and local programs.
    ///
    /// # Errors
    /// Returns the reason why the filter refused the map; no state has changed for receivers.
    fn on_map(&mut self, delivery: &Delivery<Arc<GlobalMap>>) -> Result<(), Refusal> {
        let Delivery {
            message: map,
            origin,
            received_at,
            ..
        } = delivery;
        let received_at = *received_at;
        let accepted =
            self.filter
                .accept_map(map, *origin, received_at, &self.leadership.borrow())?;
        let _accept = self.spans.accept("map", &**map, received_at);
        self.counters.count(Event::MapAccepted);
        if accepted.is_known_term {
            self.fuser.send(FuserMessage::HandleMap {
                map: Arc::clone(map),
                received_at,
            });
        }
        self.notify_election(accepted);
        let received = ReceivedMap {
            received_at,
            map: Arc::clone(map),
        };
        if let Some(log) = &mut self.log {
            log.append(&ReceivedMap {
                received_at: self.clock.date(received_at),
                map: Arc::clone(map),
            });
        }
        self.recording
            .send(received_at, LogItem::Map(Arc::clone(map)));
        self.newest.map.send_replace(Some(received));
        self.door.publish_round(&Topic::GlobalDetections, &**map);
        self.door
            .request_reports(self.leadership.borrow().position == Position::Following);
        Ok(())
    }

    /// Handles verdicts: accepted ones go to recording, election, watchers and local programs.
    ///
    /// # Errors
    /// Returns the reason why the filter refused the verdicts.
    fn on_verdicts(&mut self, delivery: &Delivery<Arc<Verdicts>>) -> Result<(), Refusal> {
        let Delivery {
            message: verdicts,
            origin,
            received_at,
            ..
        } = delivery;
        let received_at = *received_at;
        let accepted = self.filter.accept_verdicts(
            verdicts,
            *origin,
            received_at,
            &self.leadership.borrow(),
        )?;
        let _accept = self.spans.accept("verdicts", &**verdicts, received_at);
        self.counters.count(Event::VerdictsAccepted);
        self.recording
            .send(received_at, LogItem::Verdicts(Arc::clone(verdicts)));
        self.notify_election(accepted);
        self.newest.verdicts.send_replace(Some(Received {
            received_at,
            message: Arc::clone(verdicts),
        }));
        self.door.publish_round(&Topic::GlobalVerdicts, &**verdicts);
        Ok(())
    }

    /// Handles reputations: accepted ones go to recording, watchers and local programs. Reputations
    /// are not a sign of life of the leader, because brokers retain them.
    ///
    /// # Errors
    /// Returns the reason why the filter refused the reputations.
    fn on_reputations(&mut self, delivery: &Delivery<Arc<Reputations>>) -> Result<(), Refusal> {
        let Delivery {
            message: reputations,
            origin,
            received_at,
            ..
        } = delivery;
        let received_at = *received_at;
        self.filter.accept_reputations(
            reputations,
            *origin,
            received_at,
            &self.leadership.borrow(),
        )?;
        self.counters.count(Event::ReputationsAccepted);
        self.recording
            .send(received_at, LogItem::Reputations(Arc::clone(reputations)));
        self.newest.reputations.send_replace(Some(Received {
            received_at,
            message: Arc::clone(reputations),
        }));
        self.door.publish_reputations(reputations);
        Ok(())
    }

    /// Reports an accepted round to the election if the round is a sign of life of its leader.
    fn notify_election(&self, accepted: AcceptedRound) {
        let AcceptedRound {
            epoch,
            round,
            is_sign_of_life,
            ..
        } = accepted;
        if is_sign_of_life {
            self.election.send(LeaderElectionMessage::Record {
                input: Input::RoundAccepted { epoch, round },
            });
        }
    }
}
