//! The actor that closes the rounds: reports in, maps and verdicts out while the node leads.
//!
//! ```text
//! Gateway ── TakeReport ─────────> Fuser ── PublishMap, PublishVerdicts ──> Gateway
//! LeaderElection ── Lead, … ─────> │ ▲ └─── Record ──> ReputationKeeper
//! ReputationKeeper ── Adopt, … ──> └─┘ CloseRound, at the aggregator's deadline
//! ```

use std::collections::BTreeMap;
use std::sync::Arc;

use ecod::aggregator::{Aggregator, Fused};
use ecod::epoch::Epoch;
use ecod::names::NodeName;
use ecod::reputation::ReputationLedger;
use ecod::round::FirstRound;
use ecod::time::Timestamp;
use ecod::wire::Reputation;
use ractor::{Actor, ActorProcessingErr, ActorRef};
use tokio::task::AbortHandle;

use crate::clock;
use crate::counters::{Counters, Event};
use crate::gateway::{Delivery, GatewayMessage, Incoming};
use crate::reputation_keeper::ReputationKeeperMessage;
use crate::seat::Seat;

/// What the fuser is asked to do.
#[derive(Debug)]
pub enum FuserMessage {
    /// Fuse a vehicle's report.
    TakeReport {
        /// The report and when it came.
        delivery: Delivery,
    },
    /// Close the round if it is due.
    CloseRound,
    /// Publish from now on.
    Lead {
        /// The leadership.
        epoch: Epoch,
        /// Number of the next round.
        first_round: u64,
        /// When it is due.
        first: FirstRound,
    },
    /// Let the present round last its whole period: another node is about to lead from the next one on.
    HoldRound,
    /// Publish nothing more; go on fusing, to be ready.
    StopPublishing,
    /// Start from evidence that came from elsewhere.
    Adopt {
        /// All evidence that is known.
        ledger: Arc<ReputationLedger>,
    },
    /// Go on, in VOTE's `paper` mode, from reputations that were published.
    Resume {
        /// The reputations.
        reputations: BTreeMap<NodeName, Reputation>,
    },
}

/// What a fuser needs at its start.
pub struct FuserArguments {
    /// The aggregator it drives.
    pub aggregator: Aggregator,
    /// Where maps and verdicts are published.
    pub gateway: Seat<GatewayMessage>,
    /// Is told what rounds say about vehicles.
    pub keeper: Seat<ReputationKeeperMessage>,
    /// The node's counters.
    pub counters: Arc<Counters>,
}

/// Drives an [`Aggregator`] with the clock and the gateway.
#[derive(Debug, Default)]
pub struct Fuser;

/// The aggregator and its alarm.
pub struct FuserState {
    aggregator: Aggregator,
    gateway: Seat<GatewayMessage>,
    keeper: Seat<ReputationKeeperMessage>,
    counters: Arc<Counters>,
    alarm: Timestamp,
    timer: Option<AbortHandle>,
}

impl Actor for Fuser {
    type Msg = FuserMessage;
    type State = FuserState;
    type Arguments = FuserArguments;

    async fn pre_start(
        &self,
        myself: ActorRef<Self::Msg>,
        arguments: Self::Arguments,
    ) -> Result<Self::State, ActorProcessingErr> {
        let FuserArguments { aggregator, gateway, keeper, counters } = arguments;
        let mut state = FuserState { aggregator, gateway, keeper, counters, alarm: Timestamp(u64::MAX), timer: None };
        state.set_alarm(&myself);
        Ok(state)
    }

    async fn handle(
        &self,
        myself: ActorRef<Self::Msg>,
        message: Self::Msg,
        state: &mut Self::State,
    ) -> Result<(), ActorProcessingErr> {
        match message {
            FuserMessage::TakeReport { delivery } => state.take(&delivery),
            FuserMessage::CloseRound => {
                state.counters.count(Event::RoundDue);
                state.alarm = Timestamp(u64::MAX);
                state.tick();
            }
            FuserMessage::Lead { epoch, first_round, first } => state.lead(epoch, first_round, first),
            FuserMessage::HoldRound => {
                state.aggregator.hold();
                state.alarm = Timestamp(u64::MAX);
            }
            FuserMessage::StopPublishing => {
                state.aggregator.stand_by();
                state.keeper.send(ReputationKeeperMessage::StandBy);
            }
            FuserMessage::Adopt { ledger } => state.aggregator.adopt(&ledger),
            FuserMessage::Resume { reputations } => state.aggregator.resume(&reputations),
        }
        state.set_alarm(&myself);
        Ok(())
    }
}

impl FuserState {
    fn take(&mut self, delivery: &Delivery) {
        let Incoming::Report { kind, report } = &delivery.message else { return };
        let ignored_before = self.aggregator.ignored_votes();
        let taken = self.aggregator.report(*kind, report, delivery.received_at);
        self.counters.add(Event::VoteIgnored, self.aggregator.ignored_votes() - ignored_before);
        match taken {
            Ok(fused) => self.publish(fused),
            Err(reason) => {
                tracing::debug!(node = %report.node, seq = report.seq, ?kind, %reason, "report not used");
                self.counters.reject(reason);
            }
        }
    }

    fn lead(&mut self, epoch: Epoch, first_round: u64, first: FirstRound) {
        self.keeper
            .send(ReputationKeeperMessage::Lead { epoch: epoch.clone(), last_round: first_round.saturating_sub(1) });
        self.aggregator.lead(epoch, first_round, first, clock::now());
        self.tick();
    }

    fn tick(&mut self) {
        let fused = self.aggregator.tick(clock::now());
        self.publish(fused);
    }

    fn publish(&self, fused: Option<Fused>) {
        let Some(Fused { epoch, round, map, verdicts, evidence, reputations }) = fused else { return };
        if let Some(map) = map {
            self.gateway.send(GatewayMessage::PublishMap { map: Arc::new(map) });
        }
        if let Some(verdicts) = verdicts {
            self.gateway.send(GatewayMessage::PublishVerdicts { verdicts: Arc::new(verdicts) });
            self.keeper.send(ReputationKeeperMessage::Record { epoch, round, evidence, reputations });
        }
    }

    /// One alarm is enough unless the deadline has moved to before it; an early alarm closes nothing and is set anew.
    fn set_alarm(&mut self, myself: &ActorRef<FuserMessage>) {
        let deadline = self.aggregator.deadline();
        if deadline < self.alarm {
            self.alarm = deadline;
            let timer = myself.send_after(deadline.since(clock::now()), || FuserMessage::CloseRound);
            if let Some(superseded) = self.timer.replace(timer.abort_handle()) {
                superseded.abort();
            }
        }
    }
}
