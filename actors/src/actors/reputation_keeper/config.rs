//! The periods of the keeper.

use std::time::Duration;

use ecod::config::{ConfigError, check_range};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Periods at which reputations are published, saved and replicated.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct ReputationKeeperConfig {
    /// Seconds between publications; changes are saved before each. Default 1. A higher value
    /// reduces writes to a flash disk, and loses correspondingly more evidence when a node crashes.
    pub publish_period_s: f64,
    /// Seconds between shares of all evidence with the other candidates. Default 10. Changes are
    /// shared after each round.
    pub snapshot_period_s: f64,
}

impl Default for ReputationKeeperConfig {
    fn default() -> Self {
        Self {
            publish_period_s: 1.0,
            snapshot_period_s: 10.0,
        }
    }
}

impl ReputationKeeperConfig {
    /// Checks every value.
    ///
    /// # Errors
    /// Returns a [`ConfigError`] that names the key, the value and the allowed range.
    pub fn validate(&self) -> Result<(), ConfigError> {
        check_range("publish_period_s", self.publish_period_s, 0.05, 3600.0)?;
        check_range(
            "snapshot_period_s",
            self.snapshot_period_s,
            self.publish_period_s,
            36_000.0,
        )
    }

    pub(super) fn publish_period(&self) -> Duration {
        Duration::from_secs_f64(self.publish_period_s)
    }

    pub(super) fn ticks_per_snapshot(&self) -> u32 {
        (self.snapshot_period_s / self.publish_period_s).round() as u32
    }
}
