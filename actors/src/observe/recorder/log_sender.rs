//! Where the parts of a node hand over what is to be recorded; they never wait.

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::SyncSender;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, RwLock};

use ecod::epoch::Epoch;
use ecod::leadership::Leadership;
use ecod::replay::JournalEvent;
use ecod::time::Timestamp;
use ecod::wire::{GlobalMap, LedgerShare, NodeStatus, ObjectReport, ReportKind, Reputations, Verdicts};

use crate::telemetry::counters::{CounterSnapshot, Counters, Event};
use crate::transport::mqtt::{BrokerAddress, LinkState};

/// Something to be recorded and when it happened, by the node's clock.
#[derive(Debug, Clone)]
pub(crate) struct LogEntry {
    pub(crate) at: Timestamp,
    pub(crate) item: LogItem,
}

/// Something to be recorded.
#[derive(Debug, Clone)]
pub(crate) enum LogItem {
    /// A report as the aggregator took it, or as an observer saw it.
    Report {
        kind: ReportKind,
        report: Arc<ObjectReport>,
    },
    /// What the aggregator was told beside reports.
    Journal(JournalEvent),
    /// The aggregator made this round; not written.
    Round(u64),
    Map(Arc<GlobalMap>),
    Verdicts(Arc<Verdicts>),
    Reputations(Arc<Reputations>),
    Share(Arc<LedgerShare>),
    Status(Arc<NodeStatus>),
    Leadership(Leadership),
    Link {
        broker: BrokerAddress,
        state: LinkState,
    },
    Counters(CounterSnapshot),
    /// A picture of the camera as JPEG.
    Picture(Vec<u8>),
}

impl LogItem {
    /// Whether there is anything of it in the log.
    pub(crate) fn is_written(&self) -> bool {
        !matches!(self, Self::Round(_))
    }

    /// Whether the aggregator cannot be run again exactly without it.
    pub(crate) fn is_of_journal(&self) -> bool {
        matches!(self, Self::Report { .. } | Self::Journal(_))
    }
}

/// Takes what is to be recorded; clones lead to the same place. Nothing is recorded until a [`super::Recorder`] runs.
#[derive(Debug, Clone, Default)]
pub struct LogSender(Arc<Shared>);

#[derive(Debug, Default)]
struct Shared {
    queue: RwLock<Option<SyncSender<LogEntry>>>,
    /// Journal entries that were lost and have not been told of in the log.
    missing: AtomicU64,
    aggregator_state: Mutex<AggregatorState>,
    counters: Arc<Counters>,
}

/// How the aggregator stands after the last entry that was taken from the queue.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(crate) struct AggregatorState {
    pub(crate) runs: bool,
    pub(crate) leads: Option<Epoch>,
    pub(crate) next_round: u64,
}

impl LogSender {
    /// Counts in `counters`.
    pub fn new(counters: Arc<Counters>) -> Self {
        Self(Arc::new(Shared { counters, ..Shared::default() }))
    }

    /// What the aggregator was told beside reports.
    pub fn journal(&self, at: Timestamp, event: JournalEvent) {
        self.put(at, LogItem::Journal(event));
    }

    /// A report as the aggregator takes it, or as an observer sees it.
    pub fn report(&self, kind: ReportKind, report: &Arc<ObjectReport>, at: Timestamp) {
        self.put(at, LogItem::Report { kind, report: Arc::clone(report) });
    }

    /// The aggregator made this round.
    pub fn round(&self, round: u64, at: Timestamp) {
        self.put(at, LogItem::Round(round));
    }

    /// A map that the node took.
    pub fn map(&self, map: &Arc<GlobalMap>, at: Timestamp) {
        self.put(at, LogItem::Map(Arc::clone(map)));
    }

    /// Verdicts that the node took.
    pub fn verdicts(&self, verdicts: &Arc<Verdicts>, at: Timestamp) {
        self.put(at, LogItem::Verdicts(Arc::clone(verdicts)));
    }

    /// Reputations that the node took.
    pub fn reputations(&self, reputations: &Arc<Reputations>, at: Timestamp) {
        self.put(at, LogItem::Reputations(Arc::clone(reputations)));
    }

    /// Another candidate's evidence.
    pub fn share(&self, share: &Arc<LedgerShare>, at: Timestamp) {
        self.put(at, LogItem::Share(Arc::clone(share)));
    }

    /// What another node says about itself.
    pub fn status(&self, status: &Arc<NodeStatus>, at: Timestamp) {
        self.put(at, LogItem::Status(Arc::clone(status)));
    }

    /// A link changed.
    pub fn link(&self, broker: &BrokerAddress, state: LinkState, at: Timestamp) {
        self.put(at, LogItem::Link { broker: broker.clone(), state });
    }

    /// A picture of the camera as JPEG.
    pub fn picture(&self, jpeg: Vec<u8>, at: Timestamp) {
        self.put(at, LogItem::Picture(jpeg));
    }

    pub(crate) fn put(&self, at: Timestamp, item: LogItem) {
        let queue = self.0.queue.read().unwrap_or_else(PoisonError::into_inner);
        let Some(queue) = &*queue else { return };
        let is_of_journal = item.is_of_journal();
        if queue.try_send(LogEntry { at, item }).is_err() {
            self.lost(1, u64::from(is_of_journal));
        }
    }

    /// Counts entries that are not in the log, and those of the journal that the log is to tell of.
    pub(crate) fn lost(&self, entries: u64, of_journal: u64) {
        self.0.counters.add(Event::RecordDropped, entries);
        self.0.missing.fetch_add(of_journal, Ordering::Relaxed);
    }

    /// Journal entries that were lost since the last call.
    pub(crate) fn take_missing(&self) -> u64 {
        self.0.missing.swap(0, Ordering::Relaxed)
    }

    pub(crate) fn aggregator_state(&self) -> MutexGuard<'_, AggregatorState> {
        self.0.aggregator_state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub(crate) fn counters(&self) -> &Counters {
        &self.0.counters
    }

    /// Sends to another queue from now on, or to none.
    pub(crate) fn connect(&self, queue: Option<SyncSender<LogEntry>>) {
        *self.0.queue.write().unwrap_or_else(PoisonError::into_inner) = queue;
    }
}
