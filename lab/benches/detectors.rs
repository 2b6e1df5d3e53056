//! Milliseconds per frame of every detector, and the time to place targets by their corners.

#[path = "../../benches/figures.rs"]
mod figures;

use std::time::Instant;

use anyhow::Context;
use ecod::model::detection::{BoundingBox, Detection};
use ecod::model::geometry::Pose;
use ecod::model::time::Timestamp;
use ecod::perception::camera::{Intrinsics, Mount};
use ecod::perception::projection::{Cut, ObjectSize, ObjectSizes, Projection, ProjectionConfig};
use ecod_actors::camera::corner_pose::locate_target;
use ecod_actors::camera::detect::Detect;
use ecod_actors::camera::detect::coco::{CocoConfig, CocoDetector};
use ecod_actors::camera::detect::onnx::{OnnxConfig, OnnxDetector};
use ecod_actors::camera::detect::placard::{PlacardConfig, PlacardDetector};
use ecod_actors::camera::frame::CameraFrame;
use ecod_lab::testbed::Testbed;
use ecod_lab::testbed::camera::TestbedCamera;
use nalgebra::Point2;
use opencv::imgcodecs;

use figures::Figures;

const FRAMES: usize = 20;

fn main() -> anyhow::Result<()> {
    let mut figures = Figures::new("detectors");
    println!(
        "{:<36} {:>9} {:>10} {:>9} {:>6}",
        "detector", "least ms", "median ms", "most ms", "found"
    );
    let photograph = photograph("chelsea")?;
    for (name, tiling) in [("coco", false), ("coco_2x2_tiles", true)] {
        let mut coco = CocoDetector::new(CocoConfig {
            tiling,
            ..CocoConfig::default()
        })?;
        time(&mut figures, name, &mut coco, &photograph)?;
    }
    models(&mut figures, &photograph)?;
    let lot = lot()?;
    time(
        &mut figures,
        "placard",
        &mut PlacardDetector::new(PlacardConfig::default()),
        &lot,
    )?;
    corners(&mut figures)?;
    figures.save();
    Ok(())
}

/// Every model of the directory that `ONNX_MODELS` names, if any.
fn models(figures: &mut Figures, photograph: &CameraFrame) -> anyhow::Result<()> {
    let Some(directory) = std::env::var_os("ONNX_MODELS") else {
        return Ok(());
    };
    let mut paths: Vec<_> = std::fs::read_dir(directory)?
        .map(|file| Ok(file?.path()))
        .collect::<anyhow::Result<_>>()?;
    paths.retain(|path| path.extension().is_some_and(|end| end == "onnx"));
    paths.sort();
    for path in paths {
        let name = path
            .file_stem()
            .context("a file name")?
            .to_string_lossy()
            .into_owned();
        time(
            figures,
            &name,
            &mut OnnxDetector::new(OnnxConfig::of(path))?,
            photograph,
        )?;
    }
    Ok(())
}

/// From four corners to a position and its covariance, 10² to 10⁶ times.
fn corners(figures: &mut Figures) -> anyhow::Result<()> {
    let intrinsics =
        Intrinsics::from_field_of_view(640, 480, 62.2f64.to_radians(), 48.8f64.to_radians());
    let side_m = 0.05;
    let sizes = ObjectSizes {
        default: Some(ObjectSize::square(side_m)),
        ..ObjectSizes::default()
    };
    let projection = Projection::new(
        ProjectionConfig {
            sizes,
            ..ProjectionConfig::default()
        },
        intrinsics,
        Mount::default(),
    );
    let targets: Vec<[Point2<f64>; 4]> = (0..1000).map(target).collect();
    println!("\n{:<36} {:>9} {:>14}", "projector", "targets", "µs/target");
    let mut costs = Vec::new();
    for count in [100, 1_000, 10_000, 100_000, 1_000_000] {
        let start = Instant::now();
        for corners in targets.iter().cycle().take(count) {
            let detection = Detection {
                label: "ABCD123".into(),
                confidence: 0.9,
                bounding_box: BoundingBox::around(corners),
                corners: Some(*corners),
            };
            let middle = locate_target(corners, side_m, &intrinsics)?;
            std::hint::black_box(projection.place(
                &detection,
                Cut::default(),
                Some(&middle),
                &Pose::new(0.61, 0.46, 2.88),
            )?);
        }
        let cost_us = start.elapsed().as_secs_f64() * 1e6 / count as f64;
        println!("{:<36} {count:>9} {cost_us:>14.2}", "corners");
        figures.insert(
            format!("corners_{count}"),
            serde_json::json!({ "us_per_target": cost_us }),
        );
        costs.push(cost_us);
    }
    figures.flat("corners_cost_per_target", &costs);
    Ok(())
}

/// The corners of an upright target that is turned to the side.
fn target(index: usize) -> [Point2<f64>; 4] {
    let left = 20.0 + (index % 500) as f64;
    let top = 100.0 + (index % 37) as f64;
    let side = 40.0 + (index % 50) as f64;
    [(0.0, 0.0), (0.9, 0.05), (0.9, 0.95), (0.0, 1.0)]
        .map(|(x, y)| Point2::new(left + x * side, top + y * side))
}

/// Frame of the first vehicle in the first recorded parking lot.
fn lot() -> anyhow::Result<CameraFrame> {
    let path = format!(
        "{}/../examples/testbed/pace_setup1.json",
        env!("CARGO_MANIFEST_DIR")
    );
    let testbed = Testbed::from_json(&std::fs::read_to_string(path)?)?;
    let scene = testbed.scenes.first().context("a scene")?;
    let cav = scene.cavs.first().context("a vehicle")?;
    let image = TestbedCamera::new(&testbed, scene, cav, 1)?.frame(0)?;
    Ok(CameraFrame {
        image,
        captured_at: Timestamp(0),
        seq: 1,
    })
}

fn time(
    figures: &mut Figures,
    name: &str,
    detector: &mut dyn Detect,
    frame: &CameraFrame,
) -> anyhow::Result<()> {
    let found = detector.detect(frame)?.len();
    let mut times_ms = Vec::new();
    for _ in 0..FRAMES {
        let start = Instant::now();
        detector.detect(frame)?;
        times_ms.push(start.elapsed().as_secs_f64() * 1e3);
    }
    times_ms.sort_by(f64::total_cmp);
    let least = times_ms[0];
    let median = times_ms[FRAMES / 2];
    let most = times_ms[FRAMES - 1];
    println!("{name:<36} {least:>9.1} {median:>10.1} {most:>9.1} {found:>6}");
    figures.insert(
        name,
        serde_json::json!({ "least_ms": least, "median_ms": median, "most_ms": most, "objects_found": found }),
    );
    Ok(())
}

fn photograph(name: &str) -> anyhow::Result<CameraFrame> {
    let path = format!(
        "{}/../actors/tests/data/photos/{name}.jpg",
        env!("CARGO_MANIFEST_DIR")
    );
    let image = imgcodecs::imread(&path, imgcodecs::IMREAD_COLOR)?;
    Ok(CameraFrame {
        image,
        captured_at: Timestamp(0),
        seq: 1,
    })
}
