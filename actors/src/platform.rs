pub mod clock;
pub mod latest_slot;
pub mod state_file;
pub(crate) mod throttle;
