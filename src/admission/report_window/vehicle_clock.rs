//! The estimated clock of one vehicle, and admission of the vehicle's reports by it.

use std::collections::VecDeque;

use nalgebra::Point2;

use crate::admission::live_stream::LiveStream;
use crate::admission::minimum_delay::MinimumDelay;
use crate::admission::report_window::Admitted;
use crate::model::time::Timestamp;
use crate::wire::{ObjectReport, RejectReason};

/// Clock and latest reports of one vehicle.
#[derive(Debug, Clone)]
pub(super) struct VehicleClock {
    pub(super) base: TimeBase,
    last_captured: Timestamp,
    last_seq: Option<u64>,
    /// Capture time and `seq` of the latest admitted reports, ascending, at most
    /// [`MAX_REMEMBERED`].
    recent: VecDeque<(Timestamp, u64)>,
    pub(super) last_received: Timestamp,
    delay: MinimumDelay,
    /// Capture time of the last report, if it was rejected for being too far ahead of all earlier
    /// reports.
    suspect: Option<Timestamp>,
    /// A clock that the rejected reports since the last admitted one agree on.
    pub(super) candidate: Option<LiveStream>,
    pub(super) last_heard: Timestamp,
    /// Time since which reports have been rejected because of their time only.
    pub(super) untimely_since: Option<Timestamp>,
    /// Increases while `seq` goes back and forth; a restart goes back only once.
    back_and_forth: u32,
    /// Time since which all of the vehicle's objects have been where they have no effect.
    pub(super) misplaced_since: Option<Timestamp>,
    /// Position of a vehicle that states that it does not move, and the time when it last was
    /// elsewhere.
    stood_at: Option<Point2<f64>>,
    pub(super) moved_at: Option<Timestamp>,
}

/// Time scale of a vehicle's stamps.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum TimeBase {
    Own,
    /// The cell's time before its last jump.
    CellBefore,
    Cell,
}

/// The settings in microseconds.
#[derive(Debug, Clone, Copy)]
pub(super) struct Bounds {
    pub(super) max_age: i64,
    pub(super) max_offset: i64,
    pub(super) tolerance: i64,
    pub(super) cell_offset: i64,
}

/// Value of `back_and_forth` from which two senders are assumed to use the name: about fourteen
/// reports.
const MIN_BACK_AND_FORTH: u32 = 20;

/// Distance in metres over which estimates of a standing sender's pose scatter.
const MAX_STANDING_M: f64 = 25.0;

impl Bounds {
    /// Largest delay of a clock that is accepted at once.
    fn reach(self) -> i64 {
        self.max_offset.saturating_add(self.max_age)
    }

    /// Lead over all earlier stamps above which a stamp is suspect.
    fn slack(self) -> i64 {
        self.max_age / 2
    }

    /// Microseconds from a sender's clock to the aggregator's, given its least delay. A sender
    /// within the tolerance of the cell's time is treated as synchronised.
    fn to_aggregator(self, least: i64) -> i64 {
        let is_in_cell_time =
            least.saturating_add(self.cell_offset).saturating_abs() <= self.tolerance;
        if is_in_cell_time {
            self.cell_offset.saturating_neg()
        } else {
            least
        }
    }
}

impl VehicleClock {
    pub(super) fn new(now: Timestamp) -> Self {
        Self {
            base: TimeBase::Own,
            last_captured: Timestamp(0),
            last_seq: None,
            recent: VecDeque::new(),
            last_received: now,
            delay: MinimumDelay::new(now),
            suspect: None,
            candidate: None,
            last_heard: now,
            untimely_since: None,
            misplaced_since: None,
            stood_at: None,
            moved_at: None,
            back_and_forth: 0,
        }
    }

    /// Records the position of a sender that states that it does not move.
    pub(super) fn record_standing(&mut self, report: &ObjectReport, at: Timestamp) {
        let pose = report.pose.filter(|_| report.moving == Some(false));
        let place = pose.map(|pose| Point2::new(pose.x_m, pose.y_m));
        match place.zip(self.stood_at) {
            Some((place, stood_at)) if nalgebra::distance(&place, &stood_at) <= MAX_STANDING_M => {}
            moved => (self.stood_at, self.moved_at) = (place, moved.map(|_| at)),
        }
    }

    /// True if two senders use the name: the numbers of the reports go back and forth, and their
    /// times do not.
    pub(super) fn is_shared(&self) -> bool {
        self.back_and_forth >= MIN_BACK_AND_FORTH
    }

    /// Admits a report by its stated clock error, by the estimate of its sender's clock, or because
    /// its stream is live.
    pub(super) fn admit(
        &mut self,
        report: &ObjectReport,
        received_at: Timestamp,
        bounds: Bounds,
        offset_before: Option<i64>,
    ) -> Result<Admitted, RejectReason> {
        let delay = received_at.micros_from(report.captured_at_us);
        if let Some(error) = report.clock_error_us {
            let is_age = |offset: i64| {
                (-bounds.tolerance..=bounds.max_age).contains(&delay.saturating_add(offset))
            };
            let scales = [
                (TimeBase::Cell, Some(bounds.cell_offset)),
                (TimeBase::CellBefore, offset_before),
            ];
            let scale = scales
                .into_iter()
                .filter_map(|(base, offset)| Some((base, offset?)))
                .find(|(_, offset)| is_age(*offset));
            if let Some((base, offset)) = scale.filter(|_| i64::from(error) <= bounds.tolerance) {
                return self.admit_in_cell_time(report, received_at, base, offset);
            }
            if (bounds.max_age..=bounds.reach()).contains(&delay.saturating_add(bounds.cell_offset))
            {
                return Err(RejectReason::Stale);
            }
        }
        match self.admit_by_own_clock(report, received_at, bounds) {
            Err(reason @ (RejectReason::Stale | RejectReason::FromTheFuture)) => self
                .admit_if_live(report, received_at, bounds)
                .ok_or(reason),
            admitted => admitted,
        }
    }

    /// Resets the clock estimate, because the next stamps are by another clock.
    fn start_over(&mut self, base: TimeBase, now: Timestamp) {
        *self = Self {
            base,
            last_received: self.last_received,
            ..Self::new(now)
        };
    }

    /// Admits a report whose stamp less `offset` is a time on the aggregator's clock.
    fn admit_in_cell_time(
        &mut self,
        report: &ObjectReport,
        received_at: Timestamp,
        base: TimeBase,
        offset: i64,
    ) -> Result<Admitted, RejectReason> {
        if (self.base, base) == (TimeBase::Cell, TimeBase::CellBefore) {
            return Err(RejectReason::OutOfOrder);
        }
        if self.base != base {
            self.start_over(base, received_at);
        }
        let captured_at = report.captured_at_us.shifted(offset.saturating_neg());
        if self.is_overtaken(report) {
            self.remember(report)?;
            return Ok(Admitted::OutOfOrder(captured_at));
        }
        self.delay
            .observe(received_at.micros_from(report.captured_at_us), received_at);
        self.advance(report, received_at)?;
        Ok(Admitted::InOrder(captured_at))
    }

    /// Admits a report by the estimate of its sender's clock.
    fn admit_by_own_clock(
        &mut self,
        report: &ObjectReport,
        received_at: Timestamp,
        bounds: Bounds,
    ) -> Result<Admitted, RejectReason> {
        let captured = report.captured_at_us;
        let delay = received_at.micros_from(captured);
        let in_cell = delay.saturating_add(bounds.cell_offset);
        if !self.is_known(delay, bounds)
            && !(-bounds.max_offset..=bounds.reach()).contains(&in_cell)
        {
            return Err(if in_cell < 0 {
                RejectReason::FromTheFuture
            } else {
                RejectReason::Stale
            });
        }
        let stepped_back = self.last_captured.micros_from(captured) > bounds.reach();
        if stepped_back || self.is_contradicted(captured, delay, bounds) {
            self.start_over(TimeBase::Own, received_at);
        } else if self.is_overtaken(report) {
            let to_aggregator = bounds.to_aggregator(self.delay.least());
            if delay.saturating_sub(to_aggregator) > bounds.max_age {
                return Err(RejectReason::Stale);
            }
            self.remember(report)?;
            return Ok(Admitted::OutOfOrder(captured.shifted(to_aggregator)));
        } else if self.is_suspect(captured, delay, bounds.slack()) {
            return Err(RejectReason::FromTheFuture);
        }
        self.base = TimeBase::Own;
        self.delay.observe(delay, received_at);
        let to_aggregator = bounds.to_aggregator(self.delay.least());
        if delay.saturating_sub(to_aggregator) > bounds.max_age {
            return Err(RejectReason::Stale);
        }
        self.advance(report, received_at)?;
        Ok(Admitted::InOrder(captured.shifted(to_aggregator)))
    }

    /// Admits a report that contradicts the estimate if its stream is live: the sender's clock has
    /// changed.
    fn admit_if_live(
        &mut self,
        report: &ObjectReport,
        received_at: Timestamp,
        bounds: Bounds,
    ) -> Option<Admitted> {
        let captured = report.captured_at_us;
        let least =
            LiveStream::observe(&mut self.candidate, captured, received_at, bounds.slack())?;
        self.start_over(TimeBase::Own, received_at);
        self.delay.observe(least, received_at);
        self.advance(report, received_at).ok()?;
        Some(Admitted::InOrder(
            captured.shifted(bounds.to_aggregator(least)),
        ))
    }

    /// True if a later report was admitted.
    fn is_overtaken(&self, report: &ObjectReport) -> bool {
        (report.captured_at_us, Some(report.seq)) <= (self.last_captured, self.last_seq)
    }

    /// Records the vehicle's latest report.
    fn advance(
        &mut self,
        report: &ObjectReport,
        received_at: Timestamp,
    ) -> Result<(), RejectReason> {
        self.remember(report)?;
        let goes_back = self.last_seq.is_some_and(|last| report.seq < last);
        self.back_and_forth = if goes_back {
            self.back_and_forth
                .saturating_add(4)
                .min(2 * MIN_BACK_AND_FORTH)
        } else {
            self.back_and_forth.saturating_sub(1)
        };
        self.last_captured = report.captured_at_us;
        self.last_seq = Some(report.seq);
        self.last_received = received_at;
        Ok(())
    }

    /// Stores a report. A report that is a duplicate, or older than all stored reports, is
    /// rejected.
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

    /// True if a delay fits the estimated clock.
    fn is_known(&self, delay: i64, bounds: Bounds) -> bool {
        let least = self.delay.least();
        least != i64::MAX
            && (-bounds.slack()..=bounds.max_age).contains(&delay.saturating_sub(least))
    }

    /// True if the clock estimate rests on a single report that was ahead, and this report is not.
    fn is_contradicted(&self, captured: Timestamp, delay: i64, bounds: Bounds) -> bool {
        let least = self.delay.least();
        self.delay.observed() == 1
            && captured != self.last_captured
            && least.saturating_add(bounds.cell_offset) < -bounds.tolerance
            && delay.saturating_sub(least) > bounds.slack()
    }

    /// True if the timestamp is too far ahead of all before, and the previous report does not
    /// confirm it.
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

/// Number of a vehicle's latest reports that are remembered to detect duplicates.
const MAX_REMEMBERED: usize = 32;
