//! The actor that keeps the evidence about vehicles: it publishes, persists and replicates it.
//!
//! ```text
//! Fuser ── Lead, Record, StepDown ─> ReputationKeeper ── PublishReputations, PublishShare ──> Gateway
//! Gateway ── Merge ────────────────>   │ ▲      │ └──── Adopt, Resume ──> Fuser
//! LeaderElection ── SendSnapshot ──>   └─┘ Tick └── StateFile
//!          └ <── EvidenceReceived ──
//! ```
//!
//! With certificates, this actor signs the counts of its node, and verifies other nodes' counts.
//! When a certificate is revoked, the counts that it signed are dropped at once, from the published
//! reputations and from the fuser.
//!
//! [`LedgerResync`] decides which evidence is shared with the other candidates, when it is shared,
//! and which evidence is accepted. Reputations are saved before they are published. The
//! [`ReputationStore`] outlives the actor, and the state directory the node.

mod config;
mod store;

use std::collections::BTreeMap;
use std::sync::Arc;

use ecod::diagnostics::TroubleKind;
use ecod::leadership::Leadership;
use ecod::leadership::ledger_resync::LedgerResync;
use ecod::leadership::node::Input;
use ecod::model::epoch::Epoch;
use ecod::model::names::NodeName;
use ecod::reputation::{Evidence, ReputationConfig};
use ecod::wire::{
    LedgerShare, Payload, RejectReason, Reputation, Reputations, Role, SCHEMA_VERSION,
};
use ractor::{Actor, ActorProcessingErr, ActorRef};
use tokio::sync::watch;
use tokio::task::JoinSet;

pub use config::ReputationKeeperConfig;
#[cfg(fuzzing)]
pub use store::read_saved;
pub use store::{ReputationStore, SharedReputations, reset_saved};

use crate::messages::actor_slot::ActorSlot;
use crate::messages::fuser::FuserMessage;
use crate::messages::gateway::GatewayMessage;
use crate::messages::leader_election::LeaderElectionMessage;
use crate::messages::newest::Received;
use crate::messages::reputation_keeper::ReputationKeeperMessage;
use crate::platform::cell_clock::CellClock;
use crate::platform::clock;
use crate::platform::state_file::StateFile;
use crate::platform::state_writer::{SaveOutcome, StateWriter};
use crate::telemetry::counters::{Counters, Event, OTHERS};
use crate::transport::gossip::Member;
use crate::transport::mqtt::Delivery;
use crate::transport::pki::{Credentials, EvidenceSigner};
use store::Saved;

/// Arguments of a keeper's start.
pub struct ReputationKeeperArguments {
    /// Name of this node, under which it shares evidence.
    pub name: NodeName,
    /// Name of the cell, which the signatures of evidence contain.
    pub cell: NodeName,
    /// Rules by which evidence becomes reputations.
    pub reputation: ReputationConfig,
    /// Periods at which reputations are published, saved and shared.
    pub config: ReputationKeeperConfig,
    /// Evidence of earlier runs of the actor, shared with the code that starts a fuser.
    pub reputations: SharedReputations,
    /// File in which it is saved, if any.
    pub file: Option<StateFile>,
    /// The node's certificates; without them evidence is not signed.
    pub credentials: Option<Arc<Credentials>>,
    /// The newest reputations of the cell.
    pub newest: watch::Receiver<Option<Received<Reputations>>>,
    /// All living nodes except this one.
    pub members: watch::Receiver<Vec<Member>>,
    /// The leadership, as it changes.
    pub leadership: watch::Receiver<Leadership>,
    /// Where reputations and shares are published.
    pub gateway: ActorSlot<GatewayMessage>,
    /// Adopts the evidence of other nodes.
    pub fuser: ActorSlot<FuserMessage>,
    /// Is notified of accepted evidence of other candidates.
    pub election: ActorSlot<LeaderElectionMessage>,
    /// The cell's time, used for checking resets.
    pub clock: CellClock,
    /// Counters of the node, shared by its actors.
    pub counters: Arc<Counters>,
}

/// Actor that keeps the ledger: it records the evidence of rounds, merges the shares of other
/// candidates, and publishes and saves the result.
#[derive(Debug, Default)]
pub struct ReputationKeeper;

/// The ledger and its pending changes.
pub struct ReputationKeeperState {
    arguments: ReputationKeeperArguments,
    resync: LedgerResync,
    signer: Option<EvidenceSigner>,
    /// The certificate under which this node's own counts were made, in base64.
    certificate: Option<String>,
    last_round: u64,
    published: Option<(Epoch, u64)>,
    writer: StateWriter,
    unadopted: bool,
    /// Tasks that end with the actor.
    tasks: JoinSet<()>,
}

impl Actor for ReputationKeeper {
    type Msg = ReputationKeeperMessage;
    type State = ReputationKeeperState;
    type Arguments = ReputationKeeperArguments;

    async fn pre_start(
        &self,
        myself: ActorRef<Self::Msg>,
        arguments: Self::Arguments,
    ) -> Result<Self::State, ActorProcessingErr> {
        let mut state = ReputationKeeperState::new(arguments);
        state.restore();
        myself.send_interval(state.arguments.config.publish_period(), || {
            ReputationKeeperMessage::Tick
        });
        if state.signer.is_some() {
            // Certificates may have been revoked while the actor was not running.
            state.drop_revoked();
        }
        if let Some(credentials) = state.arguments.credentials.clone() {
            state.tasks.spawn(watch_certificates(credentials, myself));
        }
        Ok(state)
    }

    async fn handle(
        &self,
        _myself: ActorRef<Self::Msg>,
        message: Self::Msg,
        state: &mut Self::State,
    ) -> Result<(), ActorProcessingErr> {
        match message {
            ReputationKeeperMessage::Lead { epoch, last_round } => {
                state.lead(epoch, last_round);
                state.save().await;
                state.publish();
                state.send_snapshot();
            }
            ReputationKeeperMessage::Record {
                epoch,
                round,
                evidence,
                reputations,
            } => {
                state.record(&epoch, round, &evidence, reputations);
            }
            ReputationKeeperMessage::Configure { reputation } => {
                state.arguments.reputation = reputation;
            }
            ReputationKeeperMessage::StepDown => state.resync.step_down(),
            ReputationKeeperMessage::Merge { delivery } => state.merge(&delivery),
            ReputationKeeperMessage::SendSnapshot { to } => {
                tracing::info!(%to, "sending all evidence behind the reputations to another candidate");
                state.send_snapshot();
            }
            ReputationKeeperMessage::Tick => state.tick().await,
            ReputationKeeperMessage::CheckCertificates => {
                if state.signer.as_mut().is_some_and(EvidenceSigner::reload) && state.drop_revoked()
                {
                    // Receivers drop reputations that repeat a round.
                    state.last_round += 1;
                    state.settle().await;
                }
            }
        }
        Ok(())
    }

    async fn post_stop(
        &self,
        _myself: ActorRef<Self::Msg>,
        state: &mut Self::State,
    ) -> Result<(), ActorProcessingErr> {
        state.save().await;
        Ok(())
    }
}

impl ReputationKeeperState {
    fn new(arguments: ReputationKeeperArguments) -> Self {
        let name = arguments.name.clone();
        let ticks_per_snapshot = arguments.config.ticks_per_snapshot();
        let credentials = arguments.credentials.clone();
        let mut writer = StateWriter::new(arguments.file.clone(), "reputations");
        // An earlier run may have left unsaved changes.
        writer.record_change();
        let resync = if credentials.is_some() {
            LedgerResync::signed
        } else {
            LedgerResync::new
        };
        let signer =
            credentials.map(|credentials| EvidenceSigner::new(arguments.cell.clone(), credentials));
        Self {
            resync: resync(name, ticks_per_snapshot),
            certificate: signer.as_ref().map(EvidenceSigner::certificate),
            signer,
            arguments,
            last_round: 0,
            published: None,
            writer,
            unadopted: false,
            tasks: JoinSet::new(),
        }
    }

    /// Restores the evidence of earlier runs and from disk.
    fn restore(&mut self) {
        store::restore(&self.arguments, self.signer.as_mut());
        self.resync
            .resume(&self.arguments.reputations.open().ledger, clock::now());
    }

    /// Starts a leadership whose rounds begin after `last_round`. In VOTE's `paper` mode the
    /// reputations of the previous leader are adopted first.
    fn lead(&mut self, epoch: Epoch, last_round: u64) {
        let newest = self
            .arguments
            .newest
            .borrow()
            .as_ref()
            .map(|newest| Arc::clone(&newest.message));
        let mut store = self.arguments.reputations.open();
        // Where evidence is counted, a false leader's reputations must be dropped when its
        // certificate is revoked.
        let others =
            newest.filter(|newest| newest.aggregator.as_ref() != Some(&self.arguments.name));
        if let Some(newest) = others.filter(|_| !store.by_evidence) {
            store.standing.clone_from(&newest.reputations);
        }
        self.arguments.fuser.send(FuserMessage::Resume {
            reputations: store.standing.clone(),
        });
        self.resync.lead(epoch);
        self.last_round = last_round;
    }

    /// Records the evidence of a round of the own leadership, and publishes the shares that are
    /// due.
    fn record(
        &mut self,
        epoch: &Epoch,
        round: u64,
        evidence: &[Evidence],
        reputations: Option<BTreeMap<NodeName, Reputation>>,
    ) {
        if !evidence.is_empty() || reputations.is_some() {
            self.writer.record_change();
        }
        let mut store = self.arguments.reputations.open();
        let shares = self.resync.record(epoch, evidence, &mut store.ledger);
        if let Some(reputations) = reputations {
            store.standing = reputations;
        }
        drop(store);
        self.last_round = round;
        self.publish_shares(shares);
    }

    /// Handles a share of another candidate. The share is checked in this order: its path over the
    /// broker, its signature, its plausibility. Accepted evidence is stored and passed to the fuser
    /// at the next tick. The election is notified if the broker vouches for the sender. Refused
    /// shares are counted by reason.
    ///
    /// # Example
    /// `gauss` prepares to take over from `edge`. `edge` shares all its evidence, signed. The share
    /// arrives over the broker of `edge`: it is merged, and the election gets `EvidenceReceived`,
    /// so that `gauss` may answer `Ready`.
    fn merge(&mut self, delivery: &Delivery<Arc<LedgerShare>>) {
        let share = &delivery.message;
        let candidates = self.candidates();
        let leadership = self.arguments.leadership.borrow().clone();
        let broker = delivery.broker.as_ref();
        let way = self.resync.check_way(
            broker,
            share,
            &self.arguments.reputations.open().ledger,
            &leadership,
        );
        if let Err(reason) = way {
            let broker = broker.map_or(OTHERS, NodeName::as_str);
            tracing::debug!(node = %share.node, broker, "evidence over this broker not used");
            return reason.map_or((), |reason| self.arguments.counters.reject(reason, broker));
        }
        if let Some(signer) = self.signer.as_mut().filter(|_| !share.is_empty())
            && let Err(error) = signer.verify(share)
        {
            tracing::debug!(node = %share.node, %error, "evidence not used");
            return self
                .arguments
                .counters
                .reject(RejectReason::BadSignature, share.node.as_str());
        }
        let mut store = self.arguments.reputations.open();
        let at = delivery.received_at;
        let date = self.arguments.clock.date(delivery.received_at);
        let merged =
            self.resync
                .merge(share, &mut store.ledger, &candidates, &leadership, at, date);
        drop(store);
        let merged = match merged {
            Ok(merged) => merged,
            Err(reason) => {
                tracing::debug!(node = %share.node, %reason, "evidence not used");
                return self.arguments.counters.reject(reason, share.node.as_str());
            }
        };
        if self.resync.is_vouched_for(broker, share, &leadership) {
            let input = Input::EvidenceReceived {
                from: share.node.clone(),
            };
            self.arguments
                .election
                .send(LeaderElectionMessage::Record { input });
        }
        for reason in merged.refused {
            tracing::debug!(node = %share.node, %reason, term = leadership.term, "part of the evidence not used");
            self.arguments.counters.reject(reason, share.node.as_str());
        }
        if merged.is_news {
            self.arguments.counters.count(Event::LedgerMerged);
            self.writer.record_change();
            self.unadopted = true;
        }
        self.publish_shares(merged.shares);
    }

    /// The other nodes that may lead.
    fn candidates(&self) -> Vec<NodeName> {
        let members = self.arguments.members.borrow();
        members
            .iter()
            .filter(|member| member.role != Role::Cav)
            .map(|member| member.name.clone())
            .collect()
    }

    /// Ends probations of evidence that are over, settles pending changes, and publishes the shares
    /// that are due.
    async fn tick(&mut self) {
        let leadership = self.arguments.leadership.borrow().clone();
        let passed = self.resync.tick(
            &mut self.arguments.reputations.open().ledger,
            &leadership,
            clock::now(),
        );
        if passed.is_news {
            tracing::debug!("probation of a leader's evidence about itself has ended");
            self.writer.record_change();
            self.unadopted = true;
        }
        self.settle().await;
        self.publish_shares(passed.shares);
    }

    /// Saves, publishes and applies pending changes.
    async fn settle(&mut self) {
        self.save().await;
        self.publish();
        if std::mem::take(&mut self.unadopted) {
            let ledger = Arc::new(self.arguments.reputations.open().ledger.clone());
            self.arguments.fuser.send(FuserMessage::Adopt { ledger });
        }
    }

    /// Publishes the reputations of the store, unless they were already published for the same
    /// round.
    fn publish(&mut self) {
        let Some(epoch) = self.resync.leads() else {
            return;
        };
        let now = Some((epoch.clone(), self.last_round));
        if self.published == now {
            return;
        }
        let mut reputations = Reputations {
            schema: SCHEMA_VERSION,
            aggregator: Some(epoch.leader.clone()),
            epoch: epoch.term,
            round: self.last_round,
            reputations: self
                .arguments
                .reputations
                .open()
                .reputations(&self.arguments.reputation),
        };
        reputations.remove_invalid();
        self.published = now;
        self.arguments
            .gateway
            .send(GatewayMessage::PublishReputations {
                reputations: Arc::new(reputations),
            });
    }

    /// Publishes all evidence in shares; every candidate gets them.
    fn send_snapshot(&mut self) {
        let shares = self
            .resync
            .snapshot(&self.arguments.reputations.open().ledger);
        self.publish_shares(shares);
    }

    /// Publishes shares; shares of the node's own counts are signed first.
    fn publish_shares(&mut self, shares: Vec<LedgerShare>) {
        for share in shares {
            let signer = self
                .signer
                .as_ref()
                .filter(|_| share.signed.is_none() && !share.is_empty());
            let share = match signer {
                Some(signer) => signer.sign(share),
                None => Some(share),
            };
            if let Some(share) = share {
                self.arguments
                    .gateway
                    .send(GatewayMessage::PublishShare { share });
            }
        }
    }

    /// Drops the evidence of aggregators whose certificates were revoked, and this node's own
    /// evidence if it has a new certificate; returns true if there was any.
    fn drop_revoked(&mut self) -> bool {
        let Some(signer) = &mut self.signer else {
            return false;
        };
        let counted_under = self.certificate.replace(signer.certificate());
        let mut store = self.arguments.reputations.open();
        let mut has_dropped = store
            .ledger
            .retain_statements(|share| signer.is_trusted(share));
        if counted_under.is_some_and(|certificate| !signer.is_of_cell(&certificate)) {
            has_dropped |= store.ledger.drop_own(&self.arguments.name);
        }
        if has_dropped {
            tracing::info!(
                lanes = store.ledger.lanes(),
                "evidence of revoked nodes dropped"
            );
            self.writer.record_change();
            self.unadopted = true;
        }
        has_dropped
    }

    /// Saves the store if it has changed, and records a failure as a trouble until a later attempt
    /// succeeds.
    async fn save(&mut self) {
        let arguments = &self.arguments;
        let outcome = self
            .writer
            .save(|| {
                Saved::of(
                    &arguments.reputations.open(),
                    self.certificate.as_ref(),
                    arguments,
                )
            })
            .await;
        let counters = &arguments.counters;
        let troubles = arguments.counters.troubles();
        match outcome {
            SaveOutcome::Unchanged => {}
            SaveOutcome::Written => {
                counters.count(Event::ReputationsSaved);
                troubles.settle(TroubleKind::NotSaved, None);
            }
            SaveOutcome::Failed => {
                counters.count(Event::ReputationsNotSaved);
                troubles.record(
                    TroubleKind::NotSaved,
                    "reputations cannot be saved, and end with this node",
                );
            }
        }
    }
}

/// Notifies the keeper of changed certificates and revocation lists.
async fn watch_certificates(
    credentials: Arc<Credentials>,
    keeper: ActorRef<ReputationKeeperMessage>,
) {
    let mut known = credentials.current();
    while keeper
        .cast(ReputationKeeperMessage::CheckCertificates)
        .is_ok()
    {
        known = credentials.changed(&known).await;
    }
}

#[cfg(test)]
mod tests;
