//! The actor that takes the cell's maps, verdicts and reputations: it drops what was superseded and hands on the rest.
//!
//! ```text
//! Gateway ── TakeMap, TakeVerdicts, … ──> Follower ──> watches of the newest of each; maps also to an optional log file
//!                                            ├── NoteRound ──> LeaderElection
//!                                            └── TakeMap ──> Fuser
//! ```

use crate::messages::follower::FollowerMessage;
use crate::messages::newest::{Newest, Received, ReceivedMap};

mod age;
mod gate;

use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use ecod::epoch::Epoch;
use ecod::names::NodeName;
use ecod::time::Timestamp;
use ecod::wire::{GlobalMap, RejectReason, Reputations, Verdicts};
use ractor::{Actor, ActorProcessingErr, ActorRef};
use tokio::sync::watch;

use crate::messages::actor_slot::ActorSlot;
use crate::messages::fuser::FuserMessage;
use crate::messages::leader_election::LeaderElectionMessage;
use crate::messages::leadership::Leadership;
use crate::observe::recorder::{LogItem, LogSender};
use crate::telemetry::counters::{Counters, Event};
use crate::transport::mqtt::Incoming;
use age::Age;
use gate::{Gate, MEMORY, Refusal};

/// What a follower needs at its start.
pub struct FollowerArguments {
    /// Gets the newest of everything.
    pub newest: Newest,
    /// A file to which every accepted map is appended with its time of receipt, one JSON
    /// object a line.
    pub log: Option<PathBuf>,
    /// Where everything accepted is recorded.
    pub recording: LogSender,
    /// The lowest term taken at first: the highest that an earlier run of the node knew.
    pub least_term: u64,
    /// The highest term that the election knows.
    pub term: watch::Receiver<u64>,
    /// Who leads.
    pub leadership: watch::Receiver<Leadership>,
    /// Is told of the rounds taken.
    pub election: ActorSlot<LeaderElectionMessage>,
    /// Goes on from the maps taken, when the node leads.
    pub fuser: ActorSlot<FuserMessage>,
    /// The node's counters.
    pub counters: Arc<Counters>,
}

/// Keeps the newest map, verdicts and reputations.
#[derive(Debug, Default)]
pub struct Follower;

/// The newest of everything and where it goes.
pub struct FollowerState {
    newest: Newest,
    maps: Gate,
    verdicts: Gate,
    reputations: Gate,
    map_age: Age,
    verdicts_age: Age,
    log: Option<BufWriter<File>>,
    recording: LogSender,
    leadership: watch::Receiver<Leadership>,
    election: ActorSlot<LeaderElectionMessage>,
    fuser: ActorSlot<FuserMessage>,
    counters: Arc<Counters>,
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
        let (FollowerMessage::TakeMap { delivery }
        | FollowerMessage::TakeVerdicts { delivery }
        | FollowerMessage::TakeReputations { delivery }) = message;
        let taken = match &delivery.message {
            Incoming::Map(map) => state.take_map(map, delivery.received_at),
            Incoming::Verdicts(verdicts) => state.take_verdicts(verdicts, delivery.received_at),
            Incoming::Reputations(reputations) => state.take_reputations(reputations, delivery.received_at),
            _ => Ok(()),
        };
        match taken {
            Ok(()) => {}
            Err(Refusal::Repeated) => state.counters.count(Event::Repeated),
            Err(Refusal::Superseded) => state.counters.reject(RejectReason::Superseded),
            Err(Refusal::Stale) => state.counters.reject(RejectReason::Stale),
            Err(Refusal::NotElected) => state.counters.reject(RejectReason::NotElected),
        }
        Ok(())
    }
}

impl FollowerState {
    fn new(arguments: FollowerArguments, log: Option<BufWriter<File>>) -> Self {
        let FollowerArguments { newest, recording, least_term, term, leadership, election, fuser, counters, .. } =
            arguments;
        let [maps, verdicts] = [(); 2].map(|()| Gate::new(least_term, Some(term.clone())));
        // They are retained: a node that starts gets them before it can have heard of any term, and perhaps not again.
        let reputations = Gate::new(least_term, None);
        let (map_age, verdicts_age) = (Age::default(), Age::default());
        Self {
            newest,
            maps,
            verdicts,
            reputations,
            map_age,
            verdicts_age,
            log,
            recording,
            leadership,
            election,
            fuser,
            counters,
        }
    }

    fn take_map(&mut self, map: &Arc<GlobalMap>, received_at: Timestamp) -> Result<(), Refusal> {
        let epoch = Epoch::new(map.epoch, map.aggregator.clone());
        self.maps.admit(&epoch, map.round, received_at, &self.leadership.borrow())?;
        check(self.map_age.is_fresh(&epoch, map.fused_at_us, received_at))?;
        self.counters.count(Event::MapAccepted);
        self.fuser.send(FuserMessage::TakeMap { map: Arc::clone(map), received_at });
        self.election.send(LeaderElectionMessage::NoteRound { epoch, round: map.round });
        let received = ReceivedMap { received_at, map: Arc::clone(map) };
        self.write(&received);
        self.recording.send(received_at, LogItem::Map(Arc::clone(map)));
        self.newest.map.send_replace(Some(received));
        Ok(())
    }

    fn take_verdicts(&mut self, verdicts: &Arc<Verdicts>, received_at: Timestamp) -> Result<(), Refusal> {
        let epoch = Epoch::new(verdicts.epoch, verdicts.aggregator.clone());
        self.verdicts.admit(&epoch, verdicts.round, received_at, &self.leadership.borrow())?;
        check(self.verdicts_age.is_fresh(&epoch, verdicts.fused_at_us, received_at))?;
        self.counters.count(Event::VerdictsAccepted);
        self.recording.send(received_at, LogItem::Verdicts(Arc::clone(verdicts)));
        if self.newest.map.borrow().as_ref().is_none_or(|map| received_at.since(map.received_at) >= MEMORY) {
            self.election.send(LeaderElectionMessage::NoteRound { epoch, round: verdicts.round });
        }
        self.newest.verdicts.send_replace(Some(Received { received_at, message: Arc::clone(verdicts) }));
        Ok(())
    }

    fn take_reputations(&mut self, reputations: &Arc<Reputations>, received_at: Timestamp) -> Result<(), Refusal> {
        let aggregator = reputations.aggregator.clone().unwrap_or(UNNAMED);
        let epoch = Epoch::new(reputations.epoch, aggregator);
        self.reputations.admit(&epoch, reputations.round, received_at, &self.leadership.borrow())?;
        self.counters.count(Event::ReputationsAccepted);
        self.recording.send(received_at, LogItem::Reputations(Arc::clone(reputations)));
        self.newest.reputations.send_replace(Some(Received { received_at, message: Arc::clone(reputations) }));
        Ok(())
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

fn check(is_fresh: bool) -> Result<(), Refusal> {
    if is_fresh { Ok(()) } else { Err(Refusal::Stale) }
}

/// The aggregator of reputations that name none; it sorts before all others.
const UNNAMED: NodeName = NodeName::from_static("-");

fn open(path: &Path) -> Result<BufWriter<File>, ActorProcessingErr> {
    let file = File::options().create(true).append(true).open(path);
    file.map(BufWriter::new).map_err(|error| format!("cannot open map log {}: {error}", path.display()).into())
}

#[cfg(test)]
mod tests {
    use ecod::wire::SCHEMA_VERSION;

    use super::*;
    use crate::messages::leadership::Position;

    fn follower(leadership: Leadership) -> FollowerState {
        let arguments = FollowerArguments {
            newest: Newest::default(),
            log: None,
            recording: LogSender::default(),
            least_term: 0,
            term: watch::channel(7).1,
            leadership: watch::channel(leadership).1,
            election: ActorSlot::default(),
            fuser: ActorSlot::default(),
            counters: Arc::default(),
        };
        FollowerState::new(arguments, None)
    }

    fn map(epoch: u64, round: u64, fused_at: Timestamp) -> Arc<GlobalMap> {
        Arc::new(GlobalMap {
            schema: SCHEMA_VERSION,
            aggregator: NodeName::from_static("edge"),
            epoch,
            round,
            fused_at_us: fused_at,
            oldest_capture_us: None,
            landmarks: Vec::new(),
            objects: Vec::new(),
            pose_corrections: Default::default(),
        })
    }

    #[test]
    fn a_huge_epoch_silences_the_others_for_a_moment_only() {
        let mut follower = follower(Leadership::default());
        let ms = |n: u64| Timestamp(n * 1000);
        let accepted = |follower: &FollowerState| follower.newest.map.borrow().as_ref().map(|newest| newest.map.epoch);
        assert_eq!(follower.take_map(&map(u64::MAX, 1, ms(0)), ms(0)), Err(Refusal::NotElected));
        assert_eq!(follower.take_map(&map(u64::MAX, 2, ms(500)), ms(500)), Ok(()), "it goes on and on");
        assert_eq!(follower.take_map(&map(7, 1, ms(1000)), ms(1000)), Err(Refusal::Superseded));
        assert_eq!(accepted(&follower), Some(u64::MAX));
        assert_eq!(follower.take_map(&map(7, 2, ms(3500)), ms(3500)), Err(Refusal::Stale), "it may have waited");
        assert_eq!(follower.take_map(&map(7, 4, ms(3700)), ms(3700)), Ok(()));
        assert_eq!(accepted(&follower), Some(7));
        assert_eq!(follower.take_map(&map(7, 4, ms(3800)), ms(3800)), Err(Refusal::Repeated), "not taken twice");
    }

    #[test]
    fn rounds_that_waited_while_the_node_was_stopped_are_not_taken() {
        let mut follower = follower(Leadership::default());
        let at = |round: u64| Timestamp(round * 100_000);
        for round in 0..10 {
            assert_eq!(follower.take_map(&map(7, round, at(round)), at(round)), Ok(()));
        }
        let resumed = at(40);
        for round in 10..31 {
            assert_eq!(follower.take_map(&map(7, round, at(round)), resumed), Err(Refusal::Stale), "round {round}");
        }
        assert_eq!(follower.take_map(&map(7, 31, at(31)), resumed), Ok(()));
    }

    #[test]
    fn a_refused_map_does_not_make_old_ones_look_fresh() {
        let epoch = Some(Epoch::new(8, NodeName::from_static("edge")));
        let mut follower = follower(Leadership { position: Position::Following, epoch, standby: None });
        let at = |round: u64| Timestamp(round * 100_000);
        for round in 0..10 {
            assert_eq!(follower.take_map(&map(8, round, at(round)), at(round)), Ok(()));
        }
        let resumed = at(40);
        assert_eq!(follower.take_map(&map(7, 99, at(10)), resumed), Err(Refusal::Superseded));
        assert_eq!(follower.take_map(&map(8, 10, at(10)), resumed), Err(Refusal::Stale));
    }

    #[test]
    fn each_topic_goes_by_its_own_order_and_reputations_may_come_without_a_name() {
        let mut follower = follower(Leadership::default());
        let reputations = |epoch, round, aggregator: Option<&str>| {
            let aggregator = aggregator.map(|name| NodeName::new(name).unwrap());
            Arc::new(Reputations { schema: SCHEMA_VERSION, aggregator, epoch, round, reputations: Default::default() })
        };
        let now = Timestamp(1);
        assert_eq!(follower.take_map(&map(7, 9, now), now), Ok(()));
        assert_eq!(follower.take_reputations(&reputations(7, 1, None), now), Ok(()));
        assert_eq!(follower.take_reputations(&reputations(7, 1, Some("edge")), now), Ok(()));
        let late = follower.take_reputations(&reputations(7, 2, None), now);
        assert_eq!(late, Err(Refusal::Superseded));
        let newest = follower.newest.reputations.borrow().as_ref().map(|newest| newest.message.aggregator.clone());
        assert_eq!(newest, Some(Some(NodeName::from_static("edge"))));
    }

    #[test]
    fn a_deposed_leader_is_refused_even_when_nobody_else_is_heard() {
        let epoch = Some(Epoch::new(8, NodeName::from_static("euclid")));
        let mut follower = follower(Leadership { position: Position::Following, epoch, standby: None });
        assert_eq!(follower.take_map(&map(8, 1, Timestamp(0)), Timestamp(0)), Ok(()));
        assert_eq!(
            follower.take_map(&map(7, 99, Timestamp(9_000_000)), Timestamp(9_000_000)),
            Err(Refusal::Superseded)
        );
    }
}
