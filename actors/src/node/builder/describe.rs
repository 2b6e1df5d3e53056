//! Change of the cell's description, as it reaches the parts of a node.

use std::sync::Arc;

use ecod::leadership::node::Input;
use ecod::wire::CellDescription;

use super::NodeBuilder;
use crate::messages::fuser::FuserMessage;
use crate::messages::leader_election::LeaderElectionMessage;
use crate::messages::reputation_keeper::ReputationKeeperMessage;
use crate::node::config::NodeConfig;
use crate::node::description::{HeldDescription, rates_by_evidence, shared_facts};
use crate::node::slots::ActorKind;

impl NodeBuilder {
    /// Uses a description from now on. A description that contradicts the node's own configuration,
    /// or that this version cannot read, is stored and distributed, but the node continues with its
    /// current settings.
    pub(in crate::node) fn describe(&mut self, description: &Arc<CellDescription>) {
        self.held = HeldDescription {
            description: Some(Arc::clone(description)),
            problem: None,
        };
        if let Some(config) = self.held.lay_over(&self.own_config) {
            let before = std::mem::replace(&mut self.config, config);
            self.configure_parts(&before);
            self.check_units();
            tracing::info!(stamp = %description.stamp(), "the description of the cell is used");
        }
        self.configure_uplink();
        self.door.publish_description(description);
        self.shared
            .send_replace(shared_facts(&self.config, &self.held));
        let input = Input::Described {
            description: self.held.status(),
            round_period: self.round_period(),
            keeps_reputations: self.parts().contains(&ActorKind::ReputationKeeper),
        };
        self.slots()
            .election
            .send(LeaderElectionMessage::Record { input });
    }

    /// Records values that look as if they were in another unit.
    pub(super) fn check_units(&self) {
        let troubles = self.vehicle.counters.troubles();
        for (kind, cause) in self.config.doubtful_units() {
            match cause {
                Some(cause) => troubles.record(kind, &cause),
                None => troubles.settle(kind, None),
            }
        }
    }

    /// Sends the parts the settings that differ from `before`.
    fn configure_parts(&self, before: &NodeConfig) {
        let config = &self.config;
        let slots = self.slots();
        self.reputations.set_by_evidence(rates_by_evidence(config));
        if before.fusion.reputation != config.fusion.reputation {
            let reputation = config.fusion.reputation.clone();
            slots
                .keeper
                .send(ReputationKeeperMessage::Configure { reputation });
        }
        if (&before.fusion, &before.landmarks) != (&config.fusion, &config.landmarks) {
            let fusion = Box::new(config.fusion.clone());
            let landmarks = config.landmarks.clone();
            slots
                .fuser
                .send(FuserMessage::Configure { fusion, landmarks });
            // A part that was switched on starts with the available evidence.
            let ledger = Arc::new(self.reputations.open().ledger.clone());
            slots.fuser.send(FuserMessage::Adopt { ledger });
        }
        #[cfg(feature = "camera")]
        self.configure_cameras();
    }
}
