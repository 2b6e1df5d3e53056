//! Sockets of the membership: the node's own, and the multicast socket that all nodes of a machine
//! share.

use std::io::{self, ErrorKind};
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr, SocketAddrV4};
use std::sync::OnceLock;

use socket2::{Domain, Protocol, Socket, Type};
use tokio::net::UdpSocket;

use super::config::{DEFAULT_PORT, MembershipConfig, MulticastConfig};

/// The node's end of the gossip.
pub(crate) struct GossipSocket {
    own: UdpSocket,
    group: OnceLock<(UdpSocket, SocketAddr)>,
    address: SocketAddr,
}

/// A gossip socket that could not be opened.
#[derive(Debug, thiserror::Error)]
#[error("key `membership.bind`: cannot gossip on {address}: {source}")]
pub struct BindError {
    address: SocketAddr,
    source: io::Error,
}

impl GossipSocket {
    /// Opens the node's own socket.
    pub(crate) fn bind(config: &MembershipConfig) -> Result<Self, BindError> {
        let own = match config.bind {
            Some(address) => open(address),
            None => open_default(config.default_ip()),
        }?;
        let failed = |source| BindError {
            address: config.bind.unwrap_or(UNKNOWN),
            source,
        };
        let address = own.local_addr().map_err(failed)?;
        Ok(Self {
            own: UdpSocket::from_std(own).map_err(failed)?,
            group: OnceLock::new(),
            address,
        })
    }

    /// Joins the multicast group, if enabled.
    pub(crate) fn join(&self, config: &MulticastConfig) -> io::Result<()> {
        if let Some(group) = join(config, &self.own, self.address)? {
            // The cell is empty, because the group is joined once.
            let _ = self.group.set(group);
        }
        Ok(())
    }

    /// The bound address, which may be unspecified.
    pub(crate) fn address(&self) -> SocketAddr {
        self.address
    }

    /// Waits until a datagram can be read.
    pub(crate) async fn readable(&self) -> io::Result<()> {
        match self.group.get() {
            None => self.own.readable().await,
            Some((group, _)) => tokio::select! {
                ready = self.own.readable() => ready,
                ready = group.readable() => ready,
            },
        }
    }

    /// Reads a datagram that waits.
    pub(crate) fn receive(&self, buffer: &mut [u8]) -> Option<(usize, SocketAddr)> {
        let sockets = [Some(&self.own), self.group.get().map(|(group, _)| group)];
        sockets
            .into_iter()
            .flatten()
            .find_map(|socket| socket.try_recv_from(buffer).ok())
    }

    /// Sends a datagram, or fails when that would block.
    pub(crate) fn send(&self, frame: &[u8], to: SocketAddr) -> io::Result<()> {
        self.own.try_send_to(frame, to).map(drop)
    }

    /// Sends a datagram to the group, if there is one.
    pub(crate) fn multicast(&self, frame: &[u8]) -> Option<io::Result<()>> {
        self.group.get().map(|(_, group)| self.send(frame, *group))
    }
}

/// True if an address belongs to this machine: a socket can be bound to it.
pub(crate) fn is_of_this_machine(ip: IpAddr) -> bool {
    ip.is_loopback() || ip.is_unspecified() || std::net::UdpSocket::bind((ip, 0)).is_ok()
}

/// The address of this machine from which datagrams to another one come; `None` without a route.
pub(crate) fn source_towards(peer: SocketAddr) -> Option<IpAddr> {
    let unspecified = match peer {
        SocketAddr::V4(_) => IpAddr::from(Ipv4Addr::UNSPECIFIED),
        SocketAddr::V6(_) => IpAddr::from(Ipv6Addr::UNSPECIFIED),
    };
    // Connecting a UDP socket only selects its route.
    let socket = std::net::UdpSocket::bind((unspecified, 0)).ok()?;
    socket.connect(peer).ok()?;
    let source = socket.local_addr().ok()?.ip();
    (!source.is_loopback() && !source.is_unspecified()).then_some(source)
}

/// Receive buffer for datagrams that arrive while the node is stalled, in bytes.
const RECEIVE_BUFFER_BYTES: usize = 1 << 20;

const UNKNOWN: SocketAddr = SocketAddr::new(IpAddr::V4(Ipv4Addr::UNSPECIFIED), 0);

fn open_default(ip: IpAddr) -> Result<std::net::UdpSocket, BindError> {
    match open(SocketAddr::new(ip, DEFAULT_PORT)) {
        Err(error) if error.source.kind() == ErrorKind::AddrInUse => open(SocketAddr::new(ip, 0)),
        opened => opened,
    }
}

fn open(address: SocketAddr) -> Result<std::net::UdpSocket, BindError> {
    let open = || {
        let socket = Socket::new(
            Domain::for_address(address),
            Type::DGRAM,
            Some(Protocol::UDP),
        )?;
        socket.set_nonblocking(true)?;
        // The membership works with the system's default buffer, too.
        if let Err(error) = socket.set_recv_buffer_size(RECEIVE_BUFFER_BYTES) {
            tracing::debug!(%address, %error, "the size of the receive buffer stays as it is");
        }
        socket.bind(&address.into())?;
        Ok(socket.into())
    };
    open().map_err(|source| BindError { address, source })
}

fn join(
    config: &MulticastConfig,
    own: &UdpSocket,
    address: SocketAddr,
) -> io::Result<Option<(UdpSocket, SocketAddr)>> {
    let IpAddr::V4(ip) = address.ip() else {
        return Ok(None);
    };
    if !config.enabled {
        return Ok(None);
    }
    let interface = config.interface.unwrap_or(ip);
    let sender = socket2::SockRef::from(own);
    if !interface.is_unspecified() {
        sender.set_multicast_if_v4(&interface)?;
    }
    sender.set_multicast_ttl_v4(1)?;
    sender.set_multicast_loop_v4(true)?;
    let group = SocketAddr::V4(SocketAddrV4::new(config.group, config.port));
    let socket = Socket::new(Domain::IPV4, Type::DGRAM, Some(Protocol::UDP))?;
    socket.set_nonblocking(true)?;
    socket.set_reuse_address(true)?;
    socket.bind(&group.into())?;
    socket.join_multicast_v4(&config.group, &interface)?;
    Ok(Some((UdpSocket::from_std(socket.into())?, group)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn failed_multicast_join_is_retried() {
        let bind = Some(SocketAddr::from((Ipv4Addr::LOCALHOST, 0)));
        let socket = GossipSocket::bind(&MembershipConfig {
            bind,
            ..MembershipConfig::default()
        })
        .unwrap();
        // An interface address reserved for documentation.
        let absent = MulticastConfig {
            interface: Some(Ipv4Addr::new(192, 0, 2, 7)),
            ..MulticastConfig::default()
        };
        assert!(socket.join(&absent).is_err());
        assert!(socket.multicast(b"hello").is_none());
        socket.join(&MulticastConfig::default()).unwrap();
        assert!(socket.multicast(b"hello").is_some());
    }
}
