//! Scenes similar to a recorded one, with its detectors' errors.
//!
//! A generated scene has the recorded vehicles and objects, moved a little, with the objects'
//! places exchanged. For every object in a vehicle's view, one recorded view of such an object, by
//! any vehicle, is chosen. Its detections, from frames drawn at random, are moved to the object's
//! new place: label, confidence, apparent size and error of bearing stay as recorded. A vehicle's
//! detections of other things are added unchanged. Objects do not hide each other.

use std::ops::RangeInclusive;

use ecod::model::detection::{BoundingBox, Detection};
use ecod::model::geometry::Pose;
use ecod::perception::camera::Intrinsics;
use nalgebra::{Point2, Vector2};
use rand::seq::{IndexedRandom, SliceRandom};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::reports;
use crate::testbed::{IntersectionRecording, KnownObject};

/// Greatest shift of objects and vehicles, in metres along each axis.
const MOVED_M: RangeInclusive<f64> = -0.025..=0.025;
/// Greatest turn of vehicles, in radians.
const TURNED_RAD: RangeInclusive<f64> = -0.03..=0.03;

/// Statistics of a recording's detectors.
#[derive(Debug, Clone)]
pub struct ConfusionModel<'a> {
    recording: &'a IntersectionRecording,
    /// By object, every vehicle's view of it.
    views: Vec<Vec<View>>,
    /// Detections without an object, by vehicle and frame.
    clutter: Vec<Vec<Vec<Detection>>>,
}

/// One vehicle's view of one object: its detections by frame.
#[derive(Debug, Clone, Default)]
struct View(Vec<Vec<Glimpse>>);

/// A detection without its place.
#[derive(Debug, Clone)]
struct Glimpse {
    detection: Detection,
    /// Metres from the camera along its axis, when recorded.
    forward_m: f64,
    bearing_error_rad: f64,
}

impl<'a> ConfusionModel<'a> {
    /// Divides a recording by the locations to which its detections are assigned.
    pub fn of(recording: &'a IntersectionRecording) -> Self {
        let cavs = recording.cavs.len();
        let mut views = vec![vec![View::default(); cavs]; recording.objects.len()];
        let mut clutter: Vec<Vec<Vec<Detection>>> = vec![Vec::new(); cavs];
        for (cav, frames) in recording.frames.iter().enumerate() {
            for detections in frames {
                clutter[cav].push(Vec::new());
                views
                    .iter_mut()
                    .for_each(|of_object| of_object[cav].0.push(Vec::new()));
                for detection in detections {
                    let object = object_of(recording, cav, detection);
                    match object.and_then(|object| {
                        Some((object, glimpse(recording, cav, object, detection)?))
                    }) {
                        Some((object, glimpse)) => views[object][cav]
                            .0
                            .last_mut()
                            .map(|frame| frame.push(glimpse)),
                        None => clutter[cav]
                            .last_mut()
                            .map(|frame| frame.push(detection.clone())),
                    };
                }
            }
        }
        for (object, of_object) in recording.objects.iter().zip(&mut views) {
            let mut poses = recording.cavs.iter().map(|cav| &cav.pose);
            of_object.retain(|view| {
                let in_view = poses
                    .next()
                    .is_some_and(|pose| sight(&recording.intrinsics, pose, object).is_some());
                !view.0.is_empty() && (in_view || view.0.iter().any(|frame| !frame.is_empty()))
            });
        }
        Self {
            recording,
            views,
            clutter,
        }
    }

    /// A scene of `frames` frames; equal seeds give equal scenes.
    pub fn scene(&self, seed: u64, frames: usize) -> IntersectionRecording {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut scene = self.recording.clone();
        let mut places: Vec<Point2<f64>> =
            scene.objects.iter().map(|object| object.position).collect();
        places.shuffle(&mut rng);
        for (object, place) in scene.objects.iter_mut().zip(places) {
            object.position = place + moved(&mut rng);
        }
        for cav in &mut scene.cavs {
            cav.pose.position += moved(&mut rng);
            cav.pose.heading_rad += rng.random_range(TURNED_RAD);
        }
        scene.frames = (0..scene.cavs.len())
            .map(|cav| self.watch(&scene, cav, frames, &mut rng))
            .collect();
        scene
    }

    fn watch(
        &self,
        scene: &IntersectionRecording,
        cav: usize,
        frames: usize,
        rng: &mut ChaCha8Rng,
    ) -> Vec<Vec<Detection>> {
        let camera = &scene.intrinsics;
        let pose = &scene.cavs[cav].pose;
        let mut chosen = Vec::new();
        for (object, views) in scene.objects.iter().zip(&self.views) {
            chosen.extend(sight(camera, pose, object).zip(views.choose(rng)));
        }
        let mut watched = Vec::with_capacity(frames);
        for _ in 0..frames {
            let mut detections = self.clutter[cav].choose(rng).cloned().unwrap_or_default();
            for (sight, View(recorded)) in &chosen {
                let glimpses = recorded.choose(rng).into_iter().flatten();
                detections.extend(glimpses.filter_map(|glimpse| glimpse.at(camera, *sight)));
            }
            watched.push(detections);
        }
        watched
    }
}

/// Where a camera sees an object.
#[derive(Debug, Clone, Copy)]
struct ObjectInView {
    /// Distance along the optical axis.
    forward_m: f64,
    bearing_rad: f64,
}

/// Where a camera sees an object; `None` out of its view.
fn sight(camera: &Intrinsics, pose: &Pose, object: &KnownObject) -> Option<ObjectInView> {
    let (range_m, bearing_rad) = pose.range_bearing(&object.position);
    let in_view = bearing_rad.abs() <= camera.horizontal_field_of_view() / 2.0;
    (in_view && range_m > 0.0).then(|| ObjectInView {
        forward_m: range_m * bearing_rad.cos(),
        bearing_rad,
    })
}

/// The object that a vehicle takes a detection for.
fn object_of(
    recording: &IntersectionRecording,
    cav: usize,
    detection: &Detection,
) -> Option<usize> {
    let alone = IntersectionRecording {
        cavs: vec![recording.cavs[cav].clone()],
        frames: vec![vec![vec![detection.clone()]]],
        ..recording.clone()
    };
    let id = reports(&alone)
        .into_iter()
        .flat_map(|report| report.objects)
        .next()?
        .landmark?;
    recording.objects.iter().position(|object| object.id == id)
}

fn glimpse(
    recording: &IntersectionRecording,
    cav: usize,
    object: usize,
    detection: &Detection,
) -> Option<Glimpse> {
    let (range_m, bearing_rad) = recording.cavs[cav]
        .pose
        .range_bearing(&recording.objects[object].position);
    let forward_m = range_m * bearing_rad.cos();
    let found_rad = recording
        .intrinsics
        .bearing(detection.bounding_box.center().x);
    (forward_m > 0.0).then(|| Glimpse {
        detection: detection.clone(),
        forward_m,
        bearing_error_rad: found_rad - bearing_rad,
    })
}

impl Glimpse {
    /// The detection of an object that is now elsewhere; `None` where it leaves the image.
    fn at(&self, camera: &Intrinsics, sight: ObjectInView) -> Option<Detection> {
        let recorded = &self.detection.bounding_box;
        let scale = self.forward_m / sight.forward_m;
        let x = camera.cx - camera.fx * (sight.bearing_rad + self.bearing_error_rad).tan();
        let y = camera.cy + (recorded.center().y - camera.cy) * scale;
        let half_width = recorded.width() * scale / 2.0;
        let half_height = recorded.height() * scale / 2.0;
        let bounding_box = BoundingBox {
            x_min: x - half_width,
            y_min: (y - half_height).max(0.0),
            x_max: x + half_width,
            y_max: (y + half_height).min(f64::from(camera.height)),
        };
        let in_image = (0.0..=f64::from(camera.width)).contains(&x) && bounding_box.is_valid();
        in_image.then(|| Detection {
            bounding_box,
            ..self.detection.clone()
        })
    }
}

fn moved(rng: &mut ChaCha8Rng) -> Vector2<f64> {
    Vector2::new(rng.random_range(MOVED_M), rng.random_range(MOVED_M))
}
