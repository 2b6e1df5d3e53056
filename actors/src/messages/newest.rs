//! The newest messages of a cell, as a node accepted them.

use std::sync::Arc;

use ecod::model::time::Timestamp;
use ecod::wire::{GlobalMap, Reputations, Verdicts};
use serde::{Deserialize, Serialize};
use tokio::sync::watch;

/// A message and when it came.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Received<T> {
    /// When it came, by this node's clock.
    #[serde(rename = "received_at_us")]
    pub received_at: Timestamp,
    /// The message.
    pub message: Arc<T>,
}

/// Where the newest of everything is seen as it changes.
#[derive(Debug, Clone)]
pub struct Newest {
    /// The newest map.
    pub map: watch::Sender<Option<ReceivedMap>>,
    /// The newest verdicts.
    pub verdicts: watch::Sender<Option<Received<Verdicts>>>,
    /// The newest reputations.
    pub reputations: watch::Sender<Option<Received<Reputations>>>,
}

impl Default for Newest {
    fn default() -> Self {
        let (map, verdicts) = (watch::Sender::new(None), watch::Sender::new(None));
        Self {
            map,
            verdicts,
            reputations: watch::Sender::new(None),
        }
    }
}

/// A map and when it came; one line of a map log.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ReceivedMap {
    /// When it came, by this node's clock.
    #[serde(rename = "received_at_us")]
    pub received_at: Timestamp,
    /// The map.
    pub map: Arc<GlobalMap>,
}
