//! The members of the cell: the current and recent addresses of their machines and brokers.

use std::collections::BTreeMap;

use crate::leadership::address::BrokerAddress;
use crate::leadership::node::SeenMember;
use crate::leadership::timers::{DEPARTED_TIME, REDISCOVERY_TIME};
use crate::model::names::NodeName;
use crate::model::time::Timestamp;

/// The living members, and recently removed members.
#[derive(Debug, Clone, Default, PartialEq, Eq, Hash)]
pub(super) struct Members {
    living: BTreeMap<NodeName, SeenMember>,
    /// Brokers of nodes that were given up, and until when their end proves these nodes gone.
    departed: BTreeMap<NodeName, (BrokerAddress, Timestamp)>,
    /// Time since when a restarted membership has not found a member again.
    missing_since: Option<Timestamp>,
}

impl Members {
    /// Records a living member.
    pub(super) fn place(&mut self, member: SeenMember) {
        self.living.insert(member.name.clone(), member);
    }

    /// Removes a member. The address of its broker is kept for a while, because that broker's end
    /// may be noticed a moment later.
    pub(super) fn member_down(&mut self, name: &NodeName, now: Timestamp) {
        self.departed.retain(|_, (_, until)| now < *until);
        if let Some(broker) = self.living.remove(name).and_then(|member| member.broker) {
            self.departed
                .insert(name.clone(), (broker, now + DEPARTED_TIME));
        }
    }

    /// True if this run of a member is already stored.
    pub(super) fn contains(&self, member: &SeenMember) -> bool {
        self.living
            .get(&member.name)
            .is_some_and(|known| known.run == member.run)
    }

    /// Members that a restarted membership has not found again in [`REDISCOVERY_TIME`].
    pub(super) fn long_missing(&mut self, found: &[SeenMember], now: Timestamp) -> Vec<NodeName> {
        let is_found = |name: &&NodeName| found.iter().any(|member| member.name == **name);
        let missing: Vec<_> = self
            .living
            .keys()
            .filter(|name| !is_found(name))
            .cloned()
            .collect();
        if missing.is_empty() {
            self.missing_since = None;
            return missing;
        }
        let since = *self.missing_since.get_or_insert(now);
        if now.since(since) < REDISCOVERY_TIME {
            Vec::new()
        } else {
            missing
        }
    }

    /// The run of a living member.
    pub(super) fn run_of(&self, name: &NodeName) -> Option<u64> {
        self.living.get(name).map(|member| member.run)
    }

    /// The broker of a living member.
    pub(super) fn broker_of(&self, name: &NodeName) -> Option<BrokerAddress> {
        self.living.get(name)?.broker.clone()
    }

    /// Nodes whose broker is or recently was at this address.
    pub(super) fn at(&self, broker: &BrokerAddress, now: Timestamp) -> Vec<NodeName> {
        let living = self
            .living
            .values()
            .filter_map(|member| Some((&member.name, member.broker.as_ref()?)));
        let departed = self
            .departed
            .iter()
            .filter(|(name, (_, until))| now < *until && !self.living.contains_key(*name))
            .map(|(name, (broker, _))| (name, broker));
        living
            .chain(departed)
            .filter(|(_, at)| *at == broker)
            .map(|(name, _)| name.clone())
            .collect()
    }

    /// Members on other machines, which do not reach a broker on this one's loopback.
    pub(super) fn elsewhere(&self) -> impl Iterator<Item = &NodeName> {
        self.living
            .values()
            .filter(|member| !member.is_on_this_machine)
            .map(|member| &member.name)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(ms: u64) -> Timestamp {
        Timestamp(ms * 1000)
    }

    fn member(name: &'static str, port: u16) -> SeenMember {
        let broker = Some(format!("10.0.0.1:{port}").parse().unwrap());
        SeenMember {
            name: NodeName::from_static(name),
            run: 1,
            broker,
            is_on_this_machine: false,
        }
    }

    #[test]
    fn removed_brokers_end_is_recognised() {
        let mut members = Members::default();
        let edge = member("edge", 1);
        let broker = "10.0.0.1:1".parse().unwrap();
        members.place(edge.clone());
        assert_eq!(members.at(&broker, at(0)), std::slice::from_ref(&edge.name));
        members.member_down(&edge.name, at(0));
        assert_eq!(
            members.at(&broker, at(4999)),
            std::slice::from_ref(&edge.name)
        );
        assert_eq!(members.at(&broker, at(5000)), []);
    }

    #[test]
    fn restarted_membership_has_grace() {
        let mut members = Members::default();
        members.place(member("edge", 1));
        members.place(member("gauss", 2));
        let found = [member("gauss", 2)];
        assert_eq!(members.long_missing(&[], at(0)), []);
        assert_eq!(members.long_missing(&found, at(1999)), []);
        assert_eq!(
            members.long_missing(&found, at(2000)),
            [NodeName::from_static("edge")]
        );
    }
}
