//! Configuration of the uplink.

use std::path::PathBuf;

use ecod::config::{ConfigError, check_range};
use ecod::leadership::BrokerAddress;
use ecod::wire::Encoding;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::platform::secret::Secret;
use crate::transport::mqtt::MqttConfig;

/// The broker of a region of cells, and the rate of maps to it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct UplinkConfig {
    /// The region's broker as `host:port`. Default: not set; the cell then has no connection to
    /// other cells.
    pub broker: Option<BrokerAddress>,
    /// PEM file with the CAs of the broker's certificate. Default: not set, plaintext. The host in
    /// `broker` must be a name in the certificate. A node with `[tls]` presents its own
    /// certificate.
    pub ca: Option<PathBuf>,
    /// User name. Default: not set. Needs `password`.
    pub user: Option<String>,
    /// Password. Default: not set. It is not printed.
    pub password: Option<Secret>,
    /// Maps per second to the region; five times as many while a neighbouring cell is active.
    /// Default 2.
    pub max_hz: f64,
}

impl Default for UplinkConfig {
    fn default() -> Self {
        Self {
            broker: None,
            ca: None,
            user: None,
            password: None,
            max_hz: 2.0,
        }
    }
}

/// Maximum number of queued messages. More would be old maps.
const SEND_QUEUE: usize = 8;

/// Maximum size in bytes of a map that is sent or decoded, as accepted by the region's servers.
const MAX_MAP_BYTES: usize = 256 * 1024;

/// Milliseconds within which the broker must accept a connection. After an outage all cells of a
/// region log in at once.
const CONNECT_TIMEOUT_MS: u64 = 10_000;

impl UplinkConfig {
    /// Checks every value.
    ///
    /// # Errors
    /// Returns a [`ConfigError`] with the key, the value and the allowed range.
    pub fn validate(&self) -> Result<(), ConfigError> {
        check_range("max_hz", self.max_hz, 0.1, 4.0)?;
        self.connection(&MqttConfig::default()).validate()
    }

    /// Settings of the connection; the limit for payloads other than maps is taken from `cell`.
    pub(crate) fn connection(&self, cell: &MqttConfig) -> MqttConfig {
        MqttConfig {
            broker: self.broker.clone(),
            ca: self.ca.clone(),
            user: self.user.clone(),
            password: self.password.clone(),
            encoding: Encoding::Compact,
            send_queue: SEND_QUEUE,
            connect_timeout_ms: CONNECT_TIMEOUT_MS,
            max_payload_bytes: cell.max_payload_bytes,
            max_map_bytes: MAX_MAP_BYTES,
            ..MqttConfig::default()
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn keys_use_cell_broker_checks() {
        UplinkConfig::default().validate().unwrap();
        for (text, key) in [
            ("password = \"hush4711\"", "password"),
            ("ca = \"region.pem\"", "ca"),
            ("broker = \"region:8883\"\nmax_hz = 0", "max_hz"),
        ] {
            let error = toml::from_str::<UplinkConfig>(text)
                .unwrap()
                .validate()
                .unwrap_err();
            assert_eq!(error.key, key);
            assert!(!error.to_string().contains("4711"), "{error}");
        }
    }
}
