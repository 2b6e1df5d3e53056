//! Regions that do not let a cell in, and cells that have no place in one.

use crate::cell::{config, round, start, trouble, until};
use crate::mosquitto::Mosquitto;
use crate::region::{Broker, Subscriber};
use ecod_actors::platform::secret::Secret;

/// A wrong password is told as such, with the broker's address, and costs the cell nothing.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn wrong_credentials_are_told_and_right_ones_work() {
    for broker in Broker::both_with_user("north", "correct horse") {
        let mut wrong = config("north", broker.address());
        (wrong.uplink.user, wrong.uplink.password) = (Some("north".into()), Some(Secret::new("battery staple")));
        let mut right = wrong.clone();
        right.uplink.password = Some(Secret::new("correct horse"));
        let node = start(wrong).await;
        until("the refusal", async || trouble(&node, "broker_refuses").is_some()).await;
        let refused = trouble(&node, "broker_refuses").unwrap();
        eprintln!("{}: {}; {}", broker.name(), refused.cause, refused.remedy);
        assert_eq!(refused.about, Some(broker.address().to_string()));
        assert!(refused.cause.contains("connection refused") && refused.remedy.contains("password"), "{refused:?}");
        assert!(trouble(&node, "uplink_unreachable").is_none(), "one trouble, not two");
        let before = round(&node);
        until("the cell goes on", async || round(&node) > before + 5).await;
        node.stop().await;

        let node = start(right).await;
        use ecod_actors::telemetry::counters::Event;
        until("maps come back", async || {
            node.counters().events(Event::Echo) > 0 && node.counters().events(Event::RegionPublished) > 2
        })
        .await;
        assert!(trouble(&node, "broker_refuses").is_none());
        node.stop().await;
    }
}

/// A broker that acknowledges what it does not permit is found out: the own status does not come back.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn missing_permissions_are_told() {
    let broker = Mosquitto::with_permissions("north", "correct horse", "topic read ecod/v1/geo/#");
    let mut config = config("north", broker.address());
    (config.uplink.user, config.uplink.password) = (Some("north".into()), Some(Secret::new("correct horse")));
    let node = start(config).await;
    until("the refusal", async || trouble(&node, "broker_refuses").is_some()).await;
    let refused = trouble(&node, "broker_refuses").unwrap();
    assert!(refused.cause.contains("status does not come back"), "{refused:?}");
    node.stop().await;
}

/// A cell without a place on Earth says so and tells the region nothing; with a place it begins.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_cell_without_origin_says_so() {
    let broker = Mosquitto::start();
    let subscriber = Subscriber::new(&broker.address());
    let mut config = config("north", broker.address());
    config.origin = None;
    let node = start(config).await;
    until("the trouble", async || trouble(&node, "no_origin").is_some()).await;
    assert!(subscriber.heard().is_empty());

    use ecod_actors::messages::description_keeper::DescriptionKeeperMessage;
    let text = "[origin]\nlatitude_deg = 52.2\nlongitude_deg = 21.0\n";
    node.slots().description.send(DescriptionKeeperMessage::Set { text: text.into() });
    until("maps in the region", async || !subscriber.maps("north").is_empty()).await;
    assert!(trouble(&node, "no_origin").is_none());
    assert_eq!(subscriber.description("north").map(|description| description.text), Some(text.into()));

    // A tile is left behind empty.
    let before = subscriber.maps("north").len();
    let text = "[origin]\nlatitude_deg = 52.3\nlongitude_deg = 21.0\n";
    node.slots().description.send(DescriptionKeeperMessage::Set { text: text.into() });
    let moved = || subscriber.maps("north").iter().skip(before).any(|(message, _)| message.origin.latitude_deg == 52.3);
    until("maps of the new tile", async || moved()).await;
    let late = Subscriber::new(&broker.address());
    until("what is retained", async || late.status("north").is_some() && late.description("north").is_some()).await;
    assert!(late.heard().iter().all(|heard| heard.topic.tile == subscriber.heard().last().unwrap().topic.tile));
    node.stop().await;
}
