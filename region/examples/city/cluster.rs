//! Three NATS servers by the configuration of deploy/region, on loopback.

use std::fs;
use std::net::{Ipv4Addr, SocketAddr, TcpListener};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::atomic::{AtomicUsize, Ordering};

use anyhow::{Context, ensure};
use ecod::leadership::BrokerAddress;
use ecod_region::account::CellAccount;
use ecod_region::broker::{BrokerLogin, read_secret};
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;

use crate::places::Place;

/// Servers of the region.
pub(crate) const SERVERS: usize = 3;

/// The servers and their directory.
pub(crate) struct Cluster {
    directory: PathBuf,
    servers: Vec<Server>,
}

struct Server {
    child: Child,
    addresses: ServerAddresses,
}

#[derive(Debug, Clone, Copy)]
struct ServerAddresses {
    /// For cells.
    mqtt: SocketAddr,
    /// For the other servers.
    route: SocketAddr,
    /// For NATS's protocol.
    clients: SocketAddr,
    /// For figures.
    monitor: SocketAddr,
}

const DEPLOY: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../deploy/region");

/// Password of all simulated and real cells.
pub(crate) const PASSWORD: &str = "a-city-on-one-machine";

impl Cluster {
    /// Accounts for all places, and the servers.
    pub(crate) fn start(directory: &Path, places: &[Place]) -> anyhow::Result<Self> {
        let directory = directory.join("region");
        fs::create_dir_all(directory.join("cells.d"))?;
        for Place { cell, origin } in places {
            let account = CellAccount::new(cell.clone(), origin);
            fs::write(
                directory.join("cells.d").join(format!("{cell}.conf")),
                account.nats(PASSWORD),
            )?;
        }
        let added = Command::new(Path::new(DEPLOY).join("add-cell"))
            .env("REGION_CONFIG", &directory)
            .status()?;
        ensure!(added.success(), "add-cell failed");
        for file in ["common.conf", "nats-cluster.conf"] {
            fs::copy(Path::new(DEPLOY).join(file), directory.join(file))?;
        }
        // No TLS: the benchmark measures the server, not cryptography.
        fs::write(
            directory.join("mqtt.conf"),
            "mqtt { listen: $REGION_MQTT }\n",
        )?;
        fs::write(directory.join("cluster-tls.conf"), "")?;
        let addresses: Vec<ServerAddresses> = (0..SERVERS)
            .map(|_| {
                Ok(ServerAddresses {
                    mqtt: free_address()?,
                    route: free_address()?,
                    clients: free_address()?,
                    monitor: free_address()?,
                })
            })
            .collect::<anyhow::Result<_>>()?;
        let routes: Vec<_> = addresses
            .iter()
            .map(|server| format!("\"nats://{}\"", server.route))
            .collect();
        fs::write(
            directory.join("routes.conf"),
            format!("routes: [{}]\n", routes.join(", ")),
        )?;
        let spawned = addresses.iter().enumerate();
        let servers = spawned
            .map(|(number, addresses)| {
                Ok(Server {
                    child: spawn(&directory, number, addresses)?,
                    addresses: *addresses,
                })
            })
            .collect::<anyhow::Result<_>>()?;
        Ok(Self { directory, servers })
    }

    pub(crate) fn addresses(&self) -> Vec<SocketAddr> {
        self.servers
            .iter()
            .map(|server| server.addresses.mqtt)
            .collect()
    }

    /// The login of one of the region's own users.
    pub(crate) fn login(&self, server: usize, user: &str) -> BrokerLogin {
        let secret = read_secret(&self.directory.join("passwords").join(user));
        let address = BrokerAddress::from(self.servers[server].addresses.mqtt);
        BrokerLogin::plain(
            address,
            user,
            secret.as_ref().map_or("", |secret| secret.reveal()),
        )
    }

    pub(crate) fn pids(&self) -> Vec<u32> {
        self.servers
            .iter()
            .map(|server| server.child.id())
            .collect()
    }

    /// Sends a signal to a server; waits for the end of one that is killed.
    pub(crate) fn signal(&mut self, server: usize, signal: Signal) -> anyhow::Result<()> {
        let child = &mut self.servers[server].child;
        kill(Pid::from_raw(i32::try_from(child.id())?), signal)?;
        if signal == Signal::SIGKILL {
            child.wait()?;
        }
        Ok(())
    }

    /// Starts a server that was killed.
    pub(crate) fn restart(&mut self, server: usize) -> anyhow::Result<()> {
        let addresses = self.servers[server].addresses;
        self.servers[server].child = spawn(&self.directory, server, &addresses)?;
        Ok(())
    }
}

impl Drop for Cluster {
    fn drop(&mut self) {
        for server in &mut self.servers {
            // SIGKILL also ends a server that SIGSTOP has stopped.
            let _ = server.child.kill();
            // Waited for so that it leaves no zombie; its status makes no difference.
            let _ = server.child.wait();
        }
    }
}

fn spawn(directory: &Path, number: usize, addresses: &ServerAddresses) -> anyhow::Result<Child> {
    let log = fs::File::options()
        .create(true)
        .append(true)
        .open(directory.join(format!("server-{number}.log")))?;
    // The servers end with this program, however that ends.
    Command::new("setpriv")
        .args([
            "--pdeathsig",
            "KILL",
            "nats-server",
            "-c",
            "nats-cluster.conf",
        ])
        .current_dir(directory)
        .env("REGION_SERVER", format!("region-{}", number + 1))
        .env("REGION_MQTT", addresses.mqtt.to_string())
        .env("REGION_CLUSTER", addresses.route.to_string())
        .env("REGION_CLIENTS", addresses.clients.to_string())
        .env("REGION_MONITOR", addresses.monitor.to_string())
        .env("REGION_DATA", directory.join(format!("data-{number}")))
        .stdin(Stdio::null())
        .stdout(Stdio::null())
        .stderr(log)
        .spawn()
        .context("nats-server cannot be started; `make city` installs it")
}

/// A free port below the ephemeral range, so that no outgoing connection takes it while the server
/// is down.
pub(crate) fn free_address() -> anyhow::Result<SocketAddr> {
    static GIVEN: AtomicUsize = AtomicUsize::new(0);
    let start = std::process::id() as usize * 97;
    let mut ports =
        (0..14_000).map(|_| 18_000 + (start + GIVEN.fetch_add(1, Ordering::Relaxed)) % 14_000);
    let address = ports.find_map(|port| {
        let address = SocketAddr::from((Ipv4Addr::LOCALHOST, port as u16));
        TcpListener::bind(address).is_ok().then_some(address)
    });
    address.context("no free port on loopback")
}
