//! Cells and their region, over real brokers: mosquitto and nats-server.
//!
//! Bounds in here are generous, for a machine that does much else; figures are printed.

mod cell;
mod failover;
mod nats;
mod neighbours;
mod outage;
mod refusals;
mod region;

use std::time::Duration;

use ecod::model::quadkey::Quadkey;
use ecod::wire::NodeState;
use ecod_actors::telemetry::counters::Event;
use ecod_testkit::until_async as until;

use cell::{ORIGIN, config, start};
use region::{Broker, Subscriber, assert_in_order};

/// A subscriber gets two maps a second, and at any time later the leader's status and the cell's description.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn region_map_rate_is_limited() {
    for broker in Broker::both() {
        let subscriber = Subscriber::new(&broker.address());
        let directory = tempfile::tempdir().unwrap();
        let mut config = config("north", broker.address());
        config.origin = None;
        let description = "[origin]\nlatitude_deg = 52.2\nlongitude_deg = 21.0\nheight_m = 100.0\n";
        config.description = Some(directory.path().join("cell.toml"));
        std::fs::write(config.description.as_ref().unwrap(), description).unwrap();
        let node = start(config).await;
        until("eleven maps", async || subscriber.maps("north").len() >= 11).await;
        let maps = subscriber.maps("north");
        assert_in_order(&maps);
        let first = &maps[0].1;
        let last = &maps[10].1;
        let mean = last.since(*first).as_secs_f64() / 10.0;
        eprintln!("{}: {:.3} s from map to map", broker.name(), mean);
        assert!((0.4..1.0).contains(&mean), "{mean}");
        assert!(
            maps.iter().all(|(message, _)| message.origin == ORIGIN
                && message.map.aggregator.as_str() == "edge")
        );
        let tile = Quadkey::of_cell(&ORIGIN);
        assert!(
            subscriber
                .received()
                .iter()
                .all(|heard| heard.topic.tile == tile)
        );

        let late = Subscriber::new(&broker.address());
        let has_both = || late.status("north").is_some() && late.description("north").is_some();
        until("what is retained", async || has_both()).await;
        let retained = late
            .received()
            .into_iter()
            .filter(|heard| heard.is_retained);
        assert_eq!(retained.count(), 2, "maps are not kept");
        let status = late.status("north").unwrap();
        assert_eq!(
            (status.state, status.node.as_str()),
            (NodeState::Aggregating, "edge")
        );
        assert_eq!(late.description("north").unwrap().text, description);

        let counters = node.counters().clone();
        assert!(
            counters.events(Event::RegionPublished) >= 11
                && counters.events(Event::CellMapAccepted) == 0
        );
        node.stop().await;
        let offline = || {
            late.status("north")
                .is_some_and(|status| status.state == NodeState::Offline)
        };
        until("the stopped node's last status", async || offline()).await;
        tokio::time::sleep(Duration::from_millis(50)).await;
    }
}
