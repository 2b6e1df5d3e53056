//! The undisturbed view: one ray per sample, four by four samples per pixel. Cards stand upright on
//! the floor.

use std::ops::Range;

use ecod::model::geometry::Pose;
use ecod::perception::camera::{Intrinsics, Mount};
use nalgebra::{Matrix3, Point2, Point3, Vector2, Vector3};
use opencv::core::{CV_8UC3, Mat, Scalar, Vec3b};
use opencv::prelude::*;
use qrcode::{Color, EcLevel, QrCode};

use super::RenderError;
use crate::testbed::{Card, NEAR_M, Placard, Testbed};

/// Samples per pixel in each direction.
const SAMPLES: usize = 4;
/// Least depth of the wall behind everything, in metres, and its depth in heights of the camera.
const WALL_M: f64 = 2.5;
const WALL_HEIGHTS: f64 = 20.0;

/// Blue, green and red light, 0 to 255.
type Light = [f32; 3];

const PAPER: Light = [222.0, 226.0, 228.0];
const INK: Light = [34.0, 32.0, 33.0];
const CARDBOARD: Light = [92.0, 132.0, 168.0];
const FLOOR: Light = [104.0, 110.0, 114.0];
const WALL: Light = [150.0, 158.0, 160.0];

/// View of the camera at `pose` with the given mount, as 8-bit BGR.
pub(super) fn still(
    testbed: &Testbed,
    cards: &[Card],
    pose: &Pose,
    mount: &Mount,
) -> Result<Mat, RenderError> {
    let camera = &testbed.camera.intrinsics;
    let view = RenderView::new(camera, pose, mount, &testbed.placard);
    let faces = cards
        .iter()
        .map(|card| Face::new(card, &view))
        .collect::<Result<Vec<_>, _>>()?;
    let width = camera.width as usize;
    let height = camera.height as usize;
    let mut light = vec![[0f32; 3]; width * height];
    for row in 0..height * SAMPLES {
        let middle = view.to_level * camera.ray(&Point2::new(camera.cx, centre(row)));
        let right = Vector3::from(view.to_level.column(0));
        let on_row: Vec<&Face> = faces
            .iter()
            .filter(|face| face.rows.contains(&(row / SAMPLES)))
            .collect();
        for column in 0..width * SAMPLES {
            let x = column / SAMPLES;
            let ray = middle + right * ((centre(column) - camera.cx) / camera.fx);
            let light_here = view.light(
                &ray,
                on_row
                    .iter()
                    .copied()
                    .filter(|face| face.columns.contains(&x)),
            );
            for (sum, light) in light[row / SAMPLES * width + x].iter_mut().zip(light_here) {
                *sum += light;
            }
        }
    }
    let error = RenderError::at("allocating a view");
    let rows = camera.height.cast_signed();
    let columns = camera.width.cast_signed();
    let mut image = Mat::new_rows_cols_with_default(rows, columns, CV_8UC3, Scalar::default())
        .map_err(error)?;
    let pixels = image
        .data_typed_mut::<Vec3b>()
        .map_err(RenderError::at("filling a view"))?;
    let weight = 1.0 / (SAMPLES * SAMPLES) as f32;
    for (pixel, sum) in pixels.iter_mut().zip(light) {
        pixel.0 = sum.map(|sum| (sum * weight).round() as u8);
    }
    Ok(image)
}

/// Image coordinate of the middle of a sample, in pixels.
fn centre(sample: usize) -> f64 {
    (sample as f64 + 0.5) / SAMPLES as f64
}

/// A card with its printed code, before a camera.
struct Face<'a> {
    card: &'a Card,
    modules: Vec<Color>,
    /// Modules along one side.
    side: usize,
    facing: Vector2<f64>,
    /// Pixels beyond which it is not seen.
    columns: Range<usize>,
    rows: Range<usize>,
}

impl<'a> Face<'a> {
    fn new(card: &'a Card, view: &RenderView) -> Result<Self, RenderError> {
        let code = QrCode::with_error_correction_level(card.text.as_bytes(), EcLevel::M).map_err(
            |source| RenderError::Text {
                text: card.text.clone(),
                source,
            },
        )?;
        let [columns, rows] = view.bounds(card);
        let facing = Vector2::new(card.facing_rad.cos(), card.facing_rad.sin());
        Ok(Self {
            card,
            side: code.width(),
            modules: code.into_colors(),
            facing,
            columns,
            rows,
        })
    }

    /// True if ink is printed at a point, in metres to the right of and above the middle of the
    /// code.
    fn is_ink(&self, right_m: f64, up_m: f64, placard: &Placard) -> bool {
        let module = |from_edge_m: f64| {
            let at = (from_edge_m / placard.qr_width_m * self.side as f64).floor();
            (at >= 0.0 && at < self.side as f64).then_some(at as usize)
        };
        let half = placard.qr_width_m / 2.0;
        match (module(right_m + half), module(half - up_m)) {
            (Some(column), Some(row)) => self.modules[row * self.side + column] == Color::Dark,
            _ => false,
        }
    }
}

/// A camera among the cards.
struct RenderView<'a> {
    intrinsics: &'a Intrinsics,
    placard: &'a Placard,
    pose: &'a Pose,
    /// Unit vector of the heading.
    ahead: Vector2<f64>,
    to_level: Matrix3<f64>,
    /// Top and bottom of all cards, in metres above the camera.
    top_m: f64,
    bottom_m: f64,
}

/// Intersection of a ray with a card.
struct Meeting<'a> {
    face: &'a Face<'a>,
    depth_m: f64,
    right_m: f64,
    up_m: f64,
    front: bool,
}

impl<'a> RenderView<'a> {
    /// A camera without a height is as high as the middle of the codes.
    fn new(
        intrinsics: &'a Intrinsics,
        pose: &'a Pose,
        mount: &Mount,
        placard: &'a Placard,
    ) -> Self {
        let top_m = mount
            .height_m
            .map_or(placard.card_width_m / 2.0, |height_m| {
                placard.card_height_m - height_m
            });
        let bottom_m = top_m - placard.card_height_m;
        Self {
            intrinsics,
            placard,
            pose,
            ahead: Vector2::new(pose.heading_rad.cos(), pose.heading_rad.sin()),
            to_level: mount.to_level(),
            top_m,
            bottom_m,
        }
    }

    /// Columns and rows that a card may be in; all if a corner of it is behind the camera.
    fn bounds(&self, card: &Card) -> [Range<usize>; 2] {
        let along = Vector2::new(-card.facing_rad.sin(), card.facing_rad.cos())
            * (self.placard.card_width_m / 2.0);
        let ends = [card.position + along, card.position - along];
        let corners = ends
            .iter()
            .flat_map(|end| [(end, self.top_m), (end, self.bottom_m)]);
        let pixel = |(end, up_m): (&Point2<f64>, f64)| {
            let (range_m, bearing_rad) = self.pose.range_bearing(end);
            let level = Vector3::new(
                range_m * bearing_rad.cos(),
                range_m * bearing_rad.sin(),
                up_m,
            );
            self.intrinsics
                .project(&Point3::from(self.to_level.transpose() * level))
        };
        let size = [
            self.intrinsics.width as usize,
            self.intrinsics.height as usize,
        ];
        let Some(corners) = corners.map(pixel).collect::<Option<Vec<_>>>() else {
            return size.map(|size| 0..size);
        };
        let range = |axis: usize| {
            let values = corners.iter().map(|corner| corner[axis]);
            let (low, high) = values.fold((f64::INFINITY, 0f64), |(low, high), at| {
                (low.min(at), high.max(at))
            });
            (low - 1.0).max(0.0) as usize..((high + 2.0) as usize).min(size[axis])
        };
        [range(0), range(1)]
    }

    /// The light along a ray of the level frame that may hit `faces`.
    fn light<'f>(&self, ray: &Vector3<f64>, faces: impl Iterator<Item = &'f Face<'f>>) -> Light {
        let ahead = self.ahead;
        let sight = ahead * ray.x + Vector2::new(-ahead.y, ahead.x) * ray.y;
        let mut nearest: Option<Meeting> = None;
        for face in faces {
            // Of two cards at one place, the later hides the earlier: a plate its sign.
            nearest = self
                .meet(face, &sight, ray.z)
                .filter(|met| {
                    nearest
                        .as_ref()
                        .is_none_or(|nearest| met.depth_m <= nearest.depth_m)
                })
                .or(nearest);
        }
        let Some(met) = nearest else {
            return self.surroundings(ray, &sight);
        };
        let code_m = self.top_m - self.placard.card_width_m / 2.0;
        let is_ink = || {
            met.face
                .is_ink(met.right_m, met.up_m - code_m, self.placard)
        };
        let colour = if !met.front {
            CARDBOARD
        } else if is_ink() {
            INK
        } else {
            PAPER
        };
        let towards = if met.front { 1.0 } else { -1.0 };
        let lit = 0.9 + 0.1 * (met.face.card.facing_rad - 0.6).cos() as f32 * towards;
        colour.map(|light| light * lit)
    }

    fn meet<'f>(&self, face: &'f Face<'f>, sight: &Vector2<f64>, rise: f64) -> Option<Meeting<'f>> {
        let approach = sight.dot(&face.facing);
        let depth_m = (face.card.position - self.pose.position).dot(&face.facing) / approach;
        let at = self.pose.position + sight * depth_m - face.card.position;
        let right_m = face.facing.x * at.y - face.facing.y * at.x;
        let up_m = depth_m * rise;
        let is_met = depth_m >= NEAR_M
            && right_m.abs() <= self.placard.card_width_m / 2.0
            && (self.bottom_m..=self.top_m).contains(&up_m);
        is_met.then_some(Meeting {
            face,
            depth_m,
            right_m,
            up_m,
            front: approach < 0.0,
        })
    }

    fn surroundings(&self, ray: &Vector3<f64>, sight: &Vector2<f64>) -> Light {
        let wall_m = WALL_M.max(-WALL_HEIGHTS * self.bottom_m);
        let floor_m = self.bottom_m / ray.z;
        if ray.z < 0.0 && floor_m * ray.x < wall_m {
            let at = self.pose.position + sight * floor_m;
            let grain = 7.0 * grain(at / 0.004) + 9.0 * grain(at / 0.05);
            FLOOR.map(|light| light + grain as f32)
        } else {
            let up_m = WALL_M * ray.z;
            let shade = 1.0 + 0.12 * up_m.clamp(-1.0, 1.0);
            WALL.map(|light| light * shade as f32)
        }
    }
}

/// Smooth pattern of random values from -1 to 1 with unit spacing, the same at every call.
fn grain(at: Point2<f64>) -> f64 {
    let corner = |x: f64, y: f64| {
        let seed = (x as i64 as u64).wrapping_mul(0x9e37_79b9_7f4a_7c15)
            ^ (y as i64 as u64).wrapping_mul(0xc2b2_ae3d_27d4_eb4f);
        let mixed = (seed ^ (seed >> 29)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        (mixed >> 40) as f64 / f64::from(1 << 23) - 1.0
    };
    let x = at.x.floor();
    let y = at.y.floor();
    let u = at.x - x;
    let v = at.y - y;
    let upper = corner(x, y) * (1.0 - u) + corner(x + 1.0, y) * u;
    let lower = corner(x, y + 1.0) * (1.0 - u) + corner(x + 1.0, y + 1.0) * u;
    upper * (1.0 - v) + lower * v
}
