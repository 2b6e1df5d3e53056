//! The faults of each scenario, and their bars.

use std::time::Duration;

/// Something done to a cell.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Fault {
    /// SIGKILL.
    Kill(&'static [Who]),
    /// The edge's process is started again, with its files.
    RestartEdge,
    /// SIGSTOP to the edge.
    PauseEdge,
    /// SIGCONT to the edge.
    ResumeEdge,
    /// SIGKILL to mosquitto.
    KillExternalBroker,
    /// So many processes compete for the processor.
    Busy(usize),
    /// Programs flood the standby's door, from now on.
    FloodStandby,
    /// The network falls in two.
    Split,
    /// The leader's packets to one vehicle are lost.
    CutOneWay,
    /// A node gets another address.
    Readdress(Who),
    /// So many percent of all packets are lost.
    Lose(u8),
    /// The network is whole.
    Heal(Cure),
}

/// Part that is healed.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Cure {
    Split,
    OneWay,
    Loss,
}

/// A node, selected by its present role.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Who {
    Edge,
    Leader,
    Standby,
}

/// A fault and the time watched after it.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Step {
    pub(crate) fault: Fault,
    pub(crate) watch: Duration,
    /// Fewest and most new leaderships that follow.
    pub(crate) changes: (usize, usize),
    /// True if gap and missed rounds count for the trial.
    pub(crate) measured: bool,
}

/// Requirements of a scenario in addition to loopback.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Needs {
    Loopback,
    Mosquitto,
    /// Mosquitto, and leave to go on without it.
    MosquittoAndFallback,
    /// Network namespaces.
    Namespaces,
    /// Network namespaces and nftables.
    PacketFilter,
}

/// Bar of the gap.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum GapBar {
    /// The phase has no bar.
    None,
    /// The process is gone and its port refuses.
    Killed,
    /// The node does not receive messages any more.
    Silent,
}

/// A course of events that is tried again and again, each time with a fresh cell.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Scenario {
    pub(crate) name: &'static str,
    pub(crate) needs: Needs,
    pub(crate) least_nodes: usize,
    /// True if the edge is there at the start.
    pub(crate) edge: bool,
    pub(crate) script: &'static [Step],
    pub(crate) gap: GapBar,
    /// True if vehicles vote beforehand, and their reputations must not change.
    pub(crate) votes: bool,
    /// True if no measured vehicle may miss a round or get one twice.
    pub(crate) seamless: bool,
}

impl Scenario {
    /// True if it does something to the standby, which then must have been named.
    pub(crate) fn needs_standby(&self) -> bool {
        self.script.iter().any(|step| match step.fault {
            Fault::FloodStandby | Fault::Readdress(Who::Standby) => true,
            Fault::Kill(victims) => victims.iter().any(|who| matches!(who, Who::Standby)),
            _ => false,
        })
    }
}

impl GapBar {
    /// The bar in a cell of so many nodes, for the 99th percentile.
    pub(crate) fn limit(self, nodes: usize) -> Option<Duration> {
        match self {
            Self::None => None,
            Self::Killed if nodes >= 32 => Some(Duration::from_millis(300)),
            Self::Killed => Some(Duration::from_millis(200)),
            Self::Silent => Some(Duration::from_millis(400)),
        }
    }
}

const BASE: Scenario = Scenario {
    name: "",
    needs: Needs::Loopback,
    least_nodes: 2,
    edge: true,
    script: &[],
    gap: GapBar::None,
    votes: false,
    seamless: false,
};

/// All scenarios in the order of running.
pub(crate) const SCENARIOS: [Scenario; 15] = [
    Scenario {
        name: "edge_sigkill",
        script: &[measured(Fault::Kill(&[Who::Edge]), 2, 1, 1)],
        gap: GapBar::Killed,
        ..BASE
    },
    Scenario {
        name: "edge_sigkill_door_flood",
        least_nodes: 3,
        script: &[
            step(Fault::FloodStandby, 3, 0, 0),
            measured(Fault::Kill(&[Who::Edge]), 3, 1, 1),
        ],
        gap: GapBar::Killed,
        ..BASE
    },
    Scenario {
        name: "edge_sigstop_sigcont",
        script: &[
            measured(Fault::PauseEdge, 3, 1, 1),
            step(Fault::ResumeEdge, 9, 1, 2),
        ],
        gap: GapBar::Silent,
        ..BASE
    },
    Scenario {
        name: "edge_and_standby_sigkill",
        least_nodes: 3,
        script: &[measured(Fault::Kill(&[Who::Standby, Who::Edge]), 2, 1, 1)],
        gap: GapBar::Killed,
        ..BASE
    },
    Scenario {
        name: "leader_cav_sigkill",
        least_nodes: 3,
        edge: false,
        script: &[measured(Fault::Kill(&[Who::Leader]), 2, 1, 1)],
        gap: GapBar::Killed,
        ..BASE
    },
    Scenario {
        name: "edge_restart",
        script: &[
            step(Fault::Kill(&[Who::Edge]), 2, 1, 1),
            measured(Fault::RestartEdge, 8, 1, 1),
        ],
        seamless: true,
        ..BASE
    },
    Scenario {
        name: "edge_sigkill_after_votes",
        script: &[measured(Fault::Kill(&[Who::Edge]), 4, 1, 1)],
        gap: GapBar::Killed,
        votes: true,
        ..BASE
    },
    Scenario {
        name: "external_broker_sigkill",
        needs: Needs::MosquittoAndFallback,
        script: &[measured(Fault::KillExternalBroker, 4, 0, 1)],
        gap: GapBar::Killed,
        ..BASE
    },
    Scenario {
        name: "edge_sigkill_external_broker",
        needs: Needs::Mosquitto,
        script: &[measured(Fault::Kill(&[Who::Edge]), 2, 1, 1)],
        gap: GapBar::Killed,
        ..BASE
    },
    Scenario {
        name: "six_busy_loops",
        script: &[measured(Fault::Busy(6), 10, 0, 0)],
        ..BASE
    },
    Scenario {
        name: "split_and_heal",
        needs: Needs::Namespaces,
        script: &[
            measured(Fault::Split, 4, 1, 1),
            step(Fault::Heal(Cure::Split), 10, 0, 2),
        ],
        gap: GapBar::Silent,
        ..BASE
    },
    Scenario {
        name: "one_way_loss",
        needs: Needs::Namespaces,
        least_nodes: 3,
        script: &[
            measured(Fault::CutOneWay, 6, 0, 2),
            step(Fault::Heal(Cure::OneWay), 10, 0, 2),
        ],
        gap: GapBar::Silent,
        ..BASE
    },
    Scenario {
        name: "edge_new_address",
        needs: Needs::Namespaces,
        script: &[measured(Fault::Readdress(Who::Edge), 8, 0, 2)],
        gap: GapBar::Silent,
        ..BASE
    },
    Scenario {
        name: "standby_new_address",
        needs: Needs::Namespaces,
        least_nodes: 3,
        script: &[measured(Fault::Readdress(Who::Standby), 8, 0, 0)],
        gap: GapBar::Silent,
        ..BASE
    },
    Scenario {
        name: "loss_20_percent",
        needs: Needs::PacketFilter,
        script: &[
            measured(Fault::Lose(20), 10, 0, 0),
            step(Fault::Heal(Cure::Loss), 4, 0, 0),
        ],
        ..BASE
    },
];

const fn step(fault: Fault, seconds: u64, least_changes: usize, most_changes: usize) -> Step {
    Step {
        fault,
        watch: Duration::from_secs(seconds),
        changes: (least_changes, most_changes),
        measured: false,
    }
}

const fn measured(fault: Fault, seconds: u64, least_changes: usize, most_changes: usize) -> Step {
    Step {
        measured: true,
        ..step(fault, seconds, least_changes, most_changes)
    }
}
