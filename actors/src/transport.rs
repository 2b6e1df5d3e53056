//! Brokers, links, datagrams, certificates and invitations.

pub mod broker;
pub mod gossip;
pub mod invitation;
pub mod mqtt;
pub mod pki;
