//! A town of many cells in virtual time: generated traffic, one aggregator for each cell, and their
//! neighbours' maps.
//!
//! Each vehicle reports to the cell selected by the core's `CellChoice`. Cells send each other
//! their maps, which are delayed, duplicated, reordered or lost. Each cell has a frame and a clock
//! of its own. The town's map is the union of all maps of one moment, with each identity once. For
//! comparison, one aggregator gets all reports.

mod cell;
mod links;
mod place;

use std::collections::{BTreeMap, BTreeSet};
use std::ops::Range;
use std::time::Duration;

use ecod::aggregator::{Algorithms, FusionConfig};
use ecod::model::names::NodeName;
use ecod::model::origin::{GeographicOrigin, GeographicPosition};
use ecod::model::time::Timestamp;
use ecod::roaming::{CellChoice, CellMove, KnownCell};
use ecod::tracking::HandOvers;
use ecod::wire::{FusedObject, ObjectReport};
use hashbrown::HashMap;
use nalgebra::Point2;
use uuid::Uuid;

use crate::eval::tracks::{
    ReportedObject, TrackEvaluation, TrackScores, TrackTruth, TrackTruthError,
};
use crate::traffic::{TrafficConfig, TrafficRecording, TrafficTruth, TruthFrame};
use cell::TownCell;
use links::TownLinks;
use place::CellFrame;

/// Where the town is.
const TOWN: GeographicOrigin = GeographicOrigin {
    latitude_deg: 48.137,
    longitude_deg: 11.575,
    height_m: 520.0,
    rotation_deg: 0.0,
};

/// Cells along each side.
pub const CELLS_A_SIDE: usize = 3;

/// Numbers of the cells, row by row from the south-west.
const CELLS: Range<usize> = 0..CELLS_A_SIDE * CELLS_A_SIDE;

/// Distance in metres of a border of cells up to which a place is at the border.
pub const BORDER_M: f64 = 25.0;

/// Time that a vehicle takes to prepare in the next cell; real nodes take 0.6 to 2 s.
const JOIN_TIME: Duration = Duration::from_secs(1);

/// Maximum time between a map and the moment that it represents.
const MOMENT: Duration = Duration::from_millis(75);

/// Simulated links between cells, over which maps are exchanged.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LinkConfig {
    /// Maps a second that a cell sends.
    pub map_hz: f64,
    /// Least time in seconds that a map takes.
    pub min_delay_s: f64,
    /// Mean additional delay in seconds.
    pub delay_s: f64,
    /// Share of maps that are lost; as many come twice, and as many half a second late.
    pub lost: f64,
    /// False if cells exchange no messages.
    pub is_up: bool,
}

impl Default for LinkConfig {
    fn default() -> Self {
        Self {
            map_hz: 10.0,
            min_delay_s: 0.02,
            delay_s: 0.03,
            lost: 0.02,
            is_up: true,
        }
    }
}

/// Accuracy of one method of making the town's map.
#[derive(Debug, Clone, PartialEq)]
pub struct TownScores {
    /// Scores of all objects, wherever they are.
    pub all: TrackScores,
    /// Within [`BORDER_M`] of a border.
    pub border: TrackScores,
    /// At the same distance from a line through the middle of cells, and not at a border. If cells
    /// have an even number of roads, both kinds of lines run between roads.
    pub middle: TrackScores,
}

/// Result of a run.
#[derive(Debug, Clone, PartialEq)]
pub struct TownResult {
    /// One aggregator over everything.
    pub single: TownScores,
    /// The maps of the cells put together.
    pub cells: TownScores,
    /// Number of identities in maps of the cells.
    pub identities: usize,
    /// Identities that tracks took over from other cells.
    pub hand_overs: HandOvers,
    /// Maps that cells received.
    pub received: u64,
    /// Number of the messages that were refused.
    pub refused: u64,
}

/// A town whose traffic is such that every cell has two or more roads each way, and borders run
/// between roads.
pub fn town_traffic(roads_a_cell: usize, duration_s: f64) -> TrafficConfig {
    let roads = CELLS_A_SIDE * roads_a_cell;
    let share = (roads * (roads - 1)) as f64 / 12.0;
    let scaled = |of_quarter: usize| (of_quarter as f64 * share) as usize;
    let quarter = TrafficConfig::default();
    TrafficConfig {
        roads,
        observers: scaled(quarter.observers),
        vehicles: scaled(quarter.vehicles),
        parked: scaled(quarter.parked),
        people: scaled(quarter.people),
        bicycles: scaled(quarter.bicycles),
        duration_s,
        ..quarter
    }
}

/// Runs a recording through one aggregator and through nine; `uniform` returns numbers drawn evenly
/// from [0, 1).
///
/// # Errors
/// Returns an error for a recording without truth.
pub fn run(
    traffic: &TrafficConfig,
    recording: &TrafficRecording,
    link: LinkConfig,
    uniform: &mut dyn FnMut() -> f64,
) -> Result<TownResult, TrackTruthError> {
    let plan = TownPlan::new(traffic);
    let config = FusionConfig {
        algorithms: Algorithms::Pace,
        ..FusionConfig::default()
    };
    let Some(first) = recording.reports.first() else {
        return Err(TrackTruthError::Empty);
    };
    let start = first.received_at_us.unwrap_or(first.report.captured_at_us);
    let whole = NodeName::from_static("town");
    let mut single = TownCell::new(whole, CellFrame::new(&TOWN, TOWN, 0), config.clone(), start);
    let mut cells: Vec<TownCell> = plan
        .frames(uniform)
        .map(|(name, frame)| TownCell::new(name, frame, config.clone(), start))
        .collect();
    let mut links = TownLinks::new(link, uniform);
    let numbers: BTreeMap<NodeName, usize> =
        CELLS.map(|number| (cell_name(number), number)).collect();
    let mut vehicles: BTreeMap<NodeName, TownVehicle> = BTreeMap::new();
    for arrived in &recording.reports {
        let now = arrived
            .received_at_us
            .unwrap_or(arrived.report.captured_at_us);
        single.close_until(now);
        advance(&mut cells, &mut links, now);
        single.report(&arrived.report, now);
        let node = arrived.report.node.clone();
        let vehicle = vehicles
            .entry(node)
            .or_insert_with(|| plan.vehicle(&arrived.report));
        let number = numbers[vehicle.drive(&arrived.report, now)];
        cells[number].report(&arrived.report, now);
        links.send_from(&mut cells, number, now);
    }
    let maps = |of: &[TownCell]| judge(&plan, &recording.truth, of);
    Ok(TownResult {
        single: maps(std::slice::from_ref(&single))?,
        cells: maps(&cells)?,
        identities: cells
            .iter()
            .flat_map(TownCell::identities)
            .collect::<BTreeSet<Uuid>>()
            .len(),
        hand_overs: cells.iter().map(TownCell::hand_overs).fold(
            HandOvers::default(),
            |all, cell| HandOvers {
                begun: all.begun + cell.begun,
                renamed: all.renamed + cell.renamed,
            },
        ),
        received: cells.iter().map(|cell| cell.received).sum(),
        refused: cells.iter().map(|cell| cell.refused).sum(),
    })
}

/// Closes rounds and delivers maps that are due until `now`, in the order of time.
fn advance(cells: &mut [TownCell], links: &mut TownLinks<'_>, now: Timestamp) {
    loop {
        let rounds = cells
            .iter()
            .enumerate()
            .map(|(number, cell)| (cell.deadline(), number));
        let Some((round_at, number)) = rounds.min() else {
            return;
        };
        let delivery = links.next_at().unwrap_or(Timestamp(u64::MAX));
        if round_at.min(delivery) > now {
            return;
        }
        if delivery <= round_at {
            links.deliver(cells);
        } else {
            cells[number].close_until(round_at);
            links.send_from(cells, number, round_at);
        }
    }
}

/// The borders of the cells.
struct TownPlan {
    /// West and south edge of the first cell, and side of a cell, metres.
    from_m: f64,
    side_m: f64,
}

impl TownPlan {
    fn new(traffic: &TrafficConfig) -> Self {
        let side_m = traffic.roads as f64 * traffic.block_m / CELLS_A_SIDE as f64;
        Self {
            from_m: -traffic.block_m / 2.0,
            side_m,
        }
    }

    /// Names and frames: each with a direction and a clock of its own, up to 2 s fast or slow.
    fn frames<'a>(
        &'a self,
        uniform: &'a mut dyn FnMut() -> f64,
    ) -> impl Iterator<Item = (NodeName, CellFrame)> + 'a {
        CELLS.map(move |number| {
            let origin = GeographicOrigin {
                rotation_deg: 360.0 * uniform(),
                ..self.middle(number)
            };
            let clock_us = ((4.0 * uniform() - 2.0) * 1e6) as i64;
            (cell_name(number), CellFrame::new(&TOWN, origin, clock_us))
        })
    }

    fn index(&self, coordinate_m: f64) -> usize {
        (((coordinate_m - self.from_m) / self.side_m).max(0.0) as usize).min(CELLS_A_SIDE - 1)
    }

    /// A vehicle in the cell in which its report is made.
    fn vehicle(&self, report: &ObjectReport) -> TownVehicle {
        let place = place_of(report);
        let here = self.index(place.x) + CELLS_A_SIDE * self.index(place.y);
        // Circles that have the corners in them.
        let radius_m = 0.75 * self.side_m;
        let known = |number| KnownCell {
            name: cell_name(number),
            origin: self.middle(number),
            radius_m,
        };
        TownVehicle {
            choice: CellChoice::new(CELLS.map(known).collect(), cell_name(here)),
            joined_at: None,
        }
    }

    /// Place on Earth of the middle of a cell; its frame looks east.
    fn middle(&self, number: usize) -> GeographicOrigin {
        let middle = |place: usize| self.from_m + (place as f64 + 0.5) * self.side_m;
        let place = TOWN.to_wgs84(
            middle(number % CELLS_A_SIDE),
            middle(number / CELLS_A_SIDE),
            0.0,
        );
        let GeographicPosition {
            latitude_deg,
            longitude_deg,
            height_m,
        } = place;
        GeographicOrigin {
            latitude_deg,
            longitude_deg,
            height_m,
            rotation_deg: 0.0,
        }
    }

    /// Distance to the next border between cells, metres.
    fn border_m(&self, place: &Point2<f64>) -> f64 {
        let borders = (1..CELLS_A_SIDE).map(|number| self.from_m + number as f64 * self.side_m);
        distance_m(place, borders)
    }

    fn is_at_border(&self, place: &Point2<f64>) -> bool {
        self.border_m(place) < BORDER_M
    }

    fn is_in_middle(&self, place: &Point2<f64>) -> bool {
        let middles =
            (0..CELLS_A_SIDE).map(|number| self.from_m + (number as f64 + 0.5) * self.side_m);
        distance_m(place, middles) < BORDER_M && !self.is_at_border(place)
    }
}

/// A vehicle that reports to one cell at a time.
struct TownVehicle {
    choice: CellChoice,
    /// The next cell and when it was joined.
    joined_at: Option<(NodeName, Timestamp)>,
}

impl TownVehicle {
    /// The cell to which it reports from where it is at `now`.
    fn drive(&mut self, report: &ObjectReport, now: Timestamp) -> &NodeName {
        let place = place_of(report);
        match self
            .choice
            .observe(Some(&TOWN.to_wgs84(place.x, place.y, 0.0)), now)
        {
            Some(CellMove::Join(cell)) => self.joined_at = Some((cell, now)),
            Some(CellMove::GiveUp(_)) => self.joined_at = None,
            None => {}
        }
        if let Some((cell, _)) = self
            .joined_at
            .take_if(|(_, at)| now.since(*at) >= JOIN_TIME)
        {
            self.choice.enter(&cell);
        }
        self.choice.present()
    }
}

/// Place of the reporting vehicle in the town's frame, in metres.
fn place_of(report: &ObjectReport) -> Point2<f64> {
    report
        .pose
        .map_or(Point2::origin(), |pose| Point2::new(pose.x_m, pose.y_m))
}

/// Distance of a place to the next of lines along both axes.
fn distance_m(place: &Point2<f64>, lines: impl Iterator<Item = f64>) -> f64 {
    let distances = lines.flat_map(|line| [(place.x - line).abs(), (place.y - line).abs()]);
    distances.min_by(f64::total_cmp).unwrap_or(f64::INFINITY)
}

#[expect(clippy::expect_used, reason = "letters, a dash and a digit are a name")]
fn cell_name(number: usize) -> NodeName {
    NodeName::new(format!("cell-{number}")).expect("letters, a dash and a digit are a name")
}

/// Evaluates the maps of cells together.
fn judge(
    plan: &TownPlan,
    truth: &TrafficTruth,
    cells: &[TownCell],
) -> Result<TownScores, TrackTruthError> {
    let part = |is_part: &dyn Fn(&Point2<f64>) -> bool| -> Result<TrackScores, TrackTruthError> {
        let frames = truth.frames.iter().map(|frame| {
            let here = frame
                .objects
                .iter()
                .filter(|object| is_part(&Point2::new(object.x_m, object.y_m)));
            TruthFrame {
                t_us: frame.t_us,
                objects: here.cloned().collect(),
            }
        });
        let part = TrafficTruth {
            frames: frames.collect(),
        };
        let text = serde_json::to_string(&part).unwrap_or_default();
        let mut judge = TrackEvaluation::new(TrackTruth::parse(&text)?);
        let mut ids = HashMap::new();
        for frame in &truth.frames {
            let moment = moment(cells, frame.t_us);
            let said: Vec<ReportedObject> = moment
                .iter()
                .filter(|object| is_part(&Point2::new(object.x_m, object.y_m)))
                .map(|object| ReportedObject::of(object, &mut ids))
                .collect();
            judge.add_objects(frame.t_us, &said);
        }
        Ok(judge.result())
    };
    Ok(TownScores {
        all: part(&|_| true)?,
        border: part(&|place| plan.is_at_border(place))?,
        middle: part(&|place| plan.is_in_middle(place))?,
    })
}

/// All objects of all cells at a moment, each identity once, with its most accurate object.
fn moment(cells: &[TownCell], at: Timestamp) -> Vec<FusedObject> {
    let mut known: BTreeMap<Uuid, FusedObject> = BTreeMap::new();
    for object in cells.iter().flat_map(|cell| cell.objects_at(at, MOMENT)) {
        let spread = |object: &FusedObject| object.covariance_m2[0] + object.covariance_m2[2];
        match known.get(&object.id) {
            Some(other) if spread(other) <= spread(&object) => {}
            _ => {
                known.insert(object.id, object);
            }
        }
    }
    known.into_values().collect()
}
