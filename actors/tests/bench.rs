//! `ecod-node bench` as a program: figures on a cell of its own, and errors in words.

use std::process::{Command, Output};

use serde_json::Value;

fn bench(arguments: &[&str]) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_ecod-node"));
    command.arg("bench").args(arguments).output().unwrap()
}

#[test]
fn a_cell_of_its_own_is_measured_and_other_figures_stay() {
    let directory = tempfile::tempdir().unwrap();
    let file = directory.path().join("figures.json");
    std::fs::write(&file, r#"{"core":{"x":1}}"#).unwrap();
    let output = bench(&["--cavs", "4", "--seconds", "4", "--out", file.to_str().unwrap()]);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let text = String::from_utf8(output.stdout).unwrap();
    assert!(text.contains("p99.9") && text.contains("vehicles_4_p50_ratio"), "{text}");

    let figures: Value = serde_json::from_slice(&std::fs::read(&file).unwrap()).unwrap();
    assert_eq!(figures["core"]["x"], 1);
    let measured = &figures["cell"]["vehicles"]["4"];
    for way in ["cell", "bare"] {
        // Four passes of ten rounds, the first of each for warming up, at four vehicles.
        assert_eq!(measured[way]["n"], 4 * 9 * 4, "{measured}");
        assert_eq!(measured[way]["missing"], 0, "{measured}");
        let [p50, p99] = ["p50_us", "p99_us"].map(|quantile| measured[way][quantile].as_f64().unwrap());
        assert!(p50 > 10.0 && p99 >= p50, "{measured}");
    }
    let ratio = measured["cell"]["p50_us"].as_f64().unwrap() / measured["bare"]["p50_us"].as_f64().unwrap();
    assert!((measured["p50_ratio"].as_f64().unwrap() - ratio).abs() < 1e-9);
    assert!(measured["map_bytes"].as_u64().unwrap() > 1000, "{measured}");
}

#[test]
fn a_broker_that_is_not_there_is_named() {
    let address = std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().to_string();
    let output = bench(&["--connect", &address, "--cavs", "1", "--seconds", "1"]);
    assert_eq!(output.status.code(), Some(1));
    assert!(String::from_utf8_lossy(&output.stderr).contains(&address), "{output:?}");
}
