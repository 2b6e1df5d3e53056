//! The actor that keeps the cell's description: takes, saves and passes on the newest.
//!
//! ```text
//! program ── door ── Set ──────────> DescriptionKeeper ── PublishDescription ──> Gateway
//! LeaderElection ── Hear ──────────>   │ ▲        └── Describe ──> Node ──> the parts that use its settings
//! Gateway ── Take, Connected ──────>   └─┘ Tick
//! ```

use std::sync::Arc;
use std::time::Duration;

use ecod::description::{DescriptionEffect, DescriptionExchange, PUBLISH_INTERVAL};
use ecod::leadership::Leadership;
use ecod::model::names::NodeName;
use ecod::wire::{CellDescription, RejectReason};
use ractor::{Actor, ActorProcessingErr, ActorRef};
use tokio::sync::watch;

use crate::messages::actor_slot::ActorSlot;
use crate::messages::description_keeper::DescriptionKeeperMessage;
use crate::messages::gateway::GatewayMessage;
use crate::platform::clock;
use crate::platform::content_hash::{content_hash, is_intact};
use crate::platform::state_file::StateFile;
use crate::platform::state_writer::StateWriter;
use crate::telemetry::counters::{Counters, OTHERS};
use crate::transport::gossip::Member;

/// Callback that has a node use a description. It must not block.
pub type DescriptionSink = Arc<dyn Fn(Arc<CellDescription>) + Send + Sync>;

/// Parts and values that a keeper needs at its start.
pub struct DescriptionKeeperArguments {
    /// The node's name.
    pub name: NodeName,
    /// True if it may lead, and so set and publish descriptions.
    pub may_lead: bool,
    /// The description that the node uses, or knows and cannot use.
    pub held: Option<Arc<CellDescription>>,
    /// Where it is saved, if anywhere.
    pub file: Option<StateFile>,
    /// Has the node use a description.
    pub apply: DescriptionSink,
    /// The other nodes.
    pub members: watch::Receiver<Vec<Member>>,
    /// The leader, as it changes.
    pub leadership: watch::Receiver<Leadership>,
    /// Publishes descriptions.
    pub gateway: ActorSlot<GatewayMessage>,
    /// The node's counters.
    pub counters: Arc<Counters>,
}

/// Keeps the description.
#[derive(Debug, Default)]
pub struct DescriptionKeeper;

/// The exchange, and what the disk lacks.
pub struct DescriptionKeeperState {
    exchange: DescriptionExchange,
    name: NodeName,
    writer: StateWriter,
    apply: DescriptionSink,
    members: watch::Receiver<Vec<Member>>,
    leadership: watch::Receiver<Leadership>,
    gateway: ActorSlot<GatewayMessage>,
    counters: Arc<Counters>,
}

/// Time between two looks at what others lack.
const TICK: Duration = Duration::from_millis(500);

const _: () = assert!(TICK.as_millis() < PUBLISH_INTERVAL.as_millis());

impl Actor for DescriptionKeeper {
    type Msg = DescriptionKeeperMessage;
    type State = DescriptionKeeperState;
    type Arguments = DescriptionKeeperArguments;

    async fn pre_start(
        &self,
        myself: ActorRef<Self::Msg>,
        arguments: Self::Arguments,
    ) -> Result<Self::State, ActorProcessingErr> {
        let DescriptionKeeperArguments {
            name,
            may_lead,
            held,
            file,
            apply,
            members,
            mut leadership,
            gateway,
            counters,
        } = arguments;
        leadership.mark_changed();
        myself.send_interval(TICK, || DescriptionKeeperMessage::Tick);
        let mut writer = StateWriter::new(file, "description of the cell");
        if held.is_some() {
            // One that the node was started with is not on the disk yet.
            writer.note_change();
        }
        Ok(DescriptionKeeperState {
            exchange: DescriptionExchange::new(name.clone(), may_lead, held),
            name,
            writer,
            apply,
            members,
            leadership,
            gateway,
            counters,
        })
    }

    async fn handle(
        &self,
        _myself: ActorRef<Self::Msg>,
        message: Self::Msg,
        state: &mut Self::State,
    ) -> Result<(), ActorProcessingErr> {
        let (now, is_tick) = (clock::now(), matches!(message, DescriptionKeeperMessage::Tick));
        if state.leadership.has_changed().unwrap_or(false) {
            let leadership = state.leadership.borrow_and_update().clone();
            let effects = state.exchange.lead(leadership.leader(), now);
            state.carry_out(effects);
        }
        let effects = match message {
            DescriptionKeeperMessage::Hear { from, may_lead, stamp } => {
                state.exchange.hear(&from, may_lead, stamp, now)
            }
            DescriptionKeeperMessage::Take { delivery } if is_intact(&delivery.message) => {
                state.exchange.take(Arc::clone(&delivery.message), now)
            }
            DescriptionKeeperMessage::Take { delivery } => {
                let broker = delivery.broker.as_ref().map_or(OTHERS, NodeName::as_str);
                state.counters.reject(RejectReason::Malformed, broker);
                tracing::debug!(broker, "description not used: its hash is not that of its content");
                Vec::new()
            }
            DescriptionKeeperMessage::Set { text } => {
                let hash = content_hash(&state.name, &text);
                state.exchange.set(text, hash, now)
            }
            DescriptionKeeperMessage::Connected => state.exchange.connect(now),
            DescriptionKeeperMessage::Tick => {
                let members = state.members.borrow();
                state.exchange.retain(|name| members.iter().any(|member| member.name == *name));
                drop(members);
                state.exchange.tick(now)
            }
        };
        let has_adopted = effects.iter().any(|effect| matches!(effect, DescriptionEffect::Adopt { .. }));
        state.carry_out(effects);
        if has_adopted || is_tick {
            state.save().await;
        }
        Ok(())
    }
}

impl DescriptionKeeperState {
    fn carry_out(&mut self, effects: Vec<DescriptionEffect>) {
        for effect in effects {
            match effect {
                DescriptionEffect::Adopt { description, stated_by } => {
                    let (stamp, set_by) = (description.stamp(), &description.set_by);
                    tracing::info!(%stamp, %set_by, %stated_by, "the cell has a new description");
                    self.writer.note_change();
                    (self.apply)(description);
                }
                DescriptionEffect::Publish { description } => {
                    self.gateway.send(GatewayMessage::PublishDescription { description });
                }
                DescriptionEffect::CountImplausible { from } => {
                    self.counters.reject(RejectReason::OutOfRange, from.as_str());
                }
            }
        }
    }

    async fn save(&mut self) {
        if let Some(held) = self.exchange.current() {
            self.writer.save(|| CellDescription::clone(held)).await;
        }
    }
}
