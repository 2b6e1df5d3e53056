//! Broker, ports and multicast.

use std::io;
use std::net::{IpAddr, SocketAddr, TcpListener, UdpSocket};
use std::time::Duration;

use ecod::model::names::NodeName;
use tokio::time::timeout;

use super::Finding;
use crate::node::config::NodeConfig;
use crate::observe::dashboard::DEFAULT_ADDRESS;
use crate::transport::gossip::DEFAULT_PORT;

/// How long a datagram to oneself may take.
const PATIENCE: Duration = Duration::from_millis(500);

/// How long a name service may take.
const LOOKUP_PATIENCE: Duration = Duration::from_secs(5);

/// The external broker as it answers, and the port of the embedded one.
pub(super) async fn broker(config: &NodeConfig) -> Vec<Finding> {
    let mut findings = Vec::new();
    let plane = config.data_plane();
    if let Some(address) = &plane.external {
        let node = config.name.as_ref().map_or("node", NodeName::as_str);
        let asked = match config.security() {
            Ok(security) => crate::transport::mqtt::probe(address, node, &config.mqtt, &security).await,
            Err(error) => Err(error.to_string()),
        };
        findings.push(match asked {
            Ok(()) => Finding::fine("broker", format!("{address} accepts this node")),
            Err(error) => Finding::broken(
                "broker",
                format!("{address}: {error}"),
                "start it, or set `mqtt.broker`, `mqtt.user`, `mqtt.password`, `mqtt.ca` and `mqtt.version` as it wants them",
            ),
        });
    }
    if config.may_lead() && plane.embedded {
        let port = Port { check: "broker port", address: config.broker_listen(), key: "listen" };
        findings.push(port.of(TcpListener::bind(port.address)));
    }
    findings
}

/// The port on which the node gossips.
pub(super) fn gossip(config: &NodeConfig) -> Finding {
    let membership = &config.membership;
    let ip = if membership.has_key() { [0, 0, 0, 0] } else { [127, 0, 0, 1] };
    let address = membership.bind.unwrap_or(SocketAddr::from((ip, DEFAULT_PORT)));
    let port = Port { check: "gossip port", address, key: "membership.bind" };
    let bound = UdpSocket::bind(address);
    if membership.bind.is_some() { port.of(bound) } else { port.or_another(bound, "others have this node as a seed") }
}

/// Whether the seeds have addresses; nothing is sent to them, as they need not be there.
pub(super) async fn seeds(config: &NodeConfig) -> Vec<Finding> {
    let ipv4 = config.membership.bind.is_none_or(|bind| bind.is_ipv4());
    let mut findings = Vec::new();
    for seed in &config.membership.seeds {
        let found = timeout(LOOKUP_PATIENCE, crate::transport::gossip::look_up(seed, ipv4)).await;
        let found = found.unwrap_or_else(|_| Err(io::ErrorKind::TimedOut.into()));
        findings.push(match found {
            Ok(addresses) => {
                let addresses: Vec<_> = addresses.iter().map(|address| address.ip().to_string()).collect();
                Finding::fine("seed", format!("{seed} is at {}", addresses.join(", ")))
            }
            Err(error) => {
                let fix =
                    "mend it in `membership.seeds`, or the name service; the node goes on without it, and asks again";
                Finding::doubtful("seed", format!("{seed}: {}", words(&error)), fix)
            }
        });
    }
    findings
}

/// The port on which a vehicle that moves is told its poses.
#[cfg(feature = "camera")]
pub(super) fn poses(config: &NodeConfig) -> Option<Finding> {
    let port = Port { check: "pose port", address: config.pose.listen?, key: "pose.listen" };
    Some(port.of(UdpSocket::bind(port.address)))
}

/// The address of the dashboard, unless it is switched off.
pub(super) fn dashboard(config: &NodeConfig) -> Option<Finding> {
    let listen = config.dashboard.listen;
    let port = Port { check: "dashboard", address: listen.unwrap_or(DEFAULT_ADDRESS), key: "dashboard.listen" };
    config.dashboard.enabled.then(|| {
        let bound = TcpListener::bind(port.address);
        if listen.is_some() { port.of(bound) } else { port.or_another(bound, "its address has to be known") }
    })
}

/// The address of the log's live server, where it is wanted.
#[cfg(feature = "foxglove")]
pub(super) fn live(config: &NodeConfig) -> Option<Finding> {
    let port = config.record.as_ref().and_then(|record| record.live_port)?;
    let port = Port { check: "live port", address: SocketAddr::from(([127, 0, 0, 1], port)), key: "record.live_port" };
    Some(port.of(TcpListener::bind(port.address)))
}

/// An address that the node binds, and the key that says which.
#[derive(Clone, Copy)]
struct Port {
    check: &'static str,
    address: SocketAddr,
    key: &'static str,
}

impl Port {
    /// What became of binding it.
    fn of<T>(self, bound: io::Result<T>) -> Finding {
        let Self { check, address, key } = self;
        let Err(error) = bound else { return Finding::fine(check, format!("{address} is free")) };
        let fix = match error.kind() {
            io::ErrorKind::AddrNotAvailable => format!("set `{key}` to an address of this machine, or 0.0.0.0 for all"),
            io::ErrorKind::PermissionDenied => format!("set `{key}` to a port from 1024"),
            _ => format!("stop what uses it, perhaps this node itself, or set `{key}` to another"),
        };
        Finding::broken(check, format!("{address}: {}", words(&error)), fix)
    }

    /// The same where a free port does as well, unless `wanted` is so.
    fn or_another<T>(self, bound: io::Result<T>, wanted: &str) -> Finding {
        let Self { check, address, key } = self;
        match bound {
            Err(error) => {
                let seen = format!("{address}: {}, a free one will be taken", words(&error));
                Finding::doubtful(check, seen, format!("set `{key}` if {wanted}"))
            }
            Ok(_) => self.of(bound),
        }
    }
}

/// Whether a datagram to the group comes back.
pub(super) fn multicast(config: &NodeConfig) -> Option<Finding> {
    let multicast = &config.membership.multicast;
    if !multicast.enabled {
        return None;
    }
    let ip = config.membership.bind.map(|bind| bind.ip());
    let ip = ip.unwrap_or(IpAddr::from(if config.membership.has_key() { [0, 0, 0, 0] } else { [127, 0, 0, 1] }));
    let IpAddr::V4(ip) = ip else { return None };
    let interface = multicast.interface.unwrap_or(ip);
    let returned = || -> io::Result<()> {
        let (receiver, sender) = (UdpSocket::bind((multicast.group, 0))?, UdpSocket::bind((ip, 0))?);
        receiver.join_multicast_v4(&multicast.group, &interface)?;
        receiver.set_read_timeout(Some(PATIENCE))?;
        if !interface.is_unspecified() {
            socket2::SockRef::from(&sender).set_multicast_if_v4(&interface)?;
        }
        sender.send_to(b"ecod", (multicast.group, receiver.local_addr()?.port()))?;
        receiver.recv(&mut [0; 4]).map(drop)
    };
    let check = "multicast";
    Some(match returned() {
        Ok(()) if interface.is_unspecified() => Finding::fine(check, format!("{} comes back", multicast.group)),
        Ok(()) => Finding::fine(check, format!("{} comes back by {interface}", multicast.group)),
        Err(error) => Finding::doubtful(
            check,
            format!("{} by {interface}: {}", multicast.group, words(&error)),
            "set `membership.multicast.interface`, or list nodes in `membership.seeds`",
        ),
    })
}

fn words(error: &io::Error) -> String {
    match error.kind() {
        io::ErrorKind::AddrInUse => "in use".into(),
        io::ErrorKind::AddrNotAvailable => "not an address of this machine".into(),
        io::ErrorKind::WouldBlock | io::ErrorKind::TimedOut => "nothing came back".into(),
        _ => error.to_string(),
    }
}
