//! The actor that records the node's messages, so that its aggregator can be replayed.
//!
//! ```text
//! Fuser, Follower, Gateway's subscriber ── LogSender ──> bounded queue ──> writer thread ──> DIR/<node>-<time>.mcap
//! Recorder ── leadership, counters ───────────┘
//! ```
//!
//! - Recording does not wait for the disk. A full queue drops and counts entries; the log records
//!   dropped inputs of the aggregator.
//! - Every second the log is flushed in whole chunks. If the process ends, at most one second is
//!   lost, and readers that don't need the end of the file can read the rest.
//! - A failing disk is counted, logged once and tried again; the node continues.

use std::sync::Arc;
use std::sync::mpsc::sync_channel;
use std::thread::JoinHandle;
use std::time::Duration;

use ecod::leadership::Leadership;
use ractor::{Actor, ActorProcessingErr, ActorRef};
use tokio::sync::watch;

use crate::messages::recorder::RecorderMessage;
use crate::observe::recorder::log_sender::LogItem;
use crate::observe::recorder::writer::LogWriter;
use crate::observe::recorder::{LogIdentity, LogSender, RecordConfig};
use crate::platform::clock;
use crate::telemetry::counters::Counters;

/// Arguments of a recorder's start.
pub struct RecorderArguments {
    /// Configuration of the log.
    pub config: RecordConfig,
    /// Identity of the log.
    pub identity: LogIdentity,
    /// Sender that the node's parts share.
    pub recording: LogSender,
    /// Leadership of the node, of which every change is recorded.
    pub leadership: watch::Receiver<Leadership>,
    /// Counters of the node.
    pub counters: Arc<Counters>,
}

/// Owner of the thread that writes the log.
#[derive(Debug, Default)]
pub struct Recorder;

/// The writer thread and the recorded states.
pub struct RecorderState {
    recording: LogSender,
    leadership: watch::Receiver<Leadership>,
    counters: Arc<Counters>,
    writer: Option<JoinHandle<()>>,
}

/// Time between two records of the counters.
const TICK: Duration = Duration::from_secs(1);

/// Maximum time for the last entries to reach the disk.
const STOP_PATIENCE: Duration = Duration::from_secs(1);

impl Actor for Recorder {
    type Msg = RecorderMessage;
    type State = RecorderState;
    type Arguments = RecorderArguments;

    async fn pre_start(
        &self,
        myself: ActorRef<Self::Msg>,
        arguments: Self::Arguments,
    ) -> Result<Self::State, ActorProcessingErr> {
        let RecorderArguments {
            config,
            identity,
            recording,
            leadership,
            counters,
        } = arguments;
        let (sender, queue) = sync_channel(config.queue);
        let writer = LogWriter::new(config, identity, recording.clone());
        let thread = std::thread::Builder::new()
            .name("recorder".into())
            .spawn(move || writer.run(&queue))?;
        recording.connect(Some(sender));
        tokio::spawn(watch_leadership(leadership.clone(), myself.clone()));
        myself.send_interval(TICK, || RecorderMessage::Tick);
        Ok(RecorderState {
            recording,
            leadership,
            counters,
            writer: Some(thread),
        })
    }

    async fn handle(
        &self,
        _myself: ActorRef<Self::Msg>,
        message: Self::Msg,
        state: &mut Self::State,
    ) -> Result<(), ActorProcessingErr> {
        let item = match message {
            RecorderMessage::RecordLeadership => {
                LogItem::Leadership(state.leadership.borrow().clone())
            }
            RecorderMessage::Tick => LogItem::Counters(state.counters.snapshot()),
        };
        state.recording.send(clock::now(), item);
        if state.writer.as_ref().is_some_and(JoinHandle::is_finished) {
            Err("the writer ended".into())
        } else {
            Ok(())
        }
    }

    async fn post_stop(
        &self,
        _myself: ActorRef<Self::Msg>,
        state: &mut Self::State,
    ) -> Result<(), ActorProcessingErr> {
        state.recording.connect(None);
        let Some(writer) = state.writer.take() else {
            return Ok(());
        };
        let ended = tokio::task::spawn_blocking(|| writer.join().is_ok());
        if tokio::time::timeout(STOP_PATIENCE, ended).await.is_err() {
            tracing::warn!("the last log entries are not yet on the disk");
        }
        Ok(())
    }
}

/// Requests a record of the current leadership and of every change; ends with the recorder.
async fn watch_leadership(
    mut leadership: watch::Receiver<Leadership>,
    recorder: ActorRef<RecorderMessage>,
) {
    while recorder.cast(RecorderMessage::RecordLeadership).is_ok()
        && leadership.changed().await.is_ok()
    {}
}
