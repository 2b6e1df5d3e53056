//! Counters of events, rejected payloads and shed messages; cheap enough for every packet.

mod by_source;
mod floods;

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicU64, Ordering};

use ecod::diagnostics::TroubleKind;
use ecod::wire::RejectReason;
use strum::{IntoStaticStr, VariantArray};

pub use by_source::{OTHERS, Shed, ShedReason, SourceCount};

use by_source::CountsBySource;
use floods::Floods;

use crate::platform::clock;
use crate::telemetry::troubles::Troubles;

/// An event that is too frequent for the log.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, IntoStaticStr, VariantArray)]
#[strum(serialize_all = "snake_case")]
pub enum Event {
    /// A payload was handed to a broker connection.
    Published,
    /// A payload was not sent because a link was down or its queue full.
    PublishRefused,
    /// A payload was not sent because it is larger than receivers accept.
    PublishTooLarge,
    /// A packet arrived from a broker.
    Received,
    /// The broker sent back what this node had published; it was delivered in-process already.
    Echo,
    /// Another running node of this node's name published a status.
    NameConflict,
    /// A decoded message was dropped because its receivers were too far behind.
    InboxFull,
    /// A link was established.
    Connected,
    /// An established link was lost.
    Disconnected,
    /// An attempt to establish a link failed.
    ConnectFailed,
    /// A broker refused this node's credentials, a subscription, or its status; once per change.
    BrokerRefused,
    /// A map newer than all before was accepted.
    MapAccepted,
    /// A map, verdicts or reputations arrived again, as every message that arrives over two links
    /// does.
    Repeated,
    /// An object of a report had no effect on any vote, such as at an unknown landmark.
    VoteIgnored,
    /// A report was used for tracking only, because a later report of its vehicle had arrived
    /// first.
    ReportOvertaken,
    /// A report arrived too late for tracking.
    ReportLate,
    /// A new object was not tracked: there are too many tracks, or too many near it.
    ObjectRefused,
    /// An entry of a map, of verdicts or of reputations was left out, because a value in it is out
    /// of bounds.
    EntryLeftOut,
    /// Verdicts newer than all before were accepted.
    VerdictsAccepted,
    /// Reputations newer than all before were accepted.
    ReputationsAccepted,
    /// Evidence of another candidate was merged and held something new.
    LedgerMerged,
    /// Reputations were written to disk.
    ReputationsSaved,
    /// Reputations could not be written to disk.
    ReputationsNotSaved,
    /// An entry was written to the log.
    Recorded,
    /// An entry is not in the log: the writer was too far behind, or the disk refused it.
    RecordDropped,
    /// The log could not be written; once per attempt.
    RecordFailed,
    /// The fuser checked whether a round is due, published or not.
    RoundDue,
    /// The detector processed a camera frame.
    FrameDetected,
    /// A camera frame was encoded for browsers.
    FrameShown,
    /// A camera frame or image file could not be used.
    FrameFailed,
    /// A later camera frame replaced this one.
    FrameSkipped,
    /// A frame source failed or gave no frame in time; it is opened again.
    SourceFailed,
    /// A browser's request was refused for its token, its host name, or lack of room.
    BrowserRefused,
    /// A browser's request was refused because there were too many recently.
    BrowserThrottled,
    /// The dashboard's address could not be listened on.
    DashboardNotBound,
    /// A detection had no position in the world and is not in its report.
    DetectionUnplaced,
    /// A pose for a moving vehicle was malformed, or not later than the one before.
    PoseRejected,
    /// A frame of a moving vehicle was not reported: there is no pose near its time.
    FrameWithoutPose,
    /// The embedded broker refused a client: its address connects too often, or too many
    /// connections wait.
    ClientThrottled,
    /// A client of the embedded broker did not log in in time.
    ClientTimedOut,
    /// A client of the embedded broker has no valid certificate.
    ClientUntrusted,
    /// A client of the embedded broker did not begin with a login, or left during it.
    ClientMalformed,
    /// The embedded broker refused a client: as many as allowed are connected, in all or of its
    /// certificate or address.
    ClientsFull,
    /// The embedded broker refused a login, message or filter: another's name or topic, or beyond a
    /// limit.
    ClientDenied,
    /// Another node declared more in the election than its certificate allows.
    Overreached,
    /// The embedded broker cut off a client that did not read for 15 s, or for whose bytes there
    /// was no room.
    ClientStalled,
    /// The embedded broker cut off a client whose certificate was revoked or expired.
    ClientExpelled,
    /// A map of the cell was handed to the connection to the region's broker.
    RegionPublished,
    /// A map of the cell was not sent to the region: its broker is not connected or does not
    /// forward messages.
    RegionWithheld,
    /// A packet arrived from the region's broker.
    RegionReceived,
    /// A map of a neighbouring cell, newer than all of that cell before, was accepted.
    CellMapAccepted,
    /// An object of a neighbouring cell was not used: outside of the area that its cell may report,
    /// or beyond the maximum number.
    NeighbourRefused,
}

impl Event {
    /// All events in order of declaration.
    pub const ALL: &'static [Self] = Self::VARIANTS;

    /// The label of the event's counter.
    pub fn as_str(self) -> &'static str {
        self.into()
    }
}

/// The counters of one node, shared by its actors.
#[derive(Debug)]
pub struct Counters {
    events: [AtomicU64; Event::ALL.len()],
    rejects: [AtomicU64; RejectReason::ALL.len()],
    rejects_by_source: CountsBySource<RejectReason>,
    shed: CountsBySource<ShedReason>,
    floods: Floods<ShedReason>,
    lasting_rejects: Floods<RejectReason>,
    troubles: Troubles,
}

impl Default for Counters {
    fn default() -> Self {
        Self {
            events: [const { AtomicU64::new(0) }; Event::ALL.len()],
            rejects: [const { AtomicU64::new(0) }; RejectReason::ALL.len()],
            rejects_by_source: CountsBySource::default(),
            shed: CountsBySource::default(),
            floods: Floods::default(),
            lasting_rejects: Floods::default(),
            troubles: Troubles::default(),
        }
    }
}

impl Counters {
    /// Counts one occurrence of an event.
    pub fn count(&self, event: Event) {
        self.add(event, 1);
    }

    /// Counts an event that happened several times.
    pub fn add(&self, event: Event, times: u64) {
        self.events[event as usize].fetch_add(times, Ordering::Relaxed);
    }

    /// Counts a rejected payload other than a report, by its node, or by the broker if the sender
    /// is unavailable. It is a trouble, unless elections or re-ordering explain it.
    pub fn reject(&self, reason: RejectReason, source: &str) {
        self.reject_message(reason, source, || {
            format!("message rejected: {}", reason.in_words())
        });
    }

    /// Counts a rejected payload that a change of leader, or of the leader's certificate, explains
    /// unless it goes on for long.
    pub fn reject_if_lasting(&self, reason: RejectReason, source: &str) {
        if self.lasting_rejects.is_flood(reason, source, clock::now()) {
            self.reject(reason, source);
        } else {
            self.count_reject(reason, source);
        }
    }

    /// Counts a rejected payload as [`Self::reject`] does, with the cause as text.
    pub fn reject_message(
        &self,
        reason: RejectReason,
        source: &str,
        cause: impl FnOnce() -> String,
    ) {
        self.count_reject(reason, source);
        if trouble_of(reason).is_some() {
            self.troubles
                .record_about_with(source, TroubleKind::MessageRefused, cause);
        }
    }

    /// Counts a rejected report, with the cause as text.
    pub fn reject_report(
        &self,
        reason: RejectReason,
        source: &str,
        cause: impl FnOnce() -> String,
    ) {
        self.count_reject(reason, source);
        if let Some(kind) = trouble_of(reason) {
            self.troubles.record_about_with(source, kind, cause);
        }
    }

    /// Counts a rejected payload whose trouble, if it is one, is noted elsewhere.
    pub fn count_reject(&self, reason: RejectReason, source: &str) {
        self.rejects[reason as usize].fetch_add(1, Ordering::Relaxed);
        self.rejects_by_source.count(reason, source);
    }

    /// The node's current troubles.
    pub fn troubles(&self) -> &Troubles {
        &self.troubles
    }

    /// Payloads rejected so far, by reason and source.
    pub fn rejects_by_source(&self) -> Vec<SourceCount<RejectReason>> {
        self.rejects_by_source.snapshot()
    }

    /// Counts a message that was shed under overload. It is a trouble if it goes on for long.
    pub fn shed(&self, reason: ShedReason, source: &str) {
        self.shed.count(reason, source);
        let cause = match reason {
            ShedReason::ReaderSlow => "reads too slowly and misses the oldest messages",
            // A busy fuser uses the later report: the vehicle need not be informed.
            ShedReason::ReportReplaced => return,
            _ if !self.floods.is_flood(reason, source, clock::now()) => return,
            _ => "sends more than is taken, the rest is not used",
        };
        self.troubles.record_about(
            source,
            TroubleKind::Overload,
            &format!("{cause} ({})", reason.as_str()),
        );
    }

    /// Counts a message for a client of the broker whose connection stands still in both directions.
    pub fn shed_cut_off(&self, source: &str) {
        self.shed.count(ShedReason::ReaderSlow, source);
        self.troubles.record_about(
            source,
            TroubleKind::NetworkCut,
            "its connection stands still in both directions: the network is cut, or its machine has stopped",
        );
    }

    /// Shed messages so far, by reason and source.
    pub fn all_shed(&self) -> Vec<Shed> {
        self.shed.snapshot()
    }

    /// Occurrences of an event.
    pub fn events(&self, event: Event) -> u64 {
        self.events[event as usize].load(Ordering::Relaxed)
    }

    /// Payloads rejected for a reason.
    pub fn rejects(&self, reason: RejectReason) -> u64 {
        self.rejects[reason as usize].load(Ordering::Relaxed)
    }

    /// All counts by label, zeros included: a metric exists before its first event.
    pub fn snapshot(&self) -> CounterSnapshot {
        let mut shed: BTreeMap<_, _> = ShedReason::ALL
            .iter()
            .map(|reason| (reason.as_str(), 0))
            .collect();
        for Shed { reason, times, .. } in self.all_shed() {
            *shed.entry(reason.as_str()).or_default() += times;
        }
        CounterSnapshot {
            events: Event::ALL
                .iter()
                .map(|event| (event.as_str(), self.events(*event)))
                .collect(),
            rejects: RejectReason::ALL
                .map(|reason| (reason.as_str(), self.rejects(reason)))
                .into(),
            shed,
        }
    }
}

/// The trouble indicated by a reason for which a report is rejected. Some reasons also occur
/// without a fault: around a change of leader, or on a network that re-orders.
fn trouble_of(reason: RejectReason) -> Option<TroubleKind> {
    use RejectReason as Reason;
    match reason {
        Reason::NotCandidate
        | Reason::NotElected
        | Reason::NotPlaced
        | Reason::OutOfOrder
        | Reason::Stale
        | Reason::Superseded
        | Reason::UnknownTerm => None,
        Reason::FromTheFuture => Some(TroubleKind::Untimely),
        Reason::NotFused => Some(TroubleKind::NotFused),
        Reason::TooManyVehicles | Reason::TooManyCells => Some(TroubleKind::Overload),
        Reason::BadSignature | Reason::Unattested | Reason::Implausible | Reason::NotPermitted => {
            Some(TroubleKind::NotPermitted)
        }
        Reason::TooLarge
        | Reason::Malformed
        | Reason::UnknownSchema
        | Reason::NodeMismatch
        | Reason::TooManyObjects
        | Reason::NotFinite
        | Reason::OutOfRange
        | Reason::ConfidenceOutOfRange
        | Reason::InvalidLabel
        | Reason::UnknownTopic => Some(TroubleKind::Malformed),
    }
}

/// All counters of a node at one moment.
#[derive(Debug, Clone, PartialEq, Eq, serde::Serialize)]
pub struct CounterSnapshot {
    /// Counts of [`Event`]s by label.
    pub events: BTreeMap<&'static str, u64>,
    /// Rejected payloads by [`RejectReason`].
    pub rejects: BTreeMap<&'static str, u64>,
    /// Shed messages by [`ShedReason`].
    pub shed: BTreeMap<&'static str, u64>,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn evidence_rejections_count_separately() {
        let counters = Counters::default();
        counters.reject(RejectReason::Unattested, "euclid");
        counters.reject(RejectReason::Superseded, "gauss");
        let present = counters.troubles().present();
        let shown: Vec<_> = present
            .iter()
            .map(|trouble| (&*trouble.kind, trouble.about.as_deref()))
            .collect();
        assert_eq!(shown, [("message_refused", Some("euclid"))]);
        assert!(!TroubleKind::MessageRefused.refuses_reports());
    }

    #[test]
    fn explained_refusal_is_no_trouble() {
        let counters = Counters::default();
        for _ in 0..1000 {
            counters.reject_if_lasting(RejectReason::BadSignature, "euclid");
        }
        assert_eq!(counters.rejects(RejectReason::BadSignature), 1000);
        assert_eq!(counters.troubles().present(), []);
    }

    #[test]
    fn every_reason_has_separate_counter() {
        let counters = Counters::default();
        for (times, reason) in RejectReason::ALL.into_iter().enumerate() {
            (0..times).for_each(|_| counters.reject(reason, "euclid"));
        }
        for (times, event) in Event::ALL.iter().enumerate() {
            (0..times).for_each(|_| counters.count(*event));
        }
        for (times, reason) in RejectReason::ALL.into_iter().enumerate() {
            assert_eq!(counters.rejects(reason), times as u64, "{reason}");
        }
        for (times, event) in Event::ALL.iter().enumerate() {
            assert_eq!(counters.events(*event), times as u64, "{event:?}");
        }
        let named = counters.rejects_by_source();
        assert!(
            named
                .iter()
                .all(|count| count.source == "euclid"
                    && count.times == counters.rejects(count.reason))
        );
        assert_eq!(named.len(), RejectReason::ALL.len() - 1);
        let snapshot = counters.snapshot();
        assert_eq!(
            (snapshot.events.len(), snapshot.rejects.len()),
            (Event::ALL.len(), RejectReason::ALL.len())
        );
    }
}
