//! Addresses, configurations and input of a cell's nodes.

use std::fmt::Write as _;
use std::net::{Ipv4Addr, SocketAddr, TcpListener, UdpSocket};
use std::path::Path;

use anyhow::bail;
use ecod_actors::platform::clock;

use crate::cell::{EDGE, Plan};
use crate::network;

/// Where a node's broker listens and where it gossips.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Addresses {
    pub(crate) broker: SocketAddr,
    pub(crate) gossip: SocketAddr,
}

/// Hands out ports that are free now, from below those that the system gives to outgoing connections.
pub(crate) struct Ports {
    next: u16,
}

impl Ports {
    const FIRST: u16 = 18_000;
    const LAST: u16 = 32_000;

    /// Starts somewhere else in every process.
    pub(crate) fn new() -> Self {
        let span = u32::from(Self::LAST - Self::FIRST);
        Self { next: Self::FIRST + (clock::now().micros() as u32 % span) as u16 }
    }

    pub(crate) fn free(&mut self) -> anyhow::Result<u16> {
        for _ in Self::FIRST..Self::LAST {
            self.next = if self.next >= Self::LAST { Self::FIRST } else { self.next + 1 };
            let address = (Ipv4Addr::LOCALHOST, self.next);
            if TcpListener::bind(address).is_ok() && UdpSocket::bind(address).is_ok() {
                return Ok(self.next);
            }
        }
        bail!("no free port on loopback")
    }

    pub(crate) fn of(&mut self, node: usize, bridged: bool) -> anyhow::Result<Addresses> {
        let (ip, broker, gossip) = if bridged {
            (network::address(node), 1883, 17_884)
        } else {
            (Ipv4Addr::LOCALHOST, self.free()?, self.free()?)
        };
        Ok(Addresses { broker: (ip, broker).into(), gossip: (ip, gossip).into() })
    }
}

/// The cell's name.
pub(crate) const CELL: &str = "trial";

/// The cell's only known location.
pub(crate) const LANDMARK: &str = "ahead";

/// One object ahead of the vehicle in every frame.
pub(crate) const DETECTIONS: &str = r#"[{"label":"car","confidence":0.9,"bounding_box":{"x_min":300,"y_min":200,"x_max":340,"y_max":240}}]
"#;

/// A grey image: the vehicles see by recorded detections, but all else is as with a camera.
pub(crate) fn frame() -> Vec<u8> {
    let mut ppm = b"P6 16 16 255\n".to_vec();
    ppm.extend([128; 16 * 16 * 3]);
    ppm
}

/// On loopback the nodes find each other by seeds; where each has a network interface of its own, by multicast.
pub(crate) fn configuration(
    plan: &Plan,
    index: usize,
    name: &str,
    own: Addresses,
    all: &[Addresses],
    broker: Option<SocketAddr>,
    shared: &Path,
) -> String {
    let role = if index == EDGE { "edge" } else { "auto" };
    let seeds: Vec<_> = all.iter().take(3).map(|seed| format!("\"{}\"", seed.gossip)).collect();
    let seeds = if plan.bridged { String::new() } else { seeds.join(", ") };
    let mut text = format!(
        "name = \"{name}\"\ncell = \"{CELL}\"\nrole = \"{role}\"\nlisten = \"{}\"\nstate_dir = \"state\"\n\n\
         [membership]\nkey = \"a key for trials\"\nbind = \"{}\"\nseeds = [{seeds}]\n\n\
         [membership.multicast]\nenabled = {}\n\n[broker]\nallow_plaintext = true\n\n\
         [dashboard]\nenabled = false\n",
        own.broker, own.gossip, plan.bridged
    );
    if let Some(broker) = broker {
        let _ = write!(text, "\n[mqtt]\nbroker = \"{broker}\"\nfallback_to_embedded = {}\n", plan.fallback);
    }
    if index != EDGE {
        let (frames, detections) = (shared.join("frames"), shared.join("detections.jsonl"));
        let _ = write!(
            text,
            "\n[camera]\nvotes = {}\n\n[camera.source]\nkind = \"images\"\npath = {frames:?}\nlooping = true\n\n\
             [camera.detector]\nkind = \"recorded\"\npath = {detections:?}\nlooping = true\n\n\
             [camera.projection.sizes.default]\nwidth_m = 0.5\nheight_m = 0.5\n",
            plan.votes
        );
    }
    text + &format!("\n[[landmarks]]\nid = \"{LANDMARK}\"\nx_m = 6.0\ny_m = 0.0\n")
}
