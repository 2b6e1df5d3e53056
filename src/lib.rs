//! The core of ECOD: values, algorithms and state machines for vehicles that see together.
//!
//! Nothing here reads a clock, opens a socket or spawns a task: time is an argument, effects are return values, and
//! equal inputs give equal outputs. Lengths are metres, angles radians, positions east-north with counter-clockwise
//! headings; other units are converted where they enter.

pub mod camera;
pub mod config;
pub mod detection;
pub mod geometry;
pub mod landmark;
pub mod names;
pub mod reputation;
pub mod time;
pub mod vote;
pub mod wire;
