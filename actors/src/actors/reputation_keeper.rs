//! The actor that keeps what is known about vehicles: publishes, persists and replicates it.
//!
//! ```text
//! Fuser ── Lead, Record, StandBy ──> ReputationKeeper ── PublishReputations, PublishShare ──> Gateway
//! Gateway ── Merge ────────────────>   │ ▲      │ └──── Adopt, Resume ──> Fuser
//! LeaderElection ── SendSnapshot ──>   └─┘ Tick └── StateFile
//! ```
//!
//! - The leader records in the lane of its own epoch; every count that changed is shared with the other candidates
//!   after the round, and all counts every [`ReputationKeeperConfig::snapshot_period_s`], in case a share was lost.
//!   Receivers take the larger count: shares may come late, twice, or in any order.
//! - What is published was saved before. What an actor knew outlives it in its [`Book`]; what a node knew outlives it in
//!   its state directory.
//! - Whoever has led sends all it knows to a leader that it hears for the first time, and everybody, a little later, what
//!   has not been shared since: when a split heals, the evidence of both sides is kept, that of leaders who are gone too.
//!   So a leader shares even that it has none.
//! - Evidence is taken of members that may lead, and of terms that the election knows; the present leader's always has room.

use crate::messages::reputation_keeper::ReputationKeeperMessage;

mod book;
mod config;
mod owed;

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::Duration;

use ecod::epoch::Epoch;
use ecod::names::NodeName;
use ecod::reputation::{EntryKey, Evidence, ReputationConfig};
use ecod::time::Timestamp;
use ecod::wire::{
    LedgerEntry, LedgerMark, LedgerShare, MAX_SHARE_ENTRIES, RejectReason, Reputation, Reputations, Role,
    SCHEMA_VERSION,
};
use ractor::{Actor, ActorProcessingErr, ActorRef};
use tokio::sync::watch;
use tokio::task::JoinHandle;

#[cfg(fuzzing)]
pub use book::read_saved;
pub use book::{Book, SharedBook};
pub use config::ReputationKeeperConfig;

use crate::messages::actor_slot::ActorSlot;
use crate::messages::fuser::FuserMessage;
use crate::messages::gateway::GatewayMessage;
use crate::messages::leadership::Leadership;
use crate::messages::newest::Received;
use crate::platform::clock;
use crate::platform::state_file::StateFile;
use crate::telemetry::counters::{Counters, Event};
use crate::transport::gossip::Member;
use crate::transport::mqtt::{Delivery, Incoming};
use book::Saved;
use owed::Owed;

/// What a keeper needs at its start.
pub struct ReputationKeeperArguments {
    /// The node's name.
    pub name: NodeName,
    /// The cell's name.
    pub cell: NodeName,
    /// How evidence becomes reputations.
    pub reputation: ReputationConfig,
    /// Its rhythm.
    pub config: ReputationKeeperConfig,
    /// What earlier runs of the actor knew; shared with whoever starts a fuser.
    pub book: SharedBook,
    /// Where it is saved, if anywhere.
    pub file: Option<StateFile>,
    /// The newest reputations of the cell.
    pub newest: watch::Receiver<Option<Received<Reputations>>>,
    /// The other nodes.
    pub members: watch::Receiver<Vec<Member>>,
    /// Who leads.
    pub leadership: watch::Receiver<Leadership>,
    /// The highest term that the election knows.
    pub term: watch::Receiver<u64>,
    /// Where reputations and shares are published.
    pub gateway: ActorSlot<GatewayMessage>,
    /// Starts from evidence of others.
    pub fuser: ActorSlot<FuserMessage>,
    /// The node's counters.
    pub counters: Arc<Counters>,
}

/// Keeps the ledger.
#[derive(Debug, Default)]
pub struct ReputationKeeper;

/// The ledger and what has not been done with it yet.
pub struct ReputationKeeperState {
    arguments: ReputationKeeperArguments,
    leads: Option<Epoch>,
    has_led: bool,
    last_round: u64,
    published: Option<(Epoch, u64)>,
    owed: Owed,
    unsaved: bool,
    unadopted: bool,
    writing: Option<JoinHandle<std::io::Result<()>>>,
    disk_failed: bool,
    ticks: u32,
}

/// How long a disk may take before reputations are published unsaved.
const WRITE_PATIENCE: Duration = Duration::from_secs(1);

impl Actor for ReputationKeeper {
    type Msg = ReputationKeeperMessage;
    type State = ReputationKeeperState;
    type Arguments = ReputationKeeperArguments;

    async fn pre_start(
        &self,
        myself: ActorRef<Self::Msg>,
        arguments: Self::Arguments,
    ) -> Result<Self::State, ActorProcessingErr> {
        book::restore(&arguments);
        myself.send_interval(arguments.config.publish_period(), || ReputationKeeperMessage::Tick);
        Ok(ReputationKeeperState::new(arguments))
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
            ReputationKeeperMessage::Record { epoch, round, evidence, reputations } => {
                state.record(epoch, round, &evidence, reputations);
            }
            ReputationKeeperMessage::StandBy => state.leads = None,
            ReputationKeeperMessage::Merge { delivery } => state.merge(&delivery),
            ReputationKeeperMessage::SendSnapshot { to } => {
                tracing::info!(%to, "sharing all evidence");
                state.send_snapshot();
            }
            ReputationKeeperMessage::Tick => state.tick().await,
        }
        Ok(())
    }

    async fn post_stop(&self, _myself: ActorRef<Self::Msg>, state: &mut Self::State) -> Result<(), ActorProcessingErr> {
        state.save().await;
        Ok(())
    }
}

impl ReputationKeeperState {
    fn new(arguments: ReputationKeeperArguments) -> Self {
        Self {
            arguments,
            leads: None,
            has_led: false,
            last_round: 0,
            published: None,
            owed: Owed::default(),
            // A run before may have left something.
            unsaved: true,
            unadopted: false,
            writing: None,
            disk_failed: false,
            ticks: 0,
        }
    }

    fn lead(&mut self, epoch: Epoch, last_round: u64) {
        let newest = self.arguments.newest.borrow().as_ref().map(|newest| Arc::clone(&newest.message));
        let mut book = self.arguments.book.open();
        if let Some(newest) = newest.filter(|newest| newest.aggregator.as_ref() != Some(&self.arguments.name)) {
            book.standing.clone_from(&newest.reputations);
        }
        self.arguments.fuser.send(FuserMessage::Resume { reputations: book.standing.clone() });
        self.leads = Some(epoch);
        self.has_led = true;
        self.last_round = last_round;
    }

    fn record(
        &mut self,
        epoch: Epoch,
        round: u64,
        evidence: &[Evidence],
        reputations: Option<BTreeMap<NodeName, Reputation>>,
    ) {
        self.unsaved |= !evidence.is_empty() || reputations.is_some();
        let key = |evidence: &Evidence| {
            let Evidence { node, label, .. } = evidence.clone();
            EntryKey { lane: epoch.clone(), node, label }
        };
        let keys: BTreeSet<_> = evidence.iter().map(key).collect();
        let mut book = self.arguments.book.open();
        for evidence in evidence {
            book.ledger.record(epoch.term, &epoch.leader, evidence);
        }
        if let Some(reputations) = reputations {
            book.standing = reputations;
        }
        let changed = book.ledger.entries_of(&keys);
        let reached = book.ledger.marks_reached(epoch.term, &epoch.leader, evidence);
        drop(book);
        self.leads = Some(epoch);
        self.last_round = round;
        self.share(&changed, &reached);
    }

    fn merge(&mut self, delivery: &Delivery) {
        let Incoming::Ledger(share) = &delivery.message else { return };
        let may_lead = |member: &Member| member.name == share.node && member.role != Role::Cav;
        if !self.arguments.members.borrow().iter().any(may_lead) {
            tracing::debug!(node = %share.node, "evidence of a node that is no candidate");
            return self.arguments.counters.reject(RejectReason::NotCandidate);
        }
        let term = *self.arguments.term.borrow();
        let lanes = share.entries.iter().map(|entry| entry.epoch).chain(share.marks.iter().map(|mark| mark.epoch));
        if lanes.max() > Some(term) {
            tracing::debug!(node = %share.node, term, "evidence of a later term");
            self.arguments.counters.reject(RejectReason::UnknownTerm);
        }
        let is_news = |epoch: u64, leader: &NodeName| {
            epoch <= term && self.leads.as_ref().is_none_or(|own| own.term != epoch || own.leader != *leader)
        };
        let entries: Vec<_> = share.entries.iter().filter(|e| is_news(e.epoch, &e.aggregator)).cloned().collect();
        let marks: Vec<_> = share.marks.iter().filter(|m| is_news(m.epoch, &m.aggregator)).cloned().collect();
        let present = self.leads.clone().or_else(|| self.arguments.leadership.borrow().epoch.clone());
        let leader = share.epoch.filter(|claimed| *claimed <= term).map(|term| Epoch::new(term, share.node.clone()));
        if self.owed.is_first_of(leader, self.ticks_to_listen()) {
            let (entries, _) = self.evidence();
            self.owed
                .owe_everything(self.has_led || entries.iter().any(|entry| entry.aggregator == self.arguments.name));
        }
        self.owed.note(&entries, &marks);
        let mut book = self.arguments.book.open();
        let present = present.as_ref();
        let changed = book.ledger.merge_entries(entries, present) | book.ledger.merge_marks(marks, present);
        drop(book);
        if changed {
            self.arguments.counters.count(Event::LedgerMerged);
            self.unsaved = true;
            self.unadopted = true;
        }
        self.send_all(delivery.received_at);
    }

    /// Sends everything to a leader that may not have it, not too often.
    fn send_all(&mut self, now: Timestamp) {
        if self.owed.takes_everything(now) {
            let (entries, marks) = self.evidence();
            self.share(&entries, &marks);
        }
    }

    /// For how long a leader is listened to before it is told what it has not shared: it shares everything in two thirds
    /// of that, and who comes earlier among the candidates speaks first.
    fn ticks_to_listen(&self) -> u32 {
        let members = self.arguments.members.borrow();
        let earlier = members.iter().filter(|member| member.role != Role::Cav && member.name < self.arguments.name);
        let period = self.arguments.config.ticks_per_snapshot();
        period + period.div_ceil(2) + u32::try_from(earlier.count()).unwrap_or(u32::MAX) % period.max(1)
    }

    /// Sends the leader what nobody has shared with it.
    fn send_owed(&mut self) {
        if self.leads.is_some() {
            return;
        }
        let Some(shared) = self.owed.tick(self.arguments.config.ticks_per_snapshot()) else { return };
        let term = *self.arguments.term.borrow();
        let (mut entries, mut marks) = self.arguments.book.open().ledger.beyond(shared);
        entries.retain(|entry| entry.epoch <= term);
        marks.retain(|mark| mark.epoch <= term);
        if !entries.is_empty() || !marks.is_empty() {
            tracing::info!(entries = entries.len(), "sharing evidence that the leader has not shared");
            self.share(&entries, &marks);
        }
    }

    async fn tick(&mut self) {
        self.save().await;
        self.publish();
        self.send_all(clock::now());
        self.send_owed();
        if std::mem::take(&mut self.unadopted) {
            let ledger = Arc::new(self.arguments.book.open().ledger.clone());
            self.arguments.fuser.send(FuserMessage::Adopt { ledger });
        }
        self.ticks += 1;
        if self.ticks >= self.arguments.config.ticks_per_snapshot() {
            self.ticks = 0;
            if self.leads.is_some() {
                self.send_snapshot();
            }
        }
    }

    /// Publishes what the book says, unless it did so after the same round.
    fn publish(&mut self) {
        let Some(epoch) = &self.leads else { return };
        let now = Some((epoch.clone(), self.last_round));
        if self.published == now {
            return;
        }
        let reputations = Reputations {
            schema: SCHEMA_VERSION,
            aggregator: Some(epoch.leader.clone()),
            epoch: epoch.term,
            round: self.last_round,
            reputations: self.arguments.book.open().reputations(&self.arguments.reputation),
        };
        self.published = now;
        self.arguments.gateway.send(GatewayMessage::PublishReputations { reputations: Arc::new(reputations) });
    }

    fn evidence(&self) -> (Vec<LedgerEntry>, Vec<LedgerMark>) {
        let book = self.arguments.book.open();
        (book.ledger.entries().collect(), book.ledger.marks().collect())
    }

    /// Shares all evidence, and that there is none: whoever takes over waits for it, and whoever has some gives it.
    fn send_snapshot(&self) {
        let (entries, marks) = self.evidence();
        if entries.is_empty() {
            self.publish_share(&[], &[]);
        }
        self.share(&entries, &marks);
    }

    fn share(&self, entries: &[LedgerEntry], marks: &[LedgerMark]) {
        entries.chunks(MAX_SHARE_ENTRIES).for_each(|entries| self.publish_share(entries, &[]));
        marks.chunks(MAX_SHARE_ENTRIES).for_each(|marks| self.publish_share(&[], marks));
    }

    fn publish_share(&self, entries: &[LedgerEntry], marks: &[LedgerMark]) {
        let share = LedgerShare {
            schema: SCHEMA_VERSION,
            node: self.arguments.name.clone(),
            epoch: self.leads.as_ref().map(|epoch| epoch.term),
            entries: entries.to_vec(),
            marks: marks.to_vec(),
        };
        self.arguments.gateway.send(GatewayMessage::PublishShare { share });
    }

    /// Saves what has changed; a disk that fails or hangs is counted, and the node goes on.
    async fn save(&mut self) {
        let Some(file) = self.arguments.file.clone().filter(|_| self.unsaved) else { return };
        if self.writing.is_none() {
            let saved = Saved::of(&self.arguments.book.open(), &self.arguments);
            self.unsaved = false;
            self.writing = Some(tokio::task::spawn_blocking(move || file.save(&saved)));
        }
        let Some(writing) = &mut self.writing else { return };
        let written = match tokio::time::timeout(WRITE_PATIENCE, writing).await {
            Ok(written) => {
                self.writing = None;
                written.map_err(std::io::Error::other).flatten()
            }
            Err(elapsed) => Err(elapsed.into()),
        };
        let Err(error) = written else {
            self.disk_failed = false;
            self.arguments.counters.count(Event::ReputationsSaved);
            return;
        };
        self.unsaved = true;
        self.arguments.counters.count(Event::ReputationsNotSaved);
        if !std::mem::replace(&mut self.disk_failed, true) {
            let path = self.arguments.file.as_ref().map(|file| file.path().display().to_string());
            tracing::warn!(path, %error, "reputations not saved");
        }
    }
}

#[cfg(test)]
mod tests;
