//! KITTI tracking: the validation sequences of AB3DMOT with detections of PointRCNN.
//!
//! One vehicle reports in its own moving frame, because the recording has no poses in a fixed frame.

use std::fs;
use std::path::Path;

use anyhow::Context;
use ecod::model::names::NodeName;
use ecod_lab::eval::formats::{FileContext, FileFormat};

use super::{Recording, write_reports};

const REPOSITORY: &str = "xinshuoweng/AB3DMOT";

pub(super) const DETECTIONS: (&str, &str) = ("AB3DMOT/data/KITTI/detection", REPOSITORY);

pub(super) const TRUTH: (&str, &str) = ("AB3DMOT/scripts/KITTI/label", REPOSITORY);

/// The sequences on which PointRCNN was not trained, by `scripts/KITTI/evaluate_tracking.seqmap.val`. The first six
/// sequences were used to fit parameters of tracks.
pub(super) const SEQUENCES: [&str; 11] = [
    "0001", "0006", "0008", "0010", "0012", "0013", "0014", "0015", "0016", "0018", "0019",
];

const FRAME_RATE: &str = "10";

/// Number of sequences that were used for the fit.
pub(super) const FITTED: usize = 6;

pub(super) fn convert(
    name: &'static str,
    sequences: &[&str],
    detections: &Path,
    truth: &Path,
    work: &Path,
) -> anyhow::Result<Recording> {
    let folders = ["truth", "detections"].map(|kind| work.join(kind));
    folders.iter().try_for_each(fs::create_dir)?;
    let [own_truth, own_detections] = folders;
    let read = |path: &Path| {
        fs::read_to_string(path).with_context(|| format!("cannot read {}", path.display()))
    };
    for sequence in sequences {
        let file = format!("{sequence}.txt");
        fs::write(own_truth.join(&file), read(&truth.join(&file))?)?;
        let mut merged = String::new();
        for class in ["Car", "Pedestrian", "Cyclist"] {
            let path = detections
                .join(format!("pointrcnn_{class}_val"))
                .join(&file);
            merged += &read(&path)?;
        }
        fs::write(own_detections.join(&file), merged)?;
    }
    let truth = FileFormat::Kitti.read(&own_truth, FileContext::default())?;
    let detections = FileFormat::Kitti.read(&own_detections, FileContext::default())?;
    let mut reports = Vec::new();
    for (number, (truth, detections)) in truth.iter().zip(&detections).enumerate() {
        reports.extend(detections.reports(
            number,
            10.0,
            &NodeName::from_static("kitti"),
            truth.last(),
        ));
    }
    let path = work.join("reports.jsonl");
    write_reports(&path, reports)?;
    Ok(Recording {
        name,
        format: "kitti",
        frame_rate: FRAME_RATE,
        truth: own_truth,
        others: vec![("detections".to_owned(), own_detections)],
        reports: path,
        is_fused: false,
    })
}
