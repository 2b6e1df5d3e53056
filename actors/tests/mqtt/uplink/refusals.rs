//! Regions that do not let a cell in, and cells that have no place in one.

use std::time::Duration;

use ecod::model::names::NodeName;
use ecod::model::quadkey::Quadkey;
use ecod::wire::Role;
use ecod_actors::messages::description_keeper::DescriptionKeeperMessage;
use ecod_actors::platform::clock;
use ecod_actors::platform::secret::Secret;
use ecod_actors::telemetry::counters::Event;
use ecod_actors::transport::pki::{Authority, TlsConfig};
use ecod_testkit::until_async as until;

use crate::mosquitto::Mosquitto;
use crate::uplink::cell::{config, round, start, trouble};
use crate::uplink::region::{Broker, Subscriber};

/// A wrong password is reported as such, with the broker's address, and does not affect the cell.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn wrong_credentials_are_reported() {
    for broker in Broker::both_with_user("north", "correct horse") {
        let mut wrong = config("north", broker.address());
        wrong.uplink.user = Some("north".into());
        wrong.uplink.password = Some(Secret::new("battery staple"));
        let mut right = wrong.clone();
        right.uplink.password = Some(Secret::new("correct horse"));
        let node = start(wrong).await;
        until("the refusal", async || {
            trouble(&node, "broker_refuses").is_some()
        })
        .await;
        let refused = trouble(&node, "broker_refuses").unwrap();
        eprintln!("{}: {}; {}", broker.name(), refused.cause, refused.remedy);
        assert_eq!(refused.about, Some(broker.address().to_string()));
        assert!(
            refused.cause.contains("connection refused") && refused.remedy.contains("password"),
            "{refused:?}"
        );
        assert!(
            trouble(&node, "uplink_unreachable").is_none(),
            "one trouble, not two"
        );
        let before = round(&node);
        until("the cell goes on", async || round(&node) > before + 5).await;
        node.stop().await;

        let node = start(right).await;
        // The own maps and status.
        until("its own message comes back", async || {
            node.counters().events(Event::RegionReceived) > 3
        })
        .await;
        assert!(trouble(&node, "broker_refuses").is_none());
        node.stop().await;
    }
}

/// A broker that acknowledges forbidden subscriptions is detected, because the own status does not come back.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn missing_permissions_are_told() {
    let broker = Mosquitto::with_permissions("north", "correct horse", "topic read ecod/v1/geo/#");
    let mut config = config("north", broker.address());
    config.uplink.user = Some("north".into());
    config.uplink.password = Some(Secret::new("correct horse"));
    let node = start(config).await;
    until("the refusal", async || {
        trouble(&node, "broker_refuses").is_some()
    })
    .await;
    let refused = trouble(&node, "broker_refuses").unwrap();
    assert!(
        refused.cause.contains("status does not come back"),
        "{refused:?}"
    );
    node.stop().await;
}

/// A cell without a position on Earth reports this and publishes no maps to the region; with a position it starts.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn missing_origin_is_reported() {
    let broker = Mosquitto::start();
    let subscriber = Subscriber::new(&broker.address());
    let mut config = config("north", broker.address());
    config.origin = None;
    let node = start(config).await;
    until("the trouble", async || {
        trouble(&node, "no_origin").is_some()
    })
    .await;
    assert!(subscriber.received().is_empty());

    let text = "[origin]\nlatitude_deg = 52.2\nlongitude_deg = 21.0\n";
    node.slots()
        .description
        .send(DescriptionKeeperMessage::Set { text: text.into() });
    until("maps in the region", async || {
        !subscriber.maps("north").is_empty()
    })
    .await;
    assert!(trouble(&node, "no_origin").is_none());
    assert_eq!(
        subscriber
            .description("north")
            .map(|description| description.text),
        Some(text.into())
    );

    // A tile is left behind empty.
    let before = subscriber.maps("north").len();
    let text = "[origin]\nlatitude_deg = 52.3\nlongitude_deg = 21.0\n";
    node.slots()
        .description
        .send(DescriptionKeeperMessage::Set { text: text.into() });
    let moved = || {
        subscriber
            .maps("north")
            .iter()
            .skip(before)
            .any(|(message, _)| message.origin.latitude_deg == 52.3)
    };
    until("maps of the new tile", async || moved()).await;
    let tile = Quadkey::of_cell(&subscriber.maps("north").last().unwrap().0.origin);
    let is_left = async || {
        let late = Subscriber::new(&broker.address());
        until("what is retained", async || {
            late.status("north").is_some() && late.description("north").is_some()
        })
        .await;
        late.received().iter().all(|heard| heard.topic.tile == tile)
    };
    until("the former tile is empty", is_left).await;
    node.stop().await;
}

/// A broker that requests certificates accepts the node's certificate; a broker whose certificate is not from `ca` is
/// refused.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn both_certificates_are_checked() {
    let directory = tempfile::tempdir().unwrap();
    let name = NodeName::from_static("edge");
    let mut authority = Authority::init(
        directory.path(),
        &NodeName::from_static("north"),
        clock::now(),
    )
    .unwrap();
    authority
        .issue(&name, Role::Edge, Duration::from_secs(3600), clock::now())
        .unwrap();
    let (certificate, key) = authority.files_of(&name);
    let [region, other] = ["region", "other"].map(|name| {
        let made = rcgen::generate_simple_self_signed(vec!["127.0.0.1".to_owned()]).unwrap();
        let [certificate, key] =
            ["pem", "key"].map(|end| directory.path().join(format!("{name}.{end}")));
        std::fs::write(&certificate, made.cert.pem()).unwrap();
        std::fs::write(&key, made.signing_key.serialize_pem()).unwrap();
        (certificate, key)
    });
    let broker = Mosquitto::configured(|_| {
        let certificate = region.0.display();
        let key = region.1.display();
        let ca = authority.ca();
        let files = format!(
            "certfile {certificate}\nkeyfile {key}\ncafile {}\n",
            ca.display()
        );
        files + "require_certificate true\nuse_identity_as_username true\n"
    });
    let mut config = config("north", broker.address());
    config.tls = Some(TlsConfig {
        ca: authority.ca(),
        certificate,
        key,
        revocation_list: None,
        city: None,
    });
    config.uplink.ca = Some(other.0);
    let node = start(config.clone()).await;
    until("the refusal", async || {
        trouble(&node, "broker_refuses").is_some()
    })
    .await;
    let refused = trouble(&node, "broker_refuses").unwrap();
    assert!(refused.cause.contains("certificate"), "{refused:?}");
    node.stop().await;

    config.uplink.ca = Some(region.0);
    let node = start(config).await;
    until("its own message comes back", async || {
        node.counters().events(Event::RegionReceived) > 3
    })
    .await;
    assert!(trouble(&node, "broker_refuses").is_none());
    node.stop().await;
}
