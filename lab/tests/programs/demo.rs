//! `ecod-lab demo` and `ecod-lab testbed` as programs.

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use ecod_testkit::{stderr, until_blocking as until};
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;

fn ecod_lab() -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_ecod-lab"));
    command.stdin(Stdio::null());
    command
}

fn scenes() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../examples/testbed/pace_setup1.json")
}

#[test]
fn unwritable_output_fails_before_run() {
    let directory = tempfile::tempdir().unwrap();
    let file = directory.path().join("file");
    std::fs::write(&file, "kept").unwrap();
    for (command, out) in [
        ("testbed", "/no/such/result.json"),
        ("demo", file.to_str().unwrap()),
    ] {
        let started = Instant::now();
        let output = ecod_lab()
            .args([command, "--out", out, "--scenes"])
            .arg(scenes())
            .output()
            .unwrap();
        let error = stderr(&output);
        assert_eq!(output.status.code(), Some(1), "{error}");
        assert!(error.contains(out) && output.stdout.is_empty(), "{error}");
        assert!(
            started.elapsed() < Duration::from_secs(10),
            "{command} went to work first"
        );
    }
    assert_eq!(std::fs::read_to_string(file).unwrap(), "kept");
}

/// Four cameras, each before two of eight spots; `change` is applied to the file.
fn result_of(change: impl Fn(&mut serde_json::Value)) -> serde_json::Value {
    let directory = tempfile::tempdir().unwrap();
    let mut file: serde_json::Value =
        serde_json::from_slice(&std::fs::read(scenes()).unwrap()).unwrap();
    change(&mut file);
    let scenes = directory.path().join("scenes.json");
    let out = directory.path().join("result.json");
    std::fs::write(&scenes, file.to_string()).unwrap();
    let mut testbed = ecod_lab();
    testbed
        .args([
            "testbed",
            "--scene",
            "setup1-lot2",
            "--verdicts",
            "3",
            "--scenes",
        ])
        .arg(&scenes);
    let output = testbed.arg("--out").arg(&out).output().unwrap();
    assert!(output.status.success(), "{}", stderr(&output));
    serde_json::from_slice::<serde_json::Value>(&std::fs::read(out).unwrap()).unwrap()["scenes"][0]
        .clone()
}

#[test]
fn scenes_may_differ_from_recording() {
    let free_without_placards = result_of(|file| {
        for spot in file["scenes"][1]["spots"].as_array_mut().unwrap() {
            spot.as_object_mut().unwrap().remove("empty_placard");
        }
    });
    assert_eq!(
        free_without_placards["pace_accuracy_pct"], 100.0,
        "{free_without_placards}"
    );
    let slow = result_of(|file| {
        file["camera"]["capture_interval_s"] = 2.0.into();
        file["camera"]["submission_interval_s"] = 4.0.into();
        file["scenes"][1]["recorded"] = serde_json::json!([{"run": "14a"}]);
    });
    assert_eq!(slow["pace_accuracy_pct"], 100.0, "{slow}");
    let without_cars = result_of(|file| {
        for spot in file["scenes"][1]["spots"].as_array_mut().unwrap() {
            spot["truth"] = serde_json::Value::Null;
        }
    });
    assert_eq!(
        without_cars["occupied_accuracy_pct"], 100.0,
        "{without_cars}"
    );
    assert_eq!(without_cars["always_empty_pct"], 100.0);
}

/// Processes with the directory in their command line.
fn working_in(directory: &Path) -> Vec<i32> {
    let processes = std::fs::read_dir("/proc").unwrap().filter_map(Result::ok);
    let directory = directory.to_str().unwrap();
    let ours = processes.filter(|process| {
        // A process that has ended but was not waited for has an empty command line.
        let line = std::fs::read(process.path().join("cmdline")).unwrap_or_default();
        String::from_utf8_lossy(&line).contains(directory)
    });
    ours.filter_map(|process| process.file_name().to_str()?.parse().ok())
        .collect()
}

#[test]
fn killed_demo_leaves_no_nodes() {
    let directory = tempfile::tempdir().unwrap();
    let mut demo = ecod_lab();
    demo.args(["demo", "--scene", "setup1-lot1", "--out"])
        .arg(directory.path());
    let mut demo = demo
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    until("five nodes and the demo run", || {
        working_in(directory.path()).len() == 6
    });
    kill(
        Pid::from_raw(i32::try_from(demo.id()).unwrap()),
        Signal::SIGKILL,
    )
    .unwrap();
    demo.wait().unwrap();
    until("all nodes have ended", || {
        working_in(directory.path()).is_empty()
    });
}

#[test]
fn street_cell_outperforms_cameras_after_failover() {
    let directory = tempfile::tempdir().unwrap();
    let mut demo = ecod_lab();
    demo.args(["demo", "--scene", "street", "--seconds", "10", "--out"])
        .arg(directory.path());
    let output = demo.output().unwrap();
    let output_text = String::from_utf8_lossy(&output.stdout);
    assert!(output.status.success(), "{}{output_text}", stderr(&output));
    let result: serde_json::Value =
        serde_json::from_slice(&std::fs::read(directory.path().join("result.json")).unwrap())
            .unwrap();
    let street = &result["street"];
    let known = |how: &str| {
        let nodes = street[how]
            .as_object()
            .unwrap()
            .values()
            .map(|share| share["known"].as_f64().unwrap());
        nodes.collect::<Vec<_>>()
    };
    let alone = known("alone");
    let with_cell = known("with_cell");
    assert_eq!((alone.len(), with_cell.len()), (4, 4), "{output_text}");
    let best_alone = alone.into_iter().fold(0.0, f64::max);
    assert!(
        with_cell.iter().all(|known| *known > best_alone + 1.0),
        "{output_text}"
    );
    assert!(
        street["took_over"]
            .as_str()
            .is_some_and(|leader| leader != "edge"),
        "no node took over: {output_text}"
    );
    assert!(
        street["failover_gap_ms"]
            .as_u64()
            .is_none_or(|gap_ms| gap_ms < 5000),
        "{output_text}"
    );
    assert!(
        street["seen_only_by"]["galileo"].as_u64() > Some(0),
        "{output_text}"
    );
    assert!(
        output_text.contains("precision:")
            && output_text.contains("next: ")
            && output_text.contains(" try FILE"),
        "words are explained and the next command is shown: {output_text}"
    );
}
