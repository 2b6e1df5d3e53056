//! The actor that takes the cell's maps, verdicts and reputations.
//!
//! ```text
//! Gateway ── TakeMap, TakeVerdicts, … ──> Follower ──> watches of the newest of each; maps also to an optional log file
//!                                            ├── RoundAccepted ──> LeaderElection
//!                                            └── TakeMap ──> Fuser
//! ```
//!
//! It owns the node's [`RoundFilter`], which decides by the leadership of the moment. So each map is judged where it
//! arrives, without another hop and without a lock.

use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use ecod::leadership::Leadership;
use ecod::leadership::node::Input;
use ecod::leadership::round_filter::{AcceptedRound, Refusal, RoundFilter};
use ecod::model::time::Timestamp;
use ecod::wire::{GlobalMap, Reputations, Verdicts};
use ractor::{Actor, ActorProcessingErr, ActorRef};
use tokio::sync::watch;

use crate::messages::actor_slot::ActorSlot;
use crate::messages::follower::FollowerMessage;
use crate::messages::fuser::FuserMessage;
use crate::messages::leader_election::LeaderElectionMessage;
use crate::messages::newest::{Newest, Received, ReceivedMap};
use crate::observe::recorder::{LogItem, LogSender};
use crate::platform::cell_clock::CellClock;
use crate::telemetry::counters::{Counters, Event};
use crate::telemetry::spans::Spans;

/// What a follower needs at its start.
pub struct FollowerArguments {
    /// Gets the newest of everything.
    pub newest: Newest,
    /// A file to which every accepted map is appended with its time of receipt, one JSON
    /// object a line.
    pub log: Option<PathBuf>,
    /// Where everything accepted is recorded.
    pub recording: LogSender,
    /// The last term that an earlier run of the node wrote to disk.
    pub saved_term: u64,
    /// Who leads.
    pub leadership: watch::Receiver<Leadership>,
    /// Is told of the rounds taken.
    pub election: ActorSlot<LeaderElectionMessage>,
    /// Goes on from the maps taken, when the node leads.
    pub fuser: ActorSlot<FuserMessage>,
    /// The cell's time.
    pub clock: CellClock,
    /// The node's counters.
    pub counters: Arc<Counters>,
    /// The node's spans.
    pub spans: Spans,
}

/// Keeps the newest map, verdicts and reputations.
#[derive(Debug, Default)]
pub struct Follower;

/// The newest of everything and where it goes.
pub struct FollowerState {
    newest: Newest,
    filter: RoundFilter,
    log: Option<BufWriter<File>>,
    recording: LogSender,
    leadership: watch::Receiver<Leadership>,
    election: ActorSlot<LeaderElectionMessage>,
    fuser: ActorSlot<FuserMessage>,
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
        let log = arguments.log.as_deref().map(open).transpose()?;
        Ok(FollowerState::new(arguments, log))
    }

    async fn handle(
        &self,
        _myself: ActorRef<Self::Msg>,
        message: Self::Msg,
        state: &mut Self::State,
    ) -> Result<(), ActorProcessingErr> {
        let taken = match message {
            FollowerMessage::TakeMap { delivery } => state.take_map(&delivery.message, delivery.received_at),
            FollowerMessage::TakeVerdicts { delivery } => state.take_verdicts(&delivery.message, delivery.received_at),
            FollowerMessage::TakeReputations { delivery } => {
                state.take_reputations(&delivery.message, delivery.received_at)
            }
        };
        match taken.map_err(Refusal::reject_reason) {
            Ok(()) => {}
            Err(Some(reason)) => state.counters.reject(reason),
            Err(None) => state.counters.count(Event::Repeated),
        }
        Ok(())
    }
}

impl FollowerState {
    fn new(arguments: FollowerArguments, log: Option<BufWriter<File>>) -> Self {
        let FollowerArguments {
            newest,
            recording,
            saved_term,
            leadership,
            election,
            fuser,
            clock,
            counters,
            spans,
            ..
        } = arguments;
        let filter = RoundFilter::new(saved_term);
        Self { newest, filter, log, recording, leadership, election, fuser, clock, counters, spans }
    }

    fn take_map(&mut self, map: &Arc<GlobalMap>, received_at: Timestamp) -> Result<(), Refusal> {
        let accepted = self.filter.accept_map(map, received_at, &self.leadership.borrow())?;
        let _accept = self.spans.accept("map", &**map, received_at);
        self.counters.count(Event::MapAccepted);
        if accepted.is_known_term {
            self.fuser.send(FuserMessage::TakeMap { map: Arc::clone(map), received_at });
        }
        self.tell_election(accepted);
        self.write(&ReceivedMap { received_at: self.clock.date(received_at), map: Arc::clone(map) });
        let received = ReceivedMap { received_at, map: Arc::clone(map) };
        self.recording.send(received_at, LogItem::Map(Arc::clone(map)));
        self.newest.map.send_replace(Some(received));
        Ok(())
    }

    fn take_verdicts(&mut self, verdicts: &Arc<Verdicts>, received_at: Timestamp) -> Result<(), Refusal> {
        let accepted = self.filter.accept_verdicts(verdicts, received_at, &self.leadership.borrow())?;
        let _accept = self.spans.accept("verdicts", &**verdicts, received_at);
        self.counters.count(Event::VerdictsAccepted);
        self.recording.send(received_at, LogItem::Verdicts(Arc::clone(verdicts)));
        self.tell_election(accepted);
        self.newest.verdicts.send_replace(Some(Received { received_at, message: Arc::clone(verdicts) }));
        Ok(())
    }

    fn take_reputations(&mut self, reputations: &Arc<Reputations>, received_at: Timestamp) -> Result<(), Refusal> {
        self.filter.accept_reputations(reputations, received_at, &self.leadership.borrow())?;
        self.counters.count(Event::ReputationsAccepted);
        self.recording.send(received_at, LogItem::Reputations(Arc::clone(reputations)));
        self.newest.reputations.send_replace(Some(Received { received_at, message: Arc::clone(reputations) }));
        Ok(())
    }

    fn tell_election(&self, accepted: AcceptedRound) {
        let AcceptedRound { epoch, round, is_sign_of_life, .. } = accepted;
        if is_sign_of_life {
            self.election.send(LeaderElectionMessage::Note { input: Input::RoundAccepted { epoch, round } });
        }
    }

    fn write(&mut self, received: &ReceivedMap) {
        let Some(log) = &mut self.log else { return };
        let written = serde_json::to_writer(&mut *log, received).map_err(std::io::Error::from);
        if let Err(error) = written.and_then(|()| log.write_all(b"\n")).and_then(|()| log.flush()) {
            tracing::warn!(%error, "map log abandoned");
            self.log = None;
        }
    }
}

fn open(path: &Path) -> Result<BufWriter<File>, ActorProcessingErr> {
    let file = File::options().create(true).append(true).open(path);
    file.map(BufWriter::new).map_err(|error| format!("cannot open map log {}: {error}", path.display()).into())
}
