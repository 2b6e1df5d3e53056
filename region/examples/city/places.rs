//! Places of the cells of a city, and the halves of it that subscribers read.

use std::collections::{BTreeMap, BTreeSet};

use ecod::model::names::NodeName;
use ecod::model::origin::GeographicOrigin;
use ecod::model::quadkey::Quadkey;

/// A cell and the place of its origin.
#[derive(Debug, Clone)]
pub(crate) struct Place {
    pub(crate) cell: NodeName,
    pub(crate) origin: GeographicOrigin,
}

/// A half of the town: its tiles, and the cells in them.
#[derive(Debug, Default)]
pub(crate) struct Half {
    pub(crate) tiles: BTreeSet<Quadkey>,
    pub(crate) cells: usize,
}

/// Digits of the tiles that subscribers ask for: some 20 km.
const HALF_DIGITS: u8 = 11;

/// Distance between cells in degrees: some 800 m, so that each is alone in its tile or nearly so.
const STEP_DEG: f64 = 0.0075;

/// Places of simulated and of real cells, in a square about a town.
pub(crate) fn places(simulated: usize, real: usize) -> Vec<Place> {
    let count = simulated + real;
    let side = (count as f64).sqrt().ceil() as usize;
    let place = |number: usize| {
        let row = number / side;
        let column = number % side;
        let origin = GeographicOrigin {
            latitude_deg: 48.7 + row as f64 * STEP_DEG,
            longitude_deg: 2.2 + column as f64 * 1.5 * STEP_DEG,
            height_m: 0.0,
            rotation_deg: 0.0,
        };
        let name = if number < simulated {
            format!("cell-{number}")
        } else {
            format!("real-{number}")
        };
        Some(Place {
            cell: NodeName::new(name).ok()?,
            origin,
        })
    };
    (0..count).filter_map(place).collect()
}

/// Two halves of about as many cells.
pub(crate) fn halves(places: &[Place]) -> [Half; 2] {
    let mut tiles = BTreeMap::<Quadkey, usize>::new();
    for Place { origin, .. } in places {
        *tiles
            .entry(Quadkey::of_cell(origin).outer(HALF_DIGITS))
            .or_default() += 1;
    }
    let mut halves = [Half::default(), Half::default()];
    for (tile, cells) in tiles {
        let [a, b] = &mut halves;
        let half = if a.cells <= b.cells { a } else { b };
        half.tiles.insert(tile);
        half.cells += cells;
    }
    halves
}
