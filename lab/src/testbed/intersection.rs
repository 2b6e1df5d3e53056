//! The paper's VOTE testbed: recorded detector output processed by the projector, the naming of
//! locations and VOTE.
//!
//! Sizes were not recorded. Sizes of the objects on the table follow from the boxes with their
//! right label. People and furniture have their natural size, which places visible parts of them
//! correctly behind the table. For all other labels only the bearing is used. The accuracy of poses
//! is derived from the scatter of the recorded bearings.

pub mod generate;

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use ecod::aggregator::round::RoundConfig;
use ecod::aggregator::{Algorithms, FusionConfig};
use ecod::model::geometry::{Pose, wrap_angle};
use ecod::model::names::{Label, LandmarkId, NodeName};
use ecod::model::time::Timestamp;
use ecod::pace::PaceConfig;
use ecod::perception::camera::Mount;
use ecod::perception::landmark::{Landmark, LandmarkGate, LandmarkIndex};
use ecod::perception::projection::{ObjectSize, ObjectSizes, ProjectionConfig, Ranging};
use ecod::perception::view::ViewConfig;
use ecod::replay::{FusedLine, Replay, ReplayConfig};
use ecod::vote::{VoteConfig, VoteMode};
use ecod::wire::{ObjectReport, ReportKind};
use ecod_actors::camera::lens::Lens;
use ecod_actors::camera::perception::{Perception, VehicleCamera};
use nalgebra::Point2;
use serde::Serialize;
use serde_json::json;

use crate::eval::{EvalResult, Evaluation, Scores, Truth};
use crate::testbed::{Cav, IntersectionRecording};

/// When virtual time begins.
const START: Timestamp = Timestamp(1_700_000_000_000_000);
/// The paper's time from one verdict to the next.
const FRAME_INTERVAL: Duration = Duration::from_millis(120);
/// Height in metres and its relative standard deviation by label.
const SIZES: [(&str, f64, f64); 16] = [
    ("mouse", 0.064, 0.2),
    ("cup", 0.155, 0.2),
    ("sports ball", 0.115, 0.2),
    ("orange", 0.115, 0.2),
    ("vase", 0.115, 0.3),
    ("bowl", 0.115, 0.3),
    ("bed", 0.8, 0.3),
    ("chair", 0.9, 0.3),
    ("couch", 0.9, 0.3),
    ("dining table", 0.8, 0.3),
    ("laptop", 0.25, 0.3),
    ("keyboard", 0.1, 0.5),
    ("person", 1.7, 0.3),
    ("potted plant", 0.4, 0.5),
    ("truck", 3.0, 0.3),
    ("tv", 0.5, 0.3),
];
/// Height in metres of objects with any other label, for computing their bearing.
const ANY_HEIGHT_M: f64 = 0.11;
/// Gate for assigning an object of listed size to a location.
const GATE: LandmarkGate = LandmarkGate {
    radius_m: 0.5,
    sigmas: 3.0,
    floor_m: 0.02,
};
/// Maximum angle in radians between an object of unknown size and the location to which it is
/// assigned.
const MAX_BESIDE_RAD: f64 = 0.15;
/// Factor by which the height of such an object may differ from [`ANY_HEIGHT_M`] if it stands at
/// the location.
const MAX_HEIGHT_FACTOR: f64 = 5.0;

/// Result of a recording.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct IntersectionResult {
    /// Name of the recording or scene.
    pub name: String,
    /// Number of scenes that it is the mean of: 1 for a recording.
    pub scenes: u64,
    /// Number of verdicts that were evaluated: one for every object and frame.
    pub verdicts: u64,
    /// Right verdicts in percent, default mode.
    pub vote_accuracy_pct: f64,
    /// Right verdicts in percent, `paper` mode with a verdict after every frame.
    pub vote_paper_accuracy_pct: f64,
    /// Right labels of the map in percent, by PACE alone.
    pub pace_accuracy_pct: f64,
    /// Right labels of the map in percent, as both algorithms agree on them.
    pub answer_accuracy_pct: f64,
    /// Expected share in percent of objects and frames at which most votes are right.
    pub majority_accuracy_pct: f64,
    /// Share in percent of objects and frames at which a vehicle's own votes are right.
    pub single_cav_accuracy_pct: BTreeMap<NodeName, f64>,
    /// Every verdict of the default mode; empty for generated scenes.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub labels: Vec<FrameLabel>,
}

/// The verdict about one object in one frame.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct FrameLabel {
    /// The frame, from 1.
    pub frame: u64,
    /// Name of the object's location.
    pub landmark: LandmarkId,
    /// The verdict; null without a verdict.
    pub label: Option<Label>,
    /// True if it is among the accepted labels.
    pub right: bool,
}

/// Runs a recording.
///
/// # Errors
/// Returns an error if a report cannot be written or read back.
pub fn run(name: &str, recording: &IntersectionRecording) -> anyhow::Result<IntersectionResult> {
    let reports = reports(recording);
    let (fused, scores) = fuse(recording, &reports, Algorithms::Vote, VoteMode::Weighted)?;
    let (_, paper) = fuse(recording, &reports, Algorithms::Vote, VoteMode::Paper)?;
    let (_, pace) = fuse(recording, &reports, Algorithms::Pace, VoteMode::Weighted)?;
    let (_, answer) = fuse(recording, &reports, Algorithms::Both, VoteMode::Weighted)?;
    let alone = |cav: &Cav| {
        (
            cav.name.clone(),
            scores
                .vehicles
                .get(&cav.name)
                .and_then(|v| v.accuracy_pct)
                .unwrap_or(0.0),
        )
    };
    Ok(IntersectionResult {
        name: name.to_owned(),
        scenes: 1,
        verdicts: scores.items,
        vote_accuracy_pct: scores.accuracy_pct.unwrap_or(0.0),
        vote_paper_accuracy_pct: paper.accuracy_pct.unwrap_or(0.0),
        pace_accuracy_pct: pace.accuracy_pct.unwrap_or(0.0),
        answer_accuracy_pct: answer.accuracy_pct.unwrap_or(0.0),
        majority_accuracy_pct: scores.majority_accuracy_pct.unwrap_or(0.0),
        single_cav_accuracy_pct: recording.cavs.iter().map(alone).collect(),
        labels: labels(recording, &fused),
    })
}

impl IntersectionResult {
    /// The mean of scenes with equally many verdicts; `None` without scenes.
    pub fn mean(name: &str, scenes: &[Self]) -> Option<Self> {
        let first = scenes.first()?;
        let mean = |figure: &dyn Fn(&Self) -> f64| {
            scenes.iter().map(figure).sum::<f64>() / scenes.len() as f64
        };
        let alone = |cav: &NodeName| {
            mean(&|scene| {
                scene
                    .single_cav_accuracy_pct
                    .get(cav)
                    .copied()
                    .unwrap_or(0.0)
            })
        };
        Some(Self {
            name: name.to_owned(),
            scenes: scenes.len() as u64,
            verdicts: scenes.iter().map(|scene| scene.verdicts).sum(),
            vote_accuracy_pct: mean(&|scene| scene.vote_accuracy_pct),
            vote_paper_accuracy_pct: mean(&|scene| scene.vote_paper_accuracy_pct),
            pace_accuracy_pct: mean(&|scene| scene.pace_accuracy_pct),
            answer_accuracy_pct: mean(&|scene| scene.answer_accuracy_pct),
            majority_accuracy_pct: mean(&|scene| scene.majority_accuracy_pct),
            single_cav_accuracy_pct: first
                .single_cav_accuracy_pct
                .keys()
                .map(|cav| (cav.clone(), alone(cav)))
                .collect(),
            labels: Vec::new(),
        })
    }
}

/// Reports that the vehicles would have published, in order of arrival.
pub fn reports(recording: &IntersectionRecording) -> Vec<ObjectReport> {
    let landmarks = Arc::new(LandmarkIndex::new(recording.landmarks(), GATE.radius_m));
    let mut vehicles: Vec<Perception> = recording
        .cavs
        .iter()
        .map(|cav| perception(recording, cav, landmarks.clone()))
        .collect();
    let mut reports = Vec::new();
    for frame in 0..recording.frame_count() {
        for (vehicle, frames) in vehicles.iter_mut().zip(&recording.frames) {
            if let Some(detections) = frames.get(frame) {
                let mut report = vehicle.report(detections.clone(), captured_at(frame));
                name_by_bearing(&mut report, landmarks.landmarks());
                reports.push(report);
            }
        }
    }
    reports
}

/// Assigns every object of unknown size to the location with the smallest angle to it.
fn name_by_bearing(report: &mut ObjectReport, landmarks: &[Landmark]) {
    let Some(camera) = report.pose.map(Pose::from) else {
        return;
    };
    let is_known = |label: &Label| SIZES.iter().any(|(known, ..)| label == known);
    for object in report
        .objects
        .iter_mut()
        .filter(|object| !is_known(&object.label))
    {
        let (range_m, bearing_rad) = camera.range_bearing(&Point2::new(object.x_m, object.y_m));
        let beside_rad = |landmark: &Landmark| {
            let (to_landmark_m, towards_rad) = camera.range_bearing(&landmark.position);
            let is_of_a_size =
                (1.0 / MAX_HEIGHT_FACTOR..=MAX_HEIGHT_FACTOR).contains(&(to_landmark_m / range_m));
            Some(wrap_angle(towards_rad - bearing_rad).abs())
                .filter(|rad| is_of_a_size && *rad <= MAX_BESIDE_RAD)
        };
        let near = landmarks
            .iter()
            .filter_map(|landmark| Some((beside_rad(landmark)?, &landmark.id)));
        object.landmark = near
            .min_by(|(a, _), (b, _)| a.total_cmp(b))
            .map(|(_, id)| id.clone());
    }
}

/// A report as a line of a recording that `replay` reads.
///
/// # Errors
/// Returns an error if it cannot be written as JSON.
pub fn line(report: &ObjectReport, kind: ReportKind) -> serde_json::Result<String> {
    let mut line = serde_json::to_value(report)?;
    line["topic"] = json!(match kind {
        ReportKind::Detections => "detections",
        ReportKind::VoteDetections => "vote_detections",
    });
    serde_json::to_string(&line)
}

/// The maps or verdicts of these algorithms and their accuracy, each frame separately; with both
/// algorithms, the maps are evaluated.
fn fuse(
    recording: &IntersectionRecording,
    reports: &[ObjectReport],
    algorithms: Algorithms,
    mode: VoteMode,
) -> anyhow::Result<(Vec<FusedLine>, Scores)> {
    let landmarks = recording.landmarks();
    let fusion = fusion(algorithms, mode);
    let mut replay = Replay::new(ReplayConfig {
        fusion,
        landmarks: landmarks.clone(),
        ..ReplayConfig::default()
    });
    let mut fused = Vec::new();
    for report in reports {
        // As vehicles send them: votes first.
        if algorithms.vote() {
            fused.append(&mut replay.line(line(report, ReportKind::VoteDetections)?.as_bytes()));
        }
        if algorithms.pace() {
            fused.append(&mut replay.line(line(report, ReportKind::Detections)?.as_bytes()));
        }
    }
    let (mut rest, summary) = replay.finish();
    fused.append(&mut rest);
    if let Some((reason, rejections)) = summary.rejected.first_key_value() {
        anyhow::bail!("{} reports were rejected: {reason}", rejections.lines);
    }
    let index = LandmarkIndex::new(landmarks, GATE.radius_m);
    let mut evaluation = Evaluation::new(truth(recording)?).with_landmarks(index, GATE);
    fused.iter().for_each(|line| evaluation.fused(line));
    reports
        .iter()
        .for_each(|report| evaluation.report(ReportKind::VoteDetections, report));
    let EvalResult { pace, vote } = evaluation.result();
    let chosen = if algorithms.pace() { pace } else { vote };
    let scores = chosen.ok_or_else(|| anyhow::anyhow!("no report, and nothing fused"))?;
    Ok((fused, scores))
}

/// Every frame counts separately.
fn truth(recording: &IntersectionRecording) -> anyhow::Result<Truth> {
    let spans = |accepted: &[Label]| -> Vec<_> {
        (0..recording.frame_count())
            .map(|f| json!({"from_us": captured_at(f), "label": accepted}))
            .collect()
    };
    let objects: serde_json::Map<_, _> = recording
        .objects
        .iter()
        .map(|object| (object.id.to_string(), spans(&object.accepted).into()))
        .collect();
    Ok(Truth::parse(&json!({ "landmarks": objects }).to_string())?)
}

/// The last verdict on every object in every frame.
fn labels(recording: &IntersectionRecording, fused: &[FusedLine]) -> Vec<FrameLabel> {
    let verdicts = |line: &FusedLine| {
        if let FusedLine::Verdicts(v) = line {
            Some(v.clone())
        } else {
            None
        }
    };
    let rounds: Vec<_> = fused.iter().filter_map(verdicts).collect();
    let mut labels = Vec::new();
    for frame in 0..recording.frame_count() {
        let in_frame = captured_at(frame)..captured_at(frame + 1);
        let round = rounds
            .iter()
            .rev()
            .find(|round| in_frame.contains(&round.fused_at_us));
        for object in &recording.objects {
            let verdict =
                round.and_then(|round| round.verdicts.iter().find(|v| v.landmark == object.id));
            let label = verdict.and_then(|verdict| verdict.label.clone());
            let right = label
                .as_ref()
                .is_some_and(|label| object.accepted.contains(label));
            labels.push(FrameLabel {
                frame: frame as u64 + 1,
                landmark: object.id.clone(),
                label,
                right,
            });
        }
    }
    labels
}

fn captured_at(frame: usize) -> Timestamp {
    START + FRAME_INTERVAL * u32::try_from(frame).unwrap_or(u32::MAX)
}

/// A round closes with the last vehicle's report of a frame, at the latest within the time of the
/// next.
fn fusion(algorithms: Algorithms, mode: VoteMode) -> FusionConfig {
    let mut vote = VoteConfig {
        mode,
        ..VoteConfig::default()
    };
    vote.paper.frames_per_verdict = 1;
    vote.weighted.max_range_m = vote.paper.max_range_m;
    let LandmarkGate {
        radius_m: gate_m,
        sigmas: gate_sigmas,
        floor_m: position_floor_m,
    } = GATE;
    FusionConfig {
        algorithms,
        pace: PaceConfig {
            gate_m,
            gate_sigmas,
            position_floor_m,
            ..PaceConfig::default()
        },
        round: RoundConfig {
            period_s: FRAME_INTERVAL.as_secs_f64(),
            ..RoundConfig::default()
        },
        vote,
        ..FusionConfig::default()
    }
}

fn perception(
    recording: &IntersectionRecording,
    cav: &Cav,
    landmarks: Arc<LandmarkIndex>,
) -> Perception {
    let vehicle_camera = VehicleCamera {
        node: cav.name.clone(),
        pose: cav.pose,
        mount: Mount::default(),
        lens: Lens::ideal(recording.intrinsics),
        landmarks,
    };
    let size = |height_m, relative_sigma| ObjectSize {
        relative_sigma,
        ..ObjectSize::square(height_m)
    };
    let labels = SIZES
        .map(|(label, height_m, relative_sigma)| (label.into(), size(height_m, relative_sigma)));
    let projection = ProjectionConfig {
        ranging: Ranging::BoxHeight,
        sizes: ObjectSizes {
            default: Some(size(ANY_HEIGHT_M, 1.0)),
            labels: labels.into(),
        },
        pixel_sigma_px: 4.0,
        heading_sigma_rad: 0.05,
        position_sigma_m: 0.02,
        ..ProjectionConfig::default()
    };
    Perception::new(vehicle_camera, projection, ViewConfig::default(), GATE)
}
