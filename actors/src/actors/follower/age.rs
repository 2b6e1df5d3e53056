//! How long rounds were under way, whatever the clocks of those who sent them say.

use std::time::Duration;

use ecod::delay::MinimumDelay;
use ecod::epoch::Epoch;
use ecod::time::Timestamp;

/// What a driver was to be told longer ago than this is not told any more.
const MAX_AGE: Duration = Duration::from_secs(1);

/// So what waited for longer than this is not: how long the way itself takes nobody knows, only how much longer than at
/// best.
const MAX_WAIT: Duration = Duration::from_millis(900);

/// How long the rounds of a leadership whose first came when a node had long heard none must come as slowly as they
/// were made: what waited for the node comes faster.
const LEARNING: Duration = Duration::from_millis(150);

/// Tells rounds that have just been made from those that waited.
#[derive(Debug, Default)]
pub(super) struct Age {
    /// The present leadership's least delay, against which its rounds are old.
    delay: Option<(Epoch, LeadersDelay)>,
    newest_at: Option<Timestamp>,
    /// When a round came after none had for [`MAX_AGE`].
    resumed_at: Option<Timestamp>,
}

#[derive(Debug)]
struct LeadersDelay {
    least: MinimumDelay,
    /// Whether the least is that of rounds that did not wait.
    is_learnt: bool,
    /// For how long rounds have come as slowly as they were made.
    live_for: Duration,
    /// When the last round was made and came.
    last: (Timestamp, Timestamp),
}

impl LeadersDelay {
    fn new(is_learnt: bool, fused_at: Timestamp, received_at: Timestamp) -> Self {
        let least = MinimumDelay::new(received_at);
        Self { least, is_learnt, live_for: Duration::ZERO, last: (fused_at, received_at) }
    }

    /// Takes a round and tells how long it waited, as far as is known.
    fn observe(&mut self, fused_at: Timestamp, received_at: Timestamp) -> Duration {
        let (last_fused_at, last_received_at) = std::mem::replace(&mut self.last, (fused_at, received_at));
        let (made_in, came_in) = (fused_at.since(last_fused_at), received_at.since(last_received_at));
        self.live_for = if 2 * came_in >= made_in { self.live_for + came_in } else { Duration::ZERO };
        self.is_learnt |= self.live_for >= LEARNING;
        let delay_us = received_at.micros_from(fused_at);
        self.least.observe(delay_us, received_at);
        Duration::from_micros(delay_us.saturating_sub(self.least.least()).unsigned_abs())
    }
}

impl Age {
    /// Whether a round of `epoch`, which the gate has admitted, spent no more than [`MAX_WAIT`] in queues: a node that
    /// was stopped, or a link that was, finds the rounds of that time waiting. The first round of a leadership is
    /// fresh, since its clock is not known, but after such a time.
    pub(super) fn is_fresh(&mut self, epoch: &Epoch, fused_at: Timestamp, received_at: Timestamp) -> bool {
        if self.newest_at.replace(received_at).is_some_and(|newest_at| received_at.since(newest_at) > MAX_AGE) {
            self.resumed_at = Some(received_at);
        }
        let known = self.delay.take().filter(|(of, _)| of == epoch).map(|(_, delay)| delay);
        let has_waited = self.resumed_at.is_some_and(|resumed_at| received_at.since(resumed_at) <= MAX_AGE);
        let mut delay = known.unwrap_or_else(|| LeadersDelay::new(!has_waited, fused_at, received_at));
        let waited = delay.observe(fused_at, received_at);
        let is_fresh = delay.is_learnt && waited <= MAX_WAIT;
        self.delay = Some((epoch.clone(), delay));
        is_fresh
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
                assert!(age.is_fresh(&epoch, ms(ahead + 100 * round), ms(100 * round + 2)), "round {round}");
            }
            // Stopped for three seconds, the node finds thirty rounds.
            let fresh: Vec<_> = (20..50).filter(|n| age.is_fresh(&epoch, ms(ahead + 100 * n), ms(5002))).collect();
            assert_eq!(fresh, Vec::from_iter(41..50));
        }
    }

    #[test]
    fn a_new_leadership_has_a_clock_of_its_own() {
        let mut age = Age::default();
        assert!(age.is_fresh(&Epoch::new(3, NodeName::from_static("edge")), ms(0), ms(60_000)));
        assert!(age.is_fresh(&Epoch::new(4, NodeName::from_static("gauss")), ms(0), ms(60_300)));
    }

    #[test]
    fn of_a_leadership_that_began_while_the_node_was_stopped_only_what_is_made_now_is_taken() {
        let (edge, gauss) =
            (Epoch::new(3, NodeName::from_static("edge")), Epoch::new(4, NodeName::from_static("gauss")));
        let mut age = Age::default();
        assert!(age.is_fresh(&edge, ms(0), ms(1)));
        // Stopped for eleven seconds, it hands out a round of its own, and then finds those of its successor.
        assert!(age.is_fresh(&edge, ms(11_000), ms(11_000)));
        let waiting = (5..110).filter(|n| age.is_fresh(&gauss, ms(7 + 100 * n), ms(11_001 + 3 * n))).count();
        assert_eq!(waiting, 0, "however slowly they come");
        let live: Vec<_> = (115..125).filter(|n| age.is_fresh(&gauss, ms(7 + 100 * n), ms(9 + 100 * n))).collect();
        assert_eq!(live, Vec::from_iter(117..125));
    }

    #[test]
    fn a_way_that_became_longer_is_believed_in_the_end() {
        let (epoch, mut age) = (Epoch::new(3, NodeName::from_static("edge")), Age::default());
        let is_fresh =
            |n: u64, age: &mut Age| age.is_fresh(&epoch, ms(100 * n), ms(100 * n + if n < 10 { 1 } else { 1500 }));
        assert!((0..10).all(|n| is_fresh(n, &mut age)));
        assert!(!is_fresh(10, &mut age));
        assert_eq!((11..250).map(|n| is_fresh(n, &mut age)).last(), Some(true));
    }
}
