//! A node as a process of its own.

use std::fs::{self, File};
use std::net::{Ipv4Addr, SocketAddr, TcpListener, UdpSocket};
use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

use anyhow::{Context, bail, ensure};
use ecod_actors::node::config::NodeConfig;
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use tokio::process::{Child, Command};

/// A running `ecod-node`; killed when dropped.
#[derive(Debug)]
pub struct NodeProcess {
    name: String,
    program: PathBuf,
    file: PathBuf,
    log: PathBuf,
    child: Child,
    starts: u32,
    killed: bool,
}

/// Time that a node may take to stop.
const STOP_TIMEOUT: Duration = Duration::from_secs(5);

impl NodeProcess {
    /// Writes the node's configuration to the directory and starts it; its log goes there too.
    ///
    /// # Errors
    /// Returns an error if a file cannot be written or the program cannot be run.
    pub fn start(program: &Path, config: &NodeConfig, directory: &Path) -> anyhow::Result<Self> {
        let name = config
            .name
            .as_ref()
            .map_or_else(|| "node".to_owned(), ToString::to_string);
        let file = directory.join(format!("{name}.toml"));
        let log = directory.join(format!("{name}.log"));
        let text =
            toml::to_string(config).context("the configuration cannot be written as TOML")?;
        fs::write(&file, text).with_context(|| format!("cannot write {}", file.display()))?;
        File::create(&log).with_context(|| format!("cannot write {}", log.display()))?;
        let child = spawn(program, &file, &log)?;
        Ok(Self {
            name,
            program: program.into(),
            file,
            log,
            child,
            starts: 1,
            killed: false,
        })
    }

    /// Starts the node again, with its configuration; the log goes on.
    ///
    /// # Errors
    /// Returns an error if the program cannot be run.
    pub fn restart(&mut self) -> anyhow::Result<()> {
        self.child = spawn(&self.program, &self.file, &self.log)?;
        self.starts += 1;
        self.killed = false;
        Ok(())
    }

    /// SIGKILL: the node has no time for farewells.
    ///
    /// # Errors
    /// Returns an error if the operating system refuses.
    pub async fn kill(&mut self) -> anyhow::Result<()> {
        self.killed = true;
        self.child
            .kill()
            .await
            .with_context(|| format!("cannot kill node {}", self.name))
    }

    /// True if it was killed and not started again.
    pub fn is_killed(&self) -> bool {
        self.killed
    }

    /// Number of times that the node was started.
    pub fn starts(&self) -> u32 {
        self.starts
    }

    /// Looks whether it still runs.
    ///
    /// # Errors
    /// Returns an error if the process has ended by itself, with the last line of its log.
    pub fn check(&mut self) -> anyhow::Result<()> {
        if !self.killed
            && let Some(status) = self.child.try_wait()?
        {
            let log = fs::read_to_string(&self.log).unwrap_or_default();
            let last = log.lines().last().unwrap_or("nothing logged");
            bail!("node {} ended with {status}: {last}", self.name);
        }
        Ok(())
    }

    /// The address that the node names in its log by this message, as soon as it does.
    ///
    /// # Errors
    /// Returns an error if the process has ended by itself.
    pub async fn address(&mut self, message: &str) -> anyhow::Result<SocketAddr> {
        loop {
            let log = fs::read_to_string(&self.log).unwrap_or_default();
            // The last line may not be whole.
            let whole = log.rsplit_once('\n').map_or("", |(whole, _)| whole);
            let mut lines = whole.lines().filter(|line| line.contains(message));
            if let Some((_, address)) = lines
                .next_back()
                .and_then(|line| line.rsplit_once("address="))
            {
                return address
                    .parse()
                    .with_context(|| format!("no address of node {}: {address}", self.name));
            }
            self.check()?;
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    }

    /// The process's number, while it runs.
    pub fn pid(&self) -> Option<u32> {
        self.child.id()
    }

    /// Requests the node to stop, and kills it if it does not.
    pub async fn stop(&mut self) {
        let pid = self
            .child
            .id()
            .and_then(|pid| i32::try_from(pid).ok())
            .map(Pid::from_raw);
        if let Some(Err(error)) = pid.map(|pid| kill(pid, Signal::SIGTERM)) {
            tracing::warn!(node = self.name, %error, "node not asked to stop");
        }
        if tokio::time::timeout(STOP_TIMEOUT, self.child.wait())
            .await
            .is_err()
        {
            tracing::warn!(node = self.name, "node did not stop in time");
            if let Err(error) = self.child.kill().await {
                tracing::warn!(node = self.name, %error, "node not killed");
            }
        }
    }
}

/// The program `ecod-node` in the directory of this program.
///
/// # Errors
/// Returns an error if there is no such program.
pub fn node_program() -> anyhow::Result<PathBuf> {
    node_beside(&std::env::current_exe().context("this program cannot be found")?)
}

/// The program `ecod-node` in the directory of `program`.
///
/// # Errors
/// Returns an error if there is no such program.
pub fn node_beside(program: &Path) -> anyhow::Result<PathBuf> {
    let node = program.with_file_name("ecod-node");
    let profile = if cfg!(debug_assertions) {
        ""
    } else {
        " --release"
    };
    ensure!(
        node.is_file(),
        "there is no {}: build it by `cargo build{profile} --bin ecod-node`",
        node.display()
    );
    Ok(node)
}

/// First and last port for nodes: below the range for outgoing connections, which could otherwise
/// take a port before the node does.
const PORTS: [usize; 2] = [18_000, 31_999];

/// An unused address for TCP or UDP; each call returns another one.
///
/// # Errors
/// Returns an error if loopback has no free port.
pub fn free_address() -> anyhow::Result<SocketAddr> {
    static GIVEN: AtomicUsize = AtomicUsize::new(0);
    let [first, last] = PORTS;
    // Processes start apart.
    let start = std::process::id() as usize * 97;
    let mut ports = (first..=last).map(|_| {
        let port = first + (start + GIVEN.fetch_add(1, Ordering::Relaxed)) % (last - first + 1);
        SocketAddr::from((Ipv4Addr::LOCALHOST, port as u16))
    });
    let is_free = |address: &SocketAddr| {
        TcpListener::bind(address).is_ok() && UdpSocket::bind(address).is_ok()
    };
    ports.find(is_free).context("no free port on loopback")
}

fn spawn(program: &Path, file: &Path, log: &Path) -> anyhow::Result<Child> {
    let output = File::options()
        .append(true)
        .open(log)
        .with_context(|| format!("cannot write {}", log.display()))?;
    let mut command = Command::new(program);
    // The node must only use its file, so variables of the environment are removed.
    for (key, _) in
        std::env::vars_os().filter(|(key, _)| key.to_string_lossy().starts_with("ECOD_"))
    {
        command.env_remove(key);
    }
    command
        .args(["--log-format", "text", "--config"])
        .arg(file)
        // The pipe is not written to; it closes when this process ends in any way, which ends the
        // node.
        .arg("--stop-at-eof")
        .stdin(Stdio::piped())
        .stdout(Stdio::null())
        .stderr(output)
        .kill_on_drop(true)
        .spawn()
        .with_context(|| format!("cannot start {}", program.display()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn missing_node_program_names_remedy() {
        let error = node_beside(Path::new("/no/such/ecod-lab"))
            .unwrap_err()
            .to_string();
        assert!(
            error.contains("/no/such/ecod-node") && error.contains("--bin ecod-node`"),
            "{error}"
        );
    }
}
