//! The leader's signs of life at a node that follows it, and the deadlines that they set.
//!
//! # Deadlines
//!
//! While a leader is silent, three points in time pass in this order. Each is the earliest of several signs.
//!
//! | deadline | without rounds | with regular rounds | given up by the membership | then |
//! |---|---|---|---|---|
//! | [`Following::suspect_at`] | 2 beats | 1.5 round intervals | at once | asks about it |
//! | [`Following::direct_timeout_at`] | `silence_beats` beats | 2.5 round intervals | `given_up_timeout` | asks less often |
//! | [`Following::lost_at`] | the same | the same | the same | loses the leader, unless others heard it later |
//!
//! A claim to lead by another node counts like the membership's word: the leader is asked about at once, and lost after
//! `given_up_timeout` without a sign of life.
//!
//! [`Following::silent_at`], two beats, says whom the first question goes to: before it to the leader and its successors,
//! as one late round may be missing at all nodes; after it to all. Later questions go to all.
//!
//! A leader that no longer hears this node counts as silent, too: [`Following::bidirectional_at`] bounds all of them.

use std::time::Duration;

use crate::aggregator::round::EARLY_ROUNDS;
use crate::leadership::config::ElectionConfig;
use crate::leadership::election::Beat;
use crate::leadership::timers::{REGULAR_GAPS, missing, overdue};
use crate::model::epoch::Epoch;
use crate::model::names::NodeName;
use crate::model::time::Timestamp;

/// A node that follows a leader, by its beats or by others' evidence.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub(super) struct Following {
    pub(super) epoch: Epoch,
    pub(super) successors: Vec<NodeName>,
    /// Time between two beats of the leader to this node.
    pub(super) beat_interval: Duration,
    /// Time of its last accepted round.
    round_at: Option<Timestamp>,
    /// Number of short gaps between its first rounds; they say nothing about the interval.
    early_gaps: usize,
    /// Time between two of its rounds, as long as they come.
    round_interval: Option<Duration>,
    /// Time at which this node heard the leader.
    pub(super) direct_at: Timestamp,
    /// True if a beat of this leadership was heard. Rounds, and the word of other nodes, may overtake messages that the
    /// leader sent before it led.
    pub(super) has_beaten: bool,
    /// Time at which the leader said that it hears this node.
    pub(super) bidirectional_at: Timestamp,
    /// Time at which others heard the leader, at least.
    pub(super) indirect_heard_at: Timestamp,
    /// True if the membership gave the leader up since it was last heard.
    pub(super) given_up: bool,
    /// Latest claim to lead by another node, with the time of the first one since the leader was last heard. It is followed
    /// if the leader is lost.
    pub(super) claim: Option<Box<(Timestamp, Beat)>>,
    /// Time of the first question about it since it was last heard.
    pub(super) asked_at: Option<Timestamp>,
    /// Time of the leader's last offer of the lead.
    pub(super) offered_at: Option<Timestamp>,
    /// True if this node is ready to take the lead.
    pub(super) prepared: bool,
}

impl Following {
    /// A leader that was heard `direct_at`, or of which others said so at `indirect_heard_at`.
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

    /// Time at which the leader was last alive for certain.
    pub(super) fn evidence_at(&self) -> Timestamp {
        self.direct_at.max(self.indirect_heard_at)
    }

    /// Notes that the leader, or a round of it, was heard.
    pub(super) fn hear(&mut self, now: Timestamp) {
        self.direct_at = now;
        self.given_up = false;
        self.claim = None;
        self.asked_at = None;
    }

    /// Notes an accepted round. The interval follows slower rounds at once and faster ones in time.
    pub(super) fn take_round(&mut self, least: Duration, now: Timestamp) {
        if let Some(last) = self.round_at.replace(now) {
            let gap = now.since(last);
            if gap < overdue(least) && self.early_gaps < EARLY_ROUNDS {
                self.early_gaps += 1;
            } else {
                let known = self.round_interval.unwrap_or_default();
                self.round_interval = Some(gap.max(known * 7 / 8).max(least));
            }
        }
        self.hear(now);
    }

    /// Forgets the interval of rounds that no longer come.
    pub(super) fn forget_round_interval(&mut self, now: Timestamp) {
        self.round_interval.take_if(|gap| {
            self.round_at
                .is_none_or(|last| now.since(last) > *gap * REGULAR_GAPS)
        });
    }

    /// First deadline: the leader is doubted.
    pub(super) fn suspect_at(&self, config: &ElectionConfig) -> Timestamp {
        let late_at = self
            .telling_interval()
            .map(|gap| self.direct_at + overdue(gap));
        let claimed_at = self.claim.as_ref().map(|claim| claim.0);
        [late_at, claimed_at]
            .into_iter()
            .flatten()
            .fold(self.silent_at(config), Timestamp::min)
    }

    /// Time from when on more than a round is missing.
    pub(super) fn silent_at(&self, config: &ElectionConfig) -> Timestamp {
        if self.given_up {
            return self.direct_at;
        }
        let beats = self.beat_interval * 2;
        (self.direct_at + beats).min(self.bidirectional_at + beats.max(config.given_up_timeout()))
    }

    /// Second deadline: this node's own hearing no longer counts.
    pub(super) fn direct_timeout_at(&self, config: &ElectionConfig) -> Timestamp {
        let silence = self.beat_interval * config.silence_beats;
        let unheard_at = self.bidirectional_at + silence.max(config.response_timeout());
        let missing_at = self
            .telling_interval()
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
    /// Others that heard the leader well after this node prove the link broken, not the leader. The same holds if they heard
    /// it well after the beat that should have said that it hears this node. Then their evidence is enough, and may be as
    /// old as the leader's slowest beat makes it.
    pub(super) fn lost_at(&self, config: &ElectionConfig) -> Timestamp {
        let direct_timeout_at = self.direct_timeout_at(config);
        let late = self.telling_interval().map(overdue);
        let margin = late.unwrap_or(if self.given_up {
            config.beat()
        } else {
            self.beat_interval
        });
        let hears_us_until = self.bidirectional_at + self.beat_interval + margin;
        if self.indirect_heard_at > (self.direct_at + margin).min(hears_us_until) {
            direct_timeout_at.max(self.indirect_heard_at + config.response_timeout())
        } else if late.is_some() {
            // The standby, which hears more, gives the leader up first.
            direct_timeout_at.max(self.indirect_heard_at + config.standby_silence())
        } else {
            direct_timeout_at
        }
    }

    /// Time between two rounds, where they tell more than beats do.
    fn telling_interval(&self) -> Option<Duration> {
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
    fn the_deadlines_of_a_silent_leader_pass_in_their_order() {
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
                    (1..=20).for_each(|round| leader.take_round(config.beat(), ms(100 * round)));
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
    fn a_last_round_that_all_heard_keeps_a_standby_no_longer() {
        let config = ElectionConfig::default();
        let epoch = Epoch::new(1, NodeName::from_static("edge"));
        let mut leader = Following::new(
            epoch,
            Vec::new(),
            config.beat(),
            ms(0),
            Timestamp::default(),
        );
        // A beat is due with the round: 50 ms after the last one, and a little late.
        leader.take_round(config.beat(), ms(53));
        leader.indirect_heard_at = ms(52);
        assert_eq!(leader.lost_at(&config), ms(53) + config.standby_silence());
        // Others that hear the leader when it no longer says that it hears this node prove the way to it broken.
        leader.take_round(config.beat(), ms(90));
        leader.indirect_heard_at = ms(110);
        assert_eq!(leader.lost_at(&config), ms(110) + config.response_timeout());
    }
}
