//! Configuration of the membership.

use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::path::PathBuf;
use std::time::Duration;

use ecod::config::{ConfigError, ValueFault, check_range};
use ecod::logins::without_login;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::platform::secret::Secret;

/// Default UDP port for gossip.
pub const DEFAULT_PORT: u16 = 17_884;

/// Gossip address, discovery and timings of failure detection; `[membership]` in the configuration
/// file.
///
/// Key, multicast group and timings must be the same on every node of a cell.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct MembershipConfig {
    /// The cell's key: 64 hexadecimal digits, as from `openssl rand -hex 32`, or a passphrase of at
    /// least 12 characters. Default: not set.
    pub key: Option<Secret>,
    /// File with the key, in place of `key`. Default: not set. White space around the key is
    /// ignored.
    pub key_file: Option<PathBuf>,
    /// Address and UDP port for gossip; port 0 takes any free one. Default: port 17884 or a free
    /// one, on all interfaces with a key, otherwise on 127.0.0.1. Multicast needs an IPv4 address,
    /// and IPv6 works by `seeds` only; link-local addresses (`fe80::`) don't work.
    pub bind: Option<SocketAddr>,
    /// Address at which other nodes reach this node, if address translation hides it. Default: not
    /// set; the address of `bind`, or the address that other nodes observe.
    pub advertise: Option<SocketAddr>,
    /// Nodes as `host:port` to contact in addition to multicast. Default: empty. They are resolved
    /// and contacted repeatedly, without a time limit. Seeds may be absent, and may differ between
    /// nodes.
    pub seeds: Vec<String>,
    /// Settings of the discovery by multicast.
    pub multicast: MulticastConfig,
    /// Time between two probes of one other node, in ms. Default 100. Trade-off: shorter detects
    /// failures sooner and costs packets.
    pub probe_ms: u64,
    /// Time in ms before other nodes probe for this one, less than half of `probe_ms`. Default 30.
    /// A longer time suits slower networks.
    pub reply_ms: u64,
    /// Time in ms within which a suspected node must show that it is alive. Default 200. Trade-off:
    /// longer declares fewer living nodes down and detects failures later.
    pub suspect_ms: u64,
    /// Time between two rounds of gossip, in ms. Default 50; rounds without news send no packets.
    pub gossip_ms: u64,
    /// Interval in ms between greetings to absent seeds and to the multicast group; at most half of
    /// `join_ms`. Default 500. Once other nodes are alive, the group is greeted a tenth as often. A
    /// returning seed must discover its cell before it leads on its own. Trade-off: a shorter time
    /// heals split cells sooner and costs packets.
    pub hello_ms: u64,
    /// Maximum number of other nodes. Default 256.
    pub max_peers: usize,
}

/// Discovery by UDP multicast, which needs no configured address.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct MulticastConfig {
    /// Whether to send greetings and listen to them. Default true.
    pub enabled: bool,
    /// Address of the group. Default 239.255.36.84, of the range that routers keep local.
    pub group: Ipv4Addr,
    /// UDP port of the group. Default 17885. All nodes of a machine share it.
    pub port: u16,
    /// Address of the network interface to use. Default: the address of `bind`, otherwise the
    /// system's choice.
    pub interface: Option<Ipv4Addr>,
}

impl Default for MulticastConfig {
    fn default() -> Self {
        Self {
            enabled: true,
            group: Ipv4Addr::new(239, 255, 36, 84),
            port: 17_885,
            interface: None,
        }
    }
}

impl Default for MembershipConfig {
    fn default() -> Self {
        Self {
            key: None,
            key_file: None,
            bind: None,
            advertise: None,
            seeds: Vec::new(),
            multicast: MulticastConfig::default(),
            probe_ms: 100,
            reply_ms: 30,
            suspect_ms: 200,
            gossip_ms: 50,
            hello_ms: 500,
            max_peers: 256,
        }
    }
}

impl MembershipConfig {
    /// Checks every value.
    ///
    /// # Errors
    /// Returns a [`ConfigError`] that names the first key that cannot be used.
    pub fn validate(&self) -> Result<(), ConfigError> {
        if self.key.is_some() && self.key_file.is_some() {
            return Err(ConfigError::new(
                "key_file",
                "a file",
                "left out when `key` is set",
            ));
        }
        if self
            .key
            .as_ref()
            .is_some_and(|key| key.reveal().trim().len() < MIN_KEY_BYTES)
        {
            return Err(ConfigError::with_fault(
                "key",
                ValueFault::TooShort,
                format!("at least {MIN_KEY_BYTES} characters"),
            ));
        }
        if self
            .advertise
            .is_some_and(|address| address.ip().is_unspecified() || address.port() == 0)
        {
            return Err(ConfigError::with_fault(
                "advertise",
                ValueFault::Unspecified,
                "an address and port that others can reach",
            ));
        }
        if let Some(seed) = self.seeds.iter().find(|seed| !is_host_and_port(seed)) {
            return Err(ConfigError::new(
                "seeds",
                without_login(seed),
                "host:port, such as 192.168.1.10:17884",
            ));
        }
        self.multicast
            .validate()
            .map_err(|error| error.within("multicast"))?;
        let ms = |key, value: u64, low: f64, high: f64| check_range(key, value as f64, low, high);
        ms("probe_ms", self.probe_ms, 10.0, 60_000.0)?;
        ms(
            "reply_ms",
            self.reply_ms,
            1.0,
            (self.probe_ms.saturating_sub(1) / 2) as f64,
        )?;
        ms("suspect_ms", self.suspect_ms, 10.0, 600_000.0)?;
        ms("gossip_ms", self.gossip_ms, 5.0, 60_000.0)?;
        ms("hello_ms", self.hello_ms, 10.0, 600_000.0)?;
        check_range("max_peers", self.max_peers as f64, 1.0, 4096.0)
    }

    /// True if a key is configured. Without one the key is public.
    pub fn has_key(&self) -> bool {
        self.key.is_some() || self.key_file.is_some()
    }

    /// Gossip address without `bind`.
    pub(crate) fn default_ip(&self) -> IpAddr {
        IpAddr::V4(if self.has_key() {
            Ipv4Addr::UNSPECIFIED
        } else {
            Ipv4Addr::LOCALHOST
        })
    }

    pub(crate) fn hello(&self) -> Duration {
        Duration::from_millis(self.hello_ms)
    }
}

impl MulticastConfig {
    fn validate(&self) -> Result<(), ConfigError> {
        if !self.group.is_multicast() {
            return Err(ConfigError::new(
                "group",
                self.group,
                "an address from 224.0.0.0 to 239.255.255.255",
            ));
        }
        check_range("port", f64::from(self.port), 1.0, 65_535.0)
    }
}

/// Minimum length of a cell's key in bytes.
pub(crate) const MIN_KEY_BYTES: usize = 12;

/// True if `text` can be a seed.
pub(crate) fn is_host_and_port(text: &str) -> bool {
    text.rsplit_once(':').is_some_and(|(host, port)| {
        let port = port.parse::<u16>().is_ok_and(|port| port != 0);
        port && !host.is_empty()
            && !host.contains(|c: char| c.is_whitespace() || matches!(c, '/' | '@'))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn defaults_are_valid_errors_name_key() {
        assert_eq!(MembershipConfig::default().validate(), Ok(()));
        for (toml, key) in [
            ("key = \"short\"", "key"),
            (
                "key = \"long enough, this\"\nkey_file = \"/etc/ecod/key\"",
                "key_file",
            ),
            ("advertise = \"0.0.0.0:1\"", "advertise"),
            ("seeds = [\"host\"]", "seeds"),
            ("seeds = [\"user@host:1\"]", "seeds"),
            ("reply_ms = 50", "reply_ms"),
            ("[multicast]\ngroup = \"10.0.0.1\"", "multicast.group"),
        ] {
            let config: MembershipConfig = toml::from_str(toml).unwrap();
            assert_eq!(config.validate().unwrap_err().key, key);
        }
    }
}
