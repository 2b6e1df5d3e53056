//! Nearest-landmark queries; their cost does not depend on the number of landmarks far away.

use std::cmp::Ordering;

use hashbrown::HashMap;
use nalgebra::Point2;

use super::Landmark;
use super::grid::{Grid, GridPoint};
use crate::model::geometry::Covariance;
use crate::model::names::{Label, LandmarkId};
use crate::wire::PerceivedObject;

/// Landmarks in configuration order with a spatial index of the positions of objects and vacancy
/// signs.
#[derive(Debug, Clone)]
pub struct LandmarkIndex {
    landmarks: Vec<Landmark>,
    /// A contiguous copy of the ids, for [`Self::position_near`].
    ids: Vec<LandmarkId>,
    by_id: HashMap<LandmarkId, usize>,
    objects: Grid,
    vacancy_signs: Grid,
    /// Corners of the box around all positions, west-south and east-north; without landmarks, the
    /// wrong way around.
    corners: [Point2<f64>; 2],
}

/// A landmark that a detection may belong to.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LandmarkCandidate {
    /// Position of the landmark in configuration order.
    pub landmark: usize,
    /// True if the detection is the landmark's vacancy sign rather than an object in front of it.
    pub is_vacancy_sign: bool,
    /// Squared distance in standard deviations.
    pub mahalanobis_squared: f64,
}

/// The gate of the association of detections with landmarks.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LandmarkGate {
    /// Largest distance in metres, the paper's δ.
    pub radius_m: f64,
    /// Largest distance in standard deviations.
    pub sigmas: f64,
    /// Standard deviation in metres that is added to every reported one. It covers errors that the
    /// vehicle cannot report: errors of the map and of the vehicle's own pose.
    pub floor_m: f64,
}

impl LandmarkIndex {
    /// Indexes the landmarks for queries of about `radius_m` metres.
    pub fn new(landmarks: Vec<Landmark>, radius_m: f64) -> Self {
        let point = |(index, position): (usize, Point2<f64>)| GridPoint {
            position,
            landmark: index as u32,
            has_sign: landmarks[index].vacancy.is_some(),
        };
        let objects = landmarks.iter().map(|l| l.position).enumerate().map(point);
        let signs = landmarks
            .iter()
            .enumerate()
            .filter_map(|(index, l)| Some((index, l.vacancy.as_ref()?.position)));
        let mut low = Point2::from([f64::MAX; 2]);
        let mut high = Point2::from([f64::MIN; 2]);
        for Landmark { position, .. } in &landmarks {
            low = low.inf(position);
            high = high.sup(position);
        }
        Self {
            corners: [low, high],
            ids: landmarks.iter().map(|l| l.id.clone()).collect(),
            by_id: landmarks
                .iter()
                .enumerate()
                .map(|(index, l)| (l.id.clone(), index))
                .collect(),
            objects: Grid::new(objects, 4.0 * radius_m),
            vacancy_signs: Grid::new(signs.map(point), 4.0 * radius_m),
            landmarks,
        }
    }

    /// An index of these landmarks and then of more, for queries of about `radius_m` metres.
    pub fn extended(&self, more: Vec<Landmark>, radius_m: f64) -> Self {
        Self::new(
            self.landmarks.iter().cloned().chain(more).collect(),
            radius_m,
        )
    }

    /// The landmarks in configuration order.
    pub fn landmarks(&self) -> &[Landmark] {
        &self.landmarks
    }

    /// Position in configuration order of the landmark with this id.
    pub fn position_of(&self, id: &LandmarkId) -> Option<usize> {
        self.by_id.get(id).copied()
    }

    /// As `position_of`, for ids that mostly arrive in configuration order: `expected` is tried
    /// first.
    pub fn position_near(&self, id: &LandmarkId, expected: usize) -> Option<usize> {
        if self.ids.get(expected) == Some(id) {
            Some(expected)
        } else {
            self.position_of(id)
        }
    }

    /// Landmarks whose object position is within `radius_m` of a point in metres, in no particular
    /// order.
    pub fn within(&self, point: &Point2<f64>, radius_m: f64) -> impl Iterator<Item = usize> {
        self.objects
            .within(*point, radius_m)
            .map(|(near, _)| near.landmark as usize)
    }

    /// True if a point in metres is at most `margin_m` and their extent away from the landmarks,
    /// along each axis.
    pub fn is_around(&self, point: &Point2<f64>, margin_m: f64) -> bool {
        let [low, high] = self.corners;
        let margin = (high - low).add_scalar(margin_m);
        low - margin <= *point && *point <= high + margin
    }

    /// The landmark within the gate at the smallest Mahalanobis distance from a detection.
    ///
    /// A detection with the label of a landmark's vacancy sign is compared with the sign's
    /// position, any other with the position of objects.
    pub fn best(
        &self,
        label: &Label,
        point: &Point2<f64>,
        covariance: &Covariance,
        gate: &LandmarkGate,
    ) -> Option<LandmarkCandidate> {
        // A fold and not `min_by`, which takes the first candidate apart and thus prevents plain
        // loops.
        self.candidates(label, *point, *covariance, *gate).fold(
            None,
            |best, candidate| match best {
                Some(best) if candidate.compare(&best) != Ordering::Less => Some(best),
                _ => Some(candidate),
            },
        )
    }

    /// The object with the landmark that [`Self::best`] finds for it; an object without a covariance
    /// stays without a landmark.
    #[must_use]
    pub fn assigned(&self, object: PerceivedObject, gate: &LandmarkGate) -> PerceivedObject {
        let point = Point2::new(object.x_m, object.y_m);
        let best = object
            .covariance()
            .and_then(|covariance| self.best(&object.label, &point, &covariance, gate));
        let landmark = best.map(|best| self.landmarks[best.landmark].id.clone());
        PerceivedObject { landmark, ..object }
    }

    /// All landmarks within the gate of a detection, as for [`Self::best`], in no particular order.
    pub fn candidates<'a>(
        &'a self,
        label: &'a Label,
        point: Point2<f64>,
        covariance: Covariance,
        gate: LandmarkGate,
    ) -> impl Iterator<Item = LandmarkCandidate> + 'a {
        let near = move |grid: &'a Grid, is_vacancy_sign: bool| {
            grid.within(point, gate.radius_m)
                .filter(move |(near, _)| self.reads_sign(label, near) == is_vacancy_sign)
                .map(move |(near, offset)| LandmarkCandidate {
                    landmark: near.landmark as usize,
                    is_vacancy_sign,
                    mahalanobis_squared: covariance.mahalanobis_squared(&offset, gate.floor_m),
                })
                .filter(move |candidate| candidate.mahalanobis_squared <= gate.sigmas * gate.sigmas)
        };
        let signs = Some(&self.vacancy_signs).filter(|signs| !signs.is_empty());
        near(&self.objects, false).chain(signs.into_iter().flat_map(move |signs| near(signs, true)))
    }

    /// True if a label is the text of a landmark's vacancy sign.
    fn reads_sign(&self, label: &Label, near: &GridPoint) -> bool {
        let sign = || self.landmarks[near.landmark as usize].vacancy.as_ref();
        near.has_sign && sign().is_some_and(|sign| sign.label == *label)
    }
}

impl LandmarkCandidate {
    fn compare(&self, other: &Self) -> Ordering {
        self.mahalanobis_squared
            .total_cmp(&other.mahalanobis_squared)
            .then(self.landmark.cmp(&other.landmark))
    }
}
