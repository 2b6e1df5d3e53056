//! Milliseconds per frame of every detector.

#[path = "../../benches/figures.rs"]
mod figures;

use std::time::Instant;

use ecod::time::Timestamp;
use ecod_actors::detect::Detect;
use ecod_actors::detect::coco::{CocoConfig, CocoDetector};
use ecod_actors::frame::Frame;
use figures::Figures;
use opencv::imgcodecs;

const FRAMES: usize = 20;

fn main() -> anyhow::Result<()> {
    let mut figures = Figures::new("detectors");
    println!("{:<36} {:>9} {:>10} {:>9} {:>6}", "detector", "least ms", "median ms", "most ms", "found");
    let photograph = photograph("chelsea")?;
    for (name, tiling) in [("coco", false), ("coco_2x2_tiles", true)] {
        let mut coco = CocoDetector::new(CocoConfig { tiling, ..CocoConfig::default() })?;
        time(&mut figures, name, &mut coco, &photograph)?;
    }
    figures.save();
    Ok(())
}

fn time(figures: &mut Figures, name: &str, detector: &mut dyn Detect, frame: &Frame) -> anyhow::Result<()> {
    let found = detector.detect(frame)?.len();
    let mut times_ms = Vec::new();
    for _ in 0..FRAMES {
        let start = Instant::now();
        detector.detect(frame)?;
        times_ms.push(start.elapsed().as_secs_f64() * 1e3);
    }
    times_ms.sort_by(f64::total_cmp);
    let (least, median, most) = (times_ms[0], times_ms[FRAMES / 2], times_ms[FRAMES - 1]);
    println!("{name:<36} {least:>9.1} {median:>10.1} {most:>9.1} {found:>6}");
    figures.insert(
        name,
        serde_json::json!({ "least_ms": least, "median_ms": median, "most_ms": most, "objects_found": found }),
    );
    Ok(())
}

fn photograph(name: &str) -> anyhow::Result<Frame> {
    let path = format!("{}/tests/data/photos/{name}.jpg", env!("CARGO_MANIFEST_DIR"));
    let image = imgcodecs::imread(&path, imgcodecs::IMREAD_COLOR)?;
    Ok(Frame { image, captured_at: Timestamp(0), seq: 1 })
}
