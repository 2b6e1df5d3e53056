//! Nearest-landmark queries whose cost does not grow with the number of landmarks far away.

use std::collections::HashMap;

use nalgebra::{Point2, Vector2};
use rstar::RTree;
use rstar::primitives::GeomWithData;

use super::Landmark;
use crate::geometry::Covariance;
use crate::names::{Label, LandmarkId};

/// Landmarks in configuration order with a spatial index over where objects and vacancy signs stand.
#[derive(Debug, Clone)]
pub struct LandmarkIndex {
    landmarks: Vec<Landmark>,
    by_id: HashMap<LandmarkId, usize>,
    objects: RTree<Place>,
    vacancy_signs: RTree<Place>,
}

type Place = GeomWithData<[f64; 2], usize>;

/// A landmark that a detection may belong to.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Candidate {
    /// Position of the landmark in configuration order.
    pub landmark: usize,
    /// Whether the detection is the landmark's vacancy sign rather than an object before it.
    pub is_vacancy_sign: bool,
    /// Squared distance in standard deviations.
    pub mahalanobis_squared: f64,
}

/// How near a detection must be to a landmark.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Gate {
    /// Largest distance in metres, the paper's δ.
    pub radius_m: f64,
    /// Largest distance in standard deviations.
    pub sigmas: f64,
    /// Standard deviation in metres that is added to every reported one, for what the vehicle does not know: where
    /// exactly the object stands and where the vehicle itself is.
    pub floor_m: f64,
}

impl LandmarkIndex {
    /// Indexes the landmarks.
    pub fn new(landmarks: Vec<Landmark>) -> Self {
        let place = |(index, point): (usize, Point2<f64>)| Place::new([point.x, point.y], index);
        let objects = landmarks.iter().map(|l| l.position).enumerate().map(place).collect();
        let vacancy_signs = landmarks
            .iter()
            .enumerate()
            .filter_map(|(index, l)| l.vacancy.as_ref().map(|sign| (index, sign.position)))
            .map(place)
            .collect();
        Self {
            by_id: landmarks.iter().enumerate().map(|(index, l)| (l.id.clone(), index)).collect(),
            landmarks,
            objects: RTree::bulk_load(objects),
            vacancy_signs: RTree::bulk_load(vacancy_signs),
        }
    }

    /// The landmarks in configuration order.
    pub fn landmarks(&self) -> &[Landmark] {
        &self.landmarks
    }

    /// Position in configuration order of the landmark with this id.
    pub fn position_of(&self, id: &LandmarkId) -> Option<usize> {
        self.by_id.get(id).copied()
    }

    /// Landmarks within `radius_m` of a point in metres, in no particular order, with the squared distance in m².
    pub fn within(&self, point: &Point2<f64>, radius_m: f64) -> impl Iterator<Item = (usize, f64)> {
        let query = [point.x, point.y];
        self.objects.locate_within_distance(query, radius_m * radius_m).map(move |place| {
            let [x, y] = *place.geom();
            (place.data, (x - query[0]).powi(2) + (y - query[1]).powi(2))
        })
    }

    /// The landmark that best explains a detection: within the gate and at the least Mahalanobis distance.
    ///
    /// A detection that reads what a landmark's vacancy sign reads is compared with where the sign stands, any other
    /// with where objects stand.
    pub fn best(&self, label: &Label, point: &Point2<f64>, covariance: &Covariance, gate: &Gate) -> Option<Candidate> {
        let reads = |index: usize| self.landmarks[index].vacancy.as_ref().is_some_and(|sign| sign.label == *label);
        let query = [point.x, point.y];
        let radius_squared = gate.radius_m * gate.radius_m;
        let signs = self
            .vacancy_signs
            .locate_within_distance(query, radius_squared)
            .filter(|place| reads(place.data))
            .map(|place| (place, true));
        let objects = self
            .objects
            .locate_within_distance(query, radius_squared)
            .filter(|place| !reads(place.data))
            .map(|place| (place, false));
        signs
            .chain(objects)
            .map(|(place, is_vacancy_sign)| {
                let [x, y] = *place.geom();
                let offset = Vector2::new(point.x - x, point.y - y);
                Candidate {
                    landmark: place.data,
                    is_vacancy_sign,
                    mahalanobis_squared: covariance.mahalanobis_squared(&offset, gate.floor_m),
                }
            })
            .filter(|candidate| candidate.mahalanobis_squared <= gate.sigmas * gate.sigmas)
            .min_by(|a, b| a.mahalanobis_squared.total_cmp(&b.mahalanobis_squared).then(a.landmark.cmp(&b.landmark)))
    }
}
