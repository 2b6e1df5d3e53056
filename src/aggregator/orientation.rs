//! Mistaken conventions: a heading by compass or in another unit, a turned or mirrored frame.
//!
//! An observer with a mistaken heading reports objects that coincide with the objects of others
//! after a turn about its own position. Once a second, a report is compared with the reports of
//! other vehicles that were captured at nearly the same time. Ten comparisons are a window. If few
//! objects of the window coincide as reported, the angle of a turn or a mirror about the observer's
//! position is found by a Hough transform over all pairs of objects (Ballard, "Generalizing the
//! Hough transform to detect arbitrary shapes", 1981), and mistakes without a free angle are tried
//! after it.
//!
//! Streets and rows of parked cars look alike after half a turn or a mirror, so that observers with
//! separate views might coincide by chance. A change therefore counts only if no other change, and
//! no shift of the same change, explains half as many objects, and if three windows agree. Reports
//! with few objects have windows of their own, three times as long, in which the objects must move
//! in two dimensions: straight paths look alike, too.
//!
//! Two other vehicles must have reported explained objects, or a sole other vehicle that stands
//! elsewhere. Against a sole vehicle, a change of the frame needs six windows and explains either
//! of the two as well as the other. The trouble names the vehicles, because reports of one vehicle
//! must not put the blame on another alone.

mod comparison;
mod isometry;
mod misreading;
#[cfg(test)]
mod tests;

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use comparison::{ComparedReport, WindowComparison, WindowOutcome, Witnesses};
use misreading::PlacedReport;

pub use misreading::{MisreadObserver, Misreading, MistakenHeading};

use crate::model::names::{NodeName, vehicle_of};
use crate::model::time::Timestamp;
use crate::wire::ObjectReport;

/// Time between two comparisons of an observer.
const INTERVAL: Duration = Duration::from_secs(1);

/// Maximum number of other vehicles in a comparison, and of parts of each.
const MAX_OTHERS: usize = 16;
const MAX_PARTS_COMPARED: usize = 4;

/// Maximum time between the captures of two reports that are compared.
const SIMULTANEOUS: Duration = Duration::from_millis(200);

/// Minimum time between the judgements of two windows, which cost some milliseconds each. Until
/// then, a complete window moves on with new reports.
const JUDGEMENT_INTERVAL: Duration = Duration::from_millis(100);

/// Number of windows that must agree; for a change of the frame with a sole other vehicle.
const MIN_WINDOWS: u32 = 3;
const MIN_WINDOWS_OF_FRAME: u32 = 6;

/// Time after which a mistake that no further window shows is over.
const MISTAKE_MEMORY: Duration = Duration::from_secs(180);

/// Maximum number of observers that are compared, and the time after which a silent observer makes
/// room.
const MAX_OBSERVERS: usize = 256;
const OBSERVER_TIMEOUT: Duration = Duration::from_secs(10);

/// Compares the observers of a cell with each other.
#[derive(Debug, Clone, Default)]
pub(super) struct OrientationCheck {
    observers: BTreeMap<NodeName, ComparedObserver>,
    judged_at: Timestamp,
}

/// The latest report of an observer or of a part of a vehicle, and its comparison with others.
#[derive(Debug, Clone)]
struct ComparedObserver {
    latest: Arc<ObjectReport>,
    captured_at: Timestamp,
    compared_at: Timestamp,
    /// The window of reports with many objects, and of reports with few.
    many: WindowComparison,
    few: WindowComparison,
    suspected: Option<SuspectedMistake>,
}

/// A mistake that windows show.
#[derive(Debug, Clone)]
struct SuspectedMistake {
    found: MisreadObserver,
    windows: u32,
    shown_at: Timestamp,
}

impl OrientationCheck {
    /// Adds an admitted report, captured at `captured_at` on the aggregator's clock.
    pub(super) fn observe(&mut self, report: &Arc<ObjectReport>, captured_at: Timestamp) {
        if let Some(observer) = self.observers.get_mut(&report.node) {
            observer.latest = Arc::clone(report);
            observer.captured_at = captured_at;
            if captured_at.since(observer.compared_at) >= INTERVAL {
                observer.compared_at = captured_at;
                self.compare(report, captured_at);
            }
        } else if self.has_room(captured_at) {
            let observer = ComparedObserver {
                latest: Arc::clone(report),
                captured_at,
                compared_at: captured_at,
                many: WindowComparison::of_many(),
                few: WindowComparison::of_few(),
                suspected: None,
            };
            self.observers.insert(report.node.clone(), observer);
        }
    }

    /// The mistake that explains the reports of an observer, if there is one.
    pub(super) fn misreading(&self, node: &NodeName, now: Timestamp) -> Option<&MisreadObserver> {
        let suspected = self.observers.get(node)?.suspected.as_ref()?;
        let MisreadObserver {
            misreading,
            witnesses,
        } = &suspected.found;
        let min_windows = if misreading.is_of_frame() && witnesses.len() == 1 {
            MIN_WINDOWS_OF_FRAME
        } else {
            MIN_WINDOWS
        };
        let is_present = now.since(suspected.shown_at) < MISTAKE_MEMORY;
        (suspected.windows >= min_windows && is_present).then_some(&suspected.found)
    }

    fn has_room(&mut self, now: Timestamp) -> bool {
        if self.observers.len() >= MAX_OBSERVERS {
            self.observers
                .retain(|_, observer| now.since(observer.captured_at) < OBSERVER_TIMEOUT);
        }
        self.observers.len() < MAX_OBSERVERS
    }

    /// Compares a report with the simultaneous reports of the nearest other vehicles.
    fn compare(&mut self, report: &ObjectReport, at: Timestamp) {
        let vehicle = vehicle_of(report.node.as_str());
        let distance_m = |other: &ObjectReport| {
            let poses = report.pose.zip(other.pose);
            poses.map_or(f64::INFINITY, |(own, other)| {
                (own.x_m - other.x_m).hypot(own.y_m - other.y_m)
            })
        };
        let mut simultaneous: Vec<(f64, &ObjectReport)> = self
            .observers
            .iter()
            .filter(|(name, other)| {
                let apart_us = other.captured_at.micros_from(at).unsigned_abs();
                apart_us <= SIMULTANEOUS.as_micros() as u64 && vehicle_of(name.as_str()) != vehicle
            })
            .map(|(_, other)| &*other.latest)
            .filter(|other| !other.objects.is_empty())
            .map(|other| (distance_m(other), other))
            .collect();
        simultaneous.sort_by(|one, other| one.0.total_cmp(&other.0));
        let witnesses = witnesses(simultaneous.into_iter().map(|(_, other)| other));
        let is_due = at.since(self.judged_at) >= JUDGEMENT_INTERVAL;
        let Some(observer) = self
            .observers
            .get_mut(&report.node)
            .filter(|_| !witnesses.reports.is_empty())
        else {
            return;
        };
        let Some(compared) = ComparedReport::of(&PlacedReport::of(report), &witnesses) else {
            return;
        };
        let window = if compared.has_many() {
            &mut observer.many
        } else {
            &mut observer.few
        };
        window.add(compared);
        if is_due && window.is_complete() {
            self.judged_at = at;
            match window.take_outcome() {
                WindowOutcome::Agrees => observer.suspected = None,
                WindowOutcome::Mistaken(found) => observer.suspect(found, at),
                WindowOutcome::Open => {}
            }
        }
    }
}

/// The first reports of the first vehicles. A vehicle is one witness, however many parts it has.
fn witnesses<'a>(reports: impl Iterator<Item = &'a ObjectReport>) -> Witnesses {
    let mut witnesses = Witnesses::default();
    let mut parts = [0; MAX_OTHERS];
    for report in reports {
        let vehicle = vehicle_of(report.node.as_str());
        let mut known = witnesses.vehicles.iter();
        let number = match known.position(|name| name.as_str() == vehicle) {
            Some(number) => number,
            None if witnesses.vehicles.len() == MAX_OTHERS => continue,
            None => {
                witnesses.vehicles.push(report.node.vehicle());
                witnesses.vehicles.len() - 1
            }
        };
        parts[number] += 1;
        if parts[number] <= MAX_PARTS_COMPARED {
            witnesses.reports.push(PlacedReport {
                witness: 1 << number,
                ..PlacedReport::of(report)
            });
        }
    }
    witnesses
}

impl ComparedObserver {
    /// Counts a window that shows a mistake; another mistake starts anew, and so do other
    /// witnesses. Only witnesses of all windows remain.
    fn suspect(&mut self, mut found: MisreadObserver, at: Timestamp) {
        let mut windows = 1;
        if let Some(known) = self.suspected.take()
            && known.found.misreading.is_like(&found.misreading)
            && at.since(known.shown_at) < MISTAKE_MEMORY
            && !known.found.witnesses.is_disjoint(&found.witnesses)
        {
            windows = known.windows.saturating_add(1);
            let earlier = &known.found.witnesses;
            found.witnesses.retain(|vehicle| earlier.contains(vehicle));
        }
        self.suspected = Some(SuspectedMistake {
            found,
            windows,
            shown_at: at,
        });
    }
}
