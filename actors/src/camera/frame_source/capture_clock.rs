//! Capture times of frames on the node's clock.
//!
//! A frame arrives after its capture: exposure, transfer, buffers and decoding take time, and a busy
//! reader adds more. Most sources stamp their frames, by two kinds of clock ([`FrameStamp`]).
//! [`CaptureClock`] turns stamp and arrival into the capture time.

use std::fmt;
use std::time::Duration;

use ecod::admission::minimum_delay::MinimumDelay;
use ecod::model::time::Timestamp;
use serde::{Deserialize, Serialize};

/// Least delay from the stated capture to arrival, in microseconds, up to which stamps are plausible:
/// a clock that is further behind is wrong.
const MAX_DELAY_US: i64 = 1_000_000;

/// Time for which frames may arrive later than [`MAX_DELAY_US`] as a burst after a stall. If they are
/// late for longer, the clock of the source has stood still.
const MAX_BURST: Duration = Duration::from_secs(2);

/// Time that a source states for a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum FrameStamp {
    /// Time of capture, converted to the node's clock. The clock of the source may be wrong.
    Time(Timestamp),
    /// Time since an unknown instant, such as the presentation time in a stream.
    Position(Duration),
}

/// How the capture times of a source are determined.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum TimeSource {
    /// Recorded frames count as captured when they are due.
    Playback,
    /// The capture times that driver or camera state.
    Stamp,
    /// Arrival, freed from jitter by the positions in the stream.
    Position,
    /// Arrival, freed from jitter by stamps of a clock that is ahead or more than a second behind.
    WrongStamp,
    /// Arrival.
    Arrival,
}

impl fmt::Display for TimeSource {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Playback => "playback",
            Self::Stamp => "capture stamps",
            Self::Position => "arrival and stream positions",
            Self::WrongStamp => "arrival and the spacing of wrong capture stamps",
            Self::Arrival => "arrival",
        })
    }
}

/// Determines the capture times of one opened live source.
///
/// The least delay from stamp to arrival over the last 10 to 20 seconds is the difference of the
/// clocks plus the shortest way of a frame; any delay above it is queueing ([`MinimumDelay`]). So
/// stamp plus least delay is an arrival without jitter.
#[derive(Debug)]
pub(super) struct CaptureClock {
    /// Configured time from capture to arrival, which replaces the stamped one.
    latency: Option<Duration>,
    delay: MinimumDelay,
    /// The latest stamp.
    last_stamp: Option<Timestamp>,
    /// Start of the present run of frames that are later than [`MAX_DELAY_US`], by arrival.
    late_since: Option<Timestamp>,
    /// True once two frames had one stamp: the clock is too coarse to date frames.
    is_coarse: bool,
    /// The latest capture time.
    last_captured: Timestamp,
    /// How it was determined.
    source: TimeSource,
}

impl CaptureClock {
    pub(super) fn new(latency_s: Option<f64>) -> Self {
        Self {
            latency: latency_s.map(Duration::from_secs_f64),
            delay: MinimumDelay::new(Timestamp::default()),
            last_stamp: None,
            late_since: None,
            is_coarse: false,
            last_captured: Timestamp::default(),
            source: TimeSource::Arrival,
        }
    }

    /// How the capture time of the latest frame was determined.
    pub(super) fn source(&self) -> TimeSource {
        self.source
    }

    /// The capture time of the next frame, between the capture of the frame before and
    /// the arrival.
    pub(super) fn time(&mut self, stamp: Option<FrameStamp>, arrived_at: Timestamp) -> Timestamp {
        let captured_at = self.estimate(stamp, arrived_at);
        self.last_captured = captured_at.max(self.last_captured).min(arrived_at);
        self.last_captured
    }

    fn estimate(&mut self, stamp: Option<FrameStamp>, arrived_at: Timestamp) -> Timestamp {
        let latency = self.latency.unwrap_or_default();
        let stated = stamp.map(|stamp| match stamp {
            FrameStamp::Time(at) => at,
            FrameStamp::Position(position) => Timestamp::default() + position,
        });
        self.is_coarse |= stated.is_some() && stated == self.last_stamp;
        let Some(stated) = stated.filter(|_| !self.is_coarse) else {
            self.source = TimeSource::Arrival;
            return arrived_at - latency;
        };
        let delay_us = arrived_at.micros_from(stated);
        let is_time = matches!(stamp, Some(FrameStamp::Time(_))) && self.latency.is_none();
        let is_late = delay_us.saturating_sub(self.delay.least()) > MAX_DELAY_US;
        self.late_since = is_late.then(|| self.late_since.unwrap_or(arrived_at));
        let has_stood_still = self
            .late_since
            .is_some_and(|since| arrived_at.since(since) >= MAX_BURST);
        // Earlier delays do not apply to a clock that has stepped back, or stood still.
        if self.last_stamp.is_some_and(|last| stated < last)
            || has_stood_still && !(is_time && self.is_plausible())
        {
            self.delay = MinimumDelay::new(arrived_at);
            self.late_since = None;
        }
        self.last_stamp = Some(stated);
        self.delay.observe(delay_us, arrived_at);
        if is_time && self.is_plausible() {
            self.source = TimeSource::Stamp;
            stated
        } else {
            self.source = if is_time {
                TimeSource::WrongStamp
            } else {
                TimeSource::Position
            };
            stated.shifted(self.delay.least()) - latency
        }
    }

    /// True if the stamps may be times of capture by a clock that is right.
    fn is_plausible(&self) -> bool {
        (0..=MAX_DELAY_US).contains(&self.delay.least())
    }
}

#[cfg(test)]
mod tests;
