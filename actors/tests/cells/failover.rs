//! Cells that lose and regain their leader, over real sockets on loopback.
//!
//! Bounds in here are generous, for a machine that does much else; how long a gap usually is, is printed.

mod cell;
mod path;
mod processes;
mod record;

use std::net::{Ipv4Addr, SocketAddr};
use std::time::{Duration, Instant};

use ecod::leadership::Position;
use ecod::wire::Role;
use ecod_actors::transport::broker::{BrokerConfig, EmbeddedBroker, MqttBroker};
use ecod_testkit::Cell;

use cell::{config, record};
use path::Path;

/// A cell of an edge and three vehicles finds together by one seed, goes on without the edge, and gives it the lead
/// back.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn maps_survive_edge_loss() {
    let mut cell = Cell::new(config);
    for (name, role) in [
        ("edge", Role::Edge),
        ("euclid", Role::Auto),
        ("gauss", Role::Auto),
        ("noether", Role::Auto),
    ] {
        cell.start(name, role).await;
    }
    cell.served_by("edge").await;
    cell.standby_is_named().await;
    cell.kill("edge");
    let substitute = cell.served_by_another_than("edge").await;
    assert_ne!(substitute, "edge");
    for name in ["euclid", "gauss", "noether"] {
        let record = record(&cell, name);
        record.never_goes_back();
        eprintln!(
            "{name}: longest gap when the edge was killed {:?}",
            record.longest_gap()
        );
        assert!(record.longest_gap() < Duration::from_secs(5));
    }

    let before = record(&cell, "euclid").last_round();
    cell.start("edge", Role::Edge).await;
    cell.served_by("edge").await;
    tokio::time::sleep(Duration::from_millis(500)).await;
    for name in ["euclid", "gauss", "noether"] {
        let record = record(&cell, name);
        record.never_goes_back();
        record.misses_and_repeats_none_after(before, "edge");
    }
    cell.stop().await;
}

/// The remaining nodes elect a leader if the leader and its standby end together.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn cell_survives_two_losses() {
    let mut cell = Cell::new(config);
    for name in ["euclid", "gauss", "noether", "turing"] {
        cell.start(name, Role::Auto).await;
    }
    cell.served_by("euclid").await;
    let standby = cell.standby_is_named().await;
    cell.kill("euclid");
    cell.kill(&standby);
    cell.served_by_another_than("euclid").await;
    for name in cell.names() {
        let record = record(&cell, &name);
        record.never_goes_back();
        eprintln!(
            "{name}: longest gap when leader and standby were killed {:?}",
            record.longest_gap()
        );
    }
    cell.stop().await;
}

/// A vehicle that finds no other node serves itself, and keeps its term across a restart.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn lone_vehicle_raises_its_epochs() {
    let mut cell = Cell::new(config);
    cell.start("euclid", Role::Auto).await;
    cell.served_by("euclid").await;
    let first = cell.leadership("euclid").epoch.unwrap();
    cell.kill("euclid");
    cell.start("euclid", Role::Auto).await;
    cell.served_by("euclid").await;
    let second = cell.leadership("euclid").epoch.unwrap();
    assert!(second.term > first.term, "{second} after {first}");
    record(&cell, "euclid").never_goes_back();
    cell.stop().await;
}

/// A leader that loses its broker stops leading at once; an edge is handed the lead again when it is whole.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn leader_without_part_yields() {
    let mut cell = Cell::new(config);
    for (name, role) in [("euclid", Role::Edge), ("gauss", Role::Auto)] {
        cell.start(name, role).await;
    }
    cell.served_by("euclid").await;
    cell.standby_is_named().await;
    let slots = cell.node("euclid").slots().clone();
    let kills: [(&str, &dyn Fn()); 2] = [
        ("broker", &|| slots.broker.get().unwrap().kill()),
        ("fuser", &|| slots.fuser.get().unwrap().kill()),
    ];
    for (part, kill) in kills {
        kill();
        eprintln!("killed the leader's {part}");
        cell.served_by("gauss").await;
        cell.served_by("euclid").await;
        cell.standby_is_named().await;
    }
    for name in ["euclid", "gauss"] {
        record(&cell, name).never_goes_back();
    }
    cell.stop().await;
}

/// A leader whose broker stops answering hands over to a node whose broker answers, and only to such a node.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn leader_with_silent_broker_yields() {
    let mut broker = EmbeddedBroker::new(BrokerConfig::default());
    let address = broker
        .start(SocketAddr::from((Ipv4Addr::LOCALHOST, 0)))
        .unwrap();
    let first = Path::to(address).await;
    let second = Path::to(address).await;
    let mut cell = Cell::new(config);
    for (name, path) in [("euclid", &first), ("gauss", &second)] {
        let mut config = cell.config(name, Role::Auto);
        config.mqtt.broker = Some(path.address.into());
        // Without signs of life, only rounds can show the failure.
        config.mqtt.keep_alive_s = 600;
        cell.start_with(config).await;
    }
    cell.served_by("euclid").await;
    cell.standby_is_named().await;
    first.block(true);
    let blocked = Instant::now();
    cell.led_by("gauss").await;
    eprintln!(
        "the other led {:?} after the leader's broker fell silent",
        blocked.elapsed()
    );

    second.block(true);
    let epoch = cell.leadership("gauss").epoch;
    for _ in 0..30 {
        tokio::time::sleep(Duration::from_millis(100)).await;
        assert_eq!(
            cell.leadership("gauss").position,
            Position::Leading,
            "there is no other candidate for the lead"
        );
        assert_eq!(cell.leadership("gauss").epoch, epoch);
    }
    first.block(false);
    cell.led_by("euclid").await;
    second.block(false);
    cell.served_by("euclid").await;
    cell.stop().await;
}

/// A vehicle of role `cav` follows any leader and cannot lead.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn cav_follows_without_leading() {
    let mut cell = Cell::new(config);
    for (name, role) in [
        ("euclid", Role::Auto),
        ("gauss", Role::Cav),
        ("noether", Role::Auto),
    ] {
        cell.start(name, role).await;
    }
    cell.served_by("euclid").await;
    assert_eq!(cell.standby_is_named().await, "noether");
    cell.kill("euclid");
    cell.served_by("noether").await;
    cell.kill("noether");
    tokio::time::sleep(Duration::from_secs(3)).await;
    assert_ne!(cell.leadership("gauss").position, Position::Leading);
    record(&cell, "gauss").never_goes_back();
    cell.stop().await;
}
