//! Admission of reports: each fresh report once, with its capture time on the aggregator's clock.
//!
//! Call [`ReportWindow::admit`] with every decoded report. An admitted report may be fused once; a
//! rejected one changes at most the estimate of the vehicle's clock. A report that was overtaken by
//! a later report of its vehicle is admitted once as [`Admitted::OutOfOrder`], for algorithms that
//! can go back in time.
//!
//! - A report that states its [clock error](ObjectReport::clock_error_us) is stamped in the cell's
//!   time, so its age can be computed directly.
//! - The clock of any other sender is estimated from its least delay. An offset beyond
//!   `max_clock_offset_s`, or a step, is accepted once the stream has been live for a second
//!   ([`LiveStream`](crate::admission::live_stream::LiveStream)).
//!
//! One wrong timestamp does not silence its vehicle. A report that is ahead of all before by more
//! than half of `max_age_s` is rejected unless the next one agrees. A first report that the second
//! one contradicts is dropped.

mod vehicle_clock;

use std::collections::BTreeMap;
use std::time::Duration;

use crate::admission::timeliness::Timeliness;
use crate::config::config_section;
use crate::model::names::NodeName;
use crate::model::time::Timestamp;
use crate::wire::{ObjectReport, RejectReason};
use vehicle_clock::{Bounds, TimeBase, VehicleClock};

config_section! {
    /// Admission of reports by age and clock.
    pub struct WindowConfig {
        /// Age in seconds beyond which a report is stale. Default 1.0. A higher value tolerates
        /// slower links; a lower value drops objects sooner.
        pub max_age_s: f64 = 1.0, in 0.01 to 3600.0;
        /// Offset in seconds from the cell's time up to which a clock is accepted at once. Default
        /// 2.0. A stream with a larger offset is rejected for a second, until it has proven to be
        /// live. Every offset is estimated and removed.
        pub max_clock_offset_s: f64 = 2.0, in 0.0 to 3600.0;
        /// Clock offset in seconds up to which a clock counts as synchronised and is not corrected.
        /// Default 0.05.
        pub clock_tolerance_s: f64 = 0.05, in 0.0 to *max_clock_offset_s;
        /// Maximum number of vehicles. Default 4096.
        pub max_vehicles: usize = 4096, in 1.0 to 1e6;
    }
}

/// A report that may be used once, with its capture time on the aggregator's clock.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Admitted {
    /// The vehicle's latest so far.
    InOrder(Timestamp),
    /// A later report of the vehicle was admitted before.
    OutOfOrder(Timestamp),
}

/// Faults of a sender whose reports are admitted.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(crate) struct SenderState {
    /// Time for which all objects of the sender have been where they have no effect.
    pub(crate) misplaced: Duration,
    /// True if another sender uses its name.
    pub(crate) is_shared: bool,
    /// True if the sender states that it does not move, and has recently moved.
    pub(crate) has_moved: bool,
}

/// The state of admission.
#[derive(Debug, Clone)]
pub struct ReportWindow {
    config: WindowConfig,
    /// The cell's time minus the aggregator's clock in microseconds, and the same offset before its
    /// last jump.
    cell_offset_us: i64,
    offset_before_us: Option<i64>,
    vehicles: BTreeMap<NodeName, VehicleClock>,
}

impl ReportWindow {
    /// An empty window on a clock that is the cell's time.
    pub fn new(config: WindowConfig) -> Self {
        Self {
            config,
            cell_offset_us: 0,
            offset_before_us: None,
            vehicles: BTreeMap::new(),
        }
    }

    pub(crate) fn configure(&mut self, config: WindowConfig) {
        self.config = config;
    }

    /// Sets the cell's time minus the aggregator's clock in microseconds. After a jump, reports
    /// stamped in the previous cell time are still accepted.
    pub fn set_cell_offset(&mut self, offset_us: i64) {
        let change = offset_us.saturating_sub(self.cell_offset_us);
        if change.saturating_abs() > seconds(self.config.max_age_s) {
            self.offset_before_us = Some(self.cell_offset_us);
            for vehicle in self.vehicles.values_mut() {
                vehicle.base = if vehicle.base == TimeBase::Cell {
                    TimeBase::CellBefore
                } else {
                    TimeBase::Own
                };
            }
        }
        self.cell_offset_us = offset_us;
    }

    /// Admits a report and returns its capture time on the aggregator's clock.
    ///
    /// # Errors
    /// Returns [`RejectReason::FromTheFuture`] (also for a timestamp that no other report agrees
    /// with), [`RejectReason::Stale`], [`RejectReason::OutOfOrder`] for certain and possible
    /// duplicates, or [`RejectReason::TooManyVehicles`].
    pub fn admit(
        &mut self,
        report: &ObjectReport,
        received_at: Timestamp,
    ) -> Result<Admitted, RejectReason> {
        let bounds = Bounds {
            max_age: seconds(self.config.max_age_s),
            max_offset: seconds(self.config.max_clock_offset_s),
            tolerance: seconds(self.config.clock_tolerance_s),
            cell_offset: self.cell_offset_us,
        };
        if !self.vehicles.contains_key(&report.node) {
            self.make_room(&report.node, received_at)?;
        }
        let known = self.vehicles.entry(report.node.clone());
        let vehicle = known.or_insert_with(|| VehicleClock::new(received_at));
        vehicle.last_heard = received_at;
        let admitted = vehicle.admit(report, received_at, bounds, self.offset_before_us);
        match admitted {
            Ok(_) => {
                vehicle.candidate = None;
                vehicle.untimely_since = None;
                vehicle.record_standing(report, received_at);
            }
            Err(RejectReason::Stale | RejectReason::FromTheFuture) => {
                vehicle.untimely_since.get_or_insert(received_at);
            }
            Err(_) => {}
        }
        admitted
    }

    /// Time for which a sender's reports have been rejected because of their time only.
    pub fn untimely_for(&self, name: &NodeName, now: Timestamp) -> Duration {
        let since = self
            .vehicles
            .get(name)
            .and_then(|vehicle| vehicle.untimely_since);
        since.map_or(Duration::ZERO, |since| now.since(since))
    }

    /// The state of a sender; without faults if there are no records of it.
    pub(crate) fn sender(&self, name: &NodeName, now: Timestamp) -> SenderState {
        let Some(vehicle) = self.vehicles.get(name) else {
            return SenderState::default();
        };
        let misplaced = vehicle
            .misplaced_since
            .map_or(Duration::ZERO, |since| now.since(since));
        let has_moved = vehicle
            .moved_at
            .is_some_and(|moved_at| now.since(moved_at) < MOVED_LATELY);
        SenderState {
            misplaced,
            is_shared: vehicle.is_shared(),
            has_moved,
        }
    }

    /// Records whether any object of a sender's report has an effect where it is.
    pub(crate) fn record_place(&mut self, name: &NodeName, is_placed: bool, at: Timestamp) {
        if let Some(vehicle) = self.vehicles.get_mut(name) {
            vehicle.misplaced_since = (!is_placed).then(|| vehicle.misplaced_since.unwrap_or(at));
        }
    }

    /// The share of recently active vehicles whose reports are admitted.
    pub fn timeliness(&self, now: Timestamp) -> Timeliness {
        // Counted by vehicle, so that one vehicle with many parts has the weight of one vehicle.
        let mut vehicles = BTreeMap::new();
        for (name, vehicle) in self
            .vehicles
            .iter()
            .filter(|(_, vehicle)| now.since(vehicle.last_heard) < UNTIMELY_TIME)
        {
            let is_untimely = vehicle
                .untimely_since
                .is_some_and(|since| now.since(since) >= UNTIMELY_TIME);
            *vehicles.entry(name.vehicle()).or_insert(false) |= !is_untimely;
        }
        let timely = vehicles.values().filter(|is_timely| **is_timely).count();
        Timeliness {
            timely,
            untimely: vehicles.len() - timely,
        }
    }

    /// Makes room for a vehicle or a part of one, if there is any.
    fn make_room(&mut self, name: &NodeName, now: Timestamp) -> Result<(), RejectReason> {
        let is_full = |vehicles: &BTreeMap<NodeName, VehicleClock>| {
            vehicles.len() >= self.config.max_vehicles || parts_beside(vehicles, name) >= MAX_PARTS
        };
        if is_full(&self.vehicles) {
            self.vehicles
                .retain(|_, vehicle| now.since(vehicle.last_received) < RETENTION);
        }
        if is_full(&self.vehicles) {
            Err(RejectReason::TooManyVehicles)
        } else {
            Ok(())
        }
    }
}

/// Number of other parts of the same vehicle, if the name belongs to a part.
fn parts_beside(vehicles: &BTreeMap<NodeName, VehicleClock>, name: &NodeName) -> usize {
    let vehicle = name.vehicle();
    if vehicle == *name {
        return 0;
    }
    // Only a name with one more mark sorts between a vehicle and its parts.
    let names = vehicles.range(vehicle.clone()..).map(|(name, _)| name);
    names
        .take_while(|name| name.as_str().starts_with(vehicle.as_str()))
        .filter(|name| name.vehicle() == vehicle)
        .count()
}

/// Maximum number of parts of a vehicle at a time, so that a vehicle that invents names takes no
/// room from others.
pub const MAX_PARTS: usize = 16;

/// Time after which a silent vehicle counts as having left: its clock is dropped when room is
/// short.
const RETENTION: Duration = Duration::from_secs(10);

/// Time for which a vehicle's reports are rejected before it counts as untimely; a clock that
/// stepped takes one second.
const UNTIMELY_TIME: Duration = Duration::from_secs(3);

/// Time after a movement for which a sender that states that it does not move counts as having
/// moved.
const MOVED_LATELY: Duration = Duration::from_secs(10);

fn seconds(s: f64) -> i64 {
    (s * 1e6) as i64
}

#[cfg(test)]
mod tests;
