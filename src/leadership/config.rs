//! The election's settings.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::config::{ConfigError, check_range};
use crate::wire::Role;

/// Settings of the election on one node; `[election]` in the configuration file.
///
/// The timings must be the same on every node of a cell. Role and priority are set per node.
#[derive(Debug, Clone, PartialEq, Eq, Hash, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct ElectionConfig {
    /// Role of the node; taken from the node's `role`, not a key of this table. Default `auto`.
    #[serde(skip)]
    pub role: Role,
    /// Preference among nodes of one role; a higher value leads first. Default 100.
    pub priority: u8,
    /// Time between two beats of the leader to its standby, in ms. Other successors, and better
    /// candidates that are not yet fit, get every eighth beat. Default 50. A shorter time detects a
    /// silent leader sooner and costs packets.
    pub beat_ms: u64,
    /// Time between two beats of the leader to all other nodes, in ms. Default 2500. A shorter time
    /// costs packets in a large cell.
    pub idle_beat_ms: u64,
    /// Number of consecutive missing beats, without an accepted round, after which a leader counts
    /// as lost. Default 4. A lower value detects a loss faster, but more often mistakes lost
    /// packets for a lost leader.
    pub silence_beats: u32,
    /// Time for which a node listens after its start before it may lead, in ms. Default 1200. A
    /// longer time makes it more likely to find the existing leader, and makes a lone vehicle wait.
    pub join_ms: u64,
    /// Additional time that each next candidate waits before it claims leadership, in ms.
    /// Default 60. It must exceed the network's usual delay. Otherwise two candidates claim at
    /// once, and one candidate has to step down.
    pub claim_step_ms: u64,
    /// Time for which a better candidate must be fit and reachable before leadership is handed to
    /// it, in ms. Default 3000. A longer time avoids handovers to an unstable node, and keeps the
    /// substitute leader longer.
    pub stable_ms: u64,
    /// Time after which the leader gives up a handover, in ms. Default 3000.
    pub handover_ms: u64,
    /// Delay of a timer in ms above which the node counts as stalled. Default 40. Only this much of
    /// the delay counts as elapsed time.
    pub stall_ms: u64,
}

impl Default for ElectionConfig {
    fn default() -> Self {
        Self {
            role: Role::Auto,
            priority: 100,
            beat_ms: 50,
            idle_beat_ms: 2500,
            silence_beats: 4,
            join_ms: 1200,
            claim_step_ms: 60,
            stable_ms: 3000,
            handover_ms: 3000,
            stall_ms: 40,
        }
    }
}

impl ElectionConfig {
    /// Checks every value.
    ///
    /// # Errors
    /// Returns a [`ConfigError`] that names the first key that is out of range.
    pub fn validate(&self) -> Result<(), ConfigError> {
        let ms = |key, value: u64, low: f64, high: f64| check_range(key, value as f64, low, high);
        ms("beat_ms", self.beat_ms, 5.0, 10_000.0)?;
        ms(
            "idle_beat_ms",
            self.idle_beat_ms,
            self.beat_ms as f64,
            60_000.0,
        )?;
        check_range("silence_beats", f64::from(self.silence_beats), 2.0, 100.0)?;
        ms("join_ms", self.join_ms, 0.0, 60_000.0)?;
        ms("claim_step_ms", self.claim_step_ms, 1.0, 10_000.0)?;
        ms("stable_ms", self.stable_ms, 0.0, 3_600_000.0)?;
        ms("handover_ms", self.handover_ms, 10.0, 600_000.0)?;
        ms("stall_ms", self.stall_ms, 1.0, 10_000.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn defaults_are_valid_errors_name_key() {
        assert_eq!(ElectionConfig::default().validate(), Ok(()));
        let wrong = ElectionConfig {
            idle_beat_ms: 20,
            ..ElectionConfig::default()
        };
        assert_eq!(wrong.validate().unwrap_err().key, "idle_beat_ms");
    }
}
