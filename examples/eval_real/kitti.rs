//! KITTI tracking: the validation sequences of AB3DMOT with detections of PointRCNN.
//!
//! One vehicle reports in a frame that goes with it, as the recording has no pose there.

use std::fs;
use std::path::Path;

use anyhow::Context;
use ecod::model::names::NodeName;
use ecod::wire::{ObjectReport, PerceivedObject};
use ecod_lab::eval::formats::{FileFormat, FileObject, Sequence, time_of};

use super::{Recording, write_reports};

const REPOSITORY: &str = "xinshuoweng/AB3DMOT";

pub(super) const DETECTIONS: (&str, &str) = ("AB3DMOT/data/KITTI/detection", REPOSITORY);

pub(super) const TRUTH: (&str, &str) = ("AB3DMOT/scripts/KITTI/label", REPOSITORY);

/// The sequences on which PointRCNN was not trained, by `scripts/KITTI/evaluate_tracking.seqmap.val`.
const SEQUENCES: [&str; 11] = ["0001", "0006", "0008", "0010", "0012", "0013", "0014", "0015", "0016", "0018", "0019"];

const FRAME_RATE: &str = "10";

pub(super) fn convert(detections: &Path, truth: &Path, work: &Path) -> anyhow::Result<Recording> {
    let recording = Recording {
        name: "KITTI",
        format: "kitti",
        frame_rate: FRAME_RATE,
        truth: work.join("truth"),
        detections: work.join("detections"),
        reports: work.join("reports.jsonl"),
    };
    fs::create_dir(&recording.truth)?;
    fs::create_dir(&recording.detections)?;
    let read = |path: &Path| fs::read_to_string(path).with_context(|| format!("cannot read {}", path.display()));
    for sequence in SEQUENCES {
        let file = format!("{sequence}.txt");
        fs::write(recording.truth.join(&file), read(&truth.join(&file))?)?;
        let mut merged = String::new();
        for class in ["Car", "Pedestrian", "Cyclist"] {
            let path = detections.join(format!("pointrcnn_{class}_val")).join(&file);
            merged += &read(&path)?;
        }
        fs::write(recording.detections.join(&file), merged)?;
    }
    let (truth, detections) =
        (FileFormat::Kitti.read(&recording.truth)?, FileFormat::Kitti.read(&recording.detections)?);
    let mut reports = Vec::new();
    for (number, (truth, detections)) in truth.iter().zip(&detections).enumerate() {
        let last = truth.frames.keys().last().copied().unwrap_or(0);
        reports.extend((0..=last).map(|frame| report(number, frame, detections)));
    }
    write_reports(&recording.reports, reports)?;
    Ok(recording)
}

fn report(sequence: usize, frame: u64, detections: &Sequence) -> ObjectReport {
    let object = |object: &FileObject| {
        PerceivedObject::new(object.label.clone(), object.score, object.position.x, object.position.y)
    };
    let at = time_of(sequence, frame, 10.0);
    ObjectReport {
        objects: detections.frames.get(&frame).into_iter().flatten().map(object).collect(),
        ..ObjectReport::new(NodeName::from_static("kitti"), frame, at)
    }
}
