//! Live view of the log for Foxglove and Lichtblick.
//!
//! The protocol has no passwords, so the server listens on loopback only. A viewer that is too slow
//! loses messages.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

use foxglove::{
    ChannelBuilder, Context, FoxgloveError, PartialMetadata, RawChannel, Schema, WebSocketServer,
    WebSocketServerHandle,
};
use mcap::McapResult;

use super::channels::SchemaName;
use super::entry_encoder::{EncodedMessage, EntryEncoder, MessageSink};
use super::log_sender::LogEntry;

/// Address of the server.
const LOOPBACK: &str = "127.0.0.1";

/// Wait before a busy port is tried again.
const RETRY_AFTER: Duration = Duration::from_secs(5);

/// Server that starts with the first entry.
pub(crate) struct LiveServer {
    port: u16,
    encoder: EntryEncoder,
    state: State,
}

enum State {
    Down { retry_at: Option<Instant> },
    Up(Channels),
}

/// The running server; stops when dropped.
struct Channels {
    _server: WebSocketServerHandle,
    context: Arc<Context>,
    by_topic: HashMap<(SchemaName, String), Arc<RawChannel>>,
}

impl LiveServer {
    pub(crate) fn new(port: u16, encoder: EntryEncoder) -> Self {
        Self {
            port,
            encoder,
            state: State::Down { retry_at: None },
        }
    }

    /// Sends an entry to all viewers. A busy port is tried again.
    pub(crate) fn show(&mut self, entry: &LogEntry) {
        if let State::Down { retry_at } = self.state
            && retry_at.is_none_or(|at| Instant::now() >= at)
        {
            self.state = self.start(retry_at.is_none());
        }
        let State::Up(channels) = &mut self.state else {
            return;
        };
        if let Err(error) = self.encoder.write(entry, channels) {
            tracing::debug!(%error, "entry not sent to viewers");
        }
    }

    fn start(&self, is_first: bool) -> State {
        match Channels::start(self.port) {
            Ok(channels) => State::Up(channels),
            Err(error) => {
                if is_first {
                    let port = self.port;
                    tracing::warn!(port, %error, "cannot serve the log live; trying again every {} s", RETRY_AFTER.as_secs());
                }
                State::Down {
                    retry_at: Some(Instant::now() + RETRY_AFTER),
                }
            }
        }
    }
}

impl Channels {
    fn start(port: u16) -> Result<Self, FoxgloveError> {
        let context = Context::new();
        let server = WebSocketServer::new()
            .name("ecod-node")
            .bind(LOOPBACK, port)
            .context(&context)
            .start_blocking()?;
        tracing::info!(
            port = server.port(),
            "log is served live for Foxglove and Lichtblick"
        );
        Ok(Self {
            _server: server,
            context,
            by_topic: HashMap::new(),
        })
    }
}

impl MessageSink for Channels {
    fn put(&mut self, message: EncodedMessage<'_>) -> McapResult<()> {
        let EncodedMessage {
            schema,
            topic,
            at,
            json,
            ..
        } = message;
        let key = (schema, topic.to_owned());
        let channel = match self.by_topic.get(&key) {
            Some(channel) => channel,
            None => {
                let text = schema.json_schema().to_value().to_string();
                let schema = Schema::new(schema.as_str(), "jsonschema", text.into_bytes());
                let channel = ChannelBuilder::new(topic)
                    .context(&self.context)
                    .schema(schema)
                    .message_encoding("json")
                    .build_raw()
                    .map_err(std::io::Error::other)?;
                self.by_topic.entry(key).or_insert(channel)
            }
        };
        channel.log_with_meta(
            json,
            PartialMetadata::with_log_time(at.micros().saturating_mul(1000)),
        );
        Ok(())
    }
}
