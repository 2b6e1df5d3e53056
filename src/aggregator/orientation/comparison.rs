//! The comparison of one observer with others over a window of reports.

use std::f64::consts::TAU;

use nalgebra::{Point2, Vector2};

use super::misreading::{Misreading, PlacedReport};
use crate::model::geometry::{Pose, wrap_angle};

/// Number of reports in a window.
const WINDOW: usize = 10;

/// Minimum number of objects of a report that is compared, and of explained objects in most reports
/// of a window.
const MIN_OBJECTS: usize = 4;

/// Minimum number of explained objects that another vehicle must have reported to be a witness.
const MIN_OF_WITNESS: u32 = 2;

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

/// Minimum share of the objects that a mistake must explain.
const MIN_EXPLAINED: f64 = 0.5;

/// Maximum share, of the explained objects, that a rival may explain, and that coincide as reported:
/// objects near the axis of a mirror stay in place.
const MAX_RIVAL: f64 = 0.5;
const MAX_UNCHANGED: f64 = 0.7;

/// Mean distance, in gates, from which another change counts as a rival.
const RIVAL_GATES: f64 = 2.0;

/// Distances of shifts, in gates: up to the spacing of queued cars.
const SHIFT_GATES: [f64; 5] = [2.0, 3.0, 4.0, 5.0, 6.0];

/// Minimum root mean square distance of the explained objects of a report from their centre, in
/// gates.
const MIN_SPREAD_GATES: f64 = 3.0;

/// Minimum distance, in gates, from the only other vehicle for a change about the own position.
const MIN_APART_GATES: f64 = 10.0;

/// Change of the heading in radians that ends a window.
const MAX_HEADING_CHANGE_RAD: f64 = 0.09;

/// Number of bins of angles.
const BINS: usize = 180;

/// Reports of an observer beside simultaneous reports of others.
#[derive(Debug, Clone, Default)]
pub(super) struct WindowComparison {
    snapshots: Vec<ComparedReport>,
}

/// Result of a window.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum WindowOutcome {
    /// The objects coincide with the objects of others.
    Agrees,
    /// The objects coincide after a change.
    Mistaken(Misreading),
    /// Undecided, as for views that do not overlap.
    Open,
}

/// One report beside the reports of others.
#[derive(Debug, Clone)]
struct ComparedReport {
    pose: Option<Pose>,
    objects: Vec<Point2<f64>>,
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
    /// Adds a report and simultaneous reports of other vehicles, the nearest first.
    /// Reports with too few distinct objects are not compared.
    pub(super) fn add(&mut self, own: &PlacedReport, others: &[PlacedReport]) {
        let Some(snapshot) = ComparedReport::of(own, others) else {
            return;
        };
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
        self.snapshots.len() == WINDOW
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
        let mut best: Option<(Misreading, usize)> = None;
        for misreading in angles.peaks().chain(Misreading::without_angle()) {
            let explained = self.explained(&misreading, None);
            if best.is_none_or(|(_, most)| explained > most) {
                best = Some((misreading, explained));
            }
        }
        match best {
            Some((misreading, explained))
                if explained as f64 >= MIN_EXPLAINED * total as f64
                    && self.unchanged() as f64 <= MAX_UNCHANGED * explained as f64
                    && self.is_spread(&misreading)
                    && self.is_witnessed(&misreading)
                    && !self.has_rival(&misreading, explained, &angles) =>
            {
                WindowOutcome::Mistaken(misreading)
            }
            _ => WindowOutcome::Open,
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
        let none = Misreading::FrameTurn { angle_rad: 0.0 };
        self.explained(&none, None)
    }

    /// True if most reports have enough explained objects that are far apart.
    fn is_spread(&self, misreading: &Misreading) -> bool {
        let spread = self.snapshots.iter().filter(|snapshot| {
            let explained: Vec<_> = snapshot.coinciding(misreading, None).collect();
            explained.len() >= MIN_OBJECTS
                && root_mean_square_m(&explained) >= MIN_SPREAD_GATES * snapshot.gate_m
        });
        2 * spread.count() > self.snapshots.len()
    }

    /// True if most reports are witnessed.
    fn is_witnessed(&self, misreading: &Misreading) -> bool {
        let witnessed = self
            .snapshots
            .iter()
            .filter(|snapshot| snapshot.is_witnessed(misreading));
        2 * witnessed.count() > self.snapshots.len()
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
    /// `None` if the report has too few distinct objects.
    fn of(own: &PlacedReport, others: &[PlacedReport]) -> Option<Self> {
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
        if objects.len() < MIN_OBJECTS {
            return None;
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
            references,
            gate_m,
            agreeing,
        })
    }

    /// True if the explained objects are objects of two other vehicles. One vehicle against another
    /// shows only that they differ: a change about a point that both share would explain the right
    /// one, too. A change about the observer's own position needs only one other vehicle, if that
    /// stands elsewhere and no further vehicle has objects near the explained ones or near those
    /// that the observer reports.
    fn is_witnessed(&self, misreading: &Misreading) -> bool {
        let images: Vec<_> = self.coinciding(misreading, None).collect();
        let centre = mean(&images);
        let around_m = 2.0 * root_mean_square_m(&images);
        let present_m = PRESENT_GATES * self.gate_m;
        let mut coinciding = [0; u32::BITS as usize];
        let mut concerned = 0;
        let mut only: Option<Pose> = None;
        for reference in &self.references {
            let change = misreading.change_of_other(reference.observer.as_ref());
            let position = change.map(|change| change.apply(&reference.position));
            let coincides =
                position.is_some_and(|position| is_near(&position, &images, self.gate_m));
            for (number, objects) in coinciding.iter_mut().enumerate() {
                *objects += u32::from(coincides) & reference.witnesses >> number;
            }
            let is_around =
                position.is_some_and(|position| nalgebra::distance(&position, &centre) <= around_m);
            if is_around || is_near(&reference.position, &self.objects, present_m) {
                concerned |= reference.witnesses;
                only = only.or(reference.observer);
            }
        }
        let witnesses = coinciding
            .iter()
            .filter(|objects| **objects >= MIN_OF_WITNESS)
            .count();
        let stands_elsewhere = only.zip(self.pose).is_some_and(|(only, own)| {
            nalgebra::distance(&only.position, &own.position) >= MIN_APART_GATES * self.gate_m
        });
        let is_sole = concerned.count_ones() == 1 && self.references.len() < MAX_REFERENCES;
        witnesses >= 2 || !misreading.is_of_frame() && is_sole && stands_elsewhere
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
