//! Counters of a node.

pub mod counters;
