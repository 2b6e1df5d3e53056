//! Terms of a cell's leaders, and the gap for its vehicles at each change.

use std::collections::BTreeMap;
use std::time::Duration;

use ecod::model::epoch::Epoch;
use ecod::model::time::Timestamp;
use ecod::wire::GlobalMap;
use ecod_actors::messages::newest::ReceivedMap;

/// A leadership as observed by the vehicles.
#[derive(Debug, Clone, PartialEq)]
pub struct JudgedTerm {
    /// Leader and term of the leadership.
    pub epoch: Epoch,
    /// Time when the first vehicle accepted the first map.
    pub from: Timestamp,
    /// Time when the last vehicle accepted the last map.
    pub until: Timestamp,
    /// Longest time that a vehicle waited from the last map of another leader to the first map of
    /// this one; `None` for the first leader.
    pub gap: Option<Duration>,
    /// Share of the truth that the maps contain, in percent.
    pub right_pct: f64,
}

/// All leaderships in the order of their terms, from the maps that each vehicle accepted in order;
/// `right_pct` evaluates the maps of one.
pub(super) fn judged_terms<'a>(
    vehicles: impl IntoIterator<Item = &'a [ReceivedMap]>,
    right_pct: impl Fn(&[&GlobalMap]) -> f64,
) -> Vec<JudgedTerm> {
    let mut terms: BTreeMap<Epoch, (JudgedTerm, BTreeMap<u64, &GlobalMap>)> = BTreeMap::new();
    for maps in vehicles {
        let mut before: Option<(Epoch, Timestamp)> = None;
        for ReceivedMap { received_at, map } in maps {
            let epoch = Epoch::new(map.epoch, map.aggregator.clone());
            let waited = before
                .filter(|(last, _)| *last != epoch)
                .map(|(_, at)| received_at.since(at));
            let (term, rounds) = terms.entry(epoch.clone()).or_insert_with(|| {
                let from = *received_at;
                let until = *received_at;
                (
                    JudgedTerm {
                        epoch: epoch.clone(),
                        from,
                        until,
                        gap: None,
                        right_pct: 0.0,
                    },
                    BTreeMap::new(),
                )
            });
            term.from = term.from.min(*received_at);
            term.until = term.until.max(*received_at);
            term.gap = term.gap.max(waited);
            rounds.insert(map.round, map);
            before = Some((epoch, *received_at));
        }
    }
    let judged = |(mut term, rounds): (JudgedTerm, BTreeMap<u64, &GlobalMap>)| {
        term.right_pct = right_pct(&rounds.into_values().collect::<Vec<_>>());
        term
    };
    terms.into_values().map(judged).collect()
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use ecod::model::names::NodeName;

    use super::*;

    fn taken(leader: &str, epoch: u64, round: u64, at_ms: u64) -> ReceivedMap {
        let received_at = Timestamp(at_ms * 1000);
        let map = GlobalMap::new(
            &Epoch::new(epoch, NodeName::new(leader).unwrap()),
            round,
            received_at,
        );
        ReceivedMap {
            received_at,
            map: Arc::new(map),
        }
    }

    #[test]
    fn term_gap_is_longest_wait() {
        let quick = [
            taken("edge", 1, 1, 0),
            taken("edge", 1, 2, 100),
            taken("euclid", 2, 3, 210),
        ];
        let slow = [
            taken("edge", 1, 1, 5),
            taken("euclid", 2, 4, 320),
            taken("edge", 3, 5, 400),
        ];
        let terms = judged_terms([&quick[..], &slow[..]], |maps| maps.len() as f64);
        let summary = |term: &JudgedTerm| {
            let from = term.from.micros() / 1000;
            let until = term.until.micros() / 1000;
            (
                term.epoch.to_string(),
                from,
                until,
                term.gap.map(|gap| gap.as_millis()),
                term.right_pct,
            )
        };
        let expected = [
            ("edge@1".to_owned(), 0, 100, None, 2.0),
            ("euclid@2".to_owned(), 210, 320, Some(315), 2.0),
            ("edge@3".to_owned(), 400, 400, Some(80), 1.0),
        ];
        assert_eq!(terms.iter().map(summary).collect::<Vec<_>>(), expected);
    }
}
