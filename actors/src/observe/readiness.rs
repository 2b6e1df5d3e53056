//! Readiness of a running node, for its dashboard and for the service manager.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use ecod::admission::timeliness::Timeliness;
use ecod::aggregator::{Algorithms, FusionConfig};
use ecod::diagnostics::TroubleKind;
use ecod::leadership::Leadership;
use ecod::leadership::readiness::{Readiness, round_timeout};
use ecod::leadership::timers::READINESS_STEPS;
use ecod::model::epoch::Epoch;
use ecod::model::origin::GeographicOrigin;
use ecod::model::time::Timestamp;
use ecod::perception::box_projection::BoxProjector;
use ecod::perception::landmark::LandmarkConfig;
use ecod::vote::VoteMode;
use ecod::wire::{Trouble, Verdicts};
use tokio::sync::watch;

use crate::messages::actor_slot::ActorSlot;
use crate::messages::broker::BrokerMessage;
use crate::messages::fuser::FuserMessage;
use crate::messages::gateway::GatewayMessage;
use crate::messages::newest::{Newest, Received, ReceivedMap};
use crate::platform::cell_clock::CellClock;
use crate::platform::clock;
use crate::telemetry::counters::Counters;
use crate::transport::broker::BrokerHealth;
use crate::transport::mqtt::{BrokerAddress, DataPlane, LinkState, Security};

/// Data from which a node's readiness is determined; reading it does not block other parts.
#[derive(Debug, Clone)]
pub struct Vitals {
    /// The newest of everything.
    pub newest: Newest,
    /// The leadership, as it changes.
    pub leadership: watch::Receiver<Leadership>,
    /// The cell's time, shared by the node's actors.
    pub clock: CellClock,
    /// Which brokers carry the data.
    pub plane: DataPlane,
    /// The settings that the nodes of the cell share.
    pub shared: watch::Receiver<SharedFacts>,
    /// The node's certificates, which are valid at certain times only.
    pub security: Security,
    /// Contains the node's current troubles.
    pub counters: Arc<Counters>,
    /// Provides the state of reports.
    pub fuser: ActorSlot<FuserMessage>,
    /// Provides the state of links.
    pub gateway: ActorSlot<GatewayMessage>,
    /// Reports whether the node's own broker serves.
    pub broker: ActorSlot<BrokerMessage>,
}

/// Settings that the nodes of a cell share, as far as pages and readiness use them.
#[derive(Debug, Clone)]
pub struct SharedFacts {
    /// Maximum age of the newest round of a live aggregator; `None` if rounds arrive only with
    /// reports.
    pub patience: Option<Duration>,
    /// Maximum time between two rounds of a live aggregator, in seconds.
    pub round_period_s: f64,
    /// The algorithms that the cell runs.
    pub algorithms: Algorithms,
    /// All landmarks of the cell.
    pub landmarks: Arc<[LandmarkConfig]>,
    /// Projects the boxes of programs.
    pub boxes: Arc<BoxProjector>,
    /// The place of the cell's frame on Earth.
    pub origin: Option<GeographicOrigin>,
    /// True if the node does not use the cell's description.
    pub contradicts: bool,
    /// The reason why the node does not use the cell's description, or does not report.
    pub problem: Option<String>,
}

/// Answers of the gateway and the broker.
#[derive(Debug, Clone, Default)]
pub struct Probe {
    /// States of the links; `None` if the gateway did not answer.
    pub links: Option<BTreeMap<BrokerAddress, LinkState>>,
    /// True if the node's own broker serves.
    pub broker_serves: bool,
    /// Vehicles whose reports are usable by their time, and others.
    pub timeliness: Timeliness,
}

/// Possible cause of the node's separation from its cell, as text.
fn separating(troubles: &[Trouble]) -> Option<&str> {
    let kind = |trouble: &&Trouble| {
        TroubleKind::named(&trouble.kind).is_some_and(TroubleKind::is_separating)
    };
    troubles
        .iter()
        .find(kind)
        .map(|trouble| trouble.cause.as_str())
}

/// The node's own trouble that prevents it from working, as text.
fn disabling(troubles: &[Trouble]) -> Option<String> {
    let kind = |trouble: &&Trouble| {
        TroubleKind::named(&trouble.kind).is_some_and(TroubleKind::is_disabling)
    };
    troubles
        .iter()
        .filter(|trouble| trouble.about.is_none())
        .find(kind)
        .map(|trouble| trouble.cause.clone())
}

/// Maximum age of the newest round of a live aggregator; `None` for VOTE's `paper` mode alone,
/// which closes a round whenever the vehicles have sent a packet of frames.
pub fn patience(fusion: &FusionConfig) -> Option<Duration> {
    let by_packets = !fusion.algorithms.pace() && fusion.vote.mode == VoteMode::Paper;
    (!by_packets).then(|| round_timeout(Duration::from_secs_f64(fusion.round.period_s)))
}

impl Vitals {
    /// Queries the state of the parts.
    pub async fn probe(&self) -> Probe {
        let (health, links, timeliness) = tokio::join!(
            self.broker
                .ask(|reply| BrokerMessage::Health { reply }, READINESS_STEPS),
            self.gateway
                .ask(|reply| GatewayMessage::Links { reply }, READINESS_STEPS),
            self.fuser
                .ask(|reply| FuserMessage::Timeliness { reply }, READINESS_STEPS),
        );
        let broker_serves = matches!(health, Some(BrokerHealth::Serving(_)));
        Probe {
            broker_serves,
            links,
            timeliness: timeliness.unwrap_or_default(),
        }
    }

    /// Current readiness of the node, given the answers of its parts.
    pub fn readiness(&self, probe: &Probe) -> Readiness {
        let leadership = self.leadership.borrow().clone();
        if let Some(fault) = self.security.clock_fault() {
            return Readiness::not(fault);
        }
        let Timeliness { timely, untimely } = probe.timeliness;
        let vehicles = timely + untimely;
        let trouble = format!(
            "leading, but the times of {untimely} of {vehicles} vehicles' reports are unusable"
        );
        if leadership.is_leading() && !probe.timeliness.is_usable() {
            return Readiness::not(trouble);
        }
        // The reports of a cell's only vehicle do not depose its leader.
        let lone = Some(trouble).filter(|_| leadership.is_leading() && timely == 0 && untimely > 0);
        let SharedFacts {
            patience, problem, ..
        } = self.shared.borrow().clone();
        let works = self.broker_works(probe);
        let troubles = self.counters.troubles().present();
        Readiness::judge(
            &leadership,
            self.last_round().as_ref(),
            works,
            patience,
            clock::now(),
        )
        .because(separating(&troubles))
        .unless(problem.or(lone).or_else(|| disabling(&troubles)))
    }

    /// True if a broker carries the messages that this node publishes.
    fn broker_works(&self, probe: &Probe) -> bool {
        let up = |broker| {
            probe.links.as_ref().and_then(|links| links.get(broker)) == Some(&LinkState::Up)
        };
        self.plane.external.as_ref().is_some_and(up) || (self.plane.embedded && probe.broker_serves)
    }

    /// The newest accepted round: its epoch and time of receipt.
    fn last_round(&self) -> Option<(Epoch, Timestamp)> {
        newest_round(
            self.newest.map.borrow().as_ref(),
            self.newest.verdicts.borrow().as_ref(),
        )
    }
}

/// The epoch and time of receipt of the newest round, which may be a map or verdicts.
pub fn newest_round(
    map: Option<&ReceivedMap>,
    verdicts: Option<&Received<Verdicts>>,
) -> Option<(Epoch, Timestamp)> {
    let map = map.map(|received| {
        (
            Epoch::new(received.map.epoch, received.map.aggregator.clone()),
            received.received_at,
        )
    });
    let verdicts = verdicts.map(|received| {
        let verdicts = &received.message;
        (
            Epoch::new(verdicts.epoch, verdicts.aggregator.clone()),
            received.received_at,
        )
    });
    map.into_iter()
        .chain(verdicts)
        .max_by_key(|(_, received_at)| *received_at)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn packet_rounds_are_not_awaited() {
        let mut fusion = FusionConfig::default();
        fusion.round.period_s = 1.0;
        fusion.vote.mode = VoteMode::Paper;
        assert_eq!(patience(&fusion), Some(Duration::from_secs(5)));
        fusion.algorithms = ecod::aggregator::Algorithms::Vote;
        assert_eq!(patience(&fusion), None);
    }
}
