//! ECOD nodes: the actors, transports and cameras around the core of [`ecod`].

#![warn(clippy::unwrap_used)]

pub mod broker;
#[cfg(feature = "camera")]
pub mod calibrate;
pub mod cli;
pub mod clock;
pub mod config;
#[cfg(feature = "camera")]
pub mod corner_pose;
pub mod counters;
#[cfg(feature = "camera")]
pub mod detect;
pub mod follower;
#[cfg(feature = "camera")]
pub mod frame;
pub mod fuser;
pub mod gateway;
#[cfg(feature = "camera")]
pub mod frame_source;
pub mod latest_slot;
#[cfg(feature = "camera")]
pub mod lens;
pub mod node;
pub mod seat;
