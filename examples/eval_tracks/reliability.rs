//! Reliability diagrams: the share of objects that are right, over the stated probability.

use std::path::Path;

use ecod_lab::eval::ReliabilityBin;
use ecod_lab::eval::tracks::ReliabilityBins;
use plotters::prelude::*;

/// The scenes that are drawn, by name.
const DRAWN: [(&str, RGBColor); 5] = [
    ("1", RGBColor(150, 150, 150)),
    ("2", RGBColor(214, 130, 20)),
    ("8", RGBColor(40, 110, 200)),
    ("32", RGBColor(30, 140, 70)),
    ("recorded", RGBColor(190, 20, 60)),
];

/// Number of bins of equal width.
const BINS: usize = 10;

/// Minimum number of objects in a bin that is drawn.
const MIN_OBJECTS: u64 = 50;

/// Draws a panel for `confidence` and one for `existence`; `stated` has the calibrations of all seeds by scene.
pub(crate) fn draw(path: &Path, stated: &[(String, Vec<ReliabilityBins>)]) -> anyhow::Result<()> {
    let area = SVGBackend::new(path, (800, 430)).into_drawing_area();
    area.fill(&WHITE)?;
    let (legend, panels) = area.split_vertically(30);
    for (number, (name, color)) in DRAWN.into_iter().enumerate() {
        let x = 20 + 130 * number as i32;
        legend.draw(&PathElement::new(
            [(x, 16), (x + 26, 16)],
            color.stroke_width(3),
        ))?;
        legend.draw(&Text::new(name, (x + 34, 8), ("sans-serif", 16)))?;
    }
    let confidence = |calibration: &ReliabilityBins| calibration.confidence.bins.clone();
    let existence = |calibration: &ReliabilityBins| {
        calibration
            .existence
            .as_ref()
            .map(|existence| existence.bins.clone())
            .unwrap_or_default()
    };
    let kinds: [(&str, BinsOf); 2] = [("confidence", &confidence), ("existence", &existence)];
    for (panel, (kind, bins)) in panels.split_evenly((1, 2)).iter().zip(kinds) {
        let mut chart = ChartBuilder::on(panel)
            .margin(8)
            .margin_right(20)
            .caption(kind, ("sans-serif", 16))
            .x_label_area_size(34)
            .y_label_area_size(44)
            .build_cartesian_2d(0.0..100.0, 0.0..100.0)?;
        chart
            .configure_mesh()
            .x_labels(6)
            .y_labels(6)
            .x_desc("stated %")
            .y_desc("right %")
            .light_line_style(WHITE)
            .draw()?;
        chart.draw_series(LineSeries::new(
            [(0.0, 0.0), (100.0, 100.0)],
            BLACK.mix(0.4),
        ))?;
        for (name, color) in DRAWN {
            let of_scene = stated
                .iter()
                .filter(|(scene, _)| scene == name)
                .flat_map(|(_, seeds)| seeds);
            let points = pooled(of_scene.flat_map(bins));
            chart.draw_series(LineSeries::new(points.clone(), color.stroke_width(2)))?;
            chart.draw_series(
                points
                    .into_iter()
                    .map(|at| Circle::new(at, 3, color.filled())),
            )?;
        }
    }
    area.present()?;
    Ok(())
}

/// The bins of one kind of stated probability.
type BinsOf<'a> = &'a dyn Fn(&ReliabilityBins) -> Vec<ReliabilityBin>;

/// Stated and right percentages of the bins of several recordings together.
fn pooled(bins: impl Iterator<Item = ReliabilityBin>) -> Vec<(f64, f64)> {
    let mut sums = [(0u64, 0.0, 0.0); BINS];
    for ReliabilityBin {
        stated_pct,
        right_pct,
        objects,
    } in bins
    {
        let bin = ((stated_pct / 100.0 * BINS as f64) as usize).min(BINS - 1);
        let (count, stated, right) = &mut sums[bin];
        *count += objects;
        *stated += stated_pct * objects as f64;
        *right += right_pct * objects as f64;
    }
    let filled = sums.into_iter().filter(|(count, ..)| *count >= MIN_OBJECTS);
    filled
        .map(|(count, stated, right)| (stated / count as f64, right / count as f64))
        .collect()
}
