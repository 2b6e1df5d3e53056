//! Addresses, configurations and input of a cell's nodes.

use std::fmt::Write as _;
use std::net::{Ipv4Addr, SocketAddr};
use std::path::Path;

use crate::failover::cell::{EDGE, Plan, is_cav};
use crate::network;
use crate::ports::Ports;

/// Where a node's broker listens and where it gossips.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Addresses {
    pub(crate) broker: SocketAddr,
    pub(crate) gossip: SocketAddr,
}

/// Addresses of a node: free ports on loopback, or fixed ports in a namespace, where it listens at every address.
pub(crate) fn addresses(
    ports: &mut Ports,
    node: usize,
    bridged: bool,
) -> anyhow::Result<Addresses> {
    let (ip, broker, gossip) = if bridged {
        (network::address(node), 1883, 17_884)
    } else {
        (Ipv4Addr::LOCALHOST, ports.free()?, ports.free()?)
    };
    Ok(Addresses {
        broker: (ip, broker).into(),
        gossip: (ip, gossip).into(),
    })
}

pub(crate) const CELL: &str = "trial";

/// The only landmark of the cell.
pub(crate) const LANDMARK: &str = "ahead";

/// One object ahead of the vehicle in every frame.
pub(crate) const DETECTIONS: &str = r#"[{"label":"car","confidence":0.9,"bounding_box":{"x_min":7.5,"y_min":5.0,"x_max":8.5,"y_max":6.0}}]
"#;

/// A grey image of the default optics' shape: the vehicles see by recorded detections, but all else is as with a camera.
pub(crate) fn frame() -> Vec<u8> {
    let mut ppm = b"P6 16 12 255\n".to_vec();
    ppm.extend([128; 16 * 12 * 3]);
    ppm
}

/// On loopback the nodes find each other by seeds; with a network interface for each node, by multicast.
pub(crate) fn configuration(
    plan: &Plan,
    index: usize,
    name: &str,
    own: Addresses,
    all: &[Addresses],
    broker: Option<SocketAddr>,
    shared: &Path,
) -> String {
    let role = match index {
        EDGE => "edge",
        _ if is_cav(plan.nodes, index) => "cav",
        _ => "auto",
    };
    let seeds: Vec<_> = all
        .iter()
        .take(3)
        .map(|seed| format!("\"{}\"", seed.gossip))
        .collect();
    let seeds = if plan.bridged {
        String::new()
    } else {
        seeds.join(", ")
    };
    let listening = |address: SocketAddr| {
        if plan.bridged {
            SocketAddr::from((Ipv4Addr::UNSPECIFIED, address.port()))
        } else {
            address
        }
    };
    let mut text = format!(
        "name = \"{name}\"\ncell = \"{CELL}\"\nrole = \"{role}\"\nlisten = \"{}\"\nstate_dir = \"state\"\n\n\
         [membership]\nkey = \"a key for trials\"\nbind = \"{}\"\nseeds = [{seeds}]\n\n\
         [membership.multicast]\nenabled = {}\n\n[broker]\nallow_plaintext = true\n\n\
         [dashboard]\nenabled = false\n",
        listening(own.broker),
        listening(own.gossip),
        plan.bridged
    );
    if let Some(broker) = broker {
        let _ = write!(
            text,
            "\n[mqtt]\nbroker = \"{broker}\"\nfallback_to_embedded = {}\n",
            plan.fallback
        );
    }
    if index != EDGE {
        let frames = shared.join("frames");
        let detections = shared.join("detections.jsonl");
        let _ = write!(
            text,
            "\n[camera]\nvotes = {}\n\n[camera.source]\nkind = \"images\"\npath = {frames:?}\nlooping = true\n\n\
             [camera.detector]\nkind = \"recorded\"\npath = {detections:?}\nlooping = true\n\n\
             [camera.projection.sizes.default]\nwidth_m = 0.5\nheight_m = 0.5\n",
            plan.votes
        );
    }
    text + &format!("\n[[landmarks]]\nid = \"{LANDMARK}\"\nx_m = 6.6\ny_m = 0.0\n")
}
