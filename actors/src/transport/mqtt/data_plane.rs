//! The brokers that carry a cell's data.

use super::address::BrokerAddress;

/// Which brokers carry a cell's reports and maps.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct DataPlane {
    /// A broker that belongs to no node and is used by all.
    pub external: Option<BrokerAddress>,
    /// Whether the brokers of leader and standby are used: without an external one always, beside it if configured, so
    /// that nothing has to be switched when it is gone or returns.
    pub embedded: bool,
}
