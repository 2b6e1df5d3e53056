//! Reader of log files, in the order in which they were written and in bounded memory.

use std::collections::{BTreeMap, HashMap};
use std::fs::File;
use std::io::{BufReader, Read};
use std::path::{Path, PathBuf};

use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use mcap::McapError;
use mcap::records::{Record, op};
use mcap::sans_io::{LinearReadEvent, LinearReader, LinearReaderOptions};

use crate::platform::bounded_file;

use super::channels::SchemaName;
use super::log_identity::{LogIdentity, LogIdentityError};

/// First bytes of an MCAP file.
const MAGIC: &[u8] = b"\x89MCAP0\r\n";

/// Maximum length of a record: a chunk, or a map of the largest cells.
const MAX_RECORD_BYTES: usize = 1 << 28;

/// An event of a log.
#[derive(Debug, Clone, PartialEq)]
pub enum LogEvent {
    /// Identity of the log, at its beginning.
    Identity(Box<LogIdentity>),
    /// A message, with its topic and time.
    Message(LogMessage),
}

/// One message of a log.
#[derive(Debug, Clone, PartialEq)]
pub struct LogMessage {
    /// Schema of the message's channel.
    pub schema: SchemaName,
    /// The topic without the cell's root.
    pub topic: String,
    /// Time of receipt by the recording node's clock.
    pub at: Timestamp,
    /// The message in JSON.
    pub json: Vec<u8>,
}

/// An unusable part of a log. After all errors but [`LogError::Unreadable`] the rest remains
/// usable.
#[derive(Debug, thiserror::Error)]
pub enum LogError {
    /// The file cannot be read.
    #[error("cannot read {path}")]
    Unreadable {
        /// Path of the file.
        path: PathBuf,
        /// The operating system's error.
        source: std::io::Error,
    },
    /// The file has no end, as after its writer was killed.
    #[error("{path} was not finished: it ends before its last messages")]
    Truncated {
        /// Path of the file.
        path: PathBuf,
    },
    /// The file is damaged from some position on.
    #[error("{path} is damaged: messages after the damage are ignored")]
    Damaged {
        /// Path of the file.
        path: PathBuf,
        /// Error of the reader of MCAP files.
        source: McapError,
    },
    /// A later version of the program wrote it.
    #[error("{path} has version {found} of the log, this program reads {known}", known = LogIdentity::VERSION)]
    Newer {
        /// Path of the file.
        path: PathBuf,
        /// Version of the format in the file.
        found: u64,
    },
    /// Its metadata cannot be used.
    #[error("{path}")]
    Identity {
        /// Path of the file.
        path: PathBuf,
        /// Description of the problem.
        source: LogIdentityError,
    },
}

/// Reader of one file.
pub struct LogReader {
    path: PathBuf,
    source: BufReader<File>,
    reader: LinearReader,
    schemas: HashMap<u16, String>,
    channels: HashMap<u16, ReadChannel>,
    node: Option<NodeName>,
    /// True if the data section was read to its end.
    complete: bool,
    ended: bool,
    /// Number of messages by unknown schema.
    unknown: BTreeMap<String, u64>,
}

struct ReadChannel {
    schema: Option<SchemaName>,
    schema_name: String,
    topic: String,
}

impl LogReader {
    /// True if the file is in MCAP format.
    ///
    /// # Errors
    /// Returns [`LogError::Unreadable`].
    pub fn recognises(path: &Path) -> Result<bool, LogError> {
        let mut beginning = Vec::new();
        let read = bounded_file::open(path)
            .and_then(|file| file.take(MAGIC.len() as u64).read_to_end(&mut beginning));
        read.map_err(|source| LogError::Unreadable {
            path: path.into(),
            source,
        })?;
        Ok(beginning == MAGIC)
    }

    /// Opens a file.
    ///
    /// # Errors
    /// Returns [`LogError::Unreadable`].
    pub fn open(path: &Path) -> Result<Self, LogError> {
        let file = bounded_file::open(path).map_err(|source| LogError::Unreadable {
            path: path.into(),
            source,
        })?;
        let options = LinearReaderOptions::default()
            .with_skip_end_magic(true)
            .with_prevalidate_chunk_crcs(true)
            .with_record_length_limit(MAX_RECORD_BYTES);
        Ok(Self {
            path: path.into(),
            source: BufReader::with_capacity(1 << 18, file),
            reader: LinearReader::new_with_options(options),
            schemas: HashMap::new(),
            channels: HashMap::new(),
            node: None,
            complete: false,
            ended: false,
            unknown: BTreeMap::new(),
        })
    }

    /// Recording node, once its identity was read, even if that is otherwise unusable.
    pub fn node(&self) -> Option<&NodeName> {
        self.node.as_ref()
    }

    /// Number of messages skipped by name of their unknown schema.
    pub fn unknown(&self) -> &BTreeMap<String, u64> {
        &self.unknown
    }

    /// The next event or error. Reading continues after errors other than damage.
    fn step(&mut self) -> Option<Result<LogEvent, LogError>> {
        loop {
            let event = match self.reader.next_event() {
                None => return self.end(None),
                Some(Err(error)) => return self.end(Some(error)),
                Some(Ok(event)) => event,
            };
            match event {
                LinearReadEvent::ReadRequest(wanted) => {
                    match self.source.read(self.reader.insert(wanted)) {
                        Ok(read) => self.reader.notify_read(read),
                        Err(source) => {
                            self.ended = true;
                            return Some(Err(LogError::Unreadable {
                                path: self.path.clone(),
                                source,
                            }));
                        }
                    }
                }
                LinearReadEvent::Record {
                    opcode: op::DATA_END,
                    ..
                } => self.complete = true,
                LinearReadEvent::Record { opcode, data } => {
                    match mcap::parse_record(opcode, data) {
                        Err(error) => return self.end(Some(error)),
                        Ok(record) => {
                            let record = record.into_owned();
                            if let Some(event) = self.process(record) {
                                return Some(event);
                            }
                        }
                    }
                }
            }
        }
    }

    fn process(&mut self, record: Record<'static>) -> Option<Result<LogEvent, LogError>> {
        match record {
            Record::Metadata(metadata) if metadata.name == LogIdentity::RECORD => {
                Some(self.identity(&metadata.metadata))
            }
            Record::Schema { header, .. } => {
                self.schemas.insert(header.id, header.name);
                None
            }
            Record::Channel(channel) => {
                let schema_name = self
                    .schemas
                    .get(&channel.schema_id)
                    .cloned()
                    .unwrap_or_default();
                let schema = SchemaName::from_name(&schema_name)
                    .filter(|_| channel.message_encoding == "json");
                self.channels.insert(
                    channel.id,
                    ReadChannel {
                        schema,
                        schema_name,
                        topic: channel.topic,
                    },
                );
                None
            }
            Record::Message { header, data } => {
                let channel = self.channels.get(&header.channel_id)?;
                let Some(schema) = channel.schema else {
                    *self.unknown.entry(channel.schema_name.clone()).or_default() += 1;
                    return None;
                };
                let topic = channel.topic.clone();
                let at = Timestamp(header.log_time / 1000);
                Some(Ok(LogEvent::Message(LogMessage {
                    schema,
                    topic,
                    at,
                    json: data.into_owned(),
                })))
            }
            _ => None,
        }
    }

    fn identity(&mut self, map: &BTreeMap<String, String>) -> Result<LogEvent, LogError> {
        let path = self.path.clone();
        self.node = LogIdentity::node_in(map);
        match LogIdentity::version_in(map) {
            Some(found) if found > LogIdentity::VERSION => Err(LogError::Newer { path, found }),
            _ => match LogIdentity::from_map(map) {
                Ok(identity) => Ok(LogEvent::Identity(Box::new(identity))),
                Err(source) => Err(LogError::Identity { path, source }),
            },
        }
    }

    fn end(&mut self, error: Option<McapError>) -> Option<Result<LogEvent, LogError>> {
        if std::mem::replace(&mut self.ended, true) || self.complete {
            return None;
        }
        let path = self.path.clone();
        Some(Err(match error {
            None | Some(McapError::UnexpectedEof | McapError::UnexpectedEoc) => {
                LogError::Truncated { path }
            }
            Some(source) => LogError::Damaged { path, source },
        }))
    }
}

impl Iterator for LogReader {
    type Item = Result<LogEvent, LogError>;

    fn next(&mut self) -> Option<Self::Item> {
        if self.ended { None } else { self.step() }
    }
}
