//! A cell of real processes with certificates: an edge, a candidate and a vehicle, the latter two with cameras.

use std::collections::BTreeSet;
use std::fs::{self, File};
use std::net::{Ipv4Addr, SocketAddr};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use anyhow::{Context, ensure};
use ecod::leadership::Rights;
use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ecod::wire::Role;
use ecod_actors::platform::clock;
use ecod_actors::transport::pki::{Authority, Credentials, TlsConfig};
use rustls::ClientConfig;
use serde::Deserialize;
use tempfile::TempDir;

use crate::attacks::key_holder;
use crate::attacks::row::{Means, Outcome};
use crate::network::{self, Bridged};
use crate::ports::Ports;
use crate::process::{Process, command};

/// The program under test, unless the environment names another.
const PROGRAM: &str = env!("CARGO_BIN_EXE_ecod-node");

/// The cell's name and key.
pub(crate) const CELL: &str = "lot";
const KEY: &str = "5e5e5e5e5e5e5e5e5e5e5e5e5e5e5e5e5e5e5e5e5e5e5e5e5e5e5e5e5e5e5e5e";

/// The nodes: the edge, a candidate, and the vehicle whose map log is read.
pub(crate) const NODES: [(&str, Role); 3] = [
    ("edge", Role::Edge),
    ("v01", Role::Auto),
    ("v02", Role::Cav),
];

/// The vehicle, and the node that may lead, whose certificates the attackers hold. Some rows take more vehicles than follow
/// the leader honestly.
pub(crate) const VEHICLE: &str = "gauss";
pub(crate) const VEHICLES: [&str; 3] = [VEHICLE, "noether", "hopper"];
pub(crate) const CANDIDATE: &str = "turing";

/// The node that leads, and the vehicle whose map log is read.
pub(crate) const LEADER: &str = NODES[0].0;
pub(crate) const OBSERVED: &str = NODES[2].0;

/// Time for all processes to start and agree, and for how long they must have agreed.
const START_TIMEOUT: Duration = Duration::from_secs(60);
const SETTLED: Duration = Duration::from_millis(1500);

/// One object ahead of each vehicle in every frame, and the size of the frames.
const DETECTIONS: &str = r#"[{"label":"car","confidence":0.9,"bounding_box":{"x_min":75,"y_min":50,"x_max":85,"y_max":60}}]
"#;
const FRAME_SIZE: (usize, usize) = (160, 120);

/// Kind of the object, and its place.
const LABEL: &str = "car";
pub(crate) const LANDMARK: &str = "\n[[landmarks]]\nid = \"ahead\"\nx_m = 6.6\ny_m = 0.0\n";

/// Where attackers are on loopback.
const ELSEWHERE: Ipv4Addr = Ipv4Addr::new(127, 66, 6, 6);

/// Time between two maps.
pub(crate) const ROUND: Duration = Duration::from_millis(100);

/// Running nodes with their files; all end with it.
pub(crate) struct Cell {
    nodes: Vec<Node>,
    /// The nodes' network namespaces; without any, all are on loopback.
    network: Option<Bridged>,
    vehicles: [TlsConfig; VEHICLES.len()],
    candidate: TlsConfig,
    foreign: TlsConfig,
    directory: TempDir,
}

struct Node {
    name: &'static str,
    broker: SocketAddr,
    gossip: SocketAddr,
    process: Process,
}

/// A broker that is attacked.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Victim {
    Leader,
    Standby,
}

impl Victim {
    pub(crate) fn name(self) -> &'static str {
        if self == Self::Leader {
            "leader"
        } else {
            "standby"
        }
    }
}

/// Data and secrets of an attacker. A row uses the ones that its means allow.
#[derive(Clone)]
pub(crate) struct Target {
    /// Number of its deeds so far, in the row's unit.
    pub(crate) deeds: Arc<AtomicU64>,
    /// The attacked broker, and the broker of the candidate that does not lead.
    pub(crate) broker: SocketAddr,
    pub(crate) standby: SocketAddr,
    pub(crate) leader_process: u32,
    /// Where the nodes gossip.
    pub(crate) gossip: Vec<SocketAddr>,
    /// The attacker's own address, another than the cell's.
    pub(crate) from: Ipv4Addr,
    pub(crate) key: &'static str,
    /// TLS with the certificate of a vehicle, [`VEHICLE`].
    pub(crate) vehicle: Arc<ClientConfig>,
    /// TLS with the certificate of a node that may lead, [`CANDIDATE`].
    pub(crate) candidate: Arc<ClientConfig>,
    /// The same certificate for a membership.
    pub(crate) credentials: Arc<Credentials>,
    /// Certificates of [`VEHICLES`] for memberships.
    pub(crate) vehicles: Vec<Arc<Credentials>>,
    /// A certificate of another CA, for [`key_holder::NAME`](crate::attacks::key_holder::NAME).
    pub(crate) foreign: Arc<Credentials>,
    /// Directory of the CA's files, `pki`, and of each node's files, for the defender of the cell.
    pub(crate) home: PathBuf,
}

impl Target {
    pub(crate) fn did(&self, deeds: usize) {
        self.deeds.fetch_add(deeds as u64, Ordering::Relaxed);
    }

    /// Number of maps accepted since a time that have an object of this vehicle.
    pub(crate) fn maps_with(&self, vehicle: &str, since: Timestamp) -> anyhow::Result<usize> {
        let has_object = |line: &Line| {
            let objects = line.map.objects.iter();
            objects
                .flat_map(|object| &object.contributors)
                .any(|name| name == vehicle)
        };
        Ok(maps_in(&self.home, since)?
            .iter()
            .filter(|line| has_object(line))
            .count())
    }
}

impl Cell {
    /// Issues certificates, writes configurations, and starts all processes.
    pub(crate) fn start() -> anyhow::Result<Self> {
        let directory = tempfile::Builder::new().prefix("ecod-attack-").tempdir()?;
        let home = directory.path();
        fs::create_dir(home.join("frames"))?;
        fs::write(home.join("frames/0.ppm"), grey_frame())?;
        fs::write(home.join("detections.jsonl"), DETECTIONS)?;
        let mut authority =
            Authority::init(&home.join("pki"), &NodeName::new(CELL)?, clock::now())?;
        let [gauss, noether, hopper] = VEHICLES.map(|name| issue(&mut authority, name, Role::Cav));
        let vehicles = [gauss?, noether?, hopper?];
        let candidate = issue(&mut authority, CANDIDATE, Role::Auto)?;
        let mut elsewhere =
            Authority::init(&home.join("elsewhere"), &NodeName::new(CELL)?, clock::now())?;
        let foreign = issue(&mut elsewhere, key_holder::NAME, Role::Edge)?;
        let foreign = TlsConfig {
            ca: authority.ca(),
            revocation_list: None,
            ..foreign
        };
        let network = network::has_namespaces()
            .then(|| Bridged::new(NODES.len()))
            .transpose()?;
        let mut ports = Ports::new();
        let mut addresses = Vec::new();
        for index in 0..NODES.len() {
            let ip = network
                .as_ref()
                .map_or(Ipv4Addr::LOCALHOST, |_| network::address(index));
            let [broker, gossip] =
                [ports.free()?, ports.free()?].map(|port| SocketAddr::from((ip, port)));
            addresses.push((broker, gossip));
        }
        let seeds: Vec<SocketAddr> = addresses.iter().map(|(_, gossip)| *gossip).collect();
        let mut nodes = Vec::new();
        for (index, ((name, role), (broker, gossip))) in
            NODES.into_iter().zip(addresses).enumerate()
        {
            let rights = Rights {
                may_describe: name == LEADER,
                ..Rights::from(role)
            };
            let mut tls = issue(&mut authority, name, rights)?;
            let directory = home.join(name);
            fs::create_dir(&directory)?;
            if name == LEADER {
                // Its owner does not put a newer list there.
                let own_list = directory.join("revoked.pem");
                fs::copy(authority.revocation_list(), &own_list)?;
                tls.revocation_list = Some(own_list);
            }
            let text = configuration(name, role, broker, gossip, &seeds, &tls, home);
            fs::write(directory.join("node.toml"), text)?;
            let namespace = network.as_ref().map(|_| network::namespace(index));
            let mut command = command(&program(), namespace.as_deref());
            command.env_clear().envs(
                std::env::vars_os().filter(|(key, _)| !key.to_string_lossy().starts_with("ECOD_")),
            );
            command.args([
                "--log-format",
                "text",
                "--config",
                "node.toml",
                "--map-log",
                "maps.jsonl",
            ]);
            command
                .stderr(File::create(directory.join("node.log"))?)
                .current_dir(&directory);
            nodes.push(Node {
                name,
                broker,
                gossip,
                process: Process::start(&mut command)?,
            });
        }
        Ok(Self {
            nodes,
            network,
            vehicles,
            candidate,
            foreign,
            directory,
        })
    }

    /// Waits until maps hold the reports of all honest vehicles, and have done so for a while.
    pub(crate) async fn settle(&mut self) -> anyhow::Result<()> {
        let started = Instant::now();
        loop {
            tokio::time::sleep(Duration::from_millis(250)).await;
            let ended = self.ended()?;
            ensure!(
                ended.is_empty(),
                "ended at once: {}, files in {:?}",
                ended.join(", "),
                self.keep()
            );
            let since = Timestamp(clock::now().micros() - SETTLED.as_micros() as u64);
            let maps = self.maps(since)?;
            let is_whole = |line: &Line| line.map.reporters().is_superset(&honest());
            if maps.len() >= 12 && maps.iter().all(is_whole) {
                return Ok(());
            }
            if started.elapsed() > START_TIMEOUT {
                let directory = self.keep();
                anyhow::bail!("the cell does not settle, files in {directory:?}");
            }
        }
    }

    /// Knowledge and secrets for an attacker.
    pub(crate) fn target(&self, victim: Victim) -> anyhow::Result<Target> {
        let load =
            |files, name| Credentials::load(files, &NodeName::from_static(name)).map(Arc::new);
        let client =
            |files, name| load(files, name).map(|loaded| Arc::clone(&loaded.current().client));
        Ok(Target {
            deeds: Arc::default(),
            broker: self.nodes[usize::from(victim == Victim::Standby)].broker,
            standby: self.nodes[1].broker,
            leader_process: self.nodes[0].process.id(),
            gossip: self.nodes.iter().map(|node| node.gossip).collect(),
            from: self
                .network
                .as_ref()
                .map_or(ELSEWHERE, |_| network::HARNESS),
            key: KEY,
            vehicle: client(&self.vehicles[0], VEHICLE)?,
            candidate: client(&self.candidate, CANDIDATE)?,
            credentials: load(&self.candidate, CANDIDATE)?,
            vehicles: self
                .vehicles
                .iter()
                .zip(VEHICLES)
                .map(|(files, name)| load(files, name))
                .collect::<Result<_, _>>()?,
            foreign: load(&self.foreign, key_holder::NAME)?,
            home: self.directory.path().to_owned(),
        })
    }

    /// The beginning of a measurement.
    pub(crate) fn mark(&self) -> anyhow::Result<Timestamp> {
        // Writing 5 resets the peak of memory to the present use.
        for node in &self.nodes[..2] {
            fs::write(format!("/proc/{}/clear_refs", node.process.id()), "5")
                .context("peak memory of a broker")?;
        }
        Ok(clock::now())
    }

    /// Measurements since a mark.
    pub(crate) fn outcome(&mut self, from: Timestamp, means: Means) -> anyhow::Result<Outcome> {
        // Reading a log of large maps takes seconds, which are no gap.
        let until = clock::now();
        let ended = self.ended()?;
        let maps = self.maps(from)?;
        Ok(Outcome {
            maps: maps.len(),
            expected: (until.since(from).as_millis() / ROUND.as_millis()) as usize,
            honest: maps
                .iter()
                .filter(|line| line.map.reporters().is_superset(&honest()))
                .count(),
            longest_gap_ms: longest_gap_ms(&maps, from, until),
            is_replaced: maps
                .last()
                .is_some_and(|line| line.map.aggregator != LEADER),
            rss_mb: if ended.is_empty() {
                self.peak_memory_mb()?
            } else {
                0
            },
            accepted_falsehoods: maps.iter().filter(|line| !line.map.is_true()).count()
                + self.nodes_with_false_evidence(means)?,
            ended,
            deeds: 0,
            fault: None,
        })
    }

    /// Maps that the vehicle has accepted since a time.
    fn maps(&self, since: Timestamp) -> anyhow::Result<Vec<Line>> {
        maps_in(self.directory.path(), since)
    }

    /// Number of honest nodes that keep evidence about the vehicles of [`inverted`](crate::shares::inverted).
    fn nodes_with_false_evidence(&self, means: Means) -> anyhow::Result<usize> {
        let mut count = 0;
        for node in self
            .nodes
            .iter()
            .filter(|node| means != Means::Leader || node.name != LEADER)
        {
            let files = fs::read_dir(self.directory.path().join(node.name).join("state"))?;
            let states = files
                .map(|file| Ok(fs::read(file?.path())?))
                .collect::<anyhow::Result<Vec<_>>>()?;
            let is_forged = |state: &Vec<u8>| state.windows(6).any(|text| text == b"\"liar\"");
            count += usize::from(states.iter().any(is_forged));
        }
        Ok(count)
    }

    fn ended(&mut self) -> anyhow::Result<Vec<String>> {
        let mut ended = Vec::new();
        for node in &mut self.nodes {
            if let Some(status) = node.process.ended()? {
                ended.push(format!("{} ({status})", node.name));
            }
        }
        Ok(ended)
    }

    fn peak_memory_mb(&self) -> anyhow::Result<u64> {
        let peak = |node: &Node| {
            let text = fs::read_to_string(format!("/proc/{}/status", node.process.id()))?;
            let peak = text
                .lines()
                .find_map(|line| line.strip_prefix("VmHWM:"))
                .context("no peak of memory")?;
            anyhow::Ok(peak.trim().trim_end_matches(" kB").parse::<u64>()? * 1024 / 1_000_000)
        };
        Ok(peak(&self.nodes[0])?.max(peak(&self.nodes[1])?))
    }

    /// Leaves the files where they are.
    fn keep(&mut self) -> PathBuf {
        self.directory.disable_cleanup(true);
        self.directory.path().to_owned()
    }
}

/// Maps that the vehicle has accepted since a time, by the cell's directory.
fn maps_in(home: &Path, since: Timestamp) -> anyhow::Result<Vec<Line>> {
    let file = home.join(OBSERVED).join("maps.jsonl");
    let text = fs::read_to_string(&file).unwrap_or_default();
    let whole = text.rsplit_once('\n').map_or("", |(whole, _)| whole);
    let lines = whole.lines().map(serde_json::from_str::<Line>);
    let lines = lines
        .collect::<Result<Vec<_>, _>>()
        .with_context(|| file.display().to_string())?;
    Ok(lines
        .into_iter()
        .filter(|line| line.received_at_us >= since)
        .collect())
}

/// The part of a map log's line that is needed here.
#[derive(Deserialize)]
struct Line {
    received_at_us: Timestamp,
    map: Map,
}

#[derive(Deserialize)]
struct Map {
    aggregator: String,
    landmarks: Vec<Landmark>,
    objects: Vec<Object>,
}

#[derive(Deserialize)]
struct Object {
    contributors: BTreeSet<String>,
}

#[derive(Deserialize)]
struct Landmark {
    label: Option<String>,
    contributors: BTreeSet<String>,
}

impl Map {
    /// True if the cell made the map from the reports of honest vehicles: the landmark has the real object, or no
    /// object. Away from the landmark there may be objects that members report in their own names.
    fn is_true(&self) -> bool {
        let [landmark] = &self.landmarks[..] else {
            return false;
        };
        NODES
            .iter()
            .any(|(name, role)| *name == self.aggregator && *role != Role::Cav)
            && landmark.label.as_deref().is_none_or(|label| label == LABEL)
            && self.reporters().is_subset(&honest())
            && self
                .objects
                .iter()
                .flat_map(|object| &object.contributors)
                .all(|name| is_member(name))
    }

    fn reporters(&self) -> BTreeSet<&str> {
        self.landmarks
            .iter()
            .flat_map(|landmark| &landmark.contributors)
            .map(String::as_str)
            .collect()
    }
}

/// True if a vehicle of the cell may report under this name.
fn is_member(name: &str) -> bool {
    honest().contains(name) || VEHICLES.contains(&name)
}

/// Longest time without a map between two times.
fn longest_gap_ms(maps: &[Line], from: Timestamp, until: Timestamp) -> u64 {
    let times = [from]
        .into_iter()
        .chain(maps.iter().map(|line| line.received_at_us))
        .chain([until]);
    let times: Vec<_> = times.collect();
    let longest = times
        .windows(2)
        .map(|pair| pair[1].since(pair[0]))
        .max()
        .unwrap_or_default();
    longest.as_millis() as u64
}

fn honest() -> BTreeSet<&'static str> {
    NODES
        .into_iter()
        .filter(|(_, role)| *role != Role::Edge)
        .map(|(name, _)| name)
        .collect()
}

/// The program under test.
pub(crate) fn program() -> PathBuf {
    std::env::var("PROGRAM")
        .unwrap_or_else(|_| PROGRAM.to_owned())
        .into()
}

/// A picture: the vehicles see by recorded detections, but all else is as with a camera.
fn grey_frame() -> Vec<u8> {
    let (width, height) = FRAME_SIZE;
    let header = format!("P6 {width} {height} 255\n");
    [header.as_bytes(), &vec![128; width * height * 3]].concat()
}

fn issue(
    authority: &mut Authority,
    name: &str,
    rights: impl Into<Rights>,
) -> anyhow::Result<TlsConfig> {
    let name = NodeName::new(name)?;
    authority.issue(&name, rights, Duration::from_secs(86_400), clock::now())?;
    Ok(authority.tls_of(&name))
}

fn configuration(
    name: &str,
    role: Role,
    broker: SocketAddr,
    gossip: SocketAddr,
    seeds: &[SocketAddr],
    tls: &TlsConfig,
    shared: &Path,
) -> String {
    let seeds: Vec<_> = seeds.iter().map(|seed| format!("\"{seed}\"")).collect();
    let seeds = seeds.join(", ");
    let role = match role {
        Role::Auto => "auto",
        Role::Cav => "cav",
        Role::Edge => "edge",
    };
    let TlsConfig {
        ca,
        certificate,
        key,
        revocation_list,
        city: _,
    } = tls;
    let list = revocation_list
        .as_ref()
        .map(|list| format!("revocation_list = {list:?}\n"))
        .unwrap_or_default();
    let mut text = format!(
        "name = \"{name}\"\ncell = \"{CELL}\"\nrole = \"{role}\"\nlisten = \"{broker}\"\nstate_dir = \"state\"\n\n\
         [membership]\nkey = \"{KEY}\"\nbind = \"{gossip}\"\nseeds = [{seeds}]\n\n\
         [membership.multicast]\nenabled = false\n\n[dashboard]\nenabled = false\n\n\
         [tls]\nca = {ca:?}\ncertificate = {certificate:?}\nkey = {key:?}\n{list}"
    );
    if role != "edge" {
        let frames = shared.join("frames");
        let detections = shared.join("detections.jsonl");
        text += &format!(
            "\n[camera.source]\nkind = \"images\"\npath = {frames:?}\nlooping = true\n\n\
             [camera.detector]\nkind = \"recorded\"\npath = {detections:?}\nlooping = true\n\n\
             [camera.projection.sizes.default]\nwidth_m = 0.5\nheight_m = 0.5\n"
        );
    }
    // Objects away from the landmark are tracked, so that attackers can fill the map.
    text + LANDMARK + "\n[fusion.tracks]\nmode = \"on\"\n"
}

#[test]
fn gap_ends_with_measurement() {
    let line = |ms: u64| Line {
        received_at_us: Timestamp(1000 * ms),
        map: serde_json::from_str(r#"{"aggregator":"edge","landmarks":[],"objects":[]}"#).unwrap(),
    };
    let maps = [line(100), line(250), line(300)];
    let gap_ms = |until_ms: u64| longest_gap_ms(&maps, Timestamp(0), Timestamp(1000 * until_ms));
    assert_eq!([gap_ms(320), gap_ms(700)], [150, 400]);
}

#[test]
fn unsupported_map_is_false() {
    let map = |aggregator: &str, label: &str, contributors: &str, objects: &str| {
        let text = format!(
            r#"{{"aggregator":"{aggregator}","landmarks":[{{"label":{label},"contributors":[{contributors}]}}],"objects":[{objects}]}}"#
        );
        serde_json::from_str::<Map>(&text).unwrap().is_true()
    };
    assert!(map("edge", r#""car""#, r#""v01","v02""#, "") && map("v01", "null", "", ""));
    assert!(!map("gauss", r#""car""#, r#""v01""#, ""), "made by another");
    assert!(!map("edge", r#""bus""#, r#""v01""#, ""), "another object");
    assert!(
        !map("edge", r#""car""#, r#""gauss""#, ""),
        "seen by another"
    );
    assert!(
        map(
            "edge",
            r#""car""#,
            r#""v01""#,
            r#"{"contributors":["gauss"]}"#
        ),
        "a member may see something else"
    );
    assert!(
        !map(
            "edge",
            r#""car""#,
            r#""v01""#,
            r#"{"contributors":["zeno"]}"#
        ),
        "not of a member of the cell"
    );
    assert!(
        !serde_json::from_str::<Map>(r#"{"aggregator":"edge","landmarks":[],"objects":[]}"#)
            .unwrap()
            .is_true()
    );
}
