//! Landmarks: the set R of the paper.

mod config;
mod grid;
mod index;

use nalgebra::Point2;

pub(crate) use config::check_synonyms;
pub use config::{LandmarkConfig, VacancyConfig};
pub use index::{LandmarkCandidate, LandmarkGate, LandmarkIndex};

use crate::model::names::{Label, LandmarkId};

/// A location, given in the configuration, at which an object may stand.
#[derive(Debug, Clone, PartialEq)]
pub struct Landmark {
    /// Name of the location, unique in the cell.
    pub id: LandmarkId,
    /// Position of an object in metres.
    pub position: Point2<f64>,
    /// Direction from which an object here can be read, in radians; `None` from all around.
    pub facing_rad: Option<f64>,
    /// A sign that is in view while the location is empty.
    pub vacancy: Option<VacancySign>,
    /// Labels that count as another one here.
    pub synonyms: Vec<Synonym>,
}

impl Landmark {
    /// The label that `label` counts as here, if it has a synonym.
    pub fn synonym(&self, label: &Label) -> Option<&Label> {
        self.synonyms
            .iter()
            .find(|synonym| synonym.from == *label)
            .map(|synonym| &synonym.label)
    }
}

/// A fixed sign behind a location, such as a card that reads `EMPTY`; any object in front outweighs
/// it.
#[derive(Debug, Clone, PartialEq)]
pub struct VacancySign {
    /// The text of the sign.
    pub label: Label,
    /// Position of the sign in metres, east and north.
    pub position: Point2<f64>,
}

/// A label that counts as another one.
#[derive(Debug, Clone, PartialEq)]
pub struct Synonym {
    /// The label as detected, such as `vase`.
    pub from: Label,
    /// The label that it counts as, such as `sports ball`.
    pub label: Label,
}
