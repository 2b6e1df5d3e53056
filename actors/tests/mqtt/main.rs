//! Gateways against real brokers: the embedded one, and mosquitto as the stranger.

mod broker;
mod cell;
mod junk;
mod links;
mod mosquitto;
mod status;
