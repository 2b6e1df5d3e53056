//! Log of nodes that were refused for their certificates, once for each cause.

use std::collections::BTreeSet;
use std::net::SocketAddr;

use ecod::model::names::NodeName;

/// Refusals that were logged. A holder of the cell's key can make up names, so their number is bounded.
#[derive(Debug, Default)]
pub(crate) struct Refusals {
    logged: BTreeSet<(NodeName, String)>,
}

/// Maximum refusals that are logged until the node's certificates change.
const MAX_LOGGED: usize = 64;

impl Refusals {
    /// Logs that a node is not admitted, unless the same was logged before.
    pub(crate) fn log(&mut self, name: &NodeName, from: SocketAddr, cause: &str) {
        let refusal = (name.clone(), cause.to_owned());
        if self.logged.len() >= MAX_LOGGED || !self.logged.insert(refusal) {
            return;
        }
        tracing::warn!(
            node = %name, %from, cause,
            "node not admitted; all nodes of a cell have `[tls]` or none has. Give it a certificate of the cell's CA \
             (`ecod-node pki issue`), or set the clocks of both machines if the cause is validity"
        );
    }
}
