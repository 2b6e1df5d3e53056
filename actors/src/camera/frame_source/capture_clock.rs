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

/// Delay from the stated capture to arrival up to which a stamp is plausible: a clock that is
/// further behind is wrong. Frames of this age are stale in a cell with the default
/// `fusion.window.max_age_s`.
pub(super) const MAX_DELAY: Duration = Duration::from_secs(1);

const MAX_DELAY_US: i64 = MAX_DELAY.as_micros() as i64;

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
    /// Arrival.
    Arrival,
}

impl fmt::Display for TimeSource {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Playback => "playback",
            Self::Stamp => "capture stamps",
            Self::Position => "arrival and stream positions",
            Self::Arrival => "arrival",
        })
    }
}

/// Capture time of a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct FrameTime {
    /// Time of capture by the node's clock.
    pub(super) captured_at: Timestamp,
    pub(super) source: TimeSource,
}

/// Determines the capture times of one opened live source.
///
/// The least delay from stamp to arrival over the last 10 to 20 seconds is the difference of the
/// clocks plus the shortest way of a frame; any delay above it is queueing ([`MinimumDelay`]). So
/// stamp plus least delay is an arrival without jitter.
#[derive(Debug)]
pub(super) struct CaptureClock {
    /// Configured time from capture to arrival, which replaces the stamps.
    latency: Option<Duration>,
    delay: MinimumDelay,
    last_stamp: Timestamp,
}

impl CaptureClock {
    pub(super) fn new(latency_s: Option<f64>) -> Self {
        Self {
            latency: latency_s.map(Duration::from_secs_f64),
            delay: MinimumDelay::new(Timestamp::default()),
            last_stamp: Timestamp::default(),
        }
    }

    /// The capture time of the next frame, at the latest its arrival.
    pub(super) fn time(&mut self, stamp: Option<FrameStamp>, arrived_at: Timestamp) -> FrameTime {
        let latency = self.latency.unwrap_or_default();
        let stated = match stamp {
            Some(FrameStamp::Time(at)) => at,
            Some(FrameStamp::Position(position)) => Timestamp::default() + position,
            None => {
                return FrameTime {
                    captured_at: arrived_at - latency,
                    source: TimeSource::Arrival,
                };
            }
        };
        let delay_us = arrived_at.micros_from(stated);
        let is_far_behind = delay_us.saturating_sub(self.delay.least()) > MAX_DELAY_US;
        let is_position = matches!(stamp, Some(FrameStamp::Position(_)));
        // Earlier delays do not apply to a clock that stands still, steps back, or is too slow, as
        // positions that are counted at an assumed rate.
        if stated <= self.last_stamp || (is_position && is_far_behind) {
            self.delay = MinimumDelay::new(arrived_at);
        }
        self.last_stamp = stated;
        self.delay.observe(delay_us, arrived_at);
        let least = self.delay.least();
        let is_plausible = (0..=MAX_DELAY_US).contains(&least);
        match stamp {
            Some(FrameStamp::Time(at)) if is_plausible && self.latency.is_none() => FrameTime {
                captured_at: at,
                source: TimeSource::Stamp,
            },
            _ => FrameTime {
                captured_at: stated.shifted(least) - latency,
                source: TimeSource::Position,
            },
        }
    }
}

#[cfg(test)]
mod tests;
