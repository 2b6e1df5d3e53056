//! Configuration of the MQTT connections.

use std::path::PathBuf;
use std::time::Duration;

use ecod::config::{ConfigError, check_range};
use ecod::leadership::BrokerAddress;
use ecod::wire::{Encoding, Limits};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::platform::secret::Secret;

/// Protocol, credentials and limits of the MQTT connections.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct MqttConfig {
    /// External broker for all data as `host:port`; nodes then start no broker. Default: not set,
    /// the brokers embedded in the nodes are used.
    pub broker: Option<BrokerAddress>,
    /// Whether the embedded brokers are used in addition to an external one: the cell survives the
    /// loss of that broker, and every message travels twice. Default false. On several machines it
    /// needs `[tls]` or `broker.allow_plaintext`.
    pub fallback_to_embedded: bool,
    /// Protocol version; with 5 the broker keeps oversized packets away. Default 3.1.1, which every
    /// broker supports.
    pub version: MqttVersion,
    /// User name. Default: not set. Needs `password`.
    pub user: Option<String>,
    /// Password of `user`. Default: not set. It is not printed.
    pub password: Option<Secret>,
    /// PEM file with the CAs of the external broker's certificate, which must match the host in
    /// `broker`. Default: not set; the connection is in plaintext. A node with `[tls]` presents its
    /// own certificate.
    pub ca: Option<PathBuf>,
    /// Whether payloads are signed with the cell's key and unsigned ones rejected; equal on all
    /// nodes. Default false. For an external broker that other parties use too. Other subscribers
    /// have to skip the signature.
    pub sign: bool,
    /// Encoding of sent payloads; nodes read all three, and `compact` rounds to millimetres and
    /// 0.05 %. Default `json`.
    pub encoding: Encoding,
    /// Silence in seconds after which the broker is pinged, from 5 with version 5. Default 5.
    /// Trade-off: shorter notices a dead network path sooner and costs packets. Not the failure
    /// detector, which is the gossip.
    pub keep_alive_s: u16,
    /// Milliseconds within which a broker must accept a connection; default 2000.
    pub connect_timeout_ms: u64,
    /// Milliseconds before the first attempt to reconnect, doubled with every failure; default 50.
    pub retry_min_ms: u64,
    /// Longest wait between attempts to reconnect, of which a random part of up to half is taken
    /// off. Default 2000. A cell's vehicles thus do not return all at once.
    pub retry_max_ms: u64,
    /// Maximum messages that wait to be sent on one link; default 64. When full, new ones are
    /// refused and counted.
    pub send_queue: usize,
    /// Maximum decoded messages that wait for their receivers; default 1024. When full, new ones
    /// are dropped and counted.
    pub inbox: usize,
    /// Maximum per second, and burst, of reports of one vehicle and kind (the largest count
    /// twelvefold), evidence shares of one candidate, or statuses of one node; more are counted and
    /// not decoded. Default 100. Trade-off: a higher value lets one node take the processor time of
    /// others.
    pub max_report_hz: u32,
    /// Largest report or status in bytes that is decoded; default 262144.
    pub max_payload_bytes: usize,
    /// Largest map, verdicts or reputations that are sent and decoded: 512 bytes for each of 16,384
    /// landmarks; equal on all nodes. Default 8388608. Trade-off: a larger value admits larger
    /// cells, a smaller one limits the size of an attacker's messages.
    pub max_map_bytes: usize,
    /// Maximum objects, and maximum seen landmarks, in a report; default 1024.
    pub max_objects: usize,
}

impl Default for MqttConfig {
    fn default() -> Self {
        let limits = Limits::default();
        Self {
            broker: None,
            fallback_to_embedded: false,
            version: MqttVersion::V311,
            user: None,
            password: None,
            ca: None,
            sign: false,
            encoding: Encoding::Json,
            keep_alive_s: 5,
            connect_timeout_ms: 2000,
            retry_min_ms: 50,
            retry_max_ms: 2000,
            send_queue: 64,
            inbox: 1024,
            max_report_hz: 100,
            max_payload_bytes: limits.payload_bytes,
            max_map_bytes: limits.map_bytes,
            max_objects: limits.objects,
        }
    }
}

impl MqttConfig {
    /// Checks every value.
    ///
    /// # Errors
    /// Returns a [`ConfigError`] with the key, the value and the allowed range.
    pub fn validate(&self) -> Result<(), ConfigError> {
        let min_keep_alive_s = match self.version {
            MqttVersion::V311 => 1.0,
            // The minimum of the client library.
            MqttVersion::V5 => 5.0,
        };
        check_range(
            "keep_alive_s",
            f64::from(self.keep_alive_s),
            min_keep_alive_s,
            3600.0,
        )?;
        check_range(
            "connect_timeout_ms",
            self.connect_timeout_ms as f64,
            10.0,
            60_000.0,
        )?;
        check_range("retry_min_ms", self.retry_min_ms as f64, 1.0, 60_000.0)?;
        check_range(
            "retry_max_ms",
            self.retry_max_ms as f64,
            self.retry_min_ms as f64,
            600_000.0,
        )?;
        check_range("send_queue", self.send_queue as f64, 8.0, 65_536.0)?;
        check_range("max_report_hz", f64::from(self.max_report_hz), 1.0, 1e5)?;
        check_range("inbox", self.inbox as f64, 1.0, 1e6)?;
        check_range(
            "max_payload_bytes",
            self.max_payload_bytes as f64,
            256.0,
            MAX_PAYLOAD_BYTES,
        )?;
        check_range(
            "max_map_bytes",
            self.max_map_bytes as f64,
            1024.0,
            MAX_PAYLOAD_BYTES,
        )?;
        check_range("max_objects", self.max_objects as f64, 1.0, 1e6)?;
        if self.user.is_none() && self.password.is_some() {
            return Err(ConfigError::new(
                "password",
                "a password",
                "set together with `user`",
            ));
        }
        if self.ca.is_some() && self.broker.is_none() {
            return Err(ConfigError::new(
                "ca",
                "a file",
                "set together with `broker`",
            ));
        }
        Ok(())
    }

    /// Limits of decoded messages.
    pub fn limits(&self) -> Limits {
        Limits {
            payload_bytes: self.max_payload_bytes,
            map_bytes: self.max_map_bytes,
            objects: self.max_objects,
        }
    }

    /// Largest packet in bytes that carries a payload within the limits. A larger one cuts the
    /// link.
    pub fn max_packet_bytes(&self) -> usize {
        self.max_payload_bytes.max(self.max_map_bytes) + PACKET_OVERHEAD_BYTES
    }

    pub(crate) fn keep_alive(&self) -> Duration {
        Duration::from_secs(self.keep_alive_s.into())
    }

    pub(crate) fn connect_timeout(&self) -> Duration {
        Duration::from_millis(self.connect_timeout_ms)
    }
}

/// Room for a packet's header, topic and properties.
const PACKET_OVERHEAD_BYTES: usize = 4096;

/// Maximum payload of an MQTT packet in bytes, 2²⁸ − 1, less room for the overhead.
const MAX_PAYLOAD_BYTES: f64 = 268_000_000.0;

/// A version of the MQTT protocol.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub enum MqttVersion {
    /// MQTT 3.1.1.
    #[default]
    #[serde(rename = "3.1.1")]
    V311,
    /// MQTT 5.
    #[serde(rename = "5")]
    V5,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn defaults_are_valid_errors_name_key() {
        MqttConfig::default().validate().unwrap();
        let error = MqttConfig {
            keep_alive_s: 0,
            ..MqttConfig::default()
        }
        .validate()
        .unwrap_err();
        assert_eq!(error.key, "keep_alive_s");
        let v5 = MqttConfig {
            keep_alive_s: 4,
            version: MqttVersion::V5,
            ..MqttConfig::default()
        };
        assert_eq!(
            v5.validate().unwrap_err().allowed,
            "a number from 5 to 3600"
        );
        let lone = MqttConfig {
            password: Some(Secret::new("x")),
            ..MqttConfig::default()
        };
        assert_eq!(lone.validate().unwrap_err().key, "password");
    }

    #[test]
    fn toml_is_read_and_passwords_hidden() {
        let text = "broker = \"10.0.0.2:1883\"\nversion = \"5\"\nuser = \"u\"\npassword = \"hush\"\nencoding = \"cbor\"";
        let config: MqttConfig = toml::from_str(text).unwrap();
        assert_eq!(
            (config.version, config.encoding),
            (MqttVersion::V5, Encoding::Cbor)
        );
        assert_eq!(config.password.as_ref().map(Secret::reveal), Some("hush"));
        assert!(!format!("{config:?}{}", toml::to_string(&config).unwrap()).contains("hush"));
        assert!(toml::from_str::<MqttConfig>("brokr = \"x:1\"").is_err());
    }
}
