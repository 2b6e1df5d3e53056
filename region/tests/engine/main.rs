//! A region on real brokers: NATS by the configuration and the scripts of deploy/region, and mosquitto.

mod broker;
mod cell;
mod cluster;
mod errors;
mod help;
mod many;
mod page;
mod rights;
mod timeliness;
