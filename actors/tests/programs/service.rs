//! A node as a service: its notifications to the service manager, and its log.

use std::io::{BufRead, BufReader, Read};
use std::net::UdpSocket;
use std::os::unix::net::UnixDatagram;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use ecod_testkit::{command, output_of};
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use tempfile::TempDir;

/// Maximum time for anything.
const PATIENCE: Duration = Duration::from_secs(30);

/// Time for which a service manager waits for a sign of life here.
const WATCHDOG: Duration = Duration::from_secs(4);

/// A node started as systemd does it, and the socket that it talks to; killed when dropped.
struct Service {
    process: Child,
    socket: UnixDatagram,
    _directory: TempDir,
}

impl Service {
    fn start(arguments: &[&str]) -> Self {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("notify");
        let socket = UnixDatagram::bind(&path).unwrap();
        let mut command = program();
        command
            .args(arguments)
            .args(["--state-dir", directory.path().to_str().unwrap()]);
        command
            .env("NOTIFY_SOCKET", &path)
            .env("WATCHDOG_USEC", WATCHDOG.as_micros().to_string());
        let process = command
            .stdin(Stdio::null())
            .stderr(Stdio::null())
            .spawn()
            .unwrap();
        Self {
            process,
            socket,
            _directory: directory,
        }
    }

    /// The next notification of the node, if one arrives until then.
    fn receive(&self, until: Instant) -> Option<String> {
        let left = until
            .saturating_duration_since(Instant::now())
            .max(Duration::from_millis(1));
        self.socket.set_read_timeout(Some(left)).unwrap();
        let mut message = [0; 512];
        let length = self.socket.recv(&mut message).ok()?;
        Some(
            String::from_utf8_lossy(&message[..length])
                .trim_end()
                .to_owned(),
        )
    }

    /// All notifications of the node up to this one.
    fn receives_from(&self, wanted: &str) -> Vec<String> {
        let deadline = Instant::now() + PATIENCE;
        let mut lines_read = Vec::new();
        while let Some(line) = self.receive(deadline) {
            let found = line.starts_with(wanted);
            lines_read.push(line);
            if found {
                return lines_read;
            }
        }
        panic!("never: {wanted}, but {lines_read:?}");
    }

    fn signal(&self, signal: Signal) {
        kill(Pid::from_raw(self.process.id() as i32), signal).unwrap();
    }
}

impl Drop for Service {
    fn drop(&mut self) {
        self.process.kill().ok();
        self.process.wait().unwrap();
    }
}

fn program() -> Command {
    let mut command = command(env!("CARGO_BIN_EXE_ecod-node"));
    command
        .env("ECOD_MEMBERSHIP__MULTICAST__ENABLED", "false")
        .env("ECOD_DASHBOARD__ENABLED", "false");
    command.env_remove("RUST_LOG");
    command
}

fn free_port() -> u16 {
    UdpSocket::bind("127.0.0.1:0")
        .unwrap()
        .local_addr()
        .unwrap()
        .port()
}

/// The watchdog of a follower is fed while rounds of a live aggregator arrive, and the watchdog of the aggregator while
/// it leads; both notify their state and their end.
#[test]
fn watchdog_needs_rounds() {
    let gossip = format!("127.0.0.1:{}", free_port());
    let directory = tempfile::tempdir().unwrap();
    let file = directory.path().join("edge.toml");
    let config =
        format!("role = \"edge\"\nlisten = \"127.0.0.1:0\"\n[membership]\nbind = \"{gossip}\"\n");
    std::fs::write(&file, config).unwrap();
    let edge = Service::start(&["--config", file.to_str().unwrap()]);
    assert_eq!(
        edge.receives_from("READY=1").len(),
        1,
        "the first notification comes when the node runs"
    );
    edge.receives_from("STATUS=leading");
    edge.receives_from("WATCHDOG=1");

    let vehicle = Service::start(&["--role", "cav", "--name", "gauss", "--seed", &gossip]);
    let before = vehicle.receives_from("STATUS=following edge");
    assert!(before.iter().any(|line| line == "READY=1"), "{before:?}");
    vehicle.receives_from("WATCHDOG=1");
    vehicle.receives_from("WATCHDOG=1");

    edge.signal(Signal::SIGTERM);
    edge.receives_from("STOPPING=1");
    vehicle.receives_from("STATUS=no");
    let end = Instant::now() + WATCHDOG;
    while let Some(line) = vehicle.receive(end) {
        assert_ne!(line, "WATCHDOG=1", "fed without rounds");
    }
}

/// A supervisor that hangs does not feed the watchdog, even if the rest of the process works.
#[test]
fn stopped_node_feeds_no_watchdog() {
    let edge = Service::start(&["--role", "edge", "--listen", "127.0.0.1:0"]);
    edge.receives_from("WATCHDOG=1");
    edge.signal(Signal::SIGSTOP);
    // Messages from before the signal.
    while edge.receive(Instant::now() + WATCHDOG / 20).is_some() {}
    assert_eq!(edge.receive(Instant::now() + WATCHDOG / 2), None);
    edge.signal(Signal::SIGCONT);
    edge.receives_from("WATCHDOG=1");
}

/// Log of a node that is stopped as soon as it serves.
fn log(arguments: &[&str]) -> Vec<String> {
    let mut command = program();
    command
        .args(["--role", "edge", "--listen", "127.0.0.1:0", "--stop-at-eof"])
        .args(arguments);
    let mut node = command
        .stdin(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let mut log = BufReader::new(node.stderr.take().unwrap());
    let mut lines = Vec::new();
    while !lines
        .last()
        .is_some_and(|line: &String| line.contains("broker serves"))
    {
        let mut line = String::new();
        assert_ne!(log.read_line(&mut line).unwrap(), 0, "{lines:?}");
        lines.push(line);
    }
    drop(node.stdin.take());
    let mut rest = String::new();
    log.read_to_string(&mut rest).unwrap();
    assert!(node.wait().unwrap().success());
    lines.extend(rest.lines().map(str::to_owned));
    lines
}

#[test]
fn logs_outside_terminal_are_json() {
    for line in log(&[]) {
        let event: serde_json::Value =
            serde_json::from_str(&line).unwrap_or_else(|error| panic!("{error}: {line}"));
        assert!(
            event["level"].is_string()
                && event["message"].is_string()
                && event["timestamp"].is_string(),
            "{line}"
        );
    }
    let text = log(&["--log-format", "text"]);
    assert!(text.iter().all(|line| !line.starts_with('{')), "{text:?}");
    assert!(
        text.iter()
            .any(|line| line.contains(" INFO ") && line.contains("address=127.0.0.1:")),
        "{text:?}"
    );
    assert!(
        text.iter().all(|line| !line.contains("Actor{")),
        "the actor that wrote a line is no part of it: {text:?}"
    );
}

/// The variable is inherited by whatever a service starts; only the stream that it names is the journal.
#[test]
fn inherited_stream_is_not_journal() {
    let mut command = program();
    command
        .args(["--role", "edge", "--listen", "127.0.0.1:0", "--stop-at-eof"])
        .env("JOURNAL_STREAM", "1:1");
    let output = command.stdin(Stdio::null()).output().unwrap();
    assert!(
        output.stderr.starts_with(b"{"),
        "{}",
        String::from_utf8_lossy(&output.stderr)
    );
}

#[test]
fn completions_and_manuals_cover_commands() {
    for shell in ["bash", "zsh", "fish"] {
        let output = program().args(["completions", shell]).output().unwrap();
        let script = String::from_utf8(output.stdout).unwrap();
        assert!(
            output.status.success()
                && ["doctor", "log-format"]
                    .iter()
                    .all(|word| script.contains(word)),
            "{shell}"
        );
    }
    let directory = tempfile::tempdir().unwrap();
    let pages = directory.path().join("share/man1");
    assert!(program().arg("man").arg(&pages).status().unwrap().success());
    let page = |name: &str| std::fs::read_to_string(pages.join(name)).unwrap();
    assert!(
        page("ecod-node.1").contains("ecod\\-node\\-doctor(1)")
            && page("ecod-node-replay.1").contains("passes")
    );
    let refused = program().args(["man", "/proc/no/such"]).output().unwrap();
    assert!(
        refused.status.code() == Some(1)
            && String::from_utf8_lossy(&refused.stderr).contains("/proc/no/such")
    );
}

/// The unit starts the installed program with the installed configuration, and waits for its notification.
#[test]
fn the_unit_fits_the_program() {
    let packaging = Path::new(env!("CARGO_MANIFEST_DIR")).join("../packaging");
    let unit = std::fs::read_to_string(packaging.join("systemd/ecod-node.service")).unwrap();
    for line in [
        "Type=notify",
        "ExecStart=/usr/bin/ecod-node --config /etc/ecod/node.toml",
        "Restart=on-failure",
    ] {
        assert!(unit.lines().any(|other| other == line), "{line}");
    }
    let installed = packaging.join("debian/node.toml");
    output_of(
        program()
            .arg("--config")
            .arg(installed)
            .arg("--print-config"),
    );
}
