//! What goes wrong in a minute.

use std::fmt::{self, Display, Formatter};
use std::time::Duration;

use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use tokio::time::sleep;

use crate::failover::cell::{Cell, EDGE};
use crate::failover::soak::intruder::Intruder;

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

    /// Does it, waits, and undoes it.
    pub(super) async fn carry_out(
        self,
        cell: &mut Cell,
        intruder: &mut Intruder,
        rng: &mut ChaCha8Rng,
    ) -> anyhow::Result<()> {
        let lasts = Duration::from_secs(self.seconds);
        match self.kind {
            Kind::KillEdge => kill(cell, &[EDGE], lasts).await,
            Kind::KillLeaderAndStandby => {
                let victims: Vec<_> = [cell.leader()?]
                    .into_iter()
                    .chain(cell.standby().ok())
                    .collect();
                kill(cell, &victims, lasts).await
            }
            Kind::KillVehicles => {
                // The later half lives throughout, so that growth would show.
                let first = rng.random_range(1..cell.nodes() / 2);
                kill(cell, &[first, first + 1], lasts).await
            }
            Kind::PauseEdge => {
                cell.pause(EDGE, true)?;
                sleep(lasts).await;
                cell.pause(EDGE, false)
            }
            Kind::Busy => {
                cell.busy(BUSY_LOOPS)?;
                sleep(lasts).await;
                cell.busy(0)
            }
            Kind::Flood => intruder.flood(lasts).await,
            Kind::BadInput => intruder.send_junk(lasts).await,
            Kind::Split => {
                cell.split(true)?;
                sleep(lasts).await;
                cell.split(false)
            }
            Kind::OneWay => {
                cell.cut_one_way(true)?;
                sleep(lasts).await;
                cell.cut_one_way(false)
            }
            Kind::Loss => {
                cell.lose(LOSS_PERCENT)?;
                sleep(lasts).await;
                cell.lose(0)
            }
        }
    }
}

/// SIGKILL, and a new start with the same files.
async fn kill(cell: &mut Cell, victims: &[usize], lasts: Duration) -> anyhow::Result<()> {
    victims.iter().try_for_each(|victim| cell.kill(*victim))?;
    sleep(lasts).await;
    victims.iter().try_for_each(|victim| cell.restart(*victim))
}

impl Display for Disturbance {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        let what = match self.kind {
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
        };
        write!(f, "{what}, {} s", self.seconds)
    }
}
