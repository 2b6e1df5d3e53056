//! What the page about a log says.

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

/// Ten seconds of a cell that euclid and gauss report to: a round every 100 ms, 20 ms after the oldest capture and 5 ms
/// on its way, by the edge until it is lost, and from 400 ms later by gauss.
fn write_log(path: &Path) {
    let mut writer: Writer<_> = WriteOptions::new().create(File::create(path).unwrap()).unwrap();
    let fusion = serde_json::to_string(&ReplayConfig::default().fusion).unwrap();
    let landmarks = r#"[{"id":"a","x_m":0.0,"y_m":0.0},{"id":"b","x_m":3.0,"y_m":0.0}]"#;
    let metadata = [
        ("log", "1"),
        ("node", "hertz"),
        ("cell", "lot"),
        ("run", "00000000-0000-0000-0000-000000000000"),
        ("version", "0.1.0"),
        ("fusion", &fusion),
        ("landmarks", landmarks),
    ];
    let metadata: BTreeMap<_, _> = metadata.map(|(key, value)| (key.to_owned(), value.to_owned())).into();
    writer.write_metadata(&Metadata { name: "ecod.log".into(), metadata }).unwrap();
    let mut channels: BTreeMap<String, u16> = BTreeMap::new();
    let mut put = |schema: &str, topic: &str, at_us: u64, message: &Value| {
        let channel_id = *channels.entry(topic.to_owned()).or_insert_with(|| {
            let schema = writer.add_schema(schema, "jsonschema", b"{}").unwrap();
            writer.add_channel(schema, topic, "json", &BTreeMap::new()).unwrap()
        });
        let header = MessageHeader { channel_id, sequence: 0, log_time: at_us * 1000, publish_time: at_us * 1000 };
        writer.write_to_known_channel(&header, message.to_string().as_bytes()).unwrap();
    };
    let counters = |at_us: u64, inbox_full: u64| {
        json!({ "node": "hertz", "at_us": at_us, "events": { "inbox_full": inbox_full, "published": 900 },
            "rejects": { "out_of_order": 50, "stale": 2 }, "shed": {} })
    };
    put("ecod.Counters", "node/counters", BEGIN_US, &counters(BEGIN_US, 3));
    for round in 0..100 {
        let (leader, epoch, lost_us) = if round < 50 { ("edge", 4, 0) } else { ("gauss", 5, 300_000) };
        let at_us = BEGIN_US + round * 100_000 + lost_us;
        let fused_at_us = at_us - 5000;
        for vehicle in ["euclid", "gauss"] {
            let report = json!({ "schema": 1, "node": vehicle, "seq": round, "captured_at_us": at_us - 25_000,
                "objects": [{ "label": "car", "confidence": 0.9, "x_m": 0.0, "y_m": 0.0, "landmark": "a" }] });
            put("ecod.ObjectReport", &format!("detections/{vehicle}"), at_us - 10_000, &report);
        }
        let entry = |id: &str, x_m: f64, contributors: &[&str]| json!({ "id": id, "label": "car", "confidence": 0.9, "x_m": x_m, "y_m": 0.0, "contributors": contributors });
        let landmarks = [entry("a", 0.0, &["euclid", "gauss"]), entry("b", 3.0, &["euclid"])];
        let map = json!({ "schema": 1, "aggregator": leader, "epoch": epoch, "round": round, "fused_at_us": fused_at_us,
            "oldest_capture_us": at_us - 25_000, "landmarks": landmarks, "objects": [] });
        put("ecod.GlobalMap", "global_detections", at_us, &map);
        let verdicts = json!({ "schema": 1, "aggregator": leader, "epoch": epoch, "round": round,
            "fused_at_us": fused_at_us, "verdicts": [{ "landmark": "a", "label": "car", "score": 1.0, "margin": 1.0,
                "votes": { "car": 1.0 }, "contributors": ["euclid", "gauss"] }] });
        put("ecod.Verdicts", "global_verdicts", at_us, &verdicts);
        let score = 0.5 + round as f64 / 250.0;
        let reputations = json!({ "schema": 1, "aggregator": leader, "epoch": epoch, "round": round,
            "reputations": { "euclid": { "score": score, "correct": round, "incorrect": 0 } } });
        put("ecod.Reputations", "reputations", at_us, &reputations);
    }
    let end_us = BEGIN_US + 10_300_000;
    put("ecod.Counters", "node/counters", end_us, &counters(end_us, 10));
    writer.finish().unwrap();
}

#[test]
fn a_report_says_who_led_how_late_how_steadily_on_whom_it_rests_and_what_was_lost() {
    let folder = tempfile::tempdir().unwrap();
    let [log, truth, page] = ["log.mcap", "truth.json", "report.html"].map(|name| folder.path().join(name));
    write_log(&log);
    std::fs::write(&truth, br#"{"landmarks": {"a": "car", "b": "truck"}}"#).unwrap();
    let mut command = Command::new(env!("CARGO_BIN_EXE_ecod-node"));
    let run = command.arg("report").arg(&log).arg("--truth").arg(&truth).arg("-o").arg(&page).output().unwrap();
    assert!(run.status.success() && run.stderr.is_empty(), "{}", String::from_utf8_lossy(&run.stderr));
    let html = std::fs::read_to_string(&page).unwrap();
    let row = |cells: &[&str]| {
        let row: String = cells.iter().map(|cell| format!("<td>{cell}</td>")).collect();
        assert!(html.contains(&row), "{cells:?} not in {html}");
    };
    row(&["PACE", "100", "2", "50.0"]);
    row(&["edge", "4", "2024-11-21 02:00:00.000", "4.9", "50"]);
    row(&["gauss", "5", "2024-11-21 02:00:05.300", "4.9", "50"]);
    row(&["maps: oldest capture to end of round", "100", "20.0", "20.0", "20.0", "20.0"]);
    row(&["maps: end of round to this node", "100", "5.0", "5.0", "5.0", "5.0"]);
    row(&["verdicts", "99", "100.0", "100.0", "100.0", "400.0"]);
    row(&["euclid", "0.896"]);
    row(&["euclid", "100", "9.7", "1.0", "200"]);
    row(&["gauss", "100", "9.7", "1.0", "100"]);
    row(&["inbox full", "7"]);
    assert!(!html.contains("<td>stale</td>") && !html.contains("<td>published</td>"), "not lost meanwhile");
    for plot in ["latency distribution", "time between rounds", "reputations", "coverage per vehicle", "drops"] {
        assert!(html.contains(&format!("aria-label=\"{plot}\"")), "no plot of {plot}");
    }
    assert!(html.contains("50.0 %") && html.contains("100.0 %"), "what rests on whom");
}
