//! Generated traffic for testing and tuning: moving objects in a town, the reports of its vehicles,
//! and the truth.
//!
//! Vehicles drive on a grid of roads, follow each other, stop at signals and turn; others are
//! parked; people and bicycles go around the blocks. Some of the vehicles report their detections.
//! Buildings and vehicles hide objects behind them; objects are missed because of range and
//! occlusion; there are false alarms of one frame, lasting ones, and places that cause false alarms
//! for every passing vehicle; positions are noisy, and shifted and turned with the slowly changing
//! error of the observer's pose; captures are not synchronised, and reports arrive late, out of
//! order, or are lost.
//!
//! The truth contains, every tenth of a second, all objects that any observer could see then or up
//! to [`TrafficConfig::memory_s`] before and, if poses are reported, the observers.
//!
//! Random numbers come from outside: equal numbers give equal traffic. Motion is exact to a
//! hundredth of a second.

mod config;
mod dice;
mod drive;
mod roads;
mod sight;
mod simulated_sensor;
#[cfg(test)]
mod tests;
mod walk;

use std::time::Duration;

use ecod::model::geometry::Pose;
use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ecod::wire::ObjectReport;
use nalgebra::Point2;
use serde::Serialize;

pub use config::{ReportedFields, SensorConfig, TrafficConfig};

use dice::Dice;
use drive::MovingVehicle;
use roads::{Building, Roads};
use sight::TrafficBody;
use simulated_sensor::{SimulatedSensor, Surroundings};
use walk::Walker;

/// When the recording begins.
const START: Timestamp = Timestamp(1_732_154_400_000_000);

/// Steps of the motion a second.
const STEPS_PER_S: f64 = 100.0;
const STEP_S: f64 = 1.0 / STEPS_PER_S;

/// Steps between frames of the truth.
const TRUTH_STEPS: u64 = 10;

/// The shortest time in seconds that a report takes.
const MIN_LATENCY_S: f64 = 0.03;

/// Standard deviation of an observer's clock in seconds.
const CLOCK_S: f64 = 0.002;

/// Reports and truth; see the module.
#[derive(Debug, Clone, PartialEq)]
pub struct TrafficRecording {
    /// In the order of arrival.
    pub reports: Vec<ArrivedReport>,
    /// In the order of time.
    pub truth: TrafficTruth,
}

/// A report and its time of arrival, as a line of a recording for [`ecod::replay`].
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ArrivedReport {
    /// Time of arrival; absent if reports arrive at once.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub received_at_us: Option<Timestamp>,
    /// The report as its vehicle made it.
    #[serde(flatten)]
    pub report: ObjectReport,
}

/// Ground truth, as a file for [`crate::eval::tracks::TrackTruth`].
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct TrafficTruth {
    /// In the order of time.
    pub frames: Vec<TruthFrame>,
}

/// All objects at one moment.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct TruthFrame {
    /// Time of the moment in µs, on the clock of the reports.
    pub t_us: Timestamp,
    /// Objects that were there.
    pub objects: Vec<TruthObject>,
}

/// One object at one moment.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct TruthObject {
    /// Constant over all frames.
    pub id: usize,
    /// Class of the object.
    pub label: &'static str,
    /// East of its centre in metres.
    pub x_m: f64,
    /// North of its centre in metres.
    pub y_m: f64,
}

/// The name of an observer.
#[expect(clippy::expect_used, reason = "letters, a dash and digits are a name")]
pub fn observer_name(number: usize) -> NodeName {
    NodeName::new(format!("cav-{number}")).expect("letters, a dash and digits are a name")
}

/// Generates traffic from `uniform`, which returns numbers drawn evenly from [0, 1); `config` must
/// be valid.
pub fn generate(config: &TrafficConfig, uniform: &mut dyn FnMut() -> f64) -> TrafficRecording {
    let dice = &mut Dice(uniform);
    let mut town = Town::new(config, dice);
    let warm_up = (config.warm_up_s * STEPS_PER_S) as u64;
    (0..warm_up).for_each(|step| town.step(step, dice));
    let mut watch = Watch::new(config, &town, dice);
    let steps = (config.duration_s * STEPS_PER_S) as u64;
    for step in 0..steps {
        town.step(warm_up + step, dice);
        watch.step(step, &town, dice);
    }
    watch.finish()
}

/// The state of the town.
struct Town {
    roads: Roads,
    buildings: Vec<Building>,
    vehicles: Vec<MovingVehicle>,
    walkers: Vec<Walker>,
    parked: Vec<TrafficBody>,
    lures: Vec<Point2<f64>>,
}

impl Town {
    fn new(config: &TrafficConfig, dice: &mut Dice<'_>) -> Self {
        let roads = Roads {
            count: config.roads,
            block_m: config.block_m,
        };
        let lanes = roads.lanes();
        let mut parked: Vec<TrafficBody> = Vec::new();
        while parked.len() < config.parked {
            let lane = lanes[dice.below(lanes.len())];
            let (center, heading_rad) =
                roads.parking(lane, dice.between(0.0, roads.length_m(lane)));
            if parked
                .iter()
                .all(|other| (other.center - center).norm() > 6.0)
                || dice.chance(0.001)
            {
                parked.push(TrafficBody {
                    length_m: dice.between(3.8, 4.9),
                    ..body("car", center, heading_rad)
                });
            }
        }
        let mut walkers = walk::walkers(&roads, config.people, false, dice);
        walkers.extend(walk::walkers(&roads, config.bicycles, true, dice));
        let blocks = roads.blocks().len() as f64;
        let lures = walk::walkers(
            &roads,
            (config.sensor.lures * blocks).round() as usize,
            false,
            dice,
        );
        let convoy = if config.convoy { config.observers } else { 0 };
        Self {
            buildings: roads.buildings(),
            vehicles: drive::vehicles(&roads, config.vehicles, convoy, dice),
            walkers,
            parked,
            lures: lures.iter().map(|lure| lure.place().0).collect(),
            roads,
        }
    }

    fn step(&mut self, step: u64, dice: &mut Dice<'_>) {
        drive::drive(
            &self.roads,
            &mut self.vehicles,
            step as f64 * STEP_S,
            STEP_S,
        );
        self.walkers
            .iter_mut()
            .for_each(|walker| walker.step(STEP_S, dice));
    }

    /// Everything that can be seen, vehicles first; a body keeps its place in the list.
    fn bodies(&self) -> Vec<TrafficBody> {
        let vehicles = self.vehicles.iter().map(|vehicle| {
            let (center, heading_rad) = self.roads.place(vehicle.path, vehicle.along_m);
            let MovingVehicle {
                speed_mps,
                length_m,
                width_m,
                ..
            } = *vehicle;
            TrafficBody {
                speed_mps,
                length_m,
                width_m,
                ..body("car", center, heading_rad)
            }
        });
        let walkers = self.walkers.iter().map(|walker| {
            let (center, heading_rad) = walker.place();
            let (label, length_m) = if walker.is_bicycle {
                ("bicycle", 1.8)
            } else {
                ("person", 0.5)
            };
            let speed_mps = walker.speed_mps();
            TrafficBody {
                speed_mps,
                length_m,
                width_m: 0.6,
                is_opaque: false,
                ..body(label, center, heading_rad)
            }
        });
        vehicles
            .chain(self.parked.iter().cloned())
            .chain(walkers)
            .collect()
    }
}

fn body(label: &'static str, center: Point2<f64>, heading_rad: f64) -> TrafficBody {
    TrafficBody {
        label,
        center,
        heading_rad,
        speed_mps: 0.0,
        length_m: 4.5,
        width_m: 1.8,
        is_opaque: true,
    }
}

/// All observers and their results.
struct Watch<'a> {
    config: &'a TrafficConfig,
    observers: Vec<Watcher>,
    /// By body, the last step at which an observer could see it.
    seen_at: Vec<Option<u64>>,
    arrived: Vec<(Timestamp, ArrivedReport)>,
    truth: TrafficTruth,
}

struct Watcher {
    name: NodeName,
    /// Its place among the bodies, unless it is a camera on a post.
    body: usize,
    sensor: SimulatedSensor,
    /// Step of the next capture by the clockwork, and by the shutter.
    due: u64,
    shutter: u64,
    clock_us: i64,
    seq: u64,
}

impl<'a> Watch<'a> {
    fn new(config: &'a TrafficConfig, town: &Town, dice: &mut Dice<'_>) -> Self {
        let bodies = town.bodies().len();
        let parked = town.vehicles.len();
        let period = (STEPS_PER_S / config.sensor.rate_hz).round() as usize;
        let mut watcher = |number| {
            let due = if config.synchronous {
                0
            } else {
                dice.below(period) as u64
            };
            let clock_s = if config.synchronous {
                0.0
            } else {
                CLOCK_S * dice.normal()
            };
            let late_s = if number % 2 == 1 {
                config.sensor.stamped_late_s
            } else {
                0.0
            };
            Watcher {
                name: observer_name(number),
                body: if number < config.observers {
                    number
                } else {
                    parked + number - config.observers
                },
                sensor: SimulatedSensor::new(bodies, dice),
                due,
                shutter: due,
                clock_us: ((clock_s + late_s) * 1e6) as i64,
                seq: 0,
            }
        };
        let observers = (0..config.observers + config.standing)
            .map(&mut watcher)
            .collect();
        Self {
            config,
            observers,
            seen_at: vec![None; bodies],
            arrived: Vec::new(),
            truth: TrafficTruth::default(),
        }
    }

    fn step(&mut self, step: u64, town: &Town, dice: &mut Dice<'_>) {
        let is_capture = self.observers.iter().any(|watcher| watcher.shutter == step);
        let is_frame = step.is_multiple_of(TRUTH_STEPS);
        if !is_capture && !is_frame {
            return;
        }
        let bodies = town.bodies();
        for number in 0..self.observers.len() {
            if self.observers[number].shutter == step {
                self.capture(number, step, town, &bodies, dice);
            }
        }
        if is_frame {
            self.truth.frames.push(TruthFrame {
                t_us: time_of(step),
                objects: self.known(step, &bodies),
            });
        }
    }

    fn capture(
        &mut self,
        number: usize,
        step: u64,
        town: &Town,
        bodies: &[TrafficBody],
        dice: &mut Dice<'_>,
    ) {
        let config = self.config;
        let (position, heading_rad) = match bodies.get(self.observers[number].body) {
            Some(vehicle) if !config.fixed => (vehicle.center, vehicle.heading_rad),
            _ => town.roads.post(number),
        };
        let pose = Pose {
            position,
            heading_rad,
        };
        let sights = sight::sights(position, bodies, &town.buildings, config.sensor.range_m);
        for sight in sights
            .iter()
            .filter(|sight| SimulatedSensor::sees(config, &pose, sight))
        {
            self.seen_at[sight.body] = Some(step);
        }
        let is_open = |lure: &&Point2<f64>| {
            !town
                .buildings
                .iter()
                .any(|building| building.hides(&pose.position, lure))
        };
        let lures: Vec<Point2<f64>> = town.lures.iter().filter(is_open).copied().collect();
        let around = Surroundings {
            pose,
            bodies,
            sights: &sights,
            lures: &lures,
            at_s: step as f64 * STEP_S,
        };
        let watcher = &mut self.observers[number];
        watcher.seq += 1;
        let stamp = time_of(step).shifted(watcher.clock_us);
        let moving = config.fixed.then_some(false);
        let mut report = ObjectReport {
            moving,
            ..ObjectReport::new(watcher.name.clone(), watcher.seq, stamp)
        };
        watcher.sensor.observe(config, &around, &mut report, dice);
        watcher.due += (STEPS_PER_S / config.sensor.rate_hz).round() as u64;
        watcher.shutter = if config.synchronous {
            watcher.due
        } else {
            watcher.due - 1 + dice.below(3) as u64
        };
        let mut takes_s = MIN_LATENCY_S + dice.exponential(config.sensor.latency_s);
        if dice.chance(config.sensor.lost) {
            return;
        }
        if dice.chance(config.sensor.lost) {
            takes_s += dice.between(0.2, 0.5);
        }
        let (received, received_at_us) = if config.synchronous {
            (report.captured_at_us, None)
        } else {
            let received = time_of(step) + Duration::from_secs_f64(takes_s);
            (received, Some(received))
        };
        self.arrived.push((
            received,
            ArrivedReport {
                received_at_us,
                report,
            },
        ));
    }

    /// Objects that belong to the truth.
    fn known(&self, step: u64, bodies: &[TrafficBody]) -> Vec<TruthObject> {
        let memory = (self.config.memory_s * STEPS_PER_S) as u64;
        let are_known = self.config.said.poses && !self.config.fixed;
        let is_observer =
            |id: usize| are_known && self.observers.iter().any(|watcher| watcher.body == id);
        let is_known = |id: usize| {
            is_observer(id) || self.seen_at[id].is_some_and(|seen| step - seen <= memory)
        };
        let round = |value: f64| (value * 1e3).round() / 1e3;
        let objects = bodies.iter().enumerate().filter(|(id, _)| is_known(*id));
        objects
            .map(|(id, body)| TruthObject {
                id,
                label: body.label,
                x_m: round(body.center.x),
                y_m: round(body.center.y),
            })
            .collect()
    }

    fn finish(mut self) -> TrafficRecording {
        self.arrived.sort_by_key(|(received, _)| *received);
        TrafficRecording {
            reports: self.arrived.into_iter().map(|(_, report)| report).collect(),
            truth: self.truth,
        }
    }
}

fn time_of(step: u64) -> Timestamp {
    START + Duration::from_secs_f64(step as f64 * STEP_S)
}
