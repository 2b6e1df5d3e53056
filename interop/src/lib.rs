//! Bridges that run in addition to a node and connect a cell to other systems' message formats.
//! They connect like any local program.
//!
//! [`cpm`] writes and reads ETSI's collective perception messages; [`bridge`] transfers them
//! between a cell and other stations. `ros2` writes logs for ROS; `dds` transfers messages between
//! a cell and ROS. `docs/interoperability.md` and `docs/ros2.md` contain the tables of mapped and
//! lost fields.

#![deny(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::indexing_slicing,
    clippy::panic
)]

pub mod bridge;
mod carrying;
pub mod cpm;
#[cfg(feature = "dds")]
pub mod dds;
mod object;
#[cfg(feature = "ros2")]
pub mod ros2;
