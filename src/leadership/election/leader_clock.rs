//! The clock of the current leader, as estimated by another node from the leader's signs of life.
//!
//! Each beat states how long the leader has led. A node can therefore date a sign of life that
//! other nodes pass on: it was sent as long after a directly received beat as the two stated times
//! differ. Passing on an old sign of life as a new one has no effect, and with certificates only
//! the leader can create one.

use std::time::Duration;

use crate::leadership::election::message::LifeSign;
use crate::model::epoch::Epoch;
use crate::model::time::Timestamp;

/// Clock of a leader.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub(super) struct LeaderClock {
    epoch: Epoch,
    /// Beginning of the leadership on this node's clock.
    began_at: Timestamp,
    /// Time of the last sign of life that was dated.
    observed_at: Timestamp,
    /// The latest sign of life and its time of receipt.
    latest: LifeSign,
    latest_received_at: Timestamp,
}

/// Reciprocal of the maximum relative drift between two clocks.
const MAX_DRIFT: u32 = 1000;

/// Minimum time between two signs of life whose distance proves a live leader after its clock had
/// stopped.
const LIVE_TIME: Duration = Duration::from_millis(150);

impl LeaderClock {
    /// Creates the clock from a beat that the leader has just sent.
    pub(super) fn of_beat(epoch: Epoch, life: LifeSign, now: Timestamp) -> Self {
        let began_at = now - Duration::from_millis(life.led_ms);
        Self {
            epoch,
            began_at,
            observed_at: now,
            latest: life,
            latest_received_at: now,
        }
    }

    /// Processes a beat that the leader has just sent.
    pub(super) fn beat(&mut self, life: LifeSign, now: Timestamp) {
        self.began_at = now - Duration::from_millis(life.led_ms);
        self.observed_at = now;
        self.latest_received_at = now;
        self.latest = life;
    }

    /// True if this is the clock of the leadership `epoch`.
    pub(super) fn is_of(&self, epoch: &Epoch) -> bool {
        self.epoch == *epoch
    }

    /// Latest possible time at which the leader sent its last sign of life.
    pub(super) fn latest_at(&self) -> Timestamp {
        self.began_at + Duration::from_millis(self.latest.led_ms)
    }

    /// The latest sign of life.
    pub(super) fn latest(&self) -> &LifeSign {
        &self.latest
    }

    /// Processes a sign of life that another node passed on; returns the latest possible time at
    /// which the leader sent it.
    pub(super) fn observe(&mut self, life: LifeSign, now: Timestamp) -> Timestamp {
        let led = Duration::from_millis(life.led_ms);
        let passed_here = now.since(self.latest_received_at);
        let passed_there = Duration::from_millis(life.led_ms.saturating_sub(self.latest.led_ms));
        let is_live = passed_here >= LIVE_TIME && passed_there >= passed_here * 9 / 10;
        let drifted = self.began_at + now.since(self.observed_at) / MAX_DRIFT;
        self.began_at = if is_live {
            now - led
        } else {
            drifted.min(now - led)
        };
        self.observed_at = now;
        if life.led_ms > self.latest.led_ms {
            self.latest = life;
            self.latest_received_at = now;
        }
        self.began_at + led
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::names::NodeName;

    fn ms(ms: u64) -> Timestamp {
        Timestamp(1_000_000_000 + ms * 1000)
    }

    fn led(led_ms: u64) -> LifeSign {
        LifeSign {
            led_ms,
            signature: None,
        }
    }

    #[test]
    fn life_sign_keeps_stated_age() {
        let epoch = Epoch::new(3, NodeName::from_static("edge"));
        let mut clock = LeaderClock::of_beat(epoch, led(5000), ms(100));
        assert_eq!(
            clock.observe(led(5100), ms(210)),
            ms(200).shifted(110),
            "ten milliseconds on its way, and drift"
        );
        assert_eq!(
            clock.observe(led(5400), ms(520)),
            ms(520),
            "signs of life go on"
        );
        // The same sign of life is passed on repeatedly as a new one.
        for at in [600, 2000, 10_000] {
            assert!(clock.observe(led(5400), ms(at)) <= ms(530), "at {at} ms");
        }
        assert_eq!(clock.latest(), &led(5400));
        // It cannot have been sent after it was received.
        assert!(clock.observe(led(60_000), ms(10_001)) <= ms(10_001));
    }

    #[test]
    fn resumed_leader_is_followed_again() {
        let epoch = Epoch::new(3, NodeName::from_static("edge"));
        let mut clock = LeaderClock::of_beat(epoch, led(5000), ms(100));
        // The leader's process was suspended for two seconds, which its clock does not count.
        assert!(clock.observe(led(5050), ms(2160)) < ms(160));
        assert!(
            clock.observe(led(5100), ms(2210)) < ms(210),
            "they may have waited"
        );
        assert_eq!(clock.observe(led(5300), ms(2410)), ms(2410));
    }
}
