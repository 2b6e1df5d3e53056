//! The actors of a node, which carry out the decisions of the core crate.

pub mod broker;
pub mod dashboard;
pub mod description_keeper;
#[cfg(feature = "camera")]
pub mod detector;
pub mod follower;
pub mod fuser;
pub mod gateway;
pub mod leader_election;
pub mod membership;
pub mod pose_receiver;
#[cfg(feature = "camera")]
pub mod projector;
pub mod recorder;
pub mod reputation_keeper;
pub mod uplink;
