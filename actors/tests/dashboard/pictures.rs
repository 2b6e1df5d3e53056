//! What browsers are sent.

use ecod::wire::Role;
use serde_json::Value;

use crate::cell::{Vehicles, config, join, start, until};
use crate::http::{Events, get};

fn sees(picture: &Value, vehicle: &str) -> bool {
    picture["vehicles"].as_array().unwrap().iter().any(|sighting| sighting["report"]["node"] == vehicle)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn pictures_follow_the_cell_on_every_node() {
    let (edge, edge_page) = start(config("edge", Role::Edge, 6)).await;
    let (cav, cav_page) = join(config("euclid", Role::Cav, 6), &edge).await;
    let vehicles = Vehicles::start(&[edge.broker_address().unwrap()], 4, 6);
    for page in [edge_page, cav_page] {
        let mut events = Events::open(page).await;
        let first = events.until("a map with vehicles", |p| p["map"].is_object() && sees(p, "ada")).await;
        assert_eq!(first["leadership"]["leader"], "edge");
        let round = |picture: &Value| picture["map"]["message"]["round"].as_u64().unwrap();
        let next = events.until("a later map", |picture| round(picture) > round(&first)).await;
        for name in ["edge", "euclid"] {
            let node = next["nodes"].as_array().unwrap().iter().find(|node| node["name"] == name);
            assert_eq!(node.unwrap()["alive"], true, "{name}");
        }
        events.until("verdicts", |picture| picture["verdicts"].is_object()).await;
        events
            .until("reputations", |picture| picture["reputations"]["message"]["reputations"]["ada"].is_object())
            .await;
    }
    drop(vehicles);
    edge.stop().await;
    cav.stop().await;
}

/// A vehicle's report reaches a node that only follows while someone looks there, and no longer.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_follower_takes_reports_only_while_it_is_looked_at() {
    let (edge, _) = start(config("edge", Role::Edge, 6)).await;
    let (cav, page) = join(config("euclid", Role::Cav, 6), &edge).await;
    let _vehicles = Vehicles::start(&[edge.broker_address().unwrap()], 1, 6);
    until("the vehicle follows", || async { get(page, "/readyz").await.status == 200 }).await;
    let reports = || async {
        let metrics = get(page, "/metrics").await.body;
        let line = metrics.lines().find(|line| line.contains(r#"reports_received_total{kind="detections"}"#)).unwrap();
        line.rsplit_once(' ').unwrap().1.parse::<u64>().unwrap()
    };
    assert_eq!(reports().await, 0);
    let mut events = Events::open(page).await;
    events.until("a vehicle", |picture| sees(picture, "ada")).await;
    drop(events);
    until("reports are no longer taken", || async {
        let before = reports().await;
        tokio::time::sleep(std::time::Duration::from_millis(500)).await;
        reports().await == before
    })
    .await;
    edge.stop().await;
    cav.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn history_tells_who_led_and_how_it_went() {
    let (edge, _) = start(config("edge", Role::Edge, 2)).await;
    let (auto, page) = join(config("euclid", Role::Auto, 2), &edge).await;
    until("the edge is followed", || async { get(page, "/readyz").await.json()["reason"] == "following edge" }).await;
    edge.stop().await;
    until("the vehicle leads", || async { get(page, "/readyz").await.json()["reason"] == "leading" }).await;
    until("a sample with rounds", || async {
        let history = get(page, "/api/history").await.json();
        history["samples"].as_array().unwrap().iter().any(|sample| sample["rounds"].as_u64() > Some(0))
    })
    .await;
    let history = get(page, "/api/history").await.json();
    let reigns = history["reigns"].as_array().unwrap();
    let last = reigns.last().unwrap();
    assert_eq!((&last["leader"], &last["until_us"]), (&Value::from("euclid"), &Value::Null));
    assert!(reigns.iter().any(|reign| reign["leader"] == "edge" && reign["until_us"].is_u64()), "{history}");
    assert!(history["failovers"].as_u64() >= Some(1), "{history}");
    let latest = history["samples"].as_array().unwrap().last().unwrap()["at_us"].as_u64().unwrap();
    let news = get(page, &format!("/api/history?since={latest}")).await.json();
    assert!(news["samples"].as_array().unwrap().len() <= 1, "{news}");
    auto.stop().await;
}
