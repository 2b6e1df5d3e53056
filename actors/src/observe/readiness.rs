//! Whether a node does what it is there for: asked by its dashboard and by whoever runs it as a service.

use std::collections::BTreeMap;
use std::time::Duration;

use ecod::aggregator::FusionConfig;
use ecod::epoch::Epoch;
use ecod::time::Timestamp;
use ecod::vote::VoteMode;
use ecod::wire::Verdicts;
use ractor::{Message, RpcReplyPort};
use serde::Serialize;
use tokio::sync::watch;

use crate::messages::actor_slot::ActorSlot;
use crate::messages::broker::BrokerMessage;
use crate::messages::gateway::GatewayMessage;
use crate::messages::leadership::Leadership;
use crate::messages::newest::{Newest, Received, ReceivedMap};
use crate::platform::clock;
use crate::transport::broker::BrokerHealth;
use crate::transport::mqtt::{BrokerAddress, DataPlane, LinkState};

/// Whether a node follows a live aggregator, or leads with a working broker.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Readiness {
    /// Whether it does.
    pub ready: bool,
    /// Why, in words.
    pub reason: String,
}

/// What a node's readiness is judged from; reading never makes another part wait.
#[derive(Debug, Clone)]
pub struct Vitals {
    /// The newest of everything.
    pub newest: Newest,
    /// Who leads.
    pub leadership: watch::Receiver<Leadership>,
    /// Which brokers carry the data.
    pub plane: DataPlane,
    /// How old the newest round of a live aggregator may be; none where rounds come only with reports.
    pub patience: Option<Duration>,
    /// Tells how links are.
    pub gateway: ActorSlot<GatewayMessage>,
    /// Tells whether the node's own broker serves.
    pub broker: ActorSlot<BrokerMessage>,
}

/// What the gateway and the broker answered.
#[derive(Debug, Clone, Default)]
pub struct Probe {
    /// How the links are; none when the gateway did not answer.
    pub links: Option<BTreeMap<BrokerAddress, LinkState>>,
    /// Whether the node's own broker serves.
    pub broker_serves: bool,
}

/// How long a live aggregator may publish nothing, a few periods aside.
const ROUND_PATIENCE: Duration = Duration::from_secs(2);

/// How long a part may take to answer.
const ANSWER_PATIENCE: Duration = Duration::from_millis(500);

/// How old the newest round may be in a cell of this configuration; VOTE's `paper` mode alone has a round whenever the
/// vehicles have sent a packet of frames.
pub fn patience(fusion: &FusionConfig) -> Option<Duration> {
    let by_packets = !fusion.algorithms.pace() && fusion.vote.mode == VoteMode::Paper;
    (!by_packets).then(|| ROUND_PATIENCE + 3 * Duration::from_secs_f64(fusion.round.period_s))
}

impl Vitals {
    /// Asks the parts how they are.
    pub async fn probe(&self) -> Probe {
        let (health, links) = tokio::join!(
            ask(&self.broker, |reply| BrokerMessage::Health { reply }),
            ask(&self.gateway, |reply| GatewayMessage::Links { reply }),
        );
        Probe { broker_serves: matches!(health, Some(BrokerHealth::Serving(_))), links }
    }

    /// Whether the node is ready now, the parts being as they answered.
    pub fn readiness(&self, probe: &Probe) -> Readiness {
        let leadership = self.leadership.borrow().clone();
        readiness(&leadership, self.last_round().as_ref(), self.broker_works(probe), self.patience, clock::now())
    }

    /// Whether a broker carries what this node publishes.
    fn broker_works(&self, probe: &Probe) -> bool {
        let up = |broker| probe.links.as_ref().and_then(|links| links.get(broker)) == Some(&LinkState::Up);
        self.plane.external.as_ref().is_some_and(up) || (self.plane.embedded && probe.broker_serves)
    }

    /// The newest round accepted: its epoch and when it came.
    fn last_round(&self) -> Option<(Epoch, Timestamp)> {
        newest_round(self.newest.map.borrow().as_ref(), self.newest.verdicts.borrow().as_ref())
    }
}

/// The epoch of the newest round, be it a map or verdicts, and when it came.
pub fn newest_round(map: Option<&ReceivedMap>, verdicts: Option<&Received<Verdicts>>) -> Option<(Epoch, Timestamp)> {
    let map =
        map.map(|received| (Epoch::new(received.map.epoch, received.map.aggregator.clone()), received.received_at));
    let verdicts = verdicts.map(|received| {
        let verdicts = &received.message;
        (Epoch::new(verdicts.epoch, verdicts.aggregator.clone()), received.received_at)
    });
    map.into_iter().chain(verdicts).max_by_key(|(_, received_at)| *received_at)
}

async fn ask<M: Message, T: Send + 'static>(
    slot: &ActorSlot<M>,
    question: impl FnOnce(RpcReplyPort<T>) -> M,
) -> Option<T> {
    let answer = slot.get()?.call(question, Some(ANSWER_PATIENCE)).await;
    answer.ok()?.success_or(()).ok()
}

/// Judges from who leads, the last round accepted, and whether a broker carries what the node publishes.
fn readiness(
    leadership: &Leadership,
    last_round: Option<&(Epoch, Timestamp)>,
    broker_works: bool,
    patience: Option<Duration>,
    now: Timestamp,
) -> Readiness {
    let not = |reason: String| Readiness { ready: false, reason };
    let Some((leader, epoch)) = leadership.leader().zip(leadership.epoch.as_ref()) else {
        return not("no leader known".into());
    };
    if leadership.is_leading() && !broker_works {
        return not("leading without a working broker".into());
    }
    if let Some(patience) = patience {
        let Some((_, received_at)) = last_round.filter(|(last, _)| last == epoch) else {
            return not(format!("no round of {leader} yet"));
        };
        let age = now.since(*received_at);
        if age > patience {
            return not(format!("no round of {leader} for {} s", age.as_secs()));
        }
    }
    let reason = if leadership.is_leading() { "leading".into() } else { format!("following {leader}") };
    Readiness { ready: true, reason }
}

#[cfg(test)]
mod tests {
    use ecod::names::NodeName;

    use super::*;
    use crate::messages::leadership::Position;

    const PATIENCE: Option<Duration> = Some(Duration::from_secs(2));

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

    #[test]
    fn rounds_that_come_with_packets_only_are_not_waited_for() {
        let following = Leadership { position: Position::Following, epoch: Some(epoch(4)), standby: None };
        assert!(readiness(&following, None, false, None, Timestamp(0)).ready);
        let mut fusion = FusionConfig::default();
        fusion.round.period_s = 1.0;
        fusion.vote.mode = VoteMode::Paper;
        assert_eq!(patience(&fusion), Some(Duration::from_secs(5)));
        fusion.algorithms = ecod::aggregator::Algorithms::Vote;
        assert_eq!(patience(&fusion), None);
    }
}
