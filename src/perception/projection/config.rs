//! Settings of projection: the method of ranging, object sizes and uncertainties.

use std::collections::BTreeMap;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::coco_sizes;
use crate::config::{ConfigError, check_range, config_section};
use crate::model::names::Label;

/// Standard deviation in pixels of a box edge of a neural detector.
pub const NEURAL_PIXEL_SIGMA_PX: f64 = 3.0;

/// The method of finding the distance of a detection.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Ranging {
    /// [`Ranging::Corners`] where a detection has corners. Otherwise [`Ranging::Ground`] and
    /// [`Ranging::BoxHeight`], weighted by their covariance where both hold; without the height of
    /// the camera, the latter alone.
    #[default]
    Auto,
    /// From the four corners of a square target, at any yaw; the most exact. Detections without
    /// corners are ranged by [`Ranging::BoxHeight`].
    Corners,
    /// z = f_y · height / box height: exact for an upright object at any yaw.
    BoxHeight,
    /// d = s / (2 tan(α/2)) with α the angle between the bearings of the two edges: exact for a
    /// width perpendicular to the line of sight, too far for an object that is turned away.
    BoxWidth,
    /// From the intersection of the foot of the box with the ground: for objects on level ground
    /// and a camera of configured height.
    Ground,
    /// The paper's formulas (PACE client, Algorithm 1) to the letter, with their errors: d = s /
    /// tan α with α spread evenly over the columns, and bearings from the left edge of the image.
    /// `projection/paper.rs` explains them.
    Paper,
}

impl Ranging {
    /// True if the corners of a detection count.
    pub fn uses_corners(self) -> bool {
        matches!(self, Self::Auto | Self::Corners)
    }
}

/// The true size of a kind of object.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ObjectSize {
    /// Width in metres; the side of a square target.
    pub width_m: f64,
    /// Height in metres; the side of a square target.
    pub height_m: f64,
    /// Length in metres, the horizontal extent across the width; default the width. It matters if
    /// the ground gives the distance.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub length_m: Option<f64>,
    /// Relative standard deviation of sizes of this kind and of the focal length together; default
    /// 0.02. A value that is too small makes positions over-confident along the line of sight; one
    /// that is too large makes them count less in fusion.
    #[serde(default = "default_relative_sigma")]
    pub relative_sigma: f64,
}

impl ObjectSize {
    /// A square of the given side, with the default uncertainty.
    pub fn square(side_m: f64) -> Self {
        Self {
            width_m: side_m,
            height_m: side_m,
            length_m: None,
            relative_sigma: default_relative_sigma(),
        }
    }

    fn validate(&self) -> Result<(), ConfigError> {
        check_range("width_m", self.width_m, 1e-4, 1e3)?;
        check_range("height_m", self.height_m, 1e-4, 1e3)?;
        if let Some(length_m) = self.length_m {
            check_range("length_m", length_m, 0.0, 1e3)?;
        }
        check_range("relative_sigma", self.relative_sigma, 0.0, 1.0)
    }
}

/// Object sizes by label.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct ObjectSizes {
    /// Size of unlisted labels: `width_m`, `height_m` (0.0001–1000), `length_m` (0–1000; default
    /// the width), `relative_sigma` (0–1; default 0.02). Default: no size. Labels of COCO then have
    /// their usual sizes, and other labels have no position, unless the ground gives one.
    pub default: Option<ObjectSize>,
    /// Sizes by label; COCO labels have built-in sizes. Default: empty.
    pub labels: BTreeMap<Label, ObjectSize>,
}

impl ObjectSizes {
    /// The size of a label: listed, default, or usual for a label of COCO.
    pub fn of(&self, label: &str) -> Option<&ObjectSize> {
        self.labels
            .get(label)
            .or(self.default.as_ref())
            .or_else(|| coco_sizes::of(label))
    }

    /// Checks every size.
    ///
    /// # Errors
    /// Returns a [`ConfigError`] with the first key out of range.
    pub fn validate(&self) -> Result<(), ConfigError> {
        if let Some(size) = &self.default {
            size.validate().map_err(|e| e.within("default"))?;
        }
        self.labels.iter().try_for_each(|(label, size)| {
            size.validate()
                .map_err(|e| e.within(&format!("labels.{label}")))
        })
    }
}

config_section! {
    /// Settings of the projection from the image to the ground.
    pub struct ProjectionConfig {
        /// The method of ranging; default `auto`: from corners, otherwise from the box's height
        /// and, if the camera's height is configured, the ground. `box_height` needs upright
        /// objects, `box_width` objects that face the camera, `ground` objects on level ground;
        /// `paper` has the published formulas with their errors.
        pub ranging: Ranging = Ranging::default();
        /// True sizes of objects; by default only the usual sizes of COCO's labels.
        pub sizes: ObjectSizes = ObjectSizes::default(), checked by ObjectSizes::validate;
        /// Standard deviation of a box edge or corner in pixels; default 1.0. Placard corners reach
        /// 0.5, neural detectors 3 and more.
        pub pixel_sigma_px: f64 = 1.0, in 0.0 to 1e3;
        /// Standard deviation of the camera's heading in radians; default 0.01.
        pub heading_sigma_rad: f64 = 0.01, in 0.0 to std::f64::consts::PI;
        /// Standard deviation of the camera's pitch and roll in radians; default 0.0175 (1°). It
        /// covers a mount that was measured by hand and a road that is not level.
        pub tilt_sigma_rad: f64 = 0.0175, in 0.0 to 1.0;
        /// Standard deviation of the camera's height above the ground at the object in metres;
        /// default 0.02. Bumps count.
        pub height_sigma_m: f64 = 0.02, in 0.0 to 1e3;
        /// Standard deviation of the camera's position in metres, each axis; default 0.005.
        pub position_sigma_m: f64 = 0.005, in 0.0 to 1e3;
        /// Added to every standard deviation in quadrature, in metres; default 0.005. Keeps
        /// covariances away from zero.
        pub floor_m: f64 = 0.005, in 1e-6 to 1e3;
    }
}

fn default_relative_sigma() -> f64 {
    0.02
}
