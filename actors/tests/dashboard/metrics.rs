//! What Prometheus gets.

use std::collections::BTreeMap;
use std::net::SocketAddr;

use ecod::wire::Role;

use crate::cell::{Vehicles, config, start, until};
use crate::http::get;

/// Samples by name and labels; every line is checked.
async fn scrape(page: SocketAddr) -> BTreeMap<String, f64> {
    let answer = get(page, "/metrics").await;
    assert_eq!(answer.header("content-type"), Some("application/openmetrics-text; version=1.0.0; charset=utf-8"));
    assert_eq!(answer.body.matches("# EOF").count(), 1);
    assert!(answer.body.ends_with("# EOF\n"));
    let mut types = BTreeMap::new();
    let mut samples = BTreeMap::new();
    for line in answer.body.lines() {
        if let Some(described) = line.strip_prefix("# TYPE ") {
            let (name, kind) = described.split_once(' ').unwrap();
            assert!(types.insert(name, kind).is_none(), "{name} comes twice");
        } else if !line.starts_with('#') {
            let (series, value) = line.rsplit_once(' ').unwrap();
            let name = series.split('{').next().unwrap();
            let of = |suffix| name.strip_suffix(suffix).and_then(|name| types.get(name));
            let known = types.get(name).filter(|kind| **kind == "gauge").is_some()
                || of("_total").is_some_and(|kind| *kind == "counter")
                || ["_bucket", "_sum", "_count"]
                    .into_iter()
                    .any(|end| of(end).is_some_and(|kind| *kind == "histogram"));
            assert!(known, "{line}");
            assert!(samples.insert(series.to_owned(), value.parse().unwrap()).is_none(), "{series} comes twice");
        }
    }
    samples
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn metrics_say_what_the_node_does() {
    let (node, page) = start(config("edge", Role::Edge, 6)).await;
    let before = scrape(page).await;
    assert_eq!(before[r#"ecod_payloads_rejected_total{reason="malformed"}"#], 0.0, "there before it matters");
    let vehicles = Vehicles::start(&[node.broker_address().unwrap()], 4, 6);
    until("reports and reputations come", || async {
        let samples = scrape(page).await;
        samples[r#"ecod_reports_received_total{kind="detections"}"#] > 20.0
            && samples.contains_key(r#"ecod_reputation_score_ratio{vehicle="ada"}"#)
            && samples.get("ecod_map_capture_to_received_seconds_count").is_some_and(|count| *count > 5.0)
    })
    .await;
    let samples = scrape(page).await;
    assert_eq!(samples["ecod_ready"], 1.0);
    assert_eq!(samples["ecod_broker_up"], 1.0);
    assert_eq!(samples[r#"ecod_election_state{state="leading"}"#], 1.0);
    assert_eq!(samples[r#"ecod_election_state{state="seeking"}"#], 0.0);
    assert!(samples["ecod_election_epoch"] >= 1.0);
    assert_eq!(samples[r#"ecod_mqtt_links{state="up"}"#], 1.0);
    assert!(samples[r#"ecod_rounds_accepted_total{kind="map"}"#] > 5.0);
    assert!(samples["process_resident_memory_bytes"] > 1e6);
    assert!(samples["process_cpu_seconds_total"] > 0.0);
    for file in
        [include_str!("../../../packaging/prometheus/alerts.yml"), include_str!("../../../packaging/grafana/ecod.json")]
    {
        for name in names(file) {
            let known = samples.keys().any(|series| series.split('{').next() == Some(name));
            assert!(known, "{name} is asked for and does not exist");
        }
    }
    drop(vehicles);
    node.stop().await;
}

/// The metrics that a file asks for.
fn names(file: &str) -> Vec<&str> {
    let words = file.split(|c: char| !c.is_ascii_alphanumeric() && c != '_');
    words.filter(|word| word.starts_with("ecod_") || word.starts_with("process_")).collect()
}
