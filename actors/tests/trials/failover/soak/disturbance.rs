//! What goes wrong in a minute.

use std::collections::BTreeSet;
use std::fmt::{self, Display, Formatter};
use std::time::Duration;

use ecod::model::names::NodeName;
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use serde::{Serialize, Serializer};
use tokio::time::sleep;

use crate::failover::cell::{Cell, EDGE};
use crate::failover::logs::LoggedTrouble;
use crate::failover::soak::intruder::{self, Intruder};

/// Fewest nodes with which every disturbance leaves a cell.
pub(super) const LEAST_NODES: usize = 5;

/// One fault, and for how many seconds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Disturbance {
    kind: Kind,
    seconds: u64,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Kind {
    KillEdge,
    KillLeaderAndStandby,
    KillVehicles,
    PauseEdge,
    Busy,
    Flood,
    BadInput,
    Split,
    OneWay,
    Loss,
}

/// All kinds; the last three take network namespaces.
const KINDS: [Kind; 10] = [
    Kind::KillEdge,
    Kind::KillLeaderAndStandby,
    Kind::KillVehicles,
    Kind::PauseEdge,
    Kind::Busy,
    Kind::Flood,
    Kind::BadInput,
    Kind::Split,
    Kind::OneWay,
    Kind::Loss,
];

const BUSY_LOOPS: usize = 4;
const LOSS_PERCENT: u8 = 20;

/// Troubles that a flood of a stranger's reports causes: they come from a foreign name, wait in queues, and their objects
/// are at no landmark.
const FLOOD_TROUBLES: [&str; 5] = [
    "overload",
    "not_permitted",
    "untimely",
    "clock_off",
    "misplaced",
];

/// Troubles that junk causes.
const JUNK_TROUBLES: [&str; 3] = ["malformed", "message_refused", "not_permitted"];

impl Disturbance {
    /// Any, as likely as every other.
    pub(super) fn draw(rng: &mut ChaCha8Rng, bridged: bool) -> Self {
        let kinds = if bridged {
            KINDS.len()
        } else {
            KINDS.len() - 3
        };
        Self {
            kind: KINDS[rng.random_range(0..kinds)],
            seconds: rng.random_range(3..=12),
        }
    }

    /// Does it, waits, and undoes it. Returns the nodes that it struck.
    pub(super) async fn carry_out(
        self,
        cell: &mut Cell,
        intruder: &mut Intruder,
        rng: &mut ChaCha8Rng,
    ) -> anyhow::Result<BTreeSet<NodeName>> {
        let lasts = Duration::from_secs(self.seconds);
        let mut struck = Vec::new();
        match self.kind {
            Kind::KillEdge => {
                struck.push(EDGE);
                kill(cell, &struck, lasts).await?;
            }
            Kind::KillLeaderAndStandby => {
                struck.push(cell.leader()?);
                // A leader without a standby is killed alone.
                struck.extend(cell.standby().ok());
                kill(cell, &struck, lasts).await?;
            }
            Kind::KillVehicles => {
                // The later half lives throughout, so that growth would show.
                let first = rng.random_range(1..cell.nodes() / 2);
                struck.extend([first, first + 1]);
                kill(cell, &struck, lasts).await?;
            }
            Kind::PauseEdge => {
                struck.push(EDGE);
                cell.pause(EDGE, true)?;
                sleep(lasts).await;
                cell.pause(EDGE, false)?;
            }
            Kind::Busy => {
                cell.busy(BUSY_LOOPS)?;
                sleep(lasts).await;
                cell.busy(0)?;
            }
            Kind::Flood => intruder.flood(lasts).await?,
            Kind::BadInput => intruder.send_junk(lasts).await?,
            Kind::Split => {
                struck.extend(0..cell.nodes());
                cell.split(true)?;
                sleep(lasts).await;
                cell.split(false)?;
            }
            Kind::OneWay => {
                struck.push(EDGE);
                struck.extend(cell.last_candidate());
                cell.cut_one_way(true)?;
                sleep(lasts).await;
                cell.cut_one_way(false)?;
            }
            Kind::Loss => {
                cell.lose(LOSS_PERCENT)?;
                sleep(lasts).await;
                cell.lose(0)?;
            }
        }
        Ok(cell.names(&struck))
    }

    /// True if a trouble follows from the fault, which struck these nodes.
    pub(super) fn explains(self, trouble: &LoggedTrouble, struck: &BTreeSet<NodeName>) -> bool {
        let about = trouble.about.as_deref();
        let is_struck = struck.iter().any(|node| Some(node.as_str()) == about);
        // A broker names clients without a certificate by their address; the intruder is the sole such client.
        let is_intruder =
            about.is_some_and(|about| about == intruder::NAME || about.ends_with(", programs"));
        let is_one_of = |kinds: &[&str]| kinds.contains(&&*trouble.kind);
        match self.kind {
            Kind::KillEdge
            | Kind::KillLeaderAndStandby
            | Kind::KillVehicles
            | Kind::PauseEdge
            | Kind::Split => trouble.kind == "node_missing" && is_struck,
            // The vehicle's own messages arrive, but logins at the edge's broker fail.
            Kind::OneWay => is_one_of(&["node_missing", "broker_unreachable"]) && is_struck,
            Kind::Flood => is_intruder && is_one_of(&FLOOD_TROUBLES),
            Kind::BadInput => is_intruder && is_one_of(&JUNK_TROUBLES),
            // Reports wait until TCP has sent the lost packets again.
            Kind::Loss => trouble.kind == "untimely",
            Kind::Busy => false,
        }
    }

    /// True if brokers retain a message of it, which nodes receive again over every new link.
    pub(super) fn is_retained(self) -> bool {
        matches!(self.kind, Kind::BadInput)
    }

    /// The fault without its length.
    pub(super) fn cause(self) -> &'static str {
        match self.kind {
            Kind::KillEdge => "the edge is killed",
            Kind::KillLeaderAndStandby => "leader and standby are killed",
            Kind::KillVehicles => "two vehicles are killed",
            Kind::PauseEdge => "the edge is stopped",
            Kind::Busy => "four busy loops",
            Kind::Flood => "5000 reports/s from one vehicle",
            Kind::BadInput => "junk to brokers and membership",
            Kind::Split => "the network is split",
            Kind::OneWay => "one vehicle receives no message of the edge",
            Kind::Loss => "a fifth of all packets is lost",
        }
    }
}

/// SIGKILL, and a new start with the same files.
async fn kill(cell: &mut Cell, victims: &[usize], lasts: Duration) -> anyhow::Result<()> {
    victims.iter().try_for_each(|victim| cell.kill(*victim))?;
    sleep(lasts).await;
    victims.iter().try_for_each(|victim| cell.restart(*victim))
}

impl Serialize for Disturbance {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_str(self)
    }
}

impl Display for Disturbance {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        write!(f, "{}, {} s", self.cause(), self.seconds)
    }
}
