//! The comparison of one observer with others over a window of reports.

use std::collections::{BTreeMap, BTreeSet};
use std::f64::consts::TAU;

use nalgebra::{Matrix2, Point2, Vector2};

use super::misreading::{MisreadObserver, Misreading, PlacedReport};
use crate::model::geometry::{Pose, wrap_angle};
use crate::model::names::NodeName;

/// Number of reports in a window, if they have many objects and if they have few.
const WINDOW_OF_MANY: usize = 10;
const WINDOW_OF_FEW: usize = 30;

/// Number of objects from which a report has many; most reports of such a window have as many
/// explained objects.
const MANY_OBJECTS: usize = 4;

/// Minimum number of distinct places of the explained objects in a window of reports with few
/// objects: the objects move.
const MIN_PLACES: usize = 6;

/// Minimum number of explained objects that another vehicle must have reported to be a witness;
/// all of them if there are fewer.
const MIN_OF_WITNESS: usize = 2;

/// Maximum number of compared objects of a report, and of other observers' objects.
const MAX_OBJECTS: usize = 16;
const MAX_REFERENCES: usize = 64;

/// Distance at which two objects coincide, as a share of the median distance of the objects from
/// the observer, and its maximum in metres.
const GATE: f64 = 0.07;
const MAX_GATE_M: f64 = 2.0;

/// The same distance for objects as reported, in gates: doubts are in favour of the observer.
const PRESENT_GATES: f64 = 1.5;

/// Share of objects that coincide as reported above which an observer agrees with others, and above
/// which a report is not compared further.
const AGREEING: f64 = 0.6;
const CERTAINLY_AGREEING: f64 = 0.8;

/// Minimum share of the objects that a mistake must explain, also where reports have few objects.
const MIN_EXPLAINED: f64 = 0.5;
const MIN_EXPLAINED_OF_FEW: f64 = 0.7;

/// Maximum share, of the explained objects, that a rival may explain, and that coincide as reported:
/// objects near the axis of a mirror stay in place.
const MAX_RIVAL: f64 = 0.5;
const MAX_UNCHANGED: f64 = 0.7;

/// Ratio of explained objects above which a mistake of all explains clearly more.
const SHARED_MARGIN: f64 = 1.1;

/// Mean distance, in gates, from which another change counts as a rival.
const RIVAL_GATES: f64 = 2.0;

/// Distances of shifts, in gates: up to the spacing of queued cars.
const SHIFT_GATES: [f64; 5] = [2.0, 3.0, 4.0, 5.0, 6.0];

/// Minimum root mean square distance of explained objects from their centre, in gates: in a report
/// with many objects, and in a whole window of reports with few.
const MIN_SPREAD_GATES: f64 = 3.0;
const MIN_SPREAD_OF_FEW_GATES: f64 = 2.0;

/// Minimum root mean square distance of few moving objects from the line of their path, in gates:
/// all straight paths look alike.
const MIN_ACROSS_GATES: f64 = 1.0;

/// Minimum distance, in gates, from the only other vehicle for a change about the own position.
const MIN_APART_GATES: f64 = 10.0;

/// Change of the heading in radians that ends a window.
const MAX_HEADING_CHANGE_RAD: f64 = 0.09;

/// Number of bins of angles.
const BINS: usize = 180;

/// The positions as reported.
const NO_CHANGE: Misreading = Misreading::FrameTurn { angle_rad: 0.0 };

/// Reports of an observer beside simultaneous reports of others, all with many objects or all with
/// few.
#[derive(Debug, Clone)]
pub(super) struct WindowComparison {
    snapshots: Vec<ComparedReport>,
    length: usize,
}

/// Result of a window.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum WindowOutcome {
    /// The objects coincide with the objects of others.
    Agrees,
    /// The objects coincide after a change.
    Mistaken(MisreadObserver),
    /// Undecided, as for views that do not overlap.
    Open,
}

/// A change, and the number of objects that coincide after it.
struct Explanation {
    misreading: Misreading,
    explained: usize,
}

/// One report beside the reports of others.
#[derive(Debug, Clone)]
pub(super) struct ComparedReport {
    pose: Option<Pose>,
    objects: Vec<Point2<f64>>,
    /// The other vehicles by the bits of [`Reference::witnesses`].
    vehicles: Vec<NodeName>,
    /// Objects of others; empty if the report certainly agrees with them.
    references: Vec<Reference>,
    gate_m: f64,
    /// Number of objects that nearly coincide as reported.
    agreeing: usize,
}

/// An object of another observer.
#[derive(Debug, Clone, Copy)]
struct Reference {
    position: Point2<f64>,
    observer: Option<Pose>,
    /// A bit for each other vehicle that reported it.
    witnesses: u32,
}

impl WindowComparison {
    /// A window of reports with many objects.
    pub(super) fn of_many() -> Self {
        Self::with_length(WINDOW_OF_MANY)
    }

    /// A window of reports with few objects.
    pub(super) fn of_few() -> Self {
        Self::with_length(WINDOW_OF_FEW)
    }

    fn with_length(length: usize) -> Self {
        Self {
            snapshots: Vec::new(),
            length,
        }
    }

    /// Adds a compared report.
    pub(super) fn add(&mut self, snapshot: ComparedReport) {
        let turned_rad = |first: &ComparedReport| {
            let heading_rad = first.pose?.heading_rad;
            Some(wrap_angle(snapshot.pose?.heading_rad - heading_rad).abs())
        };
        if self.snapshots.first().and_then(turned_rad) > Some(MAX_HEADING_CHANGE_RAD) {
            self.snapshots.clear();
        }
        if self.is_complete() {
            self.snapshots.remove(0);
        }
        self.snapshots.push(snapshot);
    }

    /// True if the window can be judged.
    pub(super) fn is_complete(&self) -> bool {
        self.snapshots.len() == self.length
    }

    /// Judges the window and begins the next one.
    pub(super) fn take_outcome(&mut self) -> WindowOutcome {
        let outcome = self.outcome();
        self.snapshots.clear();
        outcome
    }

    fn outcome(&self) -> WindowOutcome {
        let total: usize = self.snapshots.iter().map(|it| it.objects.len()).sum();
        let agreeing: usize = self.snapshots.iter().map(|it| it.agreeing).sum();
        if agreeing as f64 > AGREEING * total as f64 {
            return WindowOutcome::Agrees;
        }
        let angles = AngleVotes::of(&self.snapshots);
        match self.best(&angles) {
            Some(Explanation {
                misreading,
                explained,
            }) if explained as f64 >= self.min_explained() * total as f64
                && self.unchanged() as f64 <= MAX_UNCHANGED * explained as f64
                && self.apart_gates(&misreading, &NO_CHANGE) > RIVAL_GATES
                && self.is_spread(&misreading)
                && !self.has_rival(&misreading, explained, &angles) =>
            {
                match self.witnesses(&misreading) {
                    Some(witnesses) => WindowOutcome::Mistaken(MisreadObserver {
                        misreading,
                        witnesses,
                    }),
                    None => WindowOutcome::Open,
                }
            }
            _ => WindowOutcome::Open,
        }
    }

    /// The change that explains most objects.
    fn best(&self, angles: &AngleVotes) -> Option<Explanation> {
        let mut best: Option<Explanation> = None;
        for misreading in angles.peaks().chain(Misreading::without_angle()) {
            let found = Explanation {
                misreading,
                explained: self.explained(&misreading, None),
            };
            let is_better = best
                .as_ref()
                .is_none_or(|known| self.is_better(&found, known));
            if is_better {
                best = Some(found);
            }
        }
        best
    }

    /// True if the change explains more objects. A mistake of all must explain clearly more than a
    /// mistake of the observer alone, or as many by more vehicles: where it leaves the headings of
    /// the others as they are, both explain the same.
    fn is_better(&self, found: &Explanation, known: &Explanation) -> bool {
        if !found.misreading.is_shared() || known.misreading.is_shared() {
            return found.explained > known.explained;
        }
        let witnesses = |it: &Explanation| {
            let names = self.witnesses(&it.misreading);
            names.map_or(0, |names| names.len())
        };
        let explained = found.explained as f64;
        let most = known.explained as f64;
        explained > SHARED_MARGIN * most
            || SHARED_MARGIN * explained >= most && witnesses(found) > witnesses(known)
    }

    fn has_many(&self) -> bool {
        self.length == WINDOW_OF_MANY
    }

    fn min_explained(&self) -> f64 {
        if self.has_many() {
            MIN_EXPLAINED
        } else {
            MIN_EXPLAINED_OF_FEW
        }
    }

    /// Number of objects that coincide after the change and a shift in gates.
    fn explained(&self, misreading: &Misreading, shift: Option<Vector2<f64>>) -> usize {
        self.snapshots
            .iter()
            .map(|snapshot| snapshot.coinciding(misreading, shift).count())
            .sum()
    }

    /// Number of objects that coincide as reported.
    fn unchanged(&self) -> usize {
        self.explained(&NO_CHANGE, None)
    }

    /// True if most reports have enough explained objects that are far apart, or if few objects
    /// move in two dimensions.
    fn is_spread(&self, misreading: &Misreading) -> bool {
        if !self.has_many() {
            return self.moves_in_plane(misreading);
        }
        let spread = self.snapshots.iter().filter(|snapshot| {
            let explained: Vec<_> = snapshot.coinciding(misreading, None).collect();
            explained.len() >= MANY_OBJECTS
                && root_mean_square_m(&explained) >= MIN_SPREAD_GATES * snapshot.gate_m
        });
        2 * spread.count() > self.snapshots.len()
    }

    /// True if the explained objects of the window are at enough places, not all on a line.
    fn moves_in_plane(&self, misreading: &Misreading) -> bool {
        let mut images = Vec::new();
        let mut places: Vec<Point2<f64>> = Vec::new();
        let mut gate_m: f64 = 0.0;
        for snapshot in &self.snapshots {
            gate_m = gate_m.max(snapshot.gate_m);
            for image in snapshot.coinciding(misreading, None) {
                images.push(image);
                if !is_near(&image, &places, snapshot.gate_m) {
                    places.push(image);
                }
            }
        }
        places.len() >= MIN_PLACES
            && root_mean_square_m(&images) >= MIN_SPREAD_OF_FEW_GATES * gate_m
            && across_m(&images) >= MIN_ACROSS_GATES * gate_m
    }

    /// The vehicles that witness the change in most of the witnessed reports, if most reports are
    /// witnessed. In a few reports, objects of a vehicle coincide by chance.
    fn witnesses(&self, misreading: &Misreading) -> Option<BTreeSet<NodeName>> {
        let mut reports: BTreeMap<NodeName, usize> = BTreeMap::new();
        let mut witnessed = 0;
        for snapshot in &self.snapshots {
            let vehicles = snapshot.witnesses(misreading);
            witnessed += usize::from(!vehicles.is_empty());
            for vehicle in vehicles {
                *reports.entry(vehicle.clone()).or_default() += 1;
            }
        }
        let witnesses: BTreeSet<NodeName> = reports
            .into_iter()
            .filter(|(_, reports)| 2 * reports > witnessed)
            .map(|(vehicle, _)| vehicle)
            .collect();
        (2 * witnessed > self.snapshots.len() && !witnesses.is_empty()).then_some(witnesses)
    }

    /// True if a different change, or a shift of the same change, explains many of the objects.
    fn has_rival(&self, found: &Misreading, explained: usize, angles: &AngleVotes) -> bool {
        let most = MAX_RIVAL * explained as f64;
        let is_rival = |rival: &Misreading| {
            self.explained(rival, None) as f64 > most
                && self.apart_gates(found, rival) > RIVAL_GATES
        };
        let mut rivals = angles.above(most).chain(Misreading::without_angle());
        rivals.any(|rival| is_rival(&rival))
            || shifts().any(|shift| self.explained(found, Some(shift)) as f64 > most)
    }

    /// Mean distance of the images of the objects under two changes, in gates; 0 if a change
    /// does not apply.
    fn apart_gates(&self, one: &Misreading, other: &Misreading) -> f64 {
        let mut sum = 0.0;
        let mut count = 0.0;
        for snapshot in &self.snapshots {
            let pose = snapshot.pose.as_ref();
            if let (Some(one), Some(other)) = (one.own_change(pose), other.own_change(pose)) {
                for object in &snapshot.objects {
                    sum += (one.apply(object) - other.apply(object)).norm() / snapshot.gate_m;
                    count += 1.0;
                }
            }
        }
        if count > 0.0 { sum / count } else { 0.0 }
    }
}

impl ComparedReport {
    /// Compares a report with simultaneous reports of other vehicles, the nearest first; `None`
    /// without objects.
    pub(super) fn of(own: &PlacedReport, witnesses: &Witnesses) -> Option<Self> {
        let others = &witnesses.reports;
        let centre = own
            .pose
            .map_or_else(|| mean(&own.objects), |pose| pose.position);
        let mut distances: Vec<f64> = own
            .objects
            .iter()
            .map(|object| nalgebra::distance(object, &centre))
            .collect();
        distances.sort_by(f64::total_cmp);
        let median_m = *distances.get(distances.len() / 2)?;
        let gate_m = (GATE * median_m).min(MAX_GATE_M);
        let mut objects: Vec<Point2<f64>> = Vec::new();
        for object in &own.objects {
            if objects.len() < MAX_OBJECTS && !is_near(object, &objects, gate_m) {
                objects.push(*object);
            }
        }
        let agreeing = objects
            .iter()
            .filter(|object| {
                let mut others = others.iter();
                others.any(|other| is_near(object, &other.objects, PRESENT_GATES * gate_m))
            })
            .count();
        let references = if agreeing as f64 > CERTAINLY_AGREEING * objects.len() as f64 {
            Vec::new()
        } else {
            references(others, gate_m / 2.0)
        };
        Some(Self {
            pose: own.pose,
            objects,
            vehicles: witnesses.vehicles.clone(),
            references,
            gate_m,
            agreeing,
        })
    }

    /// True if the report has many objects.
    pub(super) fn has_many(&self) -> bool {
        self.objects.len() >= MANY_OBJECTS
    }

    /// The other vehicles that reported explained objects: two, or a sole vehicle elsewhere if no
    /// further vehicle has objects near the explained ones or near the objects that the observer
    /// reports. Otherwise it is empty.
    fn witnesses(&self, misreading: &Misreading) -> Vec<&NodeName> {
        let images: Vec<_> = self.coinciding(misreading, None).collect();
        let centre = mean(&images);
        let present_m = PRESENT_GATES * self.gate_m;
        let around_m = (2.0 * root_mean_square_m(&images)).max(present_m);
        let mut coinciding = vec![0; self.vehicles.len()];
        let mut concerned: u32 = 0;
        let mut only: Option<Pose> = None;
        for reference in &self.references {
            let change = misreading.change_of_other(reference.observer.as_ref());
            let position = change.map(|change| change.apply(&reference.position));
            let coincides =
                position.is_some_and(|position| is_near(&position, &images, self.gate_m));
            for (number, objects) in coinciding.iter_mut().enumerate() {
                *objects += usize::from(coincides && reference.witnesses >> number & 1 == 1);
            }
            let is_around =
                position.is_some_and(|position| nalgebra::distance(&position, &centre) <= around_m);
            if coincides || is_around || is_near(&reference.position, &self.objects, present_m) {
                concerned |= reference.witnesses;
                only = only.or(reference.observer);
            }
        }
        let least = MIN_OF_WITNESS.min(images.len()).max(1);
        let witnesses: Vec<&NodeName> = self
            .vehicles
            .iter()
            .zip(coinciding)
            .filter(|(_, objects)| *objects >= least)
            .map(|(vehicle, _)| vehicle)
            .collect();
        let stands_elsewhere = only.zip(self.pose).is_some_and(|(only, own)| {
            nalgebra::distance(&only.position, &own.position) >= MIN_APART_GATES * self.gate_m
        });
        let is_sole = concerned.count_ones() == 1 && self.references.len() < MAX_REFERENCES;
        if witnesses.len() >= 2 || is_sole && stands_elsewhere {
            witnesses
        } else {
            Vec::new()
        }
    }

    /// Images of the objects that coincide after the change and a shift in gates.
    fn coinciding(
        &self,
        misreading: &Misreading,
        shift: Option<Vector2<f64>>,
    ) -> impl Iterator<Item = Point2<f64>> {
        let own = misreading.own_change(self.pose.as_ref());
        let references: Vec<Point2<f64>> = self
            .references
            .iter()
            .filter_map(|reference| {
                let change = misreading.change_of_other(reference.observer.as_ref())?;
                Some(change.apply(&reference.position))
            })
            .collect();
        let shift = shift.map_or_else(Vector2::zeros, |gates| gates * self.gate_m);
        let change = own.map(|own| own.shifted(shift));
        let images = self
            .objects
            .iter()
            .filter_map(move |object| Some(change?.apply(object)));
        images.filter(move |image| is_near(image, &references, self.gate_m))
    }
}

/// Simultaneous reports of other vehicles.
#[derive(Debug, Default)]
pub(super) struct Witnesses {
    /// The vehicles by the bits of [`PlacedReport::witness`].
    pub(super) vehicles: Vec<NodeName>,
    pub(super) reports: Vec<PlacedReport>,
}

/// Distinct objects of other vehicles.
fn references(others: &[PlacedReport], same_m: f64) -> Vec<Reference> {
    let mut references: Vec<Reference> = Vec::new();
    for other in others {
        for object in &other.objects {
            let is_same = |known: &&mut Reference| {
                (known.position - object).norm_squared() <= same_m * same_m
            };
            if let Some(known) = references.iter_mut().find(is_same) {
                known.witnesses |= other.witness;
            } else if references.len() < MAX_REFERENCES {
                references.push(Reference {
                    position: *object,
                    observer: other.pose,
                    witnesses: other.witness,
                });
            }
        }
    }
    references
}

/// Shifts in gates, in all directions.
fn shifts() -> impl Iterator<Item = Vector2<f64>> {
    SHIFT_GATES.into_iter().flat_map(|gates| {
        let directions = (TAU * gates).ceil();
        (0..directions as u32).map(move |number| {
            let (sin, cos) = (TAU * f64::from(number) / directions).sin_cos();
            Vector2::new(cos, sin) * gates
        })
    })
}

fn is_near(point: &Point2<f64>, others: &[Point2<f64>], distance_m: f64) -> bool {
    let squared = distance_m * distance_m;
    others
        .iter()
        .any(|other| (other - point).norm_squared() <= squared)
}

fn mean(points: &[Point2<f64>]) -> Point2<f64> {
    let sum: Vector2<f64> = points.iter().map(|point| point.coords).sum();
    Point2::from(sum / points.len().max(1) as f64)
}

fn root_mean_square_m(points: &[Point2<f64>]) -> f64 {
    let centre = mean(points);
    let sum: f64 = points
        .iter()
        .map(|point| (point - centre).norm_squared())
        .sum();
    (sum / points.len().max(1) as f64).sqrt()
}

/// Root mean square distance from the line that fits the points best.
fn across_m(points: &[Point2<f64>]) -> f64 {
    let centre = mean(points);
    let sum: Matrix2<f64> = points
        .iter()
        .map(|point| {
            let offset = point - centre;
            offset * offset.transpose()
        })
        .sum();
    let spread_m2 = sum / points.len().max(1) as f64;
    let eigenvalues = spread_m2.symmetric_eigenvalues();
    eigenvalues.min().max(0.0).sqrt()
}

/// Hough transform: by angle of a turn or a mirror, the number of objects that it moves to an object
/// of another observer.
struct AngleVotes {
    heading_rad: f64,
    turns: [usize; BINS],
    mirrors: [usize; BINS],
}

impl AngleVotes {
    fn of(snapshots: &[ComparedReport]) -> Self {
        let mut votes = Self {
            heading_rad: 0.0,
            turns: [0; BINS],
            mirrors: [0; BINS],
        };
        for snapshot in snapshots {
            votes.add(snapshot);
        }
        votes
    }

    /// Adds a report with a pose. Two objects correspond if their distances from the observer are
    /// nearly equal; an object counts once in each bin.
    fn add(&mut self, snapshot: &ComparedReport) {
        let Some(pose) = snapshot.pose else { return };
        self.heading_rad = pose.heading_rad;
        let references: Vec<(f64, f64)> = snapshot
            .references
            .iter()
            .map(|reference| polar(&pose, &reference.position))
            .collect();
        for object in &snapshot.objects {
            let (range_m, direction_rad) = polar(&pose, object);
            let half_width_rad = (snapshot.gate_m / range_m.max(snapshot.gate_m)).asin();
            let mut is_turn = [false; BINS];
            let mut is_mirror = [false; BINS];
            let alike = references
                .iter()
                .filter(|(other_m, _)| (other_m - range_m).abs() <= snapshot.gate_m);
            for (_, other_rad) in alike {
                mark(&mut is_turn, other_rad - direction_rad, half_width_rad);
                mark(&mut is_mirror, other_rad + direction_rad, half_width_rad);
            }
            for bin in 0..BINS {
                self.turns[bin] += usize::from(is_turn[bin]);
                self.mirrors[bin] += usize::from(is_mirror[bin]);
            }
        }
    }

    /// The turn and the mirror with most votes.
    fn peaks(&self) -> impl Iterator<Item = Misreading> {
        let turn = peak_rad(&self.turns).map(|angle_rad| self.turn(angle_rad));
        let mirror = peak_rad(&self.mirrors).map(|angle_rad| self.mirror(angle_rad));
        turn.into_iter().chain(mirror)
    }

    /// All turns and mirrors with more votes than `most`.
    fn above(&self, most: f64) -> impl Iterator<Item = Misreading> {
        let turns = angles_above(&self.turns, most).map(|angle_rad| self.turn(angle_rad));
        let mirrors = angles_above(&self.mirrors, most).map(|angle_rad| self.mirror(angle_rad));
        turns.chain(mirrors)
    }

    fn turn(&self, angle_rad: f64) -> Misreading {
        Misreading::Turn {
            angle_rad,
            heading_rad: self.heading_rad,
        }
    }

    fn mirror(&self, angle_rad: f64) -> Misreading {
        Misreading::Mirror {
            angle_rad,
            heading_rad: self.heading_rad,
        }
    }
}

/// The angles of the bins with more votes than `most`.
fn angles_above(votes: &[usize; BINS], most: f64) -> impl Iterator<Item = f64> {
    let bins = votes.iter().enumerate();
    let many = bins.filter(move |(_, votes)| **votes as f64 > most);
    many.map(|(bin, _)| bin_angle_rad(bin as f64))
}

/// Distance from an observer in metres, and direction in radians.
fn polar(pose: &Pose, position: &Point2<f64>) -> (f64, f64) {
    let offset = position - pose.position;
    (offset.norm(), offset.y.atan2(offset.x))
}

/// The angle at the centre of a bin, which may be fractional.
fn bin_angle_rad(bin: f64) -> f64 {
    wrap_angle((bin + 0.5) * TAU / BINS as f64)
}

/// Marks the bins of an interval of angles.
fn mark(bins: &mut [bool; BINS], centre_rad: f64, half_width_rad: f64) {
    let per_radian = BINS as f64 / TAU;
    let first = ((centre_rad - half_width_rad) * per_radian).floor() as i64;
    let last = ((centre_rad + half_width_rad) * per_radian).floor() as i64;
    for bin in first..=last.min(first + BINS as i64 - 1) {
        bins[bin.rem_euclid(BINS as i64) as usize] = true;
    }
}

/// The middle of the bins around the highest bin that have nearly as many votes; `None` without
/// votes.
fn peak_rad(votes: &[usize; BINS]) -> Option<f64> {
    let highest = (0..BINS).max_by_key(|bin| (votes[*bin], BINS - bin))?;
    let least = votes[highest] - votes[highest] / 20;
    let count = |step: i64| {
        let bins = (1..BINS as i64 / 4).map(|number| highest as i64 + step * number);
        bins.take_while(|bin| votes[bin.rem_euclid(BINS as i64) as usize] >= least)
            .count() as f64
    };
    let middle = highest as f64 + (count(1) - count(-1)) / 2.0;
    (votes[highest] > 0).then(|| bin_angle_rad(middle))
}
