//! An animation of the street, as a self-contained SVG that plays in a page: the street from above
//! with the cell's objects, and the pictures of the cameras with the placards that each of them
//! read.

use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use ecod::model::geometry::Pose;
use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ecod::wire::{FusedObject, GlobalMap, ObjectReport};
use nalgebra::Point2;
use svg::Document;
use svg::node::element::{
    Animate, AnimateTransform, Circle, ClipPath, Definitions, Group, Image, Path, Rectangle, Text,
};

use super::network_camera::{KEPT_PX, KeptPicture};
use super::view::StreetSight;
use super::{CODE_MODULES, QUIET_MODULES, Solid, Street, StreetBody, StreetCamera};
use crate::drawing::{INK, page, round};
use crate::eval::tracks::{DEFAULT_THRESHOLD, MATCH_DISTANCE_M, TrueObject};
use crate::testbed::birdseye::VEHICLE_COLORS;

/// A map and the time at which a vehicle had it.
#[derive(Debug, Clone, Copy)]
pub struct KnownMap<'a> {
    /// Time of receipt.
    pub known_at: Timestamp,
    /// The map.
    pub map: &'a GlobalMap,
}

/// Run of a street to be animated.
pub struct Film<'a> {
    /// The street.
    pub street: &'a Street,
    /// Second zero of the street.
    pub start: Timestamp,
    /// The edge's name.
    pub edge: NodeName,
    /// The maps that the first camera's node got, in order.
    pub maps: Vec<KnownMap<'a>>,
    /// The maps that the node would have made from its own reports, in order.
    pub alone: Vec<KnownMap<'a>>,
    /// All reports.
    pub reports: Vec<&'a ObjectReport>,
    /// The pictures of each camera.
    pub pictures: &'a [Vec<KeptPicture>],
    /// Time at which the edge was killed.
    pub killed_at: Timestamp,
    /// Time at which it was restarted.
    pub restarted_at: Option<Timestamp>,
    /// First and last moment that may be shown.
    pub ends: [Timestamp; 2],
}

/// Time that is shown before and after the edge is killed.
const BEFORE: Duration = Duration::from_secs(6);
const AFTER: Duration = Duration::from_secs(6);
/// Time between two moments of the drawing, and between two pictures.
const STEP: Duration = Duration::from_millis(200);
const PICTURE_STEP: Duration = Duration::from_millis(400);
/// Age of a map from which on a node counts as having no objects.
pub const FORGOTTEN: Duration = Duration::from_secs(1);
const PX_PER_M: f64 = 22.0;
/// Half the size of the shown part of the street, in metres.
const HALF_M: [f64; 2] = [20.5, 10.0];
const TOP_PX: f64 = 56.0;
const MARGIN_PX: f64 = 18.0;
/// Range up to which the view of a camera is shown, in metres.
const CONE_M: f64 = 9.0;
const FAINT: &str = "#767676";
const SHARED: &str = "#007a5a";
const ALARM: &str = "#d1420f";

impl Film<'_> {
    /// Draws it.
    pub fn draw(&self) -> String {
        let first = self
            .killed_at
            .shifted(-(BEFORE.as_micros() as i64))
            .max(self.ends[0]);
        let last = (self.killed_at + AFTER).min(self.ends[1]);
        let steps = (last.since(first).as_micros() / STEP.as_micros()).max(1) as u32;
        let scene = FilmScene {
            film: self,
            times: (0..=steps).map(|step| first + STEP * step).collect(),
        };
        scene.draw().to_string() + "\n"
    }

    /// The newest map at a time, unless it is too old.
    fn known(maps: &[KnownMap<'_>], at: Timestamp) -> Option<usize> {
        let next = maps.partition_point(|map| map.known_at <= at);
        next.checked_sub(1)
            .filter(|place| at.since(maps[*place].known_at) < FORGOTTEN)
    }
}

/// The drawing at all its moments, the last of which ends it.
struct FilmScene<'a> {
    film: &'a Film<'a>,
    times: Vec<Timestamp>,
}

impl FilmScene<'_> {
    fn draw(&self) -> Document {
        let street = self.film.street;
        let (width, street_px) = (
            2.0 * (MARGIN_PX + HALF_M[0] * PX_PER_M),
            2.0 * HALF_M[1] * PX_PER_M,
        );
        let pictures_top = TOP_PX + street_px + 34.0;
        let height = pictures_top + self.picture_px()[1] + MARGIN_PX;
        let mut document = page(width, height, 14)
            .add(self.title(width))
            .add(Definitions::new().add(ClipPath::new().set("id", "street").add(frame("white"))));
        let mut below = Group::new().set("clip-path", "url(#street)").add(ground());
        for body in &street.bodies {
            below = below.add(self.body(body));
        }
        for (camera, color) in self.cameras() {
            below = below.add(self.cone(camera, color));
        }
        document = document.add(below).add(self.known_objects());
        for (camera, color) in self.cameras() {
            document = document.add(self.camera_name(camera, color));
        }
        for (number, (camera, color)) in self.cameras().enumerate() {
            document = document.add(self.pictures(number, camera, color, pictures_top));
        }
        let words = "Grey: what is there. Rings: what each node knows through the cell; green: several told of it.";
        document.add(
            Text::new(words)
                .set("x", MARGIN_PX)
                .set("y", pictures_top - 12.0)
                .set("fill", FAINT),
        )
    }

    fn cameras(&self) -> impl Iterator<Item = (&StreetCamera, &'static str)> {
        self.film
            .street
            .cameras
            .iter()
            .zip(VEHICLE_COLORS.into_iter().cycle())
    }

    fn color_of(&self, node: &NodeName) -> &'static str {
        self.cameras()
            .find(|(camera, _)| camera.name == *node)
            .map_or(FAINT, |(_, color)| color)
    }

    /// Seconds of the street.
    fn seconds(&self, at: Timestamp) -> f64 {
        at.since(self.film.start).as_secs_f64()
    }

    fn duration(&self) -> String {
        format!(
            "{}s",
            round(STEP.as_secs_f64() * (self.times.len() - 1) as f64)
        )
    }

    /// The leader, the state of the edge, and the number of detected objects.
    fn title(&self, width: f64) -> Group {
        let film = self.film;
        let who = film
            .street
            .cameras
            .first()
            .map_or("a vehicle", |camera| camera.name.as_str());
        let all = film.street.truth(0.0).len();
        let count = |maps: &[KnownMap<'_>], at| {
            let map = Film::known(maps, at).map(|place| maps[place].map);
            let is_known = |truth: &TrueObject| {
                map.into_iter().flat_map(shown).any(|object| {
                    let place = Point2::new(object.x_m, object.y_m);
                    object.label == truth.label
                        && nalgebra::distance(&place, &truth.position) <= MATCH_DISTANCE_M
                })
            };
            film.street
                .truth(self.seconds(at))
                .iter()
                .filter(|truth| is_known(truth))
                .count()
        };
        let counts = |at| {
            let (alone, cell) = (count(&film.alone, at), count(&film.maps, at));
            format!("{who} knows {cell} of {all} with the cell, {alone} alone")
        };
        let leader = |at: Timestamp| {
            let leader = Film::known(&film.maps, at)
                .map(|place| film.maps[place].map.aggregator.to_string());
            format!(
                "{} makes the map",
                leader.unwrap_or_else(|| "nobody".to_owned())
            )
        };
        let edge = |at: Timestamp| match film.restarted_at {
            _ if at < film.killed_at => String::new(),
            Some(restarted_at) if at >= restarted_at => format!("{} is started again", film.edge),
            _ => format!("{} is killed", film.edge),
        };
        let middle = round(width * 0.45);
        Group::new()
            .add(
                self.switched(leader)
                    .set("transform", format!("translate({MARGIN_PX} 36)"))
                    .set("font-size", 20)
                    .set("font-weight", "bold"),
            )
            .add(
                self.switched(edge)
                    .set("transform", format!("translate({middle} 36)"))
                    .set("text-anchor", "middle")
                    .set("font-size", 20)
                    .set("font-weight", "bold")
                    .set("fill", ALARM),
            )
            .add(
                self.switched(counts)
                    .set(
                        "transform",
                        format!("translate({} 36)", round(width - MARGIN_PX)),
                    )
                    .set("text-anchor", "end")
                    .set("font-size", 16),
            )
    }

    /// A text that changes.
    fn switched(&self, text: impl Fn(Timestamp) -> String) -> Group {
        let texts: Vec<String> = self.times[..self.times.len() - 1]
            .iter()
            .map(|at| text(*at))
            .collect();
        let distinct: BTreeSet<&String> = texts.iter().filter(|text| !text.is_empty()).collect();
        distinct.into_iter().fold(Group::new(), |group, text| {
            let is_shown = texts.iter().map(|shown| shown == text);
            group.add(
                Text::new(text.as_str())
                    .set("visibility", "hidden")
                    .add(self.visible(is_shown)),
            )
        })
    }

    /// An element that is shown from some moments to the next.
    fn visible(&self, is_shown: impl Iterator<Item = bool>) -> Animate {
        let shown: Vec<bool> = is_shown.collect();
        let changes =
            (0..shown.len()).filter(|place| *place == 0 || shown[*place] != shown[*place - 1]);
        let (mut values, mut times) = (Vec::new(), Vec::new());
        for place in changes {
            values.push(if shown[place] { "visible" } else { "hidden" });
            times.push(format!("{:.4}", place as f64 / shown.len() as f64));
        }
        self.animate(Animate::new())
            .set("attributeName", "visibility")
            .set("calcMode", "discrete")
            .set("values", values.join(";"))
            .set("keyTimes", times.join(";"))
    }

    fn animate(&self, animation: Animate) -> Animate {
        animation
            .set("dur", self.duration())
            .set("repeatCount", "indefinite")
    }

    /// An element that moves along poses, and turns with them if `turns`.
    fn moving(&self, what: Group, poses: &[Pose], turns: bool) -> Group {
        let same =
            |of: fn(&Pose, &Pose) -> bool| poses.windows(2).all(|pair| of(&pair[0], &pair[1]));
        let mut turned = 0.0;
        let mut last = poses.first().map_or(0.0, |pose| pose.heading_rad);
        let degrees = poses.iter().map(|pose| {
            turned += ecod::model::geometry::wrap_angle(pose.heading_rad - last);
            last = pose.heading_rad;
            // The picture's y is down.
            format!("{}", round(-(poses[0].heading_rad + turned).to_degrees()))
        });
        let places = poses.iter().map(|pose| {
            let (x, y) = px(&pose.position);
            format!("{} {}", round(x), round(y))
        });
        let group = |what: Group, kind: &str, values: Vec<String>, is_still: bool| {
            let group = Group::new().set("transform", format!("{kind}({})", values[0]));
            let animation = AnimateTransform::new()
                .set("attributeName", "transform")
                .set("type", kind)
                .set("values", values.join(";"))
                .set("dur", self.duration())
                .set("repeatCount", "indefinite");
            if is_still {
                group.add(what)
            } else {
                group.add(animation).add(what)
            }
        };
        let what = if turns {
            group(
                what,
                "rotate",
                degrees.collect(),
                same(|a, b| a.heading_rad == b.heading_rad),
            )
        } else {
            what
        };
        group(
            what,
            "translate",
            places.collect(),
            same(|a, b| a.position == b.position),
        )
    }

    /// A true object, in a pale colour, because detected objects are drawn over it.
    fn body(&self, body: &StreetBody) -> Group {
        let poses: Vec<Pose> = self
            .times
            .iter()
            .map(|at| body.route.at(self.seconds(*at)))
            .collect();
        let (middle, [length_m, width_m]) = body.extent();
        let rectangle = |length_m: f64, width_m: f64| {
            Rectangle::new()
                .set("x", round((middle.x - length_m / 2.0) * PX_PER_M))
                .set("y", round((-middle.y - width_m / 2.0) * PX_PER_M))
                .set("width", round(length_m * PX_PER_M))
                .set("height", round(width_m * PX_PER_M))
        };
        let what = match body.label.as_deref() {
            Some("person") => Group::new().add(Circle::new().set("r", 7).set("fill", "#5a5a5a")),
            Some(_) => Group::new().add(
                rectangle(length_m, width_m)
                    .set("rx", 8)
                    .set("fill", "#b9bfc4"),
            ),
            None => Group::new().add(rectangle(length_m, width_m).set("fill", "#8d8377")),
        };
        self.moving(what, &poses, true)
    }

    fn poses(&self, camera: &StreetCamera) -> Vec<Pose> {
        self.times
            .iter()
            .map(|at| self.film.street.pose(camera, self.seconds(*at)))
            .collect()
    }

    fn cone(&self, camera: &StreetCamera, color: &'static str) -> Group {
        let half_rad = Street::optics().horizontal_field_of_view() / 2.0;
        let radius = CONE_M * PX_PER_M;
        let (x, y) = (
            round(radius * half_rad.cos()),
            round(radius * half_rad.sin()),
        );
        let outline = format!("M0 0L{x} {y}A{radius} {radius} 0 0 0 {x} {}Z", -y);
        let cone = Path::new()
            .set("d", outline)
            .set("fill", color)
            .set("fill-opacity", 0.22);
        self.moving(Group::new().add(cone), &self.poses(camera), true)
    }

    fn camera_name(&self, camera: &StreetCamera, color: &'static str) -> Group {
        let name = Text::new(camera.name.as_str())
            .set("y", -14)
            .set("text-anchor", "middle")
            .set("font-weight", "bold");
        let name = name
            .set("stroke", "white")
            .set("stroke-width", 3)
            .set("paint-order", "stroke");
        let dot = Circle::new()
            .set("r", 6)
            .set("fill", color)
            .set("stroke", INK);
        self.moving(Group::new().add(dot).add(name), &self.poses(camera), false)
    }

    /// A ring for each object of the maps: of one colour if several nodes reported it, of the
    /// node's colour if only one did.
    fn known_objects(&self) -> Group {
        let moments = &self.times;
        let mut seen: BTreeMap<uuid::Uuid, Vec<Option<&FusedObject>>> = BTreeMap::new();
        for (number, at) in moments.iter().enumerate() {
            let Some(place) = Film::known(&self.film.maps, *at) else {
                continue;
            };
            for object in shown(self.film.maps[place].map) {
                seen.entry(object.id)
                    .or_insert_with(|| vec![None; moments.len()])[number] = Some(object);
            }
        }
        seen.into_values().fold(Group::new(), |group, objects| {
            group.add(self.known_object(&objects))
        })
    }

    fn known_object(&self, objects: &[Option<&FusedObject>]) -> Group {
        let mut last = objects.iter().flatten().next().copied();
        let poses: Vec<Pose> = objects
            .iter()
            .map(|object| {
                last = object.or(last);
                last.map_or(Pose::new(0.0, 0.0, 0.0), |object| {
                    Pose::new(object.x_m, object.y_m, 0.0)
                })
            })
            .collect();
        let shown = &objects[..objects.len() - 1];
        let is_person = shown
            .iter()
            .flatten()
            .any(|object| object.label.as_str() == "person");
        let radius = if is_person { 12 } else { 24 };
        let mut kinds: BTreeSet<Option<&NodeName>> = shown
            .iter()
            .flatten()
            .map(|object| only_witness(object))
            .collect();
        let mut what = Group::new();
        while let Some(witness) = kinds.pop_first() {
            let is_shown = shown
                .iter()
                .map(|object| object.is_some_and(|object| only_witness(object) == witness));
            let color = witness.map_or(SHARED, |node| self.color_of(node));
            let ring = Circle::new()
                .set("r", radius)
                .set("fill", "none")
                .set("stroke", color)
                .set("stroke-width", 4);
            let mut kind = Group::new()
                .set("visibility", "hidden")
                .add(self.visible(is_shown))
                .add(ring);
            if let Some(node) = witness.filter(|_| is_person) {
                let words = Text::new(format!("seen only by {node}"))
                    .set("y", 26)
                    .set("text-anchor", "middle");
                let words = words
                    .set("font-size", 12)
                    .set("stroke", "white")
                    .set("stroke-width", 3);
                kind = kind.add(words.set("paint-order", "stroke"));
            }
            what = what.add(kind);
        }
        self.moving(what, &poses, false)
    }

    /// Width and height of a picture.
    fn picture_px(&self) -> [f64; 2] {
        let count = self.film.street.cameras.len() as f64;
        let width = (2.0 * HALF_M[0] * PX_PER_M - 8.0 * (count - 1.0)) / count;
        [width, width * f64::from(KEPT_PX[1]) / f64::from(KEPT_PX[0])]
    }

    /// The pictures of a camera, with a box around each placard that its node has placed.
    fn pictures(
        &self,
        number: usize,
        camera: &StreetCamera,
        color: &'static str,
        top: f64,
    ) -> Group {
        let [width, height] = self.picture_px();
        let left = MARGIN_PX + number as f64 * (width + 8.0);
        let (first, last) = (self.times[0], self.times[self.times.len() - 1]);
        let moments = (last.since(first).as_micros() / PICTURE_STEP.as_micros()).max(1) as usize;
        let pictures = self
            .film
            .pictures
            .get(number)
            .map(Vec::as_slice)
            .unwrap_or_default();
        let mut group = Group::new().set(
            "transform",
            format!("translate({} {})", round(left), round(top)),
        );
        let mut before = None;
        for moment in 0..moments {
            let at = first + PICTURE_STEP * moment as u32;
            let next = pictures.partition_point(|picture| picture.taken_at <= at);
            let Some(place) = next.checked_sub(1).filter(|place| before != Some(*place)) else {
                continue;
            };
            before = Some(place);
            let picture = &pictures[place];
            let data = format!("data:image/jpeg;base64,{}", STANDARD.encode(&picture.jpeg));
            let image = Image::new()
                .set("href", data)
                .set("width", round(width))
                .set("height", round(height));
            // Until the next one is shown.
            let is_shown = (0..moments).map(|other| other >= moment);
            let boxes = self.boxes(
                camera,
                picture,
                width / f64::from(Street::optics().width),
                color,
            );
            group = group.add(
                Group::new()
                    .set("visibility", "hidden")
                    .add(self.visible(is_shown))
                    .add(image)
                    .add(boxes),
            );
        }
        let frame = Rectangle::new()
            .set("width", round(width))
            .set("height", round(height))
            .set("fill", "none");
        let name = Text::new(camera.name.as_str())
            .set("x", 8)
            .set("y", 18)
            .set("font-weight", "bold");
        group
            .add(frame.set("stroke", color).set("stroke-width", 3))
            .add(
                name.set("stroke", "white")
                    .set("stroke-width", 3)
                    .set("paint-order", "stroke"),
            )
    }

    fn boxes(
        &self,
        camera: &StreetCamera,
        picture: &KeptPicture,
        scale: f64,
        color: &'static str,
    ) -> Group {
        let street = self.film.street;
        let group = Group::new()
            .set("fill", "none")
            .set("stroke", color)
            .set("stroke-width", 3);
        let mut own = self
            .film
            .reports
            .iter()
            .filter(|report| report.node == camera.name);
        // The report of this picture: the capture is the receipt of the picture by the node.
        let of_picture = |report: &&&ObjectReport| {
            (0..150_000).contains(&report.captured_at_us.micros_from(picture.taken_at))
        };
        let Some(report) = own.find(of_picture) else {
            return group;
        };
        let at_s = self.seconds(picture.taken_at);
        let sight = StreetSight::new(street.pose(camera, at_s), &camera.mount);
        report.objects.iter().fold(group, |group, object| {
            let place = Point2::new(object.x_m, object.y_m);
            let Some(placard) = street.placard_near(&place, at_s) else {
                return group;
            };
            let [bottom_m, top_m] = placard.heights_m;
            let middle = sight.point(&place, (bottom_m + top_m) / 2.0);
            let Some(pixel) = Street::optics().project(&middle) else {
                return group;
            };
            let code = CODE_MODULES as f64 / (CODE_MODULES + 2 * QUIET_MODULES) as f64;
            let side = scale * Street::optics().fx * placard.width_m * code / middle.z;
            let (x, y) = (scale * pixel.x - side / 2.0, scale * pixel.y - side / 2.0);
            let square = Rectangle::new().set("x", round(x)).set("y", round(y));
            group.add(square.set("width", round(side)).set("height", round(side)))
        })
    }
}

impl Street {
    /// The placards of the body nearest to a place.
    fn placard_near(&self, place: &Point2<f64>, at_s: f64) -> Option<&Solid> {
        let worn = self
            .bodies
            .iter()
            .filter_map(|body| Some((body, body.solids.iter().find(|solid| solid.is_placard)?)));
        let far = |body: &StreetBody| nalgebra::distance(&body.route.at(at_s).position, place);
        worn.min_by(|a, b| far(a.0).total_cmp(&far(b.0)))
            .map(|(_, placard)| placard)
    }
}

/// The objects of a map that are shown.
fn shown(map: &GlobalMap) -> impl Iterator<Item = &FusedObject> {
    map.objects
        .iter()
        .filter(|object| object.confidence >= DEFAULT_THRESHOLD)
}

/// The only node that reported an object, if there is just one.
fn only_witness(object: &FusedObject) -> Option<&NodeName> {
    match object.contributors.as_slice() {
        [node] => Some(node),
        _ => None,
    }
}

/// A rectangle on the ground: its middle, its length and width.
fn rectangle(
    [x_m, y_m]: [f64; 2],
    [length_m, width_m]: [f64; 2],
    color: &'static str,
) -> Rectangle {
    let (x, y) = px(&Point2::new(x_m - length_m / 2.0, y_m + width_m / 2.0));
    let [width, height] = [length_m, width_m].map(|metres| round(metres * PX_PER_M));
    Rectangle::new()
        .set("x", round(x))
        .set("y", round(y))
        .set("width", width)
        .set("height", height)
        .set("fill", color)
}

/// The outline of the shown part of the street.
fn frame(color: &'static str) -> Rectangle {
    rectangle([0.0, 0.0], [2.0 * HALF_M[0], 2.0 * HALF_M[1]], color)
}

fn ground() -> Group {
    Group::new()
        .add(frame("#f1efec"))
        .add(rectangle([0.0, 1.1], [36.0, 9.8], "#dcdddf"))
        .add((-8..=8).fold(Group::new(), |group, dash| {
            group.add(rectangle(
                [2.0 * f64::from(dash), 0.0],
                [1.0, 0.12],
                "white",
            ))
        }))
}

/// Where a place is in the picture.
fn px(place: &Point2<f64>) -> (f64, f64) {
    (
        MARGIN_PX + (place.x + HALF_M[0]) * PX_PER_M,
        TOP_PX + (HALF_M[1] - place.y) * PX_PER_M,
    )
}
