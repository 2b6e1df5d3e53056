//! The tests of `failover` with separate processes.

use std::fs::File;
use std::net::SocketAddr;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use ecod::model::names::NodeName;
use ecod::wire::Role;
use ecod_actors::platform::clock;
use ecod_actors::transport::pki::{Authority, TlsConfig};
use ecod_testkit::{PATIENCE, free_gossip_address, greet};
use tempfile::TempDir;

use crate::failover::cell::config;
use crate::failover::record::Record;

/// A node as a process; killed when dropped.
struct Process(Child);

impl Drop for Process {
    fn drop(&mut self) {
        self.0.kill().unwrap();
        self.0.wait().unwrap();
    }
}

/// The nodes' logs, printed when a test fails.
struct Logs<'a>(&'a Path);

impl Drop for Logs<'_> {
    fn drop(&mut self) {
        if std::thread::panicking() {
            for name in ["edge", "euclid", "gauss"] {
                let log = std::fs::read_to_string(self.0.join(format!("{name}.log")));
                eprintln!("{name}:\n{}", log.unwrap_or_default());
            }
        }
    }
}

fn start(name: &str, role: Role, seed: SocketAddr, directory: &Path) -> Process {
    let log = File::options()
        .create(true)
        .append(true)
        .open(directory.join(format!("{name}.log")))
        .unwrap();
    Process(
        command(name, role, seed, directory)
            .stdout(Stdio::null())
            .stderr(log)
            .spawn()
            .unwrap(),
    )
}

/// The program as a node of this name, whose files are in the directory.
fn command(name: &str, role: Role, seed: SocketAddr, directory: &Path) -> Command {
    let file = directory.join(format!("{name}.toml"));
    let mut config = config(name, role, directory);
    greet(&mut config, seed, role == Role::Edge);
    config.tls = certificates(name, role, directory);
    std::fs::write(&file, toml::to_string(&config).unwrap()).unwrap();
    let mut command = Command::new(env!("CARGO_BIN_EXE_ecod-node"));
    command.arg("--config").arg(file).stdin(Stdio::null());
    command
}

/// A node's certificates, if the cell has a CA in its directory.
fn certificates(name: &str, role: Role, directory: &Path) -> Option<TlsConfig> {
    let mut authority = Authority::open(&directory.join(CA)).ok()?;
    let node = NodeName::new(name).unwrap();
    authority
        .issue(&node, role, Duration::from_secs(3600), clock::now())
        .unwrap();
    Some(authority.tls_of(&node))
}

/// Where a cell that has certificates keeps its CA.
const CA: &str = "pki";

/// SIGKILL for the edge's process: its vehicles go on at once, and hand back when it has started again.
#[test]
fn vehicles_survive_edge_kill() {
    let directory = tempfile::tempdir().unwrap();
    edge_is_killed(&directory);
}

/// With TLS, a broken connection and a refused port are detected as quickly as without TLS.
#[test]
fn certified_vehicles_survive_edge_kill() {
    let directory = tempfile::tempdir().unwrap();
    Authority::init(
        &directory.path().join(CA),
        &NodeName::from_static("cell"),
        clock::now(),
    )
    .unwrap();
    edge_is_killed(&directory);
}

/// A second process with the name of a running vehicle does not join, logs the reason, and exits with a separate code.
/// Its start and its end do not affect the leadership or delay a map.
#[test]
fn second_process_of_name_exits() {
    let directory = tempfile::tempdir().unwrap();
    let _logs = Logs(directory.path());
    let seed = free_gossip_address();
    let record = || Record::read(&directory.path().join("euclid.maps"));
    let until = |what: &str, holds: &dyn Fn() -> bool| {
        let deadline = Instant::now() + PATIENCE;
        while !holds() {
            assert!(
                Instant::now() <= deadline,
                "not within {PATIENCE:?}: {what}"
            );
            std::thread::sleep(Duration::from_millis(20));
        }
    };
    let _edge = start("edge", Role::Edge, seed, directory.path());
    let _euclid = start("euclid", Role::Auto, seed, directory.path());
    until("the edge serves", &|| record().source() == Some("edge"));
    let before = record().last_round();

    for role in [Role::Cav, Role::Auto] {
        let elsewhere = tempfile::tempdir().unwrap();
        let mut second = command("euclid", role, seed, elsewhere.path());
        // It ends by itself, or the test does not.
        let ended = second.output().unwrap();
        let said = String::from_utf8_lossy(&ended.stderr);
        assert_eq!(ended.status.code(), Some(4), "{said}");
        let reason =
            "another running node of the cell cell is called euclid: give one of them another name";
        assert!(said.contains(reason), "{said}");
        // It may lead alone until it has received long enough that its name is taken.
        assert_ne!(
            Record::read(&elsewhere.path().join("euclid.maps")).source(),
            Some("edge"),
            "it took part"
        );
    }
    let seen = record().last_round();
    until("maps go on", &|| record().last_round() > seen + 5);
    let record = record();
    record.misses_and_repeats_none_after(before, "edge");
    let epochs = record.epochs_from(before, "edge");
    assert_eq!(epochs.len(), 1, "{epochs:?}");
    eprintln!(
        "longest gap with a second node of the name {:?}",
        record.longest_gap()
    );
    assert!(
        record.longest_gap() < Duration::from_secs(1),
        "{:?}",
        record.longest_gap()
    );
}

fn edge_is_killed(directory: &TempDir) {
    let _logs = Logs(directory.path());
    let seed = free_gossip_address();
    let vehicles = ["euclid", "gauss"];
    let record = |name: &str| Record::read(&directory.path().join(format!("{name}.maps")));
    let until = |what: &str, holds: &dyn Fn(&Record) -> bool| {
        let deadline = Instant::now() + PATIENCE;
        while !vehicles.iter().all(|name| holds(&record(name))) {
            assert!(
                Instant::now() <= deadline,
                "not within {PATIENCE:?}: {what}"
            );
            std::thread::sleep(Duration::from_millis(20));
        }
    };

    let edge = start("edge", Role::Edge, seed, directory.path());
    let _vehicles = vehicles.map(|name| start(name, Role::Auto, seed, directory.path()));
    until("the edge serves all", &|record| {
        !record.is_empty() && record.source() == Some("edge")
    });
    // Time until the node has the name of the standby and a connection to it.
    std::thread::sleep(Duration::from_secs(2));
    drop(edge);
    until("a vehicle serves all", &|record| {
        record.source() != Some("edge")
    });
    for name in vehicles {
        let record = record(name);
        record.never_goes_back();
        eprintln!(
            "{name}: longest gap when the process was killed {:?}",
            record.longest_gap()
        );
        assert!(record.longest_gap() < Duration::from_secs(5));
    }

    let before = record("gauss").last_round();
    let _edge = start("edge", Role::Edge, seed, directory.path());
    until("the edge leads again", &|record| {
        record.source() == Some("edge")
    });
    std::thread::sleep(Duration::from_millis(500));
    for name in vehicles {
        record(name).never_goes_back();
        record(name).misses_and_repeats_none_after(before, "edge");
    }
}
