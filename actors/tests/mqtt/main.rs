//! Gateways against real brokers: the embedded one, and mosquitto as the stranger.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on says where")]

mod broker;
mod cell;
mod junk;
mod large;
mod links;
mod mosquitto;
mod status;
