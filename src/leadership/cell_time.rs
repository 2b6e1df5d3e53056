//! The cell's time: one time scale for all stamps on the wire, independent of errors in the nodes'
//! wall clocks.
//!
//! A node's *steady clock* never steps; it times everything inside the node. Its *wall clock* may
//! be wrong and may step. Nodes compare their steady clocks by the stamps in election messages
//! ([`ClockStamps`], [`OffsetFilter`]). The leader keeps the cell's time as an offset from its
//! steady clock, and followers copy that time.
//!
//! - The leader follows the median of the candidates' wall clocks. If there are two middle values
//!   that differ, it uses the value nearer to the current cell time. One node's clock can therefore
//!   move the cell's time only in cells with a single candidate.
//! - A wall clock before [`EARLIEST`] counts as unset and is ignored.
//! - The parts of a node, such as observers, share its certificate and its machine's clock. Only the
//!   node's own statement counts, so that one certificate is one clock.
//! - A new leader continues with the old leader's time. Small errors are slewed away; larger errors
//!   make the cell's time jump.
//! - A follower's stamps don't depend on its own wall clock, so a step of that clock does no harm.
//!
//! Call [`CellTime::stamps`] for every message sent, [`CellTime::receive`] and then
//! [`CellTime::follow`] for every message received, and [`CellTime::read_wall`] periodically.
//! [`CellTime::reading`] returns the result.

mod offset_filter;

use std::collections::BTreeMap;
use std::time::Duration;

pub use offset_filter::OffsetFilter;

use crate::leadership::election::{AnsweredStamps, ClockStamps, ElectionMessage};
use crate::leadership::rights::Rights;
use crate::leadership::timers::{CLOCK_MEMORY, MAX_CLOCK_SLEW, MIN_CLOCK_JUMP};
use crate::leadership::view::Leadership;
use crate::model::names::NodeName;
use crate::model::time::Timestamp;
use crate::wire::Role;
use offset_filter::{Exchange, Offset};

/// Wall clocks before this time, the beginning of 2025, count as unset.
pub const EARLIEST: Timestamp = Timestamp(1_735_689_600_000_000);

/// One node's estimate of the cell's time.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct ClockReading {
    /// The cell's time minus the node's steady clock, in microseconds.
    pub offset_us: i64,
    /// Maximum error of the offset in microseconds; `None` while the node uses its own wall clock.
    pub error_us: Option<u32>,
}

/// Clock event for the log.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ClockEvent {
    /// The node's wall clock stepped by this many microseconds.
    WallStepped(i64),
    /// The leader made the cell's time jump by this many microseconds.
    CellJumped(i64),
}

/// A clock with a large error.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct WrongClock<'a> {
    /// The other node that has this clock; `None` for this node's own clock.
    pub node: Option<&'a NodeName>,
    /// Error of the clock in microseconds, positive if the clock is ahead.
    pub error_us: i64,
    /// True if the cell's time follows this clock or another wrong clock; the error is then
    /// measured against the other clocks.
    pub is_cell_wrong: bool,
    /// False if another clock may be the wrong one instead.
    pub is_certain: bool,
}

/// One node's state of all clocks in the cell.
#[derive(Debug, Clone)]
pub struct CellTime {
    /// True if the node's own wall clock counts.
    is_candidate: bool,
    /// The node's wall clock minus its steady clock; `None` before the first call of `read_wall`.
    wall_offset_us: Option<i64>,
    peers: BTreeMap<NodeName, PeerClock>,
    reading: Option<ClockReading>,
    read_at: Option<Timestamp>,
}

/// The clock of another node.
#[derive(Debug, Clone)]
struct PeerClock {
    run: u64,
    /// False for a node of an earlier version, which sends no stamps.
    has_stamps: bool,
    last: AnsweredStamps,
    filter: OffsetFilter,
    /// The node's wall clock minus its steady clock, if its wall clock was set.
    wall_offset_us: Option<i64>,
    /// True if the node may lead: its wall clock counts for the cell's time.
    is_candidate: bool,
    /// The cell's time minus the node's steady clock, as estimated by that node.
    cell_offset_us: Option<i64>,
}

impl PeerClock {
    /// The peer's wall clock minus this node's steady clock.
    fn wall_offset_us(&self, now: Timestamp) -> Option<i64> {
        Some(
            self.wall_offset_us?
                .saturating_add(self.filter.best(now)?.offset_us),
        )
    }
}

impl CellTime {
    /// Initial state without any clock offsets. The node's own wall clock counts only if its role
    /// may lead.
    pub fn new(role: Role) -> Self {
        Self {
            is_candidate: role != Role::Cav,
            wall_offset_us: None,
            peers: BTreeMap::new(),
            reading: None,
            read_at: None,
        }
    }

    /// The cell's time, or the node's own wall clock until a cell time is available.
    pub fn reading(&self) -> ClockReading {
        let own = ClockReading {
            offset_us: self.wall_offset_us.unwrap_or_default(),
            error_us: None,
        };
        self.reading.unwrap_or(own)
    }

    /// Clocks that differ by [`MIN_CLOCK_JUMP`] or more from the time on which most clocks agree.
    /// The node's own clock has no name. If no two clocks agree, any of them may be the wrong one.
    pub fn wrong_clocks(&self, now: Timestamp) -> Vec<WrongClock<'_>> {
        let errors = self.wall_errors(now);
        let agree = |time: i64| {
            errors
                .iter()
                .filter(|(_, us)| us.saturating_sub(time).abs() < micros(MIN_CLOCK_JUMP))
                .count()
        };
        // The cell's time, unless more clocks agree on another time.
        let times = [0].into_iter().chain(errors.iter().map(|(_, us)| *us));
        let agreed = times
            .rev()
            .max_by_key(|time| agree(*time))
            .unwrap_or_default();
        let is_cell_wrong = agreed.abs() >= micros(MIN_CLOCK_JUMP);
        let is_certain = agree(agreed) > 1;
        let time = if is_cell_wrong && is_certain {
            agreed
        } else {
            0
        };
        let errors = errors
            .into_iter()
            .map(|(node, us)| (node, us.saturating_sub(time)));
        let wrong = errors.filter(|(_, us)| us.abs() >= micros(MIN_CLOCK_JUMP));
        wrong
            .map(|(node, error_us)| WrongClock {
                node,
                error_us,
                is_cell_wrong: time != 0,
                is_certain,
            })
            .collect()
    }

    /// Errors of all available wall clocks in microseconds, positive if ahead of the cell's time:
    /// first the node's own (without a name), then those of the other nodes, without their parts.
    /// Empty until the node has a cell time.
    pub fn wall_errors(&self, now: Timestamp) -> Vec<(Option<&NodeName>, i64)> {
        let Some(cell) = self.reading.map(|reading| reading.offset_us) else {
            return Vec::new();
        };
        let own = self.wall_offset_us.map(|wall| (None, wall));
        let others = self
            .nodes()
            .filter_map(|(name, peer)| Some((Some(name), peer.wall_offset_us(now)?)));
        own.into_iter()
            .chain(others)
            .map(|(name, wall)| (name, wall.saturating_sub(cell)))
            .collect()
    }

    /// Stamps for a message to a node, sent at `now` by the steady clock.
    pub fn stamps(&self, to: &NodeName, now: Timestamp) -> ClockStamps {
        let lately =
            |peer: &&PeerClock| peer.has_stamps && now.since(peer.last.received_us) < CLOCK_MEMORY;
        let wall = self.wall_offset_us.map(|offset| now.shifted(offset));
        ClockStamps {
            sent_us: now,
            answers: self.peers.get(to).filter(lately).map(|peer| peer.last),
            wall_us: wall.filter(|wall| *wall >= EARLIEST),
            cell_us: self.reading.map(|reading| now.shifted(reading.offset_us)),
        }
    }

    /// Processes the stamps of a message that arrived at `now`. The transport must verify the
    /// sender and its rights, because only the wall clocks of possible leaders count.
    pub fn receive(&mut self, message: &ElectionMessage, rights: Rights, now: Timestamp) {
        let stamps = message.clock.as_deref().copied().unwrap_or(ClockStamps {
            sent_us: now,
            answers: None,
            wall_us: None,
            cell_us: None,
        });
        let role = rights.limit_role(message.candidacy.role);
        let wall = stamps.wall_us.filter(|wall| *wall >= EARLIEST);
        let last = AnsweredStamps {
            sent_us: stamps.sent_us,
            received_us: now,
        };
        let new = || PeerClock {
            run: message.run,
            has_stamps: message.clock.is_some(),
            last,
            filter: OffsetFilter::default(),
            wall_offset_us: None,
            is_candidate: false,
            cell_offset_us: None,
        };
        let peer = self.peers.entry(message.from.clone()).or_insert_with(new);
        if peer.run != message.run {
            *peer = new();
        }
        let offset = |time: Timestamp| time.micros_from(stamps.sent_us);
        peer.last = last;
        peer.wall_offset_us = wall.map(offset);
        peer.is_candidate = role != Role::Cav;
        peer.cell_offset_us = stamps.cell_us.map(offset);
        if let Some(AnsweredStamps {
            sent_us,
            received_us,
        }) = stamps.answers
        {
            peer.filter.observe(Exchange {
                t1: sent_us,
                t2: received_us,
                t3: stamps.sent_us,
                t4: now,
            });
        }
    }

    /// Adopts the time of the leader that this node follows. Call it after each message and each
    /// change of leader.
    pub fn follow(&mut self, leadership: &Leadership, now: Timestamp) {
        let leader = leadership.leader().filter(|_| !leadership.is_leading());
        let Some(leader) = leader.and_then(|leader| self.peers.get(leader)) else {
            return;
        };
        if !leader.has_stamps {
            self.reading = None;
        } else if let (Some(cell_offset), Some(offset)) =
            (leader.cell_offset_us, leader.filter.best(now))
        {
            let Offset {
                offset_us,
                error_us,
            } = offset;
            let offset_us = cell_offset.saturating_add(offset_us);
            self.reading = Some(ClockReading {
                offset_us,
                error_us: Some(error_us),
            });
        }
    }

    /// Removes the clock of a node that is not trusted any more. If that node led, its successor
    /// uses the other nodes' clocks.
    pub fn remove(&mut self, name: &NodeName) {
        self.peers.remove(name);
    }

    /// Reads the wall clock, which is `wall_offset_us` ahead of the steady clock. A leader adjusts
    /// the cell's time.
    pub fn read_wall(
        &mut self,
        wall_offset_us: i64,
        leadership: &Leadership,
        now: Timestamp,
    ) -> Vec<ClockEvent> {
        let mut events = Vec::new();
        if let Some(before) = self.wall_offset_us.replace(wall_offset_us) {
            let step = wall_offset_us.saturating_sub(before);
            events.extend(
                (step.saturating_abs() >= MIN_LOGGED_STEP_US)
                    .then_some(ClockEvent::WallStepped(step)),
            );
        }
        let elapsed = self
            .read_at
            .replace(now)
            .map_or(Duration::ZERO, |before| now.since(before));
        self.peers
            .retain(|_, peer| now.since(peer.last.received_us) < CLOCK_MEMORY);
        if leadership.is_leading() {
            events.extend(self.lead(elapsed, now));
        }
        events
    }

    /// Moves the cell's time towards the candidates' clocks and returns a jump if one was needed.
    fn lead(&mut self, elapsed: Duration, now: Timestamp) -> Option<ClockEvent> {
        let before = self.reading.map(|reading| reading.offset_us);
        let start = before.or(self.wall_offset_us)?;
        let mut walls = self.walls(now);
        walls.sort_unstable();
        let middle = walls
            .len()
            .checked_sub(1)
            .map(|last| (walls.get(last / 2), walls.get(last.div_ceil(2))));
        let target = match middle {
            Some((Some(low), Some(high))) => start.clamp(*low, *high),
            _ => start,
        };
        let error = target.saturating_sub(start);
        let is_jump = before.is_none() || error.saturating_abs() >= micros(MIN_CLOCK_JUMP);
        let most = micros(elapsed) * MAX_CLOCK_SLEW / 1_000_000;
        let offset_us = if is_jump {
            target
        } else {
            start.saturating_add(error.clamp(-most, most))
        };
        self.reading = Some(ClockReading {
            offset_us,
            error_us: Some(0),
        });
        (is_jump && error.saturating_abs() >= MIN_LOGGED_STEP_US)
            .then_some(ClockEvent::CellJumped(error))
    }

    /// The wall clocks of all candidates that were set, as offsets from this node's steady clock.
    fn walls(&self, now: Timestamp) -> Vec<i64> {
        let is_set = |offset: &i64| self.is_candidate && now.shifted(*offset) >= EARLIEST;
        let candidates = self.nodes().filter(|(_, peer)| peer.is_candidate);
        let others = candidates.filter_map(|(_, peer)| peer.wall_offset_us(now));
        self.wall_offset_us
            .filter(is_set)
            .into_iter()
            .chain(others)
            .collect()
    }

    /// The other nodes, without their parts.
    fn nodes(&self) -> impl Iterator<Item = (&NodeName, &PeerClock)> {
        self.peers.iter().filter(|(name, _)| !name.is_part())
    }
}

/// Minimum step of a clock that is logged, in microseconds; smaller steps are noise from reading
/// two clocks.
const MIN_LOGGED_STEP_US: i64 = 5_000;

fn micros(duration: Duration) -> i64 {
    i64::try_from(duration.as_micros()).unwrap_or(i64::MAX)
}

#[cfg(test)]
mod tests;
