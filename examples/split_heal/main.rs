//! A cell of four vehicles that splits in two halves and heals: two leaders and two maps, then one of each again,
//! without loss of evidence.
//!
//! `cargo run --example split_heal`
//!
//! This is a simulation: leadership, round filter, aggregator and replication of each vehicle are the code of a node,
//! and messages are encoded and decoded, but time is a number and the network a queue, so that all runs are equal.
//! `make trials` splits cells of real processes in network namespaces.
//!
//! Euclid and gauss read slot-0, noether and turing slot-1, and all read a sign, which turing misreads. The program
//! fails unless, at the end, one vehicle leads and every ledger contains the evidence of both halves once.

mod vehicle;

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::time::Duration;

use anyhow::ensure;
use ecod::aggregator::FusionConfig;
use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ecod::perception::landmark::{Landmark, LandmarkConfig};
use ecod::wire::{ObjectReport, PerceivedObject};

use vehicle::{Payload, Vehicle};

/// Landmarks and metres east.
const PLACES: [(&str, f64); 3] = [("slot-0", 0.0), ("slot-1", 3.0), ("sign", 6.0)];

/// Labels that each vehicle reads, by landmark.
const SEEN: [(&str, [(usize, &str); 2]); 4] = [
    ("euclid", [(0, "ABC123"), (2, "stop")]),
    ("gauss", [(0, "ABC123"), (2, "stop")]),
    ("noether", [(1, "XYZ789"), (2, "stop")]),
    ("turing", [(1, "XYZ789"), (2, "yield")]),
];

const START: Timestamp = Timestamp(1_732_154_400_000_000);
const REPORT_MS: u64 = 100;
/// Travel time of a packet, which is also the step of time.
const TRAVEL: Duration = Duration::from_millis(1);
/// Time until the memberships report a vehicle as down or up.
const NOTICE_MS: u64 = 300;

fn main() -> anyhow::Result<()> {
    let mut cell = Cell::new();
    println!(
        "{:>7}  {:<26}{:<37}map at turing",
        "time", "event", "map at gauss"
    );
    cell.split(false, "the vehicles start")?;
    cell.run_for(7700)?;
    cell.print_event("all is well");
    cell.split(true, "the network splits")?;
    cell.run_for(7700)?;
    cell.print_event("both sides go on");
    cell.split(false, "the network heals")?;
    cell.run_for(7700)?;
    cell.print_event("all is well");
    cell.check()
}

struct Packet {
    due: Timestamp,
    from: usize,
    to: usize,
    payload: Payload,
}

struct Cell {
    now: Timestamp,
    vehicles: Vec<Vehicle>,
    packets: VecDeque<Packet>,
    is_split: bool,
}

impl Cell {
    fn new() -> Self {
        let mut fusion = FusionConfig::default();
        // A vehicle's vote counts as evidence once in this time.
        fusion.vote.weighted.freshness_s = 0.5;
        let landmarks = PLACES.map(|(id, x_m)| Landmark::from(&LandmarkConfig::at(id, x_m, 0.0)));
        let vehicle = |(index, (name, _)): (u8, (&'static str, _))| {
            Vehicle::new(
                NodeName::from_static(name),
                index,
                fusion.clone(),
                landmarks.to_vec(),
                START,
            )
        };
        let vehicles = (1..).zip(SEEN).map(vehicle).collect();
        Self {
            now: START,
            vehicles,
            packets: VecDeque::new(),
            is_split: false,
        }
    }

    /// Cuts or restores the links between the halves; the memberships report it later.
    fn split(&mut self, is_split: bool, event: &str) -> anyhow::Result<()> {
        self.is_split = is_split;
        self.print_event(event);
        self.run_for(NOTICE_MS)?;
        for node in 0..SEEN.len() {
            for other in (0..SEEN.len()).filter(|other| *other != node) {
                let member = self.vehicles[other].as_member();
                let is_linked = self.is_linked(node, other);
                self.vehicles[node].notice(member, is_linked, self.now);
            }
        }
        Ok(())
    }

    fn is_linked(&self, a: usize, b: usize) -> bool {
        !self.is_split || (a < 2) == (b < 2)
    }

    fn run_for(&mut self, ms: u64) -> anyhow::Result<()> {
        for _ in 0..ms {
            self.now = self.now + TRAVEL;
            while let Some(Packet {
                from, to, payload, ..
            }) = self.packets.pop_front_if(|next| next.due <= self.now)
            {
                let sender = self.vehicles[from].name.clone();
                self.vehicles[to].receive(&sender, &payload, self.now)?;
            }
            for node in 0..SEEN.len() {
                if self.now.micros().is_multiple_of(REPORT_MS * 1000) {
                    self.vehicles[node].report(report(node, self.now), self.now)?;
                }
                self.vehicles[node].tick(self.now)?;
                self.post(node);
            }
        }
        Ok(())
    }

    /// Sends the vehicle's messages over the existing links, and prints its events.
    fn post(&mut self, from: usize) {
        for (addressee, payload) in std::mem::take(&mut self.vehicles[from].outbox) {
            for to in (0..SEEN.len()).filter(|to| *to != from) {
                let is_meant = addressee
                    .as_ref()
                    .is_none_or(|name| *name == self.vehicles[to].name);
                if is_meant && self.is_linked(from, to) {
                    self.packets.push_back(Packet {
                        due: self.now + TRAVEL,
                        from,
                        to,
                        payload: payload.clone(),
                    });
                }
            }
        }
        for event in std::mem::take(&mut self.vehicles[from].news) {
            self.print_event(&event);
        }
    }

    /// Prints an event and the map of each half.
    fn print_event(&self, event: &str) {
        let view = |vehicle: &Vehicle| {
            let Some(map) = &vehicle.map else {
                return "none".to_owned();
            };
            let labels = map
                .landmarks
                .iter()
                .map(|place| place.label.as_deref().unwrap_or("?"));
            format!(
                "{}@{} #{} {}",
                map.aggregator,
                map.epoch,
                map.round,
                labels.collect::<Vec<_>>().join(" ")
            )
        };
        let seconds = self.now.since(START).as_secs_f64();
        println!(
            "{seconds:>5.2} s  {event:<26}{:<37}{}",
            view(&self.vehicles[1]),
            view(&self.vehicles[3])
        );
    }

    /// Checks that one vehicle leads, that all accept its map, and that every ledger contains the evidence of every
    /// leadership once.
    fn check(&self) -> anyhow::Result<()> {
        println!("\nvotes settled, and in the ledgers of the vehicles");
        let settled: BTreeMap<_, _> = self
            .vehicles
            .iter()
            .flat_map(|vehicle| &vehicle.settled)
            .collect();
        for (epoch, settled) in settled {
            let held_by = |vehicle: &Vehicle| {
                let lane = vehicle
                    .ledger
                    .entries()
                    .filter(|e| e.epoch == epoch.term && e.aggregator == epoch.leader);
                lane.map(|entry| entry.correct + entry.incorrect)
                    .sum::<u64>()
            };
            let held: Vec<_> = self.vehicles.iter().map(held_by).collect();
            println!("{:<10}{settled:>4}  {held:?}", epoch.to_string());
            ensure!(*settled > 0, "{epoch} settled no votes");
            ensure!(
                held.iter().all(|held| held == settled),
                "evidence of {epoch} was lost or counted twice"
            );
        }
        let leaders = self
            .vehicles
            .iter()
            .filter(|vehicle| vehicle.leadership.is_leading())
            .count();
        let sources: BTreeSet<_> = self
            .vehicles
            .iter()
            .map(|vehicle| vehicle.map.as_ref().map(|map| (map.epoch, &map.aggregator)))
            .collect();
        ensure!(
            leaders == 1 && sources.len() == 1,
            "{leaders} lead, and maps come from {sources:?}"
        );
        Ok(())
    }
}

/// Report of a vehicle.
fn report(node: usize, now: Timestamp) -> ObjectReport {
    let (name, seen) = SEEN[node];
    let object = |(place, label): (usize, &str)| PerceivedObject {
        landmark: Some(PLACES[place].0.into()),
        ..PerceivedObject::new(label, 0.9, PLACES[place].1, 0.0)
    };
    ObjectReport {
        objects: seen.map(object).into(),
        ..ObjectReport::new(
            NodeName::from_static(name),
            now.since(START).as_millis() as u64,
            now,
        )
    }
}
