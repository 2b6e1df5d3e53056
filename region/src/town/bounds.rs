//! A rectangle of Earth's surface, and the tiles that cover it.

use std::str::FromStr;

use ecod::model::quadkey::{CELL_TILE_DIGITS, Quadkey};
use serde::Serialize;

/// A rectangle in degrees of latitude and longitude.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct GeographicBounds {
    /// Longitude of the west edge in degrees.
    pub west: f64,
    /// Latitude of the south edge in degrees.
    pub south: f64,
    /// Longitude of the east edge in degrees.
    pub east: f64,
    /// Latitude of the north edge in degrees.
    pub north: f64,
}

/// A text that is no [`GeographicBounds`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error(
    "bounds are four numbers WEST,SOUTH,EAST,NORTH in degrees, west below east and south below north"
)]
pub struct InvalidBounds;

impl FromStr for GeographicBounds {
    type Err = InvalidBounds;

    fn from_str(text: &str) -> Result<Self, InvalidBounds> {
        let numbers: Result<Vec<f64>, _> = text.split(',').map(str::parse).collect();
        let &[west, south, east, north] = numbers.map_err(|_| InvalidBounds)?.as_slice() else {
            return Err(InvalidBounds);
        };
        let bounds = Self {
            west,
            south,
            east,
            north,
        };
        if west < east
            && south < north
            && [west, south, east, north]
                .iter()
                .all(|number| number.is_finite())
        {
            Ok(bounds)
        } else {
            Err(InvalidBounds)
        }
    }
}

impl GeographicBounds {
    /// The bounds of a tile.
    pub fn of(tile: Quadkey) -> Self {
        let [[north, west], [south, east]] = tile.corners_deg();
        Self {
            west,
            south,
            east,
            north,
        }
    }

    /// The least bounds around both.
    #[must_use]
    pub fn with(self, other: Self) -> Self {
        Self {
            west: self.west.min(other.west),
            south: self.south.min(other.south),
            east: self.east.max(other.east),
            north: self.north.max(other.north),
        }
    }

    /// True if both have a place in common.
    pub fn intersects(&self, other: &Self) -> bool {
        self.west < other.east
            && other.west < self.east
            && self.south < other.north
            && other.south < self.north
    }

    /// The smallest tiles that cover the bounds, at most `max` tiles, which are not smaller than a
    /// cell's tile.
    pub fn tiles(&self, max: usize) -> Vec<Quadkey> {
        let mut tiles = vec![Quadkey::default()];
        tiles.retain(|tile| self.intersects(&Self::of(*tile)));
        for _ in 0..CELL_TILE_DIGITS {
            let parts = tiles.iter().flat_map(|tile| tile.quarters());
            let smaller: Vec<_> = parts
                .filter(|part| self.intersects(&Self::of(*part)))
                .collect();
            if smaller.is_empty() || smaller.len() > max {
                break;
            }
            tiles = smaller;
        }
        tiles
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn any_view_needs_few_tiles() {
        for (text, max_digits) in [
            ("2.29,48.85,2.30,48.86", 15),
            ("2.0,48.5,2.6,49.1", 11),
            ("-180,-85,180,85", 2),
        ] {
            let view: GeographicBounds = text.parse().unwrap();
            let tiles = view.tiles(16);
            assert!((1..=16).contains(&tiles.len()), "{text}: {}", tiles.len());
            assert!(
                tiles.iter().all(|tile| tile.digits() <= max_digits),
                "{text}: {}",
                tiles[0]
            );
            let all = tiles
                .iter()
                .map(|tile| GeographicBounds::of(*tile))
                .reduce(GeographicBounds::with)
                .unwrap();
            assert!(
                all.west <= view.west && all.east >= view.east && all.north >= view.north,
                "{all:?}"
            );
        }
        assert_eq!(
            "0,86,1,87".parse::<GeographicBounds>().unwrap().tiles(16),
            [],
            "beyond the map"
        );
        for stranger in ["", "1,2,3", "2,1,1,2", "a,b,c,d", "NaN,0,1,1"] {
            assert_eq!(
                stranger.parse::<GeographicBounds>(),
                Err(InvalidBounds),
                "{stranger}"
            );
        }
    }
}
