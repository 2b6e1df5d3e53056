//! A cell in the languages of others: bridges that run beside a node, connected as any program is.
//!
//! [`cpm`] writes and reads ETSI's collective perception messages; [`bridge`] carries them between a cell and other
//! stations. `ros2` writes logs for ROS; `dds` carries messages between a cell and ROS. `docs/interoperability.md` and
//! `docs/ros2.md` have the tables of what is mapped, and of what is lost.

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
