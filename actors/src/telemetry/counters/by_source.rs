//! Counts of messages that were not used, by reason and source.

use std::collections::BTreeMap;
use std::sync::{Mutex, MutexGuard, PoisonError};

use ecod::admission::report_window::MAX_PARTS;
use ecod::model::names::vehicle_of;
use strum::{IntoStaticStr, VariantArray};

/// Reason for which a valid message was not used.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, IntoStaticStr, VariantArray)]
#[strum(serialize_all = "snake_case")]
pub enum ShedReason {
    /// A node, an address or a local client published more often than `broker.max_messages_hz`. The
    /// embedded broker dropped the message.
    BrokerThrottled,
    /// A client of the embedded broker read too slowly. The oldest message for it was dropped, or
    /// the rest when it was cut.
    ReaderSlow,
    /// A vehicle reported more often than `mqtt.max_report_hz`; the report was not decoded.
    ReportThrottled,
    /// A candidate shared evidence more often than `mqtt.max_report_hz`; the share was not decoded.
    LedgerThrottled,
    /// A node published its status more often than `mqtt.max_report_hz`; it was not decoded.
    StatusThrottled,
    /// A vehicle and its parts reported more than 6000 objects a second; the report was not
    /// fused.
    ObjectsThrottled,
    /// A newer report of the same vehicle arrived before the fuser read this one.
    ReportReplaced,
    /// A neighbouring cell sent maps more often than 20 times a second; the map was not decoded.
    CellThrottled,
}

impl ShedReason {
    /// All reasons in order of declaration.
    pub const ALL: &'static [Self] = Self::VARIANTS;

    /// The label of the reason's counter.
    pub fn as_str(self) -> &'static str {
        self.into()
    }
}

/// Messages of one source that were not used for one reason.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SourceCount<R> {
    /// Reason for which the messages were not used.
    pub reason: R,
    /// Name of the node, or address or id of the broker's client.
    pub source: String,
    /// Number of these messages so far.
    pub times: u64,
}

/// Messages of one source shed for one reason.
pub type Shed = SourceCount<ShedReason>;

/// Counts by reason and source.
#[derive(Debug)]
pub(super) struct CountsBySource<R>(Mutex<BTreeMap<R, BTreeMap<String, u64>>>);

impl<R> Default for CountsBySource<R> {
    fn default() -> Self {
        Self(Mutex::default())
    }
}

/// Maximum sources of each reason with a count of their own; further sources share [`OTHERS`]. Of
/// the parts of one vehicle, [`MAX_PARTS`] have one.
const MAX_TRACKED_SOURCES: usize = 64;

/// Source name under which further sources are counted together.
pub const OTHERS: &str = "others";

impl<R: Copy + Ord> CountsBySource<R> {
    /// Counts one message; true for the first of a source.
    pub(super) fn count(&self, reason: R, source: &str) -> bool {
        let mut counts = self.counts();
        let sources = counts.entry(reason).or_default();
        if let Some(times) = sources.get_mut(source) {
            *times += 1;
            return false;
        }
        let vehicle = vehicle_of(source);
        let is_part = |known: &&String| vehicle_of(known) == vehicle && **known != vehicle;
        let has_room = sources.len() < MAX_TRACKED_SOURCES
            && (source == vehicle || sources.keys().filter(is_part).count() < MAX_PARTS);
        *sources
            .entry(if has_room { source } else { OTHERS }.to_owned())
            .or_default() += 1;
        has_room
    }

    pub(super) fn snapshot(&self) -> Vec<SourceCount<R>> {
        let mut all = Vec::new();
        for (&reason, sources) in self.counts().iter() {
            all.extend(sources.iter().map(|(source, &times)| SourceCount {
                reason,
                source: source.clone(),
                times,
            }));
        }
        all
    }

    fn counts(&self) -> MutexGuard<'_, BTreeMap<R, BTreeMap<String, u64>>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn vehicle_parts_leave_room() {
        let rejects = CountsBySource::default();
        for part in 0..1000 {
            rejects.count(ShedReason::StatusThrottled, &format!("mallory--{part}"));
        }
        for source in ["mallory", "gauss", "10.0.0.7"] {
            assert!(
                rejects.count(ShedReason::StatusThrottled, source),
                "{source}"
            );
        }
        assert_eq!(rejects.snapshot().len(), MAX_PARTS + 1 + 3);
    }

    #[test]
    fn excess_sources_share_one_count() {
        let shed = CountsBySource::default();
        assert!(shed.count(ShedReason::ReaderSlow, "gauss"));
        for source in 0..2 * MAX_TRACKED_SOURCES {
            for time in 0..2 {
                let is_first = shed.count(ShedReason::ReportThrottled, &format!("v{source:03}"));
                assert_eq!(
                    is_first,
                    time == 0 && source < MAX_TRACKED_SOURCES,
                    "source {source}"
                );
            }
        }
        assert!(
            shed.count(ShedReason::LedgerThrottled, "gauss"),
            "each reason has room of its own"
        );
        let mut snapshot = shed.snapshot();
        snapshot.retain(|count| count.reason == ShedReason::ReportThrottled);
        assert_eq!(snapshot.len(), MAX_TRACKED_SOURCES + 1);
        assert_eq!(
            snapshot.iter().map(|count| count.times).sum::<u64>(),
            4 * MAX_TRACKED_SOURCES as u64
        );
        let others = snapshot
            .iter()
            .find(|count| count.source == OTHERS)
            .unwrap();
        assert_eq!(others.times, 2 * MAX_TRACKED_SOURCES as u64);
    }
}
