//! `ecod-lab report`: content of the page about a log.

use std::collections::BTreeMap;
use std::fs::File;
use std::path::Path;
use std::process::Command;

use ecod::replay::ReplayConfig;
use mcap::records::{MessageHeader, Metadata};
use mcap::{WriteOptions, Writer};
use serde_json::{Value, json};

/// 2024-11-21 02:00:00 UTC, in microseconds.
const BEGIN_US: u64 = 1_732_154_400_000_000;

/// A log of the node hertz.
struct Log {
    writer: Writer<File>,
    channels: BTreeMap<String, u16>,
}

impl Log {
    fn begin(path: &Path, run: u128) -> Self {
        let mut writer: Writer<_> = WriteOptions::new()
            .create(File::create(path).unwrap())
            .unwrap();
        let fusion = serde_json::to_string(&ReplayConfig::default().fusion).unwrap();
        let run = uuid::Uuid::from_u128(run).to_string();
        let metadata = [
            ("log", "1"),
            ("node", "hertz"),
            ("cell", "lot"),
            ("run", &run),
            ("version", "0.1.0"),
            ("fusion", &fusion),
            (
                "landmarks",
                r#"[{"id":"a","x_m":0.0,"y_m":0.0},{"id":"b","x_m":3.0,"y_m":0.0}]"#,
            ),
        ];
        let metadata: BTreeMap<_, _> = metadata
            .map(|(key, value)| (key.to_owned(), value.to_owned()))
            .into();
        writer
            .write_metadata(&Metadata {
                name: "ecod.log".into(),
                metadata,
            })
            .unwrap();
        Self {
            writer,
            channels: BTreeMap::new(),
        }
    }

    fn put(&mut self, schema: &str, topic: &str, at_us: u64, message: &Value) {
        let channel_id = *self.channels.entry(topic.to_owned()).or_insert_with(|| {
            let schema = self.writer.add_schema(schema, "jsonschema", b"{}").unwrap();
            self.writer
                .add_channel(schema, topic, "json", &BTreeMap::new())
                .unwrap()
        });
        let header = MessageHeader {
            channel_id,
            sequence: 0,
            log_time: at_us * 1000,
            publish_time: at_us * 1000,
        };
        self.writer
            .write_to_known_channel(&header, message.to_string().as_bytes())
            .unwrap();
    }

    fn counters(&mut self, at_us: u64, inbox_full: u64, record_failed: u64) {
        let reading = json!({ "node": "hertz", "at_us": at_us, "shed": {},
            "events": { "inbox_full": inbox_full, "record_failed": record_failed, "published": 900 },
            "rejects": { "out_of_order": 50, "stale": 2 } });
        self.put("ecod.Counters", "node/counters", at_us, &reading);
    }

    fn finish(mut self) {
        self.writer.finish().unwrap();
    }
}

/// Runs `ecod-lab report` and returns the page.
fn page(logs: &[&Path], truth: &str) -> String {
    let folder = tempfile::tempdir().unwrap();
    let [truth_file, page] = ["truth.json", "report.html"].map(|name| folder.path().join(name));
    std::fs::write(&truth_file, truth).unwrap();
    let mut command = Command::new(env!("CARGO_BIN_EXE_ecod-lab"));
    let run = command
        .arg("report")
        .args(logs)
        .arg("--truth")
        .arg(&truth_file)
        .arg("-o")
        .arg(&page)
        .output()
        .unwrap();
    assert!(
        run.status.success() && run.stderr.is_empty(),
        "{}",
        String::from_utf8_lossy(&run.stderr)
    );
    std::fs::read_to_string(&page).unwrap()
}

fn assert_row(html: &str, cells: &[&str]) {
    let row: String = cells
        .iter()
        .map(|cell| format!("<td>{cell}</td>"))
        .collect();
    assert!(html.contains(&row), "{cells:?} not in {html}");
}

/// Ten seconds of a cell that euclid and gauss report to: a round every 100 ms, 20 ms after the oldest capture and 5 ms
/// on its way, by the edge until it is lost, and from 400 ms later by gauss.
fn write_log(path: &Path) {
    let mut log = Log::begin(path, 1);
    log.counters(BEGIN_US, 3, 0);
    for round in 0..100 {
        let (leader, epoch, lost_us) = if round < 50 {
            ("edge", 4, 0)
        } else {
            ("gauss", 5, 300_000)
        };
        let at_us = BEGIN_US + round * 100_000 + lost_us;
        let fused_at_us = at_us - 5000;
        for vehicle in ["euclid", "gauss"] {
            let report = json!({ "schema": 1, "node": vehicle, "seq": round, "captured_at_us": at_us - 25_000,
                "objects": [{ "label": "car", "confidence": 0.9, "x_m": 0.0, "y_m": 0.0, "landmark": "a" }] });
            log.put(
                "ecod.ObjectReport",
                &format!("detections/{vehicle}"),
                at_us - 10_000,
                &report,
            );
        }
        let entry = |id: &str, x_m: f64, contributors: &[&str]| json!({ "id": id, "label": "car", "confidence": 0.9, "x_m": x_m, "y_m": 0.0, "contributors": contributors });
        let landmarks = [
            entry("a", 0.0, &["euclid", "gauss"]),
            entry("b", 3.0, &["euclid"]),
        ];
        let map = json!({ "schema": 1, "aggregator": leader, "epoch": epoch, "round": round, "fused_at_us": fused_at_us,
            "oldest_capture_us": at_us - 25_000, "landmarks": landmarks, "objects": [] });
        log.put("ecod.GlobalMap", "global_detections", at_us, &map);
        let verdicts = json!({ "schema": 1, "aggregator": leader, "epoch": epoch, "round": round,
            "fused_at_us": fused_at_us, "verdicts": [{ "landmark": "a", "label": "car", "score": 1.0, "margin": 1.0,
                "votes": { "car": 1.0 }, "contributors": ["euclid", "gauss"] }] });
        log.put("ecod.Verdicts", "global_verdicts", at_us, &verdicts);
        let score = 0.5 + round as f64 / 250.0;
        let reputations = json!({ "schema": 1, "aggregator": leader, "epoch": epoch, "round": round,
            "reputations": { "euclid": { "score": score, "correct": round, "incorrect": 0 } } });
        log.put("ecod.Reputations", "reputations", at_us, &reputations);
    }
    let end_us = BEGIN_US + 10_300_000;
    log.counters(end_us, 10, 0);
    log.finish();
}

#[test]
fn report_covers_leaders_delays_and_losses() {
    let folder = tempfile::tempdir().unwrap();
    let [log, later] = ["log.mcap", "later.mcap"].map(|name| folder.path().join(name));
    write_log(&log);
    let mut restarted = Log::begin(&later, 2);
    restarted.counters(BEGIN_US + 11_000_000, 4, 0);
    restarted.counters(BEGIN_US + 12_000_000, 5, 2);
    restarted.finish();
    let html = page(
        &[&log, &later],
        r#"{"landmarks": {"a": "car", "b": "truck"}}"#,
    );
    let row = |cells: &[&str]| assert_row(&html, cells);
    row(&["PACE", "100", "2", "50.0"]);
    row(&["edge", "4", "2024-11-21 02:00:00.000", "4.9", "50"]);
    row(&["gauss", "5", "2024-11-21 02:00:05.300", "4.9", "50"]);
    row(&[
        "maps: from the oldest frame in a map to the map",
        "100",
        "20.0",
        "20.0",
        "20.0",
        "20.0",
    ]);
    row(&[
        "maps: from the leader to this node",
        "100",
        "5.0",
        "5.0",
        "5.0",
        "5.0",
    ]);
    row(&["verdicts", "99", "100.0", "100.0", "100.0", "400.0"]);
    row(&["euclid", "0.896"]);
    row(&["euclid", "100", "9.7", "1.0", "200"]);
    row(&["gauss", "100", "9.7", "1.0", "100"]);
    row(&["inbox full", "12"]);
    row(&["record failed", "2"]);
    row(&["stale", "2"]);
    assert!(
        !html.contains("<td>out of order</td>") && !html.contains("<td>published</td>"),
        "not lost"
    );
    for plot in [
        "latency distribution",
        "time between rounds",
        "reputations",
        "coverage per vehicle",
        "drops",
    ] {
        assert!(
            html.contains(&format!("aria-label=\"{plot}\"")),
            "no plot of {plot}"
        );
    }
    assert!(
        html.contains("50.0 %") && html.contains("100.0 %"),
        "what rests on whom"
    );
}

/// A cell without known locations: what its maps rest on, and how right they are, is that of their objects.
#[test]
fn open_world_report_covers_objects() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("log.mcap");
    let mut log = Log::begin(&path, 1);
    let mut frames = Vec::new();
    for round in 0..20 {
        let at_us = BEGIN_US + round * 100_000;
        let right = round as f64;
        let wrong = 40.0;
        let object = |id: u128, label: &str, x_m: f64, contributors: &[&str]| {
            json!({ "id": uuid::Uuid::from_u128(id), "label": label, "confidence": 0.9, "x_m": x_m, "y_m": 0.0,
                "covariance_m2": [0.1, 0.0, 0.1], "contributors": contributors })
        };
        let objects = [
            object(1, "car", right, &["euclid", "gauss"]),
            object(2, "car", wrong, &["gauss"]),
        ];
        let map = json!({ "schema": 1, "aggregator": "edge", "epoch": 1, "round": round, "fused_at_us": at_us,
            "oldest_capture_us": at_us - 25_000, "landmarks": [], "objects": objects });
        log.put("ecod.GlobalMap", "global_detections", at_us, &map);
        let car = json!({ "id": "car-1", "label": "car", "x_m": right, "y_m": 0.0 });
        frames.push(json!({ "t_us": at_us, "objects": [car] }));
    }
    log.finish();
    let html = page(&[&path], &json!({ "frames": frames }).to_string());
    assert!(
        html.contains("aria-label=\"coverage per vehicle\"")
            && html.contains("50.0 %")
            && html.contains("100.0 %")
    );
    assert_row(&html, &["euclid", "0", "-", "0.0", "20"]);
    assert_row(&html, &["gauss", "0", "-", "0.0", "40"]);
    assert!(
        html.contains("in 20 frames.") && html.contains("AP@0.5 %") && html.contains("HOTA %"),
        "{html}"
    );
    assert_row(&html, &["all", "20", "40"]);
}

/// The data of map and timeline in a page.
fn timeline(html: &str) -> Value {
    let data = html
        .split_once("id=\"log-data\">")
        .unwrap()
        .1
        .split_once("</script>")
        .unwrap()
        .0;
    serde_json::from_str(data).unwrap()
}

/// A map of a leader.
fn map(leader: &str, epoch: u64, round: u64, fused_at_us: u64) -> Value {
    json!({ "schema": 1, "aggregator": leader, "epoch": epoch, "round": round, "fused_at_us": fused_at_us,
        "landmarks": [], "objects": [] })
}

/// A node that was started again with its clock an hour back, a log that was silent for a while under the same leader,
/// and a leader that came back: all are in order, by the cell's time.
#[test]
fn timeline_stays_in_order() {
    let folder = tempfile::tempdir().unwrap();
    let [before, after] = ["1.mcap", "2.mcap"].map(|name| folder.path().join(name));
    let status = |node: &str, state: &str, troubles: Value| {
        json!({ "schema": 1, "node": node, "id": uuid::Uuid::from_u128(7), "role": "auto", "state": state, "epoch": 1,
            "version": "0.1.0", "troubles": troubles })
    };
    let mut log = Log::begin(&before, 1);
    let second = |n: u64| BEGIN_US + n * 1_000_000;
    for n in (0..5).chain(40..45) {
        log.put(
            "ecod.GlobalMap",
            "global_detections",
            second(n),
            &map("edge", 1, n, second(n) - 5000),
        );
    }
    let trouble = json!([{ "kind": "clock_off", "about": "late", "cause": "</script>5 s ahead", "remedy": "chrony" }]);
    log.put(
        "ecod.NodeStatus",
        "nodes/edge",
        second(44),
        &status("edge", "aggregating", trouble),
    );
    log.finish();
    let mut log = Log::begin(&after, 2);
    let hour_us = 3_600_000_000;
    log.put(
        "ecod.NodeStatus",
        "nodes/edge",
        second(50) - hour_us,
        &status("edge", "offline", json!([])),
    );
    for n in 50..55 {
        let leader = if n < 53 { "gauss" } else { "edge" };
        log.put(
            "ecod.GlobalMap",
            "global_detections",
            second(n) - hour_us,
            &map(leader, n / 53 + 2, n, second(n)),
        );
    }
    log.finish();
    // The later file first, as its name may have it.
    let html = page(&[&after, &before], r#"{"landmarks": {"a": "car"}}"#);
    let page_timeline = timeline(&html);
    let terms: Vec<_> = page_timeline["reigns"].as_array().unwrap().iter().collect();
    let leaders: Vec<_> = terms
        .iter()
        .map(|term| term["leader"].as_str().unwrap())
        .collect();
    assert_eq!(
        leaders,
        ["edge", "edge", "gauss", "edge"],
        "no band where the log has no line"
    );
    assert_eq!(
        (&terms[1]["from_us"], &terms[1]["until_us"]),
        (&second(40).into(), &second(44).into())
    );
    assert_eq!(terms[3]["gap_ms"], 1000);
    let texts: Vec<_> = page_timeline["events"]
        .as_array()
        .unwrap()
        .iter()
        .map(|event| event["text"].as_str().unwrap())
        .collect();
    let expected = [
        "the log has nothing of the 36 s before",
        "edge joined",
        "late: </script>5 s ahead. Remedy: chrony",
    ];
    assert_eq!(texts, expected, "{page_timeline}");
    let times: Vec<_> = page_timeline["frames"]
        .as_array()
        .unwrap()
        .iter()
        .map(|time| time.as_u64().unwrap())
        .collect();
    assert!(times.len() == 15 && times.is_sorted(), "{times:?}");
    let scenes = page_timeline["scenes"].as_array().unwrap();
    let rounds: Vec<_> = scenes
        .iter()
        .map(|scene| scene["map"]["message"]["round"].as_u64().unwrap())
        .collect();
    assert!(rounds.is_sorted() && rounds.len() == 15, "{rounds:?}");
}
