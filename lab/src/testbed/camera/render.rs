//! The undisturbed view: one ray per sample, four by four samples per pixel.
//!
//! Cards stand upright and the axis of the camera is level, so that a column of samples meets each card at one depth:
//! cards are sorted once per column and looked up per row.

use ecod::model::geometry::Pose;
use nalgebra::{Point2, Vector2};
use opencv::core::{CV_8UC3, Mat, Scalar, Vec3b};
use opencv::prelude::*;
use qrcode::{Color, EcLevel, QrCode};

use super::RenderError;
use crate::testbed::{Card, Placard, Testbed};

/// Samples per pixel in each direction.
const SAMPLES: usize = 4;
/// Depth of the wall behind everything, in metres.
const WALL_M: f64 = 2.5;

/// Blue, green and red light, 0 to 255.
type Light = [f32; 3];

const PAPER: Light = [222.0, 226.0, 228.0];
const INK: Light = [34.0, 32.0, 33.0];
const CARDBOARD: Light = [92.0, 132.0, 168.0];
const FLOOR: Light = [104.0, 110.0, 114.0];
const WALL: Light = [150.0, 158.0, 160.0];

/// View of the camera at `pose`, as 8-bit BGR.
pub(super) fn still(testbed: &Testbed, cards: &[Card], pose: &Pose) -> Result<Mat, RenderError> {
    let camera = &testbed.camera.intrinsics;
    let faces = cards.iter().map(Face::new).collect::<Result<Vec<_>, _>>()?;
    let (width, height) = (camera.width as usize, camera.height as usize);
    let mut light = vec![[0f32; 3]; width * height];
    for sample in 0..width * SAMPLES {
        let slope = (camera.cx - centre(sample)) / camera.fx;
        let column = Column::new(&faces, pose, slope, &testbed.placard);
        for row in 0..height * SAMPLES {
            let rise = (camera.cy - centre(row)) / camera.fy;
            let pixel = &mut light[row / SAMPLES * width + sample / SAMPLES];
            for (sum, light) in pixel.iter_mut().zip(column.light(rise)) {
                *sum += light;
            }
        }
    }
    let error = RenderError::at("allocating a view");
    let (rows, columns) = (camera.height.cast_signed(), camera.width.cast_signed());
    let mut image = Mat::new_rows_cols_with_default(rows, columns, CV_8UC3, Scalar::default()).map_err(error)?;
    let pixels = image.data_typed_mut::<Vec3b>().map_err(RenderError::at("filling a view"))?;
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

/// A card with its printed code.
struct Face<'a> {
    card: &'a Card,
    modules: Vec<Color>,
    /// Modules along one side.
    side: usize,
}

impl<'a> Face<'a> {
    fn new(card: &'a Card) -> Result<Self, RenderError> {
        let code = QrCode::with_error_correction_level(card.text.as_bytes(), EcLevel::M)
            .map_err(|source| RenderError::Text { text: card.text.clone(), source })?;
        Ok(Self { card, side: code.width(), modules: code.into_colors() })
    }

    /// True if ink is printed at a point, in metres to the right of and above the middle of the code.
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

/// One column of samples: the cards it meets, nearest first.
struct Column<'a> {
    placard: &'a Placard,
    /// Top and bottom of all cards, in metres above the axis of the camera.
    top_m: f64,
    bottom_m: f64,
    origin: Point2<f64>,
    sight: Vector2<f64>,
    met: Vec<Meeting<'a>>,
}

struct Meeting<'a> {
    face: &'a Face<'a>,
    depth_m: f64,
    right_m: f64,
    front: bool,
    /// Share of the light that falls on this side.
    lit: f32,
}

impl<'a> Column<'a> {
    fn new(faces: &'a [Face<'a>], pose: &Pose, slope: f64, placard: &'a Placard) -> Self {
        let top_m = placard.card_width_m / 2.0;
        let meeting = |face: &'a Face<'a>| {
            let hit = face.card.hit(pose, slope)?;
            (hit.right_m.abs() <= placard.card_width_m / 2.0).then(|| Meeting {
                face,
                depth_m: hit.depth_m,
                right_m: hit.right_m,
                front: hit.front,
                lit: 0.9 + 0.1 * (face.card.facing_rad - 0.6).cos() as f32 * if hit.front { 1.0 } else { -1.0 },
            })
        };
        // Of two cards at one place, the later hides the earlier: a plate its sign.
        let mut met: Vec<_> = faces.iter().rev().filter_map(meeting).collect();
        met.sort_by(|a, b| a.depth_m.total_cmp(&b.depth_m));
        let (sin, cos) = pose.heading_rad.sin_cos();
        let sight = Vector2::new(cos - sin * slope, sin + cos * slope);
        Self { placard, top_m, bottom_m: top_m - placard.card_height_m, origin: pose.position, sight, met }
    }

    /// The light from one row; `rise` is the tangent of its elevation along the axis.
    fn light(&self, rise: f64) -> Light {
        let hit = self.met.iter().find(|met| (self.bottom_m..=self.top_m).contains(&(met.depth_m * rise)));
        match hit {
            Some(met) => {
                let ink = met.front && met.face.is_ink(met.right_m, met.depth_m * rise, self.placard);
                let colour = match (ink, met.front) {
                    (true, _) => INK,
                    (false, true) => PAPER,
                    (false, false) => CARDBOARD,
                };
                colour.map(|light| light * met.lit)
            }
            None => self.surroundings(rise),
        }
    }

    fn surroundings(&self, rise: f64) -> Light {
        let floor_m = self.bottom_m / rise;
        if rise < 0.0 && floor_m < WALL_M {
            let at = self.origin + self.sight * floor_m;
            let grain = 7.0 * grain(at / 0.004) + 9.0 * grain(at / 0.05);
            FLOOR.map(|light| light + grain as f32)
        } else {
            let up_m = WALL_M * rise;
            let shade = 1.0 + 0.12 * up_m.clamp(-1.0, 1.0);
            WALL.map(|light| light * shade as f32)
        }
    }
}

/// Smooth pattern of random values from -1 to 1 with unit spacing, the same at every call.
fn grain(at: Point2<f64>) -> f64 {
    let corner = |x: f64, y: f64| {
        let mixed = (x as i64 as u64).wrapping_mul(0x9e37_79b9_7f4a_7c15)
            ^ (y as i64 as u64).wrapping_mul(0xc2b2_ae3d_27d4_eb4f);
        let mixed = (mixed ^ (mixed >> 29)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        (mixed >> 40) as f64 / f64::from(1 << 23) - 1.0
    };
    let (x, y) = (at.x.floor(), at.y.floor());
    let (u, v) = (at.x - x, at.y - y);
    let upper = corner(x, y) * (1.0 - u) + corner(x + 1.0, y) * u;
    let lower = corner(x, y + 1.0) * (1.0 - u) + corner(x + 1.0, y + 1.0) * u;
    upper * (1.0 - v) + lower * v
}
