//! Places at which the cell itself has recently detected an object.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use ecod_client::{NodeName, ObjectReport};

use crate::cpm;

/// Time after a detection for which an object counts as detected by the cell itself.
const SIGHTED_FOR: Duration = Duration::from_secs(2);

/// Distance in metres from a detection within which an object counts as the detected one, at any
/// speed and with any error of pose.
const SIGHTED_M: f64 = 5.0;

/// Time after another station's last report in which the cell may still have its objects.
const FOREIGN_FOR: Duration = Duration::from_secs(10);

/// Detections of the cell's own vehicles, and whether other stations' objects are reported at the
/// same time. A map does not state which part of a node has reported an object.
#[derive(Debug, Default)]
pub(super) struct Sightings {
    own: BTreeMap<NodeName, (Instant, Vec<[f64; 2]>)>,
    foreign: Option<Instant>,
}

impl Sightings {
    /// Processes a report for the map.
    pub(super) fn observe(&mut self, report: &ObjectReport, now: Instant) {
        self.own
            .retain(|_, (at, _)| now.duration_since(*at) < SIGHTED_FOR);
        if cpm::is_received(&report.node) {
            self.foreign = Some(now);
            return;
        }
        let objects = report.objects.iter().map(|object| [object.x_m, object.y_m]);
        // A vehicle that states its pose is an object itself.
        let places = objects
            .chain(report.pose.map(|pose| [pose.x_m, pose.y_m]))
            .collect();
        self.own.insert(report.node.clone(), (now, places));
    }

    /// False for a place at which only other stations can have detected an object.
    pub(super) fn is_sighted(&self, [x_m, y_m]: [f64; 2], now: Instant) -> bool {
        let is_alone = self
            .foreign
            .is_none_or(|at| now.duration_since(at) >= FOREIGN_FOR);
        let mut recent = self
            .own
            .values()
            .filter(|(at, _)| now.duration_since(*at) < SIGHTED_FOR);
        is_alone
            || recent.any(|(_, places)| {
                places
                    .iter()
                    .any(|[own_x, own_y]| (own_x - x_m).hypot(own_y - y_m) < SIGHTED_M)
            })
    }
}

#[cfg(test)]
mod tests {
    use ecod_client::{PerceivedObject, Timestamp, WirePose};

    use super::*;

    #[test]
    fn object_is_local_while_detected() {
        let report = |node: &'static str, x_m: f64| ObjectReport {
            objects: vec![PerceivedObject::new("car", 0.9, x_m, 0.0)],
            ..ObjectReport::new(
                NodeName::from_static(node),
                1,
                Timestamp(1_795_239_882_123_000),
            )
        };
        let start = Instant::now();
        let mut sightings = Sightings::default();
        let after = |seconds: u64| start + Duration::from_secs(seconds);
        assert!(
            sightings.is_sighted([50.0, 0.0], start),
            "no other station is heard"
        );
        sightings.observe(&report("edge--cpm-4711", 50.0), start);
        let pose = Some(WirePose::new(20.0, 0.0, 0.0));
        sightings.observe(
            &ObjectReport {
                pose,
                ..report("edge--front", 10.0)
            },
            start,
        );
        let own = |sightings: &Sightings, seconds| {
            [10.0, 14.0, 20.0, 50.0].map(|x| sightings.is_sighted([x, 0.0], after(seconds)))
        };
        assert_eq!(own(&sightings, 1), [true, true, true, false]);
        assert_eq!(own(&sightings, 3), [false; 4], "the cell has lost both");
        assert_eq!(
            own(&sightings, 11),
            [true; 4],
            "the other station is silent, and its objects are gone"
        );
    }
}
