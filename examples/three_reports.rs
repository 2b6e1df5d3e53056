//! Fuses the reports of three vehicles in memory, without clock, socket and broker.
//!
//! `cargo run --example three_reports`

use std::sync::Arc;

use ecod::aggregator::{Aggregator, FusionConfig};
use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ecod::perception::landmark::{Landmark, LandmarkConfig};
use ecod::wire::{ObjectReport, ReportKind, decode_report};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let slots = [("slot-0", 0.0), ("slot-1", 3.0), ("slot-2", 6.0)];
    let landmarks = slots
        .map(|(id, x_m)| Landmark::from(&LandmarkConfig::at(id, x_m, 0.0)))
        .into();

    // Time is an argument: equal inputs give equal maps.
    let start = Timestamp(1_732_154_400_000_000);
    let mut cell = Aggregator::new(
        NodeName::new("edge")?,
        1,
        FusionConfig::default(),
        landmarks,
        start,
    );

    // Two vehicles read slot-0 and agree, one reads slot-1, and slot-2 is empty for all.
    for frame in 0..4 {
        let now = start.shifted(100_000 * (frame + 1));
        for (node, object) in [
            (
                "euclid",
                r#"{"label":"ABC123","confidence":0.9,"x_m":0.1,"y_m":0.1}"#,
            ),
            (
                "galileo",
                r#"{"label":"ABC123","confidence":0.8,"x_m":-0.1,"y_m":0.0}"#,
            ),
            (
                "riemann",
                r#"{"label":"XYZ789","confidence":0.7,"x_m":3.0,"y_m":0.2}"#,
            ),
        ] {
            let json = format!(
                r#"{{"schema":1,"node":"{node}","seq":{frame},"captured_at_us":{now},"objects":[{object}],"seen":["slot-2"]}}"#,
                now = now.micros(),
            );
            let report: ObjectReport =
                decode_report(json.as_bytes(), &NodeName::new(node)?, &Default::default())?;
            let fused = cell.report(ReportKind::Detections, &Arc::new(report), now)?;
            if let Some(map) = fused.and_then(|fused| fused.map) {
                println!("round {}", map.round);
                for place in map.landmarks {
                    let known = if place.observers.is_empty() {
                        "unknown"
                    } else {
                        "empty"
                    };
                    println!(
                        "  {}: {} ({:.3}) at {:.2}, {:.2} by {:?}",
                        place.id,
                        place.label.as_deref().unwrap_or(known),
                        place.confidence,
                        place.x_m,
                        place.y_m,
                        place.contributors,
                    );
                }
            }
        }
    }
    Ok(())
}
