//! The common form of an object from maps, landmarks and reports, for all message formats.

use std::collections::BTreeMap;

use ecod::model::names::Label;
use ecod::wire::{FusedObject, LandmarkState, PerceivedObject};

/// An object in the cell's frame: metres and radians, `covariance_m2` as `[xx, xy, yy]`, `size_m`
/// as length and width.
#[derive(Debug, Clone)]
pub(crate) struct CellObject<'a> {
    pub(crate) label: &'a Label,
    pub(crate) confidence: f64,
    /// Confidence of each class, or in a map the share of each; empty if there is only the label's
    /// confidence.
    pub(crate) scores: &'a BTreeMap<Label, f64>,
    pub(crate) position_m: [f64; 2],
    pub(crate) covariance_m2: Option<[f64; 3]>,
    pub(crate) velocity_mps: Option<[f64; 2]>,
    pub(crate) heading_rad: Option<f64>,
    pub(crate) size_m: Option<[f64; 2]>,
}

static NO_SCORES: BTreeMap<Label, f64> = BTreeMap::new();

impl<'a> From<&'a FusedObject> for CellObject<'a> {
    fn from(object: &'a FusedObject) -> Self {
        Self {
            label: &object.label,
            confidence: object.confidence,
            scores: &object.scores,
            position_m: [object.x_m, object.y_m],
            covariance_m2: Some(object.covariance_m2),
            velocity_mps: object.velocity_mps,
            heading_rad: object.heading_rad,
            size_m: object.size_m,
        }
    }
}

impl<'a> From<&'a PerceivedObject> for CellObject<'a> {
    fn from(object: &'a PerceivedObject) -> Self {
        Self {
            label: &object.label,
            confidence: object.confidence,
            scores: &object.scores,
            position_m: [object.x_m, object.y_m],
            covariance_m2: object.covariance_m2,
            velocity_mps: object.velocity_mps,
            heading_rad: object.heading_rad,
            size_m: object.size_m,
        }
    }
}

impl<'a> CellObject<'a> {
    /// Objects of a map and objects at its landmarks, each with its id.
    #[cfg(feature = "ros2")]
    pub(crate) fn all_of(map: &'a ecod::wire::GlobalMap) -> impl Iterator<Item = (Self, String)> {
        let objects = map
            .objects
            .iter()
            .map(|object| (object.into(), object.id.to_string()));
        objects.chain(
            map.landmarks
                .iter()
                .filter_map(|place| Some((Self::at(place)?, place.id.to_string()))),
        )
    }

    /// The object at a landmark; `None` if it is empty.
    pub(crate) fn at(landmark: &'a LandmarkState) -> Option<Self> {
        Some(Self {
            label: landmark.label.as_ref()?,
            confidence: landmark.confidence,
            scores: &NO_SCORES,
            position_m: [landmark.x_m, landmark.y_m],
            covariance_m2: None,
            velocity_mps: None,
            heading_rad: None,
            size_m: None,
        })
    }
}
