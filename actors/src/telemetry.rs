//! Counters of a node, and spans of what it does.

pub mod counters;
pub mod spans;
