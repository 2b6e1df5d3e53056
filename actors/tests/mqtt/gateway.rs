//! Gateways against real brokers: the embedded one, and mosquitto as the stranger.

mod broker;
mod cell;
mod junk;
mod large;
mod links;
mod status;
