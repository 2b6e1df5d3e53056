//! The order of leaderships on one topic: which messages of other nodes are accepted before, during
//! and after the elected leader's term.
//!
//! A superseded leader is refused, and so is a leader that was not elected. No refusal is
//! permanent: election messages can be lost, and any client of a broker can forge an epoch.

use std::time::Duration;

use crate::leadership::round_filter::{EpochGate, Refusal};
use crate::leadership::timers::{ELECTED_SILENCE, EPOCH_MEMORY, SUCCESSOR_CREDIT};
use crate::leadership::view::Leadership;
use crate::model::epoch::Epoch;
use crate::model::names::NodeName;
use crate::model::time::Timestamp;

/// Number of terms above the highest seen term that the next leader may use: a restarted node skips
/// the term that it may have used before.
const TERMS_AHEAD: u64 = 2;

/// Number of rounds by which a standby that takes over may be ahead of the elected leader's last
/// round. A standby that kept leading on its own has counted further; it has to follow the elected
/// leader instead.
const MAX_ROUNDS_AHEAD: u64 = 16;

/// Maximum number of rounds that a leader publishes in `time`: one per millisecond.
fn max_rounds_in(time: Duration) -> u64 {
    u64::try_from(time.as_millis()).unwrap_or(u64::MAX)
}

/// Filter of one topic: admits messages of possible leaders in the order of epoch, aggregator and
/// round.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct SuccessionFilter {
    gate: EpochGate,
    /// True if the topic's last message is retained. In this case any term is accepted while there
    /// is no leader, and messages may have any age, so that rounds may be missing.
    is_retained: bool,
    /// Arrival of the last admitted message; before any, of the first message.
    newest_at: Option<Timestamp>,
    /// Arrival of the last admitted message that was not stale; before any, of the first message.
    fresh_at: Option<Timestamp>,
    /// `fresh_at` without the last admitted message, which may prove stale.
    earlier_fresh_at: Option<Timestamp>,
    elected: Option<Elected>,
    /// Start of the current period in which messages of other nodes are admitted, or in which the
    /// elected leader's messages are not.
    others_since: Option<Timestamp>,
    /// The elected leader during whose leadership other nodes have used up their credit, including
    /// terms that it renews.
    overruled: Option<NodeName>,
    /// The publisher of a term that the election has not seen, while there is no leader.
    stranger: Option<Stranger>,
}

/// The leader that the election named last.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
struct Elected {
    epoch: Epoch,
    last_round: Option<u64>,
    /// Arrival of its last round; before any, of the first message that found it elected.
    heard_at: Timestamp,
}

/// A publisher that no election vouches for.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
struct Stranger {
    epoch: Epoch,
    since: Timestamp,
    last: Timestamp,
}

impl Elected {
    /// True if the leader's standby may have taken over, or the leader itself may have continued in
    /// a later term, for example after a split has healed. Leaders of the same term are rivals that
    /// began at the same time.
    fn is_succeeded_by(&self, epoch: &Epoch, round: u64, standby: Option<&NodeName>) -> bool {
        let goes_on = |last| round > last && round - last <= MAX_ROUNDS_AHEAD;
        let is_next = standby == Some(&epoch.leader) || self.epoch.leader == epoch.leader;
        is_next && epoch.term > self.epoch.term && self.last_round.is_none_or(goes_on)
    }
}

impl SuccessionFilter {
    /// Creates a filter that refuses terms below `floor` at first. While there is no leader it also
    /// refuses terms below the highest seen term, or more than `TERMS_AHEAD` above it, until they
    /// have been published for a while.
    pub fn new(floor: u64) -> Self {
        Self {
            gate: EpochGate::new(floor),
            is_retained: false,
            newest_at: None,
            fresh_at: None,
            earlier_fresh_at: None,
            elected: None,
            others_since: None,
            overruled: None,
            stranger: None,
        }
    }

    /// Creates a filter for a topic whose last message is retained. While there is no leader it
    /// accepts any term from `floor` on, and a message may be many rounds later than the one before.
    pub fn of_retained(floor: u64) -> Self {
        Self {
            is_retained: true,
            ..Self::new(floor)
        }
    }

    /// Admits round `round` of `epoch`, or refuses it, based on the election's leadership.
    ///
    /// # Errors
    /// Returns the reason for the refusal, which may be any reason except [`Refusal::Stale`].
    pub fn admit(
        &mut self,
        epoch: &Epoch,
        round: u64,
        received_at: Timestamp,
        leadership: &Leadership,
    ) -> Result<(), Refusal> {
        let elected = leadership.present_epoch();
        if let Some(elected) = elected.filter(|elected| {
            self.elected
                .as_ref()
                .is_none_or(|last| last.epoch != **elected)
        }) {
            self.elected = Some(Elected {
                epoch: elected.clone(),
                last_round: None,
                heard_at: received_at,
            });
            self.overruled.take_if(|leader| *leader != elected.leader);
        }
        match elected {
            Some(elected) if elected == epoch => self.admit_elected(epoch, round, received_at),
            Some(elected) => {
                // A leader has no successor before it yields. It must discover a later leadership
                // through the election: its own rounds continue until then, and would be of a lower
                // epoch.
                let is_staying = leadership.is_leading() && !leadership.is_yielding;
                let standby = leadership.standby.as_ref().filter(|_| !is_staying);
                self.admit_other(epoch, round, received_at, elected, standby)
            }
            None if self.is_strange(epoch, leadership, received_at) => Err(Refusal::NotElected),
            None => self.admit_in_order(epoch, round, received_at, true),
        }
    }

    /// Processes that the message that [`Self::admit`] has just admitted is stale. It waited in a
    /// queue, and the leader may have published many rounds meanwhile.
    pub(super) fn on_stale(&mut self) {
        self.fresh_at = self.earlier_fresh_at;
    }

    /// The last round that `epoch` can have published by `received_at`; `None` if the last message on this topic is of
    /// another epoch.
    pub(super) fn last_possible(&self, epoch: &Epoch, received_at: Timestamp) -> Option<u64> {
        let (_, last) = self.gate.latest().filter(|(latest, _)| *latest == epoch)?;
        let fresh_at = self.fresh_at.unwrap_or(received_at);
        Some(
            last.saturating_add(MAX_ROUNDS_AHEAD)
                .saturating_add(max_rounds_in(received_at.since(fresh_at))),
        )
    }

    /// True if an unconfirmed epoch must not be accepted yet.
    ///
    /// The election receives terms only from nodes with the cell's key, at the latest with the next
    /// leader's beats, and tracks terms that are over. Without election state, or where this node
    /// has followed or led a later epoch, the filter accepts the first publisher that keeps
    /// publishing for [`SUCCESSOR_CREDIT`].
    fn is_strange(
        &mut self,
        epoch: &Epoch,
        leadership: &Leadership,
        received_at: Timestamp,
    ) -> bool {
        if self.is_retained {
            return false;
        }
        let terms = leadership.term..=leadership.term.saturating_add(TERMS_AHEAD);
        let is_over = leadership
            .epoch
            .as_ref()
            .is_some_and(|latest| latest > epoch);
        if terms.contains(&epoch.term) && !is_over
            || self
                .gate
                .latest()
                .is_some_and(|(latest, _)| latest == epoch)
        {
            return false;
        }
        match &mut self.stranger {
            Some(stranger) if stranger.epoch == *epoch => {
                stranger.last = received_at;
                received_at.since(stranger.since) < SUCCESSOR_CREDIT
            }
            Some(stranger) if received_at.since(stranger.last) < EPOCH_MEMORY => true,
            _ => {
                self.stranger = Some(Stranger {
                    epoch: epoch.clone(),
                    since: received_at,
                    last: received_at,
                });
                true
            }
        }
    }

    /// The elected leader is admitted even after another node with a later epoch, unless that node
    /// is likely to be elected next.
    fn admit_elected(
        &mut self,
        epoch: &Epoch,
        round: u64,
        received_at: Timestamp,
    ) -> Result<(), Refusal> {
        if self
            .elected
            .as_ref()
            .and_then(|elected| elected.last_round)
            .is_some_and(|last| round <= last)
        {
            return Err(Refusal::Repeated);
        }
        if self.gate.latest().is_some_and(|(latest, _)| latest > epoch) {
            let since = *self.others_since.get_or_insert(received_at);
            if received_at.since(since) >= SUCCESSOR_CREDIT {
                self.gate = EpochGate::default();
                self.overruled = Some(epoch.leader.clone());
            }
        }
        self.admit_in_order(epoch, round, received_at, true)?;
        if let Some(elected) = &mut self.elected {
            elected.last_round = Some(round);
            elected.heard_at = received_at;
        }
        self.others_since = None;
        Ok(())
    }

    /// Handles a round of a node other than the `elected` leader. A higher epoch is admitted if it
    /// continues the elected leader's rounds, as its standby or that leader in a later term does,
    /// or if that leader has been silent for [`ELECTED_SILENCE`]. It is refused once other nodes
    /// have used up their credit. A lower epoch is admitted in order: these are the last rounds of
    /// the previous leader.
    ///
    /// # Example
    /// `edge` is elected in term 4 with the standby `gauss`, and its round 88 was admitted. Round
    /// 89 of `gauss` in term 5 arrives before the election names `gauss`: it is admitted. Round 89
    /// of `euclid` in term 6 is refused as [`Refusal::NotElected`] until `edge` has been silent for
    /// [`ELECTED_SILENCE`].
    fn admit_other(
        &mut self,
        epoch: &Epoch,
        round: u64,
        received_at: Timestamp,
        elected: &Epoch,
        standby: Option<&NodeName>,
    ) -> Result<(), Refusal> {
        if epoch > elected {
            let known = self
                .elected
                .as_ref()
                .filter(|known| received_at.since(known.heard_at) < ELECTED_SILENCE);
            let goes_on = self
                .gate
                .latest()
                .is_some_and(|(latest, _)| latest == epoch);
            let usurps = known.is_some_and(|known| match known.last_round {
                None if goes_on => false,
                _ => !known.is_succeeded_by(epoch, round, standby),
            });
            if usurps || self.overruled.as_ref() == Some(&elected.leader) {
                return Err(Refusal::NotElected);
            }
        }
        self.admit_in_order(epoch, round, received_at, false)?;
        if epoch > elected {
            self.others_since.get_or_insert(received_at);
        }
        Ok(())
    }

    /// `may_lead` is true if there is no other leader.
    fn admit_in_order(
        &mut self,
        epoch: &Epoch,
        round: u64,
        received_at: Timestamp,
        may_lead: bool,
    ) -> Result<(), Refusal> {
        let silence = received_at.since(*self.newest_at.get_or_insert(received_at));
        let quiet = silence >= EPOCH_MEMORY;
        self.fresh_at.get_or_insert(received_at);
        let possible = self.last_possible(epoch, received_at);
        if !quiet && !self.is_retained && possible.is_some_and(|last| round > last) {
            return Err(Refusal::Implausible);
        }
        let mut admitted = self.gate.admit(epoch, round);
        if admitted.is_err() && quiet && may_lead {
            self.gate = EpochGate::default();
            admitted = self.gate.admit(epoch, round);
        }
        admitted.map_err(|_| match self.gate.latest() {
            Some((latest, _)) if latest == epoch => Refusal::Repeated,
            _ => Refusal::Superseded,
        })?;
        self.newest_at = Some(received_at);
        self.earlier_fresh_at = self.fresh_at.replace(received_at);
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::leadership::view::Position;
    use crate::wire::MAX_INTEGER;

    fn epoch(term: u64, leader: &str) -> Epoch {
        Epoch::new(term, NodeName::new(leader).unwrap())
    }

    fn led_by(epoch: Epoch, standby: Option<&'static str>) -> Leadership {
        let standby = standby.map(NodeName::from_static);
        Leadership {
            position: Position::Following,
            term: epoch.term,
            epoch: Some(epoch),
            standby,
            is_deserted: false,
            is_yielding: false,
        }
    }

    fn seeking(term: u64) -> Leadership {
        Leadership {
            term,
            ..Leadership::default()
        }
    }

    fn at(ms: u64) -> Timestamp {
        Timestamp(ms * 1000)
    }

    /// A split heals after this node, which led its side, has been without a working part for
    /// [`EPOCH_MEMORY`]: the other side's leader must first be elected, or go on alone for a while.
    #[test]
    fn own_earlier_leadership_needs_proof() {
        let own = epoch(2, "gauss");
        let other = epoch(2, "edge");
        let seeking = Leadership {
            position: Position::Seeking,
            ..led_by(own.clone(), None)
        };
        let mut filter = SuccessionFilter::new(0);
        let led = led_by(own.clone(), None);
        assert_eq!(filter.admit(&own, 1, at(0), &led), Ok(()));
        let quiet = EPOCH_MEMORY.as_millis() as u64;
        let credit = SUCCESSOR_CREDIT.as_millis() as u64;
        let mut admit = |round, ms| filter.admit(&other, round, at(ms), &seeking);
        assert_eq!(admit(90, quiet), Err(Refusal::NotElected));
        assert_eq!(admit(91, quiet + credit - 100), Err(Refusal::NotElected));
        assert_eq!(admit(92, quiet + credit), Ok(()));
    }

    #[test]
    fn only_retained_messages_may_be_older() {
        let elected = epoch(7, "edge");
        let leadership = led_by(elected.clone(), None);
        for (mut filter, expected) in [
            (SuccessionFilter::of_retained(0), Ok(())),
            (SuccessionFilter::new(0), Err(Refusal::Implausible)),
        ] {
            assert_eq!(filter.admit(&elected, 1, at(0), &leadership), Ok(()));
            let later = filter.admit(&elected, 1700, at(300), &leadership);
            assert_eq!(later, expected);
        }
    }

    #[test]
    fn forged_epoch_silences_no_leader() {
        let elected = epoch(7, "edge");
        let forged = epoch(u64::MAX, "gauss");
        let leadership = led_by(elected.clone(), Some("euclid"));
        let mut filter = SuccessionFilter::of_retained(0);
        for round in 0..100 {
            assert_eq!(
                filter.admit(&elected, round, at(100 * round), &leadership),
                Ok(()),
                "round {round}"
            );
            let refused = filter.admit(&forged, round, at(100 * round + 50), &leadership);
            assert_eq!(refused, Err(Refusal::NotElected));
        }
    }

    #[test]
    fn false_successor_passes_once() {
        let elected = epoch(7, "edge");
        let forged = epoch(u64::MAX, "euclid");
        let leadership = led_by(elected.clone(), Some("euclid"));
        let mut filter = SuccessionFilter::of_retained(0);
        let mut lost = Vec::new();
        for round in 0..100 {
            if filter
                .admit(&elected, round, at(100 * round), &leadership)
                .is_err()
            {
                lost.push(round);
            }
            filter
                .admit(&forged, round + 1, at(100 * round + 50), &leadership)
                .ok();
        }
        assert_eq!(lost, [1, 2, 3, 4, 5], "half a second, and only once");
    }

    /// Each claim of a later term makes the leader renew its own.
    #[test]
    fn renewal_readmits_no_false_successor() {
        let forged = |term| epoch(term + 1, "euclid");
        let mut filter = SuccessionFilter::new(0);
        let mut lost = Vec::new();
        for round in 0..1000 {
            // Every 10 s.
            let elected = epoch(7 + 2 * (round / 100), "edge");
            let leadership = led_by(elected.clone(), Some("euclid"));
            if filter
                .admit(&elected, round, at(100 * round), &leadership)
                .is_err()
            {
                lost.push(round);
            }
            filter
                .admit(
                    &forged(elected.term),
                    round + 1,
                    at(100 * round + 50),
                    &leadership,
                )
                .ok();
        }
        assert_eq!(lost, [1, 2, 3, 4, 5], "half a second, and only once");
        let after = led_by(epoch(40, "gauss"), Some("euclid"));
        assert_eq!(
            filter.admit(&epoch(40, "gauss"), 1001, at(100_100), &after),
            Ok(())
        );
        let taken_over = filter.admit(&epoch(41, "euclid"), 1002, at(100_200), &after);
        assert_eq!(
            taken_over,
            Ok(()),
            "it has credit in addition to another leader"
        );
    }

    #[test]
    fn successor_precedes_election_message() {
        let old = epoch(7, "edge");
        let new = epoch(8, "euclid");
        let mut filter = SuccessionFilter::of_retained(0);
        let before = led_by(old.clone(), Some("euclid"));
        let after = led_by(new.clone(), None);
        assert_eq!(filter.admit(&old, 1, at(0), &before), Ok(()));
        assert_eq!(filter.admit(&new, 2, at(100), &before), Ok(()));
        assert_eq!(
            filter.admit(&old, 2, at(110), &before),
            Err(Refusal::Superseded),
            "no way back"
        );
        assert_eq!(filter.admit(&new, 3, at(200), &after), Ok(()));
        let unknown = epoch(9, "gauss");
        assert_eq!(
            filter.admit(&unknown, 4, at(300), &after),
            Err(Refusal::NotElected)
        );
        assert_eq!(
            filter.admit(&unknown, 5, at(500), &after),
            Ok(()),
            "the elected has fallen silent"
        );
    }

    /// The standby took over while the leader was cut off. The standby's rounds arrive before the
    /// election's messages do.
    #[test]
    fn unyielding_leader_refuses_other_rounds() {
        let own = epoch(7, "edge");
        let next = epoch(8, "euclid");
        let leading = Leadership {
            position: Position::Leading,
            ..led_by(own.clone(), Some("euclid"))
        };
        let mut filter = SuccessionFilter::new(0);
        for round in 1..20 {
            assert_eq!(
                filter.admit(&own, round, at(100 * round), &leading),
                Ok(()),
                "round {round}"
            );
            let refused = filter.admit(&next, round + 1, at(100 * round + 50), &leading);
            assert_eq!(refused, Err(Refusal::NotElected));
        }
        let yielding = Leadership {
            is_yielding: true,
            ..leading
        };
        assert_eq!(filter.admit(&next, 20, at(2000), &yielding), Ok(()));
    }

    #[test]
    fn forged_round_silences_no_leader() {
        let edge = epoch(7, "edge");
        let leadership = led_by(epoch(7, "edge"), Some("euclid"));
        let mut filter = SuccessionFilter::new(0);
        for round in 1..100 {
            assert_eq!(
                filter.admit(&edge, round, at(100 * round), &leadership),
                Ok(()),
                "round {round}"
            );
            let forged = filter.admit(&edge, MAX_INTEGER, at(100 * round + 50), &leadership);
            assert_eq!(forged, Err(Refusal::Implausible));
        }
        let after_a_gap = filter.admit(&edge, 120, at(12_000), &leadership);
        assert_eq!(after_a_gap, Ok(()), "rounds that were lost on the way");
        let after_a_sleep = filter.admit(&edge, 100_000, at(15_000), &leadership);
        assert_eq!(
            after_a_sleep,
            Ok(()),
            "a machine whose clock stood still while it slept"
        );
    }

    #[test]
    fn renewed_term_precedes_message() {
        let before = epoch(7, "edge");
        let renewed = epoch(8, "edge");
        let leadership = led_by(before.clone(), Some("euclid"));
        let mut filter = SuccessionFilter::of_retained(0);
        assert_eq!(filter.admit(&before, 41, at(0), &leadership), Ok(()));
        assert_eq!(filter.admit(&renewed, 42, at(100), &leadership), Ok(()));
        assert_eq!(
            filter.admit(&before, 42, at(110), &leadership),
            Err(Refusal::Superseded)
        );
    }

    #[test]
    fn saved_term_admits_unelected_publisher_later() {
        let unelected = epoch(3, "aggregator");
        let leadership = seeking(50);
        let mut filter = SuccessionFilter::new(50);
        let taken = |round: &u64| {
            filter
                .admit(&unelected, *round, at(100 * round), &leadership)
                .is_ok()
        };
        assert_eq!(
            (0..60).find(taken),
            Some(35),
            "half a second until it is accepted, and three for saved state"
        );
    }

    #[test]
    fn separately_leading_standby_is_no_successor() {
        let elected = epoch(2, "euclid");
        let lone = epoch(3, "edge");
        let leadership = led_by(elected.clone(), Some("edge"));
        let mut filter = SuccessionFilter::of_retained(0);
        assert_eq!(filter.admit(&elected, 42, at(0), &leadership), Ok(()));
        assert_eq!(
            filter.admit(&lone, 3, at(50), &leadership),
            Err(Refusal::NotElected),
            "it has just started"
        );
        assert_eq!(
            filter.admit(&lone, 9000, at(50), &leadership),
            Err(Refusal::NotElected),
            "it was alone for long"
        );
        assert_eq!(filter.admit(&elected, 43, at(100), &leadership), Ok(()));
        assert_eq!(
            filter.admit(&epoch(5, "edge"), 44, at(200), &leadership),
            Ok(()),
            "it takes over"
        );
    }

    #[test]
    fn simultaneous_rival_waits_for_silence() {
        let elected = epoch(1, "edge");
        let rival = epoch(1, "v02");
        for standby in [None, Some("v02")] {
            let leadership = led_by(elected.clone(), standby);
            let mut filter = SuccessionFilter::new(0);
            for round in 0..3 {
                let refused = filter.admit(&rival, round, at(100 * round), &leadership);
                assert_eq!(
                    refused,
                    Err(Refusal::NotElected),
                    "{standby:?}, round {round}"
                );
            }
            assert_eq!(
                filter.admit(&elected, 0, at(210), &leadership),
                Ok(()),
                "its first message arrives late"
            );
            assert_eq!(
                filter.admit(&rival, 3, at(300), &leadership),
                Err(Refusal::NotElected)
            );
            assert_eq!(
                filter.admit(&rival, 5, at(500), &leadership),
                Ok(()),
                "the elected is silent"
            );
        }
    }

    #[test]
    fn earlier_rival_lasts_until_elected_publishes() {
        let elected = epoch(1, "edge");
        let rival = epoch(1, "v02");
        let renewed = epoch(2, "edge");
        let mut filter = SuccessionFilter::new(0);
        assert_eq!(filter.admit(&rival, 1, at(0), &seeking(1)), Ok(()));
        let leadership = led_by(elected.clone(), None);
        assert_eq!(
            filter.admit(&elected, 1, at(20), &leadership),
            Err(Refusal::Superseded)
        );
        assert_eq!(
            filter.admit(&rival, 2, at(100), &leadership),
            Ok(()),
            "one of both goes on"
        );
        let leadership = led_by(renewed.clone(), None);
        assert_eq!(
            filter.admit(&renewed, 5, at(420), &leadership),
            Ok(()),
            "it leads on in a term above both"
        );
        assert_eq!(
            filter.admit(&rival, 6, at(430), &leadership),
            Err(Refusal::Superseded)
        );
    }

    #[test]
    fn single_later_round_silences_briefly() {
        let elected = epoch(6, "euclid");
        let later = epoch(6, "gauss");
        let mut filter = SuccessionFilter::new(0);
        assert_eq!(filter.admit(&later, 40, at(0), &seeking(5)), Ok(()));
        let leadership = led_by(elected.clone(), None);
        let passes = (1..10).map(|n| {
            filter
                .admit(&elected, 40 + n, at(100 * n), &leadership)
                .is_ok()
        });
        assert_eq!(
            passes.collect::<Vec<_>>(),
            [[false; 5].as_slice(), &[true; 4]].concat()
        );
    }

    #[test]
    fn unknown_term_needs_steady_publisher() {
        let seeking_in_7 = seeking(7);
        let mut filter = SuccessionFilter::new(0);
        let next = epoch(8, "edge");
        for round in 0..20 {
            let forged = epoch(1 << 40 | round, "mallory");
            let refused = filter.admit(&forged, round, at(100 * round), &seeking_in_7);
            assert_eq!(refused, Err(Refusal::NotElected), "round {round}");
            assert_eq!(
                filter.admit(&next, round, at(100 * round + 1), &seeking_in_7),
                Ok(()),
                "round {round}"
            );
        }
        let later = epoch(12, "euclid");
        assert_eq!(
            filter.admit(&later, 20, at(10_000), &seeking_in_7),
            Err(Refusal::NotElected)
        );
        let seeking_in_12 = seeking(12);
        assert_eq!(
            filter.admit(&later, 21, at(10_100), &seeking_in_12),
            Ok(()),
            "the election has received it"
        );
        assert_eq!(
            filter.admit(&next, 22, at(20_000), &seeking_in_12),
            Err(Refusal::NotElected),
            "it is over"
        );
    }

    #[test]
    fn slow_unelected_publisher_is_accepted() {
        for (period_ms, believed_from) in [(100, 5), (1000, 1), (5000, 1)] {
            let mut filter = SuccessionFilter::new(0);
            for term in [3, 1_763_683_200] {
                let unelected = epoch(term, "aggregator");
                let start = 100_000 * (1 + u64::from(term > 3));
                let taken = |round: &u64| {
                    filter
                        .admit(
                            &unelected,
                            *round,
                            at(start + period_ms * round),
                            &seeking(7),
                        )
                        .is_ok()
                };
                let taken: Vec<_> = (0..8).filter(taken).collect();
                assert_eq!(
                    taken,
                    Vec::from_iter(believed_from..8),
                    "term {term} every {period_ms} ms"
                );
            }
        }
    }

    #[test]
    fn last_old_round_passes_before_new() {
        let old = epoch(7, "edge");
        let new = epoch(8, "euclid");
        let mut filter = SuccessionFilter::of_retained(0);
        let after = led_by(new.clone(), None);
        assert_eq!(
            filter.admit(&old, 1, at(0), &led_by(old.clone(), None)),
            Ok(())
        );
        assert_eq!(filter.admit(&old, 2, at(100), &after), Ok(()));
        assert_eq!(filter.admit(&new, 3, at(200), &after), Ok(()));
        assert_eq!(
            filter.admit(&old, 4, at(300), &after),
            Err(Refusal::Superseded)
        );
    }
}
