//! The actor that closes the rounds: reports in, maps out.
//!
//! ```text
//! Gateway ── TakeReport ──> Fuser ── PublishMap ──> Gateway
//!                             ▲ │
//!                             └─┘ CloseRound, at the aggregator's deadline
//! ```

use std::sync::Arc;

use ecod::aggregator::{Aggregator, Fused};
use ecod::time::Timestamp;
use ractor::{Actor, ActorProcessingErr, ActorRef};
use tokio::task::AbortHandle;

use crate::clock;
use crate::counters::Counters;
use crate::gateway::{Delivery, GatewayMessage, Incoming};
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
}

/// What a fuser needs at its start.
pub struct FuserArguments {
    /// The aggregator it drives.
    pub aggregator: Aggregator,
    /// Where maps are published.
    pub gateway: Seat<GatewayMessage>,
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
        let FuserArguments { aggregator, gateway, counters } = arguments;
        let mut state = FuserState { aggregator, gateway, counters, alarm: Timestamp(u64::MAX), timer: None };
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
                state.alarm = Timestamp(u64::MAX);
                let fused = state.aggregator.tick(clock::now());
                state.publish(fused);
            }
        }
        state.set_alarm(&myself);
        Ok(())
    }
}

impl FuserState {
    fn take(&mut self, delivery: &Delivery) {
        let Incoming::Report { kind, report } = &delivery.message else { return };
        match self.aggregator.report(*kind, report, delivery.received_at) {
            Ok(fused) => self.publish(fused),
            Err(reason) => {
                tracing::debug!(node = %report.node, seq = report.seq, %reason, "report not used");
                self.counters.reject(reason);
            }
        }
    }

    fn publish(&self, fused: Option<Fused>) {
        let Some(fused) = fused else { return };
        if let Some(map) = fused.map {
            self.gateway.send(GatewayMessage::PublishMap { map: Arc::new(map) });
        }
        if let Some(verdicts) = fused.verdicts {
            self.gateway.send(GatewayMessage::PublishVerdicts { verdicts: Arc::new(verdicts) });
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
