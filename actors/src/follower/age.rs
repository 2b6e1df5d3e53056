//! How long rounds were under way, whatever the clocks of those who sent them say.

use std::time::Duration;

use ecod::delay::MinimumDelay;
use ecod::epoch::Epoch;
use ecod::time::Timestamp;

/// The present leadership's least delay, against which its rounds are old.
#[derive(Debug, Default)]
pub(super) struct Age {
    delay: Option<(Epoch, MinimumDelay)>,
}

impl Age {
    /// Time that a round of `epoch`, which the gate has admitted, spent in queues: a node that was stopped, or a link that
    /// was, finds the rounds of that time waiting. The first of a leadership counts as fresh, since its clock is not known.
    pub(super) fn of(&mut self, epoch: &Epoch, fused_at: Timestamp, received_at: Timestamp) -> Duration {
        let known = self.delay.take().filter(|(of, _)| of == epoch);
        let (_, delay) = self.delay.insert(known.unwrap_or_else(|| (epoch.clone(), MinimumDelay::new(received_at))));
        let delay_us = received_at.micros_from(fused_at);
        delay.observe(delay_us, received_at);
        Duration::from_micros(delay_us.saturating_sub(delay.least()).unsigned_abs())
    }
}

#[cfg(test)]
mod tests {
    use ecod::names::NodeName;

    use super::*;

    const NOON: u64 = 1_732_154_400_000_000;

    fn ms(n: u64) -> Timestamp {
        Timestamp(NOON + 1000 * n)
    }

    #[test]
    fn rounds_that_waited_are_old_whatever_the_leaders_clock_says() {
        for ahead in [0, 3_600_000] {
            let (epoch, mut age) = (Epoch::new(3, NodeName::from_static("edge")), Age::default());
            for round in 0..20 {
                let fresh = age.of(&epoch, ms(ahead + 100 * round), ms(100 * round + 2));
                assert_eq!(fresh, Duration::ZERO, "round {round}");
            }
            // Stopped for three seconds, the node finds thirty rounds.
            let waited: Vec<_> = (20..50).map(|n| age.of(&epoch, ms(ahead + 100 * n), ms(5002)).as_millis()).collect();
            assert_eq!((waited[0], waited[29]), (3000, 100));
        }
    }

    #[test]
    fn a_new_leadership_has_a_clock_of_its_own() {
        let mut age = Age::default();
        age.of(&Epoch::new(3, NodeName::from_static("edge")), ms(0), ms(1));
        let other = age.of(&Epoch::new(4, NodeName::from_static("gauss")), ms(0), ms(60_000));
        assert_eq!(other, Duration::ZERO);
    }

    #[test]
    fn a_way_that_became_longer_is_believed_in_the_end() {
        let (epoch, mut age) = (Epoch::new(3, NodeName::from_static("edge")), Age::default());
        let of = |n: u64, age: &mut Age| age.of(&epoch, ms(100 * n), ms(100 * n + if n < 10 { 1 } else { 1500 }));
        assert!((0..10).all(|n| of(n, &mut age).is_zero()));
        assert!(of(10, &mut age) > Duration::from_secs(1));
        let last = (11..250).map(|n| of(n, &mut age)).last();
        assert_eq!(last, Some(Duration::ZERO));
    }
}
