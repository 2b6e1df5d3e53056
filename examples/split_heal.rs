//! A cell of four vehicles that falls in two and heals: two leaders, two maps, then one again, and no evidence lost.
//!
//! `cargo run --example split_heal`
//!
//! A simulation: the election, the aggregator and the ledger of each vehicle are those that a node runs, but time is
//! a number and the network a queue, so that every run is the same. What travels is encoded and decoded as on the wire.
//! Cells of real processes in network namespaces are split by `make trials`.
//!
//! Euclid and gauss see slot-0, noether and turing slot-1, and all vote on a sign, which turing misreads. The program fails
//! if, in the end, there is not one leader, or evidence was lost or counted twice.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::time::Duration;

use anyhow::{Context, ensure};
use ecod::aggregator::{Aggregator, Fused, FusionConfig};
use ecod::election::{Body, Effect, Election, ElectionConfig, ElectionMessage, Health, Input};
use ecod::epoch::{Epoch, EpochGate};
use ecod::landmark::{Landmark, LandmarkConfig};
use ecod::names::NodeName;
use ecod::reputation::ReputationLedger;
use ecod::time::Timestamp;
use ecod::wire::{
    Encoding, GlobalMap, LedgerShare, Limits, ObjectReport, PerceivedObject, ReportKind, SCHEMA_VERSION, decode,
    decode_report, decode_share, encode,
};

const NAMES: [&str; 4] = ["euclid", "gauss", "noether", "turing"];
/// What each reads at its slot, and on the sign.
const SEEN: [[(&str, &str); 2]; 4] = [
    [("slot-0", "ABC123"), ("sign", "stop")],
    [("slot-0", "ABC123"), ("sign", "stop")],
    [("slot-1", "XYZ789"), ("sign", "stop")],
    [("slot-1", "XYZ789"), ("sign", "yield")],
];
/// Places and metres east.
const PLACES: [(&str, f64); 3] = [("slot-0", 0.0), ("slot-1", 3.0), ("sign", 6.0)];

const START: Timestamp = Timestamp(1_732_154_400_000_000);
const STEP: Duration = Duration::from_millis(1);
const REPORT_MS: u64 = 100;
const SHARE_MS: u64 = 1000;
/// Until the memberships know who is gone or back.
const NOTICE_MS: u64 = 300;

fn main() -> anyhow::Result<()> {
    let mut cell = Cell::new();
    println!("{:>7}  {:<28}{:<37}at turing: map", "time", "event", "at gauss: map");
    cell.split(false)?;
    cell.run_for(7700)?;
    cell.tell("all is well");
    cell.split(true)?;
    cell.run_for(7700)?;
    cell.tell("both sides go on");
    cell.split(false)?;
    cell.run_for(7700)?;
    cell.tell("all is well");
    cell.check()
}

/// One vehicle.
struct Node {
    name: NodeName,
    election: Election,
    aggregator: Aggregator,
    ledger: ReputationLedger,
    gate: EpochGate,
    map: Option<GlobalMap>,
}

#[derive(Clone)]
enum Payload {
    Election(Vec<u8>),
    Report(ReportKind, Vec<u8>),
    Map(Vec<u8>),
    Share(Vec<u8>),
}

struct Packet {
    due: Timestamp,
    from: usize,
    to: usize,
    payload: Payload,
}

struct Cell {
    now: Timestamp,
    nodes: Vec<Node>,
    packets: VecDeque<Packet>,
    is_split: bool,
    /// Votes that were settled in each leadership: what the ledgers must hold in the end.
    settled: BTreeMap<Epoch, u64>,
}

impl Cell {
    fn new() -> Self {
        let mut fusion = FusionConfig::default();
        // A vehicle's vote counts as evidence once in this time.
        fusion.vote.weighted.freshness_s = 0.5;
        let landmarks = PLACES.map(|(id, x_m)| Landmark::from(&LandmarkConfig::at(id, x_m, 0.0)));
        let health = Health { broker: true, fuser: true, gateway: true, load_percent: 0 };
        let node = |name| {
            let name = NodeName::from_static(name);
            let mut election = Election::new(ElectionConfig::default(), name.clone(), 0, START);
            election.handle(Input::Health { health }, START);
            Node {
                election,
                name,
                aggregator: Aggregator::standby(fusion.clone(), landmarks.to_vec(), START),
                ledger: ReputationLedger::default(),
                gate: EpochGate::default(),
                map: None,
            }
        };
        Self {
            now: START,
            nodes: NAMES.map(node).into(),
            packets: VecDeque::new(),
            is_split: false,
            settled: BTreeMap::new(),
        }
    }

    /// Cuts or mends the links between the two halves; the memberships find out a while later.
    fn split(&mut self, is_split: bool) -> anyhow::Result<()> {
        self.is_split = is_split;
        self.tell(if is_split { "the network splits" } else { "the network is whole" });
        self.run_for(NOTICE_MS)?;
        for node in 0..NAMES.len() {
            for other in (0..NAMES.len()).filter(|other| *other != node) {
                let peer = self.nodes[other].name.clone();
                let is_linked = self.is_linked(node, other);
                self.handle(node, if is_linked { Input::PeerAlive { peer } } else { Input::PeerDown { peer } })?;
            }
        }
        Ok(())
    }

    fn run_for(&mut self, ms: u64) -> anyhow::Result<()> {
        for _ in 0..ms {
            self.now = self.now + STEP;
            let age_ms = self.now.since(START).as_millis() as u64;
            while let Some(packet) = self.packets.pop_front_if(|packet| packet.due <= self.now) {
                self.receive(packet)?;
            }
            for node in 0..NAMES.len() {
                let effects = self.nodes[node].election.tick(self.now);
                self.carry_out(node, effects)?;
                if age_ms.is_multiple_of(REPORT_MS) {
                    self.report(node)?;
                }
                if let Some(fused) = self.nodes[node].aggregator.tick(self.now) {
                    self.publish(node, fused)?;
                }
                if age_ms % SHARE_MS == SHARE_MS / 2 + 50 && self.nodes[node].election.is_leading() {
                    let share = self.evidence(node);
                    self.send_all(node, &share);
                }
            }
        }
        Ok(())
    }

    fn is_linked(&self, a: usize, b: usize) -> bool {
        !self.is_split || (a < 2) == (b < 2)
    }

    fn send(&mut self, from: usize, to: usize, payload: Payload) {
        if self.is_linked(from, to) {
            self.packets.push_back(Packet { due: self.now + STEP, from, to, payload });
        }
    }

    fn send_all(&mut self, from: usize, payload: &Payload) {
        let others = (0..NAMES.len()).filter(|to| *to != from);
        others.for_each(|to| self.send(from, to, payload.clone()));
    }

    fn receive(&mut self, Packet { from, to, payload, .. }: Packet) -> anyhow::Result<()> {
        let (limits, sender) = (Limits::default(), self.nodes[from].name.clone());
        match payload {
            Payload::Election(bytes) => self.handle(to, Input::Receive { message: ElectionMessage::decode(&bytes)? }),
            Payload::Report(kind, bytes) => self.take_report(to, kind, &decode_report(&bytes, &sender, &limits)?),
            Payload::Map(bytes) => self.take_map(to, decode(&bytes, &limits)?),
            Payload::Share(bytes) => {
                let share = decode_share(&bytes, &sender, &limits)?;
                let Node { ledger, aggregator, .. } = &mut self.nodes[to];
                if ledger.merge_entries(&share.entries) {
                    aggregator.adopt(ledger);
                }
                Ok(())
            }
        }
    }

    fn handle(&mut self, node: usize, input: Input) -> anyhow::Result<()> {
        let effects = self.nodes[node].election.handle(input, self.now);
        self.carry_out(node, effects)
    }

    fn carry_out(&mut self, node: usize, effects: Vec<Effect>) -> anyhow::Result<()> {
        let now = self.now;
        for effect in effects {
            match effect {
                Effect::Send { to, message } => {
                    if matches!(message.body, Body::Yield { .. }) {
                        self.nodes[node].aggregator.hold();
                    }
                    self.send(node, index(&to)?, Payload::Election(message.encode(Encoding::Cbor)));
                }
                Effect::Lead { epoch, first_round, on_time } => {
                    self.nodes[node].aggregator.lead(epoch.clone(), first_round, on_time, now);
                    self.tell(&format!("{epoch} leads from #{first_round}"));
                }
                Effect::StopPublishing { epoch } => {
                    self.nodes[node].aggregator.stand_by();
                    self.tell(&format!("{epoch} stops"));
                }
                Effect::Prepare { .. } => self.handle(node, Input::Prepared)?,
                Effect::SendState { to } => {
                    let share = self.evidence(node);
                    self.send(node, index(&to)?, share);
                }
                // No vehicle restarts here, and everyone sends to everyone.
                Effect::PersistTerm { .. } | Effect::Follow { .. } | Effect::Seek | Effect::AnnounceStandby { .. } => {}
            }
        }
        Ok(())
    }

    /// A vehicle reports what it sees: for the map and as votes.
    fn report(&mut self, node: usize) -> anyhow::Result<()> {
        let object = |(place, label): (&str, &str)| PerceivedObject {
            label: label.into(),
            confidence: 0.9,
            x_m: PLACES.iter().find(|(id, _)| *id == place).map_or(0.0, |(_, x_m)| *x_m),
            y_m: 0.0,
            covariance_m2: None,
            landmark: Some(place.into()),
        };
        let report = ObjectReport {
            schema: SCHEMA_VERSION,
            node: self.nodes[node].name.clone(),
            seq: self.now.micros(),
            captured_at_us: self.now,
            pose: None,
            objects: SEEN[node].map(object).into(),
            seen: None,
        };
        let bytes = encode(&report, Encoding::Cbor);
        for kind in [ReportKind::Detections, ReportKind::VoteDetections] {
            self.send_all(node, &Payload::Report(kind, bytes.clone()));
            self.take_report(node, kind, &report)?;
        }
        Ok(())
    }

    fn take_report(&mut self, node: usize, kind: ReportKind, report: &ObjectReport) -> anyhow::Result<()> {
        let fused = self.nodes[node].aggregator.report(kind, report, self.now)?;
        fused.map_or(Ok(()), |fused| self.publish(node, fused))
    }

    /// A leader publishes its round, and keeps what the round says about vehicles in the lane of its epoch.
    fn publish(&mut self, node: usize, fused: Fused) -> anyhow::Result<()> {
        let Fused { epoch, map, evidence, .. } = fused;
        for vote in &evidence {
            self.nodes[node].ledger.record(epoch.term, &epoch.leader, vote);
        }
        *self.settled.entry(epoch).or_default() += evidence.len() as u64;
        let map = map.context("the cell runs no PACE")?;
        self.send_all(node, &Payload::Map(encode(&map, Encoding::Cbor)));
        self.take_map(node, map)
    }

    fn take_map(&mut self, node: usize, map: GlobalMap) -> anyhow::Result<()> {
        let Node { gate, map: newest, .. } = &mut self.nodes[node];
        if gate.admit_map(&map).is_err() {
            return Ok(());
        }
        let (epoch, round) = (Epoch::new(map.epoch, map.aggregator.clone()), map.round);
        *newest = Some(map);
        self.handle(node, Input::Round { epoch, round })
    }

    fn evidence(&self, node: usize) -> Payload {
        let Node { name, ledger, .. } = &self.nodes[node];
        let entries = ledger.entries().collect();
        let share = LedgerShare { schema: SCHEMA_VERSION, node: name.clone(), epoch: None, entries };
        Payload::Share(encode(&share, Encoding::Cbor))
    }

    /// Says what happened and what map each side has.
    fn tell(&self, event: &str) {
        let view = |node: &Node| {
            let Some(map) = &node.map else { return "none".to_owned() };
            let labels = map.landmarks.iter().map(|place| place.label.as_deref().unwrap_or("?"));
            format!("{}@{} #{} {}", map.aggregator, map.epoch, map.round, labels.collect::<Vec<_>>().join(" "))
        };
        let seconds = self.now.since(START).as_secs_f64();
        println!("{seconds:>5.2} s  {event:<28}{:<37}{}", view(&self.nodes[1]), view(&self.nodes[3]));
    }

    /// One leads, all have its maps, and every ledger holds the evidence of every leadership once.
    fn check(&self) -> anyhow::Result<()> {
        println!("\nvotes settled, and in the ledger of each vehicle");
        for (epoch, settled) in &self.settled {
            let held = |node: &Node| {
                let lane = node.ledger.entries().filter(|e| e.epoch == epoch.term && e.aggregator == epoch.leader);
                lane.map(|entry| entry.correct + entry.incorrect).sum::<u64>()
            };
            let held: Vec<_> = self.nodes.iter().map(held).collect();
            println!("{:<12}{settled:>4} {held:?}", epoch.to_string());
            ensure!(held.iter().all(|held| held == settled), "evidence of {epoch} was lost or counted twice");
        }
        ensure!(self.settled.values().all(|settled| *settled > 0), "a leadership settled nothing");
        let leaders = self.nodes.iter().filter(|node| node.election.is_leading()).count();
        ensure!(leaders == 1, "{leaders} lead in the end");
        let rounds = self.nodes.iter().map(|node| node.map.as_ref().map(|map| (map.epoch, &map.aggregator, map.round)));
        ensure!(rounds.collect::<BTreeSet<_>>().len() == 1, "not all have the same map");
        Ok(())
    }
}

fn index(name: &NodeName) -> anyhow::Result<usize> {
    NAMES.iter().position(|known| name == known).with_context(|| format!("nobody is called {name}"))
}
