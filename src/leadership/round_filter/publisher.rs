//! The rule of a node's own broker: which nodes may publish for the whole cell.

use crate::leadership::timers::FAREWELL_TIME;
use crate::leadership::view::Leadership;
use crate::model::names::NodeName;
use crate::model::time::Timestamp;

/// Rule by which a broker forwards maps, verdicts and reputations.
///
/// The leader may publish. A former leader may publish for another [`FAREWELL_TIME`], because its
/// last round may still be in transit when its successor is elected. While there is no leader every
/// node may publish, and receivers decide.
#[derive(Debug, Clone, Default, PartialEq, Eq, Hash)]
pub struct PublisherFilter {
    last: Option<Publisher>,
    before: Option<Publisher>,
}

/// A leader and when it last published.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
struct Publisher {
    name: NodeName,
    at: Timestamp,
}

impl PublisherFilter {
    /// True if a node may publish for all now.
    pub fn may_publish(
        &mut self,
        name: &NodeName,
        leadership: &Leadership,
        now: Timestamp,
    ) -> bool {
        match leadership.leader() {
            None => true,
            Some(leader) if leader == name => {
                self.record(name, now);
                true
            }
            Some(_) => [&self.last, &self.before]
                .into_iter()
                .flatten()
                .any(|publisher| {
                    publisher.name == *name && now.since(publisher.at) < FAREWELL_TIME
                }),
        }
    }

    fn record(&mut self, name: &NodeName, now: Timestamp) {
        if self.last.as_ref().is_some_and(|last| last.name != *name) {
            self.before = self.last.take();
        }
        self.last = Some(Publisher {
            name: name.clone(),
            at: now,
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::leadership::view::Position;
    use crate::model::epoch::Epoch;

    #[test]
    fn only_leader_and_predecessor_publish() {
        let led_by = |leader: &str| Leadership {
            position: Position::Following,
            epoch: Some(Epoch::new(1, NodeName::new(leader).unwrap())),
            standby: None,
            term: 1,
            is_deserted: false,
            is_yielding: false,
        };
        let mut filter = PublisherFilter::default();
        let [edge, euclid, gauss] =
            ["edge", "euclid", "gauss"].map(|name| NodeName::new(name).unwrap());
        let mut may = |name: &NodeName, leadership: &Leadership, ms: u64| {
            filter.may_publish(name, leadership, Timestamp(ms * 1000))
        };
        assert!(may(&gauss, &Leadership::default(), 0), "no leader is known");
        assert!(
            may(&edge, &led_by("edge"), 0)
                && !may(&euclid, &led_by("edge"), 0)
                && !may(&gauss, &led_by("edge"), 0)
        );
        let next = led_by("euclid");
        assert!(
            may(&edge, &next, 100) && may(&euclid, &next, 200) && may(&edge, &next, 999),
            "its last round"
        );
        assert!(!may(&edge, &next, 1000), "its time is over");
        assert!(!may(&gauss, &next, 200));
    }
}
