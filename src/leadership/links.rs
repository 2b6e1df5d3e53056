//! The brokers that a node keeps links to.
//!
//! Reports go out on every link, so that the standby gets them on its own broker. The leader
//! publishes on its own broker and on the standby's. A link outlives its use by [`LINK_LINGER`].

use std::collections::BTreeSet;
use std::fmt;

use crate::leadership::address::BrokerAddress;
use crate::leadership::timers::LINK_LINGER;
use crate::model::time::Timestamp;

/// Brokers that carry a cell's reports and maps.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct DataPlane {
    /// A broker that belongs to no node and is used by all.
    pub external: Option<BrokerAddress>,
    /// True if the brokers of leader and standby are used. They always are if there is no external
    /// broker. In addition to an external broker they are used if configured, so that no switch is
    /// needed when the external broker fails or returns.
    pub embedded: bool,
}

/// State of a link to a broker.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum LinkState {
    /// Connected, subscribed, status published.
    Up,
    /// Connected, but messages are not echoed: the broker hangs, or its answers are lost.
    Stalled,
    /// Not connected; attempts continue.
    Down,
    /// Not connected because the port is closed: the broker's process has ended. Attempts continue.
    Refused,
}

impl fmt::Display for LinkState {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Up => "up",
            Self::Stalled => "stalled",
            Self::Down => "down",
            Self::Refused => "refused",
        })
    }
}

/// The brokers of leader and standby, and the node's own.
#[derive(Debug, Clone, Default, PartialEq, Eq, Hash)]
pub struct Brokers {
    /// The node's own broker.
    pub own: Option<BrokerAddress>,
    /// Broker of the leader; `None` if its address is unavailable. While there is no leader, the
    /// last leader's broker.
    pub leader: Option<BrokerAddress>,
    /// Broker of the standby; `None` without a standby, or if its address is unavailable.
    pub standby: Option<BrokerAddress>,
    /// Brokers at which the node could not log in when they were used: it tries on.
    pub missing: Vec<BrokerAddress>,
}

/// The links that a gateway is to keep.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct WantedLinks {
    /// All brokers to be linked to.
    pub brokers: Vec<BrokerAddress>,
    /// The subset of brokers whose reports a candidate receives, because vehicles send their
    /// reports to each of these brokers.
    pub report_brokers: Vec<BrokerAddress>,
}

/// The wanted links, and links that are kept a little longer.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct Links {
    plane: DataPlane,
    present: Brokers,
    /// Brokers no longer in use, with the time until which their links are kept.
    lingering: Vec<(BrokerAddress, Timestamp)>,
    wanted: BTreeSet<BrokerAddress>,
}

impl Links {
    /// Creates the links of a node that uses no broker yet.
    pub fn new(plane: DataPlane) -> Self {
        Self {
            plane,
            present: Brokers::default(),
            lingering: Vec::new(),
            wanted: BTreeSet::new(),
        }
    }

    /// Updates the brokers currently in use; returns the links to keep if they have changed.
    pub fn update(&mut self, brokers: Brokers, now: Timestamp) -> Option<WantedLinks> {
        let is_expired = self.lingering.iter().any(|(_, until)| *until <= now);
        if brokers == self.present && !is_expired && !self.wanted.is_empty() {
            return None;
        }
        if brokers != self.present {
            let left = [self.present.leader.take(), self.present.standby.take()]
                .into_iter()
                .flatten();
            self.lingering
                .extend(left.map(|broker| (broker, now + LINK_LINGER)));
            self.present = brokers;
        }
        self.lingering.retain(|(_, until)| *until > now);
        let mut wanted: BTreeSet<_> = self.plane.external.iter().cloned().collect();
        if self.plane.embedded {
            let Brokers {
                own,
                leader,
                standby,
                missing,
            } = &self.present;
            wanted.extend(
                [own, leader, standby]
                    .into_iter()
                    .flatten()
                    .chain(missing)
                    .cloned(),
            );
            wanted.extend(self.lingering.iter().map(|(broker, _)| broker.clone()));
        }
        if wanted == self.wanted {
            return None;
        }
        self.wanted = wanted;
        let report_brokers = self
            .present
            .own
            .iter()
            .chain(&self.plane.external)
            .cloned()
            .collect();
        Some(WantedLinks {
            brokers: self.wanted.iter().cloned().collect(),
            report_brokers,
        })
    }

    /// Clears the wanted links, so that the next update returns them: a restarted gateway needs the
    /// whole list.
    pub fn clear_wanted(&mut self) {
        self.wanted.clear();
    }

    /// The brokers of the moment, as of the last update.
    pub fn brokers(&self) -> &Brokers {
        &self.present
    }

    /// Brokers that carry the data.
    pub fn plane(&self) -> &DataPlane {
        &self.plane
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn broker(port: u16) -> BrokerAddress {
        format!("127.0.0.1:{port}").parse().unwrap()
    }

    fn brokers(own: u16, leader: u16, standby: u16) -> Brokers {
        let [own, leader, standby] = [own, leader, standby].map(broker).map(Some);
        Brokers {
            own,
            leader,
            standby,
            missing: Vec::new(),
        }
    }

    fn at(ms: u64) -> Timestamp {
        Timestamp(ms * 1000)
    }

    fn update(links: &mut Links, brokers: Brokers, now: Timestamp) -> Option<Vec<BrokerAddress>> {
        links.update(brokers, now).map(|wanted| wanted.brokers)
    }

    #[test]
    fn link_survives_leader_change_briefly() {
        let mut links = Links::new(DataPlane {
            external: None,
            embedded: true,
        });
        assert_eq!(
            update(&mut links, brokers(3, 1, 2), at(0)),
            Some(vec![broker(1), broker(2), broker(3)])
        );
        assert_eq!(
            update(&mut links, brokers(3, 2, 3), at(100)),
            None,
            "the old leader's is kept"
        );
        assert_eq!(
            update(&mut links, brokers(3, 2, 3), at(2200)),
            Some(vec![broker(2), broker(3)])
        );
        links.clear_wanted();
        assert_eq!(
            update(&mut links, brokers(3, 2, 3), at(2300)),
            Some(vec![broker(2), broker(3)])
        );
    }

    #[test]
    fn external_broker_is_exclusive_or_additional() {
        let external = Some(broker(9));
        let mut alone = Links::new(DataPlane {
            external: external.clone(),
            embedded: false,
        });
        assert_eq!(
            update(&mut alone, brokers(3, 1, 2), at(0)),
            Some(vec![broker(9)])
        );
        assert_eq!(update(&mut alone, brokers(3, 2, 3), at(1)), None);
        let mut beside = Links::new(DataPlane {
            external,
            embedded: true,
        });
        assert_eq!(
            update(&mut beside, brokers(2, 1, 2), at(0)),
            Some(vec![broker(1), broker(2), broker(9)])
        );
    }

    #[test]
    fn embedded_and_external_brokers_supply_reports() {
        let mut links = Links::new(DataPlane {
            external: Some(broker(9)),
            embedded: true,
        });
        let wanted = links.update(brokers(3, 1, 2), at(0)).unwrap();
        assert_eq!(wanted.report_brokers, [broker(3), broker(9)]);
    }
}
