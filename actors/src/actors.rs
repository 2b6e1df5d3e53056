//! The actors of a node: each carries out what the core decides.

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
