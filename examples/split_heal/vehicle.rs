//! One vehicle: the parts of a node without clock, sockets and actors.

use std::collections::{BTreeMap, VecDeque};
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use anyhow::Context;
use ecod::aggregator::{Aggregator, Fused, FusionConfig};
use ecod::leadership::election::{ElectionConfig, ElectionMessage};
use ecod::leadership::health::HealthSample;
use ecod::leadership::ledger_resync::LedgerResync;
use ecod::leadership::links::{DataPlane, LinkState};
use ecod::leadership::node::{Effect, Input, LeadershipNode, NodeSettings, SeenMember};
use ecod::leadership::round_filter::{Origin, RoundFilter};
use ecod::leadership::{Leadership, Rights};
use ecod::model::epoch::Epoch;
use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ecod::perception::landmark::Landmark;
use ecod::reputation::ReputationLedger;
use ecod::wire::{
    Encoding, GlobalMap, LedgerShare, Limits, NodeStatus, ObjectReport, ReportKind, Role, decode,
    decode_report, decode_share, encode,
};
use uuid::Uuid;

/// Messages in transit between vehicles.
#[derive(Debug, Clone)]
pub(crate) enum Payload {
    Election(Vec<u8>),
    Report(ReportKind, Vec<u8>),
    Map(Vec<u8>),
    Evidence(Vec<u8>),
}

pub(crate) struct Vehicle {
    pub(crate) name: NodeName,
    index: u8,
    machine: LeadershipNode,
    pub(crate) leadership: Leadership,
    filter: RoundFilter,
    resync: LedgerResync,
    tick_at: Timestamp,
    aggregator: Aggregator,
    pub(crate) ledger: ReputationLedger,
    pub(crate) members: BTreeMap<NodeName, SeenMember>,
    rounds_due: u64,
    /// Time of the fuser's next timer; it may be early.
    alarm: Timestamp,
    /// The last map that the vehicle accepted.
    pub(crate) map: Option<GlobalMap>,
    /// Votes that the vehicle settled in each of its leaderships.
    pub(crate) settled: BTreeMap<Epoch, u64>,
    /// Messages to be sent, to one vehicle or to all.
    pub(crate) outbox: Vec<(Option<NodeName>, Payload)>,
    /// Events for the output.
    pub(crate) news: Vec<String>,
}

/// Time between two publications of changes of the ledger, and number of publications until the whole ledger is
/// published.
const SHARE_PERIOD: Duration = Duration::from_secs(1);
const SHARES_PER_SNAPSHOT: u32 = 3;

impl Vehicle {
    pub(crate) fn new(
        name: NodeName,
        index: u8,
        fusion: FusionConfig,
        landmarks: Vec<Landmark>,
        now: Timestamp,
    ) -> Self {
        let settings = NodeSettings {
            election: ElectionConfig::default(),
            plane: DataPlane {
                external: None,
                embedded: true,
            },
            round_period: Duration::from_secs_f64(fusion.round.period_s),
            keeps_reputations: true,
            status: NodeStatus::starting(name.clone(), Uuid::nil(), Role::Auto, ""),
        };
        let mut vehicle = Self {
            machine: LeadershipNode::new(settings, 0, &Leadership::default(), now),
            leadership: Leadership::default(),
            filter: RoundFilter::new(0, now),
            resync: LedgerResync::new(name.clone(), SHARES_PER_SNAPSHOT),
            tick_at: now + SHARE_PERIOD,
            aggregator: Aggregator::new_standby(fusion, landmarks, now),
            ledger: ReputationLedger::default(),
            members: BTreeMap::new(),
            rounds_due: 0,
            alarm: now,
            map: None,
            settled: BTreeMap::new(),
            outbox: Vec::new(),
            news: Vec::new(),
            name,
            index,
        };
        vehicle.handle(
            Input::OwnBroker {
                address: Some(broker(index)),
            },
            now,
        );
        vehicle.handle(
            Input::LinkChanged {
                broker: broker(index).into(),
                state: LinkState::Up,
            },
            now,
        );
        vehicle
    }

    pub(crate) fn as_member(&self) -> SeenMember {
        let broker = Some(broker(self.index).into());
        SeenMember {
            name: self.name.clone(),
            run: 1,
            broker,
            is_on_this_machine: false,
        }
    }

    /// Processes an event of the membership about another vehicle.
    pub(crate) fn notice(&mut self, member: SeenMember, is_there: bool, now: Timestamp) {
        if is_there {
            self.members.insert(member.name.clone(), member.clone());
            self.handle(Input::MemberAlive { member }, now);
        } else {
            self.members.remove(&member.name);
            self.handle(Input::MemberDown { name: member.name }, now);
        }
    }

    pub(crate) fn tick(&mut self, now: Timestamp) -> anyhow::Result<()> {
        if now >= self.machine.next_deadline() {
            self.handle(Input::Wake, now);
        }
        if now >= self.tick_at {
            self.tick_at = now + SHARE_PERIOD;
            let shares = self
                .resync
                .tick(&mut self.ledger, &self.leadership, now)
                .shares;
            self.share(&shares);
        }
        self.alarm = self.alarm.min(self.aggregator.deadline());
        if now < self.alarm {
            return Ok(());
        }
        self.rounds_due += 1;
        let fused = self.aggregator.tick(now);
        self.alarm = self.aggregator.deadline();
        fused.map_or(Ok(()), |fused| self.publish(fused, now))
    }

    pub(crate) fn receive(
        &mut self,
        from: &NodeName,
        payload: &Payload,
        now: Timestamp,
    ) -> anyhow::Result<()> {
        let limits = Limits::default();
        match payload {
            Payload::Election(bytes) => {
                let message = ElectionMessage::decode(bytes)?;
                self.handle(
                    Input::Receive {
                        from: from.clone(),
                        rights: Rights::ALL,
                        message,
                    },
                    now,
                );
            }
            Payload::Report(kind, bytes) => {
                self.fuse(*kind, &Arc::new(decode_report(bytes, from, &limits)?), now)?;
            }
            Payload::Map(bytes) => self.accept(decode(bytes, &limits)?, now),
            Payload::Evidence(bytes) => self.merge(&decode_share(bytes, from, &limits)?, now),
        }
        Ok(())
    }

    /// Sends the vehicle's detections, for the map and as votes, and passes them to its own aggregator.
    pub(crate) fn report(&mut self, report: ObjectReport, now: Timestamp) -> anyhow::Result<()> {
        let report = Arc::new(report);
        for kind in [ReportKind::Detections, ReportKind::VoteDetections] {
            self.outbox.push((
                None,
                Payload::Report(kind, encode(&*report, Encoding::Cbor)),
            ));
            self.fuse(kind, &report, now)?;
        }
        Ok(())
    }

    fn fuse(
        &mut self,
        kind: ReportKind,
        report: &Arc<ObjectReport>,
        now: Timestamp,
    ) -> anyhow::Result<()> {
        self.aggregator
            .report(kind, report, now)?
            .map_or(Ok(()), |fused| self.publish(fused, now))
    }

    /// Publishes a round of this vehicle, and adds the round's evidence to the lane of its epoch.
    fn publish(&mut self, fused: Fused, now: Timestamp) -> anyhow::Result<()> {
        let Fused {
            epoch,
            map,
            evidence,
            ..
        } = fused;
        let shares = self.resync.record(&epoch, &evidence, &mut self.ledger);
        self.share(&shares);
        *self.settled.entry(epoch).or_default() += evidence.len() as u64;
        let map = map.context("PACE does not run")?;
        self.outbox
            .push((None, Payload::Map(encode(&map, Encoding::Cbor))));
        self.accept(map, now);
        Ok(())
    }

    /// Processes a map if the filter accepts it.
    fn accept(&mut self, map: GlobalMap, now: Timestamp) {
        let Ok(accepted) = self
            .filter
            .accept_map(&map, Origin::Claimed, now, &self.leadership)
        else {
            return;
        };
        self.map = Some(map);
        self.handle(
            Input::RoundAccepted {
                epoch: accepted.epoch,
                round: accepted.round,
            },
            now,
        );
    }

    fn merge(&mut self, share: &LedgerShare, now: Timestamp) {
        let candidates: Vec<_> = self.members.keys().cloned().collect();
        let Ok(merged) = self.resync.merge(
            share,
            &mut self.ledger,
            &candidates,
            &self.leadership,
            now,
            now,
        ) else {
            return;
        };
        if merged.is_news {
            self.aggregator.adopt(&self.ledger);
        }
        self.share(&merged.shares);
        self.handle(
            Input::EvidenceReceived {
                from: share.node.clone(),
            },
            now,
        );
    }

    fn share(&mut self, shares: &[LedgerShare]) {
        let shares = shares
            .iter()
            .map(|share| (None, Payload::Evidence(encode(share, Encoding::Cbor))));
        self.outbox.extend(shares);
    }

    fn handle(&mut self, input: Input, now: Timestamp) {
        let mut inputs = VecDeque::from([input]);
        while let Some(input) = inputs.pop_front() {
            for effect in self.machine.handle(input, now) {
                inputs.extend(self.carry_out(effect, now));
            }
        }
    }

    /// Carries out an effect of the machine, and returns the input that results from it.
    fn carry_out(&mut self, effect: Effect, now: Timestamp) -> Option<Input> {
        match effect {
            Effect::Send { to, message } => {
                self.outbox
                    .push((Some(to), Payload::Election(message.encode(Encoding::Cbor))));
            }
            Effect::PublishLeadership { leadership } => self.leadership = leadership,
            Effect::Lead {
                epoch,
                first_round,
                first,
            } => {
                self.news.push(format!("{epoch} leads from #{first_round}"));
                self.resync.lead(epoch.clone());
                self.aggregator.lead(epoch, first_round, first, now);
                self.share(&self.resync.snapshot(&self.ledger));
            }
            Effect::HoldRound => self.aggregator.hold(),
            Effect::StopPublishing { epoch } => {
                self.news.push(format!("{epoch} stops"));
                self.resync.step_down();
                self.aggregator.step_down();
            }
            Effect::SendSnapshot { .. } => self.share(&self.resync.snapshot(&self.ledger)),
            Effect::Observe => {
                let members = self.members.values().cloned().collect();
                return Some(Input::Observed {
                    rounds_due: self.rounds_due,
                    load_percent: 0,
                    members,
                });
            }
            Effect::AskParts => {
                let brokers = self
                    .members
                    .values()
                    .filter_map(|member| member.broker.clone())
                    .chain([broker(self.index).into()]);
                let links = brokers.map(|broker| (broker, LinkState::Up)).collect();
                let sample = HealthSample {
                    broker_serves: true,
                    links: Some(links),
                    fuser_runs: true,
                    rejects_reports: false,
                    contradicts: false,
                    certificate_ends: false,
                };
                return Some(Input::PartsAnswered { sample });
            }
            // In this simulation vehicles do not restart, and all messages reach all vehicles.
            Effect::PersistTerm { .. }
            | Effect::SetLinks { .. }
            | Effect::PublishStatus { .. }
            | Effect::CountImplausible { .. }
            | Effect::Log { .. } => {}
        }
        None
    }
}

fn broker(index: u8) -> SocketAddr {
    SocketAddr::from(([10, 0, 0, index], 1883))
}
