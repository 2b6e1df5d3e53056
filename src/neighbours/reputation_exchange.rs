//! The exchange of cells about vehicles: whom a leader asks about, whom it tells about, and when.
//!
//! Each cell has one retained message for each vehicle. It states absolute counts of the cell's own evidence, and never what it
//! heard of others. Nothing is sent here: [`ReputationExchange::next`] returns what is to be done.
//!
//! - *In.* A leader subscribes to what all cells say of the vehicles that are present, and of no others.
//! - *Out.* A present vehicle's counts are sent when they say something new, those of one that has left when they differ at all.
//! - *Kept.* Counts wait until the region has them: the own message comes back. That also acknowledges it. Without connection
//!   only the latest counts of each vehicle wait.
//! - *Never less.* A leader that knows less than the region does, such as one that lost its disk, first hears what its cell said
//!   before, and sends the larger of every count. What it hears too late it puts right.
//! - *Resets.* A leader that missed a reset of its cell's evidence adds to what the region has only what it counts from then on.

use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use crate::model::names::NodeName;
use crate::model::time::Timestamp;
use crate::reputation::{CellCounts, ForeignReputations, MAX_FOREIGN_VEHICLES};
use crate::wire::{CellReputation, ReputationTopic};

/// Minimum time between two messages about one vehicle.
const SEND_PERIOD: Duration = Duration::from_secs(10);

/// Time for which a leader listens for what its cell said of a vehicle before.
const LISTEN_TIME: Duration = Duration::from_secs(2);

/// Factor on the number of votes that is news of a present vehicle.
const NEWS_FACTOR: f64 = 1.5;

/// Difference of the share of right votes that is news of a present vehicle.
const NEWS_SHARE: f64 = 0.05;

/// Maximum number of vehicles that have left and wait to be told of; those with the fewest votes make room.
const MAX_WAITING: usize = 1024;

/// Maximum number of filters in one subscription.
const MAX_FILTERS: usize = 64;

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

/// News of another cell about a vehicle that is present.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ForeignNews {
    /// Its first word about the vehicle: the vehicle starts by it.
    First,
    /// Further counts, which can wait.
    Further,
}

/// A vehicle that is present or waits to be told of.
#[derive(Debug, Clone, Default)]
struct KnownVehicle {
    is_present: bool,
    /// The counts of the ledger, once they are known.
    own: Option<CellCounts>,
    /// The counts that the region has of this cell: those heard last.
    told: CellCounts,
    /// The largest of every count heard after the last reset.
    heard: CellCounts,
    /// The own counts when a reset was heard that the ledger does not have, and those of the region then.
    missed_reset: Option<(CellCounts, CellCounts)>,
    /// The filter on this connection, and since when.
    filter: Option<(VehicleFilter, Timestamp)>,
    has_heard: bool,
    sent_at: Option<Timestamp>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum VehicleFilter {
    AllCells,
    OwnCell,
}

/// A leader's part in the exchange of one cell.
#[derive(Debug, Clone)]
pub struct ReputationExchange {
    cell: NodeName,
    vehicles: BTreeMap<NodeName, KnownVehicle>,
    foreign: ForeignReputations,
    dropped: u64,
}

impl KnownVehicle {
    /// What the region is to have: no count less than it has, since the last reset.
    fn wanted(&self) -> CellCounts {
        let mut wanted = self.heard;
        let own = self.own.unwrap_or_default();
        wanted.merge(self.missed_reset.map_or(own, |(before, base)| base.plus(own.since(before))));
        wanted
    }

    /// Notes or forgets that the ledger lacks a reset that the region has.
    fn compare_resets(&mut self) {
        let Some(own) = self.own else { return };
        let noted_at = self.missed_reset.map(|(_, base)| base.reset_at);
        if own.reset_at >= self.heard.reset_at.max(noted_at.unwrap_or_default()) {
            self.missed_reset = None;
        } else if noted_at.is_none_or(|at| at < self.heard.reset_at) {
            self.missed_reset = Some((own, self.heard));
        }
    }

    /// True if nothing is to be heard of it or told.
    fn is_done(&self) -> bool {
        !self.is_present && self.is_told()
    }

    fn is_told(&self) -> bool {
        self.wanted() == self.told
    }

    /// True if the counts say something that those in the region do not.
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

    /// True if the region lacks something, and it is known what it has.
    fn may_be_told(&self, now: Timestamp) -> bool {
        let has_listened = self.filter.is_some_and(|(_, since)| self.has_heard || now.since(since) >= LISTEN_TIME);
        has_listened && !self.is_told()
    }

    fn wanted_filter(&self) -> VehicleFilter {
        if self.is_present { VehicleFilter::AllCells } else { VehicleFilter::OwnCell }
    }
}

impl VehicleFilter {
    fn text(self, vehicle: &NodeName, cell: &NodeName) -> String {
        match self {
            Self::AllCells => ReputationTopic::filter_of_vehicle(vehicle),
            Self::OwnCell => ReputationTopic { vehicle: vehicle.clone(), cell: cell.clone() }.path(),
        }
    }
}

impl ReputationExchange {
    /// No vehicles yet of a cell.
    pub fn new(cell: NodeName) -> Self {
        Self { cell, vehicles: BTreeMap::new(), foreign: ForeignReputations::default(), dropped: 0 }
    }

    /// Takes the vehicles that are present. What other cells say of the rest is forgotten; true if they said anything.
    pub fn set_present(&mut self, present: &BTreeSet<NodeName>) -> bool {
        for name in present.iter().take(MAX_FOREIGN_VEHICLES) {
            self.vehicles.entry(name.clone()).or_default();
        }
        for (name, vehicle) in &mut self.vehicles {
            vehicle.is_present = present.contains(name);
        }
        let has_less = self.foreign.retain(|name| present.contains(name));
        self.make_room();
        has_less
    }

    /// Takes what the ledger says of a vehicle.
    pub fn count(&mut self, vehicle: &NodeName, counts: CellCounts) {
        let known = self.vehicles.entry(vehicle.clone()).or_default();
        known.own = Some(counts);
        known.compare_resets();
        self.make_room();
    }

    /// Begins a connection: nothing is subscribed, and the broker may have lost what it had.
    pub fn connect(&mut self) {
        for vehicle in self.vehicles.values_mut() {
            let KnownVehicle { is_present, own, missed_reset, .. } = *vehicle;
            *vehicle = KnownVehicle { is_present, own, missed_reset, ..KnownVehicle::default() };
        }
    }

    /// Takes a message of the region; some if it is news of another cell about a vehicle that is present.
    pub fn hear(&mut self, message: &CellReputation) -> Option<ForeignNews> {
        let vehicle = self.vehicles.get_mut(&message.vehicle)?;
        let counts = CellCounts::from(message);
        if message.cell == self.cell {
            // A broker keeps the last message, which need not be the largest.
            vehicle.told = counts;
            vehicle.heard.merge(counts);
            vehicle.compare_resets();
            vehicle.has_heard = true;
            return None;
        }
        let is_first = !self.foreign.has(&message.cell, &message.vehicle);
        let is_news = vehicle.is_present && self.foreign.merge(&message.cell, &message.vehicle, counts);
        is_news.then_some(if is_first { ForeignNews::First } else { ForeignNews::Further })
    }

    /// What other cells say of the vehicles that are present.
    pub fn foreign(&self) -> &ForeignReputations {
        &self.foreign
    }

    /// Trust in the word of each cell that the own evidence contradicts, 0 to 1.
    pub fn trust_in_words(&self) -> BTreeMap<NodeName, f64> {
        self.foreign.trust_in_words(|vehicle| Some(self.vehicles.get(vehicle)?.own?.remembered()))
    }

    /// The next steps on a connection, with at most so many messages.
    pub fn next(&mut self, now: Timestamp, max_messages: usize) -> Vec<ExchangeStep> {
        let mut steps = Vec::new();
        let (mut ended, mut begun) = (Vec::new(), Vec::new());
        for (name, vehicle) in &mut self.vehicles {
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
        self.vehicles.retain(|_, vehicle| vehicle.filter.is_some() || !vehicle.is_done());
        let due = self.vehicles.iter_mut().filter(|(_, vehicle)| vehicle.is_due(now)).take(max_messages);
        for (name, vehicle) in due {
            vehicle.sent_at = Some(now);
            steps.push(ExchangeStep::Publish(vehicle.wanted().message(self.cell.clone(), name.clone())));
        }
        steps
    }

    /// Notes that a message was not sent: it is due again.
    pub fn not_sent(&mut self, vehicle: &NodeName) {
        if let Some(vehicle) = self.vehicles.get_mut(vehicle) {
            vehicle.sent_at = None;
        }
    }

    /// All that the region does not have, for a leader that leaves.
    pub fn farewell(&self, now: Timestamp) -> Vec<CellReputation> {
        let untold = self.vehicles.iter().filter(|(_, vehicle)| vehicle.may_be_told(now));
        untold.map(|(name, vehicle)| vehicle.wanted().message(self.cell.clone(), name.clone())).collect()
    }

    /// Number of vehicles of which the region was not told for want of room.
    pub fn dropped(&self) -> u64 {
        self.dropped
    }

    fn make_room(&mut self) {
        self.vehicles.retain(|_, vehicle| vehicle.filter.is_some() || !vehicle.is_done());
        let waiting = self.vehicles.iter().filter(|(_, vehicle)| !vehicle.is_present);
        let mut waiting: Vec<_> =
            waiting.map(|(name, vehicle)| (vehicle.own.unwrap_or_default().all.total(), name.clone())).collect();
        let excess = waiting.len().saturating_sub(MAX_WAITING);
        if excess > 0 {
            waiting.sort();
            waiting.iter().take(excess).for_each(|(_, name)| _ = self.vehicles.remove(name));
            self.dropped += excess as u64;
        }
    }
}

#[cfg(test)]
mod tests;
