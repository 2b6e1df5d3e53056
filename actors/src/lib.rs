//! ECOD nodes: the actors, transports and cameras around the core of [`ecod`].

#![warn(clippy::unwrap_used)]

pub mod broker;
pub mod clock;
pub mod counters;
#[cfg(feature = "camera")]
pub mod detect;
#[cfg(feature = "camera")]
pub mod frame;
