//! Topics that a node subscribes to.

/// Role of a node as a subscriber.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SubscriptionRole {
    /// Maps, verdicts, reputations, the cell's description and statuses.
    Follower,
    /// Also reports and evidence: the node records them.
    Observer,
    /// Also reports and evidence: the node aggregates or may have to.
    Candidate,
}

/// Filters of vehicles' reports, below the cell's root.
pub(crate) const REPORTS: [&str; 2] = ["detections/+", "vote_detections/+"];

impl SubscriptionRole {
    /// All filters of the role, below the cell's root. Reports come last: without them, the other
    /// filters keep their index, by which a SUBACK refers to them.
    pub(crate) fn filters(self) -> &'static [&'static str] {
        match self {
            Self::Follower => &[
                "global_detections",
                "global_verdicts",
                "reputations",
                "cell",
                "nodes/+",
                "detections/+",
                "vote_detections/+",
            ],
            Self::Observer | Self::Candidate => &[
                "global_detections",
                "global_verdicts",
                "reputations",
                "cell",
                "nodes/+",
                "ledger/+",
                "detections/+",
                "vote_detections/+",
            ],
        }
    }
}
