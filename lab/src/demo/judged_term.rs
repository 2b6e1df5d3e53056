//! Who led a cell when, and how long its vehicles waited when the lead changed hands.

use std::collections::BTreeMap;
use std::time::Duration;

use ecod::epoch::Epoch;
use ecod::time::Timestamp;
use ecod::wire::GlobalMap;
use ecod_actors::follower::ReceivedMap;

use crate::testbed::score::Score;
use crate::testbed::{Scene, Testbed};

/// A leadership as the vehicles saw it.
#[derive(Debug, Clone, PartialEq)]
pub struct Reign {
    /// Who led, in which term.
    pub epoch: Epoch,
    /// When the first vehicle took the first map.
    pub from: Timestamp,
    /// When the last vehicle took the last map.
    pub until: Timestamp,
    /// Longest time that a vehicle waited from the last map of another leader to the first of this one; none when there
    /// was no other.
    pub gap: Option<Duration>,
    /// How right the maps were.
    pub score: Score,
}

/// All leaderships in the order of their terms, from what each vehicle took in its order.
pub(super) fn reigns<'a>(
    testbed: &Testbed,
    scene: &Scene,
    vehicles: impl IntoIterator<Item = &'a [ReceivedMap]>,
) -> Vec<Reign> {
    let mut reigns: BTreeMap<Epoch, (Reign, BTreeMap<u64, &GlobalMap>)> = BTreeMap::new();
    for maps in vehicles {
        let mut before: Option<(Epoch, Timestamp)> = None;
        for ReceivedMap { received_at, map } in maps {
            let epoch = Epoch::new(map.epoch, map.aggregator.clone());
            let waited = before.filter(|(last, _)| *last != epoch).map(|(_, at)| received_at.since(at));
            let (reign, rounds) = reigns.entry(epoch.clone()).or_insert_with(|| {
                let (from, until) = (*received_at, *received_at);
                (Reign { epoch: epoch.clone(), from, until, gap: None, score: Score::default() }, BTreeMap::new())
            });
            reign.from = reign.from.min(*received_at);
            reign.until = reign.until.max(*received_at);
            reign.gap = reign.gap.max(waited);
            rounds.insert(map.round, map);
            before = Some((epoch, *received_at));
        }
    }
    let judged = |(mut reign, rounds): (Reign, BTreeMap<u64, &GlobalMap>)| {
        rounds.values().for_each(|map| reign.score.judge(testbed, scene, map));
        reign
    };
    reigns.into_values().map(judged).collect()
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use ecod::names::NodeName;
    use ecod::wire::SCHEMA_VERSION;

    use super::*;

    const SCENES: &str = include_str!("../../../examples/testbed/pace_setup1.json");

    fn taken(leader: &str, epoch: u64, round: u64, at_ms: u64) -> ReceivedMap {
        let map = GlobalMap {
            schema: SCHEMA_VERSION,
            aggregator: NodeName::new(leader).unwrap(),
            epoch,
            round,
            fused_at_us: Timestamp(at_ms * 1000),
            oldest_capture_us: None,
            landmarks: Vec::new(),
            objects: Vec::new(),
            pose_corrections: Default::default(),
        };
        ReceivedMap { received_at: Timestamp(at_ms * 1000), map: Arc::new(map) }
    }

    #[test]
    fn the_gap_of_a_reign_is_that_of_the_vehicle_that_waited_longest() {
        let testbed = Testbed::from_json(SCENES).unwrap();
        let quick = [taken("edge", 1, 1, 0), taken("edge", 1, 2, 100), taken("euclid", 2, 3, 210)];
        let slow = [taken("edge", 1, 1, 5), taken("euclid", 2, 4, 320), taken("edge", 3, 5, 400)];
        let reigns = reigns(&testbed, &testbed.scenes[0], [&quick[..], &slow[..]]);
        let told = |reign: &Reign| {
            let (from, until) = (reign.from.micros() / 1000, reign.until.micros() / 1000);
            (reign.epoch.to_string(), from, until, reign.gap.map(|gap| gap.as_millis()))
        };
        let expected = [
            ("edge@1".to_owned(), 0, 100, None),
            ("euclid@2".to_owned(), 210, 320, Some(315)),
            ("edge@3".to_owned(), 400, 400, Some(80)),
        ];
        assert_eq!(reigns.iter().map(told).collect::<Vec<_>>(), expected);
    }
}
