//! A region that is gone for a while, or hangs.

use std::time::Duration;

use ecod::model::quadkey::Quadkey;
use ecod::neighbours::{CellMapFilter, MAX_AGE};
use ecod::wire::{NodeState, RegionTopic, RegionTopicKind};
use ecod_actors::platform::clock;
use ecod_actors::telemetry::counters::Event;
use ecod_testkit::until_async as until;

use crate::mosquitto::Mosquitto;
use crate::uplink::cell::{config, round, start, trouble};
use crate::uplink::region::{Broker, Subscriber, assert_in_order};

/// Without its region the cell continues as before and reports the trouble; no part waits for the region's return.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn cell_survives_region_outage() {
    for mut broker in Broker::both() {
        let subscriber = Subscriber::new(&broker.address());
        let node = start(config("north", broker.address())).await;
        until("maps in the region", async || {
            subscriber.maps("north").len() >= 3
        })
        .await;
        let first = round(&node);
        let begun_at = clock::now();
        tokio::time::sleep(Duration::from_secs(2)).await;
        let usual_hz = (round(&node) - first) as f64 / clock::now().since(begun_at).as_secs_f64();
        broker.kill();
        let before = round(&node);
        let cut_at = clock::now();
        until("the trouble", async || {
            trouble(&node, "uplink_unreachable").is_some()
        })
        .await;
        tokio::time::sleep(Duration::from_secs(3)).await;
        let rounds = round(&node) - before;
        let spent = clock::now().since(cut_at);
        let hz = rounds as f64 / spent.as_secs_f64();
        eprintln!(
            "{}: {hz:.1} rounds a second in the cell while its region is gone",
            broker.name()
        );
        assert!(
            hz > 0.6 * usual_hz,
            "{rounds} rounds in {spent:?}, before {usual_hz} a second"
        );
        assert!(node.counters().events(Event::RegionWithheld) > 0);
        let trouble_of = trouble(&node, "uplink_unreachable").unwrap();
        assert_eq!(
            trouble_of.about,
            Some(broker.address().to_string()),
            "{trouble_of:?}"
        );

        let heard = subscriber.maps("north").len();
        broker.revive();
        let revived_at = clock::now();
        until("maps again", async || {
            subscriber.maps("north").len() >= heard + 3
        })
        .await;
        let maps = subscriber.maps("north");
        eprintln!(
            "{}: live again {:?} after its start",
            broker.name(),
            maps[heard].1.since(revived_at)
        );
        assert_in_order(&maps);
        let oldest = maps[heard..]
            .iter()
            .map(|(message, at)| at.since(message.sent_at_us))
            .max()
            .unwrap();
        assert!(
            oldest < Duration::from_secs(1),
            "a map that was sent {oldest:?} before"
        );
        until("no trouble any more", async || {
            trouble(&node, "uplink_unreachable").is_none()
        })
        .await;
        node.stop().await;
    }
}

/// How long the broker hangs: shorter than the link's keep-alive. A lost link would also drop the queued maps.
const HANG: Duration = Duration::from_secs(4);

/// A broker that hangs receives few maps, and the maps that it forwards afterwards are too old for all receivers.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn delayed_maps_are_dropped() {
    let broker = Mosquitto::start();
    let subscriber = Subscriber::new(&broker.address());
    let node = start(config("north", broker.address())).await;
    until("maps in the region", async || {
        subscriber.maps("north").len() >= 6
    })
    .await;
    broker.freeze();
    let frozen_at = clock::now();
    tokio::time::sleep(HANG).await;
    let thawed_at = clock::now();
    broker.thaw();
    let fresh = || {
        subscriber
            .maps("north")
            .iter()
            .filter(|(message, _)| message.sent_at_us > thawed_at)
            .count()
    };
    until("fresh maps", async || fresh() >= 4).await;
    let maps = subscriber.maps("north");
    let late = |age: Duration| {
        maps.iter()
            .filter(|(message, at)| at.since(message.sent_at_us) > age)
            .count()
    };
    let in_burst = late(MAX_AGE);
    let sent = maps
        .iter()
        .filter(|(message, _)| (frozen_at..thawed_at).contains(&message.sent_at_us))
        .count();
    eprintln!(
        "{sent} maps were sent to a broker that hung for {HANG:?}; {in_burst} of them came older than {MAX_AGE:?}"
    );
    assert!(in_burst > 0, "the test makes a burst");
    assert!(sent <= 8, "{sent} maps were sent to a broker that hangs");

    let mut filter = CellMapFilter::new(4);
    let admitted = maps.iter().filter(|(message, at)| {
        let tile = Quadkey::of_cell(&message.origin);
        let kind = RegionTopicKind::Map;
        filter
            .admit(
                &RegionTopic {
                    tile,
                    cell: message.cell.clone(),
                    kind,
                },
                message,
                *at,
            )
            .is_ok()
    });
    let ages: Vec<_> = admitted
        .map(|(message, at)| at.since(message.sent_at_us))
        .collect();
    let too_old = ages
        .iter()
        .filter(|age| **age > MAX_AGE + Duration::from_millis(200))
        .count();
    eprintln!(
        "{} of {} maps count, {too_old} of them too old",
        ages.len(),
        maps.len()
    );
    assert!(too_old == 0 && ages.len() >= 6, "{ages:?}");
    node.stop().await;
}

/// An uplink that ends is started anew, and the last will of the one before does not stay.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn killed_uplink_is_restarted() {
    let broker = Mosquitto::start();
    let subscriber = Subscriber::new(&broker.address());
    let node = start(config("north", broker.address())).await;
    until("maps in the region", async || {
        subscriber.maps("north").len() >= 2
    })
    .await;
    let uplink = node.slots().uplink.get().unwrap();
    uplink.kill();
    until("another uplink", async || {
        node.slots()
            .uplink
            .get()
            .is_some_and(|now| now.get_id() != uplink.get_id())
    })
    .await;
    let heard = subscriber.maps("north").len();
    until("maps again", async || {
        subscriber.maps("north").len() >= heard + 4
    })
    .await;
    // The new leader does not have the number of the last map.
    let mut maps = subscriber.maps("north");
    maps.dedup_by_key(|(message, _)| message.map.round);
    assert_in_order(&maps);
    let is_told = || {
        subscriber
            .status("north")
            .is_some_and(|status| status.state == NodeState::Aggregating)
    };
    until("the leader's status", async || is_told()).await;
    node.stop().await;
}
