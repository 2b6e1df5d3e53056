//! Nodes as processes, each with a separate wall clock.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream, UdpSocket};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicI64, Ordering};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ecod::wire::Role;
use ecod_actors::messages::newest::ReceivedMap;
use ecod_actors::transport::pki::Authority;
use tempfile::TempDir;

use crate::clocks::feeder::Feeder;
use crate::clocks::record::{Entry, Record};

/// Maximum time for anything.
const PATIENCE: Duration = Duration::from_secs(60);

/// Setting of a wall clock.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Fake {
    /// The truth, without libfaketime.
    Off,
    /// So many seconds more than the truth.
    Seconds(i64),
    /// Some months after the beginning of 1970.
    Year1970,
}

impl Fake {
    pub(crate) fn seconds(self) -> i64 {
        match self {
            Self::Off => 0,
            Self::Seconds(seconds) => seconds,
            Self::Year1970 => 10_000_000 - i64::try_from(true_time().micros() / 1_000_000).unwrap(),
        }
    }
}

/// One cell on this machine; its nodes are killed when it is dropped, and their logs printed if the test fails.
pub(crate) struct Cell {
    directory: TempDir,
    gossip: SocketAddr,
    nodes: BTreeMap<String, Running>,
    feeder: Option<(Feeder, Arc<AtomicI64>)>,
    authority: Option<Authority>,
    /// Validity of certificates.
    valid: Duration,
    /// The maps that a node with the right clock took.
    record: Record,
    /// Readiness of each node at each query, with the true time.
    claims: BTreeMap<String, Vec<(Timestamp, bool)>>,
    brokers: BTreeMap<&'static str, SocketAddr>,
}

struct Running {
    child: Child,
    page: SocketAddr,
}

impl Cell {
    pub(crate) fn new() -> Self {
        let directory = tempfile::tempdir().unwrap();
        let frames = directory.path().join("frames");
        std::fs::create_dir(&frames).unwrap();
        std::fs::write(
            frames.join("0.ppm"),
            [b"P6 640 480 255\n".as_slice(), &[128; 640 * 480 * 3]].concat(),
        )
        .unwrap();
        let car = r#"[{"label":"car","confidence":0.9,"bounding_box":{"x_min":300,"y_min":200,"x_max":340,"y_max":240}}]"#;
        std::fs::write(directory.path().join("detections.jsonl"), car).unwrap();
        let brokers = ["edge", "euclid", "gauss"]
            .map(|name| (name, free_tcp()))
            .into();
        let gossip = UdpSocket::bind("127.0.0.1:0")
            .unwrap()
            .local_addr()
            .unwrap();
        Self {
            directory,
            gossip,
            nodes: BTreeMap::new(),
            feeder: None,
            authority: None,
            valid: Duration::from_secs(3600),
            record: Record::default(),
            claims: BTreeMap::new(),
            brokers,
        }
    }

    /// A cell whose nodes have certificates.
    pub(crate) fn with_certificates() -> Self {
        let mut cell = Self::new();
        let name = NodeName::from_static("clocks");
        cell.authority = Some(Authority::init(&cell.path("pki"), &name, true_time()).unwrap());
        cell
    }

    /// A cell whose certificates are short, and renewed by the edge, which has the CA.
    pub(crate) fn with_renewals(valid: Duration) -> Self {
        let mut cell = Self::new();
        let name = NodeName::from_static("clocks");
        cell.authority = Some(Authority::init(&cell.path("edge/pki"), &name, true_time()).unwrap());
        cell.valid = valid;
        cell
    }

    /// The node's certificate on disk.
    pub(crate) fn certificate(&self, name: &str) -> PathBuf {
        self.path(name).join("node.pem")
    }

    /// The maps that a node has accepted, dated in the cell's time.
    pub(crate) fn maps(&self, name: &str) -> Vec<ReceivedMap> {
        let log = std::fs::read_to_string(self.path(&format!("{name}.maps"))).unwrap_or_default();
        log.lines()
            .map_while(|line| serde_json::from_str(line).ok())
            .collect()
    }

    /// The log of a node.
    pub(crate) fn log(&self, name: &str) -> String {
        std::fs::read_to_string(self.path(&format!("{name}.log"))).unwrap_or_default()
    }

    fn path(&self, name: &str) -> PathBuf {
        self.directory.path().join(name)
    }

    /// Starts a node with this wall clock.
    pub(crate) fn start(&mut self, name: &str, clock: Fake) {
        let page = free_tcp();
        let config = self.config(name, page) + &self.certificates(name);
        std::fs::write(self.path(&format!("{name}.toml")), config).unwrap();
        let log = File::options()
            .create(true)
            .append(true)
            .open(self.path(&format!("{name}.log")))
            .unwrap();
        let mut command = Command::new(program());
        command
            .arg("--config")
            .arg(self.path(&format!("{name}.toml")));
        command
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(log);
        if clock != Fake::Off {
            self.set_file(name, clock);
            command
                .env("LD_PRELOAD", libfaketime())
                .env(
                    "FAKETIME_TIMESTAMP_FILE",
                    self.path(&format!("{name}.faketime")),
                )
                .env("FAKETIME_NO_CACHE", "1")
                .env("FAKETIME_DONT_FAKE_MONOTONIC", "1")
                .env("NO_FAKE_STAT", "1");
        }
        self.nodes.insert(
            name.to_owned(),
            Running {
                child: command.spawn().unwrap(),
                page,
            },
        );
    }

    fn certificates(&mut self, name: &str) -> String {
        let Some(authority) = &mut self.authority else {
            return String::new();
        };
        let node = NodeName::new(name).unwrap();
        let role = if name == "edge" {
            Role::Edge
        } else {
            Role::Auto
        };
        authority
            .issue(&node, role, self.valid, true_time())
            .unwrap();
        let (certificate, key) = authority.files_of(&node);
        // Each machine has its own files.
        let machine = self.directory.path().join(name);
        std::fs::create_dir_all(&machine).unwrap();
        let [ca, certificate, key] = [
            (authority.ca(), "ca.pem"),
            (certificate, "node.pem"),
            (key, "node.key"),
        ]
        .map(|(from, to)| {
            let to = machine.join(to);
            std::fs::copy(from, &to).unwrap();
            to
        });
        format!("[tls]\nca = {ca:?}\ncertificate = {certificate:?}\nkey = {key:?}\n")
    }

    fn config(&self, name: &str, page: SocketAddr) -> String {
        let directory = self.directory.path().display();
        let role = match name {
            "edge" => "edge",
            "noether" => "cav",
            _ => "auto",
        };
        let bind = if name == "gauss" {
            self.gossip.to_string()
        } else {
            "127.0.0.1:0".into()
        };
        let mut config = format!(
            "name = \"{name}\"\nrole = \"{role}\"\ncell = \"clocks\"\nmap_log = \"{directory}/{name}.maps\"\n\
             landmarks = [{{ id = \"spot\", x_m = 6.6, y_m = 0.0 }}]\n\
             membership = {{ bind = \"{bind}\", seeds = [\"{}\"], multicast = {{ enabled = false }} }}\n\
             dashboard = {{ listen = \"{page}\" }}\nelection = {{ stable_ms = 1000 }}\n",
            self.gossip
        );
        if let Some(broker) = self.brokers.get(name) {
            config += &format!("listen = \"{broker}\"\n");
        }
        if name != "edge" {
            config += &format!(
                "[camera]\nsource = {{ kind = \"images\", path = \"{directory}/frames\", fps = 10.0, looping = true }}\n\
                 detector = {{ kind = \"recorded\", path = \"{directory}/detections.jsonl\", looping = true }}\n\
                 projection = {{ ranging = \"box_height\", sizes.default = {{ width_m = 0.5, height_m = 0.5 }} }}\n"
            );
        }
        config
    }

    /// Starts the client without a node.
    pub(crate) fn feed(&mut self, clock: Fake) {
        let offset = Arc::new(AtomicI64::new(clock.seconds()));
        let feeder = Feeder::start(
            self.brokers.values().copied().collect(),
            Arc::clone(&offset),
        );
        self.feeder = Some((feeder, offset));
    }

    /// Lets the clocks of all nodes step together.
    pub(crate) fn set_all(&self, clock: Fake) {
        for name in self.nodes.keys() {
            self.set_file(name, clock);
        }
    }

    /// Lets a clock step.
    pub(crate) fn set(&mut self, name: &str, clock: Fake) {
        if name == "feeder" {
            self.feeder
                .as_ref()
                .unwrap()
                .1
                .store(clock.seconds(), Ordering::Relaxed);
        } else {
            self.set_file(name, clock);
        }
    }

    fn set_file(&self, name: &str, clock: Fake) {
        let file = self.path(&format!("{name}.faketime"));
        let new = self.path(&format!("{name}.faketime.new"));
        std::fs::write(&new, format!("{:+}\n", clock.seconds())).unwrap();
        std::fs::rename(new, file).unwrap();
    }

    /// The true time.
    pub(crate) fn now(&self) -> Timestamp {
        true_time()
    }

    /// The maps that a node with the right clock took.
    pub(crate) fn record(&mut self) -> &Record {
        let log = self.path("gauss.maps");
        self.record.read(&log);
        &self.record
    }

    pub(crate) fn until(&mut self, what: &str, holds: impl Fn(&Record) -> bool) {
        let deadline = Instant::now() + PATIENCE;
        while !holds(self.record()) {
            assert!(
                Instant::now() <= deadline,
                "not within {PATIENCE:?}: {what}"
            );
            self.look();
        }
    }

    /// Records new maps and the readiness of the nodes, and waits a moment. A map counts from its recording on, so
    /// every waiting test calls this function.
    fn look(&mut self) {
        self.record();
        for (name, node) in &mut self.nodes {
            assert_eq!(node.child.try_wait().unwrap(), None, "{name} ended");
            let claim = (true_time(), readiness(node.page).0);
            self.claims.entry(name.clone()).or_default().push(claim);
        }
        std::thread::sleep(Duration::from_millis(50));
    }

    /// Waits until a node is not ready for a reason that contains this.
    pub(crate) fn until_unready(&mut self, name: &str, reason: &str) {
        let deadline = Instant::now() + PATIENCE;
        while readiness(self.nodes[name].page).1.find(reason).is_none() {
            assert!(
                Instant::now() <= deadline,
                "not within {PATIENCE:?}: {reason}, but {}",
                self.readiness(name)
            );
            self.look();
        }
        assert!(
            !readiness(self.nodes[name].page).0,
            "{name} is ready and reports {reason}"
        );
    }

    /// A node's readiness as it reports it; `None` while there is no page.
    pub(crate) fn readiness(&self, name: &str) -> String {
        readiness(self.nodes[name].page).1
    }

    /// Time at which a node first reports that it is ready; others may use it some moments before.
    pub(crate) fn first_ready(&mut self, name: &str, since: Timestamp) -> Timestamp {
        let deadline = Instant::now() + PATIENCE;
        loop {
            let ready = |(at, is_ready): &&(Timestamp, bool)| *is_ready && *at >= since;
            if let Some((at, _)) = self.claims[name].iter().find(ready) {
                return *at;
            }
            assert!(
                Instant::now() <= deadline,
                "{name} not ready within {PATIENCE:?}: {}",
                self.readiness(name)
            );
            self.look();
        }
    }

    /// Longest time for which a node reported that it is ready without a useful map.
    pub(crate) fn longest_idle(
        &self,
        name: &str,
        since: Timestamp,
        is_useful: impl Fn(&Entry<'_>) -> bool,
    ) -> Duration {
        let useful = self.record.times(since, is_useful);
        let mut longest = Duration::ZERO;
        let mut idle_since = None;
        for (at, is_ready) in self
            .claims
            .get(name)
            .into_iter()
            .flatten()
            .filter(|(at, _)| *at >= since)
        {
            let last_useful = useful[..useful.partition_point(|time| time <= at)]
                .last()
                .copied();
            idle_since = is_ready.then(|| {
                idle_since
                    .unwrap_or(*at)
                    .max(last_useful.unwrap_or_default())
            });
            longest =
                longest.max(idle_since.map_or(Duration::ZERO, |idle_since| at.since(idle_since)));
        }
        longest
    }
}

/// Readiness of a node and its reason; `None` while there is no page.
fn readiness(page: SocketAddr) -> (bool, String) {
    let Ok(mut stream) = TcpStream::connect(page) else {
        return (false, String::new());
    };
    write!(
        stream,
        "GET /readyz HTTP/1.1\r\nHost: {page}\r\nConnection: close\r\n\r\n"
    )
    .unwrap();
    let mut answer = String::new();
    stream.read_to_string(&mut answer).unwrap();
    (
        answer.starts_with("HTTP/1.1 200"),
        answer
            .split("\r\n\r\n")
            .nth(1)
            .unwrap_or_default()
            .trim()
            .to_owned(),
    )
}

impl Drop for Cell {
    fn drop(&mut self) {
        for Running { child, .. } in self.nodes.values_mut() {
            child.kill().ok();
            child.wait().ok();
        }
        if std::thread::panicking() {
            for name in self.nodes.keys() {
                eprintln!(
                    "{name}:\n{}",
                    std::fs::read_to_string(self.path(&format!("{name}.log"))).unwrap_or_default()
                );
            }
        }
    }
}

/// Unix time by this machine's clock, which is not faked here.
pub(crate) fn true_time() -> Timestamp {
    Timestamp::default() + SystemTime::now().duration_since(UNIX_EPOCH).unwrap()
}

/// The program under test; `CLOCKS_PROGRAM` names another one to compare with.
fn program() -> PathBuf {
    std::env::var_os("CLOCKS_PROGRAM")
        .map_or_else(|| env!("CARGO_BIN_EXE_ecod-node").into(), PathBuf::from)
}

/// The library that fakes wall clocks; Debian's package `libfaketime`, which `make setup` of the tests installs.
fn libfaketime() -> PathBuf {
    let machine = std::env::consts::ARCH;
    let file = PathBuf::from(format!(
        "/usr/lib/{machine}-linux-gnu/faketime/libfaketimeMT.so.1"
    ));
    assert!(
        Path::is_file(&file),
        "{} is missing: apt install libfaketime",
        file.display()
    );
    file
}

fn free_tcp() -> SocketAddr {
    TcpListener::bind("127.0.0.1:0")
        .unwrap()
        .local_addr()
        .unwrap()
}
