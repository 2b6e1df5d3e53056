//! Free ports on loopback.

use std::net::{Ipv4Addr, TcpListener, UdpSocket};

use anyhow::bail;
use ecod_actors::platform::clock;

/// Returns free ports below the range that the system uses for outgoing connections.
pub(crate) struct Ports {
    next: u16,
}

impl Ports {
    const FIRST: u16 = 18_000;
    const LAST: u16 = 32_000;

    /// Starts somewhere else in every process.
    pub(crate) fn new() -> Self {
        let span = u32::from(Self::LAST - Self::FIRST);
        Self {
            next: Self::FIRST + (clock::now().micros() as u32 % span) as u16,
        }
    }

    pub(crate) fn free(&mut self) -> anyhow::Result<u16> {
        for _ in Self::FIRST..Self::LAST {
            self.next = if self.next >= Self::LAST {
                Self::FIRST
            } else {
                self.next + 1
            };
            let address = (Ipv4Addr::LOCALHOST, self.next);
            if TcpListener::bind(address).is_ok() && UdpSocket::bind(address).is_ok() {
                return Ok(self.next);
            }
        }
        bail!("no free port on loopback")
    }
}
