//! The area in which a cell may report objects.

use super::COVER_M;
use crate::model::origin::GeographicPosition;
use crate::model::quadkey::Quadkey;

/// Metres in a degree of latitude.
const DEGREE_M: f64 = 111_195.0;

/// The tile of a cell and [`COVER_M`] around it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CoveredArea {
    /// The middle: latitude and longitude in degrees.
    middle_deg: [f64; 2],
    /// Half the sides in degrees.
    half_deg: [f64; 2],
}

impl CoveredArea {
    /// The area of the cells of a tile.
    pub fn of(tile: Quadkey) -> Self {
        let [[north_deg, west_deg], [south_deg, east_deg]] = tile.corners_deg();
        let middle_deg = [(north_deg + south_deg) / 2.0, (west_deg + east_deg) / 2.0];
        let cover_deg = COVER_M / DEGREE_M;
        let half_deg = [
            (north_deg - south_deg) / 2.0 + cover_deg,
            (east_deg - west_deg) / 2.0 + cover_deg / middle_deg[0].to_radians().cos(),
        ];
        Self {
            middle_deg,
            half_deg,
        }
    }

    /// True if a cell of the tile may report objects at a place.
    pub fn covers(&self, place: &GeographicPosition) -> bool {
        let north_deg = place.latitude_deg - self.middle_deg[0];
        let east_deg = (place.longitude_deg - self.middle_deg[1] + 180.0).rem_euclid(360.0) - 180.0;
        north_deg.abs() <= self.half_deg[0] && east_deg.abs() <= self.half_deg[1]
    }
}
