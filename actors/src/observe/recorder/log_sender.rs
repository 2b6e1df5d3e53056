//! Queue from the parts of a node to the recorder. Sending does not block.

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{SyncSender, TrySendError};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, RwLock};

use ecod::aggregator::Command;
use ecod::diagnostics::TroubleKind;
use ecod::leadership::Leadership;
use ecod::model::detection::Detection;
use ecod::model::epoch::Epoch;
use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ecod::perception::camera::Intrinsics;
use ecod::replay::JournalEvent;
use ecod::wire::{
    GlobalMap, LedgerShare, NodeStatus, ObjectReport, ReportKind, Reputations, Verdicts,
};

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
    /// A share of another candidate's evidence.
    Share(Arc<LedgerShare>),
    /// The status of a node, also of this one.
    Status(Arc<NodeStatus>),
    /// A change of the leadership.
    Leadership(Leadership),
    /// A change of the link to a broker.
    Link(BrokerAddress, LinkState),
    /// Counters of the node at this moment.
    Counters(CounterSnapshot),
    /// A picture of a camera.
    Picture(Box<CapturedPicture>),
}

/// A camera's picture with its detections.
#[derive(Debug, Clone)]
pub struct CapturedPicture {
    /// Name of the camera, if it has one.
    pub camera: Option<String>,
    /// Name under which the camera reports.
    pub reporter: NodeName,
    /// The picture as JPEG.
    pub jpeg: Vec<u8>,
    /// Time of capture, in the cell's time, as in reports.
    pub captured_at: Timestamp,
    /// Height of the picture in pixels.
    pub height: u32,
    /// Optics for pixels of the picture, and OpenCV's coefficients k1, k2, p1, p2, k3 to k6; absent
    /// where they are for another shape.
    pub optics: Option<(Intrinsics, Option<[f64; 8]>)>,
    /// Detections in pixels of the picture, before distortion is removed.
    pub detections: Vec<Detection>,
}

impl LogItem {
    /// True if the log contains any part of the item.
    pub(crate) fn is_written(&self) -> bool {
        !matches!(self, Self::Round(_))
    }

    /// True for a change of the aggregator's settings.
    fn is_change(&self) -> bool {
        matches!(
            self,
            Self::Journal(JournalEvent::Command(Command::Configure { .. }))
        )
    }

    /// True if an exact replay of the aggregator needs it.
    pub(crate) fn is_of_journal(&self) -> bool {
        matches!(self, Self::Report(..) | Self::Journal(_))
    }
}

/// Sends items to the recorder. Clones share one queue; items are discarded until a recorder runs.
#[derive(Debug, Clone, Default)]
pub struct LogSender(Arc<SharedQueue>);

#[derive(Debug, Default)]
struct SharedQueue {
    queue: RwLock<Option<SyncSender<LogEntry>>>,
    /// Journal entries that were lost and are not yet noted in the log.
    missing: AtomicU64,
    /// The latest change of settings that found the queue full: all later rounds depend on it.
    change: Mutex<Option<LogEntry>>,
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
        Self(Arc::new(SharedQueue {
            counters,
            ..SharedQueue::default()
        }))
    }

    /// Queues an item. A full queue drops and counts it, except for the latest change of settings,
    /// which is kept separately.
    pub fn send(&self, at: Timestamp, item: LogItem) {
        let queue = self.0.queue.read().unwrap_or_else(PoisonError::into_inner);
        let Some(queue) = &*queue else { return };
        let Err(TrySendError::Full(entry) | TrySendError::Disconnected(entry)) =
            queue.try_send(LogEntry { at, item })
        else {
            return;
        };
        let lost = if entry.item.is_change() {
            self.change().replace(entry)
        } else {
            Some(entry)
        };
        if let Some(lost) = lost {
            self.count_lost(1, u64::from(lost.item.is_of_journal()));
            self.record_incomplete("entries are missing in the log: the disk is too slow for them");
        }
    }

    /// Takes the change of settings that is kept outside the queue, if its time has come.
    pub(crate) fn take_change(&self, now: Timestamp) -> Option<LogEntry> {
        self.change().take_if(|change| change.at <= now)
    }

    fn change(&self) -> MutexGuard<'_, Option<LogEntry>> {
        self.0.change.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Counts lost entries, and the lost journal entries that the log must record.
    pub(crate) fn count_lost(&self, entries: u64, of_journal: u64) {
        self.0.counters.add(Event::RecordDropped, entries);
        self.0.missing.fetch_add(of_journal, Ordering::Relaxed);
    }

    /// Records that the log is incomplete.
    pub(crate) fn record_incomplete(&self, cause: &str) {
        self.0
            .counters
            .troubles()
            .record(TroubleKind::NotRecorded, cause);
    }

    /// Journal entries lost since the last call.
    pub(crate) fn take_missing(&self) -> u64 {
        self.0.missing.swap(0, Ordering::Relaxed)
    }

    pub(crate) fn aggregator_state(&self) -> MutexGuard<'_, AggregatorState> {
        self.0
            .aggregator_state
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
    }

    pub(crate) fn counters(&self) -> &Counters {
        &self.0.counters
    }

    /// Replaces the queue; `None` disconnects the recorder. A recorder that starts gets the current
    /// settings.
    pub(crate) fn connect(&self, queue: Option<SyncSender<LogEntry>>) {
        if queue.is_some() {
            self.change().take();
        }
        *self.0.queue.write().unwrap_or_else(PoisonError::into_inner) = queue;
    }
}
