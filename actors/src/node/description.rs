//! The cell's description at a node: with which one it starts, and what a change means for its parts.

use std::sync::Arc;

use ecod::leadership::node::Input;
use ecod::vote::VoteMode;
use ecod::wire::{CellDescription, DescriptionStatus, Limits, Payload, SCHEMA_VERSION};

use super::builder::NodeBuilder;
use super::config::NodeConfig;
use super::{ActorKind, NodeError};
use crate::messages::fuser::FuserMessage;
use crate::messages::leader_election::LeaderElectionMessage;
#[cfg(feature = "camera")]
use crate::messages::projector::ProjectorMessage;
use crate::messages::reputation_keeper::ReputationKeeperMessage;
use crate::observe::readiness::{SharedFacts, patience};
use crate::platform::content_hash::{content_hash, is_intact};
use crate::platform::state_file::StateFile;

/// Longest reason in a status, in bytes.
const MAX_PROBLEM_BYTES: usize = 1024;

/// The description that a node has.
#[derive(Debug, Clone, Default)]
pub(super) struct HeldDescription {
    pub(super) description: Option<Arc<CellDescription>>,
    /// The reason why the node does not use it.
    pub(super) problem: Option<String>,
}

impl HeldDescription {
    /// The one of an earlier run, or else of the file with which a node that may lead starts its cell.
    ///
    /// # Errors
    /// When that file cannot be used.
    pub(super) fn at_start(config: &NodeConfig) -> Result<Self, NodeError> {
        let saved = description_file(config).and_then(|file| {
            file.load(|saved: &CellDescription| {
                saved.schema == SCHEMA_VERSION && saved.check(&Limits::default()).is_ok() && is_intact(saved)
            })
        });
        let Some(path) = config.description.as_ref().filter(|_| config.may_lead()) else {
            return Ok(Self { description: saved.map(Arc::new), problem: None });
        };
        let text = std::fs::read_to_string(path)
            .map_err(|error| NodeError::Failed(format!("key `description`: {}: {error}", path.display())))?;
        if let Some(saved) = saved {
            if saved.text != text {
                let (path, version) = (path.display(), saved.version);
                tracing::info!(%path, version, "the cell has a description, and not that file's: see `ecod-node cell diff`");
            }
            return Ok(Self { description: Some(Arc::new(saved)), problem: None });
        }
        let Some(set_by) = config.name.clone() else { return Ok(Self::default()) };
        let hash = content_hash(&set_by, &text);
        let description = CellDescription { schema: SCHEMA_VERSION, version: 1, hash, set_by, text };
        Ok(Self { description: Some(Arc::new(description)), problem: None })
    }

    /// Its entry in the node's status.
    pub(super) fn status(&self) -> Option<DescriptionStatus> {
        let held = self.description.as_ref()?;
        Some(DescriptionStatus { version: held.version, hash: held.hash, problem: self.problem.clone() })
    }
}

/// Where a node keeps the cell's description, if it keeps anything.
pub(super) fn description_file(config: &NodeConfig) -> Option<StateFile> {
    let (directory, name) = (config.state_dir.as_deref()?, config.name.as_ref()?);
    Some(StateFile::new(directory, &config.cell, name, "description"))
}

/// Whether reputations follow from evidence, and not from VOTE's `paper` mode.
pub(super) fn rates_by_evidence(config: &NodeConfig) -> bool {
    config.fusion.vote.mode != VoteMode::Paper || !config.fusion.algorithms.vote()
}

/// The shared settings that pages and readiness go by.
pub(super) fn shared_facts(config: &NodeConfig, held: &HeldDescription) -> SharedFacts {
    SharedFacts {
        patience: patience(&config.fusion),
        round_period_s: config.fusion.round.period_s,
        landmarks: config.landmarks.clone().into(),
        problem: held.problem.clone(),
    }
}

impl NodeBuilder {
    /// Uses a description from now on. One that contradicts the node's own configuration, or that this version cannot read,
    /// is kept and passed on, and the node goes on with the settings that it has.
    pub(super) fn describe(&mut self, description: Arc<CellDescription>) {
        let stamp = description.stamp();
        let described = self.own_config.described(&description.text);
        let problem = described.as_ref().err().map(|error| {
            let text = format!("description {stamp} of the cell is not used: {error}");
            text.chars()
                .scan(0, |bytes, c| {
                    *bytes += c.len_utf8();
                    (*bytes <= MAX_PROBLEM_BYTES).then_some(c)
                })
                .collect::<String>()
        });
        self.held = HeldDescription { description: Some(Arc::clone(&description)), problem };
        match described {
            Ok(config) => {
                let before = std::mem::replace(&mut self.config, config);
                self.configure_parts(&before);
                tracing::info!(%stamp, "the description of the cell is used");
            }
            Err(error) => tracing::error!(%stamp, %error, "the description of the cell is not used"),
        }
        self.door.publish_description(&description);
        self.shared.send_replace(shared_facts(&self.config, &self.held));
        let input = Input::Described {
            description: self.held.status(),
            round_period: self.round_period(),
            keeps_reputations: self.parts().contains(&ActorKind::ReputationKeeper),
        };
        self.slots().election.send(LeaderElectionMessage::Note { input });
    }

    /// Tells the parts of settings that are others than `before`.
    fn configure_parts(&self, before: &NodeConfig) {
        let (config, slots) = (&self.config, self.slots());
        self.reputations.set_by_evidence(rates_by_evidence(config));
        if before.fusion.reputation != config.fusion.reputation {
            let reputation = config.fusion.reputation.clone();
            slots.keeper.send(ReputationKeeperMessage::Configure { reputation });
        }
        if (&before.fusion, &before.landmarks) != (&config.fusion, &config.landmarks) {
            let (fusion, landmarks) = (Box::new(config.fusion.clone()), config.landmarks.clone());
            slots.fuser.send(FuserMessage::Configure { fusion, landmarks });
            // What was switched on starts with the evidence that there is.
            let ledger = Arc::new(self.reputations.open().ledger.clone());
            slots.fuser.send(FuserMessage::Adopt { ledger });
        }
        #[cfg(feature = "camera")]
        if config.camera.is_some() {
            match super::camera::perception(config) {
                Ok(perception) => {
                    let (perception, algorithms) = (Box::new(perception), super::camera::algorithms(config));
                    slots.projector.send(ProjectorMessage::Configure { perception, algorithms });
                }
                Err(error) => {
                    tracing::error!(error = format!("{error:#}"), "the camera goes on with the settings before")
                }
            }
        }
    }
}
