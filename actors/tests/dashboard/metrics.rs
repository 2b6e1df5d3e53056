//! What Prometheus gets.

use std::collections::{BTreeMap, BTreeSet};
use std::net::SocketAddr;

use ecod::wire::Role;
use ecod_actors::telemetry::counters::Event;
use ecod_testkit::until_async as until;
use serde_json::Value;

use crate::cell::{Vehicles, config, start};
use crate::http::get;

/// Samples by name and labels; every line is checked.
async fn scrape(page: SocketAddr) -> BTreeMap<String, f64> {
    let answer = get(page, "/metrics").await;
    assert_eq!(
        answer.header("content-type"),
        Some("application/openmetrics-text; version=1.0.0; charset=utf-8")
    );
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
            assert!(
                samples
                    .insert(series.to_owned(), value.parse().unwrap())
                    .is_none(),
                "{series} comes twice"
            );
        }
    }
    samples
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn metrics_describe_node_activity() {
    let (node, page) = start(config("edge", Role::Edge, 6)).await;
    let before = scrape(page).await;
    assert_eq!(
        before[r#"ecod_payloads_rejected_total{reason="malformed"}"#], 0.0,
        "there before it matters"
    );
    let vehicles = Vehicles::start(&[node.broker_address().unwrap()], 4, 6);
    until("reports and reputations come", || async {
        let samples = scrape(page).await;
        samples[r#"ecod_reports_received_total{kind="detections"}"#] > 20.0
            && samples.contains_key(r#"ecod_reputation_score_ratio{vehicle="ada"}"#)
            && samples.get("ecod_map_capture_to_received_seconds_count").is_some_and(|count| *count > 5.0)
            // These are looked at from time to time only.
            && ["ecod_ready", "ecod_broker_up", r#"ecod_mqtt_links{state="up"}"#].iter().all(|name| samples[*name] == 1.0)
    })
    .await;
    let samples = scrape(page).await;
    assert_eq!(samples[r#"ecod_election_state{state="leading"}"#], 1.0);
    assert_eq!(samples[r#"ecod_election_state{state="seeking"}"#], 0.0);
    assert!(samples["ecod_election_epoch"] >= 1.0);
    assert!(samples[r#"ecod_rounds_accepted_total{kind="map"}"#] > 5.0);
    assert!(samples["process_resident_memory_bytes"] > 1e6);
    assert!(samples["process_cpu_seconds_total"] > 0.0);
    for file in [
        include_str!("../../../packaging/prometheus/alerts.yml"),
        include_str!("../../../packaging/grafana/ecod.json"),
    ] {
        for name in names(file) {
            let known = samples
                .keys()
                .any(|series| series.split('{').next() == Some(name));
            // Their series exist while nodes are missing or there is a trouble, as other tests show.
            let known = known || ["ecod_member_missing_seconds", "ecod_troubles"].contains(&name);
            assert!(known, "{name} is queried and does not exist");
        }
    }
    drop(vehicles);
    node.stop().await;
}

/// Sums over nodes must be restricted to one cell.
#[test]
fn grafana_shows_one_cell() {
    let text = include_str!("../../../packaging/grafana/ecod.json");
    let dashboard: Value = serde_json::from_str(text).unwrap();
    let variables = dashboard["templating"]["list"].as_array().unwrap();
    let variable = |name: &str| {
        variables
            .iter()
            .find(|variable| variable["name"] == name)
            .unwrap()
    };
    assert_eq!(
        (&variable("cell")["multi"], &variable("cell")["includeAll"]),
        (&Value::from(false), &Value::from(false))
    );
    assert!(
        variable("instance")["query"]["query"]
            .as_str()
            .unwrap()
            .contains(r#"cell="$cell""#)
    );
    let targets = dashboard["panels"]
        .as_array()
        .unwrap()
        .iter()
        .flat_map(|panel| panel["targets"].as_array().unwrap());
    let asked = targets
        .chain(dashboard["annotations"]["list"].as_array().unwrap())
        .map(|it| it["expr"].as_str().unwrap());
    let asked: Vec<_> = asked.collect();
    assert!(asked.len() > 20, "{asked:?}");
    for expression in asked {
        let series = expression.matches('{').count();
        let chosen = expression.matches(r#"instance=~"$instance""#).count();
        assert!(series > 0 && series == chosen, "{expression}");
    }
}

/// The page has a text for every counter of abnormal events, and Grafana shows exactly these counters.
#[test]
fn every_loss_counter_is_displayed() {
    const USUAL: [Event; 18] = [
        Event::Published,
        Event::Received,
        Event::Echo,
        Event::Connected,
        Event::MapAccepted,
        Event::Repeated,
        Event::ReportOvertaken,
        Event::VerdictsAccepted,
        Event::ReputationsAccepted,
        Event::LedgerMerged,
        Event::ReputationsSaved,
        Event::Recorded,
        Event::RoundDue,
        Event::RegionPublished,
        Event::RegionReceived,
        Event::CellMapAccepted,
        Event::FrameDetected,
        Event::FrameShown,
    ];
    let left_out: BTreeSet<_> = Event::ALL
        .iter()
        .filter(|event| !USUAL.contains(event))
        .map(|event| event.as_str())
        .collect();
    let page = include_str!("../../src/observe/dashboard/page/tables.js");
    let drops = page
        .split_once("const DROPS = {")
        .and_then(|(_, rest)| rest.split_once("};"))
        .unwrap()
        .0;
    let shown = drops
        .split('"')
        .step_by(2)
        .filter_map(|between| between.trim_matches([',', ' ', '\n']).strip_suffix(':'));
    assert_eq!(shown.collect::<BTreeSet<_>>(), left_out);
    let dashboard: Value =
        serde_json::from_str(include_str!("../../../packaging/grafana/ecod.json")).unwrap();
    let panels = dashboard["panels"].as_array().unwrap();
    let panel = panels
        .iter()
        .find(|panel| panel["title"] == "Left out or failed")
        .unwrap();
    let asked = panel["targets"][0]["expr"].as_str().unwrap();
    let asked = asked
        .split_once(r#"event=~""#)
        .and_then(|(_, rest)| rest.split_once('"'))
        .unwrap()
        .0;
    assert_eq!(asked.split('|').collect::<BTreeSet<_>>(), left_out);
}

/// A value that many clients request is read once.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn concurrent_scrapes_get_equal_values() {
    let (node, page) = start(config("edge", Role::Edge, 6)).await;
    until("the node is ready", || async {
        get(page, "/readyz").await.status == 200
    })
    .await;
    // The age of a round and the processor time change from one reading to the next.
    until("the same twice", || async {
        get(page, "/metrics").await.body == get(page, "/metrics").await.body
    })
    .await;
    let first = get(page, "/metrics").await.body;
    until("something new", || async {
        get(page, "/metrics").await.body != first
    })
    .await;
    node.stop().await;
}

/// The metrics that a file queries.
fn names(file: &str) -> Vec<&str> {
    let words = file.split(|c: char| !c.is_ascii_alphanumeric() && c != '_');
    words
        .filter(|word| word.starts_with("ecod_") || word.starts_with("process_"))
        .collect()
}
