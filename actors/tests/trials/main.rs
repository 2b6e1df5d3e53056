//! Harnesses that run cells of real processes: under faults, under attack, with wrong clocks, and from empty
//! directories.
//!
//! A harness takes minutes. A target of make runs it alone, by its exact name; `make test` runs what takes seconds.

mod attacks;
mod clocks;
mod failover;
mod joining;
mod machine;
mod network;
#[path = "../security/packets.rs"]
mod packets;
mod ports;
mod process;
mod renewal;
#[path = "../security/shares.rs"]
mod shares;
