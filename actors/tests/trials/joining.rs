//! A new cell as its owner sets it up: one machine creates the cell, the others join by tokens.

mod machines;

use std::fs::{self, File};
use std::io::{BufRead, BufReader, Write};
use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use ecod::model::names::NodeName;
use ecod::wire::Role;
use ecod_actors::platform::clock;
use ecod_actors::transport::pki::Authority;
use ecod_testkit::{all_output, command, free_gossip_address, until_blocking as until};

fn ecod_node(arguments: &[&str]) -> Command {
    let mut command = command(env!("CARGO_BIN_EXE_ecod-node"));
    command.args(arguments);
    command
}

fn succeeds(arguments: &[&str]) -> String {
    let output = ecod_node(arguments).output().unwrap();
    assert!(
        output.status.success(),
        "{arguments:?}: {}",
        all_output(&output)
    );
    all_output(&output)
}

fn fails(arguments: &[&str]) -> String {
    let output = ecod_node(arguments).output().unwrap();
    assert!(
        !output.status.success(),
        "{arguments:?}: {}",
        all_output(&output)
    );
    all_output(&output)
}

/// A process that ends with the test.
pub(crate) struct Running(Child);

impl Drop for Running {
    fn drop(&mut self) {
        self.0.kill().ok();
        self.0.wait().ok();
    }
}

/// Runs a node by its files alone, but for the addresses, as all nodes are on one machine.
fn run(directory: &Path, gossip: &str) -> Running {
    let config = directory.join("node.toml");
    let mut command = ecod_node(&[
        "--listen",
        "127.0.0.1:0",
        "--no-dashboard",
        "--config",
        config.to_str().unwrap(),
    ]);
    command
        .env("ECOD_MEMBERSHIP__BIND", gossip)
        .env("ECOD_MEMBERSHIP__MULTICAST__ENABLED", "false");
    command.arg("--map-log").arg(directory.join("maps"));
    Running(
        command
            .stderr(File::create(directory.join("log")).unwrap())
            .stdout(Stdio::null())
            .spawn()
            .unwrap(),
    )
}

/// Starts `invite`; gives it and the tokens in the order of the names.
fn invite(directory: &str, seed: &str, names: &[&str]) -> (Running, Vec<String>) {
    let mut command = ecod_node(&[
        "invite",
        "--role",
        "auto",
        "--dir",
        directory,
        "--listen",
        "127.0.0.1:0",
        "--seed",
        seed,
    ]);
    let mut host = Running(
        command
            .args(names)
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap(),
    );
    let tokens = tokens(&mut host, names.len());
    (host, tokens)
}

/// The tokens in the commands that an inviting node prints.
pub(crate) fn tokens(host: &mut Running, count: usize) -> Vec<String> {
    let lines = BufReader::new(host.0.stdout.take().unwrap()).lines();
    let tokens = lines.filter_map(|line| {
        Some(
            line.unwrap()
                .trim()
                .strip_prefix("sudo ecod-node join ")?
                .to_owned(),
        )
    });
    tokens.take(count).collect()
}

#[test]
fn three_machines_form_cell() {
    let machines = ["edge", "gauss", "euclid"].map(|_| tempfile::tempdir().unwrap());
    let [edge, gauss, euclid] = machines
        .each_ref()
        .map(|machine| machine.path().to_str().unwrap());
    let gossip = free_gossip_address().to_string();

    let output = succeeds(&["init", "lot-1", "edge", "--role", "edge", "--dir", edge]);
    assert!(
        output.contains("ecod-node invite NAME --dir")
            && output.contains("ecod-node cell set --config")
            && output.contains("start it: ecod-node --config"),
        "{output}"
    );
    let mut nodes = vec![run(Path::new(edge), &gossip)];
    let (mut host, tokens) = invite(edge, &gossip, &["gauss", "euclid"]);
    let [for_gauss, for_euclid] = &*tokens else {
        panic!("{tokens:?}")
    };
    let damaged = fails(&["join", &for_gauss[..for_gauss.len() - 1], "--dir", gauss]);
    assert!(damaged.contains("not a complete token"), "{damaged}");
    succeeds(&["join", for_gauss, "--dir", gauss]);
    let again = fails(&["join", for_gauss, "--dir", gauss]);
    assert!(again.contains("the token was used already"), "{again}");
    let elsewhere = tempfile::tempdir().unwrap();
    let again = fails(&[
        "join",
        for_gauss,
        "--dir",
        elsewhere.path().to_str().unwrap(),
    ]);
    assert!(again.contains("the token was used already"), "{again}");
    let mut join = ecod_node(&["join", "-", "--dir", euclid])
        .stdin(Stdio::piped())
        .spawn()
        .unwrap();
    writeln!(join.stdin.take().unwrap(), "{for_euclid}").unwrap();
    assert!(
        join.wait().unwrap().success(),
        "the token comes from standard input"
    );
    assert!(host.0.wait().unwrap().success(), "all have joined");
    let late = fails(&[
        "join",
        for_euclid,
        "--dir",
        elsewhere.path().to_str().unwrap(),
    ]);
    assert!(
        late.contains("is `ecod-node invite` still running"),
        "{late}"
    );

    for directory in [edge, gauss, euclid] {
        for secret in ["node.key", "cell.key"] {
            let mode = fs::metadata(Path::new(directory).join(secret))
                .unwrap()
                .permissions()
                .mode();
            assert_eq!(mode & 0o777, 0o600, "{directory}/{secret}");
        }
    }
    let kept: Vec<_> = fs::read_dir(Path::new(edge).join("pki/nodes"))
        .unwrap()
        .map(|f| f.unwrap().file_name())
        .collect();
    assert_eq!(
        kept,
        ["edge.pem"],
        "no private key of a node is with the CA"
    );

    nodes.extend([gauss, euclid].map(|directory| run(Path::new(directory), "127.0.0.1:0")));
    for directory in [gauss, euclid] {
        until("maps of the edge on all", || {
            let maps = fs::read_to_string(Path::new(directory).join("maps")).unwrap_or_default();
            maps.contains("\"aggregator\":\"edge\"")
        });
    }
}

#[test]
fn city_cell_accepts_city_vehicles() {
    let machines = ["city", "edge", "gauss"].map(|_| tempfile::tempdir().unwrap());
    let [city, edge, gauss] = machines
        .each_ref()
        .map(|machine| machine.path().to_str().unwrap());
    let gossip = free_gossip_address().to_string();
    succeeds(&["pki", "city", "init", "--city", "town", "--dir", city]);
    succeeds(&["pki", "city", "issue", "euclid", "--dir", city]);
    succeeds(&[
        "init", "lot-1", "edge", "--role", "edge", "--city", city, "--dir", edge,
    ]);
    let list = Path::new(edge).join("city-revoked.pem");
    let kept = fs::read_to_string(&list).unwrap();
    fs::remove_file(&list).unwrap();
    let incomplete = fails(&["invite", "gauss", "--dir", edge, "--listen", "127.0.0.1:0"]);
    assert!(
        incomplete.contains("city-revoked.pem is missing: a city has signed the cell's CA"),
        "{incomplete}"
    );
    fs::write(&list, kept).unwrap();
    let (mut host, tokens) = invite(edge, &gossip, &["gauss"]);
    succeeds(&["join", &tokens[0], "--dir", gauss]);
    assert!(host.0.wait().unwrap().success(), "it has joined");
    for file in ["city.pem", "city-revoked.pem"] {
        let [given, has] = [edge, gauss]
            .map(|directory| fs::read_to_string(Path::new(directory).join(file)).unwrap());
        assert_eq!(given, has, "{file}");
    }
    // The vehicle of the city, by the files of the city and the cell's key.
    let euclid = tempfile::tempdir().unwrap();
    let at = |directory: &str, file: &str| Path::new(directory).join(file).display().to_string();
    let [ca, cell_list] = ["ca.pem", "revoked.pem"].map(|file| at(gauss, file));
    let [city_ca, city_list] = ["ca.pem", "revoked.pem"].map(|file| at(city, file));
    let [certificate, key] = ["nodes/euclid.pem", "nodes/euclid.key"].map(|file| at(city, file));
    let configuration = format!(
        "name = \"euclid\"\ncell = \"lot-1\"\nrole = \"cav\"\n[membership]\nkey_file = {:?}\nseeds = [{gossip:?}]\n\
         [tls]\nca = {ca:?}\ncertificate = {certificate:?}\nkey = {key:?}\nrevocation_list = {cell_list:?}\n\
         [tls.city]\nca = {city_ca:?}\nrevocation_list = {city_list:?}\n",
        at(gauss, "cell.key")
    );
    fs::write(euclid.path().join("node.toml"), configuration).unwrap();
    // The node that joined leads alone: the vehicle accepts its maps if both trust each other.
    let _nodes = [
        run(Path::new(gauss), &gossip),
        run(euclid.path(), "127.0.0.1:0"),
    ];
    until("maps of the node that joined at the vehicle", || {
        let maps = fs::read_to_string(euclid.path().join("maps")).unwrap_or_default();
        maps.contains("\"aggregator\":\"gauss\"")
    });
}

#[test]
fn init_and_invite_explain_refusal() {
    let machine = tempfile::tempdir().unwrap();
    let missing = fails(&["invite", "gauss", "--dir", machine.path().to_str().unwrap()]);
    assert!(
        missing.contains("has no CA: run `ecod-node invite` on the machine where `ecod-node init`"),
        "{missing}"
    );
    let directory = machine.path().to_str().unwrap();
    let reserved = fails(&["init", "lot-1", "edge--a", "--dir", directory]);
    assert!(
        reserved.contains("names of nodes have no `--`"),
        "{reserved}"
    );
    succeeds(&["init", "lot-1", "edge", "--dir", directory]);
    let again = fails(&["init", "lot-1", "edge", "--dir", directory]);
    assert!(again.contains("belongs to a node already"), "{again}");
    let reserved = fails(&[
        "invite",
        "gauss--lidar",
        "--dir",
        directory,
        "--listen",
        "127.0.0.1:0",
    ]);
    assert!(
        reserved.contains("names of nodes have no `--`"),
        "{reserved}"
    );
}

/// An expired certificate of a node, in place of its present certificate.
fn let_end(pki: &Path, node: &str, role: Role, machine: &Path) {
    let name = NodeName::new(node).unwrap();
    let day = Duration::from_secs(86_400);
    let mut authority = Authority::open(pki).unwrap();
    let issued_at = clock::wall() - 10 * day;
    authority.issue(&name, role, 9 * day, issued_at).unwrap();
    let (certificate, key) = authority.files_of(&name);
    fs::copy(certificate, machine.join("node.pem")).unwrap();
    fs::copy(key, machine.join("node.key")).unwrap();
}

#[test]
fn one_command_restores_expired_node() {
    let machines = ["edge", "gauss"].map(|_| tempfile::tempdir().unwrap());
    let [edge, gauss] = machines
        .each_ref()
        .map(|machine| machine.path().to_str().unwrap());
    let gossip = free_gossip_address().to_string();
    succeeds(&["init", "lot-1", "edge", "--role", "edge", "--dir", edge]);
    let (host, tokens) = invite(edge, &gossip, &["gauss"]);
    succeeds(&["join", &tokens[0], "--dir", gauss]);
    drop(host);
    let pki = machines[0].path().join("pki");
    let_end(&pki, "edge", Role::Edge, machines[0].path());
    let_end(&pki, "gauss", Role::Auto, machines[1].path());

    let _nodes = [
        run(Path::new(edge), &gossip),
        run(Path::new(gauss), "127.0.0.1:0"),
    ];
    for machine in &machines {
        until("the node reports the end of its certificate", || {
            let log = fs::read_to_string(machine.path().join("log")).unwrap_or_default();
            log.contains("give it a new certificate")
        });
    }
    for (machine, remedy) in machines.iter().zip([
        "`ecod-node pki renew` creates a new one",
        "`ecod-node join` here, with the token of `ecod-node invite --role auto gauss`",
    ]) {
        let config = machine.path().join("node.toml");
        let advice = fails(&["doctor", "--config", config.to_str().unwrap()]);
        assert!(advice.contains(remedy), "{advice}");
    }
    let config_path = machines[0].path().join("node.toml");
    let config = config_path.to_str().unwrap();
    let directory = pki.to_str().unwrap();
    let output = succeeds(&["pki", "renew", "--config", config, "--dir", directory]);
    assert!(
        output.contains("renewed the certificate of edge"),
        "{output}"
    );
    let (_host, tokens) = invite(edge, &gossip, &["gauss"]);
    let configuration = fs::read(machines[1].path().join("node.toml")).unwrap();
    let output = succeeds(&["join", &tokens[0], "--dir", gauss]);
    assert!(
        output.contains("gauss has a new certificate of the cell lot-1"),
        "{output}"
    );
    assert_eq!(
        fs::read(machines[1].path().join("node.toml")).unwrap(),
        configuration
    );

    until("gauss gets maps of the edge", || {
        let maps = fs::read_to_string(machines[1].path().join("maps")).unwrap_or_default();
        maps.contains("\"aggregator\":\"edge\"")
    });
}
