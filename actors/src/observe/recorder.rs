//! Logs of a node in MCAP: written, read, drawn.

pub(crate) mod channels;
pub(crate) mod config;
pub(crate) mod disk;
pub(crate) mod foxglove;
pub(crate) mod identity;
#[cfg(feature = "foxglove")]
pub(crate) mod live;
pub(crate) mod log_file;
#[cfg(feature = "camera")]
pub(crate) mod pictures;
pub(crate) mod reader;
pub(crate) mod recording;
pub(crate) mod scribe;
pub(crate) mod viewers;
pub(crate) mod writer;
pub use channels::{CounterReading, LeadershipChange, SchemaName};
pub use config::RecordConfig;
pub use disk::{EXTENSION, files, free_bytes};
pub use identity::{Identity, IdentityError};
#[cfg(feature = "camera")]
pub use pictures::Pictures;
pub use reader::{LogError, LogEvent, LogMessage, LogReader};
pub use recording::Recording;
