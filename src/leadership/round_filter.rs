//! Acceptance of rounds: the only place that decides which leader's rounds a node accepts.
//!
//! # Filters
//!
//! - [`RoundFilter`] checks each map, verdict and reputation message that arrives. It belongs to
//!   the actor that receives these messages, so that rounds take no detour. It reads the current
//!   [`Leadership`] and does not query the election.
//! - [`PublisherFilter`] is the rule of a node's own broker: which nodes may publish for the whole
//!   cell.
//! - [`Leadership::has_term`] is the rule for evidence, and for maps that a new leader continues
//!   from.
//!
//! A round passes four checks in this order: its [`Origin`] is sufficient, its epoch and number
//! don't go back ([`EpochGate`]), its leader is elected or may have succeeded the elected leader
//! ([`SuccessionFilter`]), and it did not wait in a queue ([`StalenessFilter`]).
//!
//! # Invariants
//!
//! 1. An accepted round is not accepted a second time, and not followed by an earlier round of its
//!    leadership.
//! 2. A leader named by the election is refused for [`crate::leadership::timers::SUCCESSOR_CREDIT`]
//!    at most.
//! 3. Once a round of a leadership was proven, claimed rounds of that leadership are refused.
//! 4. A round older than [`crate::leadership::timers::MAX_ROUND_AGE`] is refused once its leader's
//!    delay has been measured.

mod epoch_gate;
mod origin;
mod publisher;
mod staleness;
mod succession;

pub use epoch_gate::EpochGate;
pub use origin::{Origin, SignatureState};
pub use publisher::PublisherFilter;
pub use staleness::StalenessFilter;
pub use succession::SuccessionFilter;

use crate::leadership::timers::EPOCH_MEMORY;
use crate::leadership::view::Leadership;
use crate::model::epoch::Epoch;
use crate::model::names::NodeName;
use crate::model::time::Timestamp;
use crate::wire::{GlobalMap, RejectReason, Reputations, Verdicts};

/// Filter of the maps, verdicts and reputations that arrive at one node.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct RoundFilter {
    maps: SuccessionFilter,
    map_age: StalenessFilter,
    map_accepted_at: Option<Timestamp>,
    verdicts: SuccessionFilter,
    verdict_age: StalenessFilter,
    reputations: SuccessionFilter,
    /// The last leadership of which a proven round was accepted.
    proven: Option<Epoch>,
}

/// A round that was accepted.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct AcceptedRound {
    /// The leadership that published it.
    pub epoch: Epoch,
    /// Number of the round in that leadership.
    pub round: u64,
    /// True if it goes to [`crate::leadership::node::Input::RoundAccepted`]: verdicts do while no
    /// maps come.
    pub is_sign_of_life: bool,
    /// True if a new leader may continue from this round. While the node has no leader, rounds of
    /// any term are accepted.
    pub is_known_term: bool,
}

/// Reason for which a round was refused.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Refusal {
    /// This round or a later round of the same leadership was accepted before, over another path.
    Repeated,
    /// A round of a later leadership was accepted.
    Superseded,
    /// The election names another leader.
    NotElected,
    /// Its number is further ahead than rounds can have been published.
    Implausible,
    /// It was under way for too long.
    Stale,
    /// Its leader proves its rounds, and this one is not proven.
    Unproven,
}

impl Refusal {
    /// The reason that is counted; `None` for a repeated round, which is not a fault.
    pub fn reject_reason(self) -> Option<RejectReason> {
        match self {
            Self::Repeated => None,
            Self::Superseded => Some(RejectReason::Superseded),
            Self::NotElected => Some(RejectReason::NotElected),
            Self::Implausible => Some(RejectReason::OutOfRange),
            Self::Stale => Some(RejectReason::Stale),
            Self::Unproven => Some(RejectReason::BadSignature),
        }
    }
}

impl RoundFilter {
    /// Creates the filter of a node that starts. `saved_term` is the last term that an earlier run
    /// wrote to disk, or 0. Terms below the terms of that run are refused at first.
    pub fn new(saved_term: u64, now: Timestamp) -> Self {
        let floor = floor(saved_term);
        Self {
            maps: SuccessionFilter::new(floor),
            map_age: StalenessFilter::new(now),
            map_accepted_at: None,
            verdicts: SuccessionFilter::new(floor),
            verdict_age: StalenessFilter::new(now),
            // Brokers retain reputations: a node that starts receives them before it can have seen
            // any term.
            reputations: SuccessionFilter::of_retained(floor),
            proven: None,
        }
    }

    /// Accepts or refuses a map.
    ///
    /// # Errors
    /// Returns the reason for the refusal.
    pub fn accept_map(
        &mut self,
        map: &GlobalMap,
        origin: Origin,
        received_at: Timestamp,
        leadership: &Leadership,
    ) -> Result<AcceptedRound, Refusal> {
        let epoch = Epoch::new(map.epoch, map.aggregator.clone());
        self.check_origin(&epoch, origin)?;
        self.maps
            .admit(&epoch, map.round, received_at, leadership)?;
        check_age(
            &mut self.maps,
            &mut self.map_age,
            &epoch,
            map.fused_at_us,
            received_at,
        )?;
        self.record_origin(&epoch, origin);
        self.map_accepted_at = Some(received_at);
        Ok(accepted(epoch, map.round, true, leadership))
    }

    /// Accepts or refuses verdicts.
    ///
    /// # Errors
    /// Returns the reason for the refusal.
    pub fn accept_verdicts(
        &mut self,
        verdicts: &Verdicts,
        origin: Origin,
        received_at: Timestamp,
        leadership: &Leadership,
    ) -> Result<AcceptedRound, Refusal> {
        let epoch = Epoch::new(verdicts.epoch, verdicts.aggregator.clone());
        self.check_origin(&epoch, origin)?;
        self.verdicts
            .admit(&epoch, verdicts.round, received_at, leadership)?;
        check_age(
            &mut self.verdicts,
            &mut self.verdict_age,
            &epoch,
            verdicts.fused_at_us,
            received_at,
        )?;
        self.record_origin(&epoch, origin);
        let is_sign_of_life = self
            .map_accepted_at
            .is_none_or(|at| received_at.since(at) >= EPOCH_MEMORY);
        Ok(accepted(epoch, verdicts.round, is_sign_of_life, leadership))
    }

    /// Accepts or refuses reputations. They are a state that brokers retain, so their age does not matter, and many
    /// rounds may be missing. Maps and verdicts show which rounds can have been published.
    ///
    /// # Errors
    /// Returns the reason for the refusal.
    pub fn accept_reputations(
        &mut self,
        reputations: &Reputations,
        origin: Origin,
        received_at: Timestamp,
        leadership: &Leadership,
    ) -> Result<AcceptedRound, Refusal> {
        let epoch = Epoch::new(
            reputations.epoch,
            reputations.aggregator.clone().unwrap_or(UNNAMED),
        );
        self.check_origin(&epoch, origin)?;
        let possible = [&self.maps, &self.verdicts]
            .into_iter()
            .filter_map(|rounds| rounds.last_possible(&epoch, received_at))
            .max();
        if possible.is_some_and(|last| reputations.round > last) {
            return Err(Refusal::Implausible);
        }
        self.reputations
            .admit(&epoch, reputations.round, received_at, leadership)?;
        self.record_origin(&epoch, origin);
        Ok(accepted(epoch, reputations.round, false, leadership))
    }

    /// Refuses a claimed round of a leadership of which a proven round was accepted before.
    fn check_origin(&self, epoch: &Epoch, origin: Origin) -> Result<(), Refusal> {
        let is_doubtful = origin == Origin::Claimed && self.proven.as_ref() == Some(epoch);
        if is_doubtful {
            Err(Refusal::Unproven)
        } else {
            Ok(())
        }
    }

    /// Records that the leadership proves its rounds: later rounds without proof are refused.
    fn record_origin(&mut self, epoch: &Epoch, origin: Origin) {
        if origin == Origin::Proven && self.proven.as_ref() != Some(epoch) {
            self.proven = Some(epoch.clone());
        }
    }
}

/// Lowest term that a node accepts after a restart: the highest term that it had seen when it
/// stopped. The saved term is one higher, because a node writes the next term to disk in advance.
fn floor(saved_term: u64) -> u64 {
    saved_term.saturating_sub(1)
}

/// Refuses an admitted round that was in transit for too long by its time of fusion; see
/// [`StalenessFilter`].
fn check_age(
    order: &mut SuccessionFilter,
    age: &mut StalenessFilter,
    epoch: &Epoch,
    fused_at: Timestamp,
    received_at: Timestamp,
) -> Result<(), Refusal> {
    if age.is_fresh(epoch, fused_at, received_at) {
        Ok(())
    } else {
        order.on_stale();
        Err(Refusal::Stale)
    }
}

/// The accepted round, with the facts that its receivers need beside the message.
fn accepted(
    epoch: Epoch,
    round: u64,
    is_sign_of_life: bool,
    leadership: &Leadership,
) -> AcceptedRound {
    AcceptedRound {
        is_known_term: leadership.has_term(epoch.term),
        epoch,
        round,
        is_sign_of_life,
    }
}

/// Placeholder aggregator of reputations without one; it sorts before all other names.
const UNNAMED: NodeName = NodeName::from_static("-");

#[cfg(test)]
mod tests {
    use super::*;
    use crate::leadership::view::Position;
    use crate::wire::SCHEMA_VERSION;

    fn ms(n: u64) -> Timestamp {
        Timestamp(n * 1000)
    }

    fn seeking() -> Leadership {
        Leadership {
            term: 7,
            ..Leadership::default()
        }
    }

    fn following(term: u64, leader: &'static str) -> Leadership {
        let epoch = Some(Epoch::new(term, NodeName::from_static(leader)));
        Leadership {
            position: Position::Following,
            epoch,
            standby: None,
            term,
            is_deserted: false,
            is_yielding: false,
        }
    }

    fn map(epoch: u64, round: u64, fused_at: Timestamp) -> GlobalMap {
        GlobalMap::new(
            &Epoch::new(epoch, NodeName::from_static("edge")),
            round,
            fused_at,
        )
    }

    fn take(
        filter: &mut RoundFilter,
        map: &GlobalMap,
        at: Timestamp,
        leadership: &Leadership,
    ) -> Result<(), Refusal> {
        filter
            .accept_map(map, Origin::Claimed, at, leadership)
            .map(|_| ())
    }

    #[test]
    fn huge_epoch_silences_others_briefly() {
        let mut filter = RoundFilter::new(0, ms(0));
        let seeking = seeking();
        let mut take =
            |epoch, round, at| take(&mut filter, &map(epoch, round, ms(at)), ms(at), &seeking);
        assert_eq!(take(u64::MAX, 1, 0), Err(Refusal::NotElected));
        assert_eq!(take(u64::MAX, 2, 500), Ok(()), "it goes on and on");
        assert_eq!(take(7, 1, 1000), Err(Refusal::Superseded));
        assert_eq!(take(7, 2, 3500), Ok(()), "the clock of its leader is known");
        assert_eq!(take(7, 4, 3700), Ok(()));
        assert_eq!(take(7, 4, 3800), Err(Refusal::Repeated), "not taken twice");
    }

    /// A broker drops the oldest messages for a receiver that stands still, so that the rounds of a
    /// long stall arrive together, but not all of them.
    #[test]
    fn newest_round_follows_dropped_ones() {
        let seeking = seeking();
        let at = |round: u64| ms(100 * round);
        for (resumed, newest) in [(31, 30), (60, 55)] {
            let mut filter = RoundFilter::new(0, ms(0));
            for round in 0..10 {
                let map = map(7, round, at(round));
                assert_eq!(take(&mut filter, &map, at(round), &seeking), Ok(()));
            }
            for round in 10..13 {
                let map = map(7, round, at(round));
                let waited = take(&mut filter, &map, at(resumed), &seeking);
                assert_eq!(waited, Err(Refusal::Stale), "round {round}");
                let again = take(&mut filter, &map, at(resumed), &seeking);
                assert_eq!(again, Err(Refusal::Repeated), "round {round}");
            }
            let map = map(7, newest, at(newest));
            assert_eq!(take(&mut filter, &map, at(resumed), &seeking), Ok(()));
            let again = take(&mut filter, &map, at(resumed), &seeking);
            assert_eq!(again, Err(Refusal::Repeated));
        }
    }

    #[test]
    fn queued_rounds_are_refused() {
        let mut filter = RoundFilter::new(0, ms(0));
        let seeking = seeking();
        let at = |round: u64| ms(100 * round);
        for round in 0..10 {
            assert_eq!(
                take(&mut filter, &map(7, round, at(round)), at(round), &seeking),
                Ok(())
            );
        }
        let resumed = at(40);
        for round in 10..31 {
            let waited = take(&mut filter, &map(7, round, at(round)), resumed, &seeking);
            assert_eq!(waited, Err(Refusal::Stale), "round {round}");
        }
        assert_eq!(
            take(&mut filter, &map(7, 31, at(31)), resumed, &seeking),
            Ok(())
        );
    }

    /// A node stands still for 11 s. Queued reputations and the reputations of the current round arrive together.
    #[test]
    fn reputations_follow_queued_ones() {
        let mut filter = RoundFilter::new(0, ms(0));
        let leadership = following(8, "edge");
        let at = |round: u64| ms(100 * round);
        let reputations = |round| Reputations {
            schema: SCHEMA_VERSION,
            aggregator: Some(NodeName::from_static("edge")),
            epoch: 8,
            round,
            reputations: Default::default(),
        };
        for round in 0..10 {
            take(
                &mut filter,
                &map(8, round, at(round)),
                at(round),
                &leadership,
            )
            .unwrap();
        }
        let accept = |filter: &mut RoundFilter, round, now| {
            let accepted =
                filter.accept_reputations(&reputations(round), Origin::Claimed, now, &leadership);
            accepted.map(|_| ())
        };
        assert_eq!(accept(&mut filter, 1, at(1)), Ok(()));
        assert_eq!(accept(&mut filter, 9, at(9)), Ok(()));
        let resumed = at(120);
        let waited = take(&mut filter, &map(8, 11, at(11)), resumed, &leadership);
        assert_eq!(waited, Err(Refusal::Stale));
        assert_eq!(accept(&mut filter, 11, resumed), Ok(()), "queued, too");
        assert_eq!(accept(&mut filter, 119, resumed), Ok(()));
        let now = at(121);
        let next = accept(&mut filter, 90_000, now);
        assert_eq!(next, Err(Refusal::Implausible));
        take(&mut filter, &map(8, 121, now), now, &leadership).unwrap();
        assert_eq!(accept(&mut filter, 121, now), Ok(()));
        // A vehicle joins while the retained reputations are minutes old; its arrival changes them.
        let mut filter = RoundFilter::new(0, ms(0));
        assert_eq!(accept(&mut filter, 1, ms(0)), Ok(()));
        take(&mut filter, &map(8, 1700, ms(50)), ms(50), &leadership).unwrap();
        assert_eq!(accept(&mut filter, 1700, ms(300)), Ok(()));
        let next = accept(&mut filter, 90_000, ms(1400));
        assert_eq!(next, Err(Refusal::Implausible));
    }

    #[test]
    fn refused_map_refreshes_no_others() {
        let mut filter = RoundFilter::new(0, ms(0));
        let leadership = following(8, "edge");
        let at = |round: u64| ms(100 * round);
        for round in 0..10 {
            assert_eq!(
                take(
                    &mut filter,
                    &map(8, round, at(round)),
                    at(round),
                    &leadership
                ),
                Ok(())
            );
        }
        let resumed = at(40);
        assert_eq!(
            take(&mut filter, &map(7, 99, at(10)), resumed, &leadership),
            Err(Refusal::Superseded)
        );
        assert_eq!(
            take(&mut filter, &map(8, 10, at(10)), resumed, &leadership),
            Err(Refusal::Stale)
        );
    }

    #[test]
    fn each_topic_has_separate_order() {
        let mut filter = RoundFilter::new(0, Timestamp(1));
        let seeking = seeking();
        let now = Timestamp(1);
        let reputations = |epoch, round, aggregator: Option<&'static str>| Reputations {
            schema: SCHEMA_VERSION,
            aggregator: aggregator.map(NodeName::from_static),
            epoch,
            round,
            reputations: Default::default(),
        };
        assert!(
            filter
                .accept_map(&map(7, 9, now), Origin::Claimed, now, &seeking)
                .is_ok()
        );
        assert!(
            filter
                .accept_reputations(&reputations(7, 1, None), Origin::Claimed, now, &seeking)
                .is_ok()
        );
        assert!(
            filter
                .accept_reputations(
                    &reputations(7, 1, Some("edge")),
                    Origin::Claimed,
                    now,
                    &seeking
                )
                .is_ok()
        );
        let late =
            filter.accept_reputations(&reputations(7, 2, None), Origin::Claimed, now, &seeking);
        assert_eq!(late, Err(Refusal::Superseded));
    }

    #[test]
    fn lone_deposed_leader_is_refused() {
        let mut filter = RoundFilter::new(0, ms(0));
        let leadership = following(8, "euclid");
        assert_eq!(
            take(&mut filter, &map(8, 1, ms(0)), ms(0), &leadership),
            Ok(())
        );
        assert_eq!(
            take(&mut filter, &map(7, 99, ms(9000)), ms(9000), &leadership),
            Err(Refusal::Superseded)
        );
    }

    #[test]
    fn verdicts_are_life_signs_without_maps() {
        let mut filter = RoundFilter::new(0, ms(0));
        let leadership = following(8, "edge");
        let verdicts = |round: u64| Verdicts {
            schema: SCHEMA_VERSION,
            aggregator: NodeName::from_static("edge"),
            epoch: 8,
            round,
            fused_at_us: ms(100 * round),
            verdicts: Vec::new(),
        };
        let is_sign = |round: u64, filter: &mut RoundFilter| {
            filter
                .accept_verdicts(
                    &verdicts(round),
                    Origin::Claimed,
                    ms(100 * round),
                    &leadership,
                )
                .unwrap()
                .is_sign_of_life
        };
        assert!(is_sign(1, &mut filter));
        assert!(
            filter
                .accept_map(&map(8, 2, ms(200)), Origin::Claimed, ms(200), &leadership)
                .unwrap()
                .is_sign_of_life
        );
        assert!(!is_sign(2, &mut filter));
        assert!(
            (3..40).any(|round| is_sign(round, &mut filter)),
            "maps come no more"
        );
    }

    #[test]
    fn unknown_term_is_accepted_not_continued() {
        let mut filter = RoundFilter::new(0, ms(0));
        let next = filter
            .accept_map(&map(8, 1, ms(0)), Origin::Claimed, ms(0), &seeking())
            .unwrap();
        assert!(!next.is_known_term);
        let known = filter
            .accept_map(
                &map(8, 2, ms(100)),
                Origin::Claimed,
                ms(100),
                &following(8, "edge"),
            )
            .unwrap();
        assert!(known.is_known_term);
    }

    #[test]
    fn signing_leader_needs_signature_always() {
        let mut filter = RoundFilter::new(0, ms(0));
        let leadership = following(8, "edge");
        let mut take = |epoch, round: u64, origin, leadership: &Leadership| {
            let at = ms(100 * round);
            filter
                .accept_map(&map(epoch, round, at), origin, at, leadership)
                .map(|_| ())
        };
        assert_eq!(
            take(8, 1, Origin::Claimed, &leadership),
            Ok(()),
            "the filter has no record of it"
        );
        assert_eq!(take(8, 2, Origin::Proven, &leadership), Ok(()));
        assert_eq!(
            take(8, 3, Origin::Claimed, &leadership),
            Err(Refusal::Unproven)
        );
        assert_eq!(
            take(8, 3, Origin::Proven, &leadership),
            Ok(()),
            "the refused one leaves no trace"
        );
        assert_eq!(
            take(9, 4, Origin::Claimed, &following(9, "edge")),
            Ok(()),
            "the next may not be able to"
        );
    }
}
