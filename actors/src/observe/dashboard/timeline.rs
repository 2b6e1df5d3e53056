//! Events and maps of a cell over time, for the time slider of page and report.

use std::collections::{BTreeSet, VecDeque};
use std::time::Duration;

use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ecod::wire::{GlobalMap, Reputations, Trouble, Verdicts};
use serde::Serialize;

use super::live_state::LatestReport;
use super::snapshot::json;
use crate::messages::newest::Received;

/// Events and maps, oldest first, in bounded memory: [`MAX_EVENTS`] and [`MAX_SERIES_BYTES`].
#[derive(Debug)]
pub(crate) struct Timeline {
    /// Each map as a [`TimelineFrame`] in JSON.
    pub frames: ThinnedSeries,
    events: VecDeque<TimelineEvent>,
    alive: BTreeSet<NodeName>,
    /// Present troubles by subject and kind.
    troubled: BTreeSet<(String, String)>,
    distrusted: BTreeSet<NodeName>,
}

/// An event at one moment.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub(crate) struct TimelineEvent {
    /// Time of the event.
    pub at_us: Timestamp,
    pub kind: EventKind,
    /// The event as text.
    pub text: String,
}

/// Kind of a [`TimelineEvent`]. Changes of the leader are seen in its terms.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum EventKind {
    Joined,
    /// A node left, or does not answer.
    Lost,
    Trouble,
    /// A vehicle is contradicted by the others more often than not.
    Distrusted,
    /// The log has a gap.
    Gap,
}

/// A map and its inputs, with the field names of a [`Snapshot`](super::snapshot::Snapshot).
#[derive(Debug, Serialize)]
pub(crate) struct TimelineFrame {
    /// Time of receipt.
    pub now_us: Timestamp,
    pub map: Option<Received<GlobalMap>>,
    /// Newest verdicts at that time.
    pub verdicts: Option<Received<Verdicts>>,
    /// Latest report of each vehicle and kind at that time.
    pub vehicles: Vec<LatestReport>,
}

/// Texts over time within [`MAX_SERIES_BYTES`]. A full series drops every second item and then
/// accepts half as many.
#[derive(Debug)]
pub(crate) struct ThinnedSeries {
    items: VecDeque<(Timestamp, Vec<u8>)>,
    bytes: usize,
    /// Maximum age of an item.
    span: Duration,
    /// Least time between two items, when it is not thinned and now.
    least_period: Duration,
    period: Duration,
}

/// Maximum number of events. Each has at most some 700 bytes.
pub(crate) const MAX_EVENTS: usize = 2048;

/// Maximum bytes of all texts in a series.
pub(crate) const MAX_SERIES_BYTES: usize = 8 << 20;

/// Minimum time between two items of a series that was thinned.
const THINNED_PERIOD: Duration = Duration::from_millis(100);

/// Reputation below which a vehicle counts as distrusted; from this value on it counts as
/// trustworthy again. Newcomers have 0.5.
const DISTRUSTED_SCORE: f64 = 0.4;
const TRUSTED_SCORE: f64 = 0.5;

/// Minimum number of wrong votes of a distrusted vehicle: a few wrong votes are not a pattern.
const MIN_WRONG_VOTES: u64 = 10;

impl Timeline {
    /// An empty timeline of the last `span`, with a map in each `period` at most.
    pub(crate) fn new(span: Duration, period: Duration) -> Self {
        Self {
            frames: ThinnedSeries::new(span, period),
            events: VecDeque::new(),
            alive: BTreeSet::new(),
            troubled: BTreeSet::new(),
            distrusted: BTreeSet::new(),
        }
    }

    /// Sets the nodes that are currently present.
    pub(crate) fn nodes(&mut self, alive: BTreeSet<NodeName>, now: Timestamp) {
        let before = std::mem::take(&mut self.alive);
        for name in alive.difference(&before) {
            self.event(EventKind::Joined, format!("{name} joined"), now);
        }
        for name in before.difference(&alive) {
            self.event(EventKind::Lost, format!("{name} is gone"), now);
        }
        self.alive = alive;
    }

    /// Sets all current troubles with the nodes that report them.
    pub(crate) fn troubles<'a>(
        &mut self,
        present: impl Iterator<Item = (&'a NodeName, &'a Trouble)>,
        now: Timestamp,
    ) {
        let mut troubled = BTreeSet::new();
        for (
            told_by,
            Trouble {
                kind,
                about,
                cause,
                remedy,
            },
        ) in present
        {
            let subject = about.clone().unwrap_or_else(|| told_by.to_string());
            let text = format!("{subject}: {cause}. Remedy: {remedy}");
            let key = (subject, kind.clone());
            if troubled.insert(key.clone()) && !self.troubled.contains(&key) {
                self.event(EventKind::Trouble, text, now);
            }
        }
        self.troubled = troubled;
    }

    /// Processes the newest reputations.
    pub(crate) fn reputations(&mut self, newest: &Reputations, now: Timestamp) {
        for (name, it) in &newest.reputations {
            if it.score >= TRUSTED_SCORE {
                self.distrusted.remove(name);
            } else if it.score < DISTRUSTED_SCORE
                && it.incorrect >= MIN_WRONG_VOTES
                && self.distrusted.insert(name.clone())
            {
                let text = format!(
                    "{name} is contradicted by the others: {} votes right, {} wrong",
                    it.correct, it.incorrect
                );
                self.event(EventKind::Distrusted, text, now);
            }
        }
        self.distrusted
            .retain(|name| newest.reputations.contains_key(name));
    }

    pub(crate) fn event(&mut self, kind: EventKind, text: String, at_us: Timestamp) {
        let is_old = |oldest: &TimelineEvent| at_us.since(oldest.at_us) > self.frames.span;
        while self.events.len() >= MAX_EVENTS || self.events.front().is_some_and(is_old) {
            self.events.pop_front();
        }
        self.events.push_back(TimelineEvent { at_us, kind, text });
    }

    /// The fields `events` and `frames` of a JSON object: events after `time`, and the times of all
    /// maps, in order.
    pub(crate) fn json_since(&self, time: Timestamp) -> Vec<u8> {
        let mut events: Vec<_> = self
            .events
            .iter()
            .filter(|event| event.at_us > time)
            .collect();
        events.sort_by_key(|event| event.at_us);
        let mut times: Vec<_> = self.frames.items.iter().map(|(at, _)| at).collect();
        times.sort();
        [
            &b"\"events\":"[..],
            &json(&events),
            b",\"frames\":",
            &json(&times),
        ]
        .concat()
    }
}

impl ThinnedSeries {
    /// An empty series of the last `span`, with an item in each `period` at most.
    pub(crate) fn new(span: Duration, period: Duration) -> Self {
        Self {
            items: VecDeque::new(),
            bytes: 0,
            span,
            least_period: period,
            period,
        }
    }

    /// Adds an item if one is due. An item is also due after the clock went back.
    pub(crate) fn push(&mut self, at: Timestamp, item: impl FnOnce() -> Vec<u8>) {
        let age_us = self
            .items
            .back()
            .map(|(last, _)| u128::from(at.micros().abs_diff(last.micros())));
        if age_us.is_some_and(|age| age == 0 || age < self.period.as_micros()) {
            return;
        }
        let mut item = item();
        item.shrink_to_fit();
        self.bytes += item.len();
        self.items.push_back((at, item));
        while self
            .items
            .front()
            .is_some_and(|(oldest, _)| at.since(*oldest) > self.span)
        {
            self.bytes -= self.items.pop_front().map_or(0, |(_, item)| item.len());
        }
        if self.bytes < MAX_SERIES_BYTES / 4 {
            self.period = (self.period / 2).max(self.least_period);
        }
        while self.bytes > MAX_SERIES_BYTES {
            let mut keep = true;
            self.items.retain(|_| {
                keep = !keep;
                keep
            });
            self.bytes = self.items.iter().map(|(_, item)| item.len()).sum();
            self.period = (2 * self.period).max(THINNED_PERIOD);
        }
    }

    /// The latest item of this time or before, or else the first.
    pub(crate) fn at(&self, time: Timestamp) -> Option<&[u8]> {
        let after = self.items.partition_point(|(at, _)| *at <= time);
        self.items
            .get(after.saturating_sub(1))
            .map(|(_, item)| &**item)
    }

    /// All items in order of time, as a JSON array.
    pub(crate) fn json(&self) -> Vec<u8> {
        let mut ordered: Vec<_> = self.items.iter().collect();
        ordered.sort_by_key(|(at, _)| *at);
        let items: Vec<_> = ordered.into_iter().map(|(_, item)| &**item).collect();
        [&b"["[..], &items.join(&b','), b"]"].concat()
    }
}

#[cfg(test)]
mod tests {
    use serde_json::Value;

    use super::*;

    const SECOND: Duration = Duration::from_secs(1);

    fn at(seconds: u64) -> Timestamp {
        Timestamp(seconds * 1_000_000)
    }

    fn names(all: &[&'static str]) -> BTreeSet<NodeName> {
        all.iter().map(|name| NodeName::from_static(name)).collect()
    }

    fn parsed(timeline: &Timeline) -> Value {
        serde_json::from_slice(&[b"{", &*timeline.json_since(at(0)), b"}"].concat()).unwrap()
    }

    #[test]
    fn events_are_listed_once() {
        let mut timeline = Timeline::new(600 * SECOND, SECOND);
        let trouble = Trouble {
            kind: "clock_off".into(),
            about: Some("late".into()),
            cause: "its clock is 5.0 s ahead".into(),
            remedy: "run chrony".into(),
        };
        let edge = NodeName::from_static("edge");
        let reputations = |score, round| {
            let reputation = ecod::wire::Reputation {
                score,
                correct: 3,
                incorrect: 12,
            };
            let reputations = [(NodeName::from_static("liar"), reputation)].into();
            Reputations {
                schema: 1,
                aggregator: None,
                epoch: 1,
                round,
                reputations,
            }
        };
        for second in 1..5 {
            timeline.nodes(names(&["edge", "euclid"]), at(second));
            timeline.troubles(
                [(&edge, &trouble), (&edge, &trouble)].into_iter(),
                at(second),
            );
            timeline.reputations(&reputations(0.35, second), at(second));
        }
        timeline.nodes(names(&["euclid"]), at(5));
        timeline.reputations(&reputations(0.45, 5), at(5));
        timeline.reputations(&reputations(0.35, 6), at(6));
        let parsed = parsed(&timeline);
        let texts: Vec<_> = parsed["events"]
            .as_array()
            .unwrap()
            .iter()
            .map(|event| event["text"].as_str())
            .collect();
        let expected = [
            "edge joined",
            "euclid joined",
            "late: its clock is 5.0 s ahead. Remedy: run chrony",
            "liar is contradicted by the others: 3 votes right, 12 wrong",
            "edge is gone",
        ];
        assert_eq!(texts, expected.map(Some), "a score that varies is no news");
    }

    /// Ten minutes of a small cell are held second by second, an hour of the largest maps within
    /// the bound.
    #[test]
    fn ten_minutes_fit_bounded_memory() {
        let span = 600 * SECOND;
        let mut small = ThinnedSeries::new(span, SECOND);
        for tenth in 0..36_000 {
            small.push(Timestamp(tenth * 100_000), || vec![b'x'; 10_000]);
        }
        assert_eq!(small.items.len(), 601);

        let mut timeline = Timeline::new(span, SECOND);
        let mut most = 0;
        for second in 1..=3600 {
            timeline.frames.push(at(second), || vec![b'x'; 500_000]);
            (0..100).for_each(|n| {
                timeline.event(EventKind::Trouble, format!("{second} {n}"), at(second));
            });
            most = most.max(timeline.frames.bytes);
        }
        let held = &timeline.frames.items;
        assert!(
            most <= MAX_SERIES_BYTES + 500_000 && timeline.frames.bytes <= MAX_SERIES_BYTES,
            "{most}"
        );
        assert!(held.len() >= 8, "{} maps of ten minutes", held.len());
        let apart = held
            .iter()
            .zip(held.iter().skip(1))
            .map(|(a, b)| b.0.since(a.0))
            .max()
            .unwrap();
        assert!(
            apart <= 128 * SECOND && at(3600).since(held[0].0) <= span,
            "{apart:?}"
        );
        assert_eq!(timeline.events.len(), MAX_EVENTS);

        for second in 3601..=4800 {
            timeline.frames.push(at(second), || vec![b'x'; 1000]);
        }
        assert!(
            timeline.frames.items.len() > 590,
            "a cell that became small is held in full again"
        );
        timeline
            .frames
            .push(at(5000), || vec![b'x'; 2 * MAX_SERIES_BYTES]);
        assert!(
            timeline.frames.bytes <= MAX_SERIES_BYTES,
            "also after a map that is larger than the bound"
        );
    }

    #[test]
    fn latest_earlier_map_is_shown() {
        let mut series = ThinnedSeries::new(600 * SECOND, SECOND);
        assert_eq!(series.at(at(1)), None);
        for second in [10, 12, 14] {
            series.push(at(second), || second.to_string().into_bytes());
        }
        for (time, shown) in [(0, "10"), (10, "10"), (13, "12"), (99, "14")] {
            assert_eq!(series.at(at(time)), Some(shown.as_bytes()), "{time}");
        }
    }

    #[test]
    fn backward_clock_keeps_order() {
        let mut timeline = Timeline::new(Duration::MAX, Duration::ZERO);
        for second in [100, 101, 50, 51] {
            timeline.event(EventKind::Gap, second.to_string(), at(second));
            timeline
                .frames
                .push(at(second), || second.to_string().into_bytes());
        }
        let parsed = parsed(&timeline);
        let texts: Vec<_> = parsed["events"]
            .as_array()
            .unwrap()
            .iter()
            .map(|event| event["text"].as_str())
            .collect();
        assert_eq!(texts, ["50", "51", "100", "101"].map(Some));
        assert_eq!(
            parsed["frames"],
            serde_json::json!([50_000_000, 51_000_000, 100_000_000, 101_000_000])
        );
        assert_eq!(timeline.frames.json(), b"[50,51,100,101]");
    }
}
