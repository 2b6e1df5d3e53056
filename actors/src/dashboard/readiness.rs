//! Whether the node does what it is there for.

use std::time::Duration;

use ecod::epoch::Epoch;
use ecod::time::Timestamp;
use serde::Serialize;

use crate::leader_election::Leadership;

/// The answer to `/readyz`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub(super) struct Readiness {
    /// Whether the node follows a live aggregator, or leads with a working broker.
    pub ready: bool,
    /// Why, in words.
    pub reason: String,
}

/// How long a live aggregator may publish nothing, a few periods aside.
const ROUND_PATIENCE: Duration = Duration::from_secs(2);

/// How old the newest round may be while rounds are closed at least every `period`.
pub(super) fn patience(period: Duration) -> Duration {
    ROUND_PATIENCE + 3 * period
}

/// Judges from who leads, the last round accepted, and whether a broker carries what the node publishes.
pub(super) fn readiness(
    leadership: &Leadership,
    last_round: Option<&(Epoch, Timestamp)>,
    broker_works: bool,
    patience: Duration,
    now: Timestamp,
) -> Readiness {
    let not = |reason: String| Readiness { ready: false, reason };
    let Some((leader, epoch)) = leadership.leader().zip(leadership.epoch.as_ref()) else {
        return not("no leader known".into());
    };
    if leadership.is_leading() && !broker_works {
        return not("leading without a working broker".into());
    }
    let of_leader = last_round.filter(|(last, _)| last == epoch);
    let Some((_, received_at)) = of_leader else {
        return not(format!("no round of {leader} yet"));
    };
    let age = now.since(*received_at);
    if age > patience {
        return not(format!("no round of {leader} for {} s", age.as_secs()));
    }
    let reason = if leadership.is_leading() { "leading".into() } else { format!("following {leader}") };
    Readiness { ready: true, reason }
}

#[cfg(test)]
mod tests {
    use ecod::names::NodeName;

    use super::*;
    use crate::leader_election::Position;

    const PATIENCE: Duration = Duration::from_secs(2);

    fn reason(leadership: &Leadership, round: Option<(u64, u64)>, broker_works: bool) -> (bool, String) {
        let round = round.map(|(term, at_s)| (epoch(term), Timestamp(at_s * 1_000_000)));
        let readiness = readiness(leadership, round.as_ref(), broker_works, PATIENCE, Timestamp(10_000_000));
        (readiness.ready, readiness.reason)
    }

    fn epoch(term: u64) -> Epoch {
        Epoch::new(term, NodeName::from_static("edge"))
    }

    #[test]
    fn ready_means_fresh_rounds_of_the_leader_and_a_broker_to_lead_with() {
        let at = |position| Leadership { position, epoch: Some(epoch(4)), standby: None };
        let (seeking, following, leading) = (at(Position::Seeking), at(Position::Following), at(Position::Leading));
        assert_eq!(reason(&seeking, Some((4, 9)), true), (false, "no leader known".into()));
        assert_eq!(reason(&following, None, false), (false, "no round of edge yet".into()));
        assert_eq!(reason(&following, Some((3, 9)), false), (false, "no round of edge yet".into()));
        assert_eq!(reason(&following, Some((4, 5)), false), (false, "no round of edge for 5 s".into()));
        assert_eq!(reason(&following, Some((4, 9)), false), (true, "following edge".into()));
        assert_eq!(reason(&leading, Some((4, 9)), true), (true, "leading".into()));
        assert_eq!(reason(&leading, Some((4, 9)), false), (false, "leading without a working broker".into()));
    }
}
