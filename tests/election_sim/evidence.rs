//! Evidence about vehicles: recorded by leaders, replicated by shares, kept on every candidate's disk.

use std::collections::BTreeMap;

use ecod::leadership::node::Input;
use ecod::model::epoch::Epoch;
use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ecod::reputation::{Evidence, ReputationLedger};
use ecod::wire::{LedgerEntry, LedgerShare, Role};

use crate::node::Arrival;
use crate::world::{MS, World};

/// Time between two publications of reputations, in µs.
pub(crate) const PUBLISH_PERIOD: u64 = 1000 * MS;

impl World {
    /// Records what a round of a node's own leadership says about vehicles.
    pub(crate) fn judge_vehicles(&mut self, index: usize, epoch: &Epoch) {
        if self.random.chance(80) {
            return;
        }
        let vehicle = self.random.index(self.nodes.len());
        let (node, correct) = (self.nodes[vehicle].name.clone(), self.random.chance(90));
        let evidence = [Evidence { node, label: "car".into(), correct }];
        let node = &mut self.nodes[index];
        let shares = node.resync.record(epoch, &evidence, &mut node.ledger);
        *self.recorded.entry(epoch.clone()).or_default() += 1;
        self.share(index, shares);
    }

    /// Shares all that a node knows.
    pub(crate) fn share_all(&mut self, index: usize) {
        let shares = self.nodes[index].resync.snapshot(&self.nodes[index].ledger);
        self.share(index, shares);
    }

    pub(crate) fn take_share(&mut self, to: usize, share: &LedgerShare) {
        if self.nodes[to].config.role == Role::Cav {
            return;
        }
        self.handle(to, Input::EvidenceReceived { from: share.node.clone() });
        let candidates = self.candidates(to);
        let now = Timestamp(self.now).shifted(self.nodes[to].steady_clock);
        let node = &mut self.nodes[to];
        if let Ok(merged) = node.resync.merge(share, &mut node.ledger, &candidates, &node.leadership, now) {
            self.share(to, merged.shares);
        }
    }

    /// A publication period has passed.
    pub(crate) fn keep(&mut self, index: usize) {
        let now = Timestamp(self.now).shifted(self.nodes[index].steady_clock);
        let node = &mut self.nodes[index];
        node.saved.clone_from(&node.ledger);
        let shares = node.resync.tick(&node.ledger, &node.leadership, now);
        self.share(index, shares);
        self.push_to(index, PUBLISH_PERIOD, Arrival::Keep);
    }

    /// The other nodes that may lead, as a node's membership knows them.
    fn candidates(&self, of: usize) -> Vec<NodeName> {
        let members = self.nodes[of].members.keys().map(|member| &self.nodes[*member]);
        members.filter(|node| node.config.role != Role::Cav).map(|node| node.name.clone()).collect()
    }

    /// All that the living candidates know.
    pub(crate) fn known_evidence(&self) -> ReputationLedger {
        let mut all = ReputationLedger::default();
        for (_, node) in self.alive().filter(|(_, node)| node.config.role != Role::Cav) {
            all.merge(&node.ledger);
        }
        all
    }

    /// Whether no lane counts more than its leader recorded.
    pub(crate) fn nothing_is_counted_twice(&self) -> Result<(), String> {
        for (_, node) in self.alive() {
            let mut counted: BTreeMap<Epoch, u64> = BTreeMap::new();
            for LedgerEntry { epoch, aggregator, correct, incorrect, .. } in node.ledger.entries() {
                *counted.entry(Epoch::new(epoch, aggregator)).or_default() += correct + incorrect;
            }
            for (lane, counted) in counted {
                let recorded = self.recorded.get(&lane).copied().unwrap_or_default();
                if counted > recorded {
                    return Err(format!("{} counts {counted} of {recorded} votes of {lane}", node.name));
                }
            }
        }
        Ok(())
    }
}
