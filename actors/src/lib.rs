//! ECOD nodes: the actors, transports and cameras around the core of [`ecod`].

#![deny(clippy::unwrap_used, clippy::expect_used, clippy::panic)]
#![cfg_attr(not(test), deny(clippy::string_slice))]

pub mod broker;
#[cfg(feature = "camera")]
pub mod calibrate;
#[cfg(feature = "camera")]
pub mod camera;
pub mod cli;
pub mod clock;
pub mod config;
#[cfg(feature = "camera")]
pub mod corner_pose;
pub mod counters;
pub mod dashboard;
#[cfg(feature = "camera")]
pub mod detect;
#[cfg(feature = "camera")]
pub mod detector;
pub mod doctor;
pub mod follower;
#[cfg(feature = "camera")]
pub mod frame;
#[cfg(feature = "camera")]
pub mod frame_source;
pub mod fuser;
pub mod gateway;
#[cfg(feature = "camera")]
pub mod image_size;
#[cfg(feature = "camera")]
pub mod latest_slot;
pub mod leader_election;
#[cfg(feature = "camera")]
pub mod lens;
pub mod lines;
pub mod membership;
pub mod node;
#[cfg(feature = "camera")]
pub mod perception;
pub mod pki;
#[cfg(feature = "camera")]
pub mod projector;
pub mod readiness;
pub mod recorder;
pub mod report;
pub mod reputation_keeper;
pub mod seat;
pub mod service;
pub mod state_file;
mod throttles;
pub mod top;
pub mod vehicle_pose;
