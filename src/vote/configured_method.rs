//! The voting method that a cell is configured for.

use super::config::{VoteConfig, VoteMode};
use super::method::VotingMethod;
use super::paper::PaperVoting;
use super::weighted::WeightedVoting;

#[derive(Debug, Clone)]
pub(super) enum ConfiguredMethod {
    Paper(PaperVoting),
    Weighted(Box<WeightedVoting>),
}

impl ConfiguredMethod {
    pub(super) fn new(config: &VoteConfig) -> Self {
        match config.mode {
            VoteMode::Paper => Self::Paper(PaperVoting::new(config.paper.clone())),
            VoteMode::Weighted => {
                Self::Weighted(Box::new(WeightedVoting::new(config.weighted.clone())))
            }
        }
    }

    pub(super) fn get(&self) -> &dyn VotingMethod {
        match self {
            Self::Paper(method) => method,
            Self::Weighted(method) => &**method,
        }
    }

    pub(super) fn get_mut(&mut self) -> &mut dyn VotingMethod {
        match self {
            Self::Paper(method) => method,
            Self::Weighted(method) => &mut **method,
        }
    }
}
