//! One vehicle: what a node runs, without clock, sockets and actors.

use std::collections::BTreeMap;
use std::sync::Arc;

use anyhow::Context;
use ecod::aggregator::{Aggregator, Fused, FusionConfig};
use ecod::epoch::{Epoch, EpochGate};
use ecod::landmark::Landmark;
use ecod::leadership::election::{Body, Effect, Election, ElectionConfig, ElectionMessage, Health, Input};
use ecod::names::NodeName;
use ecod::reputation::ReputationLedger;
use ecod::time::Timestamp;
use ecod::wire::{
    Encoding, GlobalMap, LedgerShare, Limits, ObjectReport, ReportKind, SCHEMA_VERSION, decode, decode_report,
    decode_share, encode,
};

/// What vehicles send each other, as it travels.
#[derive(Debug, Clone)]
pub(crate) enum Payload {
    Election(Vec<u8>),
    Report(ReportKind, Vec<u8>),
    Map(Vec<u8>),
    Evidence(Vec<u8>),
}

pub(crate) struct Vehicle {
    pub(crate) name: NodeName,
    pub(crate) election: Election,
    aggregator: Aggregator,
    pub(crate) ledger: ReputationLedger,
    gate: EpochGate,
    /// The last map that it accepted.
    pub(crate) map: Option<GlobalMap>,
    /// Votes that it settled in each of its leaderships.
    pub(crate) settled: BTreeMap<Epoch, u64>,
    /// What is to be sent, to one vehicle or to all.
    pub(crate) outbox: Vec<(Option<NodeName>, Payload)>,
    /// What there is to tell.
    pub(crate) news: Vec<String>,
}

impl Vehicle {
    pub(crate) fn new(name: NodeName, fusion: FusionConfig, landmarks: Vec<Landmark>, now: Timestamp) -> Self {
        let mut election = Election::new(ElectionConfig::default(), name.clone(), 0, now);
        let health = Health { broker: true, fuser: true, gateway: true, load_percent: 0 };
        election.handle(Input::Health { health }, now);
        Self {
            name,
            election,
            aggregator: Aggregator::new_standby(fusion, landmarks, now),
            ledger: ReputationLedger::default(),
            gate: EpochGate::default(),
            map: None,
            settled: BTreeMap::new(),
            outbox: Vec::new(),
            news: Vec::new(),
        }
    }

    pub(crate) fn tick(&mut self, now: Timestamp) -> anyhow::Result<()> {
        let effects = self.election.tick(now);
        self.carry_out(effects, now);
        self.aggregator.tick(now).map_or(Ok(()), |fused| self.publish(fused, now))
    }

    pub(crate) fn handle(&mut self, input: Input, now: Timestamp) {
        let effects = self.election.handle(input, now);
        self.carry_out(effects, now);
    }

    pub(crate) fn receive(&mut self, from: &NodeName, payload: &Payload, now: Timestamp) -> anyhow::Result<()> {
        let limits = Limits::default();
        match payload {
            Payload::Election(bytes) => self.handle(Input::Receive { message: ElectionMessage::decode(bytes)? }, now),
            Payload::Report(kind, bytes) => self.fuse(*kind, &Arc::new(decode_report(bytes, from, &limits)?), now)?,
            Payload::Map(bytes) => self.accept(decode(bytes, &limits)?, now),
            Payload::Evidence(bytes) => {
                if self.ledger.merge_entries(decode_share(bytes, from, &limits)?.entries, self.election.epoch()) {
                    self.aggregator.adopt(&self.ledger);
                }
            }
        }
        Ok(())
    }

    /// Sends what it sees, for the map and as votes, and uses it itself.
    pub(crate) fn report(&mut self, report: ObjectReport, now: Timestamp) -> anyhow::Result<()> {
        let report = Arc::new(report);
        for kind in [ReportKind::Detections, ReportKind::VoteDetections] {
            self.outbox.push((None, Payload::Report(kind, encode(&*report, Encoding::Cbor))));
            self.fuse(kind, &report, now)?;
        }
        Ok(())
    }

    fn fuse(&mut self, kind: ReportKind, report: &Arc<ObjectReport>, now: Timestamp) -> anyhow::Result<()> {
        self.aggregator.report(kind, report, now)?.map_or(Ok(()), |fused| self.publish(fused, now))
    }

    /// Publishes a round of its own, and keeps what the round says of vehicles in the lane of its epoch.
    fn publish(&mut self, fused: Fused, now: Timestamp) -> anyhow::Result<()> {
        let Fused { epoch, map, evidence, .. } = fused;
        evidence.iter().for_each(|vote| self.ledger.record(epoch.term, &epoch.leader, vote));
        *self.settled.entry(epoch).or_default() += evidence.len() as u64;
        if !evidence.is_empty() {
            self.share(None);
        }
        let map = map.context("PACE does not run")?;
        self.outbox.push((None, Payload::Map(encode(&map, Encoding::Cbor))));
        self.accept(map, now);
        Ok(())
    }

    /// Takes a map unless it was superseded.
    fn accept(&mut self, map: GlobalMap, now: Timestamp) {
        if self.gate.admit_map(&map).is_ok() {
            let (epoch, round) = (Epoch::new(map.epoch, map.aggregator.clone()), map.round);
            self.map = Some(map);
            self.handle(Input::Round { epoch, round }, now);
        }
    }

    fn share(&mut self, to: Option<NodeName>) {
        let (entries, marks) = (self.ledger.entries().collect(), self.ledger.marks().collect());
        let share = LedgerShare { schema: SCHEMA_VERSION, node: self.name.clone(), epoch: None, entries, marks };
        self.outbox.push((to, Payload::Evidence(encode(&share, Encoding::Cbor))));
    }

    fn carry_out(&mut self, effects: Vec<Effect>, now: Timestamp) {
        for effect in effects {
            match effect {
                Effect::Send { to, message } => {
                    if matches!(message.body, Body::Yield { .. }) {
                        self.aggregator.hold();
                    }
                    self.outbox.push((Some(to), Payload::Election(message.encode(Encoding::Cbor))));
                }
                Effect::Lead { epoch, first_round, first } => {
                    self.news.push(format!("{epoch} leads from #{first_round}"));
                    self.aggregator.lead(epoch, first_round, first, now);
                }
                Effect::StopPublishing { epoch } => {
                    self.news.push(format!("{epoch} stops"));
                    self.aggregator.step_down();
                }
                Effect::Prepare { .. } => self.handle(Input::Prepared, now),
                Effect::SendState { to } => self.share(Some(to)),
                // Nobody restarts here, and everybody sends to all.
                Effect::PersistTerm { .. } | Effect::Follow { .. } | Effect::Seek | Effect::AnnounceStandby { .. } => {}
            }
        }
    }
}
