//! The machine below a node: clock, state files, bounded slots, throttles.

pub mod cell_clock;
pub mod clock;
pub mod content_hash;
pub mod latest_slot;
pub mod secret;
pub mod state_file;
pub mod state_writer;
pub(crate) mod throttle;
