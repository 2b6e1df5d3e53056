//! Nodes as processes, each with a page.

use std::fs::File;
use std::net::{SocketAddr, TcpListener, UdpSocket};
use std::path::Path;
use std::process::{Child, Command, Stdio};

use ecod::wire::Role;

use crate::cell::config;

/// A process; killed when dropped.
pub(crate) struct Process(pub(crate) Child);

impl Drop for Process {
    fn drop(&mut self) {
        // It may have ended already.
        let _ = self.0.kill();
        self.0.wait().unwrap();
    }
}

/// Where a node is met.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Place {
    pub(crate) page: SocketAddr,
    pub(crate) broker: SocketAddr,
    pub(crate) gossip: SocketAddr,
}

/// Addresses without a listener at present.
pub(crate) fn free_places<const N: usize>() -> [Place; N] {
    let tcp = || TcpListener::bind("127.0.0.1:0").unwrap();
    let held = [(); N].map(|()| (tcp(), tcp(), UdpSocket::bind("127.0.0.1:0").unwrap()));
    std::array::from_fn(|n| Place {
        page: held[n].0.local_addr().unwrap(),
        broker: held[n].1.local_addr().unwrap(),
        gossip: held[n].2.local_addr().unwrap(),
    })
}

/// Starts a node that finds the others at their places.
pub(crate) fn start(
    name: &str,
    role: Role,
    place: Place,
    all: &[Place],
    directory: &Path,
) -> Process {
    let mut config = config(name, role, 12);
    config.listen = Some(place.broker);
    config.dashboard.listen = Some(place.page);
    config.membership.bind = Some(place.gossip);
    config.membership.seeds = all.iter().map(|place| place.gossip.to_string()).collect();
    config.election.stable_ms = 2000;
    let file = directory.join(format!("{name}.toml"));
    std::fs::write(&file, toml::to_string(&config).unwrap()).unwrap();
    let log = File::create(directory.join(format!("{name}.log"))).unwrap();
    let mut command = Command::new(env!("CARGO_BIN_EXE_ecod-node"));
    command
        .arg("--config")
        .arg(&file)
        .stdin(Stdio::null())
        .stdout(Stdio::null())
        .stderr(log);
    Process(command.spawn().unwrap())
}
