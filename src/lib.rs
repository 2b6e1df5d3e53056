//! The core of ECOD: values, algorithms and state machines for collaborative perception by camera
//! vehicles.
//!
//! The crate reads no clock, opens no socket and spawns no task: time is an argument, effects are
//! return values, and equal inputs give equal outputs. Lengths are metres, angles radians,
//! positions east-north with counter-clockwise headings; other units are converted where they
//! enter.

#![deny(clippy::unwrap_used, clippy::expect_used, clippy::panic)]
#![cfg_attr(not(test), deny(clippy::string_slice))]

pub mod admission;
pub mod aggregator;
pub mod association;
pub mod config;
pub mod description;
pub mod diagnostics;
pub mod leadership;
pub mod logins;
pub mod model;
pub mod neighbours;
pub mod pace;
pub mod perception;
pub mod replay;
pub mod reputation;
pub mod roaming;
pub mod tracking;
pub mod vote;
pub mod wire;
