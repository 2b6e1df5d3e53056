//! Commands about the node of this machine, without flags.

use std::fs;
use std::io::{BufRead, BufReader};
use std::net::{SocketAddr, TcpListener, UdpSocket};
use std::path::Path;
use std::process::{Child, Command, Output, Stdio};
use std::time::{Duration, Instant};

use ecod_testkit::PATIENCE;
use tempfile::TempDir;

use crate::ecod_node;

fn ecod_node_in(directory: &Path) -> Command {
    let mut command = ecod_node();
    command.current_dir(directory);
    command
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

/// A node as a process; killed when dropped.
struct Process(Child);

impl Drop for Process {
    fn drop(&mut self) {
        // It may have ended already.
        let _ = self.0.kill();
        self.0.wait().unwrap();
    }
}

/// A directory in which `ecod/node.toml` describes a node with separate addresses, and the address of its page.
fn machine(role: &str) -> (TempDir, SocketAddr) {
    let directory = tempfile::tempdir().unwrap();
    let tcp = || TcpListener::bind("127.0.0.1:0").unwrap();
    let page = tcp();
    let broker = tcp();
    let gossip = UdpSocket::bind("127.0.0.1:0").unwrap();
    let page_address = page.local_addr().unwrap();
    let toml = format!(
        "name = \"ada\"\ncell = \"daily\"\nrole = \"{role}\"\nlisten = \"{}\"\nstate_dir = \"state\"\n\
         [dashboard]\nlisten = \"{page_address}\"\n\
         [membership]\nbind = \"{}\"\nmulticast = {{ enabled = false }}\n",
        broker.local_addr().unwrap(),
        gossip.local_addr().unwrap(),
    );
    fs::create_dir(directory.path().join("ecod")).unwrap();
    fs::write(directory.path().join("ecod/node.toml"), toml).unwrap();
    (directory, page_address)
}

/// Starts the node of a machine and waits for its page.
fn start(directory: &Path) -> Process {
    let mut node = ecod_node_in(directory);
    node.args(["--config", "ecod/node.toml"])
        .stderr(Stdio::piped());
    let mut node = node.spawn().unwrap();
    let mut log = BufReader::new(node.stderr.take().unwrap()).lines();
    assert!(log.any(|line| line.unwrap().contains("dashboard serves")));
    // The node must not wait for a reader of its log.
    std::thread::spawn(move || log.count());
    Process(node)
}

/// True if root would use the files of an installed node instead of the files of the test.
fn has_installed_node() -> bool {
    Path::new("/etc/ecod").exists()
}

fn status(directory: &Path, arguments: &[&str]) -> Output {
    let mut status = ecod_node_in(directory);
    status.arg("status").args(arguments).output().unwrap()
}

/// Repeats `status` until it ends with this code. The result is its standard output.
fn until_status(directory: &Path, arguments: &[&str], code: i32) -> String {
    let started = Instant::now();
    loop {
        let output = status(directory, arguments);
        if output.status.code() == Some(code) {
            return text(&output.stdout);
        }
        assert!(
            started.elapsed() < PATIENCE,
            "{code}: {}",
            text(&output.stderr)
        );
        std::thread::sleep(Duration::from_millis(100));
    }
}

#[test]
fn status_exit_code_shows_readiness() {
    if has_installed_node() {
        return;
    }
    let (directory, page) = machine("edge");
    let file = directory.path().join("ecod/node.toml");
    let toml = fs::read_to_string(&file).unwrap();
    let listen = toml
        .lines()
        .find(|line| line.starts_with("listen"))
        .unwrap();
    fs::write(&file, toml.replacen(listen, "listen = \"127.0.0.1:0\"", 1)).unwrap();
    let absent = status(directory.path(), &[]);
    let said = text(&absent.stderr);
    assert_eq!(absent.status.code(), Some(6), "{said}");
    assert!(
        said.contains("using ecod/node.toml") && said.contains(&format!("no node at {page}")),
        "{said}"
    );
    let node = start(directory.path());
    let shown = until_status(directory.path(), &[], 0);
    assert!(
        shown.starts_with("ada (edge) in cell daily: ready, leading\nleader: ada, term "),
        "{shown}"
    );
    let json = until_status(directory.path(), &["--json"], 0);
    let json: serde_json::Value = serde_json::from_str(&json).unwrap();
    assert!(
        json["readiness"]["ready"] == true
            && json["leadership"]["leader"] == "ada"
            && json["nodes"][0]["alive"] == true,
        "{json}"
    );
    let shown = ecod_node_in(directory.path())
        .args(["cell", "show"])
        .output()
        .unwrap();
    assert!(
        text(&shown.stdout).contains("# cell daily: no description"),
        "at the port that the node has taken: {}",
        text(&shown.stderr)
    );
    let mut watching = ecod_node_in(directory.path());
    let watching = watching
        .args(["status", "--watch", "--json"])
        .stdout(Stdio::piped());
    let mut watching = Process(watching.spawn().unwrap());
    let mut states = BufReader::new(watching.0.stdout.take().unwrap()).lines();
    assert!(states.next().unwrap().unwrap().contains("\"ready\":true"));
    drop(node);
    assert!(states.next().unwrap().unwrap().contains("no node at"));
}

#[test]
fn leaderless_status_has_distinct_code() {
    if has_installed_node() {
        return;
    }
    let (directory, _) = machine("cav");
    let _node = start(directory.path());
    let shown = until_status(directory.path(), &[], 5);
    assert!(shown.contains("not ready, no leader known"), "{shown}");
}

/// A running node is no reason for `doctor` to complain about the node's own ports.
#[test]
fn doctor_recognises_running_node() {
    if has_installed_node() {
        return;
    }
    let (directory, page) = machine("edge");
    let _node = start(directory.path());
    until_status(directory.path(), &[], 0);
    let output = ecod_node_in(directory.path())
        .arg("doctor")
        .output()
        .unwrap();
    let shown = text(&output.stdout);
    let said = text(&output.stderr);
    assert!(output.status.success(), "{shown}{said}");
    assert!(said.contains("using ecod/node.toml"), "{said}");
    assert!(shown.contains("ada runs: leading"), "{shown}");
    assert!(
        shown.contains(&format!("{page} is in use while the node runs")),
        "{shown}"
    );
    assert_eq!(
        shown.matches("in use while the node runs").count(),
        3,
        "{shown}"
    );
}

#[test]
fn commands_use_local_node_files() {
    if has_installed_node() {
        return;
    }
    let (directory, _) = machine("edge");
    let run = |arguments: &[&str]| {
        let output = ecod_node_in(directory.path())
            .args(arguments)
            .output()
            .unwrap();
        let said = text(&output.stderr);
        assert!(said.contains("using ecod/"), "{arguments:?}: {said}");
        output
    };
    let reset = run(&["reset", "--term"]);
    assert!(text(&reset.stdout).contains("daily.ada.term.json"));
    let shown = run(&["cell", "show"]);
    assert!(text(&shown.stderr).contains("no node at 127.0.0.1:"));
    let made = ecod_node_in(directory.path())
        .args(["pki", "init", "--cell", "daily", "--dir", "ecod/pki"])
        .output()
        .unwrap();
    assert!(made.status.success(), "{}", text(&made.stderr));
    let issued = run(&["pki", "issue", "viewer"]);
    assert!(text(&issued.stdout).contains("ecod/pki/nodes/viewer.pem"));
    let elsewhere = tempfile::tempdir().unwrap();
    let without = ecod_node_in(elsewhere.path())
        .args(["reset", "--term"])
        .output()
        .unwrap();
    assert_eq!(without.status.code(), Some(2));
    assert!(text(&without.stderr).contains("--config FILE"));
}

/// At a terminal the program prints its state, the address of the page and the next step, and stops the node without
/// warnings.
#[test]
fn log_begins_with_page() {
    let (directory, page) = machine("edge");
    let mut node = ecod_node_in(directory.path());
    node.args(["--config", "ecod/node.toml", "--log-format", "text"])
        .stderr(Stdio::piped());
    let mut node = Process(node.spawn().unwrap());
    let mut log = BufReader::new(node.0.stderr.take().unwrap()).lines();
    let mut shown = String::new();
    for part in [
        "ada (edge) of cell daily runs, version ",
        &format!("page: http://{page}/"),
        "next: `ecod-node status` shows the cell; another node joins by `ecod-node --name NAME --cell daily --seed 127.0.0.1:",
    ] {
        let line = log
            .by_ref()
            .map(Result::unwrap)
            .inspect(|line| shown += &format!("{line}\n"));
        assert!(
            line.into_iter().any(|line| line.contains(part)),
            "{part}\n{shown}"
        );
    }
    until_status_of(page, 0);
    let interrupted = Command::new("kill")
        .args(["-INT", &node.0.id().to_string()])
        .status();
    assert!(interrupted.unwrap().success() && node.0.wait().unwrap().success());
    shown.extend(log.map(|line| line.unwrap() + "\n"));
    assert!(!shown.contains(" WARN "), "{shown}");
    for debug in ["Some(", "None", "Ok(", "Err("] {
        assert!(!shown.contains(debug), "{debug} in {shown}");
    }
}

/// Waits until `status` of the node with this page ends with this code.
fn until_status_of(page: SocketAddr, code: i32) {
    let elsewhere = tempfile::tempdir().unwrap();
    until_status(elsewhere.path(), &["--page", &page.to_string()], code);
}

/// The usual port of the broker may belong to another program; a configured one must not.
#[test]
fn busy_default_port_is_replaced() {
    // The port is in use, by this test or by another program.
    let _taken = TcpListener::bind("127.0.0.1:1883");
    let (directory, _) = machine("edge");
    let file = directory.path().join("ecod/node.toml");
    let toml = fs::read_to_string(&file).unwrap();
    let without: String = toml
        .lines()
        .filter(|line| !line.starts_with("listen = ") || line.contains("dashboard"))
        .map(|line| format!("{line}\n"))
        .collect();
    fs::write(
        &file,
        without.replace("[dashboard]\n", "[dashboard]\nenabled = false\n"),
    )
    .unwrap();
    let mut node = ecod_node_in(directory.path());
    node.args(["--config", "ecod/node.toml", "--log-format", "json"])
        .stderr(Stdio::piped());
    let mut node = Process(node.spawn().unwrap());
    let mut log = BufReader::new(node.0.stderr.take().unwrap())
        .lines()
        .map(Result::unwrap);
    let replaced = log
        .find(|line| line.contains("the broker takes a free one"))
        .unwrap();
    assert!(
        replaced.contains("127.0.0.1:1883") && replaced.contains("`listen`"),
        "{replaced}"
    );
    let serves = log.find(|line| line.contains("broker serves")).unwrap();
    assert!(!serves.contains(":1883"), "{serves}");
    let taken = TcpListener::bind("127.0.0.1:0").unwrap();
    let refused = ecod_node_in(directory.path())
        .args(["--role", "edge", "--no-dashboard", "--listen"])
        .arg(taken.local_addr().unwrap().to_string())
        .env("RUST_LOG", "off")
        .output()
        .unwrap();
    let said = text(&refused.stderr);
    assert_eq!(refused.status.code(), Some(1), "{said}");
    assert!(
        said.contains("key `listen`") && said.contains("stop the program that uses this one"),
        "{said}"
    );
}
