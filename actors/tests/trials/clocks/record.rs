//! The maps that a node accepted, by its map log.

use std::path::Path;
use std::time::Duration;

use ecod::model::time::Timestamp;
use ecod_actors::messages::newest::ReceivedMap;

use crate::clocks::cell::true_time;

/// Maps in the order of their arrival, with the true time at which they were found in the log: its own times are the
/// cell's, which may jump.
#[derive(Default)]
pub(crate) struct Record {
    maps: Vec<(Timestamp, ReceivedMap)>,
}

/// A map of the record.
pub(crate) struct Entry<'a>(&'a ReceivedMap);

impl Entry<'_> {
    /// True if a vehicle's detection is in the map.
    pub(crate) fn has(&self, vehicle: &str) -> bool {
        let mut contributors = self
            .0
            .map
            .landmarks
            .iter()
            .flat_map(|landmark| &landmark.contributors);
        contributors.any(|name| name.as_str() == vehicle)
    }
}

impl Record {
    /// Takes the lines that are new; the last one may be half written.
    pub(crate) fn read(&mut self, path: &Path) {
        let text = std::fs::read_to_string(path).unwrap_or_default();
        let new = text
            .lines()
            .skip(self.maps.len())
            .map_while(|line| serde_json::from_str(line).ok());
        self.maps
            .extend(new.map(|received| (true_time(), received)));
    }

    /// Leader whose map was taken last.
    pub(crate) fn source(&self) -> Option<&str> {
        self.maps
            .last()
            .map(|(_, received)| received.map.aggregator.as_str())
    }

    /// True if the last map has the reports of all these vehicles.
    pub(crate) fn has_lately<const N: usize>(&self, vehicles: [&str; N]) -> bool {
        self.maps
            .last()
            .is_some_and(|(_, received)| vehicles.iter().all(|name| Entry(received).has(name)))
    }

    /// Arrival of the last map.
    pub(crate) fn last_at(&self) -> Option<Timestamp> {
        self.maps.last().map(|(at, _)| *at)
    }

    /// Arrivals of certain maps.
    pub(crate) fn times(
        &self,
        since: Timestamp,
        is_meant: impl Fn(&Entry<'_>) -> bool,
    ) -> Vec<Timestamp> {
        self.since(since)
            .filter(|(_, received)| is_meant(&Entry(received)))
            .map(|(at, _)| *at)
            .collect()
    }

    /// Longest time in which no map with a vehicle's detection came.
    pub(crate) fn longest_without(&self, vehicle: &str, since: Timestamp) -> Duration {
        let mut times = vec![since];
        times.extend(self.times(since, |map| map.has(vehicle)));
        times.extend(self.last_at());
        times
            .windows(2)
            .map(|pair| pair[1].since(pair[0]))
            .max()
            .unwrap_or_default()
    }

    /// Largest difference between a map's time of fusion and the true time of its arrival.
    pub(crate) fn farthest_date(&self, since: Timestamp) -> Duration {
        let difference =
            |(at, received): &(Timestamp, ReceivedMap)| at.micros_from(received.map.fused_at_us);
        Duration::from_micros(
            self.since(since)
                .map(|entry| difference(entry).unsigned_abs())
                .max()
                .unwrap_or(0),
        )
    }

    fn since(&self, since: Timestamp) -> impl Iterator<Item = &(Timestamp, ReceivedMap)> {
        self.maps.iter().filter(move |(at, _)| *at >= since)
    }
}
