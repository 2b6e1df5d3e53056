//! What went wrong or was left out, counted by reason: cheap enough for every packet.

mod shed;

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicU64, Ordering};

use ecod::wire::RejectReason;

pub use shed::{OTHERS, Shed, ShedReason};

use shed::Shedding;

/// Something that happens often enough to be counted rather than logged.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Event {
    /// A payload was handed to a broker connection.
    Published,
    /// A payload was not sent because a link was down or its queue full.
    PublishRefused,
    /// A payload was not sent because it is larger than receivers take.
    PublishTooLarge,
    /// A packet came in from a broker.
    Received,
    /// The broker sent back what this node had published; it was delivered in-process already.
    Echo,
    /// Another living node of this node's name said something about itself.
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
    /// A map newer than all before was taken.
    MapAccepted,
    /// A map, verdicts or reputations of the leadership taken last came again, as all do that have two ways here.
    Repeated,
    /// An object voted for nothing, such as at an unknown landmark.
    VoteIgnored,
    /// A report was used for tracking alone: a later one of its vehicle came before.
    ReportOvertaken,
    /// A report came too late for tracking.
    ReportLate,
    /// A new object was not tracked: there are too many, or too many near it.
    ObjectRefused,
    /// Verdicts newer than all before were taken.
    VerdictsAccepted,
    /// Reputations newer than all before were taken.
    ReputationsAccepted,
    /// Another candidate's evidence was taken in and held something new.
    LedgerMerged,
    /// Reputations were written to disk.
    ReputationsSaved,
    /// Reputations could not be written to disk.
    ReputationsNotSaved,
    /// An entry was written to the log.
    Recorded,
    /// An entry is not in the log: the writer was too far behind, or the disk took nothing.
    RecordDropped,
    /// The log could not be written; once per attempt.
    RecordFailed,
    /// The fuser looked whether a round is due, published or not.
    RoundDue,
    /// A camera frame was looked at.
    FrameDetected,
    /// A camera frame or image file could not be used.
    FrameFailed,
    /// A camera frame gave way to a later one.
    FrameSkipped,
    /// A camera or another source of frames failed or gave none in time; it is opened again.
    SourceFailed,
    /// A browser's request was refused: a wrong or missing token, a foreign host name, or no room.
    BrowserRefused,
    /// A browser's request was refused because too many were made lately.
    BrowserThrottled,
    /// The dashboard's address could not be listened on.
    DashboardNotBound,
    /// A detection could not be placed in the world and was left out of its report.
    DetectionUnplaced,
    /// A pose that a moving vehicle was told is none, or is not later than the one before.
    PoseRejected,
    /// A frame of a moving vehicle was not reported: no pose is known near its time.
    FrameWithoutPose,
    /// A client of the embedded broker was not let in: its address made too many connections lately, or too many wait.
    ClientThrottled,
    /// A client of the embedded broker did not log in within the time.
    ClientTimedOut,
    /// A client of the embedded broker showed no certificate, or one that is not valid.
    ClientUntrusted,
    /// A client of the embedded broker began with something else than a login, or left during it.
    ClientMalformed,
    /// A client of the embedded broker was not let in: as many as allowed are connected, in all or of its certificate
    /// or address.
    ClientsFull,
    /// A client of the embedded broker spoke in another's name, or said more than may be said or kept: its login or
    /// message was refused.
    ClientDenied,
    /// A client of the embedded broker was cut off: its certificate was revoked or expired.
    ClientExpelled,
}

impl Event {
    /// All events, for snapshots.
    pub const ALL: [Self; 43] = [
        Self::Published,
        Self::PublishRefused,
        Self::PublishTooLarge,
        Self::Received,
        Self::Echo,
        Self::NameConflict,
        Self::InboxFull,
        Self::Connected,
        Self::Disconnected,
        Self::ConnectFailed,
        Self::BrokerRefused,
        Self::MapAccepted,
        Self::Repeated,
        Self::VoteIgnored,
        Self::ReportOvertaken,
        Self::ReportLate,
        Self::ObjectRefused,
        Self::VerdictsAccepted,
        Self::ReputationsAccepted,
        Self::LedgerMerged,
        Self::ReputationsSaved,
        Self::ReputationsNotSaved,
        Self::Recorded,
        Self::RecordDropped,
        Self::RecordFailed,
        Self::RoundDue,
        Self::FrameDetected,
        Self::FrameFailed,
        Self::FrameSkipped,
        Self::SourceFailed,
        Self::BrowserRefused,
        Self::BrowserThrottled,
        Self::DashboardNotBound,
        Self::DetectionUnplaced,
        Self::PoseRejected,
        Self::FrameWithoutPose,
        Self::ClientThrottled,
        Self::ClientTimedOut,
        Self::ClientUntrusted,
        Self::ClientMalformed,
        Self::ClientsFull,
        Self::ClientDenied,
        Self::ClientExpelled,
    ];

    /// The event as a counter's label.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Published => "published",
            Self::PublishRefused => "publish_refused",
            Self::PublishTooLarge => "publish_too_large",
            Self::Received => "received",
            Self::Echo => "echo",
            Self::NameConflict => "name_conflict",
            Self::InboxFull => "inbox_full",
            Self::Connected => "connected",
            Self::Disconnected => "disconnected",
            Self::ConnectFailed => "connect_failed",
            Self::BrokerRefused => "broker_refused",
            Self::MapAccepted => "map_accepted",
            Self::Repeated => "repeated",
            Self::VoteIgnored => "vote_ignored",
            Self::ReportOvertaken => "report_overtaken",
            Self::ReportLate => "report_late",
            Self::ObjectRefused => "object_refused",
            Self::VerdictsAccepted => "verdicts_accepted",
            Self::ReputationsAccepted => "reputations_accepted",
            Self::LedgerMerged => "ledger_merged",
            Self::ReputationsSaved => "reputations_saved",
            Self::ReputationsNotSaved => "reputations_not_saved",
            Self::Recorded => "recorded",
            Self::RecordDropped => "record_dropped",
            Self::RecordFailed => "record_failed",
            Self::RoundDue => "round_due",
            Self::FrameDetected => "frame_detected",
            Self::FrameFailed => "frame_failed",
            Self::FrameSkipped => "frame_skipped",
            Self::SourceFailed => "source_failed",
            Self::BrowserRefused => "browser_refused",
            Self::BrowserThrottled => "browser_throttled",
            Self::DashboardNotBound => "dashboard_not_bound",
            Self::DetectionUnplaced => "detection_unplaced",
            Self::PoseRejected => "pose_rejected",
            Self::FrameWithoutPose => "frame_without_pose",
            Self::ClientThrottled => "client_throttled",
            Self::ClientTimedOut => "client_timed_out",
            Self::ClientUntrusted => "client_untrusted",
            Self::ClientMalformed => "client_malformed",
            Self::ClientsFull => "clients_full",
            Self::ClientDenied => "client_denied",
            Self::ClientExpelled => "client_expelled",
        }
    }
}

/// The counters of one node, shared by its actors.
#[derive(Debug)]
pub struct Counters {
    events: [AtomicU64; Event::ALL.len()],
    rejects: [AtomicU64; RejectReason::ALL.len()],
    shedding: Shedding,
}

impl Default for Counters {
    fn default() -> Self {
        Self {
            events: [const { AtomicU64::new(0) }; Event::ALL.len()],
            rejects: [const { AtomicU64::new(0) }; RejectReason::ALL.len()],
            shedding: Shedding::default(),
        }
    }
}

impl Counters {
    /// Counts an event.
    pub fn count(&self, event: Event) {
        self.add(event, 1);
    }

    /// Counts an event that happened several times.
    pub fn add(&self, event: Event, times: u64) {
        self.events[event as usize].fetch_add(times, Ordering::Relaxed);
    }

    /// Counts a payload that was not used.
    pub fn reject(&self, reason: RejectReason) {
        self.rejects[reason as usize].fetch_add(1, Ordering::Relaxed);
    }

    /// Counts something that was left out under overload, and warns of the first of a source.
    pub fn shed(&self, reason: ShedReason, source: &str) {
        self.shedding.count(reason, source);
    }

    /// What was left out so far, by reason and source.
    pub fn all_shed(&self) -> Vec<Shed> {
        self.shedding.snapshot()
    }

    /// How often an event happened.
    pub fn events(&self, event: Event) -> u64 {
        self.events[event as usize].load(Ordering::Relaxed)
    }

    /// How many payloads were not used for this reason.
    pub fn rejects(&self, reason: RejectReason) -> u64 {
        self.rejects[reason as usize].load(Ordering::Relaxed)
    }

    /// All counts by label; zeros are left in, so that a metric exists before it matters.
    pub fn snapshot(&self) -> CounterSnapshot {
        CounterSnapshot {
            events: Event::ALL.map(|event| (event.as_str(), self.events(event))).into(),
            rejects: RejectReason::ALL.map(|reason| (reason.as_str(), self.rejects(reason))).into(),
            shed: self.shedding.sums(),
        }
    }
}

/// All counters of a node at one moment.
#[derive(Debug, Clone, PartialEq, Eq, serde::Serialize)]
pub struct CounterSnapshot {
    /// Counts of [`Event`]s by label.
    pub events: BTreeMap<&'static str, u64>,
    /// Payloads that were not used, by [`RejectReason`].
    pub rejects: BTreeMap<&'static str, u64>,
    /// What was left out under overload, by [`ShedReason`].
    pub shed: BTreeMap<&'static str, u64>,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_reason_and_event_has_its_own_counter() {
        let counters = Counters::default();
        for (times, reason) in RejectReason::ALL.into_iter().enumerate() {
            (0..times).for_each(|_| counters.reject(reason));
        }
        for (times, event) in Event::ALL.into_iter().enumerate() {
            (0..times).for_each(|_| counters.count(event));
        }
        for (times, reason) in RejectReason::ALL.into_iter().enumerate() {
            assert_eq!(counters.rejects(reason), times as u64, "{reason}");
        }
        for (times, event) in Event::ALL.into_iter().enumerate() {
            assert_eq!(counters.events(event), times as u64, "{event:?}");
        }
        let snapshot = counters.snapshot();
        assert_eq!((snapshot.events.len(), snapshot.rejects.len()), (Event::ALL.len(), RejectReason::ALL.len()));
    }
}
