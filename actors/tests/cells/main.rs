//! Cells of real nodes on loopback, most of them in this process: fusion, votes, failover, roaming and membership.

#[cfg(feature = "camera")]
mod camera_cell;
mod cell;
mod description;
mod failover;
#[cfg(feature = "camera")]
mod false_alarms;
mod membership;
#[cfg(feature = "camera")]
mod moving_vehicle;
#[cfg(feature = "camera")]
mod roaming;
mod tracks;
mod votes;
