//! Checking of configuration values: an error names the key, the value and what is allowed.

use std::fmt::Display;

/// A configuration value that cannot be used.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("configuration key `{key}`: {value} is not allowed, must be {allowed}")]
pub struct ConfigError {
    /// Full key, such as `pace.gate_m`.
    pub key: String,
    /// The value found.
    pub value: String,
    /// What would be accepted.
    pub allowed: String,
}

impl ConfigError {
    /// An error about one key.
    pub fn new(key: impl Into<String>, value: impl Display, allowed: impl Into<String>) -> Self {
        Self { key: key.into(), value: value.to_string(), allowed: allowed.into() }
    }

    /// The same error with the key below `section`.
    #[must_use]
    pub fn within(mut self, section: &str) -> Self {
        self.key = format!("{section}.{}", self.key);
        self
    }
}

/// Checks that `value` is a number from `low` to `high`.
///
/// # Errors
/// [`ConfigError`] otherwise, also for NaN.
pub fn check_range(key: &str, value: f64, low: f64, high: f64) -> Result<(), ConfigError> {
    if (low..=high).contains(&value) {
        Ok(())
    } else {
        Err(ConfigError::new(key, value, format!("a number from {low} to {high}")))
    }
}
