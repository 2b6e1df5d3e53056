//! Tiles of Earth's surface, named by quadkeys.
//!
//! Source: Microsoft, "Bing Maps Tile System": Web Mercator, each digit 0 to 3 a quarter of the
//! tile before it, x eastward and y southward.

use std::f64::consts::PI;
use std::fmt;
use std::str::FromStr;

use crate::model::origin::{GeographicOrigin, GeographicPosition};

/// Digits of the tile of a cell. Its side is 1.22 km at the equator, and 0.61 km at 60° of
/// latitude.
pub const CELL_TILE_DIGITS: u8 = 15;

/// Maximum latitude of the projection in degrees; places beyond it get the tile at this latitude.
const MAX_LATITUDE_DEG: f64 = 85.051_128_78;

/// Maximum digits of a tile.
const MAX_DIGITS: usize = 30;

/// A tile, and all tiles in it. As text: one digit for each level, the largest tile first. Without
/// digits: the whole map.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Quadkey {
    digits: u8,
    x: u32,
    y: u32,
}

/// A text that is no [`Quadkey`].
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{0:?} is no quadkey: it has at most {MAX_DIGITS} digits from 0 to 3")]
pub struct InvalidQuadkey(String);

impl Quadkey {
    /// The tile with this number of digits, 30 at most, in which a position is.
    pub fn of(position: &GeographicPosition, digits: u8) -> Self {
        let digits = digits.min(MAX_DIGITS as u8);
        let sin = position
            .latitude_deg
            .clamp(-MAX_LATITUDE_DEG, MAX_LATITUDE_DEG)
            .to_radians()
            .sin();
        let east = (position.longitude_deg + 180.0).rem_euclid(360.0) / 360.0;
        let south = 0.5 - ((1.0 + sin) / (1.0 - sin)).ln() / (4.0 * PI);
        let tiles = f64::from(1_u32 << digits);
        // `as` saturates, so that the edges of the map stay in it.
        let index = |share: f64| ((share * tiles) as u32).min((1 << digits) - 1);
        Self {
            digits,
            x: index(east),
            y: index(south),
        }
    }

    /// The tile of the cell with this origin, of [`CELL_TILE_DIGITS`].
    pub fn of_cell(origin: &GeographicOrigin) -> Self {
        let GeographicOrigin {
            latitude_deg,
            longitude_deg,
            height_m,
            ..
        } = *origin;
        Self::of(
            &GeographicPosition {
                latitude_deg,
                longitude_deg,
                height_m,
            },
            CELL_TILE_DIGITS,
        )
    }

    /// This tile and the adjacent tiles: nine, or fewer at the northern and southern ends of the
    /// map.
    pub fn with_neighbours(self) -> Vec<Self> {
        let tiles = 1_i64 << self.digits;
        let at = |dx: i64, dy: i64| {
            let y = i64::from(self.y) + dy;
            let x = (i64::from(self.x) + dx).rem_euclid(tiles);
            (0..tiles).contains(&y).then_some(Self {
                digits: self.digits,
                x: x as u32,
                y: y as u32,
            })
        };
        let mut tiles: Vec<_> = (-1..=1)
            .flat_map(|dy| (-1..=1).map(move |dx| (dx, dy)))
            .filter_map(|(dx, dy)| at(dx, dy))
            .collect();
        tiles.sort_unstable();
        tiles.dedup();
        tiles
    }

    /// Number of digits; 0 for the whole map.
    pub fn digits(self) -> u8 {
        self.digits
    }

    /// The enclosing tile with this number of digits, at most this tile's own.
    #[must_use]
    pub fn outer(self, digits: u8) -> Self {
        let fewer = self.digits.saturating_sub(digits);
        Self {
            digits: self.digits - fewer,
            x: self.x >> fewer,
            y: self.y >> fewer,
        }
    }

    /// True if another tile is this one or in it.
    pub fn contains(self, inner: Self) -> bool {
        inner.digits >= self.digits && inner.outer(self.digits) == self
    }

    /// The four tiles of one digit more.
    pub fn quarters(self) -> [Self; 4] {
        [0, 1, 2, 3].map(|digit| Self {
            digits: self.digits + 1,
            x: self.x << 1 | digit & 1,
            y: self.y << 1 | digit >> 1,
        })
    }

    /// Levels of a topic, one digit each: `0/2/1`.
    pub fn levels(self) -> String {
        let digits: Vec<_> = self.to_string().chars().map(String::from).collect();
        digits.join("/")
    }

    /// The north-west and the south-east corner, as `[latitude, longitude]` in degrees.
    pub fn corners_deg(self) -> [[f64; 2]; 2] {
        let tiles = f64::from(1_u32 << self.digits);
        let corner = |x: f64, y: f64| {
            let latitude = (PI * (1.0 - 2.0 * y / tiles)).sinh().atan();
            [latitude.to_degrees(), x / tiles * 360.0 - 180.0]
        };
        let x = f64::from(self.x);
        let y = f64::from(self.y);
        [corner(x, y), corner(x + 1.0, y + 1.0)]
    }
}

impl fmt::Display for Quadkey {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        (0..self.digits).rev().try_for_each(|bit| {
            let digit = (self.x >> bit & 1) | (self.y >> bit & 1) << 1;
            write!(f, "{digit}")
        })
    }
}

impl FromStr for Quadkey {
    type Err = InvalidQuadkey;

    fn from_str(text: &str) -> Result<Self, InvalidQuadkey> {
        let invalid = || InvalidQuadkey(text.to_owned());
        if text.len() > MAX_DIGITS {
            return Err(invalid());
        }
        text.chars().try_fold(Self::default(), |tile, digit| {
            let digit = digit.to_digit(4).ok_or_else(invalid)?;
            Ok(tile.quarters()[digit as usize])
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(latitude_deg: f64, longitude_deg: f64) -> GeographicPosition {
        GeographicPosition {
            latitude_deg,
            longitude_deg,
            height_m: 0.0,
        }
    }

    #[test]
    fn keys_match_tile_system() {
        // Microsoft's example: tile (3, 5) of level 3 has the key 213.
        let tile = Quadkey {
            digits: 3,
            x: 3,
            y: 5,
        };
        assert_eq!(
            (tile.to_string(), tile.levels()),
            ("213".to_owned(), "2/1/3".to_owned())
        );
        assert_eq!("213".parse(), Ok(tile));
        // The Eiffel Tower, by mercantile 1.2.1.
        assert_eq!(
            Quadkey::of(&at(48.8584, 2.2945), CELL_TILE_DIGITS).to_string(),
            "120220011012000"
        );
        for stranger in ["4", "21x", "0123012301230123012301230123012"] {
            assert!(stranger.parse::<Quadkey>().is_err(), "{stranger}");
        }
    }

    #[test]
    fn tile_contains_exactly_its_quarters() {
        let [outer, inner, beside] =
            ["213", "21302", "2120"].map(|key| key.parse::<Quadkey>().unwrap());
        assert!(
            outer.contains(outer) && outer.contains(inner) && Quadkey::default().contains(outer)
        );
        assert!(!outer.contains(beside) && !inner.contains(outer));
        assert_eq!((inner.outer(3), inner.outer(9)), (outer, inner));
        assert!(
            outer
                .quarters()
                .iter()
                .all(|quarter| outer.contains(*quarter) && quarter.digits() == 4)
        );
    }

    #[test]
    fn position_is_inside_tile_near_neighbours() {
        for (latitude, longitude) in [
            (48.85, 2.29),
            (-33.9, 151.2),
            (0.0, -180.0),
            (-89.0, 179.999),
            (84.9, 0.1),
        ] {
            let tile = Quadkey::of(&at(latitude, longitude), CELL_TILE_DIGITS);
            let [[north, west], [south, east]] = tile.corners_deg();
            let latitude = f64::clamp(latitude, -MAX_LATITUDE_DEG, MAX_LATITUDE_DEG);
            assert!(
                (south - 1e-9..=north + 1e-9).contains(&latitude),
                "{south} {latitude} {north}"
            );
            assert!((west..=east).contains(&longitude));
            let around = tile.with_neighbours();
            assert!(around.contains(&tile) && around.len() >= 6, "{around:?}");
            assert!(
                around
                    .iter()
                    .all(|near| near.to_string().parse() == Ok(*near))
            );
        }
        assert_eq!(
            Quadkey::of(&at(0.0, 179.999), 15).with_neighbours().len(),
            9,
            "across the date line"
        );
    }
}
