//! ECOD nodes: the actors, transports and cameras around the core of [`ecod`].

#![warn(clippy::unwrap_used)]

pub mod broker;
pub mod clock;
pub mod config;
pub mod counters;
#[cfg(feature = "camera")]
pub mod detect;
pub mod follower;
#[cfg(feature = "camera")]
pub mod frame;
pub mod fuser;
pub mod gateway;
pub mod node;
pub mod seat;
#[cfg(feature = "camera")]
pub mod testbed;
