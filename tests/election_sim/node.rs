//! One node of a simulated cell, and what can happen to it.

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::time::Duration;

use ecod::epoch::Epoch;
use ecod::leadership::election::{Election, ElectionConfig};
use ecod::leadership::health::HealthSample;
use ecod::leadership::links::{DataPlane, LinkState};
use ecod::leadership::node::{LeadershipNode, NodeSettings};
use ecod::leadership::round_filter::RoundFilter;
use ecod::leadership::{BrokerAddress, Leadership};
use ecod::names::NodeName;
use ecod::round::{RoundClose, RoundConfig, RoundTrigger};
use ecod::time::Timestamp;
use ecod::wire::NodeStatus;
use uuid::Uuid;

/// What can happen to a cell.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Fault {
    /// The process starts, with its disk.
    Start(usize),
    /// The process ends; others see broken connections and a refusing port when told so, else only silence.
    Kill { node: usize, seen: bool },
    /// The process is stopped in good order; its own word is the first that others hear of it.
    Leave(usize),
    /// The process does nothing for so many µs.
    Pause { node: usize, micros: u64 },
    /// The node's clock is set by so many µs.
    SetClock { node: usize, micros: i64 },
    /// Packets from one node to another are dropped.
    Cut { from: usize, to: usize },
    /// All links work again.
    Heal,
    /// So many percent of all packets are lost.
    Loss(u64),
    /// The node's broker breaks, or works again.
    Broker { node: usize, works: bool },
}

#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Event {
    Packet {
        from: usize,
        to: usize,
        life: u64,
        bytes: Vec<u8>,
    },
    Map {
        to: usize,
        life: u64,
        map: Map,
    },
    Tell {
        to: usize,
        life: u64,
        about: usize,
        about_life: u64,
        is_there: bool,
    },
    /// The gateway tries to connect to a broker.
    Connect {
        to: usize,
        life: u64,
        broker: usize,
    },
    /// A connection to a broker broke, and its port refuses.
    Refused {
        to: usize,
        life: u64,
        broker: usize,
    },
    Answered {
        to: usize,
        life: u64,
    },
    Broker {
        to: usize,
        life: u64,
        works: bool,
    },
    Timer {
        to: usize,
        life: u64,
        armed: u64,
    },
    Publish {
        to: usize,
        life: u64,
        term: u64,
    },
    Resume {
        to: usize,
    },
    Gossip,
    Fault(Fault),
}

/// A published map.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct Map {
    pub(crate) epoch: Epoch,
    pub(crate) round: u64,
    /// Time of its fusion by its publisher's clock.
    pub(crate) fused_at: Timestamp,
}

/// A round accepted by a node.
#[derive(Debug, Clone)]
pub(crate) struct Accepted {
    pub(crate) at: u64,
    pub(crate) round: u64,
}

/// One vehicle or edge box.
pub(crate) struct Node {
    pub(crate) name: NodeName,
    pub(crate) config: ElectionConfig,
    pub(crate) machine: Option<LeadershipNode>,
    pub(crate) filter: RoundFilter,
    /// The leadership as the machine told it.
    pub(crate) leadership: Leadership,
    pub(crate) accepted: Vec<Accepted>,
    pub(crate) refused: u64,
    pub(crate) life: u64,
    pub(crate) started_at: u64,
    pub(crate) persisted: u64,
    /// Difference between the node's clock, which may be set, and the time of the simulation, in µs.
    pub(crate) clock: i64,
    /// The same when the process started: its rounds are dated by a clock that nobody sets.
    pub(crate) steady_clock: i64,
    pub(crate) armed: u64,
    pub(crate) paused_until: u64,
    pub(crate) waiting: Vec<Event>,
    pub(crate) publishing: Option<(Epoch, u64)>,
    pub(crate) rounds: RoundTrigger,
    pub(crate) broker_works: bool,
    /// State of the links that the machine wants, by node.
    pub(crate) links: BTreeMap<usize, LinkState>,
    /// Nodes that the membership is about to tell of, and their runs.
    pub(crate) known: BTreeMap<usize, u64>,
    /// Nodes that the membership has told of, and their runs.
    pub(crate) members: BTreeMap<usize, u64>,
    pub(crate) packets: u64,
}

impl Node {
    pub(crate) fn new(index: usize, config: ElectionConfig) -> Self {
        Self {
            name: NodeName::new(format!("n{index:02}")).expect("valid name"),
            config,
            machine: None,
            filter: RoundFilter::new(0),
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
            waiting: Vec::new(),
            publishing: None,
            rounds: RoundTrigger::new(
                RoundConfig { close: RoundClose::Periodic, ..RoundConfig::default() },
                Timestamp(0),
            ),
            broker_works: true,
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
        (self.known, self.members, self.links) = Default::default();
        self.leadership = Leadership::default();
        self.filter = RoundFilter::new(self.persisted);
        let status = NodeStatus::starting(self.name.clone(), Uuid::from_u128(self.life.into()), self.config.role, "");
        let settings = NodeSettings {
            election: self.config.clone(),
            plane: DataPlane { external: None, embedded: true },
            round_period: Duration::from_millis(100),
            keeps_reputations: false,
            status,
        };
        let clock = Timestamp(now).shifted(self.clock);
        self.machine = Some(LeadershipNode::new(settings, self.persisted, &self.leadership, clock));
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

    /// Rounds that the fuser has closed by `now`.
    pub(crate) fn rounds_closed(&self, now: u64) -> u64 {
        (now - self.started_at) / 100_000
    }

    /// What broker, gateway and fuser answer.
    pub(crate) fn sample(&self) -> HealthSample {
        let links = self.links.iter().map(|(broker, state)| (address_of(*broker), *state)).collect();
        HealthSample { broker_serves: self.broker_works, links: Some(links), fuser_runs: true }
    }
}

/// Where a node's broker listens.
pub(crate) fn broker_of(index: usize) -> SocketAddr {
    SocketAddr::from(([10, 0, 0, u8::try_from(index + 1).expect("a small cell")], 1883))
}

pub(crate) fn address_of(index: usize) -> BrokerAddress {
    broker_of(index).into()
}
