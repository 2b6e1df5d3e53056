//! Programs with the certificate of their node.

use std::time::{Duration, Instant};

use ecod::wire::Role;
use rumqttc::v5::mqttbytes::QoS;
use tokio::time::sleep;

use crate::door::cell::Cell;
use crate::door::courses::{leaders, planners};
use crate::door::reported;

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn programs_with_certificates_survive_handover() {
    let mut cell = Cell::with_certificates().and_four(|_| ()).await;
    let planners = planners(&cell, &["gauss", "noether", "euclid"]).await;
    let lidar = cell.program("lidar", "euclid", &[]).await;
    reported(&cell, &lidar, "euclid--lidar", "noether", 3.1, "euclid").await;
    cell.kill("edge");
    cell.served_by("gauss").await;
    reported(&cell, &lidar, "euclid--lidar", "noether", 2.9, "euclid").await;
    let at_handover = cell.accepted("euclid").len();
    cell.start("edge", Role::Edge, |_| ()).await;
    cell.served_by("edge").await;
    reported(&cell, &lidar, "euclid--lidar", "noether", 3.2, "euclid").await;
    for seen in cell.have_exactly(&planners).await {
        assert_eq!(seen, leaders(["edge", "gauss"]));
    }
    let returned = cell
        .accepted("euclid")
        .into_iter()
        .skip(at_handover)
        .any(|(_, leader, _)| leader == "edge");
    assert!(returned, "the edge leads again");
    drop(planners);
    cell.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn foreign_certificate_cannot_publish() {
    let mut cell = Cell::with_certificates();
    for (name, role) in [
        ("edge", Role::Edge),
        ("gauss", Role::Auto),
        ("euclid", Role::Cav),
    ] {
        cell.start(name, role, |_| ()).await;
    }
    cell.served_by("edge").await;
    let stranger = cell.program_with("mallory", "euclid", "gauss", &[]).await;
    for name in ["euclid--lidar", "gauss--lidar", "gauss"] {
        let (reason, text) = stranger
            .ask(&format!("detections/{name}"), b"{}".to_vec())
            .await;
        assert!(
            reason == "NotAuthorized" && text.contains("euclid"),
            "{name}: {reason} {text}"
        );
    }
    let (reason, text) = stranger
        .ask_retained("nodes/euclid--lidar", b"{}".to_vec(), true)
        .await;
    assert!(
        reason == "NotAuthorized" && text.contains("euclid"),
        "{reason} {text}"
    );
    let own = cell.program("lidar", "euclid", &[]).await;
    assert_eq!(
        own.ask_retained("nodes/euclid--lidar", b"{}".to_vec(), true)
            .await
            .0,
        "Success"
    );
    cell.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn certified_flood_delays_no_map() {
    let mut cell = Cell::with_certificates();
    for (name, role) in [("edge", Role::Edge), ("euclid", Role::Cav)] {
        cell.start(name, role, |_| ()).await;
    }
    cell.served_by("edge").await;
    let flood = cell.program("flood", "edge", &[]).await;
    sleep(Duration::from_millis(500)).await;
    let before = cell.accepted("euclid").len();
    let started = Instant::now();
    while started.elapsed() < Duration::from_secs(4) {
        for _ in 0..50 {
            flood
                .publish("nodes/edge--flood", b"x".to_vec(), QoS::AtMostOnce)
                .await;
        }
        sleep(Duration::from_millis(10)).await;
    }
    let rounds: Vec<u64> = cell
        .accepted("euclid")
        .split_off(before)
        .into_iter()
        .map(|(.., round)| round)
        .collect();
    let missed: Vec<_> = rounds
        .windows(2)
        .filter(|pair| pair[1] != pair[0] + 1)
        .collect();
    assert!(rounds.len() > 20 && missed.is_empty(), "{rounds:?}");
    cell.stop().await;
}
