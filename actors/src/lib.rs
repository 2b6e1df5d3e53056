//! ECOD nodes: the actors, transports and cameras around the core of [`ecod`].
//!
//! Rooms by floor, the top first; imports run downward only:
//!
//! ```text
//! cli          the program
//! doctor, top  checks and live figures for operators
//! node         supervisor and configuration of a whole node
//! actors       one file or folder per actor
//! observe      page, metrics, health, logs, reports
//! messages     messages between actors
//! transport    MQTT, embedded broker, gossip, certificates     camera  frames, detectors, lens
//! telemetry    counters
//! platform     clock, files, throttles
//! ```

#![deny(clippy::unwrap_used, clippy::expect_used, clippy::panic)]
#![cfg_attr(not(test), deny(clippy::string_slice))]

pub mod actors;
pub mod camera;
pub mod cli;
pub mod doctor;
pub mod messages;
pub mod node;
pub mod observe;
pub mod platform;
pub mod telemetry;
pub mod top;
pub mod transport;
