//! What an entry is in messages: the payloads themselves, and what viewers draw of them.

use std::collections::BTreeMap;

use base64::prelude::{BASE64_STANDARD, Engine};
use ecod::names::NodeName;
use ecod::replay::{JournalEntry, JournalEvent};
use ecod::time::Timestamp;
use ecod::wire::{ObjectReport, ReportKind, Topic};
use mcap::McapResult;
use serde::Serialize;

use super::channels::{CounterReading, LeadershipChange, SchemaName};
use super::foxglove::{CompressedImage, FrameTransform, Level, Log, SceneUpdate};
use super::log_sender::{LogEntry, LogItem};
use crate::transport::mqtt::LinkState;

/// A message of a channel, as JSON.
#[derive(Debug, Clone, Copy)]
pub(crate) struct EncodedMessage<'a> {
    pub(crate) schema: SchemaName,
    pub(crate) topic: &'a str,
    /// When the node took it.
    pub(crate) at: Timestamp,
    /// When it was captured, or the round ended.
    pub(crate) made_at: Timestamp,
    pub(crate) json: &'a [u8],
}

/// Where messages go.
pub(crate) trait MessageSink {
    /// Takes a message.
    ///
    /// # Errors
    /// When it cannot be kept; the rest of its entry is then left out.
    fn put(&mut self, message: EncodedMessage<'_>) -> McapResult<()>;
}

/// Makes messages of entries, in the name of the recording node.
pub(crate) struct EntryEncoder {
    node: NodeName,
    drawable: bool,
    /// Reused for every message.
    json: Vec<u8>,
}

impl EntryEncoder {
    pub(crate) fn new(node: NodeName, drawable: bool) -> Self {
        Self { node, drawable, json: Vec::new() }
    }

    /// Writes an entry and what is drawn of it.
    pub(crate) fn write(&mut self, LogEntry { at, item }: &LogEntry, to: &mut impl MessageSink) -> McapResult<()> {
        let at = *at;
        match item {
            LogItem::Report { kind, report } => self.report(*kind, report, at, to),
            LogItem::Journal(event) => self.journal(at, event, to),
            LogItem::Round(_) => Ok(()),
            LogItem::Map(map) => {
                self.put(SchemaName::GlobalMap, &Topic::GlobalDetections.to_string(), at, map.fused_at_us, map, to)?;
                self.draw(SchemaName::SceneUpdate, "scene/map", at, map.fused_at_us, || SceneUpdate::of_map(map), to)
            }
            LogItem::Verdicts(verdicts) => {
                let fused_at = verdicts.fused_at_us;
                self.put(SchemaName::Verdicts, &Topic::GlobalVerdicts.to_string(), at, fused_at, verdicts, to)
            }
            LogItem::Reputations(reputations) => {
                self.put(SchemaName::Reputations, &Topic::Reputations.to_string(), at, at, reputations, to)
            }
            LogItem::Share(share) => {
                self.put(SchemaName::LedgerShare, &Topic::Ledger(share.node.clone()).to_string(), at, at, share, to)
            }
            LogItem::Status(status) => {
                self.put(SchemaName::NodeStatus, &Topic::Nodes(status.node.clone()).to_string(), at, at, status, to)
            }
            LogItem::Leadership(leadership) => {
                let change = LeadershipChange::new(self.node.clone(), at, leadership);
                self.put(SchemaName::Leadership, "node/leadership", at, at, &change, to)?;
                self.say(Level::Info, at, || change.in_words(), to)
            }
            LogItem::Link { broker, state } => {
                let level = if *state == LinkState::Up { Level::Info } else { Level::Warning };
                self.say(level, at, || format!("link to {broker} is {state:?}").to_lowercase(), to)
            }
            LogItem::Counters(snapshot) => {
                let named = |counts: &BTreeMap<&str, u64>| counts.iter().map(|(k, v)| ((*k).to_owned(), *v)).collect();
                let (events, rejects) = (named(&snapshot.events), named(&snapshot.rejects));
                let shed = named(&snapshot.shed);
                let reading = CounterReading { node: self.node.clone(), at_us: at, events, rejects, shed };
                self.put(SchemaName::Counters, "node/counters", at, at, &reading, to)
            }
            LogItem::Picture(jpeg) => self.picture(jpeg, at, to),
        }
    }

    /// Writes what happened to the aggregator.
    pub(crate) fn journal(
        &mut self,
        at_us: Timestamp,
        event: &JournalEvent,
        to: &mut impl MessageSink,
    ) -> McapResult<()> {
        let entry = JournalEntry { at_us, event: event.clone() };
        self.put(SchemaName::JournalEntry, "node/journal", at_us, at_us, &entry, to)
    }

    fn report(
        &mut self,
        kind: ReportKind,
        report: &ObjectReport,
        at: Timestamp,
        to: &mut impl MessageSink,
    ) -> McapResult<()> {
        let captured_at = report.captured_at_us;
        self.put(SchemaName::ObjectReport, &kind.topic(report.node.clone()).to_string(), at, captured_at, report, to)?;
        let topic = format!("scene/{}", report.node);
        self.draw(SchemaName::SceneUpdate, &topic, at, captured_at, || SceneUpdate::of_report(report), to)?;
        let Some(pose) = report.pose else { return Ok(()) };
        let transform = || FrameTransform::of(&report.node, pose, captured_at);
        self.draw(SchemaName::FrameTransform, "tf", at, captured_at, transform, to)
    }

    fn picture(&mut self, jpeg: &[u8], at: Timestamp, to: &mut impl MessageSink) -> McapResult<()> {
        let data = BASE64_STANDARD.encode(jpeg);
        let frame_id = self.node.clone();
        let image = CompressedImage { timestamp: at.into(), frame_id, data, format: "jpeg" };
        self.put(SchemaName::CompressedImage, "camera", at, at, &image, to)
    }

    fn say(
        &mut self,
        level: Level,
        at: Timestamp,
        message: impl FnOnce() -> String,
        to: &mut impl MessageSink,
    ) -> McapResult<()> {
        let name = self.node.to_string();
        let log = || Log { timestamp: at.into(), level, message: message(), name, file: String::new(), line: 0 };
        self.draw(SchemaName::Log, "log", at, at, log, to)
    }

    fn draw<T: Serialize>(
        &mut self,
        schema: SchemaName,
        topic: &str,
        at: Timestamp,
        made_at: Timestamp,
        message: impl FnOnce() -> T,
        to: &mut impl MessageSink,
    ) -> McapResult<()> {
        if self.drawable { self.put(schema, topic, at, made_at, &message(), to) } else { Ok(()) }
    }

    fn put(
        &mut self,
        schema: SchemaName,
        topic: &str,
        at: Timestamp,
        made_at: Timestamp,
        message: &impl Serialize,
        to: &mut impl MessageSink,
    ) -> McapResult<()> {
        self.json.clear();
        serde_json::to_writer(&mut self.json, message).map_err(std::io::Error::from)?;
        to.put(EncodedMessage { schema, topic, at, made_at, json: &self.json })
    }
}
