//! The newest messages of a cell, as a node accepted them.

use std::sync::Arc;

use ecod::model::time::Timestamp;
use ecod::wire::{GlobalMap, Reputations, Verdicts};
use serde::{Deserialize, Serialize};
use tokio::sync::watch;

/// A message and its time of receipt.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Received<T> {
    /// Time of receipt by this node's clock.
    #[serde(rename = "received_at_us")]
    pub received_at: Timestamp,
    /// The message as it was accepted.
    pub message: Arc<T>,
}

/// Watches of the newest messages of each kind.
#[derive(Debug, Clone)]
pub struct Newest {
    /// Newest accepted map; `None` before the first.
    pub map: watch::Sender<Option<ReceivedMap>>,
    /// Newest accepted verdicts; `None` before the first.
    pub verdicts: watch::Sender<Option<Received<Verdicts>>>,
    /// Newest accepted reputations; `None` before the first.
    pub reputations: watch::Sender<Option<Received<Reputations>>>,
}

impl Default for Newest {
    fn default() -> Self {
        let map = watch::Sender::new(None);
        let verdicts = watch::Sender::new(None);
        Self {
            map,
            verdicts,
            reputations: watch::Sender::new(None),
        }
    }
}

/// A map and its time of receipt; one line of a map log.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ReceivedMap {
    /// Time of receipt by this node's clock.
    #[serde(rename = "received_at_us")]
    pub received_at: Timestamp,
    /// The map as it was accepted.
    pub map: Arc<GlobalMap>,
}
