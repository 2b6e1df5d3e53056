//! Broker, ports and multicast.

use std::io;
use std::net::{IpAddr, SocketAddr, TcpListener, UdpSocket};
use std::time::Duration;

use ecod::names::NodeName;

use super::Finding;
use crate::config::NodeConfig;
use crate::dashboard::DEFAULT_ADDRESS;
use crate::gateway::{self, Security};
use crate::membership::DEFAULT_PORT;

/// How long a datagram to oneself may take.
const PATIENCE: Duration = Duration::from_millis(500);

/// The external broker as it answers, and the port of the embedded one.
pub(super) async fn broker(config: &NodeConfig) -> Vec<Finding> {
    let mut findings = Vec::new();
    let plane = config.data_plane();
    if let Some(address) = &plane.external {
        let node = config.name.as_ref().map_or("node", NodeName::as_str);
        let asked = match Security::of(config) {
            Ok(security) => gateway::probe(address, node, &config.mqtt, &security).await,
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
        let address = config.broker_listen();
        findings.push(match TcpListener::bind(address) {
            Ok(_) => Finding::fine("broker port", format!("{address} is free")),
            Err(error) => not_bound("broker port", address, &error, "listen"),
        });
    }
    findings
}

/// The port on which the node gossips.
pub(super) fn gossip(config: &NodeConfig) -> Option<Finding> {
    let check = "gossip port";
    let membership = &config.membership;
    let ip = if membership.has_key() { [0, 0, 0, 0] } else { [127, 0, 0, 1] };
    let address = membership.bind.unwrap_or(SocketAddr::from((ip, DEFAULT_PORT)));
    Some(match UdpSocket::bind(address) {
        Ok(_) => Finding::fine(check, format!("{address} is free")),
        Err(error) if membership.bind.is_none() => Finding::doubtful(
            check,
            format!("{address}: {}, a free one will be taken", words(&error)),
            "set `membership.bind` if others have this node as a seed",
        ),
        Err(error) => not_bound(check, address, &error, "membership.bind"),
    })
}

/// The port on which a vehicle that moves is told its poses.
#[cfg(feature = "camera")]
pub(super) fn poses(config: &NodeConfig) -> Option<Finding> {
    let (check, address) = ("pose port", config.pose.listen?);
    Some(match UdpSocket::bind(address) {
        Ok(_) => Finding::fine(check, format!("{address} is free")),
        Err(error) => not_bound(check, address, &error, "pose.listen"),
    })
}

/// The address of the dashboard, unless it is switched off.
pub(super) fn dashboard(config: &NodeConfig) -> Option<Finding> {
    let (check, listen) = ("dashboard", config.dashboard.listen);
    let address = listen.unwrap_or(DEFAULT_ADDRESS);
    config.dashboard.enabled.then(|| match TcpListener::bind(address) {
        Ok(_) => Finding::fine(check, format!("{address} is free")),
        Err(error) if listen.is_none() => Finding::doubtful(
            check,
            format!("{address}: {}, a free one will be taken", words(&error)),
            "set `dashboard.listen` if its address has to be known",
        ),
        Err(error) => not_bound(check, address, &error, "dashboard.listen"),
    })
}

/// The address of the log's live server, where it is wanted.
#[cfg(feature = "foxglove")]
pub(super) fn live(config: &NodeConfig) -> Option<Finding> {
    let port = config.record.as_ref().and_then(|record| record.live_port)?;
    let (check, address) = ("live port", SocketAddr::from(([127, 0, 0, 1], port)));
    Some(match TcpListener::bind(address) {
        Ok(_) => Finding::fine(check, format!("{address} is free")),
        Err(error) => not_bound(check, address, &error, "record.live_port"),
    })
}

fn not_bound(check: &'static str, address: SocketAddr, error: &io::Error, key: &str) -> Finding {
    let fix = match error.kind() {
        io::ErrorKind::AddrNotAvailable => format!("set `{key}` to an address of this machine, or 0.0.0.0 for all"),
        io::ErrorKind::PermissionDenied => format!("set `{key}` to a port from 1024"),
        _ => format!("stop what uses it, perhaps this node itself, or set `{key}` to another"),
    };
    Finding::broken(check, format!("{address}: {}", words(error)), fix)
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
