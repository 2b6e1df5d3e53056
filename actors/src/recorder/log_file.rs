//! One file of a log while it is written.

use std::collections::{BTreeMap, HashMap};
use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};
use std::time::Instant;

use base64::prelude::{BASE64_STANDARD, Engine};
use ecod::names::NodeName;
use ecod::replay::{JournalEntry, JournalEvent};
use ecod::time::Timestamp;
use ecod::wire::{ObjectReport, ReportKind, Topic};
use mcap::records::{MessageHeader, Metadata};
use mcap::{Compression, McapResult, WriteOptions, Writer};
use serde::Serialize;

use super::channels::{CounterReading, LeadershipChange, SchemaName};
use super::foxglove::{CompressedImage, FrameTransform, Log, SceneUpdate};
use super::identity::Identity;
use super::recording::{Entry, Item};
use crate::gateway::LinkState;

/// A file being written; what was written up to the last [`LogFile::flush`] survives the process.
pub(super) struct LogFile {
    writer: Writer<BufWriter<File>>,
    path: PathBuf,
    node: NodeName,
    drawable: bool,
    opened: Instant,
    channels: HashMap<(SchemaName, String), Channel>,
    /// Reused for every message.
    json: Vec<u8>,
}

struct Channel {
    id: u16,
    sequence: u32,
}

/// Levels of `foxglove.Log`.
const INFO: u8 = 2;
const WARNING: u8 = 3;

impl LogFile {
    /// Begins a file that tells who writes it.
    pub(super) fn begin(path: PathBuf, file: File, identity: &Identity, drawable: bool) -> McapResult<Self> {
        let options = WriteOptions::new()
            .profile("")
            .library(concat!("ecod-node ", env!("CARGO_PKG_VERSION")))
            .compression(Some(Compression::Zstd))
            .compression_level(1)
            .compression_threads(0);
        let mut writer = options.create(BufWriter::with_capacity(1 << 16, file))?;
        writer.write_metadata(&Metadata { name: Identity::RECORD.into(), metadata: identity.to_map() })?;
        writer.flush()?;
        let (node, opened) = (identity.node.clone(), Instant::now());
        Ok(Self { writer, path, node, drawable, opened, channels: HashMap::new(), json: Vec::new() })
    }

    pub(super) fn path(&self) -> &Path {
        &self.path
    }

    pub(super) fn opened(&self) -> Instant {
        self.opened
    }

    /// Writes an entry and what is drawn of it.
    pub(super) fn write(&mut self, Entry { at, item }: &Entry) -> McapResult<()> {
        let at = *at;
        match item {
            Item::Report { kind, report } => self.report(*kind, report, at),
            Item::Journal(event) => self.journal(at, event),
            Item::Round(_) => Ok(()),
            Item::Map(map) => {
                self.put(SchemaName::GlobalMap, &Topic::GlobalDetections.to_string(), at, map.fused_at_us, map)?;
                self.draw(SchemaName::SceneUpdate, "scene/map", at, map.fused_at_us, || SceneUpdate::of_map(map))
            }
            Item::Verdicts(verdicts) => {
                let fused_at = verdicts.fused_at_us;
                self.put(SchemaName::Verdicts, &Topic::GlobalVerdicts.to_string(), at, fused_at, verdicts)
            }
            Item::Reputations(reputations) => {
                self.put(SchemaName::Reputations, &Topic::Reputations.to_string(), at, at, reputations)
            }
            Item::Share(share) => {
                self.put(SchemaName::LedgerShare, &Topic::Ledger(share.node.clone()).to_string(), at, at, share)
            }
            Item::Status(status) => {
                self.put(SchemaName::NodeStatus, &Topic::Nodes(status.node.clone()).to_string(), at, at, status)
            }
            Item::Leadership(leadership) => {
                let change = LeadershipChange::new(self.node.clone(), at, leadership);
                self.put(SchemaName::Leadership, "node/leadership", at, at, &change)?;
                self.say(INFO, at, || change.in_words())
            }
            Item::Link { broker, state } => {
                let level = if *state == LinkState::Up { INFO } else { WARNING };
                self.say(level, at, || format!("link to {broker} is {state:?}").to_lowercase())
            }
            Item::Counters(snapshot) => {
                let named = |counts: &BTreeMap<&str, u64>| counts.iter().map(|(k, v)| ((*k).to_owned(), *v)).collect();
                let (events, rejects) = (named(&snapshot.events), named(&snapshot.rejects));
                let reading = CounterReading { node: self.node.clone(), at_us: at, events, rejects };
                self.put(SchemaName::Counters, "node/counters", at, at, &reading)
            }
            Item::Picture(jpeg) => self.picture(jpeg, at),
        }
    }

    /// Writes what happened to the aggregator.
    pub(super) fn journal(&mut self, at_us: Timestamp, event: &JournalEvent) -> McapResult<()> {
        let entry = JournalEntry { at_us, event: event.clone() };
        self.put(SchemaName::JournalEntry, "node/journal", at_us, at_us, &entry)
    }

    /// Closes the chunk and hands all bytes to the operating system; says how large the file is.
    pub(super) fn flush(&mut self) -> McapResult<u64> {
        self.writer.flush()?;
        Ok(std::fs::metadata(&self.path)?.len())
    }

    /// Ends the file with its index.
    pub(super) fn finish(mut self) -> McapResult<()> {
        self.writer.finish()?;
        self.writer.into_inner().flush()?;
        Ok(())
    }

    /// Leaves the file as it is, such as when the disk takes no more.
    pub(super) fn abandon(self) {
        drop(self.writer.into_inner().into_parts());
    }

    fn report(&mut self, kind: ReportKind, report: &ObjectReport, at: Timestamp) -> McapResult<()> {
        let captured_at = report.captured_at_us;
        self.put(SchemaName::ObjectReport, &kind.topic(report.node.clone()).to_string(), at, captured_at, report)?;
        let topic = format!("scene/{}", report.node);
        self.draw(SchemaName::SceneUpdate, &topic, at, captured_at, || SceneUpdate::of_report(report))?;
        let Some(pose) = report.pose else { return Ok(()) };
        let transform = || FrameTransform::of(&report.node, pose, captured_at);
        self.draw(SchemaName::FrameTransform, "tf", at, captured_at, transform)
    }

    fn picture(&mut self, jpeg: &[u8], at: Timestamp) -> McapResult<()> {
        let data = BASE64_STANDARD.encode(jpeg);
        let frame_id = self.node.clone();
        let image = CompressedImage { timestamp: at.into(), frame_id, data, format: "jpeg" };
        self.put(SchemaName::CompressedImage, "camera", at, at, &image)
    }

    fn say(&mut self, level: u8, at: Timestamp, message: impl FnOnce() -> String) -> McapResult<()> {
        let name = self.node.to_string();
        let log = || Log { timestamp: at.into(), level, message: message(), name, file: String::new(), line: 0 };
        self.draw(SchemaName::Log, "log", at, at, log)
    }

    fn draw<T: Serialize>(
        &mut self,
        schema: SchemaName,
        topic: &str,
        at: Timestamp,
        made_at: Timestamp,
        message: impl FnOnce() -> T,
    ) -> McapResult<()> {
        if self.drawable { self.put(schema, topic, at, made_at, &message()) } else { Ok(()) }
    }

    fn put(
        &mut self,
        schema: SchemaName,
        topic: &str,
        at: Timestamp,
        made_at: Timestamp,
        message: &impl Serialize,
    ) -> McapResult<()> {
        self.json.clear();
        serde_json::to_writer(&mut self.json, message).map_err(std::io::Error::from)?;
        let key = (schema, topic.to_owned());
        if !self.channels.contains_key(&key) {
            let text = schema.json_schema().to_value().to_string();
            let schema_id = self.writer.add_schema(schema.as_str(), "jsonschema", text.as_bytes())?;
            let id = self.writer.add_channel(schema_id, topic, "json", &BTreeMap::new())?;
            self.channels.insert(key.clone(), Channel { id, sequence: 0 });
        }
        let Some(channel) = self.channels.get_mut(&key) else { return Ok(()) };
        channel.sequence = channel.sequence.wrapping_add(1);
        let header = MessageHeader {
            channel_id: channel.id,
            sequence: channel.sequence,
            log_time: nanoseconds(at),
            publish_time: nanoseconds(made_at),
        };
        self.writer.write_to_known_channel(&header, &self.json)
    }
}

/// Unix nanoseconds; the log's times are exact microseconds.
fn nanoseconds(at: Timestamp) -> u64 {
    at.micros().saturating_mul(1000)
}
