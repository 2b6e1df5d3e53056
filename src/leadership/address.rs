//! The address of a broker.

use std::fmt;
use std::net::SocketAddr;
use std::str::FromStr;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use smol_str::{SmolStr, ToSmolStr, format_smolstr};

use crate::logins::without_login;

/// Host and port of a broker, such as `192.168.1.10:1883`, `[fe80::1]:1883` or `broker.local:1883`.
#[derive(
    Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize, JsonSchema,
)]
#[serde(try_from = "String", into = "String")]
pub struct BrokerAddress {
    host: SmolStr,
    port: u16,
}

/// Error for a broker address that is not of the form `host:port`. It contains no login.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("broker address {0:?} must be host:port, such as 192.168.1.10:1883")]
pub struct InvalidAddress(String);

impl BrokerAddress {
    /// The host; an IPv6 address is in brackets.
    pub fn host(&self) -> &str {
        &self.host
    }

    /// The TCP port, 1 to 65535.
    pub fn port(&self) -> u16 {
        self.port
    }
}

impl FromStr for BrokerAddress {
    type Err = InvalidAddress;

    fn from_str(text: &str) -> Result<Self, InvalidAddress> {
        let invalid = || InvalidAddress(without_login(text));
        let (host, port) = text.rsplit_once(':').ok_or_else(invalid)?;
        let bracketed = host.starts_with('[') && host.ends_with(']');
        let allowed = |c: char| {
            !c.is_whitespace()
                && !matches!(c, '/' | '@')
                && (bracketed || !matches!(c, ':' | '[' | ']'))
        };
        let port = port.parse().map_err(|_| invalid())?;
        if host.is_empty() || port == 0 || !host.chars().all(allowed) {
            return Err(invalid());
        }
        Ok(Self {
            host: host.into(),
            port,
        })
    }
}

impl TryFrom<String> for BrokerAddress {
    type Error = InvalidAddress;

    fn try_from(text: String) -> Result<Self, InvalidAddress> {
        text.parse()
    }
}

impl From<BrokerAddress> for String {
    fn from(address: BrokerAddress) -> Self {
        address.to_string()
    }
}

impl From<SocketAddr> for BrokerAddress {
    fn from(address: SocketAddr) -> Self {
        let host = match address {
            SocketAddr::V4(v4) => v4.ip().to_smolstr(),
            SocketAddr::V6(v6) => format_smolstr!("[{}]", v6.ip()),
        };
        Self {
            host,
            port: address.port(),
        }
    }
}

impl fmt::Display for BrokerAddress {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}:{}", self.host, self.port)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn addresses_are_host_and_port() {
        for good in ["127.0.0.1:1883", "[::1]:8883", "broker.local:1"] {
            assert_eq!(good.parse::<BrokerAddress>().unwrap().to_string(), good);
        }
        for bad in [
            "",
            "host",
            ":1883",
            "host:0",
            "host:65536",
            "::1:1883",
            "mqtt://host:1883",
            "a b:1",
            "user@host:1883",
        ] {
            assert!(bad.parse::<BrokerAddress>().is_err(), "{bad}");
        }
    }

    #[test]
    fn errors_hide_logins() {
        for address in ["user:geh eim1@host:1883", "mqtt://user:geh/eim1@host:1883"] {
            let error = address.parse::<BrokerAddress>().unwrap_err().to_string();
            let hidden = "broker address \"***@host:1883\" must be host:port";
            assert!(error.starts_with(hidden), "{error}");
        }
    }
}
