//! The cell that is measured.

use ecod::model::names::NodeName;
use ecod::perception::landmark::LandmarkConfig;
use ecod::wire::Encoding;

use super::access::BrokerAccess;

/// The cell that is measured.
#[derive(Debug, Clone)]
pub struct Target {
    /// Where its data goes.
    pub access: BrokerAccess,
    /// Name of the cell, by which its topics are named.
    pub cell: NodeName,
    /// Landmarks of the cell, at which the simulated vehicles report objects.
    pub landmarks: Vec<LandmarkConfig>,
    /// Encoding in which reports are sent.
    pub encoding: Encoding,
    /// True if its rounds make verdicts.
    pub votes: bool,
    /// The aggregator's process, if it is on this machine and should be watched.
    pub aggregator: Option<u32>,
}
