//! Timing of leadership: one table of all constants and the relations between them.
//!
//! Settings of `[election]` are in [`ElectionConfig`]; `beat`, `idle_beat`, `silence_beats`,
//! `claim_step` and `handover` stand for them here. *Round* is the default round period, 100 ms. A
//! test of this file checks every relation.
//!
//! | timer | value | must be | because |
//! |---|---|---|---|
//! | `standby_silence` | `beat * silence_beats`, 200 ms | below [`ELECTED_SILENCE`] | a round of the new leader is accepted when it comes |
//! | `response_timeout` | four of these, 800 ms | above a claim, an answer and a retry | all nodes concerned have acted by then |
//! | `given_up_timeout` | two of these, 400 ms | between both above | the membership's report counts less than the leader's beats |
//! | `ask_period` | one of these, 200 ms | not above an answer's wait | lost questions are repeated in time |
//! | `answer_time` | `claim_step * 2`, 120 ms | below `ask_period` | the answer arrives before the next question |
//! | `near_beat` | `beat * 8`, 400 ms | below `response_timeout` | a second successor receives the new standby in time |
//! | `contact_timeout` | `idle_beat * 5/2`, 6.25 s | above two idle beats | one lost beat does not end the contact |
//! | `overdue`, `missing` | 3/2 and 5/2 of a round interval | in this order | suspicion comes before loss |
//! | [`ELECTED_SILENCE`] | 250 ms | above two rounds | one late round is tolerated |
//! | [`SUCCESSOR_CREDIT`] | 500 ms | twice [`ELECTED_SILENCE`] | election messages arrive within it |
//! | [`EPOCH_MEMORY`] | 3 s | above [`MAX_ROUND_AGE`] and [`SUCCESSOR_CREDIT`] | a forged epoch ends, a queued round does not return |
//! | [`LEADER_DELAY_MEMORY`] | 10 s | above [`EPOCH_MEMORY`] | alternating leaders don't make an old round look fresh |
//! | [`MAX_ROUND_AGE`] | 1 s | above [`MAX_ROUND_WAIT`] | the rest is the transit time |
//! | [`MAX_ROUND_WAIT`] | 900 ms | above [`SUCCESSOR_CREDIT`] | a failover alone does not make rounds stale |
//! | [`MAX_ADOPTED_MAP_AGE`] | 1 s | [`MAX_ROUND_AGE`] | a new leader continues from maps that other nodes may still accept |
//! | [`LIVE_STREAM_TIME`] | 150 ms | above a round | at least two rounds prove a live stream |
//! | [`FAREWELL_TIME`] | 1 s | not below [`MAX_ROUND_AGE`] | a broker forwards every round that receivers may accept |
//! | [`LINK_LINGER`] | 2 s | above [`FAREWELL_TIME`] | the last round finds a link |
//! | [`HEALTH_PERIOD`] | 250 ms | below half of [`PART_TIMEOUT`] | two checks detect a part's end |
//! | [`CHECK_TOLERANCE`] | 500 ms | above [`HEALTH_PERIOD`] | a late check on a busy machine still counts as time |
//! | [`ANSWER_STEP`] times [`ANSWER_STEPS`] | 1 s | below [`PART_TIMEOUT`] | a hung part shows before its rounds do |
//! | [`PART_TIMEOUT`] | 2 s and three rounds | above [`ECHO_TIMEOUT`] | a stalled broker is found by its missing echo |
//! | [`ANSWER_STEP`] times [`READINESS_STEPS`] | 500 ms | above [`HEALTH_PERIOD`] | a page waits for a part for up to two checks |
//! | [`ECHO_TIMEOUT`] | 800 ms | above [`MIN_UNANSWERED`] rounds | both conditions hold at about the same time |
//! | [`VEHICLE_CONNECT_TIME`] | 300 ms | above [`crate::aggregator::round::CONNECT_TIME`] | a planned handover waits for all vehicles |
//! | [`LOGIN_TIMEOUT`] | 2 s | below `stable`, a multiple of [`HEALTH_PERIOD`] | the new leader's broker is reachable before the handover |
//! | [`LEDGER_TIMEOUT`] | 1 s | above [`VEHICLE_CONNECT_TIME`], below `handover` | a lost ledger delays a handover and does not end it |
//! | [`PREPARATION_STEP`] | 50 ms | below [`VEHICLE_CONNECT_TIME`] | it delays a handover by little |
//! | [`LATE_WAKE`] | 20 ms | below `stall_ms` | messages are read before lateness stops the clock |
//! | [`DRAIN_TIME`] | 10 ms | below [`LATE_WAKE`] | the delay itself does not make a timer late |
//! | [`DEPARTED_TIME`] | 5 s | above [`REDISCOVERY_TIME`] | the end of a broker is attributed to its node after the node was given up |
//! | [`REDISCOVERY_TIME`] | 2 s | above `response_timeout` | a restart of the membership does not end a leadership |
//! | [`DISK_TIMEOUT`] | 1 s | below `handover` | a hung disk delays a handover and does not end it |
//! | [`RENEWAL_PAUSE`] | 10 s | above `response_timeout` | a follower that refuses each epoch does not wear out terms |
//! | [`TERM_WINDOW`] | 1 h | | terms rise by a bounded step in it, from any source |
//! | [`FULL_RESYNC_PAUSE`] | 5 s | below a snapshot period, 10 s | a new leader gets all evidence before its own next snapshot |
//! | [`LAST_WORD_TIME`] | 5 s | above `handover` | the last evidence of a leader counts after a handover |
//! | [`EVIDENCE_PROBATION`] | 20 s | above [`RENEWAL_PAUSE`] and two idle beats | a false claimant is followed for a shorter time |
//! | [`MAX_RESET_AHEAD`] | 24 h | | a reset from the far future would block all later resets |
//! | `LIFE_SIGN_STEP_MS` | 10 ms | below a beat | signs of life are dated closely, and signed rarely |
//! | [`CLOCK_MEMORY`] | 15 s | above two of `contact_timeout` | the stamps of idle beats and their answers are still compared |
//! | [`MIN_CLOCK_JUMP`] | 1 s | [`MAX_ROUND_AGE`] | a report's age shows whether it was stamped before or after a jump |
//! | [`MAX_CLOCK_SLEW`] | 0.5 % | above the drift of two clocks, 0.01 % | the cell's time catches up with the median |

use std::time::Duration;

use crate::leadership::config::ElectionConfig;

/// Maximum age of a round that a node accepts.
pub const MAX_ROUND_AGE: Duration = Duration::from_secs(1);

/// Maximum time that a round spent in queues, in addition to the unknown transit time of the
/// shortest path.
pub const MAX_ROUND_WAIT: Duration = Duration::from_millis(900);

/// Maximum age of the map from whose objects a new leader continues.
pub const MAX_ADOPTED_MAP_AGE: Duration = Duration::from_secs(1);

/// Time for which rounds must arrive no faster than they were made before their delay counts as the
/// delay of a live stream.
pub const LIVE_STREAM_TIME: Duration = Duration::from_millis(150);

/// Time after its last round for which the delay of a leader's rounds is remembered.
pub const LEADER_DELAY_MEMORY: Duration = Duration::from_secs(10);

/// Time for which the newest round outranks rounds of lower epochs. It bounds how long a forged
/// epoch silences a leader.
pub const EPOCH_MEMORY: Duration = Duration::from_secs(3);

/// Silence after which a later epoch is accepted from a node other than the standby.
pub const ELECTED_SILENCE: Duration = Duration::from_millis(250);

/// Time for which a later epoch is accepted while the election names another leader: the election's
/// messages may still be in transit.
pub const SUCCESSOR_CREDIT: Duration = Duration::from_millis(500);

/// Time after its last message for which a superseded leader may still publish at a broker.
pub const FAREWELL_TIME: Duration = Duration::from_secs(1);

/// Time for which a link outlives its use: vehicles that are not yet linked to the new leader's
/// broker are served by the old one's.
pub const LINK_LINGER: Duration = Duration::from_secs(2);

/// Time between two checks of the node's own parts.
pub const HEALTH_PERIOD: Duration = Duration::from_millis(250);

/// Lateness of a check that still counts as time; a longer delay means that the whole node was
/// stalled.
pub const CHECK_TOLERANCE: Duration = Duration::from_millis(500);

/// One step of the wait for a part's answer; a stop of the whole node takes up one step only.
pub const ANSWER_STEP: Duration = Duration::from_millis(100);

/// Steps for which a part's answer is waited for.
pub const ANSWER_STEPS: usize = 10;

/// Time without a round after which a fuser counts as broken; three round periods are added.
pub const PART_TIMEOUT: Duration = Duration::from_secs(2);

/// Steps for which readiness waits for a part's answer.
pub const READINESS_STEPS: usize = 5;

/// Time without an echo after which a broker counts as stalled. Six busy loops on two processors
/// delay a broker by some tens of milliseconds.
pub const ECHO_TIMEOUT: Duration = Duration::from_millis(800);

/// Number of messages without an echo, sent over [`ECHO_TIMEOUT`], after which a broker counts as
/// stalled.
pub const MIN_UNANSWERED: u32 = 6;

/// Time given to vehicles to connect to the broker of a node that is about to be handed the lead.
pub const VEHICLE_CONNECT_TIME: Duration = Duration::from_millis(300);

/// Time without a login at a broker after which a node reports it. Reconnecting takes less time,
/// even if the first packet is lost.
pub const LOGIN_TIMEOUT: Duration = Duration::from_secs(2);

/// Time for which a node that is about to be handed the lead waits for the old leader's evidence.
pub const LEDGER_TIMEOUT: Duration = Duration::from_secs(1);

/// Time between two checks of the conditions for a handover.
pub const PREPARATION_STEP: Duration = Duration::from_millis(50);

/// Lateness of a wake-up that means that the process stalled: sockets are read for [`DRAIN_TIME`]
/// first.
pub const LATE_WAKE: Duration = Duration::from_millis(20);

/// Time for which sockets are read after a late wake-up before timers run.
pub const DRAIN_TIME: Duration = Duration::from_millis(10);

/// Time after a node was given up during which the end of its broker still proves its process gone.
pub const DEPARTED_TIME: Duration = Duration::from_secs(5);

/// Time for a restarted membership to find its members again.
pub const REDISCOVERY_TIME: Duration = Duration::from_secs(2);

/// Time for which a node waits for its disk: for its term before it leads, for reputations before
/// it publishes them.
pub const DISK_TIMEOUT: Duration = Duration::from_secs(1);

/// Longest pause between two renewals of a leadership that followers refuse. The first is
/// `given_up_timeout`.
pub const RENEWAL_PAUSE: Duration = Duration::from_secs(10);

/// Time within which the highest seen term rises by
/// [`MAX_TERM_STEP`](crate::leadership::election::MAX_TERM_STEP) at most.
pub const TERM_WINDOW: Duration = Duration::from_secs(3600);

/// Minimum time between two transfers of all evidence to new leaders, in case leaders appear and
/// disappear quickly.
pub const FULL_RESYNC_PAUSE: Duration = Duration::from_secs(5);

/// Time for which the stamps of a node are compared to later ones.
pub const CLOCK_MEMORY: Duration = Duration::from_secs(15);

/// Error of the cell's time from which it jumps; a smaller one is slewed away.
pub const MIN_CLOCK_JUMP: Duration = MAX_ROUND_AGE;

/// Rate at which the leader slews the cell's time, in parts per million.
pub const MAX_CLOCK_SLEW: i64 = 5_000;

/// Time after the end of a leadership in which evidence that its leader sends is still accepted.
pub const LAST_WORD_TIME: Duration = Duration::from_secs(5);

/// Time for which a leader must be followed without interruption before other nodes pass its
/// evidence on.
pub const EVIDENCE_PROBATION: Duration = Duration::from_secs(20);

/// Maximum time by which the clock of the node that reset all evidence may be ahead of this node's.
pub const MAX_RESET_AHEAD: Duration = Duration::from_secs(24 * 3600);

/// Number of round intervals after the last round when rounds stop counting as regular.
pub(crate) const REGULAR_GAPS: u32 = 8;

/// Step in ms of the time that a leader states in its signs of life: it signs a hundred a second at
/// most.
pub(crate) const LIFE_SIGN_STEP_MS: u64 = 10;

/// Maximum number of questions about the leader that wait for its next sign of life.
pub(crate) const MAX_WAITING_QUESTIONS: usize = 64;

/// Beats of the standby for each beat of another successor.
const NEAR_BEATS: u32 = 8;

/// Time after a round at which the next one is late: its leader is suspected.
pub(crate) fn overdue(round_interval: Duration) -> Duration {
    round_interval * 3 / 2
}

/// Time after a round at which two are missing: without other signs of life its leader is lost.
pub(crate) fn missing(round_interval: Duration) -> Duration {
    round_interval * 5 / 2
}

impl ElectionConfig {
    /// Silence after which a standby gives the leader up.
    pub(crate) fn standby_silence(&self) -> Duration {
        self.beat() * self.silence_beats
    }

    /// Time for anything that those concerned do at once: an answer, a claim, a restart.
    pub(crate) fn response_timeout(&self) -> Duration {
        self.standby_silence() * 4
    }

    /// Silence after which a node that the membership gave up is lost, and wait before a refused
    /// epoch is renewed.
    pub(crate) fn given_up_timeout(&self) -> Duration {
        self.response_timeout() / 2
    }

    /// Time between two questions of a node that has no leader.
    pub(crate) fn ask_period(&self) -> Duration {
        self.response_timeout() / 4
    }

    /// Time that an answer takes at most on a working network.
    pub(crate) fn answer_time(&self) -> Duration {
        self.claim_step() * 2
    }

    /// Time for which a peer that gets idle beats may be silent and still count as reachable.
    pub(crate) fn contact_timeout(&self) -> Duration {
        self.idle_beat() * 5 / 2
    }

    /// Time between two beats to a successor other than the standby.
    pub(crate) fn near_beat(&self) -> Duration {
        (self.beat() * NEAR_BEATS).min(self.idle_beat())
    }

    /// Time between two offers of the lead; after the last round between two messages that yield
    /// it, a quarter.
    pub(crate) fn handover_retry(&self, has_yielded: bool) -> Duration {
        if has_yielded {
            self.beat() / 4
        } else {
            self.beat()
        }
    }

    /// Time after which a leader yields although it publishes no rounds.
    pub(crate) fn roundless_yield(&self) -> Duration {
        self.handover() / 3
    }

    pub(crate) fn beat(&self) -> Duration {
        Duration::from_millis(self.beat_ms)
    }

    pub(crate) fn idle_beat(&self) -> Duration {
        Duration::from_millis(self.idle_beat_ms)
    }

    pub(crate) fn claim_step(&self) -> Duration {
        Duration::from_millis(self.claim_step_ms)
    }

    pub(crate) fn stable(&self) -> Duration {
        Duration::from_millis(self.stable_ms)
    }

    pub(crate) fn handover(&self) -> Duration {
        Duration::from_millis(self.handover_ms)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::aggregator::round::{CONNECT_TIME, RoundConfig};

    /// Every line of the table above.
    #[test]
    fn timers_keep_their_relations() {
        let config = ElectionConfig::default();
        let round = Duration::from_secs_f64(RoundConfig::default().period_s);
        let stall = Duration::from_millis(config.stall_ms);
        for (smaller, larger, why) in [
            (
                config.standby_silence(),
                ELECTED_SILENCE,
                "a new leader's first round is accepted",
            ),
            (
                config.answer_time() + config.ask_period(),
                config.response_timeout(),
                "a lost answer is repeated",
            ),
            (
                config.standby_silence(),
                config.given_up_timeout(),
                "beats weigh more than the membership",
            ),
            (
                config.given_up_timeout(),
                config.response_timeout(),
                "a given up node is not waited for",
            ),
            (
                config.answer_time(),
                config.ask_period(),
                "answers come before the next question",
            ),
            (
                config.near_beat(),
                config.response_timeout(),
                "second successors receive changes in time",
            ),
            (
                config.idle_beat() * 2,
                config.contact_timeout(),
                "one lost beat is no lost contact",
            ),
            (overdue(round), missing(round), "doubt before loss"),
            (2 * round, ELECTED_SILENCE, "one late round is no silence"),
            (
                ELECTED_SILENCE,
                SUCCESSOR_CREDIT,
                "election results arrive in time",
            ),
            (SUCCESSOR_CREDIT, EPOCH_MEMORY, "forged epochs end"),
            (
                EPOCH_MEMORY,
                LEADER_DELAY_MEMORY,
                "the delay of a returning leader is still stored",
            ),
            (MAX_ROUND_AGE, EPOCH_MEMORY, "no queued round returns"),
            (MAX_ROUND_WAIT, MAX_ROUND_AGE, "the way takes the rest"),
            (
                SUCCESSOR_CREDIT,
                MAX_ROUND_WAIT,
                "a failover makes no round stale",
            ),
            (round, LIVE_STREAM_TIME, "two rounds prove a live stream"),
            (
                MAX_ROUND_AGE,
                FAREWELL_TIME + Duration::from_nanos(1),
                "brokers pass on what receivers accept",
            ),
            (FAREWELL_TIME, LINK_LINGER, "the last round finds a link"),
            (
                2 * HEALTH_PERIOD,
                PART_TIMEOUT,
                "two looks see a part's end",
            ),
            (HEALTH_PERIOD, CHECK_TOLERANCE, "a late look is still time"),
            (
                ANSWER_STEP * ANSWER_STEPS as u32,
                PART_TIMEOUT,
                "a hung part shows before its rounds do",
            ),
            (ECHO_TIMEOUT, PART_TIMEOUT, "a missing echo shows first"),
            (
                HEALTH_PERIOD,
                ANSWER_STEP * READINESS_STEPS as u32,
                "a page waits for two looks",
            ),
            (
                MIN_UNANSWERED * round,
                ECHO_TIMEOUT,
                "both conditions hold at once",
            ),
            (
                CONNECT_TIME,
                VEHICLE_CONNECT_TIME,
                "a planned handover waits for all nodes",
            ),
            (
                VEHICLE_CONNECT_TIME,
                LEDGER_TIMEOUT,
                "evidence has more time than links",
            ),
            (
                LOGIN_TIMEOUT + HEALTH_PERIOD,
                config.stable(),
                "the new leader's broker is reachable before the handover",
            ),
            (
                LEDGER_TIMEOUT,
                config.handover(),
                "a lost ledger ends no handover",
            ),
            (
                PREPARATION_STEP,
                VEHICLE_CONNECT_TIME,
                "checks delay a handover by little",
            ),
            (LATE_WAKE, stall, "messages are read before the clock stops"),
            (DRAIN_TIME, LATE_WAKE, "the delay is no late timer"),
            (
                REDISCOVERY_TIME,
                DEPARTED_TIME,
                "a broker's end is understood",
            ),
            (
                config.response_timeout(),
                REDISCOVERY_TIME,
                "a restarted membership costs no leader",
            ),
            (
                DISK_TIMEOUT,
                config.handover(),
                "a hung disk ends no handover",
            ),
            (
                config.handover(),
                LAST_WORD_TIME,
                "the last evidence counts after a handover",
            ),
            (
                RENEWAL_PAUSE + 2 * config.idle_beat(),
                EVIDENCE_PROBATION,
                "a false claimant's evidence goes no further",
            ),
            (
                config.response_timeout(),
                RENEWAL_PAUSE,
                "all nodes receive a renewal before the next",
            ),
            (
                FULL_RESYNC_PAUSE,
                Duration::from_secs(10),
                "a new leader receives evidence before the next snapshot",
            ),
        ] {
            assert!(
                smaller < larger,
                "{why}: {smaller:?} is not below {larger:?}"
            );
        }
        assert_eq!(SUCCESSOR_CREDIT, 2 * ELECTED_SILENCE);
        assert_eq!(MAX_ADOPTED_MAP_AGE, MAX_ROUND_AGE);
        assert!(
            config.stable() > config.response_timeout(),
            "a candidate's trial outlasts a restart"
        );
    }
}
