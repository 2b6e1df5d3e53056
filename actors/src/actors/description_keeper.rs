//! The actor that keeps the cell's description: it accepts, saves and distributes the newest
//! version.
//!
//! ```text
//! program ── door ── Set ──────────> DescriptionKeeper ── PublishDescription ──> Gateway
//! LeaderElection ── HandleStamp ───>   │ ▲        └── Describe ──> Node ──> the parts that use its settings
//! Gateway ── HandleDescription, … ─>   └─┘ Tick
//! ```

use std::sync::Arc;
use std::time::Duration;

use base64::Engine;
use base64::engine::general_purpose::STANDARD as BASE64;
use ecod::description::{
    DescriptionEffect, DescriptionExchange, DescriptionHistory, DescriptionStatement,
    PUBLISH_INTERVAL,
};
use ecod::diagnostics::TroubleKind;
use ecod::leadership::Leadership;
use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ecod::wire::{CellDescription, DescriptionStamp, RejectReason};
use ractor::{Actor, ActorProcessingErr, ActorRef};
use tokio::sync::watch;

use crate::messages::actor_slot::ActorSlot;
use crate::messages::description_keeper::DescriptionKeeperMessage;
use crate::messages::gateway::GatewayMessage;
use crate::platform::clock;
use crate::platform::content_hash::{content_hash, is_intact};
use crate::platform::state_file::StateFile;
use crate::platform::state_writer::{SaveOutcome, StateWriter};
use crate::telemetry::counters::{Counters, OTHERS};
use crate::transport::gossip::Member;
use crate::transport::pki::{Credentials, LoadedCredentials};

/// Name of the saved state in messages.
const DESCRIPTION: &str = "description of the cell";

/// Callback that makes a node use a description. It must not block.
pub type DescriptionSink = Arc<dyn Fn(Arc<CellDescription>) + Send + Sync>;

/// Parts and values that a keeper needs at its start.
pub struct DescriptionKeeperArguments {
    /// Name of this node, which descriptions that are set here state as their author.
    pub name: NodeName,
    /// True if it may lead, and so set and publish descriptions.
    pub may_lead: bool,
    /// The description that the node uses, or has but cannot use.
    pub held: Option<Arc<CellDescription>>,
    /// File in which it is saved, if any.
    pub file: Option<StateFile>,
    /// The node's certificates, with the revocation list.
    pub credentials: Option<Arc<Credentials>>,
    /// Makes the node use a description.
    pub apply: DescriptionSink,
    /// All living nodes except this one.
    pub members: watch::Receiver<Vec<Member>>,
    /// The leader, as it changes.
    pub leadership: watch::Receiver<Leadership>,
    /// Publishes descriptions, retained, on all links.
    pub gateway: ActorSlot<GatewayMessage>,
    /// Counters of the node, shared by its actors.
    pub counters: Arc<Counters>,
}

/// Actor that keeps the description of the cell: it exchanges descriptions with other nodes, saves
/// the current one and makes the node use it.
#[derive(Debug, Default)]
pub struct DescriptionKeeper;

/// The exchange, and the state that is not on disk yet.
pub struct DescriptionKeeperState {
    exchange: DescriptionExchange,
    name: NodeName,
    writer: StateWriter,
    credentials: Option<Arc<Credentials>>,
    /// The revocation list that was applied.
    applied: Option<Arc<LoadedCredentials>>,
    apply: DescriptionSink,
    members: watch::Receiver<Vec<Member>>,
    leadership: watch::Receiver<Leadership>,
    gateway: ActorSlot<GatewayMessage>,
    counters: Arc<Counters>,
}

/// Time between two checks for nodes that lack the description.
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
            credentials,
            apply,
            members,
            mut leadership,
            gateway,
            counters,
        } = arguments;
        leadership.mark_changed();
        myself.send_interval(TICK, || DescriptionKeeperMessage::Tick);
        let stamp = held.as_ref().map(|held| held.stamp());
        let is_of_held = |saved: &DescriptionHistory| {
            saved.current.as_ref().map(|it| it.description.stamp()) == stamp
        };
        let saved = file
            .as_ref()
            .and_then(|file| file.load(|_: &DescriptionHistory| true))
            .filter(is_of_held);
        let history = saved.unwrap_or_else(|| DescriptionHistory::of(held.clone()));
        let mut writer = StateWriter::new(file, DESCRIPTION);
        if held.is_some() {
            // A description with which the node was started is not on disk yet.
            writer.record_change();
        }
        Ok(DescriptionKeeperState {
            exchange: DescriptionExchange::new(name.clone(), may_lead, history),
            name,
            writer,
            credentials,
            applied: None,
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
        let now = clock::now();
        let is_tick = matches!(message, DescriptionKeeperMessage::Tick);
        if state.leadership.has_changed().unwrap_or(false) {
            let leadership = state.leadership.borrow_and_update().clone();
            let effects = state.exchange.lead(leadership.leader(), now);
            state.carry_out(effects);
        }
        let effects = match message {
            DescriptionKeeperMessage::HandleStamp {
                from,
                may_lead,
                may_describe,
                stamp,
            } => state.receive(&from, may_lead, may_describe, stamp, now),
            DescriptionKeeperMessage::HandleDescription { delivery }
                if is_intact(&delivery.message) =>
            {
                state
                    .exchange
                    .on_description(Arc::clone(&delivery.message), now)
            }
            DescriptionKeeperMessage::HandleDescription { delivery } => {
                let broker = delivery.broker.as_ref().map_or(OTHERS, NodeName::as_str);
                state.counters.reject(RejectReason::Malformed, broker);
                tracing::debug!(
                    broker,
                    "description not used: its hash is not that of its content"
                );
                Vec::new()
            }
            DescriptionKeeperMessage::Set { text } => {
                let hash = content_hash(&state.name, &text);
                state.exchange.set(text, hash, now)
            }
            DescriptionKeeperMessage::Connected => state.exchange.connect(now),
            DescriptionKeeperMessage::Tick => {
                let members = state.members.borrow();
                state
                    .exchange
                    .retain(|name| members.iter().any(|member| member.name == *name));
                drop(members);
                state.exchange.tick(now)
            }
        };
        let has_adopted = effects.iter().any(is_adoption);
        state.carry_out(effects);
        if has_adopted || is_tick {
            state.drop_revoked(has_adopted, now);
        }
        if has_adopted || is_tick {
            state.save().await;
        }
        Ok(())
    }
}

impl DescriptionKeeperState {
    /// Processes a node's statement. With certificates, a statement counts only together with its
    /// certificate, by which it can be revoked.
    fn receive(
        &mut self,
        from: &NodeName,
        may_lead: bool,
        may_describe: bool,
        stamp: DescriptionStamp,
        now: Timestamp,
    ) -> Vec<DescriptionEffect> {
        let members = self.members.borrow();
        let member = members.iter().find(|member| member.name == *from);
        let certificate = member
            .and_then(|member| member.certificate.as_ref())
            .map(|it| BASE64.encode(it));
        drop(members);
        if self.credentials.is_some() && certificate.is_none() {
            return Vec::new();
        }
        self.exchange.receive(
            from,
            DescriptionStatement {
                stamp,
                may_lead,
                may_describe,
                certificate,
            },
            now,
        )
    }

    /// Returns to the latest description that was not stated by revoked nodes, when the revocation
    /// list has changed. A revoked node's last statement may also arrive after the list.
    fn drop_revoked(&mut self, has_adopted: bool, now: Timestamp) {
        let Some(loaded) = self
            .credentials
            .as_ref()
            .map(|credentials| credentials.current())
        else {
            return;
        };
        let is_revoked = |certificate: &str| {
            BASE64
                .decode(certificate)
                .is_ok_and(|der| loaded.has_revoked(&der))
        };
        let is_new = self
            .applied
            .as_ref()
            .is_none_or(|applied| !Arc::ptr_eq(applied, &loaded));
        let current = self
            .exchange
            .history()
            .current
            .as_ref()
            .filter(|_| has_adopted);
        if !is_new && !current.is_some_and(|current| current.is_of_revoked(is_revoked)) {
            return;
        }
        let effects = self
            .exchange
            .revoke(is_revoked, content_hash(&self.name, ""), now);
        if effects.iter().any(is_adoption) {
            tracing::warn!("the description was a revoked node's: the one before counts again");
        }
        self.carry_out(effects);
        self.applied = Some(loaded);
    }

    /// Carries out the effects of the exchange in order: a new description is marked for saving and
    /// passed to the node, a description to publish goes to the gateway, and an implausible version
    /// is counted.
    fn carry_out(&mut self, effects: Vec<DescriptionEffect>) {
        for effect in effects {
            match effect {
                DescriptionEffect::Adopt {
                    description,
                    stated_by,
                } => {
                    let stamp = description.stamp();
                    let set_by = &description.set_by;
                    tracing::info!(%stamp, %set_by, %stated_by, "the cell has a new description");
                    self.writer.record_change();
                    (self.apply)(description);
                }
                DescriptionEffect::Publish { description } => {
                    self.gateway
                        .send(GatewayMessage::PublishDescription { description });
                }
                DescriptionEffect::CountImplausible { from } => {
                    self.counters
                        .reject(RejectReason::OutOfRange, from.as_str());
                }
            }
        }
    }

    /// Saves the history if it has changed. A disk that fails is recorded as a trouble until a
    /// later attempt succeeds.
    async fn save(&mut self) {
        if self.exchange.current().is_some() {
            let troubles = self.counters.troubles();
            match self.writer.save(|| self.exchange.history().clone()).await {
                SaveOutcome::Unchanged => {}
                SaveOutcome::Written => troubles.settle(TroubleKind::NotSaved, Some(DESCRIPTION)),
                SaveOutcome::Failed => {
                    let cause =
                        "it cannot be saved; after a restart this node fetches it from other nodes";
                    troubles.record_about(DESCRIPTION, TroubleKind::NotSaved, cause);
                }
            }
        }
    }
}

fn is_adoption(effect: &DescriptionEffect) -> bool {
    matches!(effect, DescriptionEffect::Adopt { .. })
}
