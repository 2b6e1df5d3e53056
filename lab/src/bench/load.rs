//! Reports and votes of the vehicles of a measurement.

use std::time::Duration;

use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ecod::perception::landmark::LandmarkConfig;
use ecod::wire::{ObjectReport, PerceivedObject};

/// A number of vehicles that all report once in a period.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Load {
    /// Simulated vehicles, at least 1.
    pub vehicles: usize,
    /// Time from one report of a vehicle to its next.
    pub period: Duration,
    /// Time from the first vehicle's report to the last one's, evenly spaced; less than half a
    /// period.
    pub spread: Duration,
    /// Time for which reports are sent; the first tenth warms up and is not counted.
    pub duration: Duration,
    /// True to measure the bare way too.
    pub bare: bool,
    /// Whether vehicles also vote, with a second report before the one for the map.
    pub votes: bool,
}

impl Load {
    /// Reports and votes of this many vehicles ten times a second, all at once, and the bare path.
    pub fn new(vehicles: usize, duration: Duration) -> Self {
        Self {
            vehicles,
            period: Duration::from_millis(100),
            spread: Duration::ZERO,
            duration,
            bare: true,
            votes: true,
        }
    }

    /// Number of reports of every vehicle, at least two.
    pub(super) fn ticks(&self) -> u32 {
        u32::try_from(self.duration.as_micros() / self.period.as_micros().max(1))
            .unwrap_or(u32::MAX)
            .max(2)
    }

    /// Ticks that are not counted.
    pub(super) fn warm_up(&self) -> u32 {
        self.ticks().div_ceil(10)
    }
}

/// Objects in a report.
const OBJECTS: usize = 10;

/// A lot of 32 spots, for a cell of the benchmark's own.
pub fn landmarks() -> Vec<LandmarkConfig> {
    (0..32)
        .map(|index| LandmarkConfig::at(format!("slot-{index}"), 3.0 * f64::from(index), 0.0))
        .collect()
}

/// Report of one vehicle on ten neighbouring locations: an object at each, all in view. In a cell
/// without locations, the objects are at the places of [`landmarks`].
pub(super) fn report(vehicle: usize, landmarks: &[LandmarkConfig]) -> ObjectReport {
    let spots = spots(vehicle, landmarks);
    let object = |spot: &LandmarkConfig| PerceivedObject {
        covariance_m2: Some([0.01, 0.0012, 0.0104]),
        ..PerceivedObject::new("ABCD123", 0.931, spot.x_m + 0.1037, spot.y_m - 0.0512)
    };
    ObjectReport {
        objects: spots.iter().map(object).collect(),
        seen: (!landmarks.is_empty()).then(|| spots.iter().map(|spot| spot.id.clone()).collect()),
        ..ObjectReport::new(name(vehicle), 0, Timestamp(0))
    }
}

/// The report in the form of votes.
pub(super) fn vote(vehicle: usize, landmarks: &[LandmarkConfig]) -> ObjectReport {
    let mut vote = report(vehicle, landmarks);
    for (object, spot) in vote.objects.iter_mut().zip(spots(vehicle, landmarks)) {
        object.landmark = Some(spot.id);
    }
    ObjectReport { seen: None, ..vote }
}

fn spots(vehicle: usize, known: &[LandmarkConfig]) -> Vec<LandmarkConfig> {
    let lot = if known.is_empty() {
        landmarks()
    } else {
        known.to_vec()
    };
    lot.iter()
        .cycle()
        .skip(vehicle % lot.len())
        .take(OBJECTS.min(lot.len()))
        .cloned()
        .collect()
}

/// The vehicle's name.
///
/// # Panics
/// Does not panic: a number is a valid name.
#[expect(clippy::expect_used, reason = "letters, a dash and digits are a name")]
fn name(vehicle: usize) -> NodeName {
    NodeName::new(format!("cav-{vehicle}")).expect("a number makes a name")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn neighbours_share_spots_but_one() {
        let lot = landmarks();
        let spots = |vehicle| report(vehicle, &lot).seen.unwrap_or_default();
        assert_eq!(spots(30).len(), OBJECTS);
        assert_eq!(spots(30)[1..], spots(31)[..OBJECTS - 1]);
    }

    #[test]
    fn votes_name_reported_spots() {
        let vote = vote(3, &landmarks());
        assert_eq!(vote.objects[0].landmark.as_deref(), Some("slot-3"));
        let at = |report: &ObjectReport| {
            report
                .objects
                .iter()
                .map(|object| object.x_m)
                .collect::<Vec<_>>()
        };
        assert_eq!(at(&vote), at(&report(3, &landmarks())));
    }

    #[test]
    fn cell_without_landmarks_has_objects() {
        let report = report(5, &[]);
        assert_eq!((report.objects.len(), report.seen), (OBJECTS, None));
        assert!(
            vote(5, &[])
                .objects
                .iter()
                .all(|object| object.landmark.is_some())
        );
    }

    #[test]
    fn a_tenth_warms_up() {
        let load = Load::new(4, Duration::from_secs(5));
        assert_eq!((load.ticks(), load.warm_up()), (50, 5));
    }
}
