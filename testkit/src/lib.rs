//! Fixtures that the integration tests of all crates share. Every node is on loopback and meets only the nodes of its test.
//!
//! [`node_config`] is a node's configuration to start from, and [`Cell`] runs nodes that can be killed as processes are.
//! [`Member`] is the membership of a node alone. A test that waits uses [`until`], never a guessed time.

mod camera;
mod cell;
mod config;
mod help;
mod member;
mod program;
mod wait;

pub use camera::car_ahead;
pub use cell::Cell;
pub use config::{free_gossip_address, greet, loopback, name, node_config};
pub use help::help_of;
pub use member::{Member, member_config};
pub use program::{command, output_of};
pub use wait::{PATIENCE, until, until_by};
