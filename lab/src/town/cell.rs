//! One cell of a town: its aggregator, its neighbours, and its maps.

use std::collections::BTreeSet;
use std::sync::Arc;
use std::time::Duration;

use ecod::aggregator::{Aggregator, Command, Fused, FusionConfig};
use ecod::model::names::NodeName;
use ecod::model::quadkey::Quadkey;
use ecod::model::time::Timestamp;
use ecod::neighbours::Neighbours;
use ecod::tracking::HandOvers;
use ecod::wire::{
    CellMap, FusedObject, GlobalMap, ObjectReport, RegionTopic, RegionTopicKind, ReportKind,
    SCHEMA_VERSION,
};
use uuid::Uuid;

use super::place::CellFrame;

/// A cell that is always led by its own aggregator.
pub(super) struct TownCell {
    frame: CellFrame,
    aggregator: Aggregator,
    neighbours: Neighbours,
    topic: RegionTopic,
    /// Maps by the town's time.
    maps: Vec<(Timestamp, GlobalMap)>,
    sent_at: Timestamp,
    /// Number of maps that are sent or were passed over.
    considered: usize,
    pub(super) received: u64,
    pub(super) refused: u64,
}

impl TownCell {
    pub(super) fn new(
        name: NodeName,
        frame: CellFrame,
        config: FusionConfig,
        start: Timestamp,
    ) -> Self {
        let tile = Quadkey::of_cell(&frame.origin);
        Self {
            aggregator: Aggregator::new(name.clone(), 1, config, Vec::new(), frame.time(start)),
            neighbours: Neighbours::new(name.clone(), frame.origin),
            topic: RegionTopic {
                tile,
                cell: name,
                kind: RegionTopicKind::Map,
            },
            frame,
            maps: Vec::new(),
            sent_at: Timestamp(0),
            considered: 0,
            received: 0,
            refused: 0,
        }
    }

    /// When the round closes without a further report, by the town's time.
    pub(super) fn deadline(&self) -> Timestamp {
        self.frame.town_time(self.aggregator.deadline())
    }

    pub(super) fn close_until(&mut self, now: Timestamp) {
        while self.deadline() <= now {
            let at = self.aggregator.deadline();
            let fused = self.aggregator.tick(at);
            self.keep(fused, at);
        }
    }

    pub(super) fn report(&mut self, report: &ObjectReport, now: Timestamp) {
        let at = self.frame.time(now);
        let report = Arc::new(self.frame.report(report));
        let fused = self
            .aggregator
            .report(ReportKind::Detections, &report, at)
            .unwrap_or_default();
        self.keep(fused, at);
    }

    fn keep(&mut self, fused: Option<Fused>, at: Timestamp) {
        let Some(map) = fused.and_then(|fused| fused.map) else {
            return;
        };
        self.neighbours.observe_own(&map, at);
        self.maps.push((self.frame.town_time(at), map));
    }

    /// The newest map, if it is due at `now` to be sent and was not considered before.
    pub(super) fn due_map(
        &mut self,
        now: Timestamp,
        period: Duration,
    ) -> Option<(RegionTopic, CellMap)> {
        // Rounds come a little early or late.
        if self.maps.len() == self.considered || now.since(self.sent_at) < period - period / 10 {
            return None;
        }
        self.considered = self.maps.len();
        self.sent_at = now;
        let map = self.maps.last()?.1.clone();
        let map = GlobalMap {
            neighbour_objects: Vec::new(),
            ..map
        };
        let cell = self.topic.cell.clone();
        let origin = self.frame.origin;
        let sent_at_us = self.frame.time(now);
        Some((
            self.topic.clone(),
            CellMap {
                schema: SCHEMA_VERSION,
                cell,
                sent_at_us,
                origin,
                map,
            },
        ))
    }

    pub(super) fn receive(&mut self, topic: &RegionTopic, message: CellMap, now: Timestamp) {
        let at = self.frame.time(now);
        self.received += 1;
        match self.neighbours.accept(topic, message, at) {
            Ok(()) => {
                let objects: Arc<[_]> = self.neighbours.near(at).into();
                self.aggregator.command(
                    &Command::OnNeighbours {
                        objects,
                        stated_at: at,
                    },
                    at,
                );
            }
            Err(_) => self.refused += 1,
        }
    }

    /// The objects of the map that is nearest in time, moved on to `at`, in the town's frame.
    pub(super) fn objects_at(&self, at: Timestamp, within: Duration) -> Vec<FusedObject> {
        let distance = |time: Timestamp| at.micros_from(time).unsigned_abs();
        let from = self.maps.partition_point(|(time, _)| *time + within < at);
        let near = self.maps[from..]
            .iter()
            .take_while(|(time, _)| *time <= at + within);
        let Some((time, map)) = near.min_by_key(|(time, _)| distance(*time)) else {
            return Vec::new();
        };
        let ahead_s = at.micros_from(*time) as f64 * 1e-6;
        map.objects
            .iter()
            .map(|object| self.frame.town_object(object, ahead_s))
            .collect()
    }

    pub(super) fn hand_overs(&self) -> HandOvers {
        self.aggregator.hand_overs()
    }

    pub(super) fn identities(&self) -> BTreeSet<Uuid> {
        self.maps
            .iter()
            .flat_map(|(_, map)| map.objects.iter().map(|object| object.id))
            .collect()
    }
}
