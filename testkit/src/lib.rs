//! Fixtures that the integration tests of all crates share. Every node runs on loopback and communicates only with the
//! nodes of its test.
//!
//! [`node_config`] is a basic configuration of a node, and [`Cell`] runs nodes that can be killed like processes.
//! [`Member`] is the membership of a node alone. A test that waits uses [`until`] instead of a fixed time.

mod camera;
mod cell;
mod config;
mod errors;
mod help;
mod member;
mod people;
mod program;
mod wait;

pub use camera::car_ahead;
pub use cell::Cell;
pub use config::{free_gossip_address, greet, loopback, name, node_config};
pub use errors::{error_case, errors_of};
pub use help::help_of;
pub use member::{Member, member_config};
pub use people::walking_people;
pub use program::{all_output, command, example, output_of, stderr};
pub use wait::{PATIENCE, until, until_async, until_blocking, until_by};
