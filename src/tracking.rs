//! Tracking of objects away from landmarks: a map contains each object once, with a constant identity, although the
//! vehicles that detect it move.
//!
//! [`Tracker::observe`] adds an admitted report, and [`Tracker::close`] closes a round. A [`Tracker`] processes the
//! reports of a round in the order of capture, independently of their order of arrival. `docs/tracks.md` has the
//! equations.
//!
//! A vehicle needs no prior calibration. The tracker estimates its noise, field of view, detection rates, calibration
//! and pose bias from objects that other vehicles detect too. Maps of neighbouring cells provide identities, but do not
//! spawn or maintain tracks. The last map of another aggregator of this cell spawns tracks whose existence fades.

mod assignment;
mod attributes;
mod calibration;
mod class;
mod config;
mod coverage;
mod detection_history;
mod existence;
mod fading_mean;
mod gauge;
mod grid;
mod handles;
mod kinematics;
mod lifecycle;
mod neighbour_tracks;
mod occlusion;
mod population;
mod pose_bias;
mod registration;
mod scan;
mod sensors;
mod store;
#[cfg(test)]
mod tests;
mod track;
mod tracker;
mod trust;
mod turning;
mod twins;
mod update;

use std::collections::BTreeMap;

pub use config::{TracksConfig, TracksMode};
pub use tracker::Tracker;

use crate::model::names::NodeName;
use crate::model::time::Timestamp;
use crate::reputation::Evidence;
use crate::wire::{FusedObject, PoseCorrection};

/// Result of a round.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct TracksRound {
    /// The objects at the time of the round, the oldest first.
    pub objects: Vec<FusedObject>,
    /// Corrections of positions by vehicle.
    pub pose_corrections: BTreeMap<NodeName, PoseCorrection>,
    /// Capture time of the oldest report of the round.
    pub oldest_capture: Option<Timestamp>,
    /// Judgements of the vehicles' statements.
    pub evidence: Vec<Evidence>,
}

/// Number of identities that tracks took over from neighbouring cells.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct HandOvers {
    /// Identities taken over by new tracks.
    pub begun: u64,
    /// Identities taken over by tracks that had an identity of this cell.
    pub renamed: u64,
}

/// Number of reports and objects that were not used.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct TracksLosses {
    /// Reports that arrived later than [`TracksConfig::max_lag_s`].
    pub late: u64,
    /// New objects beyond [`TracksConfig::max_tracks`] or [`TracksConfig::max_density`].
    pub refused: u64,
}
