//! `ecod-lab bench` as a program: figures on a cell of its own, and errors in words.

use std::process::{Command, Output};

use serde_json::Value;

fn bench(arguments: &[&str]) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_ecod-lab"));
    command.arg("bench").args(arguments).output().unwrap()
}

#[test]
fn started_cell_is_measured_keeping_figures() {
    let directory = tempfile::tempdir().unwrap();
    let file = directory.path().join("figures.json");
    std::fs::write(&file, r#"{"core":{"x":1}}"#).unwrap();
    let output = bench(&[
        "--cavs",
        "4",
        "--seconds",
        "4",
        "--up-to",
        "8",
        "--out",
        file.to_str().unwrap(),
    ]);
    assert!(
        output.status.success(),
        "{}",
        String::from_utf8_lossy(&output.stderr)
    );
    let text = String::from_utf8(output.stdout).unwrap();
    assert!(
        text.contains("p99.9") && text.contains("vehicles_4_verdict_p50_ratio"),
        "{text}"
    );

    let figures: Value = serde_json::from_slice(&std::fs::read(&file).unwrap()).unwrap();
    assert_eq!(figures["core"]["x"], 1);
    let measured = &figures["cell"]["vehicles"]["4"];
    for answer in ["map", "verdict"] {
        let measured = &measured[answer];
        for way in ["cell", "bare"] {
            // Four passes of ten rounds, the first of each for warming up, at four vehicles.
            assert_eq!(measured[way]["n"], 4 * 9 * 4, "{measured}");
            assert_eq!(measured[way]["missing"], 0, "{measured}");
            let [p50, p99] =
                ["p50_us", "p99_us"].map(|quantile| measured[way][quantile].as_f64().unwrap());
            assert!(p50 > 10.0 && p99 >= p50, "{measured}");
        }
        let ratio = measured["cell"]["p50_us"].as_f64().unwrap()
            / measured["bare"]["p50_us"].as_f64().unwrap();
        assert!((measured["p50_ratio"].as_f64().unwrap() - ratio).abs() < 1e-9);
    }
    let p50 = |answer: &str| measured[answer]["cell"]["p50_us"].as_f64().unwrap();
    assert!(
        p50("verdict") >= p50("map"),
        "verdicts leave after the map: {measured}"
    );
    for bytes in ["map_bytes", "verdict_bytes"] {
        assert!(measured[bytes].as_u64().unwrap() > 1000, "{measured}");
    }

    // By default it also looks for what is saturated first, and prints it if nothing is.
    let found = &figures["cell"]["saturation"];
    let expected = match found["first_saturated"].as_str() {
        Some(first) => format!("saturated first: {first}"),
        None => "nothing saturated up to 8 vehicles".to_owned(),
    };
    assert!(text.contains(&expected), "{text}");
    assert_eq!(found["steps"][0]["vehicles"], 4);
    assert!(
        found["steps"][0]["shares"]["aggregator"]["fusion"]
            .as_f64()
            .unwrap()
            > 0.0,
        "{found}"
    );
}

#[test]
fn costs_are_measured_with_recording() {
    let directory = tempfile::tempdir().unwrap();
    let file = directory.path().join("figures.json");
    let output = bench(&["--costs", "--seconds", "2", "--out", file.to_str().unwrap()]);
    assert!(
        output.status.success(),
        "{}",
        String::from_utf8_lossy(&output.stderr)
    );
    assert!(
        String::from_utf8_lossy(&output.stdout).contains("an aggregator with 32 vehicles"),
        "{output:?}"
    );
    let figures: Value = serde_json::from_slice(&std::fs::read(&file).unwrap()).unwrap();
    let costs = &figures["costs"]["costs"];
    assert!(costs["resident_mb"].as_f64().unwrap() > 1.0, "{costs}");
    let threads = &costs["recording_cpu_percent_by_thread"];
    assert!(
        threads
            .as_object()
            .unwrap()
            .values()
            .any(|percent| percent.as_f64().unwrap() > 0.0),
        "{costs}"
    );
}

#[test]
fn closed_cell_names_reason() {
    let directory = tempfile::tempdir().unwrap();
    let file = directory.path().join("cell.toml");
    let tls = "name = \"euclid\"\n[tls]\nca = \"ca.pem\"\ncertificate = \"euclid.pem\"\nkey = \"euclid.key\"\n";
    std::fs::write(&file, tls).unwrap();
    let output = bench(&[
        "--connect",
        "127.0.0.1:8883",
        "--config",
        file.to_str().unwrap(),
    ]);
    assert_eq!(output.status.code(), Some(1));
    assert!(
        String::from_utf8_lossy(&output.stderr).contains("one vehicle only"),
        "{output:?}"
    );
}

#[test]
fn missing_broker_is_named() {
    let address = std::net::TcpListener::bind("127.0.0.1:0")
        .unwrap()
        .local_addr()
        .unwrap()
        .to_string();
    let output = bench(&["--connect", &address, "--cavs", "1", "--seconds", "1"]);
    assert_eq!(output.status.code(), Some(1));
    assert!(
        String::from_utf8_lossy(&output.stderr).contains(&address),
        "{output:?}"
    );
}
