//! One node of a simulated cell, and what can happen to it.

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::time::Duration;

use ecod::aggregator::round::{RoundClose, RoundConfig, RoundTrigger};
use ecod::leadership::election::{Election, ElectionConfig};
use ecod::leadership::health::HealthSample;
use ecod::leadership::ledger_resync::LedgerResync;
use ecod::leadership::links::{DataPlane, LinkState};
use ecod::leadership::node::{LeadershipNode, NodeSettings};
use ecod::leadership::round_filter::{PublisherFilter, RoundFilter};
use ecod::leadership::{BrokerAddress, Leadership};
use ecod::model::epoch::Epoch;
use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ecod::reputation::ReputationLedger;
use ecod::wire::{LedgerShare, NodeStatus};
use uuid::Uuid;

/// An event in a cell.
#[derive(Debug, Clone)]
pub(crate) enum Fault {
    /// The process starts, with its disk.
    Start(usize),
    /// The process ends. With `seen`, other nodes observe broken connections and a refusing port, otherwise only
    /// silence.
    Kill { node: usize, seen: bool },
    /// The process stops in order; its farewell is the first sign of it for the other nodes.
    Leave(usize),
    /// The process stalls for so many µs.
    Pause { node: usize, micros: u64 },
    /// The node's clock is set by so many µs.
    SetClock { node: usize, micros: i64 },
    /// Packets from one node to another are dropped.
    Cut { from: usize, to: usize },
    /// The node's datagrams, to it and of it, are lost for so many µs; connections work.
    Mute { node: usize, micros: u64 },
    /// All links work again.
    Heal,
    /// So many percent of all packets are lost.
    Loss(u64),
    /// The node's broker breaks, or works again.
    Broker { node: usize, works: bool },
    /// The node's fuser closes no rounds, or does again.
    Fuser { node: usize, works: bool },
    /// The node's gateway stops answering, or answers again.
    Gateway { node: usize, works: bool },
    /// A node cannot log in at another's broker, such as by a firewall or a certificate, until all links work again.
    NoLogin { node: usize, broker: usize },
}

/// Something that is going to happen.
#[derive(Debug, Clone)]
pub(crate) enum Event {
    /// At one node, if this run of it is still there.
    At {
        node: usize,
        life: u64,
        arrival: Arrival,
    },
    /// A process goes on after a pause.
    Resume {
        node: usize,
    },
    Gossip,
    Fault(Fault),
}

/// Something that reaches a running node.
#[derive(Debug, Clone)]
pub(crate) enum Arrival {
    Packet {
        from: usize,
        bytes: Vec<u8>,
    },
    /// A map for the node's broker to pass on.
    Relay {
        from: usize,
        map: Map,
    },
    Map {
        map: Map,
    },
    Share {
        share: Box<LedgerShare>,
    },
    /// News of the membership.
    Membership {
        about: usize,
        about_life: u64,
        is_there: bool,
    },
    /// The gateway tries to connect to a broker.
    Connect {
        broker: usize,
    },
    /// A connection to a broker broke, and its port refuses.
    Refused {
        broker: usize,
    },
    /// The parts answer.
    Answered,
    Broker {
        works: bool,
    },
    Timer {
        armed: u64,
    },
    /// A round is due.
    Publish {
        term: u64,
    },
    /// A publication period of reputations has passed.
    Keep,
}

#[derive(Debug, Clone)]
pub(crate) struct Map {
    pub(crate) epoch: Epoch,
    pub(crate) round: u64,
    /// Time of its fusion by its publisher's clock.
    pub(crate) fused_at: Timestamp,
    /// The same time on the simulation's clock, in µs.
    pub(crate) made_at: u64,
}

/// A round accepted by a node.
#[derive(Debug, Clone)]
pub(crate) struct Accepted {
    pub(crate) at: u64,
    pub(crate) epoch: Epoch,
    pub(crate) round: u64,
}

/// One vehicle or edge box.
pub(crate) struct Node {
    pub(crate) name: NodeName,
    pub(crate) config: ElectionConfig,
    pub(crate) machine: Option<LeadershipNode>,
    pub(crate) filter: RoundFilter,
    /// The rule of its broker.
    pub(crate) publishers: PublisherFilter,
    pub(crate) resync: LedgerResync,
    pub(crate) ledger: ReputationLedger,
    /// The ledger on disk.
    pub(crate) saved: ReputationLedger,
    /// True if evidence is signed.
    pub(crate) signs: bool,
    /// True if ledgers survive the process; terms do in any case.
    pub(crate) has_disk: bool,
    /// The leadership as reported by the machine.
    pub(crate) leadership: Leadership,
    pub(crate) accepted: Vec<Accepted>,
    pub(crate) refused: u64,
    pub(crate) life: u64,
    pub(crate) started_at: u64,
    pub(crate) persisted: u64,
    /// Difference between the node's clock, which may be set, and the time of the simulation, in µs.
    pub(crate) clock: i64,
    /// This difference at the start of the process. Its rounds are dated by a steady clock, which cannot be set.
    pub(crate) steady_clock: i64,
    pub(crate) armed: u64,
    pub(crate) paused_until: u64,
    pub(crate) mute_until: u64,
    pub(crate) waiting: Vec<Arrival>,
    pub(crate) publishing: Option<(Epoch, u64)>,
    /// The epoch in which its present leadership began: there it counts, also in terms that it renews.
    pub(crate) lane: Option<Epoch>,
    pub(crate) rounds: RoundTrigger,
    pub(crate) broker_works: bool,
    pub(crate) fuser_works: bool,
    pub(crate) gateway_works: bool,
    /// Rounds that the fuser closed before it last stopped or started, and when that was.
    pub(crate) closed: (u64, u64),
    /// State of the links that the machine requires, by node.
    pub(crate) links: BTreeMap<usize, LinkState>,
    /// Nodes that the membership is about to report, and their runs.
    pub(crate) known: BTreeMap<usize, u64>,
    /// Nodes that the membership has reported, and their runs.
    pub(crate) members: BTreeMap<usize, u64>,
    pub(crate) packets: u64,
}

impl Node {
    pub(crate) fn new(index: usize, config: ElectionConfig) -> Self {
        let name = NodeName::new(format!("n{index:02}")).expect("valid name");
        Self {
            resync: LedgerResync::new(name.clone(), TICKS_PER_SNAPSHOT),
            name,
            config,
            machine: None,
            filter: RoundFilter::new(0, Timestamp(0)),
            publishers: PublisherFilter::default(),
            ledger: ReputationLedger::default(),
            saved: ReputationLedger::default(),
            signs: false,
            has_disk: true,
            leadership: Leadership::default(),
            accepted: Vec::new(),
            refused: 0,
            life: 0,
            started_at: 0,
            persisted: 0,
            clock: 0,
            steady_clock: 0,
            armed: 0,
            paused_until: 0,
            mute_until: 0,
            waiting: Vec::new(),
            publishing: None,
            lane: None,
            rounds: RoundTrigger::new(
                RoundConfig {
                    close: RoundClose::Periodic,
                    ..RoundConfig::default()
                },
                Timestamp(0),
            ),
            broker_works: true,
            fuser_works: true,
            gateway_works: true,
            closed: (0, 0),
            links: BTreeMap::new(),
            known: BTreeMap::new(),
            members: BTreeMap::new(),
            packets: 0,
        }
    }

    /// Begins a run of the process, with its disk.
    pub(crate) fn start(&mut self, now: u64) {
        self.life += 1;
        self.started_at = now;
        self.paused_until = 0;
        self.steady_clock = self.clock;
        self.broker_works = true;
        self.fuser_works = true;
        self.gateway_works = true;
        self.closed = (0, now);
        self.publishers = PublisherFilter::default();
        self.lane = None;
        let resync = if self.signs {
            LedgerResync::signed
        } else {
            LedgerResync::new
        };
        self.resync = resync(self.name.clone(), TICKS_PER_SNAPSHOT);
        if !self.has_disk {
            self.saved = ReputationLedger::default();
        }
        self.ledger = self.saved.clone();
        self.resync
            .resume(&self.ledger, Timestamp(now).shifted(self.clock));
        self.known.clear();
        self.members.clear();
        self.links.clear();
        self.leadership = Leadership::default();
        self.filter = RoundFilter::new(self.persisted, Timestamp(now).shifted(self.clock));
        let status = NodeStatus::starting(
            self.name.clone(),
            Uuid::from_u128(self.life.into()),
            self.config.role,
            "",
        );
        let settings = NodeSettings {
            election: self.config.clone(),
            plane: DataPlane {
                external: None,
                embedded: true,
            },
            round_period: Duration::from_millis(100),
            keeps_reputations: true,
            status,
        };
        let clock = Timestamp(now).shifted(self.clock);
        self.machine = Some(LeadershipNode::new(
            settings,
            self.persisted,
            &self.leadership,
            clock,
        ));
    }

    pub(crate) fn election(&self) -> Option<&Election> {
        self.machine.as_ref().map(LeadershipNode::election)
    }

    pub(crate) fn leads(&self) -> bool {
        self.election().is_some_and(Election::is_leading)
    }

    pub(crate) fn leader(&self) -> Option<&NodeName> {
        self.election().and_then(Election::leader)
    }

    pub(crate) fn standby(&self) -> Option<&NodeName> {
        self.election().and_then(Election::standby)
    }

    /// Lets the fuser stop, or close rounds again.
    pub(crate) fn set_fuser(&mut self, works: bool, now: u64) {
        self.closed = (self.rounds_due(now), now);
        self.fuser_works = works;
    }

    /// Rounds that the fuser has closed by `now`, published or not.
    pub(crate) fn rounds_due(&self, now: u64) -> u64 {
        let (closed, since) = self.closed;
        if self.fuser_works {
            closed + (now - since) / 100_000
        } else {
            closed
        }
    }

    /// Answers of broker, gateway and fuser.
    pub(crate) fn sample(&self) -> HealthSample {
        let links = || {
            self.links
                .iter()
                .map(|(broker, state)| (address_of(*broker), *state))
                .collect()
        };
        let links = self.gateway_works.then(links);
        HealthSample {
            broker_serves: self.broker_works,
            links,
            fuser_runs: true,
            rejects_reports: false,
            contradicts: false,
            certificate_ends: false,
        }
    }
}

/// Publication periods between two times that a leader shares everything.
const TICKS_PER_SNAPSHOT: u32 = 4;

/// Where a node's broker listens.
pub(crate) fn broker_of(index: usize) -> SocketAddr {
    SocketAddr::from((
        [10, 0, 0, u8::try_from(index + 1).expect("a small cell")],
        1883,
    ))
}

pub(crate) fn address_of(index: usize) -> BrokerAddress {
    broker_of(index).into()
}
