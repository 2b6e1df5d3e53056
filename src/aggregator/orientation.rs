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
//! no shift of the same change, explains half as many objects, and if three windows agree. Two
//! other vehicles must have reported explained objects; a sole other vehicle with objects there
//! suffices if the change is about the observer's own position.

mod comparison;
mod isometry;
mod misreading;
#[cfg(test)]
mod tests;

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use comparison::{WindowComparison, WindowOutcome};
use misreading::PlacedReport;

pub use misreading::{Misreading, MistakenHeading};

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

/// Number of windows that must agree.
const MIN_WINDOWS: u32 = 3;

/// Time after which a mistake that no further window shows is over.
const MISTAKE_MEMORY: Duration = Duration::from_secs(60);

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
    comparison: WindowComparison,
    suspected: Option<SuspectedMistake>,
}

/// A mistake that windows show.
#[derive(Debug, Clone)]
struct SuspectedMistake {
    misreading: Misreading,
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
                comparison: WindowComparison::default(),
                suspected: None,
            };
            self.observers.insert(report.node.clone(), observer);
        }
    }

    /// The mistake that explains the reports of an observer, if there is one.
    pub(super) fn misreading(&self, node: &NodeName, now: Timestamp) -> Option<&Misreading> {
        let suspected = self.observers.get(node)?.suspected.as_ref()?;
        let is_present = now.since(suspected.shown_at) < MISTAKE_MEMORY;
        (suspected.windows >= MIN_WINDOWS && is_present).then_some(&suspected.misreading)
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
        let others = witnesses(simultaneous.into_iter().map(|(_, other)| other));
        let is_due = at.since(self.judged_at) >= JUDGEMENT_INTERVAL;
        let Some(observer) = self
            .observers
            .get_mut(&report.node)
            .filter(|_| !others.is_empty())
        else {
            return;
        };
        observer.comparison.add(&PlacedReport::of(report), &others);
        if is_due && observer.comparison.is_complete() {
            self.judged_at = at;
            match observer.comparison.take_outcome() {
                WindowOutcome::Agrees => observer.suspected = None,
                WindowOutcome::Mistaken(misreading) => observer.suspect(misreading, at),
                WindowOutcome::Open => {}
            }
        }
    }
}

/// The first reports of the first vehicles. A vehicle is one witness, however many parts it has.
fn witnesses<'a>(reports: impl Iterator<Item = &'a ObjectReport>) -> Vec<PlacedReport> {
    let mut vehicles: Vec<(&str, usize)> = Vec::new();
    let mut placed = Vec::new();
    for report in reports {
        let vehicle = vehicle_of(report.node.as_str());
        let known = vehicles.iter().position(|(name, _)| *name == vehicle);
        let number = match known {
            Some(number) => number,
            None if vehicles.len() == MAX_OTHERS => continue,
            None => {
                vehicles.push((vehicle, 0));
                vehicles.len() - 1
            }
        };
        let parts = &mut vehicles[number].1;
        *parts += 1;
        if *parts <= MAX_PARTS_COMPARED {
            placed.push(PlacedReport {
                witness: 1 << number,
                ..PlacedReport::of(report)
            });
        }
    }
    placed
}

impl ComparedObserver {
    /// Counts a window that shows a mistake; another mistake starts anew.
    fn suspect(&mut self, misreading: Misreading, at: Timestamp) {
        let windows = match &self.suspected {
            Some(known)
                if known.misreading.is_like(&misreading)
                    && at.since(known.shown_at) < MISTAKE_MEMORY =>
            {
                known.windows.saturating_add(1)
            }
            _ => 1,
        };
        self.suspected = Some(SuspectedMistake {
            misreading,
            windows,
            shown_at: at,
        });
    }
}
