//! Logs of a node in MCAP: written, read, drawn.

#[cfg(feature = "camera")]
pub(crate) mod camera_images;
pub(crate) mod channels;
pub(crate) mod config;
pub(crate) mod disk;
pub(crate) mod entry_encoder;
pub(crate) mod foxglove;
#[cfg(feature = "foxglove")]
pub(crate) mod live_server;
pub(crate) mod log_file;
pub(crate) mod log_identity;
pub(crate) mod log_sender;
pub(crate) mod reader;
pub(crate) mod viewer_schema;
pub(crate) mod writer;
#[cfg(feature = "camera")]
pub use camera_images::ImageRecorder;
pub use channels::{CounterReading, LeadershipChange, SchemaName};
pub use config::RecordConfig;
pub use disk::{EXTENSION, files, free_bytes};
pub use log_identity::{LogIdentity, LogIdentityError};
pub use log_sender::LogSender;
pub use reader::{LogError, LogEvent, LogMessage, LogReader};
