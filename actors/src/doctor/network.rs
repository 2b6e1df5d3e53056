//! Checks of broker, ports, seeds and multicast.

use std::io;
use std::net::{IpAddr, SocketAddr, TcpListener, UdpSocket};
use std::time::Duration;

use ecod::model::names::NodeName;
use tokio::time::timeout;

use super::Finding;
use crate::node::config::NodeConfig;
use crate::observe::dashboard::DEFAULT_ADDRESS;
use crate::transport::gossip::DEFAULT_PORT;
use crate::transport::mqtt::probe;

/// Maximum time for a multicast datagram to return.
const MULTICAST_TIMEOUT: Duration = Duration::from_millis(500);

/// Maximum time of a name lookup.
const LOOKUP_TIMEOUT: Duration = Duration::from_secs(5);

/// Checks the connection to the external broker and the port of the embedded one.
pub(super) async fn broker(config: &NodeConfig, is_running: bool) -> Vec<Finding> {
    let mut findings = Vec::new();
    let plane = config.data_plane();
    if let Some(address) = &plane.external {
        let node = config.name.as_ref().map_or("node", NodeName::as_str);
        let answer = match config.security() {
            Ok(security) => probe(address, node, &config.mqtt, &security).await,
            Err(error) => Err(error.to_string()),
        };
        findings.push(match answer {
            Ok(()) => Finding::fine("broker", format!("{address} accepts this node")),
            Err(error) => Finding::broken(
                "broker",
                format!("{address}: {error}"),
                "start the broker, or correct `mqtt.broker`, `mqtt.user`, `mqtt.password`, `mqtt.ca` and `mqtt.version`",
            ),
        });
    }
    if config.has_broker() {
        let port = Port {
            check: "broker port",
            address: config.broker_listen(),
            key: "listen",
            is_running,
        };
        let bound = TcpListener::bind(port.address);
        let free_one_will_do = config.may_listen_at_any_port();
        findings.push(if free_one_will_do {
            port.or_another(bound, "programs look for it there")
        } else {
            port.of(bound)
        });
    }
    findings
}

/// Checks the connection to the region's broker.
pub(super) async fn uplink(config: &NodeConfig) -> Option<Finding> {
    let address = config
        .uplink
        .broker
        .as_ref()
        .filter(|_| config.has_uplink())?;
    let node = config.name.as_ref().map_or("node", NodeName::as_str);
    let security = config
        .security()
        .map_err(|error| error.to_string())
        .and_then(|security| {
            security
                .of_uplink(address.clone(), config.uplink.ca.clone())
                .map_err(|error| error.to_string())
        });
    let answer = match security {
        Ok(security) => {
            probe(
                address,
                node,
                &config.uplink.connection(&config.mqtt),
                &security,
            )
            .await
        }
        Err(error) => Err(error),
    };
    Some(match answer {
        Ok(()) => Finding::fine("uplink", format!("{address} accepts this node")),
        Err(error) => Finding::doubtful(
            "uplink",
            format!("{address}: {error}"),
            "the cell runs without it; look at the link, or correct `uplink.broker`, `uplink.user`, `uplink.password` and \
             `uplink.ca`",
        ),
    })
}

/// Checks the gossip port.
pub(super) fn gossip(config: &NodeConfig, is_running: bool) -> Finding {
    let membership = &config.membership;
    let ip = if membership.has_key() {
        [0, 0, 0, 0]
    } else {
        [127, 0, 0, 1]
    };
    let address = membership
        .bind
        .unwrap_or(SocketAddr::from((ip, DEFAULT_PORT)));
    let port = Port {
        check: "gossip port",
        address,
        key: "membership.bind",
        is_running,
    };
    let bound = UdpSocket::bind(address);
    if membership.bind.is_some() {
        port.of(bound)
    } else {
        port.or_another(bound, "other nodes use this node as a seed")
    }
}

/// Checks that the seeds have addresses. Sends no packets, because the seeds may be offline.
pub(super) async fn seeds(config: &NodeConfig) -> Vec<Finding> {
    let ipv4 = config.membership.bind.is_none_or(|bind| bind.is_ipv4());
    let mut findings = Vec::new();
    for seed in &config.membership.seeds {
        let found = timeout(
            LOOKUP_TIMEOUT,
            crate::transport::gossip::look_up(seed, ipv4),
        )
        .await
        .unwrap_or_else(|_| Err(io::ErrorKind::TimedOut.into()));
        findings.push(match found {
            Ok(addresses) => {
                let addresses: Vec<_> = addresses.iter().map(|address| address.ip().to_string()).collect();
                Finding::fine("seed", format!("{seed} has the address {}", addresses.join(", ")))
            }
            Err(error) => {
                let fix = "correct `membership.seeds` or the name service; the node runs without this seed and retries";
                Finding::doubtful("seed", format!("{seed}: {}", describe(&error)), fix)
            }
        });
    }
    findings
}

/// Checks the port that receives the poses of a moving vehicle.
#[cfg(feature = "camera")]
pub(super) fn poses(config: &NodeConfig, is_running: bool) -> Option<Finding> {
    let port = Port {
        check: "pose port",
        address: config.pose.listen?,
        key: "pose.listen",
        is_running,
    };
    Some(port.of(UdpSocket::bind(port.address)))
}

/// Checks the address of the dashboard, unless it is disabled.
pub(super) fn dashboard(config: &NodeConfig, is_running: bool) -> Option<Finding> {
    let listen = config.dashboard.listen;
    let port = Port {
        check: "dashboard",
        address: listen.unwrap_or(DEFAULT_ADDRESS),
        key: "dashboard.listen",
        is_running,
    };
    config.dashboard.enabled.then(|| {
        let bound = TcpListener::bind(port.address);
        if listen.is_some() {
            port.of(bound)
        } else {
            port.or_another(bound, "its address must be fixed")
        }
    })
}

/// Checks the port of the live log server, if configured.
#[cfg(feature = "foxglove")]
pub(super) fn live(config: &NodeConfig, is_running: bool) -> Option<Finding> {
    let number = config.record.as_ref().and_then(|record| record.live_port)?;
    let port = Port {
        check: "live port",
        address: SocketAddr::from(([127, 0, 0, 1], number)),
        key: "record.live_port",
        is_running,
    };
    Some(port.of(TcpListener::bind(port.address)))
}

/// An address that the node binds, and its configuration key.
#[derive(Clone, Copy)]
struct Port {
    check: &'static str,
    address: SocketAddr,
    key: &'static str,
    /// True if the node itself runs, so that it has the port.
    is_running: bool,
}

impl Port {
    /// Finding for an attempt to bind.
    fn of<T>(self, bound: io::Result<T>) -> Finding {
        let Self {
            check,
            address,
            key,
            is_running,
        } = self;
        if is_running && is_in_use(&bound) {
            return Finding::fine(check, format!("{address} is in use while the node runs"));
        }
        let Err(error) = bound else {
            return Finding::fine(check, format!("{address} is free"));
        };
        let fix = match error.kind() {
            io::ErrorKind::AddrNotAvailable => {
                format!("set `{key}` to an address of this machine, or 0.0.0.0 for all")
            }
            io::ErrorKind::PermissionDenied => format!("set `{key}` to port 1024 or higher"),
            _ => {
                format!("stop the program that uses it, or change `{key}`")
            }
        };
        Finding::broken(check, format!("{address}: {}", describe(&error)), fix)
    }

    /// As `of`, for a port that may be replaced by a free one, except for the reason `unless`.
    fn or_another<T>(self, bound: io::Result<T>, unless: &str) -> Finding {
        let Self {
            check,
            address,
            key,
            is_running,
        } = self;
        match bound {
            Err(error) if !is_running => {
                let seen = format!(
                    "{address}: {}, the node will take a free one",
                    describe(&error)
                );
                Finding::doubtful(check, seen, format!("set `{key}` if {unless}"))
            }
            _ => self.of(bound),
        }
    }
}

fn is_in_use<T>(bound: &io::Result<T>) -> bool {
    bound
        .as_ref()
        .is_err_and(|error| error.kind() == io::ErrorKind::AddrInUse)
}

/// Checks that a datagram to the multicast group returns.
pub(super) fn multicast(config: &NodeConfig) -> Option<Finding> {
    let multicast = &config.membership.multicast;
    if !multicast.enabled {
        return None;
    }
    let ip = config
        .membership
        .bind
        .map(|bind| bind.ip())
        .unwrap_or(IpAddr::from(if config.membership.has_key() {
            [0, 0, 0, 0]
        } else {
            [127, 0, 0, 1]
        }));
    let IpAddr::V4(ip) = ip else { return None };
    let interface = multicast.interface.unwrap_or(ip);
    let returned = || -> io::Result<()> {
        let receiver = UdpSocket::bind((multicast.group, 0))?;
        let sender = UdpSocket::bind((ip, 0))?;
        receiver.join_multicast_v4(&multicast.group, &interface)?;
        receiver.set_read_timeout(Some(MULTICAST_TIMEOUT))?;
        if !interface.is_unspecified() {
            socket2::SockRef::from(&sender).set_multicast_if_v4(&interface)?;
        }
        sender.send_to(b"ecod", (multicast.group, receiver.local_addr()?.port()))?;
        receiver.recv(&mut [0; 4]).map(drop)
    };
    let check = "multicast";
    Some(match returned() {
        Ok(()) if interface.is_unspecified() => {
            Finding::fine(check, format!("{} works", multicast.group))
        }
        Ok(()) => Finding::fine(check, format!("{} works on {interface}", multicast.group)),
        Err(error) => Finding::doubtful(
            check,
            format!("{} on {interface}: {}", multicast.group, describe(&error)),
            "set `membership.multicast.interface`, or list nodes in `membership.seeds`",
        ),
    })
}

fn describe(error: &io::Error) -> String {
    match error.kind() {
        io::ErrorKind::AddrInUse => "in use".into(),
        io::ErrorKind::AddrNotAvailable => "not an address of this machine".into(),
        io::ErrorKind::WouldBlock | io::ErrorKind::TimedOut => "no answer".into(),
        _ => error.to_string(),
    }
}
