//! Losses while a log was recorded, in all runs of its node.

use std::collections::BTreeMap;

use uuid::Uuid;

use super::series::Samples;
use crate::observe::recorder::CounterReading;
use crate::telemetry::counters::Event;

/// Events that count as losses.
const EVENTS: [Event; 26] = [
    Event::PublishRefused,
    Event::PublishTooLarge,
    Event::InboxFull,
    Event::Disconnected,
    Event::VoteIgnored,
    Event::ReportLate,
    Event::ObjectRefused,
    Event::EntryLeftOut,
    Event::RecordDropped,
    Event::RecordFailed,
    Event::FrameFailed,
    Event::FrameSkipped,
    Event::SourceFailed,
    Event::DetectionUnplaced,
    Event::PoseRejected,
    Event::FrameWithoutPose,
    Event::ReputationsNotSaved,
    Event::ClientThrottled,
    Event::ClientTimedOut,
    Event::ClientUntrusted,
    Event::ClientMalformed,
    Event::ClientsFull,
    Event::ClientDenied,
    Event::ClientStalled,
    Event::ClientExpelled,
    Event::Overreached,
];

/// Sums of counters, which start at zero in every run of the node.
#[derive(Debug, Default)]
pub(super) struct Losses {
    by_reason: BTreeMap<String, u64>,
    over_time: Samples,
    newest: Option<(Option<Uuid>, CounterReading)>,
}

impl Losses {
    /// Processes the next reading. The first one is the baseline; later runs count from zero.
    pub(super) fn add(&mut self, run: Option<Uuid>, reading: CounterReading) {
        if let Some((run_before, before)) = &self.newest {
            let before: BTreeMap<_, _> = counts(before).filter(|_| *run_before == run).collect();
            for (name, times) in counts(&reading) {
                // A lower value than before means that the counter was reset.
                let base = before
                    .get(name)
                    .copied()
                    .filter(|base| *base <= times)
                    .unwrap_or_default();
                if times > base {
                    *self.by_reason.entry(name.to_owned()).or_default() += times - base;
                }
            }
        }
        self.over_time
            .push(reading.at_us, self.by_reason.values().sum::<u64>() as f64);
        self.newest = Some((run, reading));
    }

    /// True if the log has any reading.
    pub(super) fn are_known(&self) -> bool {
        self.newest.is_some()
    }

    /// Number of losses by reason, without zeros.
    pub(super) fn by_reason(&self) -> &BTreeMap<String, u64> {
        &self.by_reason
    }

    /// Cumulative number of losses over time.
    pub(super) fn over_time(&self) -> &Samples {
        &self.over_time
    }
}

/// Losses in a reading. Copies through a second broker (`out_of_order`) don't count as losses.
fn counts(reading: &CounterReading) -> impl Iterator<Item = (&str, u64)> {
    let is_loss = |name: &str| EVENTS.iter().any(|event| event.as_str() == name);
    let events = reading.events.iter().filter(move |(name, _)| is_loss(name));
    let rejects = reading
        .rejects
        .iter()
        .filter(|(name, _)| *name != "out_of_order");
    events
        .chain(rejects)
        .chain(&reading.shed)
        .map(|(name, times)| (name.as_str(), *times))
}

#[cfg(test)]
mod tests {
    use ecod::model::names::NodeName;
    use ecod::model::time::Timestamp;

    use super::*;

    #[test]
    fn losses_of_runs_add_up() {
        let mut losses = Losses::default();
        let runs = [1, 2].map(|number| Some(Uuid::from_u128(number)));
        assert!(!losses.are_known());
        let readings = [
            (runs[0], 3, 7),
            (runs[0], 10, 7),
            (runs[1], 4, 0),
            (runs[1], 30, 1),
            (runs[1], 2, 1),
        ];
        for (second, (run, inbox_full, stale)) in readings.into_iter().enumerate() {
            let counts = |name: &str, times| BTreeMap::from([(name.to_owned(), times)]);
            let mut events = counts("inbox_full", inbox_full);
            events.insert("published".into(), 1000 * second as u64);
            let node = NodeName::from_static("cav");
            let at_us = Timestamp(second as u64 * 1_000_000);
            losses.add(
                run,
                CounterReading {
                    node,
                    at_us,
                    events,
                    rejects: counts("stale", stale),
                    shed: BTreeMap::new(),
                },
            );
        }
        assert!(losses.are_known());
        let sums = [("inbox_full", 7 + 4 + 26 + 2), ("stale", 1)]
            .map(|(name, times)| (name.to_owned(), times));
        assert_eq!(*losses.by_reason(), BTreeMap::from(sums));
        assert_eq!(losses.over_time().values(), [0.0, 7.0, 11.0, 38.0, 40.0]);
    }
}
