//! ECOD nodes: the actors, transports and cameras around the core of [`ecod`].

pub mod bench;
pub mod broker;
pub mod clock;
pub mod counters;
pub mod gateway;
