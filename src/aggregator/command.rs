//! The aggregator's inputs other than reports, as values. Commands, reports and their times are
//! sufficient to replay an aggregator.

use std::collections::BTreeMap;
use std::sync::Arc;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::{Aggregator, Fused, FusionConfig};
use crate::aggregator::round::FirstRound;
use crate::model::epoch::Epoch;
use crate::model::names::NodeName;
use crate::model::time::Timestamp;
use crate::perception::landmark::{Landmark, LandmarkConfig};
use crate::reputation::ReputationLedger;
use crate::wire::{GlobalMap, NeighbourObject, Reputation};

/// A call of an aggregator's method of the same name.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Command {
    /// [`Aggregator::tick`].
    Tick,
    /// [`Aggregator::lead`].
    Lead {
        /// The leadership.
        epoch: Epoch,
        /// Number of the next round.
        first_round: u64,
        /// When it is due.
        first: FirstRound,
    },
    /// [`Aggregator::hold`].
    Hold,
    /// [`Aggregator::step_down`].
    #[serde(rename = "stand_by")]
    StepDown,
    /// [`Aggregator::adopt`].
    Adopt {
        /// All available evidence.
        #[schemars(with = "serde_json::Value")]
        ledger: Arc<ReputationLedger>,
    },
    /// [`Aggregator::adopt_map`].
    AdoptMap {
        /// The map.
        map: Arc<GlobalMap>,
        /// When it was received.
        received_at: Timestamp,
    },
    /// [`Aggregator::on_neighbours`].
    #[serde(rename = "take_neighbours")]
    OnNeighbours {
        /// All objects of other cells near this one; their times are by the aggregator's clock.
        objects: Arc<[NeighbourObject]>,
        /// Time at which the objects had the ages that they state.
        stated_at: Timestamp,
    },
    /// [`Aggregator::resume`].
    Resume {
        /// The reputations.
        reputations: BTreeMap<NodeName, Reputation>,
    },
    /// [`Aggregator::configure`].
    Configure {
        /// Settings of fusion.
        #[schemars(with = "serde_json::Value")]
        fusion: Box<FusionConfig>,
        /// The cell's landmarks.
        #[schemars(with = "serde_json::Value")]
        landmarks: Vec<LandmarkConfig>,
    },
    /// [`Aggregator::expel`].
    Expel {
        /// The vehicle.
        vehicle: NodeName,
    },
    /// [`Aggregator::set_cell_offset`].
    SetCellOffset {
        /// The cell's time minus the aggregator's clock in microseconds.
        offset_us: i64,
    },
}

impl Aggregator {
    /// Carries out a command at `now`; returns the round if that closes it.
    pub fn command(&mut self, command: &Command, now: Timestamp) -> Option<Fused> {
        match command {
            Command::Tick => return self.tick(now),
            Command::Lead {
                epoch,
                first_round,
                first,
            } => self.lead(epoch.clone(), *first_round, *first, now),
            Command::Hold => self.hold(),
            Command::StepDown => self.step_down(),
            Command::Adopt { ledger } => self.adopt(ledger),
            Command::AdoptMap { map, received_at } => self.adopt_map(map, *received_at),
            Command::OnNeighbours { objects, stated_at } => {
                self.on_neighbours(objects, *stated_at);
            }
            Command::Resume { reputations } => self.resume(reputations),
            Command::Configure { fusion, landmarks } => {
                self.configure(
                    FusionConfig::clone(fusion),
                    landmarks.iter().map(Landmark::from).collect(),
                );
            }
            Command::Expel { vehicle } => self.expel(vehicle.clone(), now),
            Command::SetCellOffset { offset_us } => self.set_cell_offset(*offset_us),
        }
        None
    }
}
