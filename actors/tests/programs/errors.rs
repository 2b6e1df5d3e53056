//! The errors for a configuration or a description that cannot be used: key, value, allowed values, remedy.
//!
//! A change is accepted by `INSTA_UPDATE=always make snapshots`.

use ecod_actors::node::config::NodeConfig;
use ecod_testkit::{command, error_case, errors_of};

/// Configurations that cannot be used, each in one way.
const CONFIGURATIONS: &[&str] = &[
    "",
    "name =",
    "nmae = \"edge\"",
    "cell = \"two words\"",
    "role = \"leader\"",
    "listen = \"nowhere\"",
    "cell = 5",
    "[pose]\nx = 1",
    "[pose]\nlatitude_deg = 52",
    "[pose]\nx_m = 1\nlatitude_deg = 52\nlongitude_deg = 21\nazimuth_deg = 0",
    "[pose]\nlisten = \"127.0.0.1:0\"\nmoving = false",
    "cells = \"cells.toml\"",
    "[membership]\nprobe_ms = 1",
    "[membership]\nkey = \"short\"",
    "[membership]\nkey = \"a key that is long enough\"\nkey_file = \"key\"",
    "[membership]\nadvertise = \"0.0.0.0:0\"",
    "[membership]\nseeds = [\"192.168.1.10\"]",
    "[membership]\nseeds = [\"user:geheim1@192.168.1.10:17884\"]",
    "[mqtt]\nbroker = \"mqtt://user:geheim1@broker:1883\"",
    "[uplink]\nbroker = \"user:geheim1@broker:1883\"",
    "[membership]\nmulticast = { group = \"10.0.0.1\" }",
    "[election]\npriority = 300",
    "[election]\nstable_ms = -1",
    "[mqtt]\nbroker = \"\"",
    "[mqtt]\nkeep_alive_s = 0",
    "[mqtt]\npassword = \"secret\"",
    "[mqtt]\nca = \"ca.pem\"",
    "[mqtt]\nsign = true",
    "[mqtt]\nencoding = \"xml\"",
    "[tls]\nca = \"ca.pem\"",
    "[broker]\nmax_packet_bytes = 5",
    "[fusion.round]\nperiod_s = 0",
    "[fusion.pace]\ngate_m = -1.0",
    "[fusion.tracks]\nmode = \"maybe\"",
    "[reputations]\npublish_period_s = nan",
    "[uplink]\nca = \"ca.pem\"",
    "[dashboard]\nlisten = \"0.0.0.0:8080\"",
    "[dashboard]\nlisten = \"0.0.0.0:8080\"\ntoken = \"short\"",
    "[record]\nmax_file_mb = 10",
    "[record]\ndir = \"\"",
    "[origin]\nlatitude_deg = 91\nlongitude_deg = 21",
    "[[landmarks]]\nid = \"\"\nx_m = 0\ny_m = 0",
    "[[landmarks]]\nid = \"slot-0\"\nx_m = 0",
    "[[landmarks]]\nid = \"slot-0\"\nx_m = 0\ny_m = inf",
    "[[landmarks]]\nid = \"slot-0\"\nx_m = 0\ny_m = 0\n[[landmarks]]\nid = \"slot-0\"\nx_m = 3\ny_m = 0",
];

/// Camera configurations that a node refuses.
const CAMERAS: &[&str] = &[
    "[camera]",
    "[camera]\nsource = { kind = \"film\" }\ndetector = { kind = \"placard\" }",
    "[camera]\nsource = { kind = \"v4l2\" }\ndetector = { kind = \"eyes\" }",
    "[camera]\nsource = { kind = \"v4l2\", fps = 0 }\ndetector = { kind = \"placard\" }",
    "[camera]\nsource = { kind = \"url\", url = \"ftp://camera\" }\ndetector = { kind = \"placard\" }",
    "[camera]\nsource = { kind = \"gstreamer\", pipeline = \"v4l2src\" }\ndetector = { kind = \"placard\" }",
    "[camera]\nsource = { kind = \"v4l2\" }\ndetector = { kind = \"placard\", passes = [] }",
    "[camera]\nsource = { kind = \"v4l2\" }\ndetector = { kind = \"placard\" }\noptics = { horizontal_fov_deg = 190 }",
    "[camera]\nsource = { kind = \"v4l2\" }\ndetector = { kind = \"placard\" }\nprojection = { ranging = \"guess\" }",
    "[[cameras]]\nsource = { kind = \"v4l2\" }\ndetector = { kind = \"placard\" }",
];

/// Descriptions that cannot be used, each in one way.
const DESCRIPTIONS: &[&str] = &[
    "name = \"edge\"",
    "[[landmarks]]\nid = 5",
    "[[landmarks]]\nid = \"slot-0\"\nx_m = 0\ny_m = 1e9",
    "[[landmarks]]\nid = \"slot-0\"\nx_m = 0\ny_m = 0\ncolour = \"red\"",
    "[fusion.pace]\ngate_m = 0",
    "[fusion.round]\nperiod_s = 0.001",
    "[fusion.vote]\nmode = \"loudest\"",
    "[origin]\nlatitude_deg = 52",
];

/// Command lines that cannot be carried out in an empty folder, each for another reason.
const COMMANDS: &[&str] = &[
    "--role leader",
    "--name two/parts",
    "--config missing.toml",
    "--confg node.toml",
    "join not-a-token",
    "join ecod1-AAAA",
    "pki issue edge",
    "pki revoke edge",
    "cell set missing.toml",
    "--broker user:geheim1@broker:1883",
    "--seed user:geheim1@edge:17884",
    "--brokr=user:geheim1@broker:1883",
    "mqtt://user:geheim1@broker:1883",
    "invite gauss --seed user:geheim1@edge:17884",
    "report missing.jsonl",
    "replay --input missing.jsonl --output maps.jsonl",
    "replay --input same.jsonl --output same.jsonl",
    "status --jsn",
    "nodee",
];

/// The program's output about a configuration.
fn refused(text: &str) -> String {
    let directory = tempfile::tempdir().unwrap();
    std::fs::write(directory.path().join("node.toml"), text).unwrap();
    let output = command(env!("CARGO_BIN_EXE_ecod-node"))
        .args(["--name", "edge", "--config", "node.toml", "--print-config"])
        .current_dir(directory.path())
        .output()
        .unwrap();
    assert_eq!(output.status.code(), Some(2), "{text} can be used");
    error_case(text, &String::from_utf8(output.stderr).unwrap())
}

#[test]
fn of_configurations() {
    let refused: String = CONFIGURATIONS.iter().map(|text| refused(text)).collect();
    insta::assert_snapshot!(refused);
}

#[test]
fn of_cameras() {
    let refused: String = CAMERAS.iter().map(|text| refused(text)).collect();
    insta::assert_snapshot!(refused);
}

#[test]
fn of_descriptions() {
    let node = NodeConfig::default();
    let refused = DESCRIPTIONS.iter().map(|text| {
        let error = node.described(text).expect_err(text);
        error_case(text, &error.to_string())
    });
    insta::assert_snapshot!(refused.collect::<String>());
}

#[test]
fn of_commands() {
    let shown = errors_of(env!("CARGO_BIN_EXE_ecod-node"), COMMANDS, |_| {});
    insta::assert_snapshot!(shown);
}
