//! Roaming: selects the cell in which a vehicle is a member, by its position.
//!
//! ```text
//! position ── observe ──> CellChoice ──> CellMove::Join    get ready in the next cell, and go on in the present one
//!       the next follows ── enter ──┘└─> CellMove::GiveUp  stay in the present one
//! ```
//!
//! A cell is a circle around its origin. A vehicle changes to a cell if it is inside that cell, and
//! that cell is nearer than the current one by [`MARGIN_M`]. Distances are to the circles' edges,
//! negative inside. Where circles overlap, the border is in the middle.

use std::collections::BTreeMap;
use std::time::Duration;

use crate::model::names::NodeName;
use crate::model::origin::{GeographicOrigin, GeographicPosition};
use crate::model::time::Timestamp;

/// Distance in metres by which the next cell must be nearer: more than localisation by satellites
/// jumps on a road.
pub const MARGIN_M: f64 = 20.0;

/// Maximum time for which a vehicle prepares in the next cell.
pub const JOIN_TIMEOUT: Duration = Duration::from_secs(15);

/// Time for which a cell that could not be joined is not tried again.
pub const RETRY_AFTER: Duration = Duration::from_secs(30);

/// Time for which a cell is not tried again after the vehicle has turned away from it.
pub const TURN_PAUSE: Duration = Duration::from_secs(5);

/// A cell in a vehicle's list.
#[derive(Debug, Clone, PartialEq)]
pub struct KnownCell {
    /// Name of the cell, by which the vehicle joins it.
    pub name: NodeName,
    /// Origin of the cell's frame; the cell is the circle of `radius_m` around it.
    pub origin: GeographicOrigin,
    /// Radius of the cell in metres.
    pub radius_m: f64,
}

impl KnownCell {
    /// Horizontal distance in metres to the edge, independent of the height; negative inside.
    fn outside_m(&self, place: &GeographicPosition) -> f64 {
        self.origin.to_map(place).coords.xy().norm() - self.radius_m
    }
}

/// The next step of the vehicle.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum CellMove {
    /// Prepare in this cell, and stay in the present one until then.
    Join(NodeName),
    /// Leave this cell again, and stay in the present one.
    GiveUp(NodeName),
}

/// The choice of a vehicle's cell; see the [module](self).
#[derive(Debug, Clone)]
pub struct CellChoice {
    cells: Vec<KnownCell>,
    present: NodeName,
    /// The cell in which the vehicle prepares, and since when.
    next: Option<(NodeName, Timestamp)>,
    /// Cells that could not be joined, and the time until which they are not tried.
    failed: BTreeMap<NodeName, Timestamp>,
}

impl CellChoice {
    /// The choice among `cells` of a vehicle that is in `present`.
    pub fn new(cells: Vec<KnownCell>, present: NodeName) -> Self {
        Self {
            cells,
            present,
            next: None,
            failed: BTreeMap::new(),
        }
    }

    /// The cell in which the vehicle is a member.
    pub fn present(&self) -> &NodeName {
        &self.present
    }

    /// Processes the vehicle's position at `now`, or `None` if it is unavailable. Repeated calls
    /// with the same position let time pass.
    pub fn observe(
        &mut self,
        place: Option<&GeographicPosition>,
        now: Timestamp,
    ) -> Option<CellMove> {
        self.failed.retain(|_, until| *until > now);
        if let Some((next, _)) = self
            .next
            .clone()
            .filter(|(_, since)| now.since(*since) > JOIN_TIMEOUT)
        {
            self.fail(&next, now);
            return Some(CellMove::GiveUp(next));
        }
        let place = place?;
        let outside_m = |name: &NodeName| {
            let cell = self.cells.iter().find(|cell| cell.name == *name);
            cell.map_or(f64::INFINITY, |cell| cell.outside_m(place))
        };
        let present_m = outside_m(&self.present);
        if let Some((next, _)) = &self.next {
            let has_turned = outside_m(next) >= present_m;
            let (left, _) = self.next.take_if(|_| has_turned)?;
            self.failed.insert(left.clone(), now + TURN_PAUSE);
            return Some(CellMove::GiveUp(left));
        }
        let others = self
            .cells
            .iter()
            .filter(|cell| cell.name != self.present && !self.failed.contains_key(&cell.name));
        let nearest = others
            .map(|cell| (cell.outside_m(place), &cell.name))
            .min_by(|a, b| a.0.total_cmp(&b.0))?;
        let nearest_m = nearest.0;
        let name = nearest.1.clone();
        if nearest_m > 0.0 || nearest_m + MARGIN_M >= present_m {
            return None;
        }
        self.next = Some((name.clone(), now));
        Some(CellMove::Join(name))
    }

    /// Records that the vehicle follows a leader in the next cell; returns true if this becomes its
    /// cell.
    pub fn enter(&mut self, cell: &NodeName) -> bool {
        let Some((next, _)) = self.next.take_if(|(next, _)| next == cell) else {
            return false;
        };
        self.present = next;
        true
    }

    /// Records that a cell could not be joined: it is not tried again for [`RETRY_AFTER`].
    pub fn fail(&mut self, cell: &NodeName, now: Timestamp) {
        self.next.take_if(|(next, _)| next == cell);
        self.failed.insert(cell.clone(), now + RETRY_AFTER);
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const LATITUDE_DEG: f64 = 52.2;
    const LONGITUDE_DEG: f64 = 21.0;
    /// Distance between the middles of two cells in metres.
    const SPACING_M: f64 = 300.0;

    fn name(number: usize) -> NodeName {
        NodeName::new(format!("lot-{number}")).unwrap()
    }

    fn middle() -> GeographicOrigin {
        GeographicOrigin {
            latitude_deg: LATITUDE_DEG,
            longitude_deg: LONGITUDE_DEG,
            height_m: 0.0,
            rotation_deg: 0.0,
        }
    }

    /// A place on a road through the middles of all cells.
    fn at(x_m: f64, y_m: f64) -> GeographicPosition {
        middle().to_wgs84(x_m, y_m, 0.0)
    }

    /// Three cells in a row, each with a radius of 200 m.
    fn cells() -> Vec<KnownCell> {
        let cell = |number| {
            let GeographicPosition {
                latitude_deg,
                longitude_deg,
                ..
            } = at(SPACING_M * number as f64, 0.0);
            let origin = GeographicOrigin {
                latitude_deg,
                longitude_deg,
                ..middle()
            };
            KnownCell {
                name: name(number),
                origin,
                radius_m: 200.0,
            }
        };
        (0..3).map(cell).collect()
    }

    fn s(seconds: f64) -> Timestamp {
        Timestamp::default() + Duration::from_secs_f64(seconds)
    }

    /// Drives at 50 km/h; each cell follows 2 s after it is joined. Returns the places and cells of
    /// all changes.
    fn drive(path: impl Fn(f64) -> (f64, f64), seconds: f64) -> Vec<(f64, NodeName)> {
        let mut choice = CellChoice::new(cells(), name(0));
        let mut changes = Vec::new();
        let mut joined = None;
        for tick in 0..(10.0 * seconds) as usize {
            let now_s = 0.1 * tick as f64;
            let (x_m, y_m) = path(now_s);
            match choice.observe(Some(&at(x_m, y_m)), s(now_s)) {
                Some(CellMove::Join(cell)) => joined = Some((cell, now_s + 2.0)),
                Some(CellMove::GiveUp(_)) => joined = None,
                None => {}
            }
            if let Some((cell, _)) = joined.take_if(|(_, ready_s)| *ready_s <= now_s) {
                assert!(choice.enter(&cell));
                changes.push((x_m, cell));
            }
        }
        changes
    }

    #[test]
    fn vehicle_changes_once_per_border() {
        let changes = drive(|s| (13.9 * s, 5.0), 43.0);
        let cells: Vec<_> = changes.iter().map(|(_, cell)| cell.clone()).collect();
        assert_eq!(cells, [name(1), name(2)]);
        for ((x_m, _), border_m) in changes.iter().zip([150.0, 450.0]) {
            // Half the margin, and 2 s of driving.
            assert!((10.0..45.0).contains(&(x_m - border_m)), "{changes:?}");
        }
    }

    #[test]
    fn border_jumps_change_no_cell() {
        let jumping = |s: f64| (150.0 + 9.0 * (s * 7.3).sin(), 9.0 * (s * 3.1).cos());
        assert_eq!(drive(jumping, 3600.0), []);
    }

    #[test]
    fn turning_back_keeps_cell() {
        assert_eq!(
            drive(
                |s| (
                    if s < 11.7 {
                        13.9 * s
                    } else {
                        13.9 * (23.4 - s)
                    },
                    0.0
                ),
                20.0
            ),
            []
        );
        assert_eq!(drive(|s| (0.0, 13.9 * s), 60.0), []);
    }

    #[test]
    fn silent_cell_is_retried_later() {
        let mut choice = CellChoice::new(cells(), name(0));
        let place = at(SPACING_M, 0.0);
        assert_eq!(
            choice.observe(Some(&place), s(0.0)),
            Some(CellMove::Join(name(1)))
        );
        assert_eq!(choice.observe(Some(&place), s(14.0)), None);
        assert_eq!(
            choice.observe(None, s(15.5)),
            Some(CellMove::GiveUp(name(1))),
            "also without a position"
        );
        assert_eq!(choice.present(), &name(0));
        assert_eq!(
            choice.observe(Some(&place), s(40.0)),
            None,
            "it is unchanged"
        );
        assert_eq!(
            choice.observe(Some(&place), s(46.0)),
            Some(CellMove::Join(name(1)))
        );
        assert!(!choice.enter(&name(2)), "only the next cell is entered");
        choice.fail(&name(1), s(47.0));
        assert!(!choice.enter(&name(1)));
    }

    #[test]
    fn oscillating_vehicle_joins_rarely() {
        let mut choice = CellChoice::new(cells(), name(0));
        let places = [at(SPACING_M, 0.0), at(0.0, 0.0)];
        let moves = (0..100)
            .filter_map(|tick| choice.observe(Some(&places[tick % 2]), s(0.2 * tick as f64)));
        let joins = moves
            .filter(|step| matches!(step, CellMove::Join(_)))
            .count();
        assert!((2..=4).contains(&joins), "{joins} in 20 s");
    }

    #[test]
    fn height_does_not_block_change() {
        let mut choice = CellChoice::new(cells(), name(0));
        let place = GeographicPosition {
            height_m: 1500.0,
            ..at(SPACING_M, 0.0)
        };
        assert_eq!(
            choice.observe(Some(&place), s(0.0)),
            Some(CellMove::Join(name(1)))
        );
    }

    #[test]
    fn antipode_is_far_away() {
        let mut choice = CellChoice::new(cells(), name(2));
        let place = GeographicPosition {
            latitude_deg: -52.2,
            longitude_deg: -159.0,
            height_m: 0.0,
        };
        assert_eq!(choice.observe(Some(&place), s(0.0)), None);
    }

    proptest! {
        #[test]
        fn one_cell_is_joined_at_once(places in prop::collection::vec((-400.0..1000.0, -300.0..300.0, 0.0..20.0), 1..60)) {
            let mut choice = CellChoice::new(cells(), name(0));
            let mut now_s = 0.0;
            let mut joined = None;
            for (x_m, y_m, passed_s) in places {
                now_s += passed_s;
                match choice.observe(Some(&at(x_m, y_m)), s(now_s)) {
                    Some(CellMove::Join(cell)) => {
                        prop_assert!(joined.is_none() && cell != *choice.present());
                        joined = Some(cell);
                    }
                    Some(CellMove::GiveUp(cell)) => prop_assert_eq!(joined.take(), Some(cell)),
                    None => {}
                }
                if let Some(cell) = joined.take_if(|_| passed_s < 5.0) {
                    prop_assert!(choice.enter(&cell) && *choice.present() == cell);
                }
            }
        }
    }
}
