//! Where the dashboard listens and who may look.

use std::net::{Ipv4Addr, SocketAddr, SocketAddrV4};

use ecod::config::{ConfigError, check_range};
use serde::{Deserialize, Serialize};

use crate::platform::secret::Secret;

/// A node's web page, metrics and health.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct DashboardConfig {
    /// Whether the page is served; default true. Without, nothing listens, and metrics and health are not there either.
    pub enabled: bool,
    /// Where the page is served, port 0 for a free one, which the log names. Default [`DEFAULT_ADDRESS`], or a free
    /// port if that is taken, as by another node of the machine. An address that other machines reach needs a token.
    pub listen: Option<SocketAddr>,
    /// What who looks has to know, at least 12 characters that stand for themselves in an address. Default none, which
    /// only a loopback address allows. Give it as `ECOD_DASHBOARD__TOKEN` rather than in a file that others read.
    pub token: Option<Secret>,
    /// Most pictures of the cell a second that browsers get; default 10. Less costs less, more shows more of a fast
    /// cell.
    pub max_rate_hz: f64,
    /// Most connections at a time; default 64. A browser's tab takes one for as long as it is looked at, and others for
    /// a moment; half of them at most are for live pictures.
    pub max_connections: usize,
}

/// Where the page is served if nothing else is said and nobody else is there.
pub const DEFAULT_ADDRESS: SocketAddr = SocketAddr::V4(SocketAddrV4::new(Ipv4Addr::LOCALHOST, 8080));

/// The shortest token.
const MIN_TOKEN_BYTES: usize = 12;

/// What a browser changes or cuts off in `/?token=…`, beside what is no visible ASCII.
const NOT_IN_TOKENS: [char; 7] = ['"', '#', '%', '&', '\'', '<', '>'];

impl Default for DashboardConfig {
    fn default() -> Self {
        Self { enabled: true, listen: None, token: None, max_rate_hz: 10.0, max_connections: 64 }
    }
}

impl DashboardConfig {
    /// Checks every value and that strangers stay outside.
    ///
    /// # Errors
    /// [`ConfigError`] with the key, the value and what is allowed.
    pub fn validate(&self) -> Result<(), ConfigError> {
        check_range("max_rate_hz", self.max_rate_hz, 0.1, 60.0)?;
        check_range("max_connections", self.max_connections as f64, 4.0, 4096.0)?;
        match (&self.token, self.listen) {
            (Some(token), _) if token.reveal().len() < MIN_TOKEN_BYTES => {
                Err(ConfigError::new("token", "a short text", format!("at least {MIN_TOKEN_BYTES} characters")))
            }
            (Some(token), _)
                if !token.reveal().chars().all(|c| c.is_ascii_graphic() && !NOT_IN_TOKENS.contains(&c)) =>
            {
                let allowed = "visible ASCII without \" # % & ' < >, as it is also given in an address";
                Err(ConfigError::new("token", "a text with other characters", allowed))
            }
            (None, Some(address)) if self.enabled && !address.ip().is_loopback() => {
                Err(ConfigError::new("token", "nothing", format!("a secret, as other machines reach {address}")))
            }
            _ => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn validate(listen: &str, token: Option<&str>) -> Result<(), ConfigError> {
        let (listen, token) = (listen.parse().ok(), token.map(Secret::new));
        DashboardConfig { listen, token, ..DashboardConfig::default() }.validate()
    }

    #[test]
    fn an_address_that_others_reach_needs_a_token() {
        validate("127.0.0.1:8080", None).unwrap();
        validate("[::1]:8080", None).unwrap();
        for address in ["0.0.0.0:8080", "10.0.0.2:8080", "[::]:8080"] {
            assert_eq!(validate(address, None).unwrap_err().key, "token", "{address}");
            validate(address, Some("a-long-enough-token")).unwrap();
        }
        for token in
            ["short", "with a space in it", "a&b&c&d&e&f&g", "100%-certain-token", "number#1-token", "zwölf-zeichen"]
        {
            assert_eq!(validate("127.0.0.1:8080", Some(token)).unwrap_err().key, "token", "{token}");
        }
        validate("127.0.0.1:8080", Some("q0Zk/8+d=~Tx:1!")).unwrap();
        let listen = "0.0.0.0:8080".parse().ok();
        DashboardConfig { enabled: false, listen, ..DashboardConfig::default() }.validate().unwrap();
    }
}
