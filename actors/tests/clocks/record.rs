//! The maps that a node took, as its map log tells.

use std::path::Path;
use std::time::Duration;

use ecod::model::time::Timestamp;
use ecod_actors::messages::newest::ReceivedMap;

/// Maps in the order of their arrival.
pub(crate) struct Record {
    maps: Vec<ReceivedMap>,
}

/// A map of the record.
pub(crate) struct Entry<'a>(&'a ReceivedMap);

impl Entry<'_> {
    /// Whether a vehicle's detection is in the map.
    pub(crate) fn has(&self, vehicle: &str) -> bool {
        let mut contributors = self.0.map.landmarks.iter().flat_map(|landmark| &landmark.contributors);
        contributors.any(|name| name.as_str() == vehicle)
    }
}

impl Record {
    pub(crate) fn read(path: &Path) -> Self {
        let text = std::fs::read_to_string(path).unwrap_or_default();
        // The last line may be half written.
        Self { maps: text.lines().filter_map(|line| serde_json::from_str(line).ok()).collect() }
    }

    /// Whose map was taken last.
    pub(crate) fn source(&self) -> Option<&str> {
        self.maps.last().map(|received| received.map.aggregator.as_str())
    }

    /// Arrival of the last map.
    pub(crate) fn last_at(&self) -> Option<Timestamp> {
        self.maps.last().map(|received| received.received_at)
    }

    pub(crate) fn count(&self, since: Timestamp, is_counted: impl Fn(&Entry<'_>) -> bool) -> usize {
        self.since(since).filter(|received| is_counted(&Entry(received))).count()
    }

    /// Longest time in which no map with a vehicle's detection came.
    pub(crate) fn longest_without(&self, vehicle: &str, since: Timestamp) -> Duration {
        let with =
            self.since(since).filter(|received| Entry(received).has(vehicle)).map(|received| received.received_at);
        let mut times = vec![since];
        times.extend(with);
        times.extend(self.last_at());
        times.windows(2).map(|pair| pair[1].since(pair[0])).max().unwrap_or_default()
    }

    /// Largest difference between a map's time of fusion and its arrival.
    pub(crate) fn farthest_date(&self, since: Timestamp) -> Duration {
        let difference = |received: &ReceivedMap| received.received_at.micros_from(received.map.fused_at_us);
        Duration::from_micros(self.since(since).map(|received| difference(received).unsigned_abs()).max().unwrap_or(0))
    }

    fn since(&self, since: Timestamp) -> impl Iterator<Item = &ReceivedMap> {
        self.maps.iter().filter(move |received| received.received_at >= since)
    }
}
