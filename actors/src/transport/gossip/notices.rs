//! Troubles with other hosts that a membership detects, for its caller.

use ecod::diagnostics::TroubleKind;

/// A trouble with a node or host.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct GossipNotice {
    /// Name of the node, or address of the host.
    pub(crate) about: String,
    pub(crate) kind: TroubleKind,
    pub(crate) cause: String,
}

/// Notices that have not been taken yet. One datagram causes one or two.
#[derive(Debug, Default)]
pub(crate) struct Notices(Vec<GossipNotice>);

impl Notices {
    pub(crate) fn add(
        &mut self,
        about: &impl ToString,
        kind: TroubleKind,
        cause: impl Into<String>,
    ) {
        self.0.push(GossipNotice {
            about: about.to_string(),
            kind,
            cause: cause.into(),
        });
    }

    /// All notices since the last call.
    pub(crate) fn take(&mut self) -> Vec<GossipNotice> {
        std::mem::take(&mut self.0)
    }
}
