//! Which brokers a node keeps links to.

use std::collections::BTreeSet;
use std::time::Duration;

use ecod::time::Timestamp;

use crate::transport::mqtt::{BrokerAddress, DataPlane};

/// The brokers of the moment.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(super) struct Brokers {
    pub(super) own: Option<BrokerAddress>,
    pub(super) leader: Option<BrokerAddress>,
    pub(super) standby: Option<BrokerAddress>,
}

/// The links that are wanted, and those that are kept for a while longer.
#[derive(Debug)]
pub(super) struct Routes {
    plane: DataPlane,
    now: Brokers,
    lingering: Vec<(BrokerAddress, Timestamp)>,
    wanted: BTreeSet<BrokerAddress>,
}

/// How long a link outlives its use: a new leader serves vehicles that are not yet connected to its broker by way of
/// the old one's.
const LINGER: Duration = Duration::from_secs(2);

impl Routes {
    pub(super) fn new(plane: DataPlane) -> Self {
        Self { plane, now: Brokers::default(), lingering: Vec::new(), wanted: BTreeSet::new() }
    }

    /// All brokers to be linked to, if they are others than before.
    pub(super) fn update(&mut self, brokers: Brokers, now: Timestamp) -> Option<Vec<BrokerAddress>> {
        if brokers != self.now {
            let left = [self.now.leader.take(), self.now.standby.take()].into_iter().flatten();
            self.lingering.extend(left.map(|broker| (broker, now + LINGER)));
            self.now = brokers;
        }
        self.lingering.retain(|(_, until)| *until > now);
        let mut wanted: BTreeSet<_> = self.plane.external.iter().cloned().collect();
        if self.plane.embedded {
            let Brokers { own, leader, standby } = &self.now;
            wanted.extend([own, leader, standby].into_iter().flatten().cloned());
            wanted.extend(self.lingering.iter().map(|(broker, _)| broker.clone()));
        }
        if wanted == self.wanted {
            return None;
        }
        self.wanted = wanted;
        Some(self.wanted.iter().cloned().collect())
    }

    /// Forgets what was wanted before: the gateway does not know it.
    pub(super) fn forget(&mut self) {
        self.wanted.clear();
    }

    /// The brokers of the moment, as of the last update.
    pub(super) fn brokers(&self) -> &Brokers {
        &self.now
    }

    pub(super) fn plane(&self) -> &DataPlane {
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
        Brokers { own: Some(broker(own)), leader: Some(broker(leader)), standby: Some(broker(standby)) }
    }

    fn at(ms: u64) -> Timestamp {
        Timestamp(ms * 1000)
    }

    #[test]
    fn a_link_outlives_a_change_of_leader_for_a_while() {
        let mut routes = Routes::new(DataPlane { external: None, embedded: true });
        assert_eq!(routes.update(brokers(3, 1, 2), at(0)), Some(vec![broker(1), broker(2), broker(3)]));
        assert_eq!(routes.update(brokers(3, 2, 3), at(100)), None, "the old leader's is kept");
        assert_eq!(routes.update(brokers(3, 2, 3), at(2200)), Some(vec![broker(2), broker(3)]));
        routes.forget();
        assert_eq!(routes.update(brokers(3, 2, 3), at(2300)), Some(vec![broker(2), broker(3)]));
    }

    #[test]
    fn an_external_broker_is_used_alone_or_beside_the_others() {
        let external = Some(broker(9));
        let mut alone = Routes::new(DataPlane { external: external.clone(), embedded: false });
        assert_eq!(alone.update(brokers(3, 1, 2), at(0)), Some(vec![broker(9)]));
        assert_eq!(alone.update(brokers(3, 2, 3), at(1)), None);
        let mut beside = Routes::new(DataPlane { external, embedded: true });
        assert_eq!(beside.update(brokers(2, 1, 2), at(0)), Some(vec![broker(1), broker(2), broker(9)]));
    }
}
