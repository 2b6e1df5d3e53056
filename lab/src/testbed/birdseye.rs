//! A scene seen from above, as a picture: the vehicles, their detections, and the agreed labels.

mod sheet;
#[cfg(test)]
mod tests;

use ecod::model::geometry::Pose;
use ecod::model::names::{Label, LandmarkId, NodeName};
use ecod::wire::{GlobalMap, LandmarkState};
use nalgebra::Point2;
use svg::Document;
use svg::node::element::{Circle, ClipPath, Definitions, Group, Line, Path, Text};

use super::score::is_right;
use crate::drawing::{INK, page, round};
use crate::testbed::{Cav, Scene, Spot, Testbed};
use sheet::{METRES_PER_INCH, Sheet};

/// Draws a scene as a self-contained SVG, in inches.
///
/// `detections` are places in the world with the vehicle that saw them; places outside the frame
/// are not drawn but counted in the legend. Spots are evaluated as in [`super::score`].
///
/// # Errors
/// Returns a [`BirdseyeError`] if a detection is not from one of the scene's vehicles, or a place
/// is not finite.
pub fn birdseye(
    testbed: &Testbed,
    scene: &Scene,
    detections: &[(NodeName, Point2<f64>)],
    map: Option<&GlobalMap>,
) -> Result<String, BirdseyeError> {
    check(scene, detections, map)?;
    let picture = BirdseyePicture {
        testbed,
        scene,
        map,
        sheet: Sheet::around(scene),
    };
    Ok(picture.draw(detections).to_string() + "\n")
}

/// A scene that cannot be drawn.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum BirdseyeError {
    /// A detection names a vehicle that the scene does not have.
    #[error("scene {scene} has no vehicle {node}, which a detection names")]
    Stranger {
        /// Name of the scene.
        scene: String,
        /// Name of the vehicle.
        node: NodeName,
    },
    /// A detection's place is not a number.
    #[error("a detection of {node} is at a place that is not finite")]
    Detection {
        /// Name of the vehicle.
        node: NodeName,
    },
    /// A fused place is not a number.
    #[error("the map has {landmark} at a place that is not finite")]
    Landmark {
        /// Name of the landmark.
        landmark: LandmarkId,
    },
}

fn check(
    scene: &Scene,
    detections: &[(NodeName, Point2<f64>)],
    map: Option<&GlobalMap>,
) -> Result<(), BirdseyeError> {
    for (node, place) in detections {
        if !scene.cavs.iter().any(|cav| cav.name == *node) {
            return Err(BirdseyeError::Stranger {
                scene: scene.name.clone(),
                node: node.clone(),
            });
        }
        if !(place.x.is_finite() && place.y.is_finite()) {
            return Err(BirdseyeError::Detection { node: node.clone() });
        }
    }
    match map
        .into_iter()
        .flat_map(|map| &map.landmarks)
        .find(|state| !(state.x_m.is_finite() && state.y_m.is_finite()))
    {
        Some(state) => Err(BirdseyeError::Landmark {
            landmark: state.id.clone(),
        }),
        None => Ok(()),
    }
}

/// Comparison of a spot's label in the map with the truth.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum MarkKind {
    Right,
    Wrong,
    Unknown,
}

impl MarkKind {
    fn of(is_right: Option<bool>) -> Self {
        match is_right {
            None => Self::Unknown,
            Some(true) => Self::Right,
            Some(false) => Self::Wrong,
        }
    }

    fn color(self) -> &'static str {
        match self {
            Self::Right => "#007a5a",
            Self::Wrong => "#d1420f",
            Self::Unknown => "#767676",
        }
    }

    /// A mark around `(x, y)` that shows the result independent of its colour: ring, cross, dashed
    /// ring.
    fn mark(self, x: f64, y: f64) -> Group {
        let ring = || {
            Circle::new()
                .set("cx", round(x))
                .set("cy", round(y))
                .set("r", 8)
        };
        let group = Group::new()
            .set("fill", "none")
            .set("stroke", self.color())
            .set("stroke-width", 2.5);
        match self {
            Self::Right => group.add(ring()),
            Self::Wrong => {
                let cross = format!("M{} {}l14 14m0 -14l-14 14", round(x - 7.0), round(y - 7.0));
                group.add(Path::new().set("d", cross))
            }
            Self::Unknown => {
                group.add(ring().set("stroke-dasharray", "3 3").set("stroke-width", 2))
            }
        }
    }
}

/// Fill of each vehicle in turn: colours of Okabe and Ito that differ clearly from the colours of a
/// [`MarkKind`].
const VEHICLE_COLORS: [&str; 5] = ["#0072b2", "#e69f00", "#cc79a7", "#56b4e9", "#000000"];
const FAINT: &str = "#8a8a8a";
/// Height of a line of text in pixels.
const LINE_PX: f64 = 18.0;
/// Longest text in characters; the rest is cut.
const LONGEST_TEXT: usize = 12;

struct BirdseyePicture<'a> {
    testbed: &'a Testbed,
    scene: &'a Scene,
    map: Option<&'a GlobalMap>,
    sheet: Sheet,
}

impl BirdseyePicture<'_> {
    fn draw(&self, detections: &[(NodeName, Point2<f64>)]) -> Document {
        let sheet = &self.sheet;
        let (width, height) = sheet.size();
        let clip = ClipPath::new().set("id", "frame").add(sheet.frame());
        let inside = Group::new()
            .set("clip-path", "url(#frame)")
            .add(self.vehicles_parked())
            .add(self.cones())
            .add(self.placards())
            .add(self.dots(detections))
            .add(self.marks());
        let beyond = detections
            .iter()
            .filter(|(_, place)| !sheet.holds(place))
            .count();
        page(width, height, 13)
            .add(Definitions::new().add(clip))
            .add(self.title())
            .add(sheet.axes())
            .add(inside)
            .add(sheet.frame().set("fill", "none").set("stroke", FAINT))
            .add(self.cameras())
            .add(self.table())
            .add(self.legend(beyond))
    }

    fn title(&self) -> Group {
        let right = self
            .scene
            .spots
            .iter()
            .filter(|spot| self.judge(spot) == MarkKind::Right)
            .count();
        let all = self.scene.spots.len();
        let share = match self.map {
            Some(_) if all > 0 => {
                format!(
                    "{right} of {all} spots right ({:.1} %)",
                    100.0 * right as f64 / all as f64
                )
            }
            Some(_) => "no spots".to_owned(),
            None => "no map".to_owned(),
        };
        let name = text(Sheet::MARGIN_PX, 32.0, &printable(&self.scene.name)).set("font-size", 20);
        Group::new()
            .add(name.set("font-weight", "bold"))
            .add(text(Sheet::MARGIN_PX, 54.0, &share).set("font-size", 15))
    }

    /// The body of each parked vehicle, between its two placards.
    fn vehicles_parked(&self) -> Group {
        let bodies = self
            .scene
            .spots
            .iter()
            .filter(|spot| spot.truth.is_some())
            .filter_map(|spot| {
                let (x1, y1) = self.sheet.at(&spot.empty?);
                let (x2, y2) = self.sheet.at(&spot.occupied);
                Some(line(x1, y1, x2, y2))
            });
        let width = self.sheet.length(self.testbed.placard.card_width_m);
        let group = Group::new()
            .set("stroke", "#e6e6e6")
            .set("stroke-width", round(width));
        bodies.fold(group, Group::add)
    }

    /// Cards in the scene: plates of parked vehicles thick, `EMPTY` placards thin, each with a tick
    /// towards its front.
    fn placards(&self) -> Group {
        let placard = |place: &Point2<f64>, facing_rad: f64, weight: f64| {
            let pose = Pose {
                position: *place,
                heading_rad: facing_rad,
            };
            let half_m = self.testbed.placard.card_width_m / 2.0;
            let (x1, y1) = self.sheet.at(&pose.transform(0.0, half_m));
            let (x2, y2) = self.sheet.at(&pose.transform(0.0, -half_m));
            let (x, y) = self.sheet.at(place);
            let (x3, y3) = self.sheet.at(&pose.transform(0.4 * METRES_PER_INCH, 0.0));
            let tick = line(x, y, x3, y3).set("stroke-width", 1.5);
            Group::new()
                .add(line(x1, y1, x2, y2).set("stroke-width", weight))
                .add(tick)
        };
        let of_spot = |spot: &Spot| {
            let empty = spot
                .empty
                .map(|place| placard(&place, spot.facing_rad, 1.5));
            let plate = spot
                .truth
                .as_ref()
                .map(|_| placard(&spot.occupied, spot.facing_rad, 5.0));
            empty.into_iter().chain(plate)
        };
        self.scene
            .spots
            .iter()
            .flat_map(of_spot)
            .fold(Group::new().set("stroke", INK), Group::add)
    }

    /// The field of view of each camera, as far as the farthest placard.
    fn cones(&self) -> Group {
        let intrinsics = &self.testbed.camera.intrinsics;
        let half_rad = (f64::from(intrinsics.width) / 2.0 / intrinsics.fx).atan();
        let cone = |(cav, color): (&Cav, &'static str)| {
            let places = self
                .scene
                .spots
                .iter()
                .flat_map(|spot| spot.empty.into_iter().chain([spot.occupied]));
            let in_view = places
                .map(|place| cav.pose.range_bearing(&place))
                .filter(|(_, b)| b.abs() <= half_rad);
            let range_m = in_view
                .map(|(range_m, _)| range_m)
                .fold(6.0 * METRES_PER_INCH, f64::max);
            let edge = |side_rad: f64| {
                let pose = Pose {
                    heading_rad: cav.pose.heading_rad + side_rad,
                    ..cav.pose
                };
                self.sheet.at(&pose.transform(range_m, 0.0))
            };
            let (x, y) = self.sheet.at(&cav.pose.position);
            let (x1, y1) = edge(half_rad);
            let (x2, y2) = edge(-half_rad);
            let radius = round(self.sheet.length(range_m));
            let [x, y, x1, y1, x2, y2] = [x, y, x1, y1, x2, y2].map(round);
            let outline = format!("M{x} {y}L{x1} {y1}A{radius} {radius} 0 0 1 {x2} {y2}Z");
            Path::new()
                .set("d", outline)
                .set("fill", color)
                .set("stroke", color)
        };
        let group = Group::new()
            .set("fill-opacity", 0.09)
            .set("stroke-opacity", 0.35);
        self.vehicles().map(cone).fold(group, Group::add)
    }

    fn dots(&self, detections: &[(NodeName, Point2<f64>)]) -> Group {
        let of_vehicle = |(cav, color): (&Cav, &'static str)| {
            let seen = detections
                .iter()
                .filter(|(node, place)| *node == cav.name && self.sheet.holds(place));
            let dots = seen.map(|(_, place)| {
                let (x, y) = self.sheet.at(place);
                dot(x, y)
            });
            dots.fold(
                Group::new().set("fill", color).set("fill-opacity", 0.35),
                Group::add,
            )
        };
        self.vehicles()
            .map(of_vehicle)
            .fold(Group::new(), Group::add)
    }

    fn marks(&self) -> Group {
        let marks = self
            .scene
            .spots
            .iter()
            .filter(|_| self.map.is_some())
            .map(|spot| {
                let place = self
                    .state(spot)
                    .map_or(spot.occupied, |state| Point2::new(state.x_m, state.y_m));
                let (x, y) = self.sheet.at(&place);
                self.judge(spot).mark(x, y)
            });
        marks.fold(Group::new(), Group::add)
    }

    /// Each camera as a wedge that points where it looks, with its name behind it.
    fn cameras(&self) -> Group {
        let mut taken: Vec<(f64, f64)> = Vec::new();
        let mut group = Group::new();
        for (cav, color) in self.vehicles() {
            let (x, y) = self.sheet.at(&cav.pose.position);
            let ahead = 0.75 * METRES_PER_INCH;
            let aside = 0.45 * METRES_PER_INCH;
            let corners =
                [(ahead, 0.0), (-aside, aside), (-aside, -aside)].map(|(forward_m, left_m)| {
                    let (x, y) = self.sheet.at(&cav.pose.transform(forward_m, left_m));
                    format!("{} {}", round(x), round(y))
                });
            let wedge = Path::new()
                .set("d", format!("M{}Z", corners.join("L")))
                .set("fill", color);
            let looks_left = cav.pose.heading_rad.cos() < 0.0;
            let (dx, anchor) = if looks_left {
                (14.0, "start")
            } else {
                (-14.0, "end")
            };
            let mut below = y + 5.0;
            while taken
                .iter()
                .any(|(tx, ty)| (tx - x).abs() < 80.0 && (ty - below).abs() < LINE_PX)
            {
                below += LINE_PX;
            }
            taken.push((x, below));
            let name = text(x + dx, below, cav.name.as_str())
                .set("text-anchor", anchor)
                .set("font-weight", "bold");
            group = group
                .add(wedge.set("stroke", INK).set("stroke-linejoin", "round"))
                .add(name);
        }
        group
    }

    /// Truth and agreed label of every spot, in rows next to the lot, each connected to its spot by
    /// a line.
    fn table(&self) -> Group {
        let frame_left = self.sheet.left();
        let columns = [-268.0, -196.0, -100.0].map(|offset| frame_left + offset);
        let header = self.sheet.top() - 8.0;
        let mut group = Group::new();
        for (x, title) in columns.into_iter().zip(["spot", "truth", "agreed"]) {
            group = group.add(text(x, header, title).set("fill", FAINT));
        }
        let mut spots: Vec<&Spot> = self.scene.spots.iter().collect();
        spots.sort_by(|a, b| b.occupied.y.total_cmp(&a.occupied.y));
        let heights: Vec<f64> = spots
            .iter()
            .map(|spot| self.sheet.at(&anchor(spot)).1)
            .collect();
        for (spot, y) in spots
            .into_iter()
            .zip(spread(&heights, self.sheet.top() + LINE_PX / 2.0))
        {
            let judgement = self.judge(spot);
            let (end_x, end_y) = self.sheet.at(&anchor(spot));
            let lead = format!(
                "M{} {}H{}L{} {}",
                frame_left - 4.0,
                round(y),
                frame_left + 8.0,
                round(end_x - 5.0),
                round(end_y)
            );
            group = group
                .add(
                    Path::new()
                        .set("d", lead)
                        .set("fill", "none")
                        .set("stroke", "#bdbdbd"),
                )
                .add(text(columns[0], y + 4.5, &printable(&spot.id)).set("fill", FAINT))
                .add(text(columns[1], y + 4.5, &printable(self.truth(spot))));
            if self.map.is_some() {
                let agreed = self.state(spot).and_then(|state| state.label.as_ref());
                let words = agreed.map_or_else(|| "unknown".to_owned(), |label| printable(label));
                let said = text(columns[2], y + 4.5, &words)
                    .set("fill", judgement.color())
                    .set("font-weight", "bold");
                group = group.add(said);
            }
        }
        group
    }

    fn legend(&self, beyond: usize) -> Group {
        let x = self.sheet.right() + 52.0;
        let mut y = self.sheet.top() + 12.0;
        let mut group = Group::new();
        let mut entry = |sign: Group, words: &str| {
            let row = std::mem::replace(&mut group, Group::new());
            group = row
                .add(sign.set("transform", format!("translate({} {})", round(x), round(y))))
                .add(text(x + 22.0, y + 4.5, words));
            y += 24.0;
        };
        let stroke = |weight: f64| {
            Group::new()
                .set("stroke", INK)
                .add(line(0.0, -8.0, 0.0, 8.0).set("stroke-width", weight))
        };
        for (cav, color) in self.vehicles() {
            let dots = [(-5.0, 2.0), (0.0, -3.0), (5.0, 3.0)]
                .into_iter()
                .map(|(x, y)| dot(x, y));
            entry(
                dots.fold(Group::new().set("fill", color), Group::add),
                &format!("seen by {}", cav.name),
            );
        }
        entry(stroke(5.0), "plate of a parked vehicle");
        entry(stroke(1.5), "EMPTY placard");
        for (judgement, words) in [
            (MarkKind::Right, "agreed, right"),
            (MarkKind::Wrong, "agreed, wrong"),
            (MarkKind::Unknown, "unknown"),
        ] {
            entry(judgement.mark(0.0, 0.0), words);
        }
        if beyond > 0 {
            entry(Group::new(), &format!("{beyond} seen outside the frame"));
        }
        group
    }

    fn vehicles(&self) -> impl Iterator<Item = (&Cav, &'static str)> {
        self.scene
            .cavs
            .iter()
            .zip(VEHICLE_COLORS.into_iter().cycle())
    }

    fn state(&self, spot: &Spot) -> Option<&LandmarkState> {
        self.map?.landmarks.iter().find(|state| state.id == spot.id)
    }

    fn truth<'s>(&'s self, spot: &'s Spot) -> &'s Label {
        spot.truth
            .as_ref()
            .unwrap_or(&self.testbed.placard.empty_text)
    }

    fn judge(&self, spot: &Spot) -> MarkKind {
        MarkKind::of(
            self.state(spot)
                .and_then(|state| is_right(self.testbed, spot, state)),
        )
    }
}

/// The westernmost placard of a spot, where its line of the table leads to.
fn anchor(spot: &Spot) -> Point2<f64> {
    spot.empty
        .filter(|empty| empty.x < spot.occupied.x)
        .unwrap_or(spot.occupied)
}

/// The same heights, ascending, moved apart so that lines of text do not overlap.
fn spread(heights: &[f64], first: f64) -> Vec<f64> {
    let mut next = first;
    let place = |height: &f64| {
        let at = height.max(next);
        next = at + LINE_PX;
        at
    };
    heights.iter().map(place).collect()
}

/// Text fit to be printed: without control characters, which XML forbids, and not too long.
fn printable(label: &str) -> String {
    let clean = |c: char| {
        if c.is_control() || matches!(c, '\u{fffe}' | '\u{ffff}') {
            '\u{fffd}'
        } else {
            c
        }
    };
    let mut text: String = label.chars().take(LONGEST_TEXT).map(clean).collect();
    if label.chars().nth(LONGEST_TEXT).is_some() {
        text.pop();
        text.push('…');
    }
    text
}

fn text(x: f64, y: f64, words: &str) -> Text {
    Text::new(words).set("x", round(x)).set("y", round(y))
}

fn line(x1: f64, y1: f64, x2: f64, y2: f64) -> Line {
    Line::new()
        .set("x1", round(x1))
        .set("y1", round(y1))
        .set("x2", round(x2))
        .set("y2", round(y2))
}

fn dot(x: f64, y: f64) -> Circle {
    Circle::new()
        .set("cx", round(x))
        .set("cy", round(y))
        .set("r", 2.5)
}
