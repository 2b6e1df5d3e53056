//! Logs that are cut short, damaged, or of another version, and other readers.

use std::collections::BTreeMap;
use std::io::Cursor;
use std::path::{Path, PathBuf};
use std::process::Command;

use ecod::replay::ReplayConfig;
use mcap::records::{MessageHeader, Metadata};
use mcap::{WriteOptions, Writer};
use tempfile::TempDir;

/// A log of two reports, with this version and one more channel.
fn log(version: u64) -> Vec<u8> {
    log_with(&[("log", &version.to_string())])
}

/// The same file with other metadata.
fn log_with(changes: &[(&str, &str)]) -> Vec<u8> {
    let mut bytes = Cursor::new(Vec::new());
    let mut writer: Writer<_> = WriteOptions::new()
        .compression(None)
        .create(&mut bytes)
        .unwrap();
    let fusion = serde_json::to_string(&ReplayConfig::default().fusion).unwrap();
    let metadata = [
        ("log", "1".into()),
        ("node", "gauss".into()),
        ("cell", "cell".into()),
        ("run", uuid::Uuid::nil().to_string()),
        ("version", env!("CARGO_PKG_VERSION").into()),
        ("fusion", fusion),
        ("landmarks", "[]".into()),
    ];
    let mut metadata: BTreeMap<_, _> = metadata.map(|(key, value)| (key.to_owned(), value)).into();
    metadata.extend(
        changes
            .iter()
            .map(|(key, value)| ((*key).to_owned(), (*value).to_owned())),
    );
    writer
        .write_metadata(&Metadata {
            name: "ecod.log".into(),
            metadata,
        })
        .unwrap();
    let mut channel = |schema: &str, topic: &str| {
        let schema = writer.add_schema(schema, "jsonschema", b"{}").unwrap();
        writer
            .add_channel(schema, topic, "json", &BTreeMap::new())
            .unwrap()
    };
    let reports = channel("ecod.ObjectReport", "detections/a");
    let tea = channel("ecod.Tea", "tea");
    for (second, channel_id) in [(1, reports), (2, tea), (3, reports)] {
        let micros: u64 = 1_732_154_400_000_000 + second * 1_000_000;
        let report = format!(
            r#"{{"schema":1,"node":"a","seq":{second},"captured_at_us":{micros},"pose":null,
            "objects":[{{"label":"car","confidence":0.9,"x_m":1.0,"y_m":2.0,"landmark":"slot-0"}}]}}"#
        );
        let time = micros * 1000;
        let header = MessageHeader {
            channel_id,
            sequence: second as u32,
            log_time: time,
            publish_time: time,
        };
        writer
            .write_to_known_channel(&header, report.as_bytes())
            .unwrap();
        writer.flush().unwrap();
    }
    writer.finish().unwrap();
    drop(writer);
    bytes.into_inner()
}

fn file(folder: &TempDir, name: &str, bytes: &[u8]) -> PathBuf {
    let path = folder.path().join(name);
    std::fs::write(&path, bytes).unwrap();
    path
}

/// The exit code of a replay, the number of lines that it writes, and its messages.
fn replay(inputs: &[&Path]) -> (i32, usize, String) {
    let mut command = Command::new(env!("CARGO_BIN_EXE_ecod-node"));
    command.args(["replay", "--output", "-"]);
    for input in inputs {
        command.arg("--input").arg(input);
    }
    let run = command.output().unwrap();
    let lines = run.stdout.iter().filter(|byte| **byte == b'\n').count();
    (
        run.status.code().unwrap(),
        lines,
        String::from_utf8(run.stderr).unwrap(),
    )
}

#[test]
fn readable_log_part_is_used() {
    let folder = TempDir::new().unwrap();
    let whole = log(1);
    let (code, lines, said) = replay(&[&file(&folder, "whole.mcap", &whole)]);
    assert!(
        code == 0 && lines > 10 && said.contains("2 lines, 2 used"),
        "{code} {lines} {said}"
    );
    assert!(
        said.contains("1 messages of the unknown kind \"ecod.Tea\" are skipped"),
        "{said}"
    );

    let second = whole
        .windows(8)
        .rposition(|bytes| bytes == b"captured")
        .unwrap();
    let (code, lines, said) = replay(&[&file(&folder, "cut.mcap", &whole[..second])]);
    assert!(
        code == 0 && lines > 0 && said.contains("cut.mcap was not finished"),
        "{code} {lines} {said}"
    );
    assert!(said.contains("1 lines, 1 used"), "{said}");

    let mut damaged = whole.clone();
    damaged[second..second + 20].fill(0xff);
    let (code, _, said) = replay(&[&file(&folder, "damaged.mcap", &damaged)]);
    assert!(
        code == 0 && said.contains("damaged.mcap is damaged"),
        "{said}"
    );

    for length in 0..whole.len() {
        let reader = ecod_actors::observe::recorder::LogReader::open(&file(
            &folder,
            "any.mcap",
            &whole[..length],
        ))
        .unwrap();
        assert!(
            reader.take(1000).count() < 1000,
            "cut at {length}, reading ends"
        );
    }
}

/// Reports that are fused in another way than in the original run are not a replay: missing settings have to be stated.
#[test]
fn unreadable_configuration_requires_given_one() {
    let folder = TempDir::new().unwrap();
    let unknown = r#"{"later_key": 1}"#;
    let config = file(&folder, "cell.toml", b"cell = \"cell\"\n");
    for (name, bytes, why) in [
        (
            "newer.mcap",
            log(7),
            "newer.mcap has version 7 of the log, this program reads 1",
        ),
        (
            "unknown.mcap",
            log_with(&[("fusion", unknown)]),
            "metadata `fusion` of the log cannot be used",
        ),
    ] {
        let log = file(&folder, name, &bytes);
        let output = file(&folder, "rounds.jsonl", b"of an earlier replay");
        let run = |more: &[&Path]| {
            let mut command = Command::new(env!("CARGO_BIN_EXE_ecod-node"));
            command
                .arg("replay")
                .arg("--input")
                .arg(&log)
                .arg("--output")
                .arg(&output)
                .args(more);
            let run = command.output().unwrap();
            (
                run.status.code().unwrap(),
                String::from_utf8(run.stderr).unwrap(),
            )
        };
        let (code, said) = run(&[]);
        assert!(
            code == 2 && said.contains(why) && said.contains("--config"),
            "{code} {said}"
        );
        assert_eq!(std::fs::read(&output).unwrap(), b"of an earlier replay");
        let (code, said) = run(&[Path::new("--config"), &config]);
        assert!(
            code == 0 && said.contains(why) && said.contains("2 lines, 2 used"),
            "{code} {said}"
        );
    }
}

#[test]
fn one_log_is_chosen() {
    let folder = TempDir::new().unwrap();
    let logs = TempDir::new().unwrap();
    let [run, other_run] = [1, 2].map(|number| uuid::Uuid::from_u128(number).to_string());
    file(&logs, "edge-1.mcap", &log_with(&[("node", "edge")]));
    file(&logs, "gauss-1.mcap", &log_with(&[("run", &run)]));
    file(&logs, "gauss-2.mcap", &log_with(&[("run", &other_run)]));
    let ecod = |command: &str, input: &str, output: &str, more: &[&str]| {
        let output = file(&folder, output, b"of before");
        let mut run = Command::new(env!("CARGO_BIN_EXE_ecod-node"));
        run.arg(command)
            .args(input.split_whitespace())
            .arg(logs.path())
            .arg("--output")
            .arg(&output)
            .args(more);
        let run = run.output().unwrap();
        let said = String::from_utf8(run.stderr).unwrap();
        (
            run.status.code().unwrap(),
            said,
            std::fs::read_to_string(&output).unwrap(),
        )
    };
    for (command, input, output) in [
        ("replay", "--input", "rounds.jsonl"),
        ("report", "", "report.html"),
    ] {
        let (code, said, written) = ecod(command, input, output, &[]);
        assert!(
            code == 2 && said.contains("several nodes, edge, gauss: choose one by --node"),
            "{code} {said}"
        );
        assert_eq!(written, "of before");
        let (code, said, _) = ecod(command, input, output, &["--node", "euclid"]);
        assert!(
            code == 2 && said.contains("no log of euclid here, but of edge, gauss"),
            "{code} {said}"
        );
        // The two logs hold the same dates.
        let lenient: &[&str] = if command == "replay" {
            &["--max-rejected", "100"]
        } else {
            &[]
        };
        let (code, said, written) = ecod(
            command,
            input,
            output,
            &[&["--node", "gauss"], lenient].concat(),
        );
        assert!(
            code == 0 && !said.contains("edge") && written.contains("gauss"),
            "{code} {said}"
        );
        assert!(command == "report" || said.contains("4 lines"), "{said}");
    }
}

#[test]
fn later_configuration_is_used() {
    let folder = TempDir::new().unwrap();
    let one = file(&folder, "one.mcap", &log(1));
    let run = uuid::Uuid::from_u128(1).to_string();
    let moved = [
        ("run", &*run),
        ("version", "0.0.1"),
        ("landmarks", r#"[{"id":"slot-0","x_m":1.5,"y_m":2.0}]"#),
    ];
    let other = file(&folder, "other.mcap", &log_with(&moved));
    let (_, alone, _) = replay(&[&one]);
    let (_, other_alone, _) = replay(&[&other]);
    let (code, lines, said) = replay(&[&one, &other]);
    assert_eq!((code, lines), (0, alone + other_alone), "{said}");
    assert_eq!(said.matches("2 lines, 2 used").count(), 2, "{said}");
    for part in [
        "other.mcap was written by version 0.0.1",
        "other.mcap is of a run under another configuration",
    ] {
        assert_eq!(said.matches(part).count(), 1, "{said}");
    }
    let same = file(&folder, "same.mcap", &log_with(&[("run", &run)]));
    let (_, _, said) = replay(&[&one, &same]);
    assert!(
        said.contains("4 lines") && !said.contains("another configuration"),
        "{said}"
    );
}

#[test]
fn foreign_file_is_named() {
    let folder = TempDir::new().unwrap();
    let one = file(&folder, "one.mcap", &log(1));
    let lines = file(&folder, "lines.jsonl", b"{}\n");
    let (code, _, said) = replay(&[&one, &lines]);
    assert!(
        code == 2 && said.contains("lines.jsonl is not a log"),
        "{said}"
    );
    let (code, _, said) = replay(&[Path::new("/no/such.mcap")]);
    assert!(code == 2 && said.contains("/no/such.mcap"), "{said}");
    let empty = TempDir::new().unwrap();
    let (code, _, said) = replay(&[empty.path()]);
    assert!(code == 2 && said.contains("no log in"), "{said}");
}

#[test]
fn report_is_one_complete_page() {
    let folder = TempDir::new().unwrap();
    let log = file(&folder, "log.mcap", &log(1));
    let page = folder.path().join("report.html");
    let report = |log: &Path| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_ecod-node"));
        command
            .arg("report")
            .arg(log)
            .arg("-o")
            .arg(&page)
            .output()
            .unwrap()
    };
    let run = report(&log);
    assert!(
        run.status.success(),
        "{}",
        String::from_utf8_lossy(&run.stderr)
    );
    let html = std::fs::read_to_string(&page).unwrap();
    assert!(html.contains("Log of gauss") && html.contains("prefers-color-scheme: dark"));
    assert!(
        ["<script", "src=", "href=", "url("]
            .iter()
            .all(|part| !html.contains(part)),
        "self-contained"
    );
    assert!(String::from_utf8_lossy(&run.stderr).contains("ecod.Tea"));
    let run = report(&file(&folder, "not.mcap", b"{}"));
    assert_eq!(run.status.code(), Some(2));
}

#[test]
fn doctor_reports_by_exit_code() {
    let folder = TempDir::new().unwrap();
    let config = |name: &str, more: &str| {
        let text = format!(
            "role = \"edge\"\nlisten = \"127.0.0.1:0\"\n{more}\n[membership]\nbind = \"127.0.0.1:0\"\nmulticast.enabled = false\n"
        );
        file(&folder, name, text.as_bytes())
    };
    let doctor = |config: &Path, json: bool| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_ecod-node"));
        command
            .arg("doctor")
            .arg("--config")
            .arg(config)
            .args(json.then_some("--json"))
            .output()
            .unwrap()
    };
    let sound = doctor(&config("sound.toml", ""), false);
    let text = String::from_utf8_lossy(&sound.stdout).into_owned();
    assert!(
        sound.status.success() && text.contains("ok    broker port"),
        "{text}"
    );
    let broken = doctor(
        &config("broken.toml", "state_dir = \"/proc/no/such\""),
        true,
    );
    assert_eq!(broken.status.code(), Some(1));
    let findings: serde_json::Value = serde_json::from_slice(&broken.stdout).unwrap();
    let state = findings
        .as_array()
        .unwrap()
        .iter()
        .find(|finding| finding["check"] == "state directory")
        .unwrap();
    assert_eq!(state["verdict"], "broken");
    assert!(state["fix"].as_str().unwrap().contains("state_dir"));
    assert_eq!(
        doctor(&config("typo.toml", "stat_dir = \"x\""), false)
            .status
            .code(),
        Some(2)
    );
}
