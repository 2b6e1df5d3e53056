//! A cell's messages in the formats of others, from real nodes and back.

mod cpm;
#[cfg(feature = "dds")]
mod dds;
#[cfg(all(feature = "dds", feature = "ros2"))]
mod errors;
#[cfg(all(feature = "dds", feature = "ros2"))]
mod help;
#[cfg(feature = "ros2")]
mod ros2;
