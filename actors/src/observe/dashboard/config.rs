//! Configuration of the dashboard: address, token and limits.

use std::net::{Ipv4Addr, SocketAddr, SocketAddrV4};

use ecod::config::{ConfigError, ValueFault, check_range};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::floor_plan::{FloorPlan, FloorPlanConfig};
use crate::platform::secret::Secret;

/// A node's web page, metrics and health.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct DashboardConfig {
    /// Whether page, metrics and health are served. Default true.
    pub enabled: bool,
    /// Address and port of the page; port 0 takes a free one, and the log names it. Default
    /// 127.0.0.1:8080, or a free port if that is in use. An address that other machines can reach
    /// needs a token.
    pub listen: Option<SocketAddr>,
    /// Secret of viewers, required unless `listen` is loopback: at least 12 visible ASCII
    /// characters without `"#%&'<>`. Default: not set. Prefer `ECOD_DASHBOARD__TOKEN` to a file
    /// that other users can read.
    pub token: Option<Secret>,
    /// Whether the page shows the pictures of the node's camera to users with access. Default true.
    pub camera: bool,
    /// Image under the map. Default: not set.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub floor_plan: Option<FloorPlanConfig>,
    /// Maximum snapshots per second for each browser. Default 10. Trade-off: more snapshots show a
    /// fast cell better, fewer cost less.
    pub max_rate_hz: f64,
    /// Maximum number of connections, of which at most half are live pictures. Default 64. A
    /// visible browser tab keeps one and opens others briefly.
    pub max_connections: usize,
}

/// Default address of the page.
pub const DEFAULT_ADDRESS: SocketAddr =
    SocketAddr::V4(SocketAddrV4::new(Ipv4Addr::LOCALHOST, 8080));

/// Minimum length of a token.
const MIN_TOKEN_BYTES: usize = 12;

/// Visible ASCII characters that a browser escapes or cuts off in `/?token=…`.
const NOT_IN_TOKENS: [char; 7] = ['"', '#', '%', '&', '\'', '<', '>'];

impl Default for DashboardConfig {
    fn default() -> Self {
        Self {
            enabled: true,
            listen: None,
            token: None,
            camera: true,
            floor_plan: None,
            max_rate_hz: 10.0,
            max_connections: 64,
        }
    }
}

impl DashboardConfig {
    /// Checks every value, and that an address that other machines can reach has a token.
    ///
    /// # Errors
    /// Returns a [`ConfigError`] with the key, the value and the allowed range.
    pub fn validate(&self) -> Result<(), ConfigError> {
        check_range("max_rate_hz", self.max_rate_hz, 0.1, 60.0)?;
        check_range("max_connections", self.max_connections as f64, 4.0, 4096.0)?;
        if let Some(plan) = &self.floor_plan {
            plan.validate()
                .map_err(|error| error.within("floor_plan"))?;
        }
        match (&self.token, self.listen) {
            (Some(token), _) if token.reveal().len() < MIN_TOKEN_BYTES => {
                Err(ConfigError::with_fault(
                    "token",
                    ValueFault::TooShort,
                    format!("at least {MIN_TOKEN_BYTES} characters"),
                ))
            }
            (Some(token), _)
                if !token
                    .reveal()
                    .chars()
                    .all(|c| c.is_ascii_graphic() && !NOT_IN_TOKENS.contains(&c)) =>
            {
                let allowed =
                    "visible ASCII without \" # % & ' < >, as it is also given in an address";
                Err(ConfigError::new(
                    "token",
                    "a text with other characters",
                    allowed,
                ))
            }
            (None, Some(address)) if self.enabled && !address.ip().is_loopback() => {
                Err(ConfigError::missing(
                    "token",
                    format!("a secret, as other machines reach {address}"),
                ))
            }
            _ => Ok(()),
        }
    }

    /// Reads the floor plan, if the page shows one.
    ///
    /// # Errors
    /// Returns the errors of [`FloorPlanConfig::load`].
    pub fn load_floor_plan(&self) -> Result<Option<FloorPlan>, ConfigError> {
        let plan = self.floor_plan.as_ref().filter(|_| self.enabled);
        plan.map(FloorPlanConfig::load)
            .transpose()
            .map_err(|error| error.within("dashboard.floor_plan"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn validate(listen: &str, token: Option<&str>) -> Result<(), ConfigError> {
        let listen = listen.parse().ok();
        let token = token.map(Secret::new);
        DashboardConfig {
            listen,
            token,
            ..DashboardConfig::default()
        }
        .validate()
    }

    #[test]
    fn reachable_address_needs_token() {
        validate("127.0.0.1:8080", None).unwrap();
        validate("[::1]:8080", None).unwrap();
        for address in ["0.0.0.0:8080", "10.0.0.2:8080", "[::]:8080"] {
            assert_eq!(
                validate(address, None).unwrap_err().key,
                "token",
                "{address}"
            );
            validate(address, Some("a-long-enough-token")).unwrap();
        }
        for token in [
            "short",
            "with a space in it",
            "a&b&c&d&e&f&g",
            "100%-certain-token",
            "number#1-token",
            "zwölf-zeichen",
        ] {
            assert_eq!(
                validate("127.0.0.1:8080", Some(token)).unwrap_err().key,
                "token",
                "{token}"
            );
        }
        validate("127.0.0.1:8080", Some("q0Zk/8+d=~Tx:1!")).unwrap();
        let listen = "0.0.0.0:8080".parse().ok();
        DashboardConfig {
            enabled: false,
            listen,
            ..DashboardConfig::default()
        }
        .validate()
        .unwrap();
    }
}
