//! Detection of rounds that waited in a queue, independent of the sender's clock.

use std::time::Duration;

use crate::admission::live_stream::LiveStream;
use crate::admission::minimum_delay::MinimumDelay;
use crate::leadership::timers::{
    LEADER_DELAY_MEMORY, LIVE_STREAM_TIME, MAX_ROUND_AGE, MAX_ROUND_WAIT,
};
use crate::model::epoch::Epoch;
use crate::model::time::Timestamp;

/// Filter that separates fresh rounds from rounds that waited in a queue.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct StalenessFilter {
    /// Least delays of the current leader, to which the delay of its rounds is compared, and of
    /// leaders whose rounds arrived within the last [`LEADER_DELAY_MEMORY`]. A leader that leads
    /// again has the same clock, so alternating leaders don't make an old round look fresh.
    delays: Vec<(Epoch, LeadersDelay)>,
    /// Arrival of the last round; before any, the time of the start.
    newest_at: Timestamp,
    /// Arrival of the first round after a gap of [`MAX_ROUND_AGE`].
    resumed_at: Option<Timestamp>,
}

#[derive(Debug, Clone, PartialEq, Eq, Hash)]
struct LeadersDelay {
    least: MinimumDelay,
    /// Consistent delay of rounds that seem to have waited, or of a leader whose delay has not been
    /// measured: the leader's clock may have been set.
    candidate: Option<LiveStream>,
    /// True if the least delay was measured on rounds that did not wait.
    is_learnt: bool,
    /// True if the least delay is only a bound, until the rounds prove to be live.
    is_bound: bool,
    /// Time for which rounds have arrived no faster than they were made.
    live_for: Duration,
    /// Fusion and arrival of the last round.
    last: (Timestamp, Timestamp),
    /// Maximum time for which it waited.
    last_waited: Duration,
}

impl LeadersDelay {
    fn new(is_learnt: bool, fused_at: Timestamp, received_at: Timestamp) -> Self {
        let least = MinimumDelay::new(received_at);
        Self {
            least,
            candidate: None,
            is_learnt,
            is_bound: false,
            live_for: Duration::ZERO,
            last: (fused_at, received_at),
            last_waited: Duration::ZERO,
        }
    }

    /// Distance of a round's delay from the least one.
    fn distance(&self, fused_at: Timestamp, received_at: Timestamp) -> Duration {
        let delay_us = received_at.micros_from(fused_at);
        Duration::from_micros(delay_us.saturating_sub(self.least.least()).unsigned_abs())
    }

    /// Processes a round; returns how long it waited, as far as can be determined.
    fn observe(&mut self, fused_at: Timestamp, received_at: Timestamp) -> Duration {
        let (last_fused_at, last_received_at) =
            std::mem::replace(&mut self.last, (fused_at, received_at));
        let made_in = fused_at.since(last_fused_at);
        let came_in = received_at.since(last_received_at);
        self.live_for = if 2 * came_in >= made_in {
            self.live_for + came_in
        } else {
            Duration::ZERO
        };
        self.is_learnt |= self.live_for >= LIVE_STREAM_TIME;
        // A later round with an earlier stamp: the leader's clock was set back. The round was made
        // after the previous one, so it has waited no longer than the previous round plus the time
        // since.
        let longest_wait = self.last_waited + came_in;
        let delay_us = received_at.micros_from(fused_at);
        if fused_at < last_fused_at && longest_wait <= MAX_ROUND_WAIT {
            self.least = MinimumDelay::new(received_at);
            self.least.observe(
                delay_us.saturating_sub(longest_wait.as_micros() as i64),
                received_at,
            );
            self.is_bound = true;
            self.candidate = None;
        }
        self.least.observe(delay_us, received_at);
        let mut waited =
            Duration::from_micros(delay_us.saturating_sub(self.least.least()).unsigned_abs());
        if waited <= MAX_ROUND_WAIT && !self.is_bound {
            self.candidate = None;
        } else if let Some(least_us) =
            LiveStream::observe(&mut self.candidate, fused_at, received_at, TOLERANCE_US)
        {
            self.least = MinimumDelay::new(received_at);
            self.least.observe(least_us, received_at);
            self.is_bound = false;
            waited = Duration::from_micros(delay_us.saturating_sub(least_us).unsigned_abs());
        }
        self.last_waited = waited;
        waited
    }
}

/// Maximum number of leaders whose delays are stored; the leader whose rounds arrived longest ago
/// is removed first.
const MAX_LEADERS: usize = 8;

/// Change of delay within which the rounds of a leader whose clock was set agree.
const TOLERANCE_US: i64 = 250_000;

impl StalenessFilter {
    /// Creates the filter of a node that starts; rounds cannot have waited for it before that.
    pub fn new(now: Timestamp) -> Self {
        Self {
            delays: Vec::new(),
            newest_at: now,
            resumed_at: None,
        }
    }

    /// True if a round of `epoch`, whose order is right, spent at most [`MAX_ROUND_WAIT`] in
    /// queues. After a stall of the node or of a link, the rounds of that time are waiting in the
    /// queue.
    ///
    /// The first round of a leadership counts as fresh, because the delay of its clock has not been
    /// measured. After a gap without rounds, including the time since the start, a round may have
    /// waited; then the stream first has to be live for [`LIVE_STREAM_TIME`].
    pub fn is_fresh(&mut self, epoch: &Epoch, fused_at: Timestamp, received_at: Timestamp) -> bool {
        let has_resumed =
            received_at.since(std::mem::replace(&mut self.newest_at, received_at)) > MAX_ROUND_AGE;
        if has_resumed {
            self.resumed_at = Some(received_at);
        }
        // A delay that was not fully measured before a gap is not used after it: it may stem from
        // rounds that waited.
        self.delays.retain(|(of, delay)| {
            let is_recent = || received_at.since(delay.last.1) <= LEADER_DELAY_MEMORY;
            (delay.is_learnt || !has_resumed) && (of == epoch || is_recent())
        });
        let known = self
            .delays
            .iter()
            .position(|(of, _)| of.leader == epoch.leader)
            .map(|at| self.delays.remove(at))
            .filter(|(of, delay)| {
                // A clock that was set while another node led provides no information about the
                // delay.
                of == epoch || delay.distance(fused_at, received_at) <= LEADER_DELAY_MEMORY
            })
            .map(|(_, delay)| delay);
        let has_waited = self
            .resumed_at
            .is_some_and(|resumed_at| received_at.since(resumed_at) <= MAX_ROUND_AGE);
        let mut delay =
            known.unwrap_or_else(|| LeadersDelay::new(!has_waited, fused_at, received_at));
        let waited = delay.observe(fused_at, received_at);
        let is_fresh = delay.is_learnt && waited <= MAX_ROUND_WAIT;
        if self.delays.len() == MAX_LEADERS {
            self.delays.remove(0);
        }
        self.delays.push((epoch.clone(), delay));
        is_fresh
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::names::NodeName;

    const NOON: u64 = 1_732_154_400_000_000;

    fn ms(n: u64) -> Timestamp {
        Timestamp(NOON + 1000 * n)
    }

    #[test]
    fn delayed_rounds_are_old() {
        for ahead in [0, 3_600_000] {
            let epoch = Epoch::new(3, NodeName::from_static("edge"));
            let mut filter = StalenessFilter::new(ms(0));
            for round in 0..20 {
                assert!(
                    filter.is_fresh(&epoch, ms(ahead + 100 * round), ms(100 * round + 2)),
                    "round {round}"
                );
            }
            // Stopped for three seconds, the node finds thirty rounds.
            let fresh: Vec<_> = (20..50)
                .filter(|n| filter.is_fresh(&epoch, ms(ahead + 100 * n), ms(5002)))
                .collect();
            assert_eq!(fresh, Vec::from_iter(41..50));
        }
    }

    #[test]
    fn each_leadership_has_separate_clock() {
        let mut filter = StalenessFilter::new(ms(60_000));
        assert!(filter.is_fresh(
            &Epoch::new(3, NodeName::from_static("edge")),
            ms(0),
            ms(60_000)
        ));
        assert!(filter.is_fresh(
            &Epoch::new(4, NodeName::from_static("gauss")),
            ms(0),
            ms(60_300)
        ));
    }

    #[test]
    fn alternating_leaders_refresh_no_old_round() {
        let leaders = ["edge", "gauss"].map(NodeName::from_static);
        let epoch = |n: u64| Epoch::new(n / 3, leaders[(n / 3 % 2) as usize].clone());
        let mut filter = StalenessFilter::new(ms(0));
        // The lead changes after each third round.
        assert!((0..30).all(|n| filter.is_fresh(&epoch(n), ms(100 * n), ms(100 * n + 2))));
        // A slow reader gets each round later than the one before, up to 4 s late.
        let late = |n: u64| 100 * (n - 30);
        let oldest =
            (30..70).filter(|n| filter.is_fresh(&epoch(*n), ms(100 * n), ms(100 * n + late(*n))));
        assert_eq!(oldest.map(late).max(), Some(900));
    }

    #[test]
    fn returning_leader_may_change_clock() {
        let leaders = ["edge", "gauss"].map(NodeName::from_static);
        let epoch = |term: u64| Epoch::new(term, leaders[(term % 2) as usize].clone());
        let mut filter = StalenessFilter::new(ms(0));
        assert!((0..10).all(|n| filter.is_fresh(&epoch(2), ms(100 * n), ms(100 * n + 2))));
        assert!((10..20).all(|n| filter.is_fresh(&epoch(3), ms(100 * n), ms(100 * n + 2))));
        let set_back = |n: u64| ms(100 * n).shifted(-3_600_000_000);
        assert!((20..30).all(|n| filter.is_fresh(&epoch(4), set_back(n), ms(100 * n + 2))));
    }

    #[test]
    fn missed_leadership_needs_fresh_rounds() {
        let edge = Epoch::new(3, NodeName::from_static("edge"));
        let gauss = Epoch::new(4, NodeName::from_static("gauss"));
        let mut filter = StalenessFilter::new(ms(0));
        assert!(filter.is_fresh(&edge, ms(0), ms(1)));
        // After a stall of eleven seconds, the old leader emits one more round, followed by its
        // successor's rounds.
        assert!(filter.is_fresh(&edge, ms(11_000), ms(11_000)));
        let waiting = (5..110)
            .filter(|n| filter.is_fresh(&gauss, ms(7 + 100 * n), ms(11_001 + 3 * n)))
            .count();
        assert_eq!(waiting, 0, "however slowly they come");
        let live: Vec<_> = (115..125)
            .filter(|n| filter.is_fresh(&gauss, ms(7 + 100 * n), ms(9 + 100 * n)))
            .collect();
        assert_eq!(live, Vec::from_iter(117..125));
    }

    #[test]
    fn leader_with_changed_clock_is_accepted() {
        for step_ms in [5_000, -5_000, -31_536_000_000_i64] {
            let epoch = Epoch::new(3, NodeName::from_static("edge"));
            let mut filter = StalenessFilter::new(ms(0));
            let refused = (0..100).filter(|n| {
                let fused_at = ms(100 * n).shifted(if *n < 50 { 0 } else { 1000 * step_ms });
                !filter.is_fresh(&epoch, fused_at, ms(100 * n + 1))
            });
            assert_eq!(refused.count(), 0, "{step_ms} ms");
        }
    }

    #[test]
    fn backward_clock_hides_no_delay() {
        let epoch = Epoch::new(3, NodeName::from_static("edge"));
        let mut filter = StalenessFilter::new(ms(0));
        let made = |n: u64| ms(100 * n).shifted(if n < 30 { 0 } else { -5_000_000 });
        assert!((0..20).all(|n| filter.is_fresh(&epoch, made(n), ms(100 * n + 2))));
        // Stopped for three seconds, the node finds thirty rounds; the clock was set in the midst
        // of them.
        let fresh: Vec<_> = (20..50)
            .filter(|n| filter.is_fresh(&epoch, made(*n), ms(5002)))
            .collect();
        assert!(fresh.iter().all(|n| *n > 40), "{fresh:?}");
    }

    #[test]
    fn stop_at_start_needs_fresh_rounds() {
        let epoch = Epoch::new(3, NodeName::from_static("edge"));
        let mut filter = StalenessFilter::new(ms(0));
        assert!((1..30).all(|n| !filter.is_fresh(&epoch, ms(100 * n), ms(3000))));
        let live: Vec<_> = (30..40)
            .filter(|n| filter.is_fresh(&epoch, ms(100 * n), ms(100 * n + 2)))
            .collect();
        assert_eq!(live, Vec::from_iter(32..40));
    }

    #[test]
    fn longer_path_is_accepted_eventually() {
        let epoch = Epoch::new(3, NodeName::from_static("edge"));
        let mut filter = StalenessFilter::new(ms(0));
        let is_fresh = |n: u64, filter: &mut StalenessFilter| {
            filter.is_fresh(
                &epoch,
                ms(100 * n),
                ms(100 * n + if n < 10 { 1 } else { 1500 }),
            )
        };
        assert!((0..10).all(|n| is_fresh(n, &mut filter)));
        assert!(!is_fresh(10, &mut filter));
        assert_eq!(
            (11..250).map(|n| is_fresh(n, &mut filter)).last(),
            Some(true)
        );
    }

    #[test]
    fn backward_clock_refreshes_no_old_rounds() {
        let epoch = Epoch::new(3, NodeName::from_static("edge"));
        let mut filter = StalenessFilter::new(ms(0));
        let mut is_fresh = |made_ms: u64, set_back_s: i64, waited_ms| {
            filter.is_fresh(
                &epoch,
                ms(made_ms).shifted(-1_000_000 * set_back_s),
                ms(made_ms + waited_ms),
            )
        };
        assert!((0..20).all(|n| is_fresh(100 * n, 0, 2)));
        assert!(is_fresh(2000, 0, 800) && is_fresh(2100, 5, 790), "in time");
        assert!(
            !is_fresh(2200, 5, 1600),
            "too late, though it waited for only 810 ms more than the first by this clock"
        );
    }

    #[test]
    fn rounds_continue_after_silent_clock_change() {
        let epoch = Epoch::new(3, NodeName::from_static("edge"));
        let mut filter = StalenessFilter::new(ms(0));
        let mut is_fresh = |made_ms: u64, set_back_s: i64, waited_ms| {
            filter.is_fresh(
                &epoch,
                ms(made_ms).shifted(-1_000_000 * set_back_s),
                ms(made_ms + waited_ms),
            )
        };
        assert!((0..20).all(|n| is_fresh(100 * n, 0, 2)));
        // The waiting time of the first rounds cannot be determined. Once the stream is live,
        // rounds may be late again.
        assert!((27..40).all(|n| is_fresh(100 * n, 5, 2)));
        assert!((40..60).all(|n| is_fresh(100 * n, 5, 2 + 600 * (n % 2))));
    }

    #[test]
    fn short_run_between_stops_keeps_delay() {
        let old = NodeName::from_static("euclid");
        let new = NodeName::from_static("edge");
        let old = Epoch::new(1, old);
        let new = Epoch::new(2, new);
        let mut filter = StalenessFilter::new(ms(0));
        assert!((0..20).all(|round| filter.is_fresh(&old, ms(100 * round), ms(100 * round + 2))));
        // Stopped until 5 s, for a moment, and until 6.1 s: of the moment, the older rounds alone
        // passed other checks.
        assert!((20..41).all(|round| !filter.is_fresh(&new, ms(100 * round), ms(5000))));
        assert!(
            !filter.is_fresh(&new, ms(5060), ms(6100)),
            "a round of 1.04 s ago"
        );
    }
}
