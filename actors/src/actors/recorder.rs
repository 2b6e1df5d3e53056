//! The actor that records what its node takes, and from which its aggregator can be run again.
//!
//! ```text
//! Fuser, Follower, Gateway's subscriber ── LogSender ──> bounded queue ──> writer thread ──> DIR/<node>-<time>.mcap
//! Recorder ── leadership, counters ───────────┘
//! ```
//!
//! - Nobody waits for the disk. A full queue drops and counts; where the aggregator's inputs were dropped, the log says so.
//! - Every second the log is handed to the operating system in whole chunks: what ends the process costs a second at
//!   most, and readers that do not ask for the end of the file read the rest.
//! - A disk that takes nothing is counted, told of once, and tried again; the node goes on.

use std::sync::Arc;
use std::sync::mpsc::sync_channel;
use std::thread::JoinHandle;
use std::time::Duration;

use ractor::{Actor, ActorProcessingErr, ActorRef};
use tokio::sync::watch;

use crate::messages::leadership::Leadership;
use crate::messages::recorder::RecorderMessage;
use crate::observe::recorder::log_sender::LogItem;
use crate::observe::recorder::writer::LogWriter;
use crate::observe::recorder::{LogIdentity, LogSender, RecordConfig};
use crate::platform::clock;
use crate::telemetry::counters::Counters;

/// What a recorder needs at its start.
pub struct RecorderArguments {
    /// What is recorded, and where.
    pub config: RecordConfig,
    /// Who records.
    pub identity: LogIdentity,
    /// Where the node's parts hand over.
    pub recording: LogSender,
    /// Who leads.
    pub leadership: watch::Receiver<Leadership>,
    /// The node's counters.
    pub counters: Arc<Counters>,
}

/// Records.
#[derive(Debug, Default)]
pub struct Recorder;

/// The writer and what is watched.
pub struct RecorderState {
    recording: LogSender,
    leadership: watch::Receiver<Leadership>,
    counters: Arc<Counters>,
    writer: Option<JoinHandle<()>>,
}

/// How often counters are recorded.
const TICK: Duration = Duration::from_secs(1);

/// How long the last entries may take to the disk.
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
        let RecorderArguments { config, identity, recording, leadership, counters } = arguments;
        let (sender, queue) = sync_channel(config.queue);
        let writer = LogWriter::new(config, identity, recording.clone());
        let writer = std::thread::Builder::new().name("recorder".into()).spawn(move || writer.run(&queue))?;
        recording.connect(Some(sender));
        tokio::spawn(watch_leadership(leadership.clone(), myself.clone()));
        myself.send_interval(TICK, || RecorderMessage::Tick);
        Ok(RecorderState { recording, leadership, counters, writer: Some(writer) })
    }

    async fn handle(
        &self,
        _myself: ActorRef<Self::Msg>,
        message: Self::Msg,
        state: &mut Self::State,
    ) -> Result<(), ActorProcessingErr> {
        let item = match message {
            RecorderMessage::NoteLeadership => LogItem::Leadership(state.leadership.borrow().clone()),
            RecorderMessage::Tick => LogItem::Counters(state.counters.snapshot()),
        };
        state.recording.send(clock::now(), item);
        if state.writer.as_ref().is_some_and(JoinHandle::is_finished) { Err("the writer ended".into()) } else { Ok(()) }
    }

    async fn post_stop(&self, _myself: ActorRef<Self::Msg>, state: &mut Self::State) -> Result<(), ActorProcessingErr> {
        state.recording.connect(None);
        let Some(writer) = state.writer.take() else { return Ok(()) };
        let ended = tokio::task::spawn_blocking(|| writer.join().is_ok());
        if tokio::time::timeout(STOP_PATIENCE, ended).await.is_err() {
            tracing::warn!("the log's last entries are still on their way to the disk");
        }
        Ok(())
    }
}

/// Tells of every change, the present state first; ends with the recorder.
async fn watch_leadership(mut leadership: watch::Receiver<Leadership>, recorder: ActorRef<RecorderMessage>) {
    while recorder.cast(RecorderMessage::NoteLeadership).is_ok() && leadership.changed().await.is_ok() {}
}
