//! `ecod-lab eval`, and `ecod-lab testbed` of an intersection, as programs.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use ecod::replay::{FusedLine, Replay, ReplayConfig, Summary};
use ecod_actors::cli::cell;
use ecod_testkit::{example, stderr};
use serde_json::Value;
use tempfile::TempDir;

fn ecod_lab(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_ecod-lab"))
        .args(arguments)
        .output()
        .unwrap()
}

/// `ecod-lab eval` of what a cell has published, with further flags.
fn eval(flags: &[&str], truth: &Path, input: &Path, out: &Path) -> Output {
    let files = [
        "--truth",
        text(truth),
        "--input",
        text(input),
        "--out",
        text(out),
    ];
    ecod_lab(&[&["eval"], flags, &files].concat())
}

#[track_caller]
fn succeeded(output: &Output) {
    assert!(output.status.success(), "{}", stderr(output));
}

fn json(path: &Path) -> Value {
    serde_json::from_slice(&fs::read(path).unwrap()).unwrap()
}

fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

/// Output of `ecod-node replay` for a file of reports.
fn replay(config: ReplayConfig, reports: &Path) -> (Vec<FusedLine>, Summary) {
    let mut replay = Replay::new(config);
    let lines = fs::read_to_string(reports).unwrap();
    let mut output: Vec<_> = lines
        .lines()
        .flat_map(|line| replay.line(line.as_bytes()))
        .collect();
    let (rest, summary) = replay.finish();
    output.extend(rest);
    (output, summary)
}

fn write_lines(path: &Path, fused: &[FusedLine]) {
    let lines: Vec<_> = fused
        .iter()
        .map(|line| serde_json::to_string(line).unwrap())
        .collect();
    fs::write(path, lines.join("\n")).unwrap();
}

/// Replays the example and returns the output.
fn replay_lot(folder: &TempDir) -> PathBuf {
    let (fused, _) = replay(
        cell(Some(&example("recordings/lot.toml"))).unwrap(),
        &example("recordings/lot.jsonl"),
    );
    let output = folder.path().join("out.jsonl");
    write_lines(&output, &fused);
    output
}

#[test]
fn replay_is_compared_with_majority() {
    let folder = TempDir::new().unwrap();
    let output = replay_lot(&folder);
    let truth = example("recordings/lot_truth.json");
    let reports = example("recordings/lot.jsonl");
    let config = example("recordings/lot.toml");
    let result = folder.path().join("result.json");
    let run = eval(
        &["--reports", text(&reports), "--config", text(&config)],
        &truth,
        &output,
        &result,
    );
    succeeded(&run);
    let table = String::from_utf8(run.stdout).unwrap();
    assert!(
        ["PACE", "VOTE", "majority %", "euclid", "truth", "recall %"]
            .iter()
            .all(|part| table.contains(part)),
        "{table}"
    );
    let result = json(&result);
    for (algorithm, least) in [("pace", 100.0), ("vote", 75.0)] {
        let scores = &result[algorithm];
        assert_eq!(scores["items"].as_u64(), Some(8));
        assert!(
            scores["accuracy_pct"].as_f64().unwrap() >= least,
            "{scores}"
        );
        assert_eq!(scores["vehicles"].as_object().unwrap().len(), 4);
        assert!(
            scores["vehicles"]["euclid"]["accuracy_pct"]
                .as_f64()
                .unwrap()
                < 100.0
        );
    }
}

#[test]
fn moving_objects_use_past_positions() {
    let folder = TempDir::new().unwrap();
    let recorded = |name: &str| {
        Path::new(concat!(
            env!("CARGO_MANIFEST_DIR"),
            "/tests/accuracy/eval_tracks"
        ))
        .join(name)
    };
    let truth = recorded("truth.json");
    let maps = recorded("maps.jsonl");
    let result = folder.path().join("result.json");
    let run = eval(&[], &truth, &maps, &result);
    succeeded(&run);
    let table = String::from_utf8(run.stdout).unwrap();
    assert!(
        [
            "AP@0.5 %",
            "AP@4 %",
            "bicycle",
            "MODA %",
            "HOTA %",
            "switches",
            "fragments",
            "calibration error %"
        ]
        .iter()
        .all(|p| table.contains(p)),
        "{table}"
    );
    let result = json(&result);
    let ap_pct = result["tracks"]["ap_pct"].as_array().unwrap();
    assert!(
        ap_pct.len() == 4
            && ap_pct
                .iter()
                .all(|ap| ap.as_f64().is_some_and(|ap| ap > 10.0)),
        "{result}"
    );
    let broken = folder.path().join("broken.json");
    fs::write(
        &broken,
        r#"{"frames": [{"t_us": 1, "objects": [{"id": 1, "label": "car", "x_m": 0}]}]}"#,
    )
    .unwrap();
    let run = ecod_lab(&["eval", "--truth", text(&broken), "--input", text(&maps)]);
    assert_eq!(run.status.code(), Some(2));
    assert!(
        stderr(&run).contains("broken.json: at frames[0].objects[0]: missing field `y_m`"),
        "{}",
        stderr(&run)
    );
}

/// Two cars in four frames of KITTI: the tracker loses one and calls the other by two names.
#[test]
fn benchmark_file_errors_name_line() {
    let folder = TempDir::new().unwrap();
    let line = |frame: u32, track: u32, x: f64, z: f64, score: &str| {
        format!("{frame} {track} Car 0 0 -1 0 0 9 9 1.5 1.6 3.9 {x} 1.7 {z} 0 {score}\n")
    };
    let write = |name: &str, content: String| {
        let path = folder.path().join(name);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(&path, content).unwrap();
        path
    };
    let truth = (0..4)
        .map(|n| line(n, 1, 2.0, 10.0 + f64::from(n), "") + &line(n, 2, -8.0, 30.0, ""))
        .collect();
    let said = (0..4)
        .map(|n| line(n, 5 + n / 2, 2.0, 10.0 + f64::from(n), "0.9"))
        .collect();
    let truth = write("truth/0001.txt", truth);
    write("truth/0002.txt", line(0, 1, 0.0, 5.0, ""));
    let said = write("said/0001.txt", said);
    let result = folder.path().join("result.json");
    for (truth, input) in [
        (&truth, &said),
        (&folder.path().join("truth"), &folder.path().join("said")),
    ] {
        let run = eval(&["--format", "kitti"], truth, input, &result);
        succeeded(&run);
        let result = json(&result);
        let tracks = &result["tracks"];
        let at = &tracks["at_default"];
        assert_eq!(
            (tracks["frames"].as_u64(), tracks["objects"].as_u64()),
            (Some(4), Some(8))
        );
        assert_eq!(
            (
                at["matches"].as_u64(),
                at["misses"].as_u64(),
                at["id_switches"].as_u64()
            ),
            (Some(4), Some(4), Some(1))
        );
        assert_eq!(at["mota_pct"].as_f64(), Some(37.5));
    }
    let detections: String = (0..4)
        .map(|n| format!("{n},2,0,0,9,9,8.5,1.5,1.6,3.9,-8.0,1.7,30.0,0,0\n"))
        .collect();
    let run = |input: &Path| eval(&["--format", "kitti"], &truth, input, &result);
    assert!(run(&write("detections.txt", detections)).status.success());
    let broken = run(&write(
        "broken.txt",
        "0,2,0,0,9,9,8.5,1.5,1.6,3.9,x,1.7,30.0,0,0\n".into(),
    ));
    assert_eq!(broken.status.code(), Some(2));
    assert!(
        stderr(&broken).contains("broken.txt: line 1: column 11 (x): \"x\" is no number"),
        "{}",
        stderr(&broken)
    );
}

/// Two cameras detect a person; a replay of their reports has one.
#[test]
fn benchmark_detections_become_reports() {
    let folder = TempDir::new().unwrap();
    let file = |name: &str, content: String| {
        let path = folder.path().join(name);
        fs::write(&path, content).unwrap();
        path
    };
    let each = |line: &str| (1..=30).map(|frame| format!("{frame},{line}\n")).collect();
    let left = file("left.txt", each("-1,0,0,9,9,0.9,3.1,4,0"));
    let right = file("right.txt", each("-1,0,0,9,9,0.8,2.9,4,0"));
    let truth = file("truth.txt", each("1,0,0,9,9,1,3,4,0"));
    let [reports, maps, result] =
        ["reports.jsonl", "maps.jsonl", "result.json"].map(|name| folder.path().join(name));
    let right = format!("right={}", text(&right));
    let convert = |left: &str| {
        let vehicles = ["--vehicle", left, "--vehicle", &right];
        ecod_lab(
            &[
                &["convert", "--format", "mot", "--output", text(&reports)][..],
                &vehicles,
            ]
            .concat(),
        )
    };
    let run = convert(&format!("left={}", text(&left)));
    succeeded(&run);
    let (fused, summary) = replay(ReplayConfig::default(), &reports);
    assert_eq!((summary.lines, summary.used()), (60, 60));
    write_lines(&maps, &fused);
    assert!(
        eval(&["--format", "mot"], &truth, &maps, &result)
            .status
            .success()
    );
    let result = json(&result);
    let at = &result["tracks"]["at_best_f1"];
    assert_eq!(
        (
            at["false_alarms"].as_u64(),
            at["misses"].as_u64().map(|n| n < 10)
        ),
        (Some(0), Some(true)),
        "{at}"
    );
    let broken = convert(text(&left));
    assert!(
        broken.status.code() == Some(2) && stderr(&broken).contains("is not NAME=FILE"),
        "{}",
        stderr(&broken)
    );
}

/// Two vehicles, one of which detects nothing in the first sequence, and truth of one sequence more.
#[test]
fn sequences_match_names_and_truth() {
    let folder = TempDir::new().unwrap();
    let path = |name: &str| folder.path().join(name);
    let each = |place: &str| {
        (1..=20)
            .map(|frame| format!("{frame},1,0,0,9,9,0.9,{place},0\n"))
            .collect::<String>()
    };
    for (name, place) in [
        ("left/a.txt", "3,4"),
        ("left/b.txt", "5,6"),
        ("right/b.txt", "5,6"),
        ("truth/a.txt", "3,4"),
        ("truth/b.txt", "5,6"),
        ("more/a.txt", "3,4"),
        ("more/aa.txt", "9,9"),
        ("more/b.txt", "5,6"),
    ] {
        fs::create_dir_all(path(name).parent().unwrap()).unwrap();
        fs::write(path(name), each(place)).unwrap();
    }
    let [reports, maps, result] = ["reports.jsonl", "maps.jsonl", "result.json"].map(path);
    let [left, right] = ["left", "right"].map(|name| format!("{name}={}", text(&path(name))));
    let flags = [
        "convert",
        "--format",
        "mot",
        "--vehicle",
        &left,
        "--vehicle",
        &right,
        "--output",
        text(&reports),
    ];
    let run = ecod_lab(&flags);
    succeeded(&run);
    write_lines(&maps, &replay(ReplayConfig::default(), &reports).0);
    let judge = |truth: &Path| eval(&["--format", "mot"], truth, &maps, &result);
    let run = judge(&path("truth"));
    succeeded(&run);
    let judged = json(&result);
    assert_eq!(
        judged["tracks"]["at_best_f1"]["false_alarms"].as_u64(),
        Some(0),
        "{judged}"
    );
    let over = text(&path("left/a.txt")).to_owned();
    for (flags, fault) in [
        (
            [
                "--vehicle",
                &left,
                "--vehicle",
                &left,
                "--output",
                text(&reports),
            ],
            "names left twice",
        ),
        (
            ["--vehicle", &left, "--vehicle", &right, "--output", &over],
            "a.txt is both input and output; choose another output file",
        ),
    ] {
        let run = ecod_lab(&[&["convert", "--format", "mot"][..], &flags].concat());
        assert!(
            run.status.code() == Some(2) && stderr(&run).contains(fault),
            "{}",
            stderr(&run)
        );
    }
    let run = judge(&path("more"));
    assert!(
        run.status.code() == Some(2) && stderr(&run).contains("has 3 sequences"),
        "{}",
        stderr(&run)
    );
}

#[test]
fn truth_without_identities_judges_none() {
    let folder = TempDir::new().unwrap();
    let truth = folder.path().join("truth.txt");
    let maps = folder.path().join("maps.txt");
    let result = folder.path().join("result.json");
    fs::write(&truth, "1,-1,0,0,9,9,1,3,4,0\n2,-1,0,0,9,9,1,3,4,0\n").unwrap();
    fs::write(&maps, "1,4,0,0,9,9,1,3,4,0\n2,4,0,0,9,9,1,3,5,0\n").unwrap();
    let run = eval(&["--format", "mot"], &truth, &maps, &result);
    succeeded(&run);
    let result = json(&result);
    let at = &result["tracks"]["at_default"];
    assert_eq!(
        (at["moda_pct"].as_f64(), at["motp_m"].as_f64()),
        (Some(100.0), Some(0.5))
    );
    assert!(
        ["mota_pct", "idf1_pct", "hota_pct"]
            .iter()
            .all(|figure| at[figure].is_null()),
        "{at}"
    );
}

#[test]
fn recorded_intersection_is_judged_right() {
    let folder = TempDir::new().unwrap();
    let scenes = example("testbed/vote_recording.json");
    let out = folder.path().join("result.json");
    let reports = folder.path().join("reports.jsonl");
    let run = ecod_lab(&[
        "testbed",
        "--scenes",
        text(&scenes),
        "--generated",
        "3",
        "--out",
        text(&out),
        "--reports",
        text(&reports),
    ]);
    succeeded(&run);
    let result = json(&out);
    let recording = &result["scenes"][0];
    assert_eq!(
        (
            recording["verdicts"].as_u64(),
            recording["vote_accuracy_pct"].as_f64()
        ),
        (Some(9), Some(100.0))
    );
    assert_eq!(result["scenes"][1]["scenes"].as_u64(), Some(3));
    let (_, summary) = replay(ReplayConfig::default(), &reports);
    assert_eq!((summary.lines, summary.used()), (12, 12));
}

#[test]
fn silent_vehicles_spoil_no_intersection() {
    let folder = TempDir::new().unwrap();
    let recorded = fs::read_to_string(example("testbed/vote_recording.json")).unwrap();
    let mut silent: Value = serde_json::from_str(&recorded).unwrap();
    silent["frames"]["euclid"]
        .as_array_mut()
        .unwrap()
        .truncate(1);
    let renamed = recorded
        .replace("mouse", "remote")
        .replace("\"cup\"", "\"bottle\"");
    for scene in [renamed, silent.to_string()] {
        let scenes = folder.path().join("scenes.json");
        let out = folder.path().join("result.json");
        fs::write(&scenes, scene).unwrap();
        let run = ecod_lab(&[
            "testbed",
            "--scenes",
            text(&scenes),
            "--scene",
            "recording",
            "--out",
            text(&out),
        ]);
        succeeded(&run);
        let result = json(&out);
        assert_eq!(
            result["scenes"][0]["vote_accuracy_pct"].as_f64(),
            Some(100.0),
            "{result}"
        );
    }
}

#[test]
fn unjudgeable_input_is_reported() {
    let folder = TempDir::new().unwrap();
    let file = |name: &str, content: &str| {
        let path = folder.path().join(name);
        fs::write(&path, content).unwrap();
        path
    };
    let recording = file("in.jsonl", "{}\n");
    let truth = file("truth.json", "{\"a\": {}}");
    let empty = file("empty.jsonl", "");
    let frames = file(
        "frames.json",
        r#"{"frames": [{"t_us": 9000000, "objects": []}]}"#,
    );
    let map = r#"{"schema": 1, "aggregator": "edge", "epoch": 1, "round": 1, "fused_at_us": 1, "landmarks": [], "objects": []}"#;
    let map = file("map.jsonl", map);
    let unsure = file(
        "unsure.jsonl",
        r#"{"schema": 1, "aggregator": "edge", "epoch": 1, "round": 1, "fused_at_us": 1, "landmarks": [], "objects": [
            {"id": "018f0000-0000-7000-8000-000000000000", "label": "car", "x_m": 0, "y_m": 0,
             "covariance_m2": [1, 0, 1], "confidence": 1.5, "contributors": []}]}"#
            .replace('\n', "")
            .as_str(),
    );
    let lot = example("recordings/lot_truth.json");
    for (truth, input, code, part) in [
        (Path::new("/no.json"), &recording, 2, "/no.json"),
        (&truth, &recording, 2, "`a` has {}"),
        (&lot, &empty, 1, "no map"),
        (&lot, &unsure, 1, "the first is line 1: objects[0]: "),
        (&frames, &map, 1, "no map of "),
        (
            &lot,
            &recording,
            1,
            "1 lines cannot be used, the first is line 1: it is neither a map nor verdicts",
        ),
    ] {
        let run = ecod_lab(&["eval", "--truth", text(truth), "--input", text(input)]);
        assert_eq!(run.status.code(), Some(code), "{truth:?}: {}", stderr(&run));
        assert!(stderr(&run).contains(part), "{truth:?}: {}", stderr(&run));
    }
}

/// A method of one's own beside ECOD, by the template in the manual.
#[test]
fn methods_share_one_table() {
    let folder = TempDir::new().unwrap();
    let own = folder.path().join("own.jsonl");
    let table = folder.path().join("table");
    let fusion = Command::new("python3")
        .arg(example("own_fusion.py"))
        .stdin(fs::File::open(example("recordings/lot.jsonl")).unwrap())
        .stdout(fs::File::create(&own).unwrap())
        .status()
        .unwrap();
    assert!(fusion.success());
    let ecod = replay_lot(&folder);
    let inputs = [
        format!("--input=ecod={}", text(&ecod)),
        format!("--input=own={}", text(&own)),
        format!("--input=own={}", text(&own)),
    ];
    for (ending, part) in [
        ("csv", "method,file,accuracy %"),
        ("tex", "own, PACE & 2 & "),
        ("json", "\"method\": \"ecod, VOTE\""),
    ] {
        let file = table.with_extension(ending);
        let run = ecod_lab(&[
            "eval",
            "--truth",
            text(&example("recordings/lot_truth.json")),
            &inputs[0],
            &inputs[1],
            &inputs[2],
            "--output",
            text(&file),
        ]);
        succeeded(&run);
        let printed = String::from_utf8(run.stdout).unwrap();
        let row = |method: &str| printed.lines().find(|line| line.starts_with(method));
        assert!(row("ecod, PACE").unwrap().contains("100.00"), "{printed}");
        assert!(row("own, PACE").unwrap().contains(" ± 0.00"), "{printed}");
        let written = fs::read_to_string(&file).unwrap();
        assert!(written.contains(part), "{written}");
    }
}

#[test]
fn missing_output_field_is_named() {
    let folder = TempDir::new().unwrap();
    let input = folder.path().join("own.jsonl");
    let map = r#"{"schema":1,"aggregator":"own","epoch":1,"round":1,"fused_at_us":1,"landmarks":[],
        "objects":[{"id":"67e55044-10b1-426f-9247-bb680e5fe0c8","label":"car","confidence":1}]}"#;
    fs::write(&input, map.replace('\n', "")).unwrap();
    let run = ecod_lab(&[
        "eval",
        "--truth",
        text(&example("recordings/lot_truth.json")),
        "--input",
        text(&input),
    ]);
    assert!(!run.status.success());
    let error = stderr(&run);
    assert!(
        error.contains("verdicts: objects[0]: missing field `x_m`"),
        "{error}"
    );
}
