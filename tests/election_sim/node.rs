//! One node of a simulated cell, and what can happen to it.

use std::collections::BTreeSet;

use ecod::epoch::{Epoch, EpochGate};
use ecod::leadership::election::{Election, ElectionConfig};
use ecod::names::NodeName;
use ecod::round::{RoundClose, RoundConfig, RoundTrigger};
use ecod::time::Timestamp;

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
    Packet { to: usize, life: u64, bytes: Vec<u8> },
    Map { to: usize, life: u64, epoch: Epoch, round: u64 },
    Tell { to: usize, life: u64, about: usize, news: News },
    Prepared { to: usize, life: u64 },
    Broker { to: usize, life: u64, works: bool },
    Timer { to: usize, life: u64, armed: u64 },
    Publish { to: usize, life: u64, term: u64 },
    Resume { to: usize },
    Gossip,
    Fault(Fault),
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum News {
    Alive,
    Down,
    Gone,
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
    pub(crate) election: Option<Election>,
    pub(crate) accepted: Vec<Accepted>,
    pub(crate) stale_refused: u64,
    pub(crate) life: u64,
    pub(crate) persisted: u64,
    pub(crate) clock: i64,
    pub(crate) armed: u64,
    pub(crate) paused_until: u64,
    pub(crate) waiting: Vec<Event>,
    pub(crate) publishing: Option<(Epoch, u64)>,
    pub(crate) rounds: RoundTrigger,
    pub(crate) gate: EpochGate,
    pub(crate) elected_refused_since: Option<u64>,
    pub(crate) known: BTreeSet<usize>,
    pub(crate) packets: u64,
}

impl Node {
    pub(crate) fn new(index: usize, config: ElectionConfig) -> Self {
        Self {
            name: NodeName::new(format!("n{index:02}")).expect("valid name"),
            config,
            election: None,
            accepted: Vec::new(),
            stale_refused: 0,
            life: 0,
            persisted: 0,
            clock: 0,
            armed: 0,
            paused_until: 0,
            waiting: Vec::new(),
            publishing: None,
            rounds: RoundTrigger::new(
                RoundConfig { close: RoundClose::Periodic, ..RoundConfig::default() },
                Timestamp(0),
            ),
            gate: EpochGate::default(),
            elected_refused_since: None,
            known: BTreeSet::new(),
            packets: 0,
        }
    }

    pub(crate) fn leads(&self) -> bool {
        self.election.as_ref().is_some_and(Election::is_leading)
    }

    pub(crate) fn leader(&self) -> Option<&NodeName> {
        self.election.as_ref().and_then(Election::leader)
    }
}
