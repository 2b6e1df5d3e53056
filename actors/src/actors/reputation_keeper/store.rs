//! Evidence and reputations of vehicles, in memory and on disk.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use ecod::leadership::cell_time::EARLIEST;
use ecod::leadership::ledger_resync::is_plausible;
use ecod::leadership::timers::MAX_RESET_AHEAD;
use ecod::model::epoch::Epoch;
use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ecod::reputation::{ReputationConfig, ReputationLedger};
use ecod::wire::{
    InvalidEntry, LedgerEntry, LedgerMark, LedgerShare, Payload, Reputation, Reputations,
    SCHEMA_VERSION,
};
use serde::{Deserialize, Serialize};

use super::ReputationKeeperArguments;
use crate::platform::clock;
use crate::platform::state_file::StateFile;
use crate::transport::pki::EvidenceSigner;

/// Evidence about vehicles; it outlives individual runs of the actor that keeps it.
#[derive(Debug)]
pub struct ReputationStore {
    /// Evidence of this node and of the candidates whose shares it merged.
    pub ledger: ReputationLedger,
    /// In VOTE's `paper` mode, the reputations themselves.
    pub standing: BTreeMap<NodeName, Reputation>,
    pub(super) by_evidence: bool,
    restored: bool,
}

impl ReputationStore {
    pub(super) fn reputations(&self, config: &ReputationConfig) -> BTreeMap<NodeName, Reputation> {
        if self.by_evidence {
            self.ledger.reputations(config)
        } else {
            self.standing.clone()
        }
    }

    /// Loads saved evidence, within the bounds for other nodes' evidence. If evidence is signed,
    /// `signer` verifies it. `date` is the current time; without a set clock, checks against
    /// it are skipped.
    fn adopt(&mut self, saved: Saved, mut signer: Option<&mut EvidenceSigner>, date: Timestamp) {
        let Saved {
            entries,
            marks,
            mut statements,
            standing,
            signed,
            certificate,
            reset_at_us,
            node,
            ..
        } = saved;
        let is_own_valid = match (&mut signer, &certificate) {
            (Some(signer), Some(certificate)) => signed && signer.is_of_cell(certificate),
            (signer, _) => signer.is_none() || signed,
        };
        if reset_at_us.since(date) >= MAX_RESET_AHEAD && date >= EARLIEST {
            tracing::warn!(%reset_at_us, "saved time of a reset not used: it is in the future");
        } else if reset_at_us > self.ledger.reset_at() {
            self.ledger = ReputationLedger::reset(reset_at_us);
        }
        let mut standing = Reputations {
            schema: SCHEMA_VERSION,
            aggregator: None,
            epoch: 0,
            round: 0,
            reputations: standing,
        };
        for InvalidEntry {
            reason,
            contributors,
        } in standing.remove_invalid()
        {
            let vehicles: Vec<_> = contributors.iter().map(NodeName::as_str).collect();
            tracing::warn!(%reason, vehicles = vehicles.join(", "), "a saved reputation is not used");
        }
        self.standing = standing.reputations;
        let share = |entries, marks| LedgerShare {
            schema: SCHEMA_VERSION,
            node: node.clone(),
            epoch: None,
            entries,
            marks,
            signed: None,
            reset_at_us: None,
        };
        let mut counts: Vec<_> = entries
            .into_iter()
            .map(|entry| share(vec![entry], Vec::new()))
            .chain(marks.into_iter().map(|mark| share(Vec::new(), vec![mark])))
            .collect();
        let read = counts.len() + statements.len();
        counts.retain(|share| is_own_valid && is_plausible(share));
        let mut is_valid = |share: &_| {
            signer
                .as_mut()
                .is_none_or(|signer| signer.verify_again(share).is_ok())
        };
        statements.retain(|share| is_plausible(share) && is_valid(share));
        let dropped = read - counts.len() - statements.len();
        if dropped > 0 {
            tracing::warn!(
                dropped,
                "saved evidence ignored: unsigned, from a revoked node, or more votes than possible"
            );
        }
        counts
            .iter()
            .for_each(|share| _ = self.ledger.merge_share(share, None));
        for share in statements {
            match signer {
                Some(_) => self.ledger.merge_statement(&Arc::new(share), None),
                None => self.ledger.merge_share(&share, None),
            };
        }
    }
}

/// A [`ReputationStore`] with several owners.
#[derive(Debug, Clone)]
pub struct SharedReputations(Arc<Mutex<ReputationStore>>);

impl SharedReputations {
    /// An empty store; reputations follow `by_evidence` unless VOTE runs in `paper` mode.
    pub fn new(by_evidence: bool) -> Self {
        let store = ReputationStore {
            ledger: Default::default(),
            standing: BTreeMap::new(),
            by_evidence,
            restored: false,
        };
        Self(Arc::new(Mutex::new(store)))
    }

    /// Changes whether reputations follow from the evidence.
    pub fn set_by_evidence(&self, by_evidence: bool) {
        self.open().by_evidence = by_evidence;
    }

    /// Locks the store until the guard is dropped.
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
    /// All counts; if evidence is signed, only this node's own counts.
    entries: Vec<LedgerEntry>,
    #[serde(default)]
    marks: Vec<LedgerMark>,
    standing: BTreeMap<NodeName, Reputation>,
    /// True if the counts of other nodes are in `statements`.
    #[serde(default)]
    signed: bool,
    /// The certificate under which this node counted, in base64.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    certificate: Option<String>,
    /// Shares that other aggregators signed.
    #[serde(default)]
    statements: Vec<LedgerShare>,
    #[serde(default)]
    reset_at_us: Timestamp,
}

impl Saved {
    pub(super) fn of(
        store: &ReputationStore,
        certificate: Option<&String>,
        arguments: &ReputationKeeperArguments,
    ) -> Self {
        let ledger = &store.ledger;
        let signed = arguments.credentials.is_some();
        let is_kept = |term: u64, aggregator: &NodeName| {
            !signed
                || (*aggregator == arguments.name
                    && !ledger.is_stated(&Epoch::new(term, aggregator.clone())))
        };
        Self {
            entries: ledger
                .entries()
                .filter(|entry| is_kept(entry.epoch, &entry.aggregator))
                .collect(),
            marks: ledger
                .marks()
                .filter(|mark| is_kept(mark.epoch, &mark.aggregator))
                .collect(),
            standing: store.standing.clone(),
            signed,
            certificate: certificate.cloned(),
            statements: ledger
                .statements()
                .map(|share| LedgerShare::clone(share))
                .collect(),
            reset_at_us: ledger.reset_at(),
            ..Self::reset(&arguments.cell, &arguments.name, Timestamp::default())
        }
    }

    /// An empty state that also voids evidence from before `reset_at_us`.
    fn reset(cell: &NodeName, node: &NodeName, reset_at_us: Timestamp) -> Self {
        Self {
            schema: SCHEMA_VERSION,
            cell: cell.clone(),
            node: node.clone(),
            entries: Vec::new(),
            marks: Vec::new(),
            standing: BTreeMap::new(),
            signed: true,
            certificate: None,
            statements: Vec::new(),
            reset_at_us,
        }
    }

    fn is_of(&self, arguments: &ReputationKeeperArguments) -> bool {
        self.schema == SCHEMA_VERSION && self.cell == arguments.cell && self.node == arguments.name
    }
}

/// Empties the file. A node that starts with it makes the other nodes drop evidence from before
/// `reset_at`.
///
/// # Errors
/// Returns the error of the disk.
pub fn reset_saved(
    file: &StateFile,
    cell: &NodeName,
    node: &NodeName,
    reset_at: Timestamp,
) -> std::io::Result<()> {
    file.save(&Saved::reset(cell, node, reset_at))
}

/// Reads the file into the store, once in its life.
pub(super) fn restore(arguments: &ReputationKeeperArguments, signer: Option<&mut EvidenceSigner>) {
    let mut store = arguments.reputations.open();
    if std::mem::replace(&mut store.restored, true) {
        return;
    }
    let Some(file) = &arguments.file else {
        tracing::warn!(
            "`state_dir` is not set: reputations and terms are lost when the node stops"
        );
        return;
    };
    if let Some(saved) = file.load(|saved: &Saved| saved.is_of(arguments)) {
        let date = arguments.clock.date(clock::now());
        store.adopt(saved, signer, date);
        tracing::info!(path = %file.path().display(), entries = store.ledger.entries().count(), "reputations restored");
    }
}

/// Restores an empty store from the bytes of a file; only built for the fuzz targets.
#[cfg(fuzzing)]
pub fn read_saved(bytes: &[u8]) {
    if let Ok(saved) = serde_json::from_slice(bytes) {
        let store = SharedReputations::new(true);
        store.open().adopt(saved, None, EARLIEST);
        drop(store.open().reputations(&ReputationConfig::default()));
    }
}
