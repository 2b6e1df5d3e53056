//! Pictures of the street: all bodies are projected by the pinhole camera and painted from far to
//! near.

use std::collections::BTreeMap;

use ecod::model::geometry::Pose;
use ecod::model::names::Label;
use ecod::perception::camera::{Intrinsics, Mount};
use nalgebra::{Matrix3, Point2, Point3, Vector2, Vector3};
use opencv::core::{BORDER_TRANSPARENT, CV_8UC3, Mat, Point, Point2f, Rect, Scalar, Size, Vector};
use opencv::imgproc::{
    INTER_LINEAR, INTER_NEAREST, LINE_8, fill_convex_poly, get_perspective_transform_slice_def,
    resize, warp_perspective,
};
use opencv::prelude::*;
use qrcode::{Color, EcLevel, QrCode};

use super::depth_order::depth_order;
use super::{CODE_MODULES, Carrier, QUIET_MODULES, Solid, Street, StreetCamera};

/// Nearest depth that is painted, in metres.
const NEAR_M: f64 = 0.2;
/// Bits of a pixel's fraction in OpenCV's polygons.
const FRACTION_BITS: i32 = 4;
/// Largest size of a module in a printed code, in pixels.
const MAX_MODULE: i32 = 16;

const SKY: [f64; 3] = [225.0, 205.0, 180.0];
/// Rectangles on the ground, painted in this order: centre, length and width in metres, and colour.
const GROUND: [([f64; 2], [f64; 2], [f64; 3]); 5] = [
    ([0.0, 0.0], [120.0, 120.0], [105.0, 140.0, 120.0]),
    ([0.0, 0.0], [38.0, 18.0], [150.0, 155.0, 158.0]),
    ([0.0, 1.1], [36.0, 9.8], [88.0, 86.0, 86.0]),
    ([0.0, 3.85], [26.0, 0.12], [190.0, 195.0, 195.0]),
    ([0.0, -3.75], [36.0, 0.15], [175.0, 178.0, 180.0]),
];
/// Dashes between the lanes.
const DASH_COLOR: [f64; 3] = [215.0, 220.0, 222.0];

/// Renders the street for one of its cameras.
pub(crate) struct StreetView {
    optics: Intrinsics,
    /// By label and size of a module in pixels.
    placards: BTreeMap<(Label, i32), Mat>,
}

impl StreetView {
    /// A view with all placards of the street.
    ///
    /// # Errors
    /// Returns an error if a label does not fit into a code, or OpenCV fails.
    pub(crate) fn new(street: &Street) -> anyhow::Result<Self> {
        let mut placards = BTreeMap::new();
        for label in street.bodies.iter().filter_map(|body| body.label.clone()) {
            if !placards.contains_key(&(label.clone(), 1)) {
                let print = print(&label)?;
                for module in 1..=MAX_MODULE {
                    let mut enlarged = Mat::default();
                    let side = print.cols() * module;
                    resize(
                        &print,
                        &mut enlarged,
                        Size::new(side, side),
                        0.0,
                        0.0,
                        INTER_NEAREST,
                    )?;
                    placards.insert((label.clone(), module), enlarged);
                }
            }
        }
        Ok(Self {
            optics: Street::optics(),
            placards,
        })
    }

    /// The picture of a camera at a time in seconds, without noise: 8-bit BGR.
    ///
    /// # Errors
    /// Returns an error if OpenCV fails.
    pub(crate) fn render(
        &self,
        street: &Street,
        camera: &StreetCamera,
        at_s: f64,
    ) -> opencv::Result<Mat> {
        let rows = self.optics.height.cast_signed();
        let columns = self.optics.width.cast_signed();
        let image = Mat::new_rows_cols_with_default(rows, columns, CV_8UC3, scalar(SKY, 1.0))?;
        let sight = StreetSight::new(street.pose(camera, at_s), &camera.mount);
        let mut canvas = Canvas {
            view: self,
            sight,
            image,
        };
        canvas.paint_ground()?;
        let own = match camera.carrier {
            Carrier::Body(body) => Some(body),
            Carrier::Mast(_) => None,
        };
        let others = street
            .bodies
            .iter()
            .enumerate()
            .filter(|(place, _)| Some(*place) != own);
        let bodies: Vec<_> = others
            .map(|(_, body)| (body, body.route.at(at_s)))
            .collect();
        let footprints: Vec<_> = bodies
            .iter()
            .map(|(body, pose)| body.footprint(pose))
            .collect();
        let eye_m = canvas.sight.height_m;
        for place in depth_order(&canvas.sight.pose.position, &footprints) {
            let (body, pose) = &bodies[place];
            // Parts lie on each other: the farther from the height of the eye, the sooner.
            let mut solids = body.solids.clone();
            let from_eye =
                |solid: &Solid| ((solid.heights_m[0] + solid.heights_m[1]) / 2.0 - eye_m).abs();
            solids.sort_by(|a, b| from_eye(b).total_cmp(&from_eye(a)));
            for solid in &solids {
                canvas.paint_solid(
                    solid,
                    pose,
                    body.label.as_ref().filter(|_| solid.is_placard),
                )?;
            }
        }
        Ok(canvas.image)
    }
}

/// A label as it is printed: one pixel for each module, with the quiet zone.
fn print(label: &Label) -> anyhow::Result<Mat> {
    let code = QrCode::with_error_correction_level(label.as_bytes(), EcLevel::M)?;
    anyhow::ensure!(
        code.width() == CODE_MODULES,
        "label {label} does not fit into the smallest code"
    );
    let side = CODE_MODULES + 2 * QUIET_MODULES;
    let mut print = Mat::new_rows_cols_with_default(
        side as i32,
        side as i32,
        CV_8UC3,
        scalar([235.0, 238.0, 240.0], 1.0),
    )?;
    for (place, color) in code.to_colors().into_iter().enumerate() {
        if color == Color::Dark {
            let row = place / CODE_MODULES + QUIET_MODULES;
            let column = place % CODE_MODULES + QUIET_MODULES;
            *print.at_2d_mut(row as i32, column as i32)? = opencv::core::Vec3b::from([32, 30, 31]);
        }
    }
    Ok(print)
}

/// From the world to the frame of a camera.
struct StreetSight {
    pose: Pose,
    height_m: f64,
    from_level: Matrix3<f64>,
}

impl StreetSight {
    fn new(pose: Pose, mount: &Mount) -> Self {
        let pose = mount.camera_pose(&pose);
        let height_m = mount.height_m.unwrap_or_default();
        Self {
            pose,
            height_m,
            from_level: mount.to_level().transpose(),
        }
    }

    /// A point of the world in the camera frame, in metres.
    fn point(&self, place: &Point2<f64>, height_m: f64) -> Point3<f64> {
        let offset = place - self.pose.position;
        let (sin, cos) = self.pose.heading_rad.sin_cos();
        let level = Vector3::new(
            offset.x * cos + offset.y * sin,
            offset.y * cos - offset.x * sin,
            height_m - self.height_m,
        );
        Point3::from(self.from_level * level)
    }
}

/// A picture while it is painted.
struct Canvas<'a> {
    view: &'a StreetView,
    sight: StreetSight,
    image: Mat,
}

impl Canvas<'_> {
    fn paint_ground(&mut self) -> opencv::Result<()> {
        let dashes =
            (-6..=6).map(|number| ([2.0 * f64::from(number), 0.0], [1.0, 0.12], DASH_COLOR));
        for ([x_m, y_m], [length_m, width_m], color) in GROUND.into_iter().chain(dashes) {
            let corners = super::corners(
                &Pose::new(x_m, y_m, 0.0),
                Point2::origin(),
                length_m,
                width_m,
            );
            let face = corners.map(|corner| self.sight.point(&corner, 0.0));
            self.fill(&face, scalar(color, 1.0))?;
        }
        Ok(())
    }

    /// Paints the sides of a box that face the camera, and its top if that is seen.
    fn paint_solid(
        &mut self,
        solid: &Solid,
        pose: &Pose,
        label: Option<&Label>,
    ) -> opencv::Result<()> {
        let middle = Point2::new(solid.forward_m, solid.left_m);
        let corners = super::corners(pose, middle, solid.length_m, solid.width_m);
        let [bottom_m, top_m] = solid.heights_m;
        if self.sight.height_m > top_m {
            let face = corners.map(|corner| self.sight.point(&corner, top_m));
            self.fill(&face, scalar(solid.color, 1.08))?;
        }
        for side in 0..4 {
            let right = corners[side];
            let left = corners[(side + 1) % 4];
            // Counter-clockwise corners: outside is to the right.
            let out = Vector2::new(left.y - right.y, right.x - left.x);
            if (self.sight.pose.position - right).dot(&out) <= 0.0 {
                continue;
            }
            // The viewer has the later corner on the right.
            let face = [
                (right, top_m),
                (left, top_m),
                (left, bottom_m),
                (right, bottom_m),
            ]
            .map(|(corner, height_m)| self.sight.point(&corner, height_m));
            let lit = 0.86 + 0.14 * (out.y.atan2(out.x) + 1.1).cos();
            match label {
                Some(label) => self.paste(&face, label, scalar(solid.color, lit))?,
                None => self.fill(&face, scalar(solid.color, lit))?,
            }
        }
        Ok(())
    }

    /// Pastes a placard into a face that is wholly before the camera; others stay blank.
    fn paste(
        &mut self,
        face: &[Point3<f64>; 4],
        label: &Label,
        blank: Scalar,
    ) -> opencv::Result<()> {
        let pixels = face.map(|corner| {
            self.view
                .optics
                .project(&corner)
                .filter(|_| corner.z >= NEAR_M)
        });
        let [Some(a), Some(b), Some(c), Some(d)] = pixels else {
            return self.fill(face, blank);
        };
        let pixels = [a, b, c, d];
        let longest = (0..4)
            .map(|side| nalgebra::distance(&pixels[side], &pixels[(side + 1) % 4]))
            .fold(0.0, f64::max);
        let modules = (CODE_MODULES + 2 * QUIET_MODULES) as f64;
        let module = ((longest / modules).round() as i32).clamp(1, MAX_MODULE);
        let Some(print) = self.view.placards.get(&(label.clone(), module)) else {
            return self.fill(face, blank);
        };
        let bounds = |of: fn(&Point2<f64>) -> f64, end: i32| {
            let low = pixels
                .iter()
                .map(of)
                .fold(f64::INFINITY, f64::min)
                .floor()
                .clamp(0.0, f64::from(end));
            let high = pixels
                .iter()
                .map(of)
                .fold(f64::NEG_INFINITY, f64::max)
                .ceil()
                .clamp(0.0, f64::from(end));
            (low as i32, (high - low) as i32)
        };
        let (x, width) = bounds(|p| p.x, self.image.cols());
        let (y, height) = bounds(|p| p.y, self.image.rows());
        if width == 0 || height == 0 {
            return Ok(());
        }
        // OpenCV counts pixels from their middles.
        let side = print.cols() as f32 - 0.5;
        let from = [(-0.5, -0.5), (side, -0.5), (side, side), (-0.5, side)]
            .map(|(x, y)| Point2f::new(x, y));
        let to = pixels
            .map(|p| Point2f::new((p.x - 0.5) as f32 - x as f32, (p.y - 0.5) as f32 - y as f32));
        let transform = get_perspective_transform_slice_def(from, to)?;
        let mut part = self.image.roi_mut(Rect::new(x, y, width, height))?;
        let size = Size::new(width, height);
        warp_perspective(
            print,
            &mut part,
            &transform,
            size,
            INTER_LINEAR,
            BORDER_TRANSPARENT,
            Scalar::default(),
        )
    }

    /// Fills the part of a plane polygon that is before the camera.
    fn fill(&mut self, corners: &[Point3<f64>], color: Scalar) -> opencv::Result<()> {
        let scale = f64::from(1 << FRACTION_BITS);
        let before = clip(corners);
        let pixels = before
            .iter()
            .filter_map(|corner| self.view.optics.project(corner));
        // Far outside of the picture OpenCV's integers end.
        let fixed = |value: f64| ((value - 0.5) * scale).clamp(-1e8, 1e8) as i32;
        let points: Vector<Point> = pixels
            .map(|pixel| Point::new(fixed(pixel.x), fixed(pixel.y)))
            .collect();
        if points.len() < 3 {
            return Ok(());
        }
        fill_convex_poly(&mut self.image, &points, color, LINE_8, FRACTION_BITS)
    }
}

/// The part of a polygon that is at least [`NEAR_M`] before the camera (Sutherland and Hodgman
/// 1974).
fn clip(corners: &[Point3<f64>]) -> Vec<Point3<f64>> {
    let mut kept = Vec::with_capacity(corners.len() + 1);
    for (from, to) in corners.iter().zip(corners.iter().cycle().skip(1)) {
        if from.z >= NEAR_M {
            kept.push(*from);
        }
        if (from.z >= NEAR_M) != (to.z >= NEAR_M) {
            kept.push(from + (to - from) * ((NEAR_M - from.z) / (to.z - from.z)));
        }
    }
    kept
}

fn scalar(color: [f64; 3], lit: f64) -> Scalar {
    let [blue, green, red] = color.map(|value| value * lit);
    Scalar::new(blue, green, red, 0.0)
}

#[cfg(test)]
mod tests;
