//! The log line about a node's counters.

use std::collections::BTreeMap;

use serde_json::json;
use tracing::field::{DisplayValue, display};

use crate::telemetry::counters::Counters;
use crate::transport::gossip::FrameCounters;

/// Target of the line, whose fields are JSON objects.
pub(crate) const TARGET: &str = "ecod_actors::node::health";

/// Counts of one group by label.
type LoggedCounts = BTreeMap<String, u64>;

/// Counts at the time of the last line.
#[derive(Debug, Default)]
pub(super) struct HealthLog {
    events: LoggedCounts,
    rejects: LoggedCounts,
    shed: LoggedCounts,
    frames: LoggedCounts,
}

impl HealthLog {
    /// Logs the counters that have changed since the last line; without a change there is no line.
    pub(super) fn log(&mut self, counters: &Counters, frames: &FrameCounters) {
        let snapshot = counters.snapshot();
        let counts = counters.all_shed().into_iter().map(|shed| {
            (
                format!("{} {}", shed.reason.as_str(), shed.source),
                shed.times,
            )
        });
        let events = changed(&mut self.events, named(snapshot.events));
        let rejects = changed(&mut self.rejects, named(snapshot.rejects));
        let shed = changed(&mut self.shed, counts);
        let frames = changed(&mut self.frames, named(frames.snapshot()));
        if [&events, &rejects, &shed, &frames]
            .iter()
            .any(|it| it.is_some())
        {
            tracing::info!(target: TARGET, events, rejects, shed, frames, "health");
        }
    }
}

fn named(counts: BTreeMap<&'static str, u64>) -> impl Iterator<Item = (String, u64)> {
    counts
        .into_iter()
        .map(|(label, times)| (label.to_owned(), times))
}

/// The counts that differ from the logged ones, as a JSON object; `None` if all are equal.
fn changed(
    logged: &mut LoggedCounts,
    counts: impl Iterator<Item = (String, u64)>,
) -> Option<DisplayValue<String>> {
    let is_new = |(label, times): &(String, u64)| logged.get(label).unwrap_or(&0) != times;
    let news: LoggedCounts = counts.filter(is_new).collect();
    let text = (!news.is_empty()).then(|| display(json!(news).to_string()));
    logged.extend(news);
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_changed_counts_are_logged() {
        let mut logged = LoggedCounts::default();
        let mut line = |sent, lost| {
            let counts = [("sent".to_owned(), sent), ("lost".to_owned(), lost)];
            changed(&mut logged, counts.into_iter()).map(|text| text.to_string())
        };
        assert_eq!(line(3, 0).as_deref(), Some("{\"sent\":3}"));
        assert_eq!(line(3, 0), None);
        assert_eq!(line(3, 1).as_deref(), Some("{\"lost\":1}"));
    }
}
