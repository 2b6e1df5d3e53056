//! The cell's description on a node: the initial description, and the settings that follow from it.

use std::sync::Arc;

use ecod::perception::box_projection::BoxProjector;
use ecod::perception::landmark::LandmarkIndex;
use ecod::vote::VoteMode;
use ecod::wire::{CellDescription, DescriptionStatus, Limits, Payload, SCHEMA_VERSION};

use super::NodeError;
use super::config::NodeConfig;
use crate::observe::readiness::{SharedFacts, patience};
use crate::platform::bounded_file;
use crate::platform::content_hash::{content_hash, is_intact};
use crate::platform::state_file::StateFile;

/// The description that a node has.
#[derive(Debug, Clone, Default)]
pub(super) struct HeldDescription {
    pub(super) description: Option<Arc<CellDescription>>,
    /// The reason why the node does not use it.
    pub(super) problem: Option<String>,
}

impl HeldDescription {
    /// The description of an earlier run or, otherwise, of the file with which a node that may lead
    /// starts its cell.
    ///
    /// # Errors
    /// Returns an error if that file cannot be used.
    pub(super) fn at_start(config: &NodeConfig) -> Result<Self, NodeError> {
        let saved = description_file(config).and_then(|file| {
            file.load(|saved: &CellDescription| {
                saved.schema == SCHEMA_VERSION
                    && saved.check(&Limits::default()).is_ok()
                    && is_intact(saved)
            })
        });
        let Some(path) = config.description.as_ref().filter(|_| config.may_lead()) else {
            return Ok(Self {
                description: saved.map(Arc::new),
                problem: None,
            });
        };
        let text = bounded_file::read_text(path).map_err(|error| {
            NodeError::Failed(format!("key `description`: {}: {error}", path.display()))
        })?;
        if let Some(saved) = saved {
            if saved.text != text {
                let path = path.display();
                let version = saved.version;
                tracing::info!(%path, version, "the cell has a description, and not that file's: see `ecod-node cell diff`");
            }
            return Ok(Self {
                description: Some(Arc::new(saved)),
                problem: None,
            });
        }
        let Some(set_by) = config.name.clone() else {
            return Ok(Self::default());
        };
        config.described(&text).map_err(|error| {
            NodeError::Failed(format!("key `description`: {}: {error}", path.display()))
        })?;
        let hash = content_hash(&set_by, &text);
        let description = CellDescription {
            schema: SCHEMA_VERSION,
            version: 1,
            hash,
            set_by,
            text,
        };
        Ok(Self {
            description: Some(Arc::new(description)),
            problem: None,
        })
    }

    /// Applies the description to the node's own configuration. A description that contradicts it,
    /// or that this version cannot read, is not used, and the log and `problem` contain the reason:
    /// a description from other nodes must not stop a node, even at its start.
    pub(super) fn lay_over(&mut self, own: &NodeConfig) -> Option<NodeConfig> {
        let description = self.description.as_ref()?;
        let stamp = description.stamp();
        let set_by = &description.set_by;
        let error = match own.described(&description.text) {
            Ok(config) => return Some(config),
            Err(error) => error,
        };
        let problem =
            format!("description {stamp} of the cell, set at {set_by}, is not used: {error}");
        let shown = |character: char| {
            if character.is_control() {
                ' '
            } else {
                character
            }
        };
        let problem: String = problem.chars().map(shown).take(MAX_PROBLEM).collect();
        tracing::error!("{problem}");
        self.problem = Some(problem);
        None
    }

    /// Its entry in the node's status.
    pub(super) fn status(&self) -> Option<DescriptionStatus> {
        let held = self.description.as_ref()?;
        Some(DescriptionStatus {
            version: held.version,
            hash: held.hash,
            problem: self.problem.clone(),
        })
    }
}

/// Longest reason in a status, in characters.
const MAX_PROBLEM: usize = 500;

/// File in which a node stores the cell's description, if it keeps state.
pub(crate) fn description_file(config: &NodeConfig) -> Option<StateFile> {
    let directory = config.state_dir.as_deref()?;
    let name = config.name.as_ref()?;
    Some(StateFile::new(directory, &config.cell, name, "description"))
}

/// True if reputations follow from evidence, and not from VOTE's `paper` mode.
pub(super) fn rates_by_evidence(config: &NodeConfig) -> bool {
    config.fusion.vote.mode != VoteMode::Paper || !config.fusion.algorithms.vote()
}

/// The shared settings that pages and readiness use.
pub(super) fn shared_facts(config: &NodeConfig, held: &HeldDescription) -> SharedFacts {
    SharedFacts {
        patience: patience(&config.fusion),
        round_period_s: config.fusion.round.period_s,
        algorithms: config.fusion.algorithms,
        landmarks: config.landmarks.clone().into(),
        boxes: box_projector(config, held),
        origin: config.origin,
        contradicts: held.problem.is_some(),
        problem: held.problem.clone().or_else(|| pose_problem(config)),
    }
}

/// The projection of the boxes of programs: objects have the sizes of the node's own camera, or
/// without a camera the sizes of the description.
fn box_projector(config: &NodeConfig, held: &HeldDescription) -> Arc<BoxProjector> {
    let described = held.description.as_ref().filter(|_| held.problem.is_none());
    let gate = config.fusion.pace.gate();
    Arc::new(BoxProjector {
        sizes: config.object_sizes(described.map(|description| &*description.text)),
        landmarks: Arc::new(LandmarkIndex::new(config.landmarks(), gate.radius_m)),
        gate,
    })
}

/// The reason why the frames of the node's camera have no place in the cell's frame.
#[cfg(feature = "camera")]
fn pose_problem(config: &NodeConfig) -> Option<String> {
    let error = super::camera::standing_pose(config).err()?;
    Some(format!("the camera's frames are not reported: {error:#}"))
}

#[cfg(not(feature = "camera"))]
fn pose_problem(_config: &NodeConfig) -> Option<String> {
    None
}

#[cfg(test)]
mod tests {
    use ecod::model::names::NodeName;
    use ecod::wire::Role;

    use super::*;

    #[test]
    fn boxes_use_description_sizes() {
        let text = "[camera.projection.sizes.labels]\ncar = { width_m = 0.18, height_m = 0.12 }\n";
        let set_by = NodeName::from_static("edge");
        let mut held = HeldDescription {
            description: Some(Arc::new(CellDescription {
                schema: SCHEMA_VERSION,
                version: 1,
                hash: content_hash(&set_by, text),
                set_by,
                text: text.to_owned(),
            })),
            problem: None,
        };
        let config = NodeConfig {
            role: Role::Edge,
            ..NodeConfig::default()
        };
        let car_m = |held: &HeldDescription| {
            let sizes = &shared_facts(&config, held).boxes.sizes;
            sizes.of("car").map(|size| size.height_m)
        };
        assert_eq!(car_m(&held), Some(0.12));
        held.problem = Some("contradicts".to_owned());
        assert_eq!(car_m(&held), car_m(&HeldDescription::default()));
    }
}
