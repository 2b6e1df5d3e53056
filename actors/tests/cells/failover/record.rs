//! The maps that a node accepted, by its map log.

use std::collections::BTreeSet;
use std::path::Path;
use std::time::Duration;

use ecod::model::epoch::Epoch;
use ecod_actors::messages::newest::ReceivedMap;

/// The maps that a node took, in their order.
pub(crate) struct Record {
    maps: Vec<ReceivedMap>,
}

impl Record {
    pub(crate) fn read(path: &Path) -> Self {
        let text = std::fs::read_to_string(path).unwrap_or_default();
        // The last line of a killed process may be cut short.
        let maps = text
            .lines()
            .filter_map(|line| serde_json::from_str(line).ok())
            .collect();
        Self { maps }
    }

    pub(crate) fn is_empty(&self) -> bool {
        self.maps.is_empty()
    }

    /// Whose map was taken last.
    pub(crate) fn source(&self) -> Option<&str> {
        self.maps
            .last()
            .map(|received| received.map.aggregator.as_str())
    }

    pub(crate) fn last_round(&self) -> u64 {
        self.maps.last().map_or(0, |received| received.map.round)
    }

    /// Epochs of the maps from the round on, which is of the leader at that time.
    pub(crate) fn epochs_from(&self, round: u64, leader: &str) -> BTreeSet<Epoch> {
        let is_earlier = |taken: &&ReceivedMap| {
            taken.map.aggregator.as_str() != leader || taken.map.round < round
        };
        let taken = self.maps.iter().skip_while(is_earlier);
        taken
            .map(|received| Epoch::new(received.map.epoch, received.map.aggregator.clone()))
            .collect()
    }

    pub(crate) fn longest_gap(&self) -> Duration {
        let gap = |pair: &[ReceivedMap]| pair[1].received_at.since(pair[0].received_at);
        self.maps.windows(2).map(gap).max().unwrap_or_default()
    }

    /// Epochs do not repeat, and rounds within an epoch do not repeat.
    #[track_caller]
    pub(crate) fn never_goes_back(&self) {
        let place = |received: &ReceivedMap| {
            (
                Epoch::new(received.map.epoch, received.map.aggregator.clone()),
                received.map.round,
            )
        };
        for pair in self.maps.windows(2) {
            assert!(
                place(&pair[1]) > place(&pair[0]),
                "{:?} after {:?}",
                place(&pair[1]),
                place(&pair[0])
            );
        }
    }

    /// From the first round on, every round was accepted exactly once from any publisher, including the handover back
    /// to `owner`, which leads at the end. Only if a leader was not received in time, for example on a stalled machine,
    /// may its successor have published rounds again: that is a failover and not a handover.
    #[track_caller]
    pub(crate) fn misses_and_repeats_none_after(&self, round: u64, owner: &str) {
        let rounds: Vec<_> = self
            .maps
            .iter()
            .map(|received| (received.map.round, received.map.aggregator.as_str()))
            .skip_while(|(taken, _)| *taken < round)
            .collect();
        assert!(rounds.len() > 5, "only {rounds:?}");
        for pair in rounds.windows(2) {
            let next = pair[0].0 + 1;
            let may_repeat = pair[1].1 != pair[0].1 && pair[1].1 != owner;
            assert!(
                pair[1].0 == next || may_repeat && pair[1].0 < next,
                "{:?} after {:?}",
                pair[1],
                pair[0]
            );
        }
        assert_eq!(self.source(), Some(owner));
    }
}
