//! The parking-lot testbed of the paper (§V): scenes of placards and cameras, in metres and
//! radians.
//!
//! Every spot has a placard `EMPTY` at its back. A parked vehicle is a second placard in front of
//! it whose code reads the plate; it hides the first from most directions. Files are in inches and
//! degrees and converted while being read.

pub mod birdseye;
pub mod camera;
mod file;
pub mod frames;
pub mod intersection;
mod recording;
pub mod scene_run;
pub mod score;
pub mod setup;
mod sight;
pub mod table;
#[cfg(test)]
mod tests;

use std::time::Duration;

use ecod::model::geometry::Pose;
use ecod::model::names::{Label, LandmarkId, NodeName};
use ecod::perception::camera::Intrinsics;
use ecod::perception::landmark::{Landmark, VacancySign};
use nalgebra::Point2;

pub use file::TestbedError;
pub use recording::{IntersectionRecording, KnownObject};
use sight::NEAR_M;
pub use sight::{Hit, Sighting};

/// Scenes that share one kind of camera and one kind of placard.
#[derive(Debug, Clone, PartialEq)]
pub struct Testbed {
    /// The camera of every vehicle.
    pub camera: Camera,
    /// The make of every placard.
    pub placard: Placard,
    /// The scenes in the order of the file.
    pub scenes: Vec<Scene>,
}

impl Testbed {
    /// Reads a scene file.
    ///
    /// # Errors
    /// Returns a [`TestbedError`] if the text is not JSON; otherwise it names the scene, the key
    /// and the fault of its value.
    pub fn from_json(text: &str) -> Result<Self, TestbedError> {
        file::read(text)
    }

    /// The scene of the given name.
    pub fn scene(&self, name: &str) -> Option<&Scene> {
        self.scenes.iter().find(|scene| scene.name == name)
    }

    /// All cards that stand in a scene: of each spot its `EMPTY` placard, if it has one, and then
    /// its plate, if a vehicle is parked there.
    pub fn cards(&self, scene: &Scene) -> Vec<Card> {
        scene
            .spots
            .iter()
            .flat_map(|spot| [spot.empty_card(&self.placard), spot.plate_card()])
            .flatten()
            .collect()
    }

    /// Sign that the vehicle's camera could read at a spot, by the geometry alone: the plate of an
    /// occupied spot, the `EMPTY` placard of a free one; `None` when it is outside the image, seen
    /// from behind, too small in it, or mostly hidden. A free spot without a placard can be seen to
    /// be free where its plate could be read.
    pub fn sighting(&self, scene: &Scene, cav: &Cav, spot: &Spot) -> Option<Sighting> {
        let place = || Card {
            text: Label::default(),
            position: spot.occupied,
            facing_rad: spot.facing_rad,
        };
        let card = spot
            .plate_card()
            .or_else(|| spot.empty_card(&self.placard))
            .unwrap_or_else(place);
        Sighting::of(&card, &self.cards(scene), &cav.pose, self).filter(Sighting::is_legible)
    }
}

/// A vehicle's camera and how often it is used.
#[derive(Debug, Clone, PartialEq)]
pub struct Camera {
    /// Its image, without distortion.
    pub intrinsics: Intrinsics,
    /// Time from one frame to the next.
    pub capture_interval: Duration,
    /// Time from one report to the next.
    pub submission_interval: Duration,
}

/// A card that stands upright with a QR code near its upper end; lengths in metres.
#[derive(Debug, Clone, PartialEq)]
pub struct Placard {
    /// Side of the code.
    pub qr_width_m: f64,
    /// Side of the code with its quiet zone.
    pub quiet_width_m: f64,
    /// Width of the card.
    pub card_width_m: f64,
    /// Height of the card.
    pub card_height_m: f64,
    /// Text on the placard of a free spot.
    pub empty_text: Label,
}

/// One arrangement of parked vehicles and observers.
#[derive(Debug, Clone, PartialEq)]
pub struct Scene {
    /// The scene's name, unique in its file.
    pub name: String,
    /// The parking spots, free or occupied.
    pub spots: Vec<Spot>,
    /// The vehicles that watch them.
    pub cavs: Vec<Cav>,
    /// Runs recorded on the physical testbed; may be empty.
    pub recorded: Vec<RecordedRun>,
}

impl Scene {
    /// The spots as landmarks of PACE.
    pub fn landmarks(&self, placard: &Placard) -> Vec<Landmark> {
        self.spots
            .iter()
            .map(|spot| spot.landmark(placard))
            .collect()
    }
}

/// One parking spot with its truth.
#[derive(Debug, Clone, PartialEq)]
pub struct Spot {
    /// `slot-` and the spot's number or name in the file.
    pub id: LandmarkId,
    /// Where the plate of a parked vehicle stands, in metres.
    pub occupied: Point2<f64>,
    /// Where the `EMPTY` placard is mounted, in metres.
    pub empty: Option<Point2<f64>>,
    /// Direction that both placards face, in radians: from empty towards occupied.
    pub facing_rad: f64,
    /// The plate of the parked vehicle; `None` when the spot is free.
    pub truth: Option<Label>,
}

impl Spot {
    /// The spot as a landmark, with its `EMPTY` placard as the vacancy sign.
    pub fn landmark(&self, placard: &Placard) -> Landmark {
        Landmark {
            id: self.id.clone(),
            position: self.occupied,
            facing_rad: Some(self.facing_rad),
            vacancy: self.empty.map(|position| VacancySign {
                label: placard.empty_text.clone(),
                position,
            }),
            synonyms: Vec::new(),
        }
    }

    fn plate_card(&self) -> Option<Card> {
        self.truth.clone().map(|text| Card {
            text,
            position: self.occupied,
            facing_rad: self.facing_rad,
        })
    }

    fn empty_card(&self, placard: &Placard) -> Option<Card> {
        let text = placard.empty_text.clone();
        self.empty.map(|position| Card {
            text,
            position,
            facing_rad: self.facing_rad,
        })
    }
}

/// One placard that stands in a scene.
#[derive(Debug, Clone, PartialEq)]
pub struct Card {
    /// Text of its code.
    pub text: Label,
    /// Where it stands, in metres.
    pub position: Point2<f64>,
    /// Direction that its front faces, in radians.
    pub facing_rad: f64,
}

/// One vehicle that watches the spots.
#[derive(Debug, Clone, PartialEq)]
pub struct Cav {
    /// Name of the vehicle, by which it reports.
    pub name: NodeName,
    /// Where its camera is and looks.
    pub pose: Pose,
}

/// Accuracies recorded in one run on the physical testbed.
#[derive(Debug, Clone, PartialEq)]
pub struct RecordedRun {
    /// Accuracy of PACE in percent, if it was recorded.
    pub pace_accuracy_pct: Option<f64>,
    /// Accuracy of each vehicle alone in percent, in the order of the scene's vehicles; those
    /// recorded only.
    pub single_cav_accuracy_pct: Vec<(NodeName, f64)>,
}
