//! Readiness of a node: whether it follows a live aggregator, or leads with a working broker.

use std::time::Duration;

use serde::Serialize;

use crate::leadership::timers::PART_TIMEOUT;
use crate::leadership::view::Leadership;
use crate::model::epoch::Epoch;
use crate::model::time::Timestamp;

/// Readiness of a node, and the reason.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Readiness {
    /// True if the node is ready.
    pub ready: bool,
    /// The reason as text.
    pub reason: String,
    /// True if a restart may help.
    #[serde(skip)]
    pub needs_restart: bool,
}

/// Maximum age of the newest round of a live aggregator that closes a round each `round_period`.
pub fn round_timeout(round_period: Duration) -> Duration {
    PART_TIMEOUT + 3 * round_period
}

impl Readiness {
    /// A node that is not ready.
    pub fn not(reason: String) -> Self {
        Self {
            ready: false,
            reason,
            needs_restart: true,
        }
    }

    /// The readiness of the same node with a possible cause, if it is not ready.
    #[must_use]
    pub fn because(self, cause: Option<&str>) -> Self {
        match cause {
            Some(cause) if !self.ready => Self {
                reason: format!("{}: {cause}", self.reason),
                ..self
            },
            _ => self,
        }
    }

    /// The readiness of the same node with a problem of its settings, if there is one, which a
    /// restart does not fix.
    #[must_use]
    pub fn unless(self, problem: Option<String>) -> Self {
        match problem {
            Some(reason) => Self {
                ready: false,
                reason,
                needs_restart: self.needs_restart,
            },
            None => self,
        }
    }

    /// Determines readiness from the leadership, the epoch and arrival time of the last accepted
    /// round, and whether a broker carries the node's messages. Without a `timeout`, rounds are not
    /// required.
    pub fn judge(
        leadership: &Leadership,
        last_round: Option<&(Epoch, Timestamp)>,
        broker_works: bool,
        timeout: Option<Duration>,
        now: Timestamp,
    ) -> Self {
        let not = Self::not;
        let Some(epoch) = leadership.present_epoch() else {
            return not("no leader known".into());
        };
        if leadership.is_leading() && !broker_works {
            return not("leading without a working broker".into());
        }
        if leadership.is_leading() && leadership.is_deserted {
            // This depends on other nodes' reports, so it must not restart this node.
            let reason = "leading, but no follower can log in at this node's broker".into();
            return Self {
                ready: false,
                reason,
                needs_restart: false,
            };
        }
        let leader = &epoch.leader;
        if let Some(timeout) = timeout {
            let Some((_, received_at)) = last_round.filter(|(last, _)| last == epoch) else {
                return not(format!("no round of {leader} yet"));
            };
            let age = now.since(*received_at);
            if age > timeout {
                return not(format!("no round of {leader} for {} s", age.as_secs()));
            }
        }
        let reason = if leadership.is_leading() {
            "leading".into()
        } else {
            format!("following {leader}")
        };
        Self {
            ready: true,
            reason,
            needs_restart: false,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::leadership::view::Position;
    use crate::model::names::NodeName;

    const TIMEOUT: Option<Duration> = Some(Duration::from_secs(2));

    fn reason(
        leadership: &Leadership,
        round: Option<(u64, u64)>,
        broker_works: bool,
    ) -> (bool, String) {
        let round = round.map(|(term, at_s)| (epoch(term), Timestamp(at_s * 1_000_000)));
        let readiness = Readiness::judge(
            leadership,
            round.as_ref(),
            broker_works,
            TIMEOUT,
            Timestamp(10_000_000),
        );
        (readiness.ready, readiness.reason)
    }

    fn epoch(term: u64) -> Epoch {
        Epoch::new(term, NodeName::from_static("edge"))
    }

    #[test]
    fn ready_needs_rounds_and_broker() {
        let at = |position| Leadership {
            position,
            epoch: Some(epoch(4)),
            standby: None,
            term: 4,
            is_deserted: false,
            is_yielding: false,
        };
        let seeking = at(Position::Seeking);
        let following = at(Position::Following);
        let leading = at(Position::Leading);
        assert_eq!(
            reason(&seeking, Some((4, 9)), true),
            (false, "no leader known".into())
        );
        assert_eq!(
            reason(&following, None, false),
            (false, "no round of edge yet".into())
        );
        assert_eq!(
            reason(&following, Some((3, 9)), false),
            (false, "no round of edge yet".into())
        );
        assert_eq!(
            reason(&following, Some((4, 5)), false),
            (false, "no round of edge for 5 s".into())
        );
        assert_eq!(
            reason(&following, Some((4, 9)), false),
            (true, "following edge".into())
        );
        assert_eq!(
            reason(&leading, Some((4, 9)), true),
            (true, "leading".into())
        );
        assert_eq!(
            reason(&leading, Some((4, 9)), false),
            (false, "leading without a working broker".into())
        );
    }

    #[test]
    fn refused_logins_cause_no_restart() {
        let leading = Leadership {
            position: Position::Leading,
            epoch: Some(epoch(4)),
            ..Leadership::default()
        };
        let deserted = Leadership {
            is_deserted: true,
            ..leading
        };
        let readiness = Readiness::judge(
            &deserted,
            Some(&(epoch(4), Timestamp(0))),
            true,
            None,
            Timestamp(0),
        );
        assert_eq!(
            readiness.reason,
            "leading, but no follower can log in at this node's broker"
        );
        assert_eq!((readiness.ready, readiness.needs_restart), (false, false));
    }

    #[test]
    fn settings_problem_comes_first_without_restart() {
        let following = Leadership {
            position: Position::Following,
            epoch: Some(epoch(4)),
            ..Leadership::default()
        };
        let judge = |problem: Option<&str>, last_round: Option<&(Epoch, Timestamp)>| {
            let judged = Readiness::judge(&following, last_round, false, TIMEOUT, Timestamp(0));
            let Readiness {
                ready,
                reason,
                needs_restart,
            } = judged.unless(problem.map(Into::into));
            (ready, reason, needs_restart)
        };
        let fresh = (epoch(4), Timestamp(0));
        assert_eq!(
            judge(None, Some(&fresh)),
            (true, "following edge".into(), false)
        );
        assert_eq!(
            judge(Some("no origin"), Some(&fresh)),
            (false, "no origin".into(), false)
        );
        assert_eq!(
            judge(Some("no origin"), None),
            (false, "no origin".into(), true),
            "rounds are missing, too"
        );
    }

    #[test]
    fn unready_node_names_cause() {
        let reason_for = |leadership: &Leadership| {
            let judged = Readiness::judge(leadership, None, false, None, Timestamp(0));
            judged
                .because(Some(
                    "received a datagram of cell lot-1 with another key from 10.0.0.7",
                ))
                .reason
        };
        let alone =
            "no leader known: received a datagram of cell lot-1 with another key from 10.0.0.7";
        assert_eq!(reason_for(&Leadership::default()), alone);
        let following = Leadership {
            position: Position::Following,
            epoch: Some(epoch(4)),
            ..Leadership::default()
        };
        assert_eq!(reason_for(&following), "following edge");
    }

    #[test]
    fn packet_rounds_are_not_awaited() {
        let following = Leadership {
            position: Position::Following,
            epoch: Some(epoch(4)),
            standby: None,
            term: 4,
            is_deserted: false,
            is_yielding: false,
        };
        assert!(Readiness::judge(&following, None, false, None, Timestamp(0)).ready);
    }
}
