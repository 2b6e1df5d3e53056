//! The network of a trial's nodes: loopback, or a network namespace for each node, joined by bridges.
//!
//! ```text
//! node 0: eth0 ── veth ──┐            one bridge, or two while the network is split
//! node 1: eth0 ── veth ──┴── bridge   (the harness has an address on the first)
//! ```

use std::io::Write;
use std::net::Ipv4Addr;
use std::process::{Command, Stdio};

use anyhow::{Context, bail};

/// Where the harness itself is on the first bridge.
pub(crate) const HARNESS: Ipv4Addr = Ipv4Addr::new(10, 77, 0, 254);

/// Namespaces and bridges; removed when dropped.
#[derive(Debug)]
pub(crate) struct Bridged {
    nodes: usize,
}

/// True if namespaces can be made here.
pub(crate) fn has_namespaces() -> bool {
    let probe = namespace(usize::MAX);
    let made = ip(&["netns", "add", &probe])
        .and_then(|()| ip(&["link", "add", &bridge('p'), "type", "bridge"]));
    let _ = ip(&["link", "delete", &bridge('p')]);
    let _ = ip(&["netns", "delete", &probe]);
    made.is_ok()
}

/// True if packets can be dropped at random here.
pub(crate) fn has_packet_filter() -> bool {
    Command::new("nft")
        .arg("--version")
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .status()
        .is_ok_and(|s| s.success())
}

impl Bridged {
    /// A namespace for each node, all on one bridge.
    pub(crate) fn new(nodes: usize) -> anyhow::Result<Self> {
        let network = Self { nodes };
        for side in ['a', 'b'] {
            ip(&[
                "link",
                "add",
                &bridge(side),
                "type",
                "bridge",
                "mcast_snooping",
                "0",
            ])?;
            ip(&["link", "set", &bridge(side), "up"])?;
        }
        ip(&[
            "address",
            "add",
            &format!("{HARNESS}/24"),
            "dev",
            &bridge('a'),
        ])?;
        for node in 0..nodes {
            let space = namespace(node);
            let port = port(node);
            ip(&["netns", "add", &space])?;
            ip(&[
                "link", "add", &port, "type", "veth", "peer", "name", "eth0", "netns", &space,
            ])?;
            ip(&["link", "set", &port, "master", &bridge('a'), "up"])?;
            ip(&[
                "-n",
                &space,
                "address",
                "add",
                &format!("{}/24", address(node)),
                "dev",
                "eth0",
            ])?;
            ip(&["-n", &space, "link", "set", "lo", "up"])?;
            ip(&["-n", &space, "link", "set", "eth0", "up"])?;
            ip(&["-n", &space, "route", "add", "224.0.0.0/4", "dev", "eth0"])?;
        }
        Ok(network)
    }

    /// Joins some nodes among themselves only, or all nodes without an argument.
    pub(crate) fn split(&self, apart: &[usize]) -> anyhow::Result<()> {
        for node in 0..self.nodes {
            let side = if apart.contains(&node) { 'b' } else { 'a' };
            ip(&["link", "set", &port(node), "master", &bridge(side)])?;
        }
        Ok(())
    }

    /// Sends what one node has for another to a station that is not there, or sends it right again.
    pub(crate) fn cut_one_way(&self, from: usize, to: usize, cut: bool) -> anyhow::Result<()> {
        let space = namespace(from);
        let to = address(to).to_string();
        let change = if cut { "replace" } else { "delete" };
        let mut arguments = vec!["-n", &space, "neigh", change, &to, "dev", "eth0"];
        if cut {
            arguments.extend(["lladdr", "02:00:00:00:00:01", "nud", "permanent"]);
        }
        ip(&arguments)
    }

    /// Gives a node another address, as a DHCP server may, and loses the one before.
    pub(crate) fn readdress(&self, node: usize) -> anyhow::Result<()> {
        let space = namespace(node);
        let old = address(node);
        let new = readdressed(node);
        let change = |action: &str, address: Ipv4Addr| {
            let address = format!("{address}/24");
            ip(&["-n", &space, "address", action, &address, "dev", "eth0"])
        };
        change("delete", old)?;
        change("add", new)?;
        // Routes go with the last address of an interface.
        ip(&[
            "-n",
            &space,
            "route",
            "replace",
            "224.0.0.0/4",
            "dev",
            "eth0",
        ])
    }

    /// Every node loses this percentage of arriving packets; zero removes the loss.
    pub(crate) fn lose(&self, percent: u8) -> anyhow::Result<()> {
        let rules = if percent == 0 {
            "delete table inet trials\n".to_owned()
        } else {
            let rule = format!("iifname \"eth0\" numgen random mod 100 < {percent} drop");
            format!(
                "table inet trials {{\nchain input {{\ntype filter hook input priority 0; {rule}; }}\n}}\n"
            )
        };
        (0..self.nodes).try_for_each(|node| nft(&namespace(node), &rules))
    }
}

impl Drop for Bridged {
    fn drop(&mut self) {
        // A namespace that was not created does not exist for removal.
        for node in 0..self.nodes {
            // With its namespace alone it would go a while later, when the next trial makes its own.
            let _ = ip(&["link", "delete", &port(node)]);
            let _ = ip(&["netns", "delete", &namespace(node)]);
        }
        for side in ['a', 'b'] {
            let _ = ip(&["link", "delete", &bridge(side)]);
        }
    }
}

/// Name of a node's namespace, which is separate for each harness.
pub(crate) fn namespace(node: usize) -> String {
    format!("ecod-{}-{}", std::process::id(), node as u16)
}

/// Address of a node on the bridge.
pub(crate) fn address(node: usize) -> Ipv4Addr {
    Ipv4Addr::new(10, 77, 0, node as u8 + 1)
}

/// Address of a node after [`Bridged::readdress`].
fn readdressed(node: usize) -> Ipv4Addr {
    Ipv4Addr::new(10, 77, 0, node as u8 + 101)
}

fn port(node: usize) -> String {
    format!("ec{}v{node}", std::process::id())
}

fn bridge(side: char) -> String {
    format!("ec{}{side}", std::process::id())
}

fn ip(arguments: &[&str]) -> anyhow::Result<()> {
    run(Command::new("ip").args(arguments), "")
}

fn nft(namespace: &str, rules: &str) -> anyhow::Result<()> {
    run(
        Command::new("ip").args(["netns", "exec", namespace, "nft", "-f", "-"]),
        rules,
    )
}

fn run(command: &mut Command, input: &str) -> anyhow::Result<()> {
    command
        .stdin(Stdio::piped())
        .stdout(Stdio::null())
        .stderr(Stdio::piped());
    let mut child = command
        .spawn()
        .with_context(|| format!("cannot run {command:?}"))?;
    if let Some(mut stdin) = child.stdin.take() {
        stdin.write_all(input.as_bytes())?;
    }
    let output = child.wait_with_output()?;
    if !output.status.success() {
        bail!(
            "{command:?}: {}",
            String::from_utf8_lossy(&output.stderr).trim()
        );
    }
    Ok(())
}
