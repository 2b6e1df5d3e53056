//! A log file while it is written.

use std::collections::{BTreeMap, HashMap};
use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};
use std::time::Instant;

use ecod::model::time::Timestamp;
use mcap::records::{MessageHeader, Metadata};
use mcap::{Compression, McapResult, WriteOptions, Writer};

use super::channels::SchemaName;
use super::entry_encoder::{EncodedMessage, MessageSink};
use super::log_identity::LogIdentity;

/// A file being written. Messages up to the last [`LogFile::flush`] survive the end of the process.
pub(crate) struct LogFile {
    writer: Writer<BufWriter<File>>,
    path: PathBuf,
    /// True if the disk holds any message.
    has_messages: bool,
    opened: Instant,
    channels: HashMap<(SchemaName, String), WrittenChannel>,
}

struct WrittenChannel {
    id: u16,
    sequence: u32,
}

impl LogFile {
    /// Begins a file with its identity; removes the file on failure.
    pub(crate) fn begin(path: &Path, file: File, identity: &LogIdentity) -> McapResult<Self> {
        Self::create(path.into(), file, identity).inspect_err(|_| remove(path))
    }

    fn create(path: PathBuf, file: File, identity: &LogIdentity) -> McapResult<Self> {
        let options = WriteOptions::new()
            .profile("")
            .library(concat!("ecod-node ", env!("CARGO_PKG_VERSION")))
            .compression(Some(Compression::Zstd))
            .compression_level(1)
            .compression_threads(0);
        let mut writer = options.create(BufWriter::with_capacity(1 << 16, file))?;
        writer.write_metadata(&Metadata {
            name: LogIdentity::RECORD.into(),
            metadata: identity.to_map(),
        })?;
        writer.flush()?;
        Ok(Self {
            writer,
            path,
            has_messages: false,
            opened: Instant::now(),
            channels: HashMap::new(),
        })
    }

    pub(crate) fn path(&self) -> &Path {
        &self.path
    }

    pub(crate) fn opened(&self) -> Instant {
        self.opened
    }

    /// Closes the chunk and hands all bytes to the operating system; returns the size of the file.
    pub(crate) fn flush(&mut self) -> McapResult<u64> {
        self.writer.flush()?;
        self.has_messages |= !self.channels.is_empty();
        Ok(std::fs::metadata(&self.path)?.len())
    }

    /// Ends the file with its index.
    pub(crate) fn finish(mut self) -> McapResult<()> {
        self.writer.finish()?;
        self.writer.into_inner().flush()?;
        Ok(())
    }

    /// Leaves the file as it is, as when the disk is full. A file without messages is removed.
    pub(crate) fn abandon(self) {
        drop(self.writer.into_inner().into_parts());
        if !self.has_messages {
            remove(&self.path);
        }
    }
}

fn remove(path: &Path) {
    if let Err(error) = std::fs::remove_file(path) {
        tracing::debug!(file = %path.display(), %error, "cannot remove empty log");
    }
}

impl MessageSink for LogFile {
    fn put(&mut self, message: EncodedMessage<'_>) -> McapResult<()> {
        let EncodedMessage {
            schema,
            topic,
            at,
            made_at,
            json,
        } = message;
        let key = (schema, topic.to_owned());
        if !self.channels.contains_key(&key) {
            let text = schema.json_schema().to_value().to_string();
            let schema_id =
                self.writer
                    .add_schema(schema.as_str(), "jsonschema", text.as_bytes())?;
            let id = self
                .writer
                .add_channel(schema_id, topic, "json", &BTreeMap::new())?;
            self.channels
                .insert(key.clone(), WrittenChannel { id, sequence: 0 });
        }
        let Some(channel) = self.channels.get_mut(&key) else {
            return Ok(());
        };
        channel.sequence = channel.sequence.wrapping_add(1);
        let header = MessageHeader {
            channel_id: channel.id,
            sequence: channel.sequence,
            log_time: nanoseconds(at),
            publish_time: nanoseconds(made_at),
        };
        self.writer.write_to_known_channel(&header, json)
    }
}

/// Unix nanoseconds; times in the log are whole microseconds.
fn nanoseconds(at: Timestamp) -> u64 {
    at.micros().saturating_mul(1000)
}

#[cfg(test)]
mod tests {
    use ecod::model::names::NodeName;
    use uuid::Uuid;

    use super::*;
    use ecod::aggregator::FusionConfig;

    #[test]
    fn empty_file_is_removed() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("cav.mcap");
        let identity = LogIdentity::new(
            NodeName::from_static("cav"),
            Uuid::nil(),
            NodeName::from_static("lot-1"),
            FusionConfig::default(),
            Vec::new(),
        );
        let json = br#"{"at_us":0,"event":{"missing":{"entries":1}}}"#;
        let at = Timestamp(0);
        let made_at = Timestamp(0);
        let message = EncodedMessage {
            schema: SchemaName::JournalEntry,
            topic: "node/journal",
            at,
            made_at,
            json,
        };

        File::create_new(&path).unwrap();
        let refusing = File::open(&path).unwrap();
        assert!(LogFile::begin(&path, refusing, &identity).is_err());
        assert!(!path.exists(), "the disk accepted no byte");

        let mut file = LogFile::begin(&path, File::create_new(&path).unwrap(), &identity).unwrap();
        file.put(message).unwrap();
        file.abandon();
        assert!(!path.exists(), "the disk took no whole chunk");

        let mut file = LogFile::begin(&path, File::create_new(&path).unwrap(), &identity).unwrap();
        file.put(message).unwrap();
        file.flush().unwrap();
        file.abandon();
        assert!(path.exists(), "the disk took a message");
    }
}
