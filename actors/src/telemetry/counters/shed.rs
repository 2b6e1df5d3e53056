//! Counts of messages shed under overload, by reason and source.

use std::collections::BTreeMap;
use std::sync::{Mutex, MutexGuard, PoisonError};

use strum::{IntoStaticStr, VariantArray};

/// Reason for which a valid message was not used.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, IntoStaticStr, VariantArray)]
#[strum(serialize_all = "snake_case")]
pub enum ShedReason {
    /// A node, an address or a local client published more often than `broker.max_messages_hz`. The embedded broker
    /// dropped the message.
    BrokerThrottled,
    /// A client of the embedded broker read too slowly. The oldest message for it was dropped, or the rest when it was cut.
    ReaderSlow,
    /// A vehicle reported more often than `mqtt.max_report_hz`; the report was not decoded.
    ReportThrottled,
    /// A candidate shared evidence more often than `mqtt.max_report_hz`; the share was not decoded.
    LedgerThrottled,
    /// A node published its status more often than `mqtt.max_report_hz`; it was not decoded.
    StatusThrottled,
    /// A newer report of the same vehicle came before the fuser read this one.
    ReportReplaced,
}

impl ShedReason {
    /// All reasons.
    pub const ALL: &'static [Self] = Self::VARIANTS;

    /// The label of the reason's counter.
    pub fn as_str(self) -> &'static str {
        self.into()
    }
}

/// Messages of one source shed for one reason.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Shed {
    /// Why.
    pub reason: ShedReason,
    /// Name of the node, or address or id of the broker's client.
    pub source: String,
    /// Number of messages.
    pub times: u64,
}

/// Counts by reason and source.
#[derive(Debug, Default)]
pub(super) struct Shedding {
    counts: Mutex<BTreeMap<(ShedReason, String), u64>>,
}

/// Maximum pairs of reason and source with a count of their own; further sources share [`OTHERS`].
const MAX_TRACKED_SOURCES: usize = 64;

/// Source name under which further sources are counted together.
pub const OTHERS: &str = "others";

impl Shedding {
    /// Counts one message; the first of each source is also a warning.
    pub(super) fn count(&self, reason: ShedReason, source: &str) {
        let mut counts = self.counts();
        let key = (reason, source.to_owned());
        if let Some(times) = counts.get_mut(&key) {
            *times += 1;
        } else if counts.len() < MAX_TRACKED_SOURCES {
            counts.insert(key, 1);
            tracing::warn!(source, reason = reason.as_str(), "more comes in than is taken, the rest is left out");
        } else {
            *counts.entry((reason, OTHERS.to_owned())).or_default() += 1;
        }
    }

    /// Counts by reason over all sources, zeros included.
    pub(super) fn sums(&self) -> BTreeMap<&'static str, u64> {
        let mut sums: BTreeMap<_, _> = ShedReason::ALL.iter().map(|reason| (reason.as_str(), 0)).collect();
        for ((reason, _), times) in &*self.counts() {
            *sums.entry(reason.as_str()).or_default() += times;
        }
        sums
    }

    pub(super) fn snapshot(&self) -> Vec<Shed> {
        let shed = |((reason, source), times): (&(ShedReason, String), &u64)| Shed {
            reason: *reason,
            source: source.clone(),
            times: *times,
        };
        self.counts().iter().map(shed).collect()
    }

    fn counts(&self) -> MutexGuard<'_, BTreeMap<(ShedReason, String), u64>> {
        self.counts.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sources_are_told_apart_until_there_are_too_many() {
        let shedding = Shedding::default();
        for source in 0..2 * MAX_TRACKED_SOURCES {
            for _ in 0..2 {
                shedding.count(ShedReason::ReportThrottled, &format!("v{source:03}"));
            }
        }
        let snapshot = shedding.snapshot();
        assert_eq!(snapshot.len(), MAX_TRACKED_SOURCES + 1);
        assert_eq!(snapshot.iter().map(|shed| shed.times).sum::<u64>(), 4 * MAX_TRACKED_SOURCES as u64);
        let others = snapshot.iter().find(|shed| shed.source == OTHERS).unwrap();
        assert_eq!(others.times, 2 * MAX_TRACKED_SOURCES as u64);
        let sums = shedding.sums();
        let expected = [
            ("broker_throttled", 0),
            ("ledger_throttled", 0),
            ("reader_slow", 0),
            ("report_replaced", 0),
            ("status_throttled", 0),
        ];
        assert_eq!(
            sums,
            BTreeMap::from_iter(expected.into_iter().chain([("report_throttled", 4 * MAX_TRACKED_SOURCES as u64)]))
        );
    }
}
