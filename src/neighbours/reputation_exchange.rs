//! The exchange of vehicle counts between cells: which vehicles a leader subscribes to, which
//! counts it publishes, and when.
//!
//! Each cell has one retained message per vehicle. The message states absolute counts of the cell's
//! own evidence, and does not include counts received from other cells. This module sends no
//! messages: [`ReputationExchange::next`] returns the steps to carry out.
//!
//! - *In.* A leader subscribes to all cells' counts of the vehicles that are present, and only of
//!   these.
//! - *Out.* The counts of a present vehicle are sent when they contain enough news; those of a
//!   vehicle that has left when they differ at all.
//! - *Kept.* Counts are pending until the region has them, which the leader detects when its own
//!   message comes back. A broker may forward a message and still fail to store it, so the leader
//!   checks the region once more some seconds later. Without a connection only the latest counts of
//!   each vehicle are pending.
//! - *Monotonic.* A leader may have fewer counts than the region, for example after losing its
//!   disk. It therefore first reads its cell's earlier message, and then sends the larger of every
//!   count. If the earlier message arrives late, the leader corrects its own message.
//! - *News.* A cell's first counts of a present vehicle are due at once; further counts are
//!   gathered for a second.
//! - *Resets.* A leader that missed a reset of its cell's evidence adds to the region's counts only
//!   the votes that it counts from then on.

use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use crate::model::names::NodeName;
use crate::model::time::Timestamp;
use crate::reputation::{CellCounts, ForeignReputations, MAX_FOREIGN_VEHICLES};
use crate::wire::{CellReputation, ReputationTopic};

/// Minimum time between two messages about one vehicle.
const SEND_PERIOD: Duration = Duration::from_secs(10);

/// Time for which a leader waits for its cell's earlier counts of a vehicle.
const LISTEN_TIME: Duration = Duration::from_secs(2);

/// Time after a message from which the leader checks whether the region has stored it.
const ASK_AGAIN_AFTER: Duration = Duration::from_secs(10);

/// Factor by which a present vehicle's number of votes must grow to count as news.
const NEWS_FACTOR: f64 = 1.5;

/// Change of a present vehicle's share of right votes that counts as news.
const NEWS_SHARE: f64 = 0.05;

/// Maximum number of vehicles that have left and whose counts are pending; the vehicles with the
/// fewest votes are dropped first.
const MAX_WAITING: usize = 1024;

/// Maximum number of filters in one subscription. All retained messages that match arrive at once,
/// and must fit into a broker's queue for a subscriber.
const MAX_FILTERS: usize = 16;

/// Time for which first counts of cells are gathered, because many cells send counts for an
/// arriving vehicle at the same time.
const GATHER_TIME: Duration = Duration::from_millis(20);

/// Time for which further counts are gathered.
const FURTHER_GATHER_TIME: Duration = Duration::from_secs(1);

/// A leader's next step on its region's broker.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum ExchangeStep {
    /// Subscribe to these filters.
    Subscribe(Vec<String>),
    /// Unsubscribe from these filters.
    Unsubscribe(Vec<String>),
    /// Publish, retained.
    Publish(CellReputation),
}

/// A vehicle that is present or has pending counts.
#[derive(Debug, Clone, Default)]
struct KnownVehicle {
    is_present: bool,
    /// The counts of the ledger; `None` before they are set.
    own: Option<CellCounts>,
    /// This cell's counts in the region, as last received.
    told: CellCounts,
    /// The largest of every count received after the last reset.
    heard: CellCounts,
    missed_reset: Option<MissedReset>,
    /// The filter on this connection, and since when.
    filter: Option<(VehicleFilter, Timestamp)>,
    has_heard: bool,
    sent_at: Option<Timestamp>,
    /// True if the last message is confirmed as stored, or the check was made once.
    is_kept: bool,
}

/// A reset that the region has and the ledger lacks.
#[derive(Debug, Clone, Copy)]
struct MissedReset {
    /// The counts of the ledger when the reset was received.
    own: CellCounts,
    /// The counts of the region at that time.
    region: CellCounts,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum VehicleFilter {
    AllCells,
    OwnCell,
}

/// The exchange of one cell, on its leader.
#[derive(Debug, Clone)]
pub struct ReputationExchange {
    cell: NodeName,
    vehicles: BTreeMap<NodeName, KnownVehicle>,
    foreign: ForeignReputations,
    /// Time when news of other cells, or a change of their weight, is due.
    news_at: Option<Timestamp>,
    /// True if there are news of other cells.
    is_news: bool,
    dropped: u64,
}

impl KnownVehicle {
    /// The counts that the region should have: no count lower than in the region, since the last
    /// reset.
    fn wanted(&self) -> CellCounts {
        let mut wanted = self.heard;
        let own = self.own.unwrap_or_default();
        wanted.merge(
            self.missed_reset
                .map_or(own, |missed| missed.region.plus(own.since(missed.own))),
        );
        wanted
    }

    /// Sets or clears the state that the ledger lacks a reset that the region has.
    fn compare_resets(&mut self) {
        let Some(own) = self.own else { return };
        let noted_at = self.missed_reset.map(|missed| missed.region.reset_at);
        if own.reset_at >= self.heard.reset_at.max(noted_at.unwrap_or_default()) {
            self.missed_reset = None;
        } else if noted_at.is_none_or(|at| at < self.heard.reset_at) {
            self.missed_reset = Some(MissedReset {
                own,
                region: self.heard,
            });
        }
    }

    /// True if there are no counts left to receive or send for the vehicle.
    fn is_done(&self) -> bool {
        !self.is_present && self.is_told() && (self.is_kept || self.sent_at.is_none())
    }

    /// True if it is time to check whether the region has stored the last message.
    fn is_to_be_asked(&self, now: Timestamp) -> bool {
        let is_due = self
            .sent_at
            .is_some_and(|at| now.since(at) >= ASK_AGAIN_AFTER);
        !self.is_present && !self.is_kept && is_due && self.is_told()
    }

    fn is_told(&self) -> bool {
        self.wanted() == self.told
    }

    /// True if the counts contain news compared to those in the region.
    fn is_news(&self) -> bool {
        let (wanted, told) = (self.wanted(), self.told);
        wanted.reset_at > told.reset_at
            || wanted.all.total() as f64 > NEWS_FACTOR * told.all.total() as f64
            || (wanted.remembered().share() - told.remembered().share()).abs() > NEWS_SHARE
    }

    fn is_due(&self, now: Timestamp) -> bool {
        let has_paused = self.sent_at.is_none_or(|at| now.since(at) >= SEND_PERIOD);
        has_paused && self.may_be_told(now) && (!self.is_present || self.is_news())
    }

    /// True if the region lacks counts and its own state has been received.
    fn may_be_told(&self, now: Timestamp) -> bool {
        let has_listened = self
            .filter
            .is_some_and(|(_, since)| self.has_heard || now.since(since) >= LISTEN_TIME);
        has_listened && !self.is_told()
    }

    fn wanted_filter(&self) -> VehicleFilter {
        if self.is_present {
            VehicleFilter::AllCells
        } else {
            VehicleFilter::OwnCell
        }
    }
}

impl VehicleFilter {
    fn text(self, vehicle: &NodeName, cell: &NodeName) -> String {
        match self {
            Self::AllCells => ReputationTopic::filter_of_vehicle(vehicle),
            Self::OwnCell => ReputationTopic {
                vehicle: vehicle.clone(),
                cell: cell.clone(),
            }
            .path(),
        }
    }
}

impl ReputationExchange {
    /// Creates the exchange of a cell without vehicles. The empty state counts as news, because an
    /// earlier exchange may have had counts.
    pub fn new(cell: NodeName) -> Self {
        let news_at = Some(Timestamp::default());
        let (vehicles, foreign) = (BTreeMap::new(), ForeignReputations::default());
        Self {
            cell,
            vehicles,
            foreign,
            news_at,
            is_news: true,
            dropped: 0,
        }
    }

    /// Sets the vehicles that are present. Other cells' counts of all other vehicles are dropped.
    /// If the set is unchanged, the aggregator has restarted and gets all counts again.
    pub fn set_present(&mut self, present: &BTreeSet<NodeName>) {
        let mut is_same = true;
        for name in present.iter().take(MAX_FOREIGN_VEHICLES) {
            self.vehicles.entry(name.clone()).or_default();
        }
        for (name, vehicle) in &mut self.vehicles {
            let is_present = present.contains(name);
            is_same &= std::mem::replace(&mut vehicle.is_present, is_present) == is_present;
        }
        if self.foreign.retain(|name| present.contains(name)) || is_same {
            (self.news_at, self.is_news) = (Some(Timestamp::default()), true);
        }
        self.make_room();
    }

    /// Sets the ledger's counts of a vehicle. They may contradict other cells.
    pub fn count(&mut self, vehicle: &NodeName, counts: CellCounts, now: Timestamp) {
        let known = self.vehicles.entry(vehicle.clone()).or_default();
        known.own = Some(counts);
        known.compare_resets();
        if known.is_present {
            self.look_at(now + FURTHER_GATHER_TIME);
        }
        self.make_room();
    }

    /// Starts a connection: there are no subscriptions, and the broker may have lost its retained
    /// messages.
    pub fn connect(&mut self) {
        for vehicle in self.vehicles.values_mut() {
            let KnownVehicle {
                is_present,
                own,
                missed_reset,
                ..
            } = *vehicle;
            *vehicle = KnownVehicle {
                is_present,
                own,
                missed_reset,
                ..KnownVehicle::default()
            };
        }
    }

    /// Processes a message of the region at `now`; returns true if it contains news of another cell
    /// about a present vehicle.
    pub fn hear(&mut self, message: &CellReputation, now: Timestamp) -> bool {
        let Some(vehicle) = self.vehicles.get_mut(&message.vehicle) else {
            return false;
        };
        let counts = CellCounts::from(message);
        if message.cell == self.cell {
            // A broker keeps the last message, which is not necessarily the largest.
            vehicle.told = counts;
            vehicle.heard.merge(counts);
            vehicle.compare_resets();
            vehicle.has_heard = true;
            return false;
        }
        let is_first = !self.foreign.has(&message.cell, &message.vehicle);
        let is_news =
            vehicle.is_present && self.foreign.merge(&message.cell, &message.vehicle, counts);
        if is_news {
            self.is_news = true;
            self.look_at(
                now + if is_first {
                    GATHER_TIME
                } else {
                    FURTHER_GATHER_TIME
                },
            );
        }
        is_news
    }

    /// When to call [`Self::take_news`].
    pub fn news_at(&self) -> Option<Timestamp> {
        self.news_at
    }

    /// All other cells' counts of the present vehicles, if there is news and it is due. The counts
    /// are weighted by comparison with this cell's own evidence.
    pub fn take_news(&mut self, now: Timestamp) -> Option<ForeignReputations> {
        self.news_at.take_if(|at| *at <= now)?;
        let vehicles = &self.vehicles;
        let is_judged = self
            .foreign
            .judge(|vehicle| Some(vehicles.get(vehicle)?.own?.remembered()));
        let is_news = std::mem::take(&mut self.is_news) || is_judged;
        is_news.then(|| self.foreign.clone())
    }

    fn look_at(&mut self, at: Timestamp) {
        self.news_at = Some(self.news_at.map_or(at, |news_at| news_at.min(at)));
    }

    /// The next steps on a connection, with at most `max_messages` messages.
    pub fn next(&mut self, now: Timestamp, max_messages: usize) -> Vec<ExchangeStep> {
        let mut steps = Vec::new();
        let (mut ended, mut begun) = (Vec::new(), Vec::new());
        for (name, vehicle) in &mut self.vehicles {
            if vehicle.is_to_be_asked(now) {
                (vehicle.filter, vehicle.has_heard, vehicle.told) =
                    (None, false, CellCounts::default());
                vehicle.is_kept = true;
            }
            let wanted = (!vehicle.is_done()).then(|| vehicle.wanted_filter());
            let present = vehicle.filter.map(|(filter, _)| filter);
            if wanted == present || ended.len().max(begun.len()) >= MAX_FILTERS {
                continue;
            }
            ended.extend(present.map(|filter| filter.text(name, &self.cell)));
            begun.extend(wanted.map(|filter| filter.text(name, &self.cell)));
            vehicle.filter = wanted.map(|filter| (filter, now));
        }
        steps.extend((!begun.is_empty()).then_some(ExchangeStep::Subscribe(begun)));
        steps.extend((!ended.is_empty()).then_some(ExchangeStep::Unsubscribe(ended)));
        self.vehicles
            .retain(|_, vehicle| vehicle.filter.is_some() || !vehicle.is_done());
        let due = self
            .vehicles
            .iter_mut()
            .filter(|(_, vehicle)| vehicle.is_due(now))
            .take(max_messages);
        for (name, vehicle) in due {
            vehicle.sent_at = Some(now);
            steps.push(ExchangeStep::Publish(
                vehicle.wanted().message(self.cell.clone(), name.clone()),
            ));
        }
        steps
    }

    /// Records that a message was not sent; it is due again.
    pub fn not_sent(&mut self, vehicle: &NodeName) {
        if let Some(vehicle) = self.vehicles.get_mut(vehicle) {
            vehicle.sent_at = None;
        }
    }

    /// All counts that the region lacks, for a leader that leaves.
    pub fn farewell(&self, now: Timestamp) -> Vec<CellReputation> {
        let untold = self
            .vehicles
            .iter()
            .filter(|(_, vehicle)| vehicle.may_be_told(now));
        untold
            .map(|(name, vehicle)| vehicle.wanted().message(self.cell.clone(), name.clone()))
            .collect()
    }

    /// Number of vehicles whose counts were dropped because too many were pending.
    pub fn dropped(&self) -> u64 {
        self.dropped
    }

    fn make_room(&mut self) {
        self.vehicles
            .retain(|_, vehicle| vehicle.filter.is_some() || !vehicle.is_done());
        let waiting = self
            .vehicles
            .iter()
            .filter(|(_, vehicle)| !vehicle.is_present);
        let mut waiting: Vec<_> = waiting
            .map(|(name, vehicle)| (vehicle.own.unwrap_or_default().all.total(), name.clone()))
            .collect();
        let excess = waiting.len().saturating_sub(MAX_WAITING);
        if excess > 0 {
            waiting.sort();
            waiting
                .iter()
                .take(excess)
                .for_each(|(_, name)| _ = self.vehicles.remove(name));
            self.dropped += excess as u64;
        }
    }
}

#[cfg(test)]
mod tests;
