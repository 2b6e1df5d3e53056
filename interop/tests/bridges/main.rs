//! A cell's messages in the formats of others, from real nodes and back.

mod cpm;
#[cfg(feature = "dds")]
mod dds;
#[cfg(feature = "ros2")]
mod ros2;
