//! Measurements that the `bench` command and the benchmarks share.

pub mod rounds;
pub mod two_hop;
