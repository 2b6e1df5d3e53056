//! Maps of cells in the order of arrival, in a file of MCAP.

use std::borrow::Cow;
use std::collections::BTreeMap;
use std::fs::File;
use std::io::BufWriter;
use std::path::Path;

use anyhow::Context;
use ecod::model::time::Timestamp;
use ecod::wire::{CellMap, Encoding, Limits, decode, encode, schemas};
use mcap::Writer;
use mcap::records::MessageHeader;

/// A file that maps are written to: one channel for each cell, with its topic, in JSON.
pub struct CellMapLog {
    writer: Writer<BufWriter<File>>,
    schema: u16,
    /// Number of the channel and of the next message, by topic.
    channels: BTreeMap<String, (u16, u32)>,
}

impl CellMapLog {
    /// An empty log.
    ///
    /// # Errors
    /// Returns an error if it cannot be written.
    pub fn create(path: &Path) -> anyhow::Result<Self> {
        let file =
            File::create(path).with_context(|| format!("cannot write {}", path.display()))?;
        let mut writer = Writer::new(BufWriter::new(file))?;
        let definition = schemas()
            .remove("CellMap")
            .map(|schema| schema.to_value().to_string())
            .unwrap_or_default();
        let schema = writer.add_schema("CellMap", "jsonschema", definition.as_bytes())?;
        Ok(Self {
            writer,
            schema,
            channels: BTreeMap::new(),
        })
    }

    /// Writes a map that was received at `at`, in any encoding.
    ///
    /// # Errors
    /// Returns an error if the file cannot be written.
    pub fn write(&mut self, topic: &str, payload: &[u8], at: Timestamp) -> anyhow::Result<()> {
        let Ok(map) = decode::<CellMap>(payload, &Limits::default()) else {
            return Ok(());
        };
        if !self.channels.contains_key(topic) {
            let channel = self
                .writer
                .add_channel(self.schema, topic, "json", &BTreeMap::new())?;
            self.channels.insert(topic.to_owned(), (channel, 0));
        }
        let Some((channel, sequence)) = self.channels.get_mut(topic) else {
            return Ok(());
        };
        let header = MessageHeader {
            channel_id: *channel,
            sequence: *sequence,
            log_time: at.micros().saturating_mul(1000),
            publish_time: map.sent_at_us.micros().saturating_mul(1000),
        };
        *sequence += 1;
        let payload = if payload.starts_with(b"{") {
            Cow::from(payload)
        } else {
            encode(&map, Encoding::Json).into()
        };
        Ok(self.writer.write_to_known_channel(&header, &payload)?)
    }

    /// Ends the file; returns the number of cells and of maps in it.
    ///
    /// # Errors
    /// Returns an error if it cannot be written.
    pub fn finish(mut self) -> anyhow::Result<(usize, u64)> {
        self.writer.finish()?;
        Ok((
            self.channels.len(),
            self.channels
                .values()
                .map(|(_, maps)| u64::from(*maps))
                .sum(),
        ))
    }
}
