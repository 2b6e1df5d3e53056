//! What browsers are sent.

use std::net::SocketAddr;
use std::time::Duration;

use ecod::model::names::NodeName;
use ecod::wire::{Encoding, NodeStatus, Role, encode};
use ecod_testkit::until_async as until;
use rumqttc::{AsyncClient, MqttOptions, QoS};
use serde_json::Value;
use tokio::task::JoinSet;
use uuid::Uuid;

use crate::cell::{Vehicles, config, join, start};
use crate::http::{Events, get, try_request};
use crate::processes::{self, Place, free_places};

fn sees(picture: &Value, vehicle: &str) -> bool {
    picture["vehicles"]
        .as_array()
        .unwrap()
        .iter()
        .any(|sighting| sighting["report"]["node"] == vehicle)
}

fn node_of<'a>(picture: &'a Value, name: &str) -> &'a Value {
    let found = picture["nodes"]
        .as_array()
        .unwrap()
        .iter()
        .find(|node| node["name"] == name);
    found.unwrap_or(&Value::Null)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn every_node_page_shows_cell() {
    let (edge, edge_page) = start(config("edge", Role::Edge, 6)).await;
    let (cav, cav_page) = join(config("euclid", Role::Cav, 6), &edge).await;
    let vehicles = Vehicles::start(&[edge.broker_address().unwrap()], 4, 6);
    for page in [edge_page, cav_page] {
        let mut events = Events::open(page).await;
        let first = events
            .until("a map with vehicles", |p| {
                p["map"].is_object() && sees(p, "ada")
            })
            .await;
        assert_eq!(first["leadership"]["leader"], "edge");
        let round = |picture: &Value| picture["map"]["message"]["round"].as_u64().unwrap();
        let next = events
            .until("a later map", |picture| round(picture) > round(&first))
            .await;
        for (name, its_page) in [("edge", edge_page), ("euclid", cav_page)] {
            let linked = if its_page == page {
                Value::Null
            } else {
                its_page.to_string().into()
            };
            events
                .until("the other's page is linked", |picture| {
                    node_of(picture, name)["page"] == linked
                })
                .await;
            assert_eq!(node_of(&next, name)["alive"], true, "{name}");
        }
        events
            .until("verdicts", |picture| picture["verdicts"].is_object())
            .await;
        events
            .until("reputations", |picture| {
                picture["reputations"]["message"]["reputations"]["ada"].is_object()
            })
            .await;
    }
    drop(vehicles);
    edge.stop().await;
    cav.stop().await;
}

/// The broker that ended with the edge cannot report the departure of the edge and of a plain client.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn dead_brokers_clients_are_removed() {
    let directory = tempfile::tempdir().unwrap();
    let places: [Place; 2] = free_places();
    let mut edge = processes::start("edge", Role::Edge, places[0], &places, directory.path());
    let _cav = processes::start("euclid", Role::Cav, places[1], &places, directory.path());
    let mut plain = JoinSet::new();
    plain.spawn(publish_status("plain", places[0].broker));
    let are_alive = |names: [&'static str; 2], wanted: bool| async move {
        let asked = try_request(
            places[1].page,
            "GET",
            "/api/picture",
            &[("Host", "localhost")],
            "",
        )
        .await;
        let Ok(picture) = asked.map(|answer| answer.json()) else {
            return false;
        };
        let node = |name| {
            picture["nodes"]
                .as_array()
                .unwrap()
                .iter()
                .find(|node| node["name"] == name)
        };
        names
            .into_iter()
            .all(|name| node(name).is_some_and(|node| node["alive"] == wanted))
    };
    until("both are there", || are_alive(["edge", "plain"], true)).await;
    edge.0.kill().unwrap();
    until("both are gone", || are_alive(["edge", "plain"], false)).await;
}

/// A client that does not gossip leaves its status with a broker.
async fn publish_status(name: &'static str, broker: SocketAddr) {
    let name = NodeName::from_static(name);
    let status = NodeStatus::starting(name.clone(), Uuid::from_u128(1), Role::Cav, "0.1.0");
    let options = MqttOptions::new(name.as_str(), broker.ip().to_string(), broker.port());
    let (client, mut events) = AsyncClient::new(options, 4);
    let topic = format!("ecod/v1/lot/nodes/{name}");
    client
        .try_publish(
            topic,
            QoS::AtLeastOnce,
            true,
            encode(&status, Encoding::Json),
        )
        .unwrap();
    loop {
        if events.poll().await.is_err() {
            tokio::time::sleep(Duration::from_millis(200)).await;
        }
    }
}

/// A vehicle's report reaches a following node only while a reader views it there.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn unviewed_follower_receives_no_reports() {
    let (edge, _) = start(config("edge", Role::Edge, 6)).await;
    let (cav, page) = join(config("euclid", Role::Cav, 6), &edge).await;
    let _vehicles = Vehicles::start(&[edge.broker_address().unwrap()], 1, 6);
    until("the vehicle follows", || async {
        get(page, "/readyz").await.status == 200
    })
    .await;
    let reports = || async {
        let metrics = get(page, "/metrics").await.body;
        let line = metrics
            .lines()
            .find(|line| line.contains(r#"reports_received_total{kind="detections"}"#))
            .unwrap();
        line.rsplit_once(' ').unwrap().1.parse::<u64>().unwrap()
    };
    assert_eq!(reports().await, 0);
    let mut events = Events::open(page).await;
    events
        .until("a vehicle", |picture| sees(picture, "ada"))
        .await;
    drop(events);
    until("reports are no longer taken", || async {
        let before = reports().await;
        tokio::time::sleep(Duration::from_millis(500)).await;
        reports().await == before
    })
    .await;
    edge.stop().await;
    cav.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn history_lists_leaders_and_gaps() {
    let (edge, _) = start(config("edge", Role::Edge, 2)).await;
    let (auto, page) = join(config("euclid", Role::Auto, 2), &edge).await;
    until("the edge is followed", || async {
        get(page, "/readyz").await.json()["reason"] == "following edge"
    })
    .await;
    let held = async |at: u64| match get(page, &format!("/api/frame?at={at}")).await {
        frame if frame.status == 200 => frame.json(),
        _ => Value::Null,
    };
    until("a map of the edge is held", || async {
        held(u64::MAX).await["map"]["message"]["aggregator"] == "edge"
    })
    .await;
    let of_edge = held(u64::MAX).await["now_us"].as_u64().unwrap();
    edge.stop().await;
    until("the vehicle leads", || async {
        get(page, "/readyz").await.json()["reason"] == "leading"
    })
    .await;
    until("a sample with rounds", || async {
        let history = get(page, "/api/history").await.json();
        history["samples"]
            .as_array()
            .unwrap()
            .iter()
            .any(|sample| sample["rounds"].as_u64() > Some(0))
    })
    .await;
    let history = get(page, "/api/history").await.json();
    let reigns = history["reigns"].as_array().unwrap();
    let last = reigns.last().unwrap();
    assert_eq!(
        (&last["leader"], &last["until_us"]),
        (&Value::from("euclid"), &Value::Null)
    );
    assert!(
        reigns
            .iter()
            .any(|reign| reign["leader"] == "edge" && reign["until_us"].is_u64()),
        "{history}"
    );
    assert!(history["failovers"].as_u64() >= Some(1), "{history}");
    until("the edge's end is shown", || async {
        let history = get(page, "/api/history").await.json();
        history["events"]
            .as_array()
            .unwrap()
            .iter()
            .any(|event| event["text"] == "edge is gone")
    })
    .await;
    until("a map of the vehicle is held", || async {
        held(u64::MAX).await["map"]["message"]["aggregator"] == "euclid"
    })
    .await;
    let earlier = held(of_edge).await;
    assert_eq!(
        (&earlier["now_us"], &earlier["map"]["message"]["aggregator"]),
        (&of_edge.into(), &"edge".into())
    );
    let history = get(page, "/api/history").await.json();
    assert!(
        history["frames"]
            .as_array()
            .unwrap()
            .contains(&of_edge.into()),
        "{history}"
    );
    for query in ["", "?at=", "?at=-1", "?at=x"] {
        assert_eq!(
            get(page, &format!("/api/frame{query}")).await.status,
            404,
            "{query}"
        );
    }
    let latest = history["samples"].as_array().unwrap().last().unwrap()["at_us"]
        .as_u64()
        .unwrap();
    let news = get(page, &format!("/api/history?since={latest}"))
        .await
        .json();
    assert!(news["samples"].as_array().unwrap().len() <= 1, "{news}");
    auto.stop().await;
}
