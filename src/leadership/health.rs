//! Health of a node's own parts, which decides whether the node is fit to lead.
//!
//! The parts are checked every [`HEALTH_PERIOD`]. Each check reads at once how often the fuser's
//! rounds fell due and how busy the machine is; broker and gateway answer later. A stall of the
//! whole node does not count as a fault of its parts.

use std::collections::BTreeMap;
use std::time::Duration;

use crate::leadership::address::BrokerAddress;
use crate::leadership::election::{AwakeClock, Health};
use crate::leadership::links::{Brokers, DataPlane, LinkState};
use crate::leadership::readiness::round_timeout;
use crate::leadership::timers::{CHECK_TOLERANCE, HEALTH_PERIOD};
use crate::model::names::NodeName;
use crate::model::time::Timestamp;

/// The latest state of the parts.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct HealthMonitor {
    links: BTreeMap<BrokerAddress, LinkState>,
    /// Nodes whose certificates the brokers have presented.
    nodes: BTreeMap<BrokerAddress, NodeName>,
    sample: HealthSample,
    /// Clock of the time during which this node was awake.
    clock: AwakeClock,
    check_at: Timestamp,
    rounds_due: u64,
    round_due_at: Option<Timestamp>,
    load_percent: u8,
}

/// The parts' answer to a check.
#[derive(Debug, Clone, Default, PartialEq, Eq, Hash)]
pub struct HealthSample {
    /// True if clients can connect to the node's own broker.
    pub broker_serves: bool,
    /// State of the gateway's links; `None` if the gateway does not answer.
    pub links: Option<BTreeMap<BrokerAddress, LinkState>>,
    /// True if the fuser runs.
    pub fuser_runs: bool,
    /// True if the fuser rejects nearly all vehicles' reports because of their timestamps.
    pub rejects_reports: bool,
    /// True if the node does not use the cell's description because its own configuration
    /// contradicts it.
    pub contradicts: bool,
    /// True if the node's certificate ends soon: other nodes then end their connections to it.
    pub certificate_ends: bool,
}

impl HealthMonitor {
    /// Creates a monitor without any results; the first check is due at once.
    pub fn new(now: Timestamp) -> Self {
        Self {
            links: BTreeMap::new(),
            nodes: BTreeMap::new(),
            sample: HealthSample::default(),
            clock: AwakeClock::new(now, CHECK_TOLERANCE),
            check_at: now,
            rounds_due: 0,
            round_due_at: None,
            load_percent: 0,
        }
    }

    /// Time of the next check of the parts.
    pub fn next_deadline(&self) -> Timestamp {
        self.check_at
    }

    /// True if the parts must be checked now; the next check is then due [`HEALTH_PERIOD`] later.
    pub fn is_due(&mut self, now: Timestamp) -> bool {
        // A clock that was set back does not postpone the check.
        self.check_at = self.check_at.min(now + HEALTH_PERIOD);
        let is_due = now >= self.check_at;
        if is_due {
            self.check_at = now + HEALTH_PERIOD;
        }
        is_due
    }

    /// Records the state of a link. Returns true if an established link has broken and its broker's
    /// port is closed.
    pub fn record_link(&mut self, broker: &BrokerAddress, state: LinkState) -> bool {
        match state {
            // A closed port has not been confirmed yet.
            LinkState::Down | LinkState::Stalled => {
                self.links
                    .entry(broker.clone())
                    .and_modify(|known| *known = state);
                false
            }
            LinkState::Up => {
                self.links.insert(broker.clone(), state);
                false
            }
            LinkState::Refused => self.links.remove(broker).is_some(),
        }
    }

    /// Records which node's certificate a broker presented.
    pub fn record_node(&mut self, broker: BrokerAddress, node: NodeName) {
        self.nodes.insert(broker, node);
    }

    /// Removes all links, because a restarted gateway connects anew.
    pub fn drop_links(&mut self) {
        self.drop_links_except(&[]);
    }

    /// Removes the links to all brokers except `wanted`: the gateway closes them and may reopen
    /// them later.
    pub fn drop_links_except(&mut self, wanted: &[BrokerAddress]) {
        self.links.retain(|broker, _| wanted.contains(broker));
        self.nodes.retain(|broker, _| wanted.contains(broker));
    }

    /// Records the parts' answers. They also contain links that came up before the monitor received
    /// events.
    pub fn record_sample(&mut self, sample: HealthSample) {
        for (broker, state) in sample.links.iter().flatten() {
            match state {
                LinkState::Up | LinkState::Stalled => {
                    self.links.insert(broker.clone(), *state);
                }
                // A refused link is reported separately, and the report may still be in transit.
                LinkState::Down | LinkState::Refused => {
                    self.links
                        .entry(broker.clone())
                        .and_modify(|known| *known = LinkState::Down);
                }
            }
        }
        self.sample = sample;
    }

    /// Records a check: how often a round has been due so far, and the processor load in percent.
    pub fn record_load(&mut self, rounds_due: u64, load_percent: u8, now: Timestamp) {
        let due = self.clock.now() + HEALTH_PERIOD;
        let now = self.clock.advance(now, due);
        if rounds_due != self.rounds_due {
            self.rounds_due = rounds_due;
            self.round_due_at = Some(now);
        }
        self.load_percent = load_percent;
    }

    /// Health of the parts, for the election. A node needs the external broker or its own broker,
    /// depending on which of them it uses; if it uses both, one is enough. A stalled link does not
    /// count as a link, rejected reports do not count as usable, and own settings that contradict
    /// the cell's, or a certificate that ends soon, do not count as valid. A leader with `no_other`
    /// candidate ignores all of this, because stepping down would leave the cell without a leader.
    pub fn health(
        &self,
        plane: &DataPlane,
        brokers: &Brokers,
        no_other: bool,
        round_period: Duration,
    ) -> Health {
        let external = self.is_up(plane.external.as_ref(), no_other);
        let embedded = plane.embedded && self.sample.broker_serves;
        let timeout = round_timeout(round_period);
        let closes_rounds = self
            .round_due_at
            .is_some_and(|at| self.clock.now().since(at) < timeout);
        Health {
            broker: external || embedded,
            fuser: self.sample.fuser_runs && closes_rounds,
            gateway: self.sample.links.is_some()
                && (external || (embedded && self.is_up(brokers.own.as_ref(), no_other))),
            reports: no_other || !self.sample.rejects_reports,
            settings: no_other || !(self.sample.contradicts || self.sample.certificate_ends),
            load_percent: self.load_percent,
        }
    }

    /// True if members on other machines can reach this node: by its own broker, unless it is
    /// `private` to this machine, or by an external broker while there is a link to it.
    pub fn reaches_others(&self, plane: &DataPlane, private: bool, no_other: bool) -> bool {
        !private || self.is_up(plane.external.as_ref(), no_other)
    }

    /// True if this node is logged in at a broker.
    pub fn is_logged_in(&self, broker: &BrokerAddress) -> bool {
        matches!(
            self.links.get(broker),
            Some(LinkState::Up | LinkState::Stalled)
        )
    }

    /// True if this node is logged in at a node's broker and that broker has not presented another
    /// node's certificate.
    pub fn is_logged_in_at(&self, node: &NodeName, broker: &BrokerAddress) -> bool {
        self.is_logged_in(broker) && self.nodes.get(broker).is_none_or(|shown| shown == node)
    }

    fn is_up(&self, broker: Option<&BrokerAddress>, no_other: bool) -> bool {
        match broker.and_then(|broker| self.links.get(broker)) {
            Some(LinkState::Up) => true,
            Some(LinkState::Stalled) => no_other,
            Some(LinkState::Down | LinkState::Refused) | None => false,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const PERIOD: Duration = Duration::from_millis(100);

    fn address(port: u16) -> BrokerAddress {
        format!("127.0.0.1:{port}").parse().unwrap()
    }

    fn sample(links: Option<BTreeMap<BrokerAddress, LinkState>>) -> HealthSample {
        HealthSample {
            broker_serves: true,
            links,
            fuser_runs: true,
            rejects_reports: false,
            contradicts: false,
            certificate_ends: false,
        }
    }

    /// Creates a monitor of parts that have answered and have closed a round.
    fn monitor(now: Timestamp) -> HealthMonitor {
        let mut monitor = HealthMonitor::new(now);
        monitor.record_sample(sample(Some(BTreeMap::new())));
        monitor.record_load(1, 0, now);
        monitor
    }

    #[test]
    fn only_broken_established_link_proves_death() {
        let mut monitor = HealthMonitor::new(Timestamp(0));
        let broker = address(1);
        assert!(
            !monitor.record_link(&broker, LinkState::Refused),
            "never reached"
        );
        assert!(!monitor.record_link(&broker, LinkState::Up));
        assert!(!monitor.record_link(&broker, LinkState::Down));
        assert!(monitor.record_link(&broker, LinkState::Refused));
        assert!(
            !monitor.record_link(&broker, LinkState::Refused),
            "reported once"
        );
    }

    #[test]
    fn fit_node_has_broker_and_rounds() {
        let now = Timestamp(60_000_000);
        let mut monitor = monitor(now);
        let plane = DataPlane {
            external: None,
            embedded: true,
        };
        let brokers = Brokers {
            own: Some(address(1)),
            ..Brokers::default()
        };
        assert!(
            !monitor.health(&plane, &brokers, false, PERIOD).is_fit(),
            "no link to its own broker yet"
        );
        monitor.record_link(&address(1), LinkState::Up);
        assert!(monitor.health(&plane, &brokers, false, PERIOD).is_fit());
        for checks in 1..=12 {
            monitor.record_load(1, 0, now + HEALTH_PERIOD * checks);
        }
        assert!(
            !monitor.health(&plane, &brokers, false, PERIOD).fuser,
            "no rounds"
        );
        monitor.record_link(&address(1), LinkState::Down);
        assert!(!monitor.health(&plane, &brokers, false, PERIOD).gateway);
    }

    #[test]
    fn stopped_node_blames_no_fuser() {
        let now = Timestamp(60_000_000);
        let mut monitor = monitor(now);
        let fuser = |monitor: &HealthMonitor| {
            let plane = DataPlane {
                external: None,
                embedded: true,
            };
            monitor
                .health(&plane, &Brokers::default(), false, PERIOD)
                .fuser
        };
        monitor.record_load(1, 0, now + Duration::from_secs(10));
        assert!(
            fuser(&monitor),
            "the look may come before the fuser's next round"
        );
        let after = |ms| now + Duration::from_secs(10) + Duration::from_millis(ms);
        (1..=8).for_each(|checks| monitor.record_load(1, 0, after(250 * checks)));
        assert!(!fuser(&monitor), "the fuser had its time");
        monitor.record_load(2, 0, after(2250));
        assert!(fuser(&monitor));
    }

    #[test]
    fn unfit_leader_yields_to_alternative() {
        let plane = DataPlane {
            external: None,
            embedded: true,
        };
        let brokers = Brokers {
            own: Some(address(1)),
            ..Brokers::default()
        };
        for fault in 0..3 {
            let mut monitor = monitor(Timestamp(60_000_000));
            let links = Some(BTreeMap::from([(address(1), LinkState::Up)]));
            monitor.record_sample(HealthSample {
                rejects_reports: fault == 0,
                contradicts: fault == 1,
                certificate_ends: fault == 2,
                ..sample(links)
            });
            assert!(!monitor.health(&plane, &brokers, false, PERIOD).is_fit());
            assert!(
                monitor.health(&plane, &brokers, true, PERIOD).is_fit(),
                "no other node could lead better"
            );
        }
    }

    #[test]
    fn unnoticed_link_is_found_by_query() {
        let now = Timestamp(60_000_000);
        let mut monitor = monitor(now);
        let plane = DataPlane {
            external: None,
            embedded: true,
        };
        let brokers = Brokers {
            own: Some(address(1)),
            ..Brokers::default()
        };
        let links = |state| Some(BTreeMap::from([(address(1), state)]));
        let answer = |state| sample(links(state));
        monitor.record_sample(answer(LinkState::Up));
        assert!(monitor.health(&plane, &brokers, false, PERIOD).is_fit());
        monitor.record_sample(answer(LinkState::Down));
        assert!(!monitor.health(&plane, &brokers, false, PERIOD).is_fit());
        assert!(
            monitor.record_link(&address(1), LinkState::Refused),
            "its end is still news"
        );
    }

    #[test]
    fn nonrelaying_broker_is_unfit_with_alternative() {
        let now = Timestamp(60_000_000);
        let mut monitor = monitor(now);
        let brokers = Brokers {
            own: Some(address(1)),
            ..Brokers::default()
        };
        monitor.record_link(&address(1), LinkState::Up);
        let fit = |monitor: &HealthMonitor, no_other| {
            let plane = DataPlane {
                external: None,
                embedded: true,
            };
            monitor.health(&plane, &brokers, no_other, PERIOD).is_fit()
        };
        assert!(fit(&monitor, false));
        assert!(!monitor.record_link(&address(1), LinkState::Stalled));
        assert_eq!((fit(&monitor, false), fit(&monitor, true)), (false, true));
        monitor.record_link(&address(1), LinkState::Down);
        assert!(!fit(&monitor, true));
        monitor.record_link(&address(1), LinkState::Stalled);
        assert!(
            monitor.record_link(&address(1), LinkState::Refused),
            "its end is still news"
        );
    }

    #[test]
    fn external_broker_substitutes_if_connected() {
        let mut monitor = HealthMonitor::new(Timestamp(0));
        let plane = DataPlane {
            external: Some(address(9)),
            embedded: true,
        };
        let reaches =
            |monitor: &HealthMonitor, private| monitor.reaches_others(&plane, private, false);
        assert_eq!(
            (reaches(&monitor, true), reaches(&monitor, false)),
            (false, true),
            "never reached"
        );
        for (state, reached) in [
            (LinkState::Up, true),
            (LinkState::Stalled, false),
            (LinkState::Down, false),
        ] {
            monitor.record_link(&address(9), state);
            assert_eq!(reaches(&monitor, true), reached, "{state:?}");
        }
    }

    #[test]
    fn unused_broker_is_no_login() {
        let mut monitor = HealthMonitor::new(Timestamp(0));
        monitor.record_link(&address(1), LinkState::Up);
        monitor.record_link(&address(2), LinkState::Up);
        monitor.drop_links_except(&[address(2)]);
        assert_eq!(
            (
                monitor.is_logged_in(&address(1)),
                monitor.is_logged_in(&address(2))
            ),
            (false, true)
        );
    }

    #[test]
    fn external_or_embedded_link_counts() {
        let now = Timestamp(60_000_000);
        let mut monitor = monitor(now);
        let brokers = Brokers {
            own: Some(address(1)),
            ..Brokers::default()
        };
        monitor.record_link(&address(1), LinkState::Up);
        let fit = |monitor: &HealthMonitor, embedded| {
            let plane = DataPlane {
                external: Some(address(9)),
                embedded,
            };
            monitor.health(&plane, &brokers, false, PERIOD).is_fit()
        };
        assert!(!fit(&monitor, false));
        assert!(fit(&monitor, true), "falls back to its own");
        monitor.record_link(&address(9), LinkState::Up);
        assert!(fit(&monitor, false));
    }
}
