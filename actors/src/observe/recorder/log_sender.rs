//! Queue from the parts of a node to the recorder. Sending never waits.

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::SyncSender;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, RwLock};

use ecod::leadership::Leadership;
use ecod::model::epoch::Epoch;
use ecod::model::time::Timestamp;
use ecod::replay::JournalEvent;
use ecod::wire::{GlobalMap, LedgerShare, NodeStatus, ObjectReport, ReportKind, Reputations, Verdicts};

use crate::telemetry::counters::{CounterSnapshot, Counters, Event};
use crate::transport::mqtt::{BrokerAddress, LinkState};

/// An item to record with its time by the node's clock.
#[derive(Debug, Clone)]
pub(crate) struct LogEntry {
    pub(crate) at: Timestamp,
    pub(crate) item: LogItem,
}

/// An item to record.
#[derive(Debug, Clone)]
pub enum LogItem {
    /// A report as the aggregator took it, or as an observer received it.
    Report(ReportKind, Arc<ObjectReport>),
    /// An input of the aggregator other than a report.
    Journal(JournalEvent),
    /// Number of a round that the aggregator closed; not written.
    Round(u64),
    /// A map that the node accepted.
    Map(Arc<GlobalMap>),
    /// Verdicts that the node accepted.
    Verdicts(Arc<Verdicts>),
    /// Reputations that the node accepted.
    Reputations(Arc<Reputations>),
    /// Another candidate's evidence.
    Share(Arc<LedgerShare>),
    /// Another node's status.
    Status(Arc<NodeStatus>),
    /// A change of the leadership.
    Leadership(Leadership),
    /// A change of the link to a broker.
    Link(BrokerAddress, LinkState),
    /// The node's counters.
    Counters(CounterSnapshot),
    /// A camera image as JPEG.
    Image(Vec<u8>),
}

impl LogItem {
    /// True if the log holds anything of it.
    pub(crate) fn is_written(&self) -> bool {
        !matches!(self, Self::Round(_))
    }

    /// True if an exact rerun of the aggregator needs it.
    pub(crate) fn is_of_journal(&self) -> bool {
        matches!(self, Self::Report(..) | Self::Journal(_))
    }
}

/// Sends items to the recorder. Clones share one queue; items are discarded until a recorder runs.
#[derive(Debug, Clone, Default)]
pub struct LogSender(Arc<Shared>);

#[derive(Debug, Default)]
struct Shared {
    queue: RwLock<Option<SyncSender<LogEntry>>>,
    /// Journal entries that were lost and are not yet noted in the log.
    missing: AtomicU64,
    aggregator_state: Mutex<AggregatorState>,
    counters: Arc<Counters>,
}

/// State of the aggregator after the last entry taken from the queue.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(crate) struct AggregatorState {
    pub(crate) runs: bool,
    pub(crate) leads: Option<Epoch>,
    pub(crate) next_round: u64,
}

impl LogSender {
    /// A sender that counts losses in `counters`.
    pub fn new(counters: Arc<Counters>) -> Self {
        Self(Arc::new(Shared { counters, ..Shared::default() }))
    }

    /// Queues an item. A full queue drops and counts it.
    pub fn send(&self, at: Timestamp, item: LogItem) {
        let queue = self.0.queue.read().unwrap_or_else(PoisonError::into_inner);
        let Some(queue) = &*queue else { return };
        let is_of_journal = item.is_of_journal();
        if queue.try_send(LogEntry { at, item }).is_err() {
            self.count_lost(1, u64::from(is_of_journal));
        }
    }

    /// Counts lost entries, and those of the journal that the log must note.
    pub(crate) fn count_lost(&self, entries: u64, of_journal: u64) {
        self.0.counters.add(Event::RecordDropped, entries);
        self.0.missing.fetch_add(of_journal, Ordering::Relaxed);
    }

    /// Journal entries lost since the last call.
    pub(crate) fn take_missing(&self) -> u64 {
        self.0.missing.swap(0, Ordering::Relaxed)
    }

    pub(crate) fn aggregator_state(&self) -> MutexGuard<'_, AggregatorState> {
        self.0.aggregator_state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub(crate) fn counters(&self) -> &Counters {
        &self.0.counters
    }

    /// Replaces the queue; `None` disconnects the recorder.
    pub(crate) fn connect(&self, queue: Option<SyncSender<LogEntry>>) {
        *self.0.queue.write().unwrap_or_else(PoisonError::into_inner) = queue;
    }
}
