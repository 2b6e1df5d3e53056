//! Thread that writes the log, so that other threads don't wait for the disk.

use std::sync::mpsc::{Receiver, RecvTimeoutError};
use std::time::{Duration, Instant};

use ecod::aggregator::{Command, FusionConfig};
use ecod::model::time::Timestamp;
use ecod::replay::JournalEvent;
use mcap::{McapError, McapResult};

use super::config::RecordConfig;
use super::disk;
use super::entry_encoder::EntryEncoder;
#[cfg(feature = "foxglove")]
use super::live_server::LiveServer;
use super::log_file::LogFile;
use super::log_identity::LogIdentity;
use super::log_sender::{AggregatorState, LogEntry, LogItem, LogSender};
use crate::telemetry::counters::Event;

/// Time between two flushes. The end of the process loses at most this.
const FLUSH_PERIOD: Duration = Duration::from_secs(1);

/// Wait after a failure before the disk is tried again.
const RETRY_AFTER: Duration = Duration::from_secs(5);

/// Writes the entries of the queue to files.
pub(crate) struct LogWriter {
    config: RecordConfig,
    identity: LogIdentity,
    recording: LogSender,
    encoder: EntryEncoder,
    file: Option<LogFile>,
    #[cfg(feature = "foxglove")]
    live: Option<LiveServer>,
    pending: Pending,
    flush_due: Instant,
    retry_at: Option<Instant>,
    /// True if the last write failed; only the first failure is logged.
    failing: bool,
}

/// Number of entries since the last flush, which a failure loses.
#[derive(Debug, Default)]
struct Pending {
    entries: u64,
    /// Journal entries among them, including earlier losses that they report.
    of_journal: u64,
}

impl LogWriter {
    pub(crate) fn new(config: RecordConfig, identity: LogIdentity, recording: LogSender) -> Self {
        let flush_due = Instant::now() + FLUSH_PERIOD;
        let encoder =
            |drawable| EntryEncoder::new(identity.node.clone(), &identity.landmarks, drawable);
        #[cfg(feature = "foxglove")]
        let live = config
            .live_port
            .map(|port| LiveServer::new(port, encoder(true)));
        let encoder = encoder(config.drawable);
        Self {
            config,
            identity,
            recording,
            encoder,
            file: None,
            #[cfg(feature = "foxglove")]
            live,
            pending: Pending::default(),
            flush_due,
            retry_at: None,
            failing: false,
        }
    }

    /// Writes until all senders are gone.
    pub(crate) fn run(mut self, queue: &Receiver<LogEntry>) {
        loop {
            match queue.recv_timeout(self.flush_due.saturating_duration_since(Instant::now())) {
                Ok(entry) => self.write(&entry),
                Err(RecvTimeoutError::Timeout) => {}
                Err(RecvTimeoutError::Disconnected) => break,
            }
            if Instant::now() >= self.flush_due {
                self.flush();
                self.flush_due = Instant::now() + FLUSH_PERIOD;
            }
        }
        if let Some(change) = self.recording.take_change(Timestamp(u64::MAX)) {
            self.write(&change);
        }
        self.flush();
        if let Some(Err(error)) = self.file.take().map(LogFile::finish) {
            self.failed(&error);
        }
    }

    /// Writes an entry, after a change of settings that did not get into the queue before it.
    fn write(&mut self, entry: &LogEntry) {
        if let Some(change) = self.recording.take_change(entry.at) {
            self.write(&change);
        }
        #[cfg(feature = "foxglove")]
        if let Some(live) = &mut self.live {
            live.show(entry);
        }
        if !entry.item.is_written() {
            return self.track_aggregator(&entry.item);
        }
        self.open(entry);
        self.track_aggregator(&entry.item);
        let of_journal = u64::from(entry.item.is_of_journal());
        let Some(file) = &mut self.file else {
            return self.recording.count_lost(1, of_journal);
        };
        let missing = self.recording.take_missing();
        self.pending.entries += 1;
        self.pending.of_journal += of_journal + missing;
        let noted = match missing {
            0 => Ok(()),
            entries => self
                .encoder
                .journal(entry.at, &JournalEvent::Missing { entries }, file),
        };
        if let Err(error) = noted.and_then(|()| self.encoder.write(entry, file)) {
            self.failed(&error);
        }
    }

    /// Starts the next file if there is none, unless an attempt has just failed.
    fn open(&mut self, entry: &LogEntry) {
        if self.file.is_some() || self.retry_at.is_some_and(|at| Instant::now() < at) {
            return;
        }
        match self.begin(entry) {
            Ok(file) => {
                tracing::info!(file = %file.path().display(), "recording");
                self.file = Some(file);
                self.retry_at = None;
            }
            Err(error) => self.failed(&error),
        }
    }

    fn begin(&mut self, entry: &LogEntry) -> McapResult<LogFile> {
        let dir = &self.config.dir;
        let node = &self.identity.node;
        std::fs::create_dir_all(dir)?;
        // Deletion comes first, since it may free the space that is needed. Its failure does not
        // end the log.
        if let Err(error) = disk::prune(dir, node, self.config.max_old_bytes()) {
            tracing::warn!(dir = %dir.display(), %error, "cannot delete old logs");
        }
        let (path, file) = disk::create(dir, node, entry.at, self.config.min_free_bytes())?;
        let mut file = LogFile::begin(&path, file, &self.identity)?;
        let AggregatorState {
            runs,
            leads,
            next_round,
        } = self.recording.aggregator_state().clone();
        if runs && !matches!(entry.item, LogItem::Journal(JournalEvent::Start { .. })) {
            self.encoder.journal(
                entry.at,
                &JournalEvent::Continue { leads, next_round },
                &mut file,
            )?;
        }
        Ok(file)
    }

    /// Follows the state and settings of the aggregator, for files that begin in the middle of its
    /// run.
    fn track_aggregator(&mut self, item: &LogItem) {
        let mut aggregator_state = self.recording.aggregator_state();
        match item {
            LogItem::Journal(JournalEvent::Start { .. }) => {
                *aggregator_state = AggregatorState {
                    runs: true,
                    ..AggregatorState::default()
                }
            }
            LogItem::Journal(JournalEvent::Command(Command::Lead {
                epoch, first_round, ..
            })) => {
                aggregator_state.leads = Some(epoch.clone());
                aggregator_state.next_round = *first_round;
            }
            LogItem::Journal(JournalEvent::Command(Command::Configure { fusion, landmarks })) => {
                self.identity.fusion = FusionConfig::clone(fusion);
                self.identity.landmarks = landmarks.clone();
            }
            LogItem::Journal(JournalEvent::Command(Command::StepDown)) => {
                aggregator_state.leads = None;
            }
            LogItem::Round(round) => aggregator_state.next_round = round.saturating_add(1),
            _ => {}
        }
    }

    fn flush(&mut self) {
        let Some(file) = &mut self.file else { return };
        let is_full = match file.flush() {
            Ok(bytes) => {
                bytes >= self.config.max_file_bytes()
                    || file.opened().elapsed() >= self.config.max_file_age()
            }
            Err(error) => return self.failed(&error),
        };
        self.recording
            .counters()
            .add(Event::Recorded, std::mem::take(&mut self.pending).entries);
        self.failing = false;
        if let Err(error) = disk::check_room(&self.config.dir, self.config.min_free_bytes()) {
            // All entries are in the file, which only needs its end.
            let ended = self.file.take().map_or(Ok(()), LogFile::finish);
            return self.failed(&ended.err().unwrap_or(error.into()));
        }
        if is_full && let Some(Err(error)) = self.file.take().map(LogFile::finish) {
            self.failed(&error);
        }
    }

    /// Counts a failure, gives up the file and schedules the next attempt.
    fn failed(&mut self, error: &McapError) {
        self.recording.counters().count(Event::RecordFailed);
        if let Some(file) = self.file.take() {
            file.abandon();
        }
        let Pending {
            entries,
            of_journal,
        } = std::mem::take(&mut self.pending);
        self.recording.count_lost(entries, of_journal);
        self.retry_at = Some(Instant::now() + RETRY_AFTER);
        let directory = self.config.dir.display();
        let error = match error {
            McapError::Io(disk) => disk.to_string(),
            other => other.to_string(),
        };
        self.recording
            .record_incomplete(&format!("nothing is recorded in {directory}: {error}"));
        if !std::mem::replace(&mut self.failing, true) {
            tracing::warn!(%directory, error, "not recording, the node goes on; trying again every {} s", RETRY_AFTER.as_secs());
        }
    }
}

#[cfg(test)]
mod tests {
    use std::fs::File;
    use std::os::fd::AsRawFd;
    use std::path::Path;
    use std::sync::Arc;
    use std::sync::mpsc::sync_channel;

    use ecod::model::names::NodeName;
    use ecod::perception::landmark::LandmarkConfig;
    use ecod::replay::JournalEntry;
    use rustix::fs::{MemfdFlags, SealFlags, fcntl_add_seals, memfd_create};
    use uuid::Uuid;

    use super::*;
    use crate::observe::recorder::{LogEvent, LogMessage, LogReader, SchemaName, files};
    use crate::telemetry::counters::Counters;

    const NODE: NodeName = NodeName::from_static("cav");

    fn writer(config: RecordConfig, counters: &Arc<Counters>) -> LogWriter {
        let identity = LogIdentity::new(
            NODE,
            Uuid::nil(),
            NodeName::from_static("lot-1"),
            FusionConfig::default(),
            Vec::new(),
        );
        LogWriter::new(config, identity, LogSender::new(Arc::clone(counters)))
    }

    fn in_directory(directory: &Path) -> RecordConfig {
        RecordConfig {
            min_free_mb: 0,
            ..RecordConfig::new(directory)
        }
    }

    fn second(seconds: u64, item: LogItem) -> LogEntry {
        LogEntry {
            at: Timestamp(seconds * 1_000_000),
            item,
        }
    }

    fn messages(path: &Path) -> Vec<LogMessage> {
        let message = |event| {
            if let Ok(LogEvent::Message(message)) = event {
                Some(message)
            } else {
                None
            }
        };
        LogReader::open(path).unwrap().filter_map(message).collect()
    }

    /// Times at which the log records missing entries, and their numbers.
    fn missing(messages: &[LogMessage]) -> Vec<(Timestamp, u64)> {
        let journal = messages
            .iter()
            .filter(|message| message.schema == SchemaName::JournalEntry);
        let missing = |message: &LogMessage| match serde_json::from_slice(&message.json).unwrap() {
            JournalEntry {
                at_us,
                event: JournalEvent::Missing { entries },
            } => Some((at_us, entries)),
            JournalEntry { .. } => None,
        };
        journal.filter_map(missing).collect()
    }

    #[test]
    fn disk_limit_includes_small_files() {
        let directory = tempfile::tempdir().unwrap();
        for second in 0..40 {
            let (path, _) =
                disk::create(directory.path(), &NODE, Timestamp(second * 1_000_000), 0).unwrap();
            std::fs::write(path, vec![0; 100_000]).unwrap();
        }
        let kept = || files(directory.path()).unwrap();
        let config = |min_free_mb| RecordConfig {
            max_file_mb: 1,
            max_total_mb: 3,
            min_free_mb,
            ..RecordConfig::new(directory.path())
        };
        let counters = Arc::new(Counters::default());
        let entry = second(100, LogItem::Counters(counters.snapshot()));
        let all = kept();
        writer(config(1_000_000_000), &counters).write(&entry);
        assert_eq!(counters.events(Event::RecordFailed), 1);
        let troubles = counters.troubles().present();
        assert_eq!(troubles[0].kind, "not_recorded", "{troubles:?}");
        assert_eq!(
            kept(),
            all[20..],
            "the oldest are gone, though there is still no room for another"
        );
        for starts in 1..=3 {
            let mut writer = writer(config(0), &counters);
            writer.write(&entry);
            writer.flush();
            assert_eq!(counters.events(Event::Recorded), starts);
            let bytes: u64 = kept()
                .iter()
                .map(|path| path.metadata().unwrap().len())
                .sum();
            assert!(bytes <= 3_000_000, "{bytes} bytes after {starts} starts");
        }
    }

    #[test]
    fn new_file_has_current_settings() {
        let directory = tempfile::tempdir().unwrap();
        let counters = Arc::new(Counters::default());
        let mut writer = writer(in_directory(directory.path()), &counters);
        let landmarks = vec![LandmarkConfig::at("slot-0", 1.0, 2.0)];
        let change = Command::Configure {
            fusion: Box::default(),
            landmarks: landmarks.clone(),
        };
        writer.write(&second(1, LogItem::Journal(JournalEvent::Command(change))));
        writer.flush();
        writer.file.take().map(LogFile::finish).unwrap().unwrap();
        writer.write(&second(2, LogItem::Counters(counters.snapshot())));
        writer.flush();
        let known = |path: &Path| {
            let identity = |event| {
                if let Ok(LogEvent::Identity(identity)) = event {
                    Some(identity.landmarks)
                } else {
                    None
                }
            };
            LogReader::open(path).unwrap().find_map(identity).unwrap()
        };
        let files = files(directory.path()).unwrap();
        assert_eq!([known(&files[0]), known(&files[1])], [vec![], landmarks]);
    }

    #[test]
    fn settings_change_survives_full_queue() {
        let directory = tempfile::tempdir().unwrap();
        let counters = Arc::new(Counters::default());
        let mut writer = writer(in_directory(directory.path()), &counters);
        let (sender, queue) = sync_channel(1);
        writer.recording.connect(Some(sender));
        let change = |id| {
            let landmarks = vec![LandmarkConfig::at(id, 1.0, 2.0)];
            LogItem::Journal(JournalEvent::Command(Command::Configure {
                fusion: Box::default(),
                landmarks,
            }))
        };
        let tick = || LogItem::Journal(JournalEvent::Command(Command::Tick));
        let items = [
            (1, tick()),
            (3, change("superseded")),
            (4, change("slot-0")),
            (4, tick()),
        ];
        for (seconds, item) in items {
            writer.recording.send(Timestamp(seconds * 1_000_000), item);
        }
        writer.write(&queue.recv().unwrap());
        writer.write(&second(2, tick()));
        writer.write(&second(5, tick()));
        writer.flush();
        let messages = messages(&files(directory.path()).unwrap()[0]);
        let journal = messages
            .iter()
            .filter(|message| message.schema == SchemaName::JournalEntry);
        let events =
            journal.map(|message| serde_json::from_slice::<JournalEntry>(&message.json).unwrap());
        let listed: Vec<_> = events
            .map(|JournalEntry { at_us, event }| match event {
                JournalEvent::Command(Command::Configure { landmarks, .. }) => {
                    (at_us.0 / 1_000_000, landmarks[0].id.to_string())
                }
                JournalEvent::Missing { entries } => {
                    (at_us.0 / 1_000_000, format!("{entries} missing"))
                }
                _ => (at_us.0 / 1_000_000, "tick".into()),
            })
            .collect();
        let listed: Vec<_> = listed
            .iter()
            .map(|(at, event)| (*at, event.as_str()))
            .collect();
        assert_eq!(
            listed,
            [
                (1, "2 missing"),
                (1, "tick"),
                (2, "tick"),
                (4, "slot-0"),
                (5, "tick")
            ]
        );
        assert_eq!(counters.events(Event::RecordDropped), 2);
        assert_eq!(
            writer.identity.landmarks[0].id.as_str(),
            "slot-0",
            "later files have it, too"
        );
    }

    #[test]
    fn full_disk_closes_file_cleanly() {
        let directory = tempfile::tempdir().unwrap();
        let counters = Arc::new(Counters::default());
        let mut writer = writer(in_directory(directory.path()), &counters);
        let entry = |seconds: u64| second(seconds, LogItem::Counters(counters.snapshot()));
        writer.write(&entry(1));
        writer.flush();
        assert_eq!(counters.events(Event::RecordFailed), 0);
        writer.config.min_free_mb = 1_000_000_000;
        writer.write(&entry(2));
        writer.flush();
        writer.write(&entry(3));
        let recorded = Event::Recorded;
        let failed = Event::RecordFailed;
        let dropped = Event::RecordDropped;
        assert_eq!(
            [recorded, failed, dropped].map(|event| counters.events(event)),
            [2, 1, 1]
        );
        let path = &files(directory.path()).unwrap()[0];
        let read = LogReader::open(path)
            .unwrap()
            .collect::<Result<Vec<_>, _>>()
            .unwrap();
        assert!(
            read.len() >= 2,
            "what came before is there, and the file is whole: {}",
            read.len()
        );
    }

    #[test]
    fn unwritten_entries_count_as_dropped() {
        let directory = tempfile::tempdir().unwrap();
        let counters = Arc::new(Counters::default());
        let mut writer = writer(in_directory(directory.path()), &counters);
        let counts = || [Event::Recorded, Event::RecordDropped].map(|event| counters.events(event));
        let flags = MemfdFlags::CLOEXEC | MemfdFlags::ALLOW_SEALING;
        let memory = File::from(memfd_create("log", flags).unwrap());
        let path = format!("/proc/self/fd/{}", memory.as_raw_fd());
        let disk = memory.try_clone().unwrap();
        writer.file = Some(LogFile::begin(Path::new(&path), memory, &writer.identity).unwrap());
        let tick = |seconds| {
            second(
                seconds,
                LogItem::Journal(JournalEvent::Command(Command::Tick)),
            )
        };
        writer.write(&tick(1));
        assert_eq!(counts(), [0, 0], "it is not on the disk yet");
        writer.flush();
        assert_eq!(counts(), [1, 0]);

        fcntl_add_seals(&disk, SealFlags::GROW).unwrap();
        writer.recording.count_lost(1, 1);
        writer.write(&tick(2));
        writer.write(&second(3, LogItem::Counters(counters.snapshot())));
        writer.write(&tick(4));
        writer.flush();
        assert_eq!(counts(), [1, 4]);

        writer.retry_at = None;
        writer.write(&tick(5));
        writer.flush();
        assert_eq!(counts(), [2, 4]);
        let next = messages(&files(directory.path()).unwrap()[0]);
        assert_eq!(missing(&next), [(Timestamp(5_000_000), 3)]);
    }

    /// The number of a round is for files that start later; it does not cause a new file.
    #[test]
    fn entries_keep_their_time() {
        let directory = tempfile::tempdir().unwrap();
        let counters = Arc::new(Counters::default());
        let mut writer = writer(in_directory(directory.path()), &counters);
        let (sender, queue) = sync_channel(1);
        writer.recording.connect(Some(sender));
        writer.recording.count_lost(3, 3);
        writer
            .recording
            .send(Timestamp(99_000_000), LogItem::Round(7));
        let round = queue.recv().unwrap();
        assert_eq!(round.at, Timestamp(99_000_000));
        writer.write(&round);
        assert!(files(directory.path()).unwrap().is_empty());
        writer.write(&second(
            100,
            LogItem::Journal(JournalEvent::Command(Command::Tick)),
        ));
        writer.flush();
        let path = &files(directory.path()).unwrap()[0];
        assert_eq!(path.file_name().unwrap(), "cav-19700101T000140Z-000.mcap");
        assert_eq!(missing(&messages(path)), [(Timestamp(100_000_000), 3)]);
        assert_eq!(
            [Event::Recorded, Event::RecordDropped].map(|event| counters.events(event)),
            [1, 3]
        );
    }
}
