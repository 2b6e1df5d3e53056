//! Logs of a node in MCAP: written, served live to viewers, and read again.

pub(crate) mod channels;
pub(crate) mod config;
pub(crate) mod disk;
pub(crate) mod entry_encoder;
pub(crate) mod foxglove;
#[cfg(feature = "camera")]
pub(crate) mod image_recorder;
#[cfg(feature = "foxglove")]
pub(crate) mod live_server;
pub(crate) mod log_file;
pub(crate) mod log_identity;
pub(crate) mod log_sender;
pub(crate) mod reader;
pub(crate) mod viewer_schema;
pub(crate) mod writer;

pub use channels::{CounterReading, LeadershipChange, SchemaName};
pub use config::RecordConfig;
pub use disk::{EXTENSION, files, free_bytes};
#[cfg(feature = "camera")]
pub use image_recorder::ImageRecorder;
pub use log_identity::{LogIdentity, LogIdentityError};
pub use log_sender::{CapturedPicture, LogItem, LogSender};
pub use reader::{LogError, LogEvent, LogMessage, LogReader};
