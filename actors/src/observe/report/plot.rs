//! SVG plots, coloured by the page's style sheet.

use svg::Document;
use svg::node::element::{Group, Line, Polyline, Rectangle, Text, Title};

/// A curve of a plot.
#[derive(Debug)]
pub(super) struct Curve {
    pub(super) name: String,
    pub(super) points: Vec<(f64, f64)>,
}

/// Curves over a common axis.
#[derive(Debug)]
pub(super) struct Plot<'a> {
    /// Description for screen readers.
    pub(super) title: &'a str,
    pub(super) x_label: &'a str,
    pub(super) y_label: &'a str,
    pub(super) curves: Vec<Curve>,
    /// Vertical lines and their descriptions.
    pub(super) marks: Vec<(f64, String)>,
    pub(super) x: Axis,
}

#[derive(Debug, Clone, Copy)]
pub(super) enum Axis {
    /// From 0 to this.
    Linear(f64),
    /// Powers of ten around all points, six at most.
    Logarithmic,
}

/// Number of colours; further curves repeat them dashed.
pub(super) const COLOURS: usize = 6;

const WIDTH: f64 = 720.0;
const HEIGHT: f64 = 250.0;
const LEFT: f64 = 56.0;
const RIGHT: f64 = 22.0;
const TOP: f64 = 26.0;
const BOTTOM: f64 = 40.0;
const BAR: f64 = 24.0;
const TICKS: f64 = 6.0;

impl Plot<'_> {
    pub(super) fn draw(&self) -> String {
        let points = || self.curves.iter().flat_map(|curve| &curve.points);
        let scale = Scale::new(self.x, points().map(|point| point.0));
        let highest = points()
            .filter(|point| scale.shows(point.0))
            .map(|point| point.1)
            .fold(0.0, f64::max)
            .max(1e-9);
        let y_step = step(highest * 1.05);
        let y_max = (highest / y_step).ceil() * y_step;
        let x = |value: f64| LEFT + (WIDTH - LEFT - RIGHT) * scale.share(value);
        let y = |value: f64| HEIGHT - BOTTOM - (HEIGHT - TOP - BOTTOM) * value / y_max;
        let mut picture = picture(self.title, HEIGHT);
        for value in ticks(y_step, y_max) {
            picture = picture.add(line("grid", LEFT, y(value), WIDTH - RIGHT, y(value)));
            picture = picture.add(text(
                "tick",
                "end",
                LEFT - 6.0,
                y(value) + 4.0,
                &number(value),
            ));
        }
        for value in scale.ticks() {
            picture = picture.add(text(
                "tick",
                "middle",
                x(value),
                HEIGHT - BOTTOM + 16.0,
                &number(value),
            ));
        }
        picture = picture
            .add(line(
                "axis",
                LEFT,
                HEIGHT - BOTTOM,
                WIDTH - RIGHT,
                HEIGHT - BOTTOM,
            ))
            .add(text(
                "label",
                "middle",
                (LEFT + WIDTH - RIGHT) / 2.0,
                HEIGHT - 6.0,
                self.x_label,
            ))
            .add(text("label", "start", 4.0, TOP - 12.0, self.y_label));
        for (at, what) in &self.marks {
            let mark = line("mark", x(*at), TOP, x(*at), HEIGHT - BOTTOM);
            picture = picture.add(Group::new().add(mark).add(Title::new(what.as_str())));
        }
        for (index, curve) in self.curves.iter().enumerate() {
            let shown = curve.points.iter().filter(|point| scale.shows(point.0));
            let points: Vec<_> = shown
                .map(|point| format!("{:.1},{:.1}", x(point.0), y(point.1)))
                .collect();
            let title = Title::new(curve.name.as_str());
            picture = picture.add(
                Group::new().add(title).add(
                    Polyline::new()
                        .set("class", format!("curve {}", class(index)))
                        .set("points", points.join(" ")),
                ),
            );
        }
        picture.to_string()
    }
}

/// Mapping of values to a horizontal axis.
#[derive(Debug)]
enum Scale {
    Linear { max: f64 },
    Logarithmic { min: i32, max: i32 },
}

/// Maximum powers of ten on a logarithmic axis.
const DECADES: i32 = 6;

impl Scale {
    fn new(axis: Axis, values: impl Iterator<Item = f64>) -> Self {
        match axis {
            Axis::Linear(max) => Self::Linear { max: max.max(1e-9) },
            Axis::Logarithmic => {
                let (min, max) = values
                    .filter(|value| *value > 0.0)
                    .fold((f64::INFINITY, 0.0), |(min, max): (f64, f64), value| {
                        (value.min(min), value.max(max))
                    });
                let max = if max > 0.0 {
                    max.log10().ceil() as i32
                } else {
                    0
                };
                let min = if min.is_finite() {
                    min.log10().floor() as i32
                } else {
                    max
                };
                Self::Logarithmic {
                    min: min.clamp(max - DECADES, max - 1),
                    max,
                }
            }
        }
    }

    /// Position of a value from 0 to 1; smaller values are at 0.
    fn share(&self, value: f64) -> f64 {
        match self {
            Self::Linear { max } => value / max,
            Self::Logarithmic { min, max } => {
                let min = f64::from(*min);
                (value.max(10f64.powf(min)).log10() - min) / (f64::from(*max) - min)
            }
        }
    }

    fn shows(&self, value: f64) -> bool {
        self.share(value) <= 1.0 + 1e-9
    }

    fn ticks(&self) -> Vec<f64> {
        match *self {
            Self::Linear { max } => ticks(step(max), max).collect(),
            Self::Logarithmic { min, max } => (min..=max).map(|power| 10f64.powi(power)).collect(),
        }
    }
}

/// Horizontal bars of shares in percent.
pub fn bars(title: &str, shares: &[(String, f64)]) -> String {
    let height = BAR * shares.len() as f64 + 8.0;
    let left = 160.0;
    let width = WIDTH - 160.0 - 60.0;
    let mut picture = picture(title, height);
    for (index, (name, share)) in shares.iter().enumerate() {
        let y = 4.0 + BAR * index as f64;
        let bar = Rectangle::new()
            .set("class", "bar")
            .set("x", left)
            .set("y", y + 3.0)
            .set("rx", 2);
        picture = picture
            .add(text("tick", "end", left - 8.0, y + BAR / 2.0 + 4.0, name))
            .add(
                bar.set(
                    "width",
                    format!("{:.1}", width * (share / 100.0).clamp(0.0, 1.0)),
                )
                .set("height", BAR - 6.0),
            )
            .add(text(
                "tick",
                "start",
                left + width * share / 100.0 + 6.0,
                y + BAR / 2.0 + 4.0,
                &format!("{share:.1} %"),
            ));
    }
    picture.to_string()
}

/// The class of a curve, for its colour.
pub(super) fn class(index: usize) -> String {
    let dashed = if index / COLOURS % 2 == 1 {
        " dashed"
    } else {
        ""
    };
    format!("c{}{dashed}", index % COLOURS)
}

fn picture(title: &str, height: f64) -> Document {
    let document = Document::new()
        .set("viewBox", (0.0, 0.0, WIDTH, height))
        .set("role", "img");
    document
        .set("aria-label", title)
        .set("preserveAspectRatio", "xMinYMin meet")
}

fn line(class: &str, x1: f64, y1: f64, x2: f64, y2: f64) -> Line {
    let round = |value: f64| format!("{value:.1}");
    Line::new()
        .set("class", class)
        .set("x1", round(x1))
        .set("y1", round(y1))
        .set("x2", round(x2))
        .set("y2", round(y2))
}

fn text(class: &str, anchor: &str, x: f64, y: f64, content: &str) -> Text {
    let text = Text::new(content)
        .set("class", class)
        .set("text-anchor", anchor);
    text.set("x", format!("{x:.1}")).set("y", format!("{y:.1}"))
}

/// Step between ticks: 1, 2 or 5 times a power of ten.
fn step(max: f64) -> f64 {
    let rough = max / TICKS;
    let power = 10f64.powf(rough.log10().floor());
    [1.0, 2.0, 5.0, 10.0]
        .map(|factor| factor * power)
        .into_iter()
        .find(|step| *step >= rough)
        .unwrap_or(10.0 * power)
}

fn ticks(step: f64, max: f64) -> impl Iterator<Item = f64> {
    (0..=(max / step + 1e-6) as u32).map(move |n| f64::from(n) * step)
}

/// A number without trailing zeros.
pub(super) fn number(value: f64) -> String {
    let rounded = format!("{value:.4}");
    let short = rounded.trim_end_matches('0').trim_end_matches('.');
    if short.is_empty() {
        "0".into()
    } else {
        short.into()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn axes_have_few_round_ticks() {
        for (max, expected) in [(1.0, 0.2), (0.07, 0.02), (3600.0, 1000.0), (59.0, 10.0)] {
            assert!((step(max) - expected).abs() < 1e-12, "{max}: {}", step(max));
            assert!((3..=8).contains(&ticks(step(max), max).count()), "{max}");
        }
        assert_eq!([0.0, 0.2, 1000.0].map(number), ["0", "0.2", "1000"]);
    }

    #[test]
    fn logarithmic_axis_spans_powers() {
        let scale = Scale::new(Axis::Logarithmic, [0.0, 0.3, 45.0, 941.0].into_iter());
        assert_eq!(scale.ticks(), [0.1, 1.0, 10.0, 100.0, 1000.0]);
        assert_eq!(
            [0.0, 0.1, 10.0, 1000.0].map(|value| scale.share(value)),
            [0.0, 0.0, 0.5, 1.0]
        );
        assert_eq!(
            Scale::new(Axis::Logarithmic, [1e-9, 1.0].into_iter())
                .ticks()
                .len(),
            7
        );
    }

    #[test]
    fn any_plot_is_well_formed() {
        let curve = |points: Vec<(f64, f64)>| Curve {
            name: "<a & b>".into(),
            points,
        };
        for points in [vec![], vec![(0.0, 0.0)], vec![(0.0, 1.0), (5.0, 2.0)]] {
            let marks = vec![(1.0, "new \"leader\" <x>".into())];
            let curves = vec![curve(points)];
            let mut plot = Plot {
                title: "t & u",
                x_label: "s",
                y_label: "ms",
                curves,
                marks,
                x: Axis::Linear(0.0),
            };
            for x in [Axis::Linear(0.0), Axis::Linear(5.0), Axis::Logarithmic] {
                plot.x = x;
                let drawn = plot.draw();
                let document = roxmltree::Document::parse(&drawn)
                    .unwrap_or_else(|error| panic!("{error}: {drawn}"));
                assert!(
                    ["NaN", "inf"].iter().all(|text| !drawn.contains(text)),
                    "{drawn}"
                );
                assert!(
                    document
                        .descendants()
                        .any(|node| node.has_tag_name("polyline"))
                );
            }
        }
        assert!(roxmltree::Document::parse(&bars("b", &[("a<b".into(), 120.0)])).is_ok());
    }
}
