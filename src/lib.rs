//! The core of ECOD: values, algorithms and state machines for vehicles that see together.
//!
//! Nothing here reads a clock, opens a socket or spawns a task: time is an argument, effects are return values, and
//! equal inputs give equal outputs. Lengths are metres, angles radians, positions east-north with counter-clockwise
//! headings; other units are converted where they enter.

#![deny(clippy::unwrap_used, clippy::expect_used, clippy::panic)]
#![cfg_attr(not(test), deny(clippy::string_slice))]

pub mod aggregator;
pub mod association;
pub mod camera;
pub mod config;
pub mod delay;
pub mod detection;
pub mod epoch;
pub mod geometry;
pub mod landmark;
pub mod leadership;
pub mod names;
pub mod pace;
pub mod pose_history;
pub mod projection;
pub mod replay;
pub mod reputation;
pub mod round;
pub mod time;
pub mod tracking;
pub mod view;
pub mod vote;
pub mod window;
pub mod wire;

pub use leadership::election;
