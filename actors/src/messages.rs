//! The messages between the actors of a node, and the actors' addresses. Imports no actor.

pub mod actor_slot;
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
pub mod newest;
pub mod pose_receiver;
#[cfg(feature = "camera")]
pub mod projector;
pub mod recorder;
pub mod reputation_keeper;
pub mod uplink;
