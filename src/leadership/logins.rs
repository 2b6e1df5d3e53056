//! Brokers at which this node should be logged in but is not.

use std::collections::BTreeMap;

use crate::leadership::election::MAX_NO_LOGIN;
use crate::leadership::timers::{HEALTH_PERIOD, LOGIN_TIMEOUT};
use crate::model::names::NodeName;

/// Number of consecutive checks after which a login counts as missing, or as restored. Checks are
/// counted instead of time, so that a node does not report a broker because of its own stall.
const CHECKS: u128 = LOGIN_TIMEOUT.as_millis() / HEALTH_PERIOD.as_millis();

/// The nodes whose brokers are used, and the nodes at whose brokers a login is missing.
#[derive(Debug, Clone, Default, PartialEq, Eq, Hash)]
pub(super) struct Logins {
    nodes: BTreeMap<NodeName, Login>,
}

#[derive(Debug, Clone, Default, PartialEq, Eq, Hash)]
struct Login {
    is_missing: bool,
    /// Number of latest checks with the opposite result.
    contrary_checks: u128,
}

impl Logins {
    /// Records a check of the used brokers and the brokers in [`Self::missing`]: whether this node
    /// is logged in at each. Returns true if the set of missing logins changed.
    pub(super) fn record(&mut self, brokers: &BTreeMap<NodeName, bool>) -> bool {
        self.nodes
            .retain(|name, login| login.is_missing || brokers.contains_key(name));
        let mut missing = self.missing().count();
        let mut has_changed = false;
        for (name, is_logged_in) in brokers {
            let login = self.nodes.entry(name.clone()).or_default();
            login.contrary_checks = if *is_logged_in == login.is_missing {
                login.contrary_checks + 1
            } else {
                0
            };
            if login.contrary_checks >= CHECKS && (login.is_missing || missing < MAX_NO_LOGIN) {
                *login = Login {
                    is_missing: !login.is_missing,
                    contrary_checks: 0,
                };
                missing = if login.is_missing {
                    missing + 1
                } else {
                    missing - 1
                };
                has_changed = true;
            }
        }
        has_changed
    }

    /// Removes a node that has left or restarted. Returns true if its login was missing.
    pub(super) fn remove(&mut self, name: &NodeName) -> bool {
        self.nodes
            .remove(name)
            .is_some_and(|login| login.is_missing)
    }

    /// Nodes at whose brokers a login is missing.
    pub(super) fn missing(&self) -> impl Iterator<Item = &NodeName> {
        self.nodes
            .iter()
            .filter(|(_, login)| login.is_missing)
            .map(|(name, _)| name)
    }

    /// True if the last check found a broker without a login that is not yet reported as missing.
    pub(super) fn is_doubtful(&self) -> bool {
        self.nodes.values().any(|login| login.contrary_checks > 0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Repeats checks of the broker of `edge` until they change the result.
    fn checks_until_change(logins: &mut Logins, is_logged_in: bool) -> Option<u128> {
        let brokers = BTreeMap::from([(NodeName::from_static("edge"), is_logged_in)]);
        (1..100).find(|_| logins.record(&brokers))
    }

    #[test]
    fn missing_login_needs_two_seconds() {
        let mut logins = Logins::default();
        assert_eq!(checks_until_change(&mut logins, false), Some(8));
        assert_eq!(logins.missing().count(), 1);
        logins.record(&BTreeMap::new());
        assert_eq!(logins.missing().count(), 1, "it is tried on");
        assert_eq!(checks_until_change(&mut logins, true), Some(8));
        assert_eq!(checks_until_change(&mut logins, true), None);
    }

    #[test]
    fn intermittent_broker_is_not_missing() {
        let mut logins = Logins::default();
        let brokers_at = |number: usize| {
            BTreeMap::from([(NodeName::from_static("edge"), number.is_multiple_of(7))])
        };
        assert!((0..100).all(|number| !logins.record(&brokers_at(number))));
    }

    #[test]
    fn missing_logins_fit_message() {
        let mut logins = Logins::default();
        let names = (0..10).map(|number| (NodeName::new(format!("n{number}")).unwrap(), false));
        let brokers = names.collect();
        assert_eq!((0..20).filter(|_| logins.record(&brokers)).count(), 1);
        assert_eq!(logins.missing().count(), MAX_NO_LOGIN);
        assert!(logins.remove(&NodeName::from_static("n0")));
    }
}
