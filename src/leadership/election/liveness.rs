//! The leader's signs of life at a node that follows it, and the deadlines that they set.
//!
//! # Deadlines
//!
//! While a leader is silent, three deadlines pass in this order. Each is the earliest of several
//! conditions.
//!
//! | deadline | without rounds | with regular rounds | given up by the membership | then |
//! |---|---|---|---|---|
//! | [`Following::suspect_at`] | 2 beats | 1.5 round intervals | at once | asks about it |
//! | [`Following::direct_timeout_at`] | `silence_beats` beats | 2.5 round intervals | `given_up_timeout` | asks less often |
//! | [`Following::lost_at`] | `silence_beats` beats | 2.5 round intervals | `given_up_timeout` | loses the leader, unless other nodes received a later sign of life |
//!
//! Another node's claim to lead has the same effect as a report of the membership: this node asks
//! about the leader at once, and the leader is lost after `given_up_timeout` without a sign of
//! life.
//!
//! [`Following::silent_at`] (two beats) selects the addressees of the first question: before it,
//! the leader and its successors, because a late round may be missing at all nodes; after it, all
//! nodes. Later questions go to all nodes.
//!
//! A leader that does not receive this node's messages also counts as silent:
//! [`Following::bidirectional_at`] limits all three deadlines.

use std::time::Duration;

use crate::aggregator::round::EARLY_ROUNDS;
use crate::leadership::config::ElectionConfig;
use crate::leadership::election::Beat;
use crate::leadership::timers::{REGULAR_GAPS, missing, overdue};
use crate::model::epoch::Epoch;
use crate::model::names::NodeName;
use crate::model::time::Timestamp;

/// State of a node that follows a leader, based on its beats or on other nodes' evidence.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub(super) struct Following {
    pub(super) epoch: Epoch,
    pub(super) successors: Vec<NodeName>,
    /// Time between two beats of the leader to this node.
    pub(super) beat_interval: Duration,
    /// Time of the leader's last accepted round.
    round_at: Option<Timestamp>,
    /// Number of short gaps between the leader's first rounds, which are not representative of the
    /// interval.
    early_gaps: usize,
    /// Time between two of the leader's rounds while they arrive regularly.
    round_interval: Option<Duration>,
    /// Time at which this node last received a message of the leader.
    pub(super) direct_at: Timestamp,
    /// True if a beat of this leadership was received. Rounds and reports of other nodes may
    /// overtake messages that the leader sent before it led.
    pub(super) has_beaten: bool,
    /// Time of the leader's last message that confirmed that it receives this node.
    pub(super) bidirectional_at: Timestamp,
    /// Earliest possible time at which other nodes last received the leader.
    pub(super) indirect_heard_at: Timestamp,
    /// True if the membership gave up the leader since its last sign of life.
    pub(super) given_up: bool,
    /// Latest claim to lead by another node, with the time of the first such claim since the
    /// leader's last sign of life. This node follows the claim if the leader is lost.
    pub(super) claim: Option<Box<(Timestamp, Beat)>>,
    /// Time of the first question about the leader since its last sign of life.
    pub(super) asked_at: Option<Timestamp>,
    /// Time of the leader's last offer of the lead.
    pub(super) offered_at: Option<Timestamp>,
    /// True if this node is ready to take the lead.
    pub(super) prepared: bool,
}

impl Following {
    /// Creates the state for a leader whose message this node received at `direct_at`, or other
    /// nodes received at `indirect_heard_at`.
    pub(super) fn new(
        epoch: Epoch,
        successors: Vec<NodeName>,
        beat_interval: Duration,
        direct_at: Timestamp,
        indirect_heard_at: Timestamp,
    ) -> Self {
        Self {
            epoch,
            successors,
            beat_interval,
            round_at: None,
            early_gaps: 0,
            round_interval: None,
            direct_at,
            has_beaten: direct_at != Timestamp::default(),
            bidirectional_at: direct_at,
            indirect_heard_at,
            given_up: false,
            claim: None,
            asked_at: None,
            offered_at: None,
            prepared: false,
        }
    }

    /// Latest time at which the leader was certainly alive.
    pub(super) fn evidence_at(&self) -> Timestamp {
        self.direct_at.max(self.indirect_heard_at)
    }

    /// Records a message or round of the leader.
    pub(super) fn receive(&mut self, now: Timestamp) {
        self.direct_at = now;
        self.given_up = false;
        self.claim = None;
        self.asked_at = None;
    }

    /// Records an accepted round. The interval adapts to slower rounds at once and to faster rounds
    /// gradually.
    pub(super) fn on_round(&mut self, least: Duration, now: Timestamp) {
        if let Some(last) = self.round_at.replace(now) {
            let gap = now.since(last);
            if gap < overdue(least) && self.early_gaps < EARLY_ROUNDS {
                self.early_gaps += 1;
            } else {
                let known = self.round_interval.unwrap_or_default();
                self.round_interval = Some(gap.max(known * 7 / 8).max(least));
            }
        }
        self.receive(now);
    }

    /// Removes the round interval when rounds have stopped arriving.
    pub(super) fn drop_round_interval(&mut self, now: Timestamp) {
        self.round_interval.take_if(|gap| {
            self.round_at
                .is_none_or(|last| now.since(last) > *gap * REGULAR_GAPS)
        });
    }

    /// First deadline: the leader is suspected.
    pub(super) fn suspect_at(&self, config: &ElectionConfig) -> Timestamp {
        let late_at = self
            .informative_interval()
            .map(|gap| self.direct_at + overdue(gap));
        let claimed_at = self.claim.as_ref().map(|claim| claim.0);
        [late_at, claimed_at]
            .into_iter()
            .flatten()
            .fold(self.silent_at(config), Timestamp::min)
    }

    /// Time from which on more than one round is missing.
    pub(super) fn silent_at(&self, config: &ElectionConfig) -> Timestamp {
        if self.given_up {
            return self.direct_at;
        }
        let beats = self.beat_interval * 2;
        (self.direct_at + beats).min(self.bidirectional_at + beats.max(config.given_up_timeout()))
    }

    /// Second deadline: this node's direct connection to the leader counts as broken.
    pub(super) fn direct_timeout_at(&self, config: &ElectionConfig) -> Timestamp {
        let silence = self.beat_interval * config.silence_beats;
        let unheard_at = self.bidirectional_at + silence.max(config.response_timeout());
        let missing_at = self
            .informative_interval()
            .map(|gap| self.direct_at + missing(gap));
        let given_up_at = self
            .given_up
            .then(|| self.direct_at + config.given_up_timeout());
        let claimed_at = self
            .claim
            .as_ref()
            .map(|claim| claim.0 + config.given_up_timeout());
        let silent_at = (self.direct_at + silence).min(unheard_at);
        [missing_at, given_up_at, claimed_at]
            .into_iter()
            .flatten()
            .fold(silent_at, Timestamp::min)
    }

    /// Third deadline: the leader is lost.
    ///
    /// If other nodes received the leader well after this node did, the link is broken and the
    /// leader is alive. The same is true if they received it well after the beat that should have
    /// confirmed this node's messages. In both cases the other nodes' evidence is sufficient, and
    /// may be as old as the leader's slowest beat interval.
    pub(super) fn lost_at(&self, config: &ElectionConfig) -> Timestamp {
        let direct_timeout_at = self.direct_timeout_at(config);
        let late = self.informative_interval().map(overdue);
        let margin = late.unwrap_or(if self.given_up {
            config.beat()
        } else {
            self.beat_interval
        });
        let receives_us_until = self.bidirectional_at + self.beat_interval + margin;
        if self.indirect_heard_at > (self.direct_at + margin).min(receives_us_until) {
            direct_timeout_at.max(self.indirect_heard_at + config.response_timeout())
        } else if late.is_some() {
            // The standby, which gets more beats, gives the leader up first.
            direct_timeout_at.max(self.indirect_heard_at + config.standby_silence())
        } else {
            direct_timeout_at
        }
    }

    /// Interval between two rounds, if rounds are more informative than beats.
    fn informative_interval(&self) -> Option<Duration> {
        self.round_interval.filter(|gap| *gap < self.beat_interval)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ms(ms: u64) -> Timestamp {
        Timestamp(1_000_000_000 + ms * 1000)
    }

    #[test]
    fn silent_leader_deadlines_are_ordered() {
        let config = ElectionConfig::default();
        for beat_interval in [config.beat(), config.near_beat(), config.idle_beat()] {
            for (has_rounds, given_up) in
                [(false, false), (true, false), (false, true), (true, true)]
            {
                let epoch = Epoch::new(1, NodeName::from_static("edge"));
                let mut leader = Following::new(
                    epoch,
                    Vec::new(),
                    beat_interval,
                    ms(0),
                    Timestamp::default(),
                );
                if has_rounds {
                    (1..=20).for_each(|round| leader.on_round(config.beat(), ms(100 * round)));
                }
                leader.bidirectional_at = leader.direct_at;
                leader.given_up = given_up;
                let deadlines = [
                    leader.suspect_at(&config),
                    leader.direct_timeout_at(&config),
                    leader.lost_at(&config),
                ];
                assert!(leader.suspect_at(&config) <= leader.silent_at(&config));
                assert!(
                    deadlines.is_sorted(),
                    "{beat_interval:?} {has_rounds} {given_up}: {deadlines:?}"
                );
            }
        }
    }

    #[test]
    fn complete_last_round_frees_standby() {
        let config = ElectionConfig::default();
        let epoch = Epoch::new(1, NodeName::from_static("edge"));
        let mut leader = Following::new(
            epoch,
            Vec::new(),
            config.beat(),
            ms(0),
            Timestamp::default(),
        );
        // A beat is due with the round: 50 ms after the previous beat, and slightly late.
        leader.on_round(config.beat(), ms(53));
        leader.indirect_heard_at = ms(52);
        assert_eq!(leader.lost_at(&config), ms(53) + config.standby_silence());
        // Other nodes receive the leader after it stopped confirming this node: the path to the
        // leader is broken.
        leader.on_round(config.beat(), ms(90));
        leader.indirect_heard_at = ms(110);
        assert_eq!(leader.lost_at(&config), ms(110) + config.response_timeout());
    }
}
