//! The election under every fault: all orders of events of a few nodes, and whole cells in simulated time.

mod model;
mod sim;
