//! Masks: parts of a camera's picture that are black before anything else gets the picture.

use std::str::FromStr;

use ecod::config::ConfigError;
use ecod::perception::polygon::{Polygon, PolygonError};
use nalgebra::Point2;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::image_size::ImageSize;

/// Polygons of the picture.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(transparent)]
pub struct Masks(Vec<Mask>);

/// Corners `[x, y]` of a polygon in shares of the picture's width and height, from its upper left
/// corner.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(transparent)]
pub struct Mask(Vec<[f64; 2]>);

/// A text is not a mask.
#[derive(Debug, thiserror::Error)]
#[error(
    "need corners with commas inside and spaces between, such as \"0,0 0.3,0 0.3,0.4\", in shares of \
     the picture's width and height"
)]
pub struct MaskTextError;

impl FromStr for Mask {
    type Err = MaskTextError;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let share = |word: &str| word.trim().parse::<f64>().map_err(|_| MaskTextError);
        let corner = |word: &str| {
            let (x, y) = word.split_once(',').ok_or(MaskTextError)?;
            Ok([share(x)?, share(y)?])
        };
        let corners = text.split_whitespace().map(corner);
        Ok(Self(corners.collect::<Result<_, _>>()?))
    }
}

impl From<Vec<Mask>> for Masks {
    fn from(masks: Vec<Mask>) -> Self {
        Self(masks)
    }
}

/// Key of the masks among the keys of a camera.
const KEY: &str = "masks";

/// Maximum number of masks of a camera. Each is drawn into each frame.
const MAX_MASKS: usize = 64;

/// Maximum number of corners of a mask.
const MAX_CORNERS: usize = 128;

impl Masks {
    /// Number of masks.
    pub fn len(&self) -> usize {
        self.0.len()
    }

    /// True if no part of the picture is masked.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// The masks in shares of the picture's width and height.
    ///
    /// # Errors
    /// Returns a [`ConfigError`] whose key has the number of the mask, from 0, such as `masks[2]`.
    pub fn polygons(&self) -> Result<Vec<Polygon>, ConfigError> {
        if self.len() > MAX_MASKS {
            let allowed = format!("at most {MAX_MASKS} polygons: join neighbouring masks");
            let found = format!("{} polygons", self.len());
            return Err(ConfigError::new(KEY, found, allowed));
        }
        let numbered = self.0.iter().enumerate();
        numbered
            .map(|(number, Mask(corners))| {
                polygon(corners).map_err(|mut error| {
                    error.key = format!("{KEY}[{number}]{}", error.key);
                    error
                })
            })
            .collect()
    }

    /// The masks in pixels of pictures of this size; empty if the masks are not valid.
    pub fn in_pixels_of(&self, size: ImageSize) -> Vec<Polygon> {
        let shares = self.polygons().unwrap_or_default();
        let scaled = |mask: &Polygon| mask.scaled(size.width.into(), size.height.into());
        shares.iter().map(scaled).collect()
    }
}

fn polygon(corners: &[[f64; 2]]) -> Result<Polygon, ConfigError> {
    let outside = |corner: &[f64; 2]| corner.iter().any(|share| !(0.0..=1.0).contains(share));
    if let Some(number) = corners.iter().position(outside) {
        let [x, y] = corners[number];
        let allowed = "within the picture, with x and y from 0 to 1 as shares of its width and \
                       height: divide pixels by the picture's size";
        return Err(ConfigError::new(
            format!("[{number}]"),
            format!("[{x}, {y}]"),
            allowed,
        ));
    }
    if corners.len() > MAX_CORNERS {
        let allowed = format!("at most {MAX_CORNERS} corners: use several polygons");
        let found = format!("a polygon of {} corners", corners.len());
        return Err(ConfigError::new("", found, allowed));
    }
    let corners: Vec<_> = corners.iter().copied().map(Point2::from).collect();
    Polygon::new(&corners).map_err(|error| {
        let allowed = match error {
            PolygonError::Crossing { .. } => {
                "a polygon whose edges do not cross or touch: list its corners in order around the area"
            }
            _ => "a polygon of at least 3 corners [x, y] around an area",
        };
        ConfigError::new("", format!("a polygon with {error}"), allowed)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn error(masks: &[&[[f64; 2]]]) -> String {
        let masks = Masks(masks.iter().map(|mask| Mask(mask.to_vec())).collect());
        masks.polygons().unwrap_err().to_string()
    }

    #[test]
    fn corners_are_read_from_text() {
        let mask: Mask = "0,0 0.3,0  0.3,.4".parse().unwrap();
        assert_eq!(mask, Mask(vec![[0.0, 0.0], [0.3, 0.0], [0.3, 0.4]]));
        for text in ["0 0 1,1", "0,0;1,1", "a,b"] {
            assert!(text.parse::<Mask>().is_err(), "{text}");
        }
    }

    #[test]
    fn errors_name_mask_and_remedy() {
        let square = [[0.1, 0.1], [0.2, 0.1], [0.2, 0.2], [0.1, 0.2]];
        let cases: [(&[[f64; 2]], &str, &str); 6] = [
            (
                &[[0.1, 0.1], [0.2, 0.1]],
                "`masks[1]`",
                "at least 3 corners",
            ),
            (&[], "`masks[1]`", "at least 3 corners"),
            (
                &[[0.1, 0.1], [320.0, 0.1], [0.2, 0.2]],
                "`masks[1][1]`: [320, 0.1]",
                "divide pixels by the picture's size",
            ),
            (
                &[[0.1, 0.1], [0.2, 0.1], [0.2, f64::NAN]],
                "`masks[1][2]`",
                "from 0 to 1",
            ),
            (
                &[[0.1, 0.1], [0.2, 0.2], [0.3, 0.3]],
                "`masks[1]`",
                "around an area",
            ),
            (
                &[[0.1, 0.1], [0.2, 0.1], [0.1, 0.2], [0.2, 0.2]],
                "`masks[1]`: a polygon with edges from corners 1 and 3 that cross or touch",
                "in order around the area",
            ),
        ];
        for (bad, key, remedy) in cases {
            let text = error(&[&square, bad]);
            assert!(text.contains(key) && text.contains(remedy), "{text}");
        }
        let many = vec![&square[..]; MAX_MASKS + 1];
        let text = error(&many);
        assert!(text.contains("`masks`: 65 polygons"), "{text}");
        let long = vec![[0.5, 0.5]; MAX_CORNERS + 1];
        assert!(error(&[&long]).contains("`masks[0]`: a polygon of 129 corners"));
    }
}
