//! The machine below a node: clock, files, state files, bounded slots, throttles, installed files.

pub mod bounded_file;
pub mod cell_clock;
pub mod clock;
pub mod content_hash;
#[cfg(feature = "camera")]
pub(crate) mod installed;
pub mod latest_slot;
pub(crate) mod owner;
pub mod secret;
pub mod state_file;
pub mod state_writer;
pub mod throttle;
