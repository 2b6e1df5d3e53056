//! Plain MQTT clients against a live cell, as in the documentation: mosquitto's tools. The client in Python has
//! separate tests, `make python-client-check`.

use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::thread::sleep;
use std::time::{Duration, Instant};

use ecod::model::names::NodeName;
use ecod::perception::landmark::LandmarkConfig;
use ecod::wire::Role;
use ecod_actors::node::config::NodeConfig;
use ecod_actors::node::{self, NodeHandle};
use ecod_actors::platform::clock;
use ecod_actors::transport::pki::{Authority, TlsConfig};
use ecod_testkit::{all_output, node_config};

/// An edge of the cell that the documentation uses.
async fn edge(tls: Option<TlsConfig>) -> (NodeHandle, SocketAddr) {
    let config = NodeConfig {
        landmarks: vec![
            LandmarkConfig::at("slot-0", 0.0, 0.0),
            LandmarkConfig::at("slot-1", 2.5, 0.0),
        ],
        tls,
        ..node_config("edge", "lot-1", Role::Edge)
    };
    config.validate().unwrap();
    let node = node::start(config).await.unwrap();
    let mut maps = node.newest_map();
    tokio::time::timeout(Duration::from_secs(30), maps.wait_for(Option::is_some))
        .await
        .unwrap()
        .unwrap();
    let broker = node.broker_address().unwrap();
    (node, broker)
}

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..")
}

/// True if a program is there that the test needs.
fn found(program: &str, arguments: &[&str]) -> bool {
    Command::new(program)
        .args(arguments)
        .output()
        .is_ok_and(|output| output.status.success())
}

/// The commands in the section of that name, one script a code block.
fn commands(document: &str, section: &str) -> Vec<String> {
    let text = std::fs::read_to_string(root().join(document)).unwrap();
    let (_, rest) = text.split_once(&format!("\n## {section}\n")).unwrap();
    let section = rest.split("\n## ").next().unwrap();
    let blocks = section.split("```sh\n").skip(1);
    blocks
        .map(|block| block.split("```").next().unwrap().to_owned())
        .collect()
}

/// The first two blocks are run as they are, but for the port: the first reports, the second waits for a map and for verdicts.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn documented_mosquitto_commands_work() {
    let is_installed = found("sh", &["-c", "command -v mosquitto_pub mosquitto_sub"]);
    assert!(
        is_installed,
        "mosquitto_pub is missing: install Debian's package mosquitto-clients"
    );
    let (node, broker) = edge(None).await;
    let maps = node.newest_map();
    let verdicts = node.newest_verdicts();
    let output = tokio::task::spawn_blocking(move || {
        let scripts = commands("docs/protocol.md", "From a shell");
        let [report, receive, _with_certificates] = &*scripts else {
            panic!("{scripts:?}")
        };
        let run = |script: &str| {
            let script = script.replace("-p 1883", &format!("-p {}", broker.port()));
            let mut shell = Command::new("sh");
            shell
                .args(["-e", "-c", &script])
                .stdin(Stdio::null())
                .stdout(Stdio::piped())
                .stderr(Stdio::piped());
            shell.spawn().unwrap()
        };
        let mut reporter = run(report);
        // The second script begins when the cell has fused.
        let has_fused = || {
            let map = maps.borrow();
            let verdicts = verdicts.borrow();
            let seen = map
                .as_ref()
                .and_then(|newest| newest.map.landmarks[0].label.as_deref());
            let agreed = verdicts
                .as_ref()
                .and_then(|newest| newest.message.verdicts[0].label.as_deref());
            seen == Some("car") && agreed == Some("car")
        };
        let deadline = Instant::now() + Duration::from_secs(30);
        while !has_fused() {
            assert!(Instant::now() < deadline, "not fused");
            sleep(Duration::from_millis(20));
        }
        let output = run(receive).wait_with_output().unwrap();
        reporter.wait().unwrap();
        output
    });
    let output = output.await.unwrap();
    node.stop().await;
    let text = all_output(&output);
    assert!(output.status.success(), "{text}");
    let messages: Vec<serde_json::Value> = text
        .lines()
        .map(|line| serde_json::from_str(line).unwrap())
        .collect();
    let [map, verdicts] = &*messages else {
        panic!("{text}")
    };
    assert_eq!(
        (&map["landmarks"][0]["id"], &map["landmarks"][0]["label"]),
        (&"slot-0".into(), &"car".into())
    );
    assert_eq!(
        (
            &verdicts["verdicts"][0]["landmark"],
            &verdicts["verdicts"][0]["label"]
        ),
        (&"slot-0".into(), &"car".into())
    );
}

/// The third block is run as it is, but for directory and port.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn documented_mosquitto_commands_work_with_certificate() {
    let directory = tempfile::tempdir().unwrap();
    let cell = NodeName::from_static("lot-1");
    let name = NodeName::from_static("edge");
    let mut authority = Authority::init(directory.path(), &cell, clock::now()).unwrap();
    authority
        .issue(&name, Role::Edge, Duration::from_secs(86_400), clock::now())
        .unwrap();
    let tls = TlsConfig {
        revocation_list: None,
        ..authority.tls_of(&name)
    };
    std::fs::copy(&tls.certificate, directory.path().join("node.pem")).unwrap();
    std::fs::copy(&tls.key, directory.path().join("node.key")).unwrap();
    let (node, broker) = edge(Some(tls)).await;
    let output = tokio::task::spawn_blocking(move || {
        let scripts = commands("docs/protocol.md", "From a shell");
        let [_report, _receive, with_certificates] = &*scripts else {
            panic!("{scripts:?}")
        };
        let script = with_certificates.replace("/etc/ecod", directory.path().to_str().unwrap());
        let script = script.replace("-p 8883", &format!("-W 30 -p {}", broker.port()));
        Command::new("sh")
            .args(["-e", "-c", &script])
            .stdin(Stdio::null())
            .output()
            .unwrap()
    });
    let output = output.await.unwrap();
    node.stop().await;
    let map: serde_json::Value = serde_json::from_slice(&output.stdout)
        .unwrap_or_else(|_| panic!("{}", all_output(&output)));
    assert_eq!(map["aggregator"], "edge");
}
