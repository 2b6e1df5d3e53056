//! Debian's nats-server as the broker of a region: MQTT 3.1.1 on top of JetStream.

use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use ecod_actors::transport::mqtt::BrokerAddress;
use tempfile::TempDir;

const PROGRAM: &str = "/usr/sbin/nats-server";

/// A nats-server process on free loopback ports; killed when dropped.
pub(crate) struct Nats {
    child: Child,
    directory: TempDir,
    port: u16,
}

impl Nats {
    pub(crate) fn start() -> Self {
        Self::configured("")
    }

    /// Admits only this user.
    pub(crate) fn with_user(user: &str, password: &str) -> Self {
        Self::configured(&format!(
            "authorization {{ users = [ {{ user: {user}, password: \"{password}\" }} ] }}\n"
        ))
    }

    fn configured(settings: &str) -> Self {
        assert!(
            Path::new(PROGRAM).exists(),
            "{PROGRAM} is missing: install Debian's package nats-server"
        );
        let directory = tempfile::tempdir().unwrap();
        // With MQTT it needs a name and JetStream. Port -1 is any free one.
        let text = format!(
            "server_name: region\nhost: 127.0.0.1\nport: -1\njetstream {{ store_dir: \"{}\" }}\n{settings}",
            directory.path().join("streams").display()
        );
        std::fs::write(directory.path().join("settings.conf"), text).unwrap();
        let (child, port) = spawn(directory.path(), None);
        Self {
            child,
            directory,
            port,
        }
    }

    pub(crate) fn address(&self) -> BrokerAddress {
        format!("127.0.0.1:{}", self.port).parse().unwrap()
    }

    pub(crate) fn kill(&mut self) {
        self.child.kill().unwrap();
        self.child.wait().unwrap();
    }

    /// Starts it again at the port that it had.
    pub(crate) fn revive(&mut self) {
        (self.child, _) = spawn(self.directory.path(), Some(self.port));
    }
}

impl Drop for Nats {
    fn drop(&mut self) {
        if self.child.kill().is_ok() {
            self.child.wait().unwrap();
        }
    }
}

/// Starts the server; returns it and the port for MQTT once it listens there.
fn spawn(directory: &Path, port: Option<u16>) -> (Child, u16) {
    let settings = directory.join("settings.conf");
    let log = directory.join("nats.log");
    let text = std::fs::read_to_string(&settings).unwrap();
    let port = port.map_or_else(|| "-1".to_owned(), |port| port.to_string());
    let file = directory.join("nats.conf");
    std::fs::write(
        &file,
        format!("{text}mqtt {{ host: 127.0.0.1, port: {port} }}\n"),
    )
    .unwrap();
    std::fs::remove_file(&log).ok();
    let mut command = Command::new(PROGRAM);
    command
        .arg("-c")
        .arg(&file)
        .arg("-l")
        .arg(&log)
        .stdout(Stdio::null())
        .stderr(Stdio::null());
    let mut child = command.spawn().unwrap();
    let deadline = Instant::now() + Duration::from_secs(20);
    loop {
        let said = std::fs::read_to_string(&log).unwrap_or_default();
        let listens = said
            .lines()
            .find_map(|line| line.split_once("Listening for MQTT clients on mqtt://127.0.0.1:"));
        if let Some((_, port)) = listens.filter(|_| said.contains("Server is ready")) {
            return (child, port.trim().parse().unwrap());
        }
        let ended = child.try_wait().unwrap();
        assert!(
            ended.is_none() && Instant::now() < deadline,
            "nats-server does not listen: {said}"
        );
        std::thread::sleep(Duration::from_millis(10));
    }
}
