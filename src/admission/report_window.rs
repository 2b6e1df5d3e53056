//! Admission of reports: each fresh report once, with its capture time on the aggregator's clock.
//!
//! Call [`ReportWindow::admit`] with every decoded report. An admitted report may be fused once; a rejected one changes
//! at most the estimate of the vehicle's clock. A report that a later one of its vehicle overtook is admitted once as
//! [`Admitted::OutOfOrder`], for algorithms that can go back in time.
//!
//! One wrong timestamp does not silence its vehicle. A report that is ahead of all before by more than half of
//! `max_age_s` is rejected unless the next one agrees. A first report that the second contradicts is forgotten.

use std::collections::{BTreeMap, VecDeque};
use std::time::Duration;

use schemars::JsonSchema;

use crate::admission::minimum_delay::MinimumDelay;
use crate::config::config_section;
use crate::model::names::NodeName;
use crate::model::time::Timestamp;
use crate::wire::{ObjectReport, RejectReason};

config_section! {
    /// Admission of reports by age and clock.
    #[derive(JsonSchema)]
    pub struct WindowConfig {
        /// Age in seconds beyond which a report is stale. Default 1.0; higher bridges slower links, lower forgets sooner.
        pub max_age_s: f64 = 1.0, in 0.01 to 3600.0;
        /// Maximum offset in seconds of a vehicle's clock from the aggregator's. Default 2.0; smaller offsets are
        /// estimated and removed, reports beyond it rejected.
        pub max_clock_offset_s: f64 = 2.0, in 0.0 to 3600.0;
        /// Clock offset in seconds up to which clocks count as synchronised and nothing is removed. Default 0.05.
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
    /// A later one of the vehicle was admitted before.
    OutOfOrder(Timestamp),
}

/// The state of admission.
#[derive(Debug, Clone)]
pub struct ReportWindow {
    config: WindowConfig,
    vehicles: BTreeMap<NodeName, VehicleClock>,
}

#[derive(Debug, Clone)]
struct VehicleClock {
    last_captured: Timestamp,
    last_seq: Option<u64>,
    /// Capture time and `seq` of the latest admitted reports, ascending, at most [`MAX_REMEMBERED`].
    recent: VecDeque<(Timestamp, u64)>,
    last_received: Timestamp,
    delay: MinimumDelay,
    /// Capture time of the last report, if it was rejected for being too far ahead of all before.
    suspect: Option<Timestamp>,
}

impl ReportWindow {
    /// An empty window.
    pub fn new(config: WindowConfig) -> Self {
        Self { config, vehicles: BTreeMap::new() }
    }

    /// Admits a report and returns its capture time on the aggregator's clock.
    ///
    /// # Errors
    /// [`RejectReason::FromTheFuture`] (also for a timestamp that no other report agrees with), [`RejectReason::Stale`],
    /// [`RejectReason::OutOfOrder`] for certain and possible duplicates, or [`RejectReason::TooManyVehicles`].
    pub fn admit(&mut self, report: &ObjectReport, received_at: Timestamp) -> Result<Admitted, RejectReason> {
        let delay = received_at.micros_from(report.captured_at_us);
        let reach = seconds(self.config.max_clock_offset_s) + seconds(self.config.max_age_s);
        if delay < -seconds(self.config.max_clock_offset_s) {
            return Err(RejectReason::FromTheFuture);
        }
        if delay > reach {
            return Err(RejectReason::Stale);
        }
        if !self.vehicles.contains_key(&report.node) {
            self.make_room(received_at)?;
        }
        let vehicle = self.vehicles.entry(report.node.clone()).or_insert_with(|| VehicleClock {
            last_captured: Timestamp(0),
            last_seq: None,
            recent: VecDeque::new(),
            last_received: received_at,
            delay: MinimumDelay::new(received_at),
            suspect: None,
        });
        let tolerance = seconds(self.config.clock_tolerance_s);
        let slack = seconds(self.config.max_age_s) / 2;
        let stepped_back = vehicle.last_captured.micros_from(report.captured_at_us) > reach;
        if stepped_back || vehicle.is_contradicted(report.captured_at_us, delay, tolerance, slack) {
            vehicle.delay = MinimumDelay::new(received_at);
            vehicle.recent.clear();
        } else if (report.captured_at_us, Some(report.seq)) <= (vehicle.last_captured, vehicle.last_seq) {
            let offset = vehicle.delay.clock_offset(tolerance);
            if delay - offset > seconds(self.config.max_age_s) {
                return Err(RejectReason::Stale);
            }
            vehicle.remember(report)?;
            return Ok(Admitted::OutOfOrder(report.captured_at_us.shifted(offset)));
        } else if vehicle.is_suspect(report.captured_at_us, delay, slack) {
            return Err(RejectReason::FromTheFuture);
        }
        vehicle.delay.observe(delay, received_at);
        let offset = vehicle.delay.clock_offset(tolerance);
        if delay - offset > seconds(self.config.max_age_s) {
            return Err(RejectReason::Stale);
        }
        vehicle.remember(report)?;
        vehicle.last_captured = report.captured_at_us;
        vehicle.last_seq = Some(report.seq);
        vehicle.last_received = received_at;
        Ok(Admitted::InOrder(report.captured_at_us.shifted(offset)))
    }

    fn make_room(&mut self, now: Timestamp) -> Result<(), RejectReason> {
        if self.vehicles.len() >= self.config.max_vehicles {
            self.vehicles.retain(|_, vehicle| now.since(vehicle.last_received) < RETENTION);
        }
        if self.vehicles.len() < self.config.max_vehicles { Ok(()) } else { Err(RejectReason::TooManyVehicles) }
    }
}

impl VehicleClock {
    /// Remembers a report. It is rejected as a duplicate, also if it is older than all that are remembered.
    fn remember(&mut self, report: &ObjectReport) -> Result<(), RejectReason> {
        let entry = (report.captured_at_us, report.seq);
        let place = self.recent.partition_point(|known| *known < entry);
        let is_full = self.recent.len() >= MAX_REMEMBERED;
        if self.recent.get(place) == Some(&entry) || is_full && place == 0 {
            return Err(RejectReason::OutOfOrder);
        }
        self.recent.insert(place, entry);
        if is_full {
            self.recent.pop_front();
        }
        Ok(())
    }

    /// Whether the clock estimate rests on a single report that was ahead, and this report is not.
    fn is_contradicted(&self, captured: Timestamp, delay_us: i64, tolerance_us: i64, slack_us: i64) -> bool {
        let least = self.delay.least();
        self.delay.observed() == 1
            && captured != self.last_captured
            && least < -tolerance_us
            && delay_us.saturating_sub(least) > slack_us
    }

    /// Whether the timestamp is too far ahead of all before, and the previous report does not confirm it.
    fn is_suspect(&mut self, captured: Timestamp, delay_us: i64, slack_us: i64) -> bool {
        let before = self.suspect.take();
        let least = self.delay.least();
        let ahead = least != i64::MAX && least.saturating_sub(delay_us) > slack_us;
        let alone = before.is_none_or(|before| before == captured);
        if ahead && alone {
            self.suspect = Some(captured);
        }
        ahead && alone
    }
}

/// Time after which a silent vehicle's clock is forgotten when room is short.
const RETENTION: Duration = Duration::from_secs(10);

/// Number of a vehicle's latest reports that are remembered to detect duplicates.
const MAX_REMEMBERED: usize = 32;

fn seconds(s: f64) -> i64 {
    (s * 1e6) as i64
}

#[cfg(test)]
mod tests {
    use super::Admitted::{InOrder, OutOfOrder};
    use super::*;

    const NOON: u64 = 1_732_154_400_000_000;

    fn report(node: &str, captured_us: u64) -> ObjectReport {
        ObjectReport { objects: vec![], ..ObjectReport::new(NodeName::new(node).unwrap(), 0, Timestamp(captured_us)) }
    }

    fn window() -> ReportWindow {
        ReportWindow::new(WindowConfig::default())
    }

    #[test]
    fn takes_each_report_once_and_in_order() {
        let mut window = window();
        let now = Timestamp(NOON + 10_000);
        assert_eq!(window.admit(&report("a", NOON), now), Ok(InOrder(Timestamp(NOON))));
        assert_eq!(window.admit(&report("a", NOON), now), Err(RejectReason::OutOfOrder));
        assert_eq!(window.admit(&report("a", NOON - 1), now), Ok(OutOfOrder(Timestamp(NOON - 1))));
        assert_eq!(window.admit(&report("a", NOON - 1), now), Err(RejectReason::OutOfOrder));
        assert_eq!(window.admit(&report("b", NOON - 1), now), Ok(InOrder(Timestamp(NOON - 1))));
    }

    #[test]
    fn an_overtaken_report_is_told_from_a_duplicate_as_long_as_it_is_remembered() {
        let mut window = window();
        let now = Timestamp(NOON + 810_000);
        for n in 1..=40 {
            assert!(matches!(window.admit(&report("a", NOON + n * 20_000), now), Ok(InOrder(_))));
        }
        let admitted = |window: &mut ReportWindow, n: u64| window.admit(&report("a", NOON + n * 10_000), now);
        assert_eq!(admitted(&mut window, 79), Ok(OutOfOrder(Timestamp(NOON + 790_000))));
        assert_eq!(admitted(&mut window, 79), Err(RejectReason::OutOfOrder));
        assert_eq!(admitted(&mut window, 31), Ok(OutOfOrder(Timestamp(NOON + 310_000))));
        for n in [1, 2, 12] {
            assert_eq!(admitted(&mut window, n), Err(RejectReason::OutOfOrder), "nobody knows whether {n} came before");
        }
        assert_eq!(window.admit(&report("a", NOON), Timestamp(NOON + 1_100_000)), Err(RejectReason::Stale));
    }

    #[test]
    fn tomorrow_and_yesterday_are_rejected() {
        let mut window = window();
        let day = 86_400_000_000;
        assert_eq!(window.admit(&report("a", NOON + day), Timestamp(NOON)), Err(RejectReason::FromTheFuture));
        assert_eq!(window.admit(&report("a", NOON - day), Timestamp(NOON)), Err(RejectReason::Stale));
        assert_eq!(window.admit(&report("a", u64::MAX), Timestamp(NOON)), Err(RejectReason::FromTheFuture));
        assert_eq!(window.admit(&report("a", 0), Timestamp(NOON)), Err(RejectReason::Stale));
    }

    #[test]
    fn a_clock_one_and_a_half_seconds_ahead_is_corrected() {
        let mut window = window();
        for step in 0..20 {
            let sent = NOON + step * 100_000;
            let admitted = window.admit(&report("fast", sent + 1_500_000), Timestamp(sent + 2_000)).unwrap();
            assert_eq!(admitted, InOrder(Timestamp(sent + 2_000)), "the fastest transit counts as none");
        }
        let late = NOON + 2_000_000;
        let admitted = window.admit(&report("fast", late + 1_500_000), Timestamp(late + 302_000)).unwrap();
        assert_eq!(admitted, InOrder(Timestamp(late + 2_000)), "queueing does not move the capture time");
    }

    /// Reports every 100 ms with 2 ms of transit; the numbered one is stamped `ahead_us` ahead. Returns which of them
    /// are admitted in order.
    fn admitted_around_a_wrong_stamp(wrong: u64, ahead_us: u64) -> Vec<bool> {
        let mut window = window();
        let admit = |n: u64| {
            let stamp = NOON + n * 100_000 + if n == wrong { ahead_us } else { 0 };
            let admitted = window.admit(&report("a", stamp), Timestamp(NOON + n * 100_000 + 2_000));
            matches!(admitted, Ok(InOrder(_)))
        };
        (0..200).map(admit).collect()
    }

    #[test]
    fn one_wrong_stamp_silences_its_vehicle_for_a_second_at_most() {
        for wrong in [0, 1, 2, 50, 101] {
            for ahead_us in [100_000, 400_000, 600_000, 1_000_000, 1_900_000] {
                let admitted = admitted_around_a_wrong_stamp(wrong, ahead_us);
                let lost = admitted.iter().filter(|admitted| !**admitted).count();
                assert!(lost <= 10, "report {wrong}, {ahead_us} µs ahead: {lost} reports lost");
            }
        }
    }

    #[test]
    fn a_clock_that_was_set_forward_is_followed_and_a_duplicate_confirms_nothing() {
        let mut window = window();
        let sent = |n: u64| NOON + n * 100_000;
        for n in 0..10 {
            assert!(window.admit(&report("a", sent(n)), Timestamp(sent(n) + 2_000)).is_ok());
        }
        let first = report("a", sent(10) + 1_500_000);
        for transit_us in [2_000, 3_000] {
            let received = Timestamp(sent(10) + transit_us);
            assert_eq!(window.admit(&first, received), Err(RejectReason::FromTheFuture), "over two links");
        }
        for n in 11..20 {
            let received = Timestamp(sent(n) + 2_000);
            assert_eq!(window.admit(&report("a", sent(n) + 1_500_000), received), Ok(InOrder(received)));
        }
    }

    #[test]
    fn a_delayed_report_from_a_synchronised_vehicle_is_stale() {
        let mut window = window();
        assert!(window.admit(&report("a", NOON), Timestamp(NOON + 5_000)).is_ok());
        let held_back = window.admit(&report("a", NOON + 100_000), Timestamp(NOON + 1_200_000));
        assert_eq!(held_back, Err(RejectReason::Stale));
    }

    #[test]
    fn a_vehicle_whose_clock_was_set_back_is_heard_again() {
        let config = WindowConfig { max_clock_offset_s: 10.0, ..WindowConfig::default() };
        let mut window = ReportWindow::new(config);
        assert!(window.admit(&report("a", NOON + 9_000_000), Timestamp(NOON)).is_ok());
        assert!(window.admit(&report("a", NOON - 9_000_000), Timestamp(NOON + 100_000)).is_ok());
    }

    #[test]
    fn vehicles_are_bounded_and_silent_ones_make_room() {
        let mut window = ReportWindow::new(WindowConfig { max_vehicles: 2, ..WindowConfig::default() });
        for node in ["a", "b"] {
            assert!(window.admit(&report(node, NOON), Timestamp(NOON)).is_ok());
        }
        assert_eq!(window.admit(&report("c", NOON), Timestamp(NOON)), Err(RejectReason::TooManyVehicles));
        let later = NOON + 11_000_000;
        assert!(window.admit(&report("c", later), Timestamp(later)).is_ok());
    }
}
