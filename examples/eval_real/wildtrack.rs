//! WILDTRACK (Chavdarova et al., CVPR 2018): seven cameras around a square, with the MVDeTr boxes that ReST uses.
//!
//! The 40 frames of its test part, at two frames per second. Each camera reports the feet of its boxes on the ground,
//! and its own fixed pose. MVDeTr detects people in all images together, so the errors of the cameras are not
//! independent. The truth of MVDet has no identities.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::fs;
use std::path::Path;

use anyhow::Context;
use ecod::model::geometry::Pose;
use ecod::model::names::NodeName;
use ecod::wire::{ObjectReport, PerceivedObject, WirePose};
use ecod_lab::eval::baselines::{LatestReports, NearestTracker, suppressed};
use ecod_lab::eval::formats::time_of;
use nalgebra::{Matrix2, Matrix3, Point2, Vector3};
use serde_json::Value;

use super::ground_camera::GroundCamera;
use super::{Recording, write_reports};

pub(super) const BOXES: (&str, &str) = (
    "ReST/datasets/Wildtrack/sequence1/output/MVDeTr_test.json",
    "chengche6230/ReST",
);

pub(super) const CAMERAS: (&str, &str) =
    ("ReST/datasets/Wildtrack/metainfo.json", "chengche6230/ReST");

pub(super) const TRUTH: (&str, &str) = (
    "MVDet/multiview_detector/evaluation/gt-demo.txt",
    "hou-yz/MVDet",
);

const FRAME_RATE_HZ: f64 = 2.0;

/// The truth counts frames at ten per second, on a grid of 2.5 cm from this corner in metres.
const TRUTH_FRAMES: u64 = 5;
const GRID_M: f64 = 0.025;
const CORNER_M: [f64; 2] = [-3.0, -9.0];

/// The boxes have no confidence.
const CONFIDENCE: f64 = 0.9;

/// Standard deviation in pixels of the foot of a box.
const FOOT_PIXELS: f64 = 5.0;

/// Row of pixels at which the image cuts a box, so that its foot is not in view.
const LAST_ROW: f64 = 1079.0;

/// The boxes of a frame: left, top, width, height, an unused value, camera.
type Boxes = BTreeMap<u64, Vec<[f64; 6]>>;

/// Boxes, cameras and truth.
pub(super) struct Wildtrack {
    pub(super) boxes: Boxes,
    /// From the ground in centimetres to the image without distortion, by camera.
    homographies: Vec<Matrix3<f64>>,
    pub(super) cameras: Vec<GroundCamera>,
    /// Positions of people in metres by frame.
    pub(super) positions: BTreeMap<u64, Vec<Point2<f64>>>,
}

impl Wildtrack {
    pub(super) fn read(boxes: &Path, cameras: &Path, truth: &Path) -> anyhow::Result<Self> {
        let read = |path: &Path| {
            fs::read_to_string(path).with_context(|| format!("cannot read {}", path.display()))
        };
        let boxes = serde_json::from_str(&read(boxes)?)?;
        let cameras: Value = serde_json::from_str(&read(cameras)?)?;
        let matrices: Vec<[[f64; 3]; 3]> =
            serde_json::from_value(cameras["sequence1"]["homography"].clone())?;
        let homographies: Vec<Matrix3<f64>> = matrices
            .iter()
            .map(|rows| Matrix3::from_fn(|row, column| rows[row][column]))
            .collect();
        let cameras = homographies
            .iter()
            .map(GroundCamera::new)
            .collect::<Option<Vec<_>>>()
            .context("a homography of no pinhole camera")?;
        let mut positions: BTreeMap<u64, Vec<Point2<f64>>> = BTreeMap::new();
        for (number, line) in read(truth)?.lines().enumerate() {
            let [frame, x, y]: [u64; 3] = line
                .split_ascii_whitespace()
                .map(|cell| cell.parse().ok())
                .collect::<Option<Vec<u64>>>()
                .and_then(|cells| cells.try_into().ok())
                .with_context(|| {
                    format!(
                        "{}: line {}: not three numbers",
                        truth.display(),
                        number + 1
                    )
                })?;
            let cell = [x as f64, y as f64];
            let place: [f64; 2] = std::array::from_fn(|axis| CORNER_M[axis] + GRID_M * cell[axis]);
            positions
                .entry(frame / TRUTH_FRAMES)
                .or_default()
                .push(place.into());
        }
        Ok(Self {
            boxes,
            homographies,
            cameras,
            positions,
        })
    }

    pub(super) fn convert(&self, work: &Path) -> anyhow::Result<Recording> {
        let truth = work.join("truth.txt");
        let reports = work.join("reports.jsonl");
        let to_ground = self
            .homographies
            .iter()
            .map(|homography| homography.try_inverse())
            .collect::<Option<Vec<_>>>()
            .context("a homography has no inverse")?;
        let mut places = String::new();
        let mut all = String::new();
        let mut late_fusion = String::new();
        let mut alone = vec![String::new(); to_ground.len()];
        let mut reported = Vec::new();
        let mut latest = LatestReports::default();
        let mut tracker = NearestTracker::default();
        for (number, (frame, boxes)) in (1..).zip(&self.boxes) {
            for place in self.positions.get(frame).into_iter().flatten() {
                writeln!(places, "{}", line(number, 1.0, place))?;
            }
            let at = time_of(0, number, FRAME_RATE_HZ);
            for (camera, to_ground) in to_ground.iter().enumerate() {
                let of_camera = boxes.iter().filter(|cells| cells[5] as usize == camera);
                let with_foot = of_camera.filter(|[_, top, _, height, ..]| top + height < LAST_ROW);
                let objects: Vec<PerceivedObject> =
                    with_foot.map(|cells| object(cells, to_ground)).collect();
                for PerceivedObject { x_m, y_m, .. } in &objects {
                    let line = line(number, CONFIDENCE, &Point2::new(*x_m, *y_m));
                    writeln!(all, "{line}")?;
                    writeln!(alone[camera], "{line}")?;
                }
                let Pose {
                    position,
                    heading_rad,
                } = self.cameras[camera].pose;
                let pose = Some(WirePose::new(position.x, position.y, heading_rad));
                let node = NodeName::new(format!("camera-{}", camera + 1))?;
                let report = ObjectReport {
                    objects,
                    pose,
                    moving: Some(false),
                    ..ObjectReport::new(node, number, at)
                };
                latest.report(&report);
                reported.push(report);
            }
            for said in tracker.track(at, &suppressed(latest.union(at))) {
                writeln!(late_fusion, "{}", line(number, said.score, &said.position))?;
            }
        }
        let alone = (1..)
            .zip(alone)
            .map(|(camera, lines)| (format!("camera {camera}"), lines));
        let methods = [("detections".to_owned(), all)].into_iter().chain(alone);
        let others = methods
            .chain([("late fusion".to_owned(), late_fusion)])
            .map(|(method, lines)| {
                let path = work.join(format!("{method}.txt"));
                fs::write(&path, lines)?;
                anyhow::Ok((method, path))
            })
            .collect::<Result<_, _>>()?;
        fs::write(&truth, places)?;
        write_reports(&reports, reported)?;
        Ok(Recording {
            name: "WILDTRACK",
            format: "mot",
            frame_rate: "2",
            truth,
            others,
            reports,
            is_fused: true,
        })
    }
}

/// A line of MOTChallenge: an object without track and box.
fn line(frame: u64, score: f64, place: &Point2<f64>) -> String {
    format!("{frame},-1,0,0,0,0,{score},{},{},0", place.x, place.y)
}

/// The foot of a box on the ground, with the error of its pixels.
fn object(&[left, top, width, height, ..]: &[f64; 6], to_ground: &Matrix3<f64>) -> PerceivedObject {
    let ground = |x: f64, y: f64| {
        let place = to_ground * Vector3::new(x, y, 1.0);
        // Centimetres.
        Point2::new(place.x / place.z, place.y / place.z) / 100.0
    };
    let x = left + width / 2.0;
    let y = top + height;
    let place = ground(x, y);
    let steps = [
        ground(x + FOOT_PIXELS, y) - place,
        ground(x, y + FOOT_PIXELS) - place,
    ];
    let covariance: Matrix2<f64> = steps.iter().map(|step| step * step.transpose()).sum();
    PerceivedObject {
        covariance_m2: Some([covariance[(0, 0)], covariance[(0, 1)], covariance[(1, 1)]]),
        ..PerceivedObject::new("person", CONFIDENCE, place.x, place.y)
    }
}
