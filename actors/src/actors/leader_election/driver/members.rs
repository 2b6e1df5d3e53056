//! The members of the cell as the election's driver keeps them: where they and their brokers are, or were a moment ago.

use std::time::Duration;

use ecod::names::NodeName;

use super::ElectionDriver;
use crate::platform::clock;
use crate::transport::gossip::{Member, is_of_this_machine};
use crate::transport::mqtt::BrokerAddress;

/// How long after a node was given up the end of its broker may still be on its way.
const DEPARTURE: Duration = Duration::from_secs(5);

/// How long a membership started anew may take to find the others again.
const RETURN_PATIENCE: Duration = Duration::from_secs(2);

impl ElectionDriver {
    /// Notes a member, and whether it is on this machine.
    pub(super) fn place(&mut self, member: Member) {
        if is_of_this_machine(member.gossip.ip()) {
            self.elsewhere.remove(&member.name);
        } else {
            self.elsewhere.insert(member.name.clone());
        }
        self.members.insert(member.name.clone(), member);
    }

    /// Members that a membership started anew has not found again.
    pub(super) fn long_missing(&mut self, found: &[Member]) -> Vec<NodeName> {
        let is_found = |name: &&NodeName| found.iter().any(|member| member.name == **name);
        let missing: Vec<_> = self.members.keys().filter(|name| !is_found(name)).cloned().collect();
        if missing.is_empty() {
            self.missing_since = None;
            return missing;
        }
        let now = clock::now();
        let since = *self.missing_since.get_or_insert(now);
        if now.since(since) < RETURN_PATIENCE { Vec::new() } else { missing }
    }

    /// Whose broker is, or was a moment ago, at this address.
    pub(super) fn nodes_at(&self, broker: &BrokerAddress) -> Vec<NodeName> {
        let now = clock::now();
        let there = self.members.values().filter_map(|member| Some((&member.name, member.broker?.into())));
        let departed =
            self.departed.iter().filter(|(name, (_, until))| now < *until && !self.members.contains_key(*name));
        let departed = departed.map(|(name, (broker, _))| (name, broker.clone()));
        there.chain(departed).filter(|(_, at)| at == broker).map(|(name, _)| name.clone()).collect()
    }

    /// Forgets a member, but not at once where its broker was: that may end a moment later.
    pub(super) fn part_with(&mut self, name: &NodeName) {
        let now = clock::now();
        self.departed.retain(|_, (_, until)| now < *until);
        self.elsewhere.remove(name);
        if let Some(broker) = self.members.remove(name).and_then(|member| member.broker) {
            self.departed.insert(name.clone(), (broker.into(), now + DEPARTURE));
        }
    }

    /// Whether the members reach the broker that this node would lead with; the first time that they do not is told of.
    pub(super) fn is_reached(&mut self, no_other: bool) -> bool {
        let is_private = self.own_broker.borrow().is_some_and(|broker| broker.ip().is_loopback());
        let is_reached =
            self.elsewhere.is_empty() || self.monitor.reaches_others(self.routes.plane(), is_private, no_other);
        if !is_reached && !std::mem::replace(&mut self.told_out_of_reach, true) {
            tracing::warn!(
                members = ?self.elsewhere,
                "other machines do not reach this node's broker: it does not lead; give the nodes certificates in [tls], \
                 or set broker.allow_plaintext, or an external mqtt.broker that is there"
            );
        }
        is_reached
    }
}
