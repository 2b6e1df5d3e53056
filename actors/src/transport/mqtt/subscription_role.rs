//! Which topics a node takes.

/// Which topics a node takes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SubscriptionRole {
    /// Maps, verdicts, reputations and statuses.
    Follower,
    /// Also reports and evidence: the node records them.
    Observer,
    /// Also reports and evidence: the node aggregates or may have to.
    Candidate,
}

/// Where vehicles report.
pub(crate) const REPORTS: [&str; 2] = ["detections/+", "vote_detections/+"];

impl SubscriptionRole {
    /// All that the node may subscribe to. Reports come last: wherever they are left out, a level keeps its place, by
    /// which a broker names it.
    pub(crate) fn filters(self) -> &'static [&'static str] {
        match self {
            Self::Follower => {
                &["global_detections", "global_verdicts", "reputations", "nodes/+", "detections/+", "vote_detections/+"]
            }
            Self::Observer | Self::Candidate => &[
                "global_detections",
                "global_verdicts",
                "reputations",
                "nodes/+",
                "ledger/+",
                "detections/+",
                "vote_detections/+",
            ],
        }
    }
}
