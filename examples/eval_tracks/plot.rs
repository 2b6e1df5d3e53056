//! Every figure over the number of vehicles.

use std::path::Path;

use anyhow::Context;
use plotters::prelude::*;

use super::{FIGURES, Figures, METHODS};

const COLORS: [RGBColor; METHODS.len()] = [
    RGBColor(150, 150, 150),
    RGBColor(214, 130, 20),
    RGBColor(40, 110, 200),
    RGBColor(190, 20, 60),
];

/// The figures that are drawn, by their place in the table, in three columns.
const DRAWN: [usize; 6] = [0, 2, 4, 5, 6, 7];

/// Draws a panel for each figure; `courses` has the figures of all methods by the number of vehicles.
pub(crate) fn draw(
    path: &Path,
    courses: &[(usize, [Figures; METHODS.len()])],
) -> anyhow::Result<()> {
    let last = courses.len().checked_sub(1).context("no figures to draw")?;
    let area = SVGBackend::new(path, (960, 640)).into_drawing_area();
    area.fill(&WHITE)?;
    let (legend, panels) = area.split_vertically(30);
    for (number, (name, color)) in METHODS.iter().zip(COLORS).enumerate() {
        let x = 20 + 170 * number as i32;
        legend.draw(&PathElement::new(
            [(x, 16), (x + 26, 16)],
            color.stroke_width(3),
        ))?;
        legend.draw(&Text::new(*name, (x + 34, 8), ("sans-serif", 16)))?;
    }
    for (panel, figure) in panels.split_evenly((2, 3)).iter().zip(DRAWN) {
        let values = courses
            .iter()
            .flat_map(|(_, methods)| methods.iter().map(|figures| figures[figure]));
        let lowest = (values.fold(100.0, f64::min).max(-20.0) / 10.0).floor() * 10.0;
        let mut chart = ChartBuilder::on(panel)
            .margin(8)
            .margin_right(20)
            .caption(format!("{} %", FIGURES[figure]), ("sans-serif", 16))
            .x_label_area_size(34)
            .y_label_area_size(36)
            .build_cartesian_2d(-0.2..last as f64 + 0.2, lowest..100.0)?;
        // The numbers of vehicles nearly double from point to point, so the points have equal distances.
        let name = |x: &f64| {
            let is_point = (x - x.round()).abs() < 0.01;
            courses
                .get(x.round() as usize)
                .filter(|_| is_point)
                .map_or(String::new(), |(vehicles, _)| vehicles.to_string())
        };
        chart
            .configure_mesh()
            .x_labels(courses.len() + 1)
            .x_label_formatter(&name)
            .y_labels(6)
            .y_label_formatter(&|y| format!("{y:.0}"))
            .x_desc("vehicles")
            .light_line_style(WHITE)
            .draw()?;
        for (method, color) in COLORS.into_iter().enumerate() {
            let points = courses
                .iter()
                .enumerate()
                .map(|(place, (_, methods))| (place as f64, methods[method][figure]));
            chart.draw_series(LineSeries::new(points.clone(), color.stroke_width(2)))?;
            chart.draw_series(points.map(|at| Circle::new(at, 3, color.filled())))?;
        }
    }
    area.present()?;
    Ok(())
}
