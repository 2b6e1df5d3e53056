//! Evidence and reputations of vehicles, in memory and on disk.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use ecod::model::names::NodeName;
use ecod::reputation::{ReputationConfig, ReputationLedger};
use ecod::wire::{LedgerEntry, LedgerMark, Reputation, SCHEMA_VERSION};
use serde::{Deserialize, Serialize};

use super::ReputationKeeperArguments;

/// Evidence about vehicles; it outlives the runs of the actor that keeps it.
#[derive(Debug)]
pub struct ReputationStore {
    /// The evidence.
    pub ledger: ReputationLedger,
    /// In VOTE's `paper` mode, the reputations themselves.
    pub standing: BTreeMap<NodeName, Reputation>,
    by_evidence: bool,
    restored: bool,
}

impl ReputationStore {
    pub(super) fn reputations(&self, config: &ReputationConfig) -> BTreeMap<NodeName, Reputation> {
        if self.by_evidence { self.ledger.reputations(config) } else { self.standing.clone() }
    }

    fn take(&mut self, saved: Saved) {
        self.ledger.merge_entries(saved.entries, None);
        self.ledger.merge_marks(saved.marks, None);
        self.standing = saved.standing;
    }
}

/// A [`ReputationStore`] with several owners.
#[derive(Debug, Clone)]
pub struct SharedReputations(Arc<Mutex<ReputationStore>>);

impl SharedReputations {
    /// An empty store; reputations follow `by_evidence` unless VOTE runs in `paper` mode.
    pub fn new(by_evidence: bool) -> Self {
        let store =
            ReputationStore { ledger: Default::default(), standing: BTreeMap::new(), by_evidence, restored: false };
        Self(Arc::new(Mutex::new(store)))
    }

    /// Locks the store.
    pub fn open(&self) -> MutexGuard<'_, ReputationStore> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// The store on disk.
#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Saved {
    schema: u32,
    cell: NodeName,
    node: NodeName,
    entries: Vec<LedgerEntry>,
    #[serde(default)]
    marks: Vec<LedgerMark>,
    standing: BTreeMap<NodeName, Reputation>,
}

impl Saved {
    pub(super) fn of(store: &ReputationStore, arguments: &ReputationKeeperArguments) -> Self {
        Self {
            schema: SCHEMA_VERSION,
            cell: arguments.cell.clone(),
            node: arguments.name.clone(),
            entries: store.ledger.entries().collect(),
            marks: store.ledger.marks().collect(),
            standing: store.standing.clone(),
        }
    }

    fn is_of(&self, arguments: &ReputationKeeperArguments) -> bool {
        self.schema == SCHEMA_VERSION && self.cell == arguments.cell && self.node == arguments.name
    }
}

/// Reads the file into the store, once in its life.
pub(super) fn restore(arguments: &ReputationKeeperArguments) {
    let mut store = arguments.reputations.open();
    if std::mem::replace(&mut store.restored, true) {
        return;
    }
    let Some(file) = &arguments.file else {
        tracing::warn!("no `state_dir`: reputations, and the terms in which this node has led, end with it");
        return;
    };
    if let Some(saved) = file.load(|saved: &Saved| saved.is_of(arguments)) {
        tracing::info!(path = %file.path().display(), entries = saved.entries.len(), "reputations restored");
        store.take(saved);
    }
}

/// Restores an empty store from the bytes of a file; only built for the fuzz targets.
#[cfg(fuzzing)]
pub fn read_saved(bytes: &[u8]) {
    if let Ok(saved) = serde_json::from_slice(bytes) {
        let store = SharedReputations::new(true);
        store.open().take(saved);
        drop(store.open().reputations(&ReputationConfig::default()));
    }
}
