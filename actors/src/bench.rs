//! Measurements that the `bench` command and the benchmarks share.

pub mod two_hop;
