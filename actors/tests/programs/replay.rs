//! `ecod-node replay` as a program.

use std::fs;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};

use ecod_testkit::{example, stderr};
use serde_json::Value;
use tempfile::TempDir;

fn ecod(arguments: &[&str]) -> Output {
    ecod_with_input(arguments, b"")
}

fn ecod_with_input(arguments: &[&str], input: &[u8]) -> Output {
    let mut child = Command::new(env!("CARGO_BIN_EXE_ecod-node"))
        .args(arguments)
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let mut stdin = child.stdin.take().unwrap();
    let input = input.to_vec();
    let writer = std::thread::spawn(move || drop(stdin.write_all(&input)));
    let output = child.wait_with_output().unwrap();
    writer.join().unwrap();
    output
}

fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

/// Replays the example and returns the output.
fn replay_lot(folder: &TempDir, name: &str) -> PathBuf {
    let config = example("recordings/lot.toml");
    let input = example("recordings/lot.jsonl");
    let output = folder.path().join(name);
    let arguments = [
        "replay",
        "--config",
        text(&config),
        "--input",
        text(&input),
        "--output",
        text(&output),
    ];
    let run = ecod(&arguments);
    assert!(run.status.success(), "{}", stderr(&run));
    assert!(
        stderr(&run).starts_with("96 lines, 96 used, "),
        "{}",
        stderr(&run)
    );
    output
}

#[test]
fn equal_inputs_give_equal_bytes() {
    let folder = TempDir::new().unwrap();
    let first = replay_lot(&folder, "1.jsonl");
    let second = replay_lot(&folder, "2.jsonl");
    let bytes = fs::read(first).unwrap();
    assert!(!bytes.is_empty());
    assert!(bytes == fs::read(second).unwrap());
    let config = example("recordings/lot.toml");
    let recording = fs::read(example("recordings/lot.jsonl")).unwrap();
    let arguments = [
        "replay",
        "--config",
        text(&config),
        "--input",
        "-",
        "--output",
        "-",
    ];
    assert!(ecod_with_input(&arguments, &recording).stdout == bytes);
}

#[test]
fn unusable_lines_count_by_reason() {
    let recording = fs::read(example("recordings/lot.jsonl")).unwrap();
    let first = recording.split(|byte| *byte == b'\n').next().unwrap();
    let mut input = first.to_vec();
    input.extend_from_slice(b"\r\n\nnonsense\n\xff\xfe\n");
    input.extend(std::iter::repeat_n(b'x', 5 << 20));
    input.push(b'\n');
    input.extend_from_slice(first);
    input.push(b'\n');
    input.extend_from_slice(&first[..first.len() / 2]);
    for (most, code) in [("82", 3), ("84", 0)] {
        let run = ecod_with_input(
            &[
                "replay",
                "--input",
                "-",
                "--output",
                "-",
                "--max-rejected",
                most,
            ],
            &input,
        );
        assert_eq!(run.status.code(), Some(code));
        let error = stderr(&run);
        for part in [
            "6 lines, 1 used, 1 written",
            "rejected malformed 3\n  line 3: is no JSON object\n  line 4: is no JSON object\n  line 7: ",
            "rejected too_large 1\n  line 5: is longer than",
            "rejected out_of_order 1\n  line 6: captured_at_us: is not later than in an earlier line of this node",
        ] {
            assert!(error.contains(part), "{error}");
        }
        assert_eq!(
            error.contains("5 of 6 reports were rejected, more than 82 % (--max-rejected)"),
            code == 3,
            "{error}"
        );
        assert_eq!(run.stdout.iter().filter(|byte| **byte == b'\n').count(), 1);
    }
}

/// A vote that names its landmark needs no position. A detection needs one: the error names the field, and a replay
/// without any used report fails.
#[test]
fn named_votes_need_no_positions() {
    let line = |topic: &str| {
        let object = r#"{"label":"cup","confidence":0.9,"landmark":"table"}"#;
        let report = format!(
            r#""schema":1,"node":"v1","seq":1,"captured_at_us":1700000000000000,"objects":[{object}]"#
        );
        format!("{{{report},\"topic\":\"{topic}\"}}\n")
    };
    let run = |topic: &str| {
        ecod_with_input(
            &["replay", "--input", "-", "--output", "-"],
            line(topic).as_bytes(),
        )
    };
    let votes = run("vote_detections");
    assert!(
        votes.status.success() && stderr(&votes).contains("1 lines, 1 used"),
        "{}",
        stderr(&votes)
    );
    assert!(String::from_utf8_lossy(&votes.stdout).contains(r#""landmark":"table","label":"cup""#));
    let detections = run("detections");
    assert_eq!(detections.status.code(), Some(3));
    assert!(
        stderr(&detections).contains("line 1: objects[0]: missing field `x_m`"),
        "{}",
        stderr(&detections)
    );
}

/// Votes for landmarks that the configuration does not have, and positions in centimetres, are readable and have no
/// effect.
#[test]
fn reports_without_effect_fail() {
    let folder = TempDir::new().unwrap();
    let cell = folder.path().join("cell.toml");
    fs::write(&cell, "[[landmarks]]\nid = \"table\"\nx_m = 3\ny_m = 0\n").unwrap();
    let vote = |landmark: &str, vehicle_m: u32| {
        let pose = format!(r#""pose":{{"x_m":{vehicle_m},"y_m":0,"heading_rad":0}}"#);
        let object = format!(
            r#"{{"label":"cup","confidence":0.9,"x_m":3,"y_m":0,"landmark":"{landmark}"}}"#
        );
        format!(r#"{pose},"topic":"vote_detections","objects":[{object}]"#)
    };
    let detection =
        |x_m: u32| format!(r#""objects":[{{"label":"cup","confidence":0.9,"x_m":{x_m},"y_m":0}}]"#);
    let no_vote = "1 of 1 votes do not count";
    let no_object = "no report has an object at a known location";
    for (report, problem) in [
        (vote("table", 0), None),
        (vote("tabel", 0), Some(no_vote)),
        (vote("table", 300), Some(no_vote)),
        (detection(3), None),
        (detection(300), Some(no_object)),
    ] {
        let line = format!(
            r#"{{"schema":1,"node":"v1","seq":1,"captured_at_us":1700000000000000,{report}}}"#
        );
        let arguments = [
            "replay",
            "--config",
            text(&cell),
            "--input",
            "-",
            "--output",
            "-",
        ];
        let run = ecod_with_input(&arguments, line.as_bytes());
        assert_eq!(
            run.status.code(),
            Some(if problem.is_some() { 3 } else { 0 }),
            "{report}: {}",
            stderr(&run)
        );
        assert!(
            problem.is_none_or(|problem| stderr(&run).contains(problem)),
            "{report}: {}",
            stderr(&run)
        );
    }
}

#[test]
fn input_without_recording_fails() {
    let folder = TempDir::new().unwrap();
    let readme = folder.path().join("README.md");
    let empty = folder.path().join("empty.jsonl");
    fs::write(&readme, "# A title\n\nSome text.\n").unwrap();
    fs::write(&empty, "").unwrap();
    for input in [&readme, &empty] {
        let run = ecod(&[
            "replay",
            "--input",
            text(input),
            "--output",
            "-",
            "--max-rejected",
            "100",
        ]);
        assert!(
            run.status.code() == Some(3) && run.stdout.is_empty(),
            "{}",
            stderr(&run)
        );
        assert!(
            stderr(&run).contains("no report could be used"),
            "{}",
            stderr(&run)
        );
    }
}

#[test]
fn foreign_time_units_are_reported() {
    let line = |unit: u64| {
        let times = (0..3).map(|n| 1_732_154_400_000_000 / unit + n);
        let lines = times.map(|at| {
            format!(
                "{{\"schema\":1,\"node\":\"a\",\"seq\":1,\"captured_at_us\":{at},\"objects\":[]}}\n"
            )
        });
        stderr(&ecod_with_input(
            &["replay", "--input", "-", "--output", "-"],
            lines.collect::<String>().as_bytes(),
        ))
    };
    assert!(
        line(1000).contains("times look like milliseconds"),
        "{}",
        line(1000)
    );
    assert!(line(1_000_000).contains("times look like seconds"));
    assert!(!line(1).contains("times look like"));
}

#[test]
fn passes_write_one_verdict_set() {
    let input = example("recordings/lot.jsonl");
    let run = ecod(&[
        "replay",
        "--input",
        text(&input),
        "--output",
        "-",
        "--passes",
        "4",
    ]);
    assert!(
        run.status.success() && stderr(&run).contains("rejected not_fused 48"),
        "{}",
        stderr(&run)
    );
    let lines: Vec<Value> = run
        .stdout
        .split(|b| *b == b'\n')
        .filter(|l| !l.is_empty())
        .map(|l| serde_json::from_slice(l).unwrap())
        .collect();
    assert_eq!(lines.len(), 1);
    assert_eq!(lines[0]["verdicts"].as_array().unwrap().len(), 8);
}

#[test]
fn impossible_request_changes_no_file() {
    let folder = TempDir::new().unwrap();
    let file = |name: &str, content: &str| {
        let path = folder.path().join(name);
        fs::write(&path, content).unwrap();
        path
    };
    let recording = file("in.jsonl", "{}\n");
    let typo = file("typo.toml", "[fusion.pace]\ngat_m = 1\n");
    let fusion = file("fusion.toml", "[fusion]\n");
    let fusion = text(&fusion);
    let out = folder.path().join("out.jsonl");
    let recording = text(&recording);
    let out = text(&out);
    for (arguments, code, part) in [
        (
            vec!["replay", "--input", "/no/such.jsonl", "--output", out],
            2,
            "/no/such.jsonl",
        ),
        (
            vec!["replay", "--input", "/", "--output", out],
            2,
            "directory",
        ),
        (
            vec!["replay", "--input", recording, "--output", recording],
            2,
            "is both input and output",
        ),
        (
            vec![
                "replay", "--config", fusion, "--input", recording, "--output", fusion,
            ],
            2,
            "is both input and output",
        ),
        (
            vec![
                "replay",
                "--input",
                recording,
                "--output",
                "/no/such/dir.jsonl",
            ],
            2,
            "/no/such/dir.jsonl",
        ),
        (
            vec![
                "replay",
                "--config",
                text(&typo),
                "--input",
                recording,
                "--output",
                out,
            ],
            2,
            "fusion.pace.gat_m",
        ),
        (
            vec![
                "replay", "--config", "/no.toml", "--input", recording, "--output", out,
            ],
            2,
            "/no.toml",
        ),
        (
            vec![
                "replay", "--input", recording, "--output", out, "--passes", "0",
            ],
            2,
            "--passes",
        ),
    ] {
        let run = ecod(&arguments);
        assert_eq!(
            run.status.code(),
            Some(code),
            "{arguments:?}: {}",
            stderr(&run)
        );
        assert!(
            stderr(&run).contains(part),
            "{arguments:?}: {}",
            stderr(&run)
        );
    }
    assert_eq!(fs::read_to_string(recording).unwrap(), "{}\n");
    assert!(!Path::new(out).exists());
}
