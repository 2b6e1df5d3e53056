//! Log of nodes that were refused for their certificates, once for each cause.

use std::collections::BTreeSet;
use std::net::SocketAddr;

use ecod::model::names::NodeName;

/// Refusals that were logged: node, and cause without its numbers, which are times that differ at each attempt.
/// A holder of the cell's key can make up names, so their number is bounded.
#[derive(Debug, Default)]
pub(crate) struct Refusals {
    logged: BTreeSet<(NodeName, String)>,
}

/// Maximum refusals that are logged until the node's certificates change.
const MAX_LOGGED: usize = 64;

impl Refusals {
    /// Logs that a node is not admitted, unless the same was logged before.
    pub(crate) fn log(&mut self, name: &NodeName, from: SocketAddr, cause: &str) {
        if self.logged.len() >= MAX_LOGGED || !self.is_new(name, cause) {
            return;
        }
        tracing::warn!(
            node = %name, %from, cause,
            "node not admitted; all nodes of a cell have `[tls]` or none has. Give it a certificate of the cell's CA \
             (`ecod-node pki issue`), or set the clocks of both machines if the cause is validity"
        );
    }

    fn is_new(&mut self, name: &NodeName, cause: &str) -> bool {
        self.logged.insert((name.clone(), cause.replace(|character: char| character.is_ascii_digit(), "")))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_cause_that_counts_seconds_is_one_cause() {
        let (mut refusals, gauss) = (Refusals::default(), NodeName::from_static("gauss"));
        assert!(refusals.is_new(&gauss, "certificate expired: verification time 1700000010 (10 seconds ago)"));
        assert!(!refusals.is_new(&gauss, "certificate expired: verification time 1700000011 (11 seconds ago)"));
        assert!(refusals.is_new(&gauss, "certificate revoked"));
        assert!(refusals.is_new(&NodeName::from_static("euclid"), "certificate revoked"));
    }
}
