//! Brokers, links, datagrams and certificates.

pub mod broker;
pub mod gossip;
pub mod mqtt;
pub mod pki;
