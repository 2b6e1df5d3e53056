//! What is left out under overload, by reason and source.

use std::collections::BTreeMap;
use std::sync::{Mutex, MutexGuard, PoisonError};

/// Why something that came in was left out though nothing is wrong with it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum ShedReason {
    /// A node, an address or a client of this machine published more than `broker.max_messages_hz`; the embedded broker
    /// passed the message on to nobody.
    BrokerThrottled,
    /// A vehicle reported more often than `mqtt.max_report_hz`; the report was not decoded.
    ReportThrottled,
    /// A candidate shared evidence more often than `mqtt.max_report_hz`; the share was not decoded.
    LedgerThrottled,
    /// A node told its status more often than `mqtt.max_report_hz`; it was not decoded.
    StatusThrottled,
    /// A newer report of the same vehicle came before the fuser had taken this one.
    ReportReplaced,
}

impl ShedReason {
    /// All reasons.
    pub const ALL: [Self; 5] = [
        Self::BrokerThrottled,
        Self::ReportThrottled,
        Self::LedgerThrottled,
        Self::StatusThrottled,
        Self::ReportReplaced,
    ];

    /// The reason as a counter's label.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::BrokerThrottled => "broker_throttled",
            Self::ReportThrottled => "report_throttled",
            Self::LedgerThrottled => "ledger_throttled",
            Self::StatusThrottled => "status_throttled",
            Self::ReportReplaced => "report_replaced",
        }
    }
}

/// How much of whose was left out for one reason.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Shed {
    /// Why.
    pub reason: ShedReason,
    /// The vehicle, or the client of the broker.
    pub source: String,
    /// How many messages.
    pub times: u64,
}

/// Counts by reason and source; a bounded number of sources is told apart.
#[derive(Debug, Default)]
pub(super) struct Shedding {
    counts: Mutex<BTreeMap<(ShedReason, String), u64>>,
}

/// Most pairs of reason and source that are told apart; further sources are counted together.
const MAX_SOURCES: usize = 64;

/// The source of what further sources send.
pub const OTHERS: &str = "others";

impl Shedding {
    /// Counts one message, and warns of the first of a source.
    pub(super) fn count(&self, reason: ShedReason, source: &str) {
        let mut counts = self.counts();
        let key = (reason, source.to_owned());
        if let Some(times) = counts.get_mut(&key) {
            *times += 1;
        } else if counts.len() < MAX_SOURCES {
            counts.insert(key, 1);
            tracing::warn!(source, reason = reason.as_str(), "more comes in than is taken, the rest is left out");
        } else {
            *counts.entry((reason, OTHERS.to_owned())).or_default() += 1;
        }
    }

    /// How much was left out for each reason, whoever sent it; zeros are left in.
    pub(super) fn sums(&self) -> BTreeMap<&'static str, u64> {
        let mut sums: BTreeMap<_, _> = ShedReason::ALL.map(|reason| (reason.as_str(), 0)).into();
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
        for source in 0..2 * MAX_SOURCES {
            for _ in 0..2 {
                shedding.count(ShedReason::ReportThrottled, &format!("v{source:03}"));
            }
        }
        let snapshot = shedding.snapshot();
        assert_eq!(snapshot.len(), MAX_SOURCES + 1);
        assert_eq!(snapshot.iter().map(|shed| shed.times).sum::<u64>(), 4 * MAX_SOURCES as u64);
        let others = snapshot.iter().find(|shed| shed.source == OTHERS).unwrap();
        assert_eq!(others.times, 2 * MAX_SOURCES as u64);
        let sums = shedding.sums();
        let expected =
            [("broker_throttled", 0), ("ledger_throttled", 0), ("report_replaced", 0), ("status_throttled", 0)];
        assert_eq!(
            sums,
            BTreeMap::from_iter(expected.into_iter().chain([("report_throttled", 4 * MAX_SOURCES as u64)]))
        );
    }
}
