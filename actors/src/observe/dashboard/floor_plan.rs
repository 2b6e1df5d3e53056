//! Floor plan under the map: an image file, placed by two points with given positions.

use std::path::PathBuf;

use bytes::Bytes;
use ecod::config::ConfigError;
use imagesize::ImageType;
use nalgebra::Complex;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::platform::bounded_file;

/// An image of the cell's ground from above, such as a floor plan or an aerial photograph.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct FloorPlanConfig {
    /// PNG, JPEG or WebP file, 8 MiB at most.
    pub image: PathBuf,
    /// Two points with `pixel` (column, row) and `position_m` (east, north), which determine scale,
    /// direction and place.
    pub points: [FloorPlanPoint; 2],
}

/// A point of the image with a given position.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct FloorPlanPoint {
    /// Column and row in pixels from the upper left corner.
    pub pixel: [f64; 2],
    /// East and north in metres.
    pub position_m: [f64; 2],
}

/// A floor plan that has been read.
#[derive(Debug, Clone)]
pub struct FloorPlan {
    pub(crate) content_type: &'static str,
    pub(crate) content: Bytes,
    pub(crate) facts: FloorPlanFacts,
}

/// A floor plan's place, for a browser.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct FloorPlanFacts {
    /// Path of the image.
    path: &'static str,
    /// The map `[a, b, c, d, e, f]` from pixels to metres: east is a·column + c·row + e, north is
    /// b·column + d·row + f.
    metres: [f64; 6],
}

/// Path of the image.
pub(crate) const PATH: &str = "/api/floor_plan";

/// Maximum size of the image file.
const MAX_BYTES: u64 = 8 * 1024 * 1024;

/// Maximum coordinate, in pixels or metres.
const MAX_COORDINATE: f64 = 1e6;

impl FloorPlanConfig {
    /// Checks the points, but not the file.
    ///
    /// # Errors
    /// Returns a [`ConfigError`] with the key, the value and the allowed range.
    pub fn validate(&self) -> Result<(), ConfigError> {
        for (index, point) in self.points.iter().enumerate() {
            for (key, value) in [("pixel", point.pixel), ("position_m", point.position_m)] {
                if !value
                    .iter()
                    .all(|coordinate| coordinate.abs() <= MAX_COORDINATE)
                {
                    let allowed = format!("numbers from -{MAX_COORDINATE} to {MAX_COORDINATE}");
                    return Err(ConfigError::new(
                        format!("points[{index}].{key}"),
                        format!("{value:?}"),
                        allowed,
                    ));
                }
            }
        }
        let [one, other] = self.points;
        for (key, one, other) in [
            ("pixel", one.pixel, other.pixel),
            ("position_m", one.position_m, other.position_m),
        ] {
            if one == other {
                let allowed = format!("two points, each with a {key} of its own");
                return Err(ConfigError::new(
                    "points",
                    format!("{one:?} as the {key} of both"),
                    allowed,
                ));
            }
        }
        Ok(())
    }

    /// Reads the image.
    ///
    /// # Errors
    /// Returns a [`ConfigError`] if the file cannot be read, is too large or not an image, or a
    /// point lies outside of it.
    pub fn load(&self) -> Result<FloorPlan, ConfigError> {
        let refuse = |found: String| {
            let allowed = format!(
                "a PNG, JPEG or WebP file of {} MiB at most",
                MAX_BYTES / 1024 / 1024
            );
            ConfigError::new("image", format!("{:?}: {found}", self.image), allowed)
        };
        let content = bounded_file::read(&self.image, MAX_BYTES)
            .map_err(|error| refuse(error.to_string()))?;
        let content_type = match imagesize::image_type(&content) {
            Ok(ImageType::Png) => "image/png",
            Ok(ImageType::Jpeg) => "image/jpeg",
            Ok(ImageType::Webp) => "image/webp",
            _ => return Err(refuse("no such image".into())),
        };
        let size = imagesize::blob_size(&content).map_err(|error| refuse(error.to_string()))?;
        for (
            index,
            FloorPlanPoint {
                pixel: [column, row],
                ..
            },
        ) in self.points.iter().enumerate()
        {
            if !(0.0..=size.width as f64).contains(column)
                || !(0.0..=size.height as f64).contains(row)
            {
                let allowed = format!(
                    "a point of the image, which is {} × {} pixels",
                    size.width, size.height
                );
                return Err(ConfigError::new(
                    format!("points[{index}].pixel"),
                    format!("[{column}, {row}]"),
                    allowed,
                ));
            }
        }
        let facts = FloorPlanFacts {
            path: PATH,
            metres: self.metres(),
        };
        Ok(FloorPlan {
            content_type,
            content: content.into(),
            facts,
        })
    }

    /// The similarity through both points. With rows counted upwards it is the complex function m =
    /// s·p + t.
    fn metres(&self) -> [f64; 6] {
        let [(p1, m1), (p2, m2)] = self.points.map(|FloorPlanPoint { pixel, position_m }| {
            (
                Complex::new(pixel[0], -pixel[1]),
                Complex::new(position_m[0], position_m[1]),
            )
        });
        let s = (m2 - m1) / (p2 - p1);
        let t = m1 - s * p1;
        [s.re, s.im, s.im, -s.re, t.re, t.im]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The smallest PNG file of this size, as far as its head goes.
    fn png(width: u32, height: u32) -> Vec<u8> {
        let head = b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR";
        [
            &head[..],
            &width.to_be_bytes(),
            &height.to_be_bytes(),
            &[8, 2, 0, 0, 0],
        ]
        .concat()
    }

    fn plan(image: PathBuf, points: [([f64; 2], [f64; 2]); 2]) -> FloorPlanConfig {
        FloorPlanConfig {
            image,
            points: points.map(|(pixel, position_m)| FloorPlanPoint { pixel, position_m }),
        }
    }

    fn place(config: &FloorPlanConfig, [column, row]: [f64; 2]) -> [f64; 2] {
        let [a, b, c, d, e, f] = config.metres();
        [a * column + c * row + e, b * column + d * row + f]
    }

    #[test]
    fn two_points_place_plan() {
        let upright = plan(
            "a.png".into(),
            [([100.0, 300.0], [0.0, 0.0]), ([300.0, 100.0], [10.0, 10.0])],
        );
        let turned = plan(
            "a.png".into(),
            [([0.0, 0.0], [5.0, 5.0]), ([100.0, 0.0], [5.0, 15.0])],
        );
        for (config, pixel, wanted) in [
            (&upright, [300.0, 300.0], [10.0, 0.0]),
            (&upright, [100.0, 100.0], [0.0, 10.0]),
            (&turned, [100.0, 0.0], [5.0, 15.0]),
            // Right in the image is north, so down is east.
            (&turned, [0.0, 100.0], [15.0, 5.0]),
        ] {
            let found = place(config, pixel);
            assert!(
                found.iter().zip(wanted).all(|(a, b)| (a - b).abs() < 1e-9),
                "{pixel:?}: {found:?}, not {wanted:?}"
            );
        }
    }

    #[test]
    fn unusable_plan_names_remedy() {
        let directory = tempfile::tempdir().unwrap();
        let good = [([0.0, 0.0], [0.0, 0.0]), ([640.0, 480.0], [10.0, -7.5])];
        let file = |name: &str, content: &[u8]| {
            let path = directory.path().join(name);
            std::fs::write(&path, content).unwrap();
            path
        };
        let image = file("plan.png", &png(640, 480));
        assert_eq!(
            plan(image.clone(), good).load().unwrap().content_type,
            "image/png"
        );

        let same_pixel = plan(image.clone(), [good[0], ([0.0, 0.0], [1.0, 1.0])]);
        let same_place = plan(image.clone(), [good[0], ([9.0, 9.0], [0.0, 0.0])]);
        let no_number = plan(image.clone(), [good[0], ([f64::NAN, 9.0], [1.0, 1.0])]);
        for (config, key) in [
            (same_pixel, "points"),
            (same_place, "points"),
            (no_number, "points[1].pixel"),
        ] {
            assert_eq!(config.validate().unwrap_err().key, key);
        }
        let outside = plan(image, [good[0], ([641.0, 0.0], [1.0, 1.0])])
            .load()
            .unwrap_err();
        assert_eq!(
            (outside.key.as_str(), outside.allowed.contains("640 × 480")),
            ("points[1].pixel", true)
        );
        for (path, cause) in [
            (directory.path().join("none.png"), "No such file"),
            (file("text.png", b"not an image at all"), "no such image"),
            (
                file("large.png", &vec![0; MAX_BYTES as usize + 1]),
                "more than 8388608 bytes",
            ),
        ] {
            let error = plan(path, good).load().unwrap_err();
            assert!(
                error.key == "image" && error.fault.to_string().contains(cause),
                "{error}"
            );
        }
    }
}
