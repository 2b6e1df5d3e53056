//! Plain MQTT clients against a live cell, as the documentation tells them: paho-mqtt in Python, and mosquitto's tools.

use std::io::{Read, Write};
use std::net::{SocketAddr, TcpListener};
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::thread::{JoinHandle, sleep};
use std::time::Duration;

use ecod::model::names::NodeName;
use ecod::perception::landmark::LandmarkConfig;
use ecod::wire::Role;
use ecod_actors::node::config::NodeConfig;
use ecod_actors::node::{self, NodeHandle};
use ecod_actors::platform::clock;
use ecod_actors::transport::pki::{Authority, TlsConfig};

/// An edge of the cell that the documentation speaks of.
async fn edge(tls: Option<TlsConfig>) -> (NodeHandle, SocketAddr) {
    let landmark = |id: &str, x_m| LandmarkConfig {
        id: id.into(),
        x_m,
        y_m: 0.0,
        facing_deg: None,
        vacancy: None,
        synonyms: Default::default(),
    };
    let mut config = NodeConfig {
        name: Some(NodeName::from_static("edge")),
        cell: NodeName::from_static("lot-1"),
        role: Role::Edge,
        listen: Some(SocketAddr::from(([127, 0, 0, 1], 0))),
        landmarks: vec![landmark("slot-0", 0.0), landmark("slot-1", 2.5)],
        tls,
        ..NodeConfig::default()
    };
    config.membership.bind = Some(SocketAddr::from(([127, 0, 0, 1], 0)));
    config.membership.multicast.enabled = false;
    config.dashboard.enabled = false;
    config.validate().unwrap();
    let node = node::start(config).await.unwrap();
    let mut maps = node.newest_map();
    tokio::time::timeout(Duration::from_secs(30), maps.wait_for(Option::is_some)).await.unwrap().unwrap();
    let broker = node.broker_address().unwrap();
    (node, broker)
}

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..")
}

fn said(output: &Output) -> String {
    String::from_utf8_lossy(&output.stdout).into_owned() + &String::from_utf8_lossy(&output.stderr)
}

/// Whether a program is there that the test needs.
fn found(program: &str, arguments: &[&str]) -> bool {
    Command::new(program).args(arguments).output().is_ok_and(|output| output.status.success())
}

/// A Python that has paho-mqtt.
fn python() -> String {
    let python = std::env::var("PAHO_PYTHON").unwrap_or("python3".into());
    assert!(found(&python, &["-c", "import paho.mqtt.client"]), "{python} has no paho-mqtt: run `make python-check`");
    python
}

/// What a detector of any kind writes about a frame.
const FRAME: &str = r#"{"objects":[{"label":"car","confidence":0.9,"x_m":0.1,"y_m":0.1,"landmark":"slot-0"}],"seen":["slot-0","slot-1"]}"#;

/// Runs the Python example at a broker on ten such lines a second.
fn feed(python: &str, broker: SocketAddr, arguments: &[&str], lines: &[&str]) -> Output {
    let mut example = Command::new(python);
    example.arg(root().join("examples/python/feed_detections.py")).args(["--broker", &broker.to_string()]);
    example.args(["--cell", "lot-1", "--node", "euclid", "--pose", "1", "6", "-90"]).args(arguments);
    let mut example = example.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    let mut detector = example.stdin.take().unwrap();
    for line in lines {
        // The example may have left.
        if writeln!(detector, "{line}").is_err() {
            break;
        }
        sleep(Duration::from_millis(100));
    }
    drop(detector);
    example.wait_with_output().unwrap()
}

/// The example reports what a detector writes and prints maps and verdicts with it; lines that are no frames it skips
/// and names.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "needs paho-mqtt, which `make python-check` installs"]
async fn the_python_example_feeds_a_cell_and_prints_what_it_agrees_on() {
    let python = python();
    let (node, broker) = edge(None).await;
    let junk = ["loading model", r#"{"seen":["slot-0"]}"#, "[1]"];
    let lines = [&[FRAME; 3][..], &junk, &[FRAME; 17]].concat();
    let output = tokio::task::spawn_blocking(move || feed(&python, broker, &[], &lines)).await.unwrap();
    node.stop().await;
    let said = said(&output);
    assert!(output.status.success(), "{said}");
    for parts in [["map ", "slot-0: car 0.", "slot-1: empty"], ["verdicts ", "edge round ", "slot-0: car by "]] {
        assert!(said.lines().any(|line| parts.iter().all(|part| line.contains(part))), "{parts:?}: {said}");
    }
    for number in [4, 5, 6] {
        assert!(said.contains(&format!("line {number} skipped: ")), "{said}");
    }
    assert_eq!(said.matches("skipped").count(), 3, "{said}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "needs paho-mqtt, which `make python-check` installs"]
async fn the_python_example_joins_a_cell_with_certificates_by_its_own() {
    let python = python();
    let (directory, now) = (tempfile::tempdir().unwrap(), clock::now());
    let cell = NodeName::from_static("lot-1");
    let mut authority = Authority::init(directory.path(), &cell, now).unwrap();
    let mut issue = |name, role| {
        let name = NodeName::from_static(name);
        authority.issue(&name, role, Duration::from_secs(86_400), now).unwrap();
        let (certificate, key) = authority.files_of(&name);
        TlsConfig { ca: authority.ca(), certificate, key, revocation_list: None }
    };
    let (node, broker) = edge(Some(issue("edge", Role::Edge))).await;
    let TlsConfig { ca, certificate, key, .. } = issue("euclid", Role::Cav);
    let output = tokio::task::spawn_blocking(move || {
        let [ca, certificate, key] = [&ca, &certificate, &key].map(|file| file.to_str().unwrap());
        let own = feed(&python, broker, &["--ca", ca, "--cert", certificate, "--key", key], &[FRAME; 15]);
        let other_name = ["--ca", ca, "--cert", certificate, "--key", key, "--broker-name", "broker.example"];
        (own, feed(&python, broker, &other_name, &[FRAME]))
    });
    let (own, other_name) = output.await.unwrap();
    node.stop().await;
    assert!(own.status.success() && said(&own).contains("slot-0: car 0."), "{}", said(&own));
    assert!(!other_name.status.success() && said(&other_name).contains("cannot reach"), "{}", said(&other_name));
}

/// A broker for one client that answers to its login; also gives what the client sent for it.
fn broker_that_answers(code: u8) -> (SocketAddr, JoinHandle<Vec<u8>>) {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = listener.local_addr().unwrap();
    let login = std::thread::spawn(move || {
        let (mut stream, _) = listener.accept().unwrap();
        drop(listener);
        let mut login = vec![0; 1024];
        let length = stream.read(&mut login).unwrap();
        stream.write_all(&[0x20, 2, 0, code]).unwrap();
        sleep(Duration::from_millis(300));
        login.truncate(length);
        login
    });
    (address, login)
}

#[test]
#[ignore = "needs paho-mqtt, which `make python-check` installs"]
fn the_python_example_says_that_a_broker_refuses_or_is_gone_and_fails() {
    let python = python();
    let (broker, login) = broker_that_answers(5);
    let refused = feed(&python, broker, &["--user", "ada", "--password", "hush4711"], &[FRAME; 30]);
    let login = String::from_utf8_lossy(&login.join().unwrap()).into_owned();
    assert!(login.contains("ada") && login.contains("hush4711"), "{login:?}");
    assert_eq!(refused.status.code(), Some(1));
    assert!(said(&refused).contains("the broker refuses: Not authorized"), "{}", said(&refused));

    let (broker, login) = broker_that_answers(0);
    let lost = feed(&python, broker, &[], &[FRAME; 10]);
    login.join().unwrap();
    assert_eq!(lost.status.code(), Some(1));
    assert!(said(&lost).contains("of 10 frames were not sent"), "{}", said(&lost));
}

/// The commands in the section of that name, one script a code block.
fn commands(document: &str, section: &str) -> Vec<String> {
    let text = std::fs::read_to_string(root().join(document)).unwrap();
    let (_, rest) = text.split_once(&format!("\n## {section}\n")).unwrap();
    let section = rest.split("\n## ").next().unwrap();
    let blocks = section.split("```sh\n").skip(1);
    blocks.map(|block| block.split("```").next().unwrap().to_owned()).collect()
}

/// Both blocks are run as they are, but for the port: the first reports, the second waits for a map and for verdicts.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_documented_commands_of_mosquitto_report_and_receive() {
    let is_installed = found("sh", &["-c", "command -v mosquitto_pub mosquitto_sub"]);
    assert!(is_installed, "mosquitto_pub is missing: install Debian's package mosquitto-clients");
    let (node, broker) = edge(None).await;
    let output = tokio::task::spawn_blocking(move || {
        let scripts = commands("docs/protocol.md", "From a shell");
        let [report, receive] = &*scripts else { panic!("{scripts:?}") };
        let run = |script: &str| {
            let script = script.replace("-p 1883", &format!("-p {}", broker.port()));
            let mut shell = Command::new("sh");
            shell.args(["-e", "-c", &script]).stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
            shell.spawn().unwrap()
        };
        let mut reporter = run(report);
        // The second script begins when the cell has had time to fuse.
        sleep(Duration::from_secs(1));
        let output = run(receive).wait_with_output().unwrap();
        reporter.wait().unwrap();
        output
    });
    let output = output.await.unwrap();
    node.stop().await;
    let said = said(&output);
    assert!(output.status.success(), "{said}");
    let messages: Vec<serde_json::Value> = said.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    let [map, verdicts] = &*messages else { panic!("{said}") };
    assert_eq!((&map["landmarks"][0]["id"], &map["landmarks"][0]["label"]), (&"slot-0".into(), &"car".into()));
    assert_eq!(
        (&verdicts["verdicts"][0]["landmark"], &verdicts["verdicts"][0]["label"]),
        (&"slot-0".into(), &"car".into())
    );
}
