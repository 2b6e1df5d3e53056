//! Links: payloads pass, several at once, and after a broker's death.

use std::time::{Duration, Instant};

use ecod::wire::Encoding;
use ecod_actors::messages::gateway::GatewayMessage;
use ecod_actors::platform::secret::Secret;
use ecod_actors::telemetry::counters::Event;
use ecod_actors::transport::broker::MqttBroker;
use ecod_actors::transport::mqtt::{
    BrokerAddress, Incoming, LinkState, MqttConfig, MqttVersion, SubscriptionRole,
};
use ecod_testkit::until;
use tokio::task::JoinHandle;

use crate::gateway::cell::{LOOPBACK, Node, edge_and_vehicle, embedded, map, name};
use crate::mosquitto::Mosquitto;

async fn report_and_map_pass(broker: &BrokerAddress, mqtt: MqttConfig) {
    let (mut edge, mut euclid) = edge_and_vehicle(broker, mqtt).await;
    settle(&mut edge, &euclid).await;
    euclid.report(1);
    assert_eq!(edge.next_report().await, (name("euclid"), 1));
    settle(&mut euclid, &edge).await;
    edge.send(GatewayMessage::PublishMap {
        map: map("edge", 88),
    });
    assert_eq!(euclid.next_map_round().await, 88);
    assert_eq!(edge.next_map_round().await, 88, "in-process");
    until("the broker's echo is dropped", || {
        edge.counters.events(Event::Echo) >= 2
    })
    .await;
}

/// A node's subscription is active once another node's retained status has arrived through it.
async fn settle(receiver: &mut Node, sender: &Node) {
    sender.send(GatewayMessage::PublishStatus {
        status: sender.status.clone(),
    });
    receiver.next_state_of(sender.name.as_str()).await;
}

#[tokio::test]
async fn embedded_broker_relays_versions_and_encodings() {
    let (_broker, address) = embedded();
    for version in [MqttVersion::V311, MqttVersion::V5] {
        for encoding in [Encoding::Json, Encoding::Cbor, Encoding::Compact] {
            report_and_map_pass(
                &address,
                MqttConfig {
                    version,
                    encoding,
                    ..MqttConfig::default()
                },
            )
            .await;
        }
    }
}

#[tokio::test]
async fn mosquitto_relays_both_versions() {
    let broker = Mosquitto::start();
    for version in [MqttVersion::V311, MqttVersion::V5] {
        report_and_map_pass(
            &broker.address(),
            MqttConfig {
                version,
                ..MqttConfig::default()
            },
        )
        .await;
    }
}

#[tokio::test]
async fn versions_mix_at_one_broker() {
    let (_broker, address) = embedded();
    let v5 = MqttConfig {
        version: MqttVersion::V5,
        ..MqttConfig::default()
    };
    let mut edge = Node::join("edge", SubscriptionRole::Candidate, v5, &[&address]).await;
    let euclid = Node::follower("euclid", &address).await;
    settle(&mut edge, &euclid).await;
    euclid.report(3);
    assert_eq!(edge.next_report().await, (name("euclid"), 3));
}

#[tokio::test]
async fn user_and_password_are_presented() {
    let broker = Mosquitto::with_user("ecod", "hush");
    for version in [MqttVersion::V311, MqttVersion::V5] {
        let right = MqttConfig {
            version,
            user: Some("ecod".to_owned()),
            password: Some(Secret::new("hush")),
            ..MqttConfig::default()
        };
        report_and_map_pass(&broker.address(), right.clone()).await;
        let wrong = MqttConfig {
            password: Some(Secret::new("loud")),
            ..right
        };
        let intruder = Node::start("mallory", SubscriptionRole::Follower, wrong).await;
        intruder.send(GatewayMessage::SetBrokers {
            addresses: vec![broker.address()],
        });
        until("refusals are counted", || {
            intruder.counters.events(Event::ConnectFailed) >= 2
        })
        .await;
        assert_eq!(intruder.counters.events(Event::Connected), 0);
        assert_eq!(
            intruder.counters.events(Event::BrokerRefused),
            1,
            "reported once, not with every attempt"
        );
    }
}

#[tokio::test]
async fn silent_publish_refusal_is_reported() {
    let permitted = Mosquitto::with_permissions("ecod", "hush", "topic readwrite ecod/v1/test/#");
    let denied = Mosquitto::with_permissions("ecod", "hush", "topic read ecod/v1/test/#");
    for version in [MqttVersion::V311, MqttVersion::V5] {
        let mqtt = MqttConfig {
            version,
            user: Some("ecod".to_owned()),
            password: Some(Secret::new("hush")),
            keep_alive_s: if version == MqttVersion::V5 { 5 } else { 1 },
            connect_timeout_ms: 500,
            ..MqttConfig::default()
        };
        let gauss = Node::join(
            "gauss",
            SubscriptionRole::Follower,
            mqtt.clone(),
            &[&permitted.address()],
        )
        .await;
        let euclid = Node::join(
            "euclid",
            SubscriptionRole::Follower,
            mqtt,
            &[&denied.address()],
        )
        .await;
        until("the refusal is reported", || {
            euclid.counters.events(Event::BrokerRefused) == 1
        })
        .await;
        until("gauss receives its own message", || {
            gauss.counters.events(Event::Echo) > 0
        })
        .await;
        assert_eq!(gauss.counters.events(Event::BrokerRefused), 0);
    }
}

#[tokio::test]
async fn stall_accuses_no_broker() {
    let (_broker, address) = embedded();
    let mqtt = MqttConfig {
        connect_timeout_ms: 100,
        ..MqttConfig::default()
    };
    let euclid = Node::join("euclid", SubscriptionRole::Follower, mqtt, &[&address]).await;
    std::thread::sleep(Duration::from_millis(300));
    until("euclid receives its own message", || {
        euclid.counters.events(Event::Echo) > 0
    })
    .await;
    assert_eq!(euclid.counters.events(Event::BrokerRefused), 0);
}

#[tokio::test]
async fn node_publishes_on_all_links_once() {
    let (_first, one) = embedded();
    let (_second, two) = embedded();
    let mut edge = Node::join(
        "edge",
        SubscriptionRole::Candidate,
        MqttConfig::default(),
        &[&one, &two],
    )
    .await;
    let mut left = Node::follower("left", &one).await;
    let mut right = Node::follower("right", &two).await;
    settle(&mut left, &edge).await;
    settle(&mut right, &edge).await;
    for round in [1, 2] {
        edge.send(GatewayMessage::PublishMap {
            map: map("edge", round),
        });
        assert_eq!(left.next_map_round().await, round);
        assert_eq!(right.next_map_round().await, round);
        assert_eq!(edge.next_map_round().await, round);
    }

    edge.send(GatewayMessage::SetBrokers {
        addresses: vec![two.clone()],
    });
    edge.report(5);
    assert_eq!(
        edge.next_report().await,
        (name("edge"), 5),
        "a candidate takes its own report in-process"
    );
    edge.send(GatewayMessage::PublishMap {
        map: map("edge", 3),
    });
    assert_eq!(right.next_map_round().await, 3);
    edge.send(GatewayMessage::SetBrokers {
        addresses: vec![one.clone(), two.clone()],
    });
    assert_eq!(
        edge.link(LinkState::Up).await,
        one,
        "the link that stayed was not touched"
    );
    edge.send(GatewayMessage::PublishMap {
        map: map("edge", 4),
    });
    assert_eq!(
        left.next_map_round().await,
        4,
        "round 3 was not for this broker"
    );
}

#[tokio::test]
async fn reconnection_delivers_only_new_messages() {
    for version in [MqttVersion::V311, MqttVersion::V5] {
        let mut broker = Mosquitto::start();
        let address = broker.address();
        let mqtt = MqttConfig {
            version,
            ..MqttConfig::default()
        };
        let (mut edge, mut euclid) = edge_and_vehicle(&address, mqtt).await;
        settle(&mut edge, &euclid).await;

        broker.kill();
        euclid.link(LinkState::Refused).await;
        let refused = euclid.counters.events(Event::PublishRefused);
        (10..20).for_each(|seq| euclid.report(seq));
        until("reports are refused", || {
            euclid.counters.events(Event::PublishRefused) == refused + 10
        })
        .await;

        broker.revive();
        edge.link(LinkState::Up).await;
        euclid.link(LinkState::Up).await;
        settle(&mut edge, &euclid).await;
        euclid.report(100);
        assert_eq!(edge.next_report().await, (name("euclid"), 100));
    }
}

#[tokio::test]
async fn restarted_embedded_broker_is_reconnected() {
    let (mut broker, address) = embedded();
    let (mut edge, mut euclid) = edge_and_vehicle(&address, MqttConfig::default()).await;
    for seq in 1..=3 {
        broker.restart(LOOPBACK).unwrap();
        edge.link(LinkState::Up).await;
        euclid.link(LinkState::Up).await;
        settle(&mut edge, &euclid).await;
        euclid.report(seq);
        assert_eq!(edge.next_report().await, (name("euclid"), seq));
    }
}

#[tokio::test]
async fn observer_keeps_receiving_reports() {
    let (_broker, address) = embedded();
    let mut observer = Node::join(
        "recorder",
        SubscriptionRole::Observer,
        MqttConfig::default(),
        &[&address],
    )
    .await;
    let euclid = Node::follower("euclid", &address).await;
    settle(&mut observer, &euclid).await;
    for wanted in [true, false] {
        observer.send(GatewayMessage::WatchReports { wanted });
    }
    // An UNSUBSCRIBE takes effect before a message that is sent later on the same connection returns.
    let before = observer.counters.events(Event::Echo);
    observer.send(GatewayMessage::PublishStatus {
        status: observer.status.clone(),
    });
    until("the status returns", || {
        observer.counters.events(Event::Echo) > before
    })
    .await;
    euclid.report(5);
    assert_eq!(observer.next_report().await, (name("euclid"), 5));
}

#[tokio::test]
async fn missing_echoes_reveal_hanging_broker() {
    for version in [MqttVersion::V311, MqttVersion::V5] {
        let broker = Mosquitto::start();
        let address = broker.address();
        // Long enough that the protocol's own keep-alive does not occur in this time.
        let mqtt = MqttConfig {
            version,
            keep_alive_s: 600,
            ..MqttConfig::default()
        };
        let mut edge = Node::join(
            "edge",
            SubscriptionRole::Candidate,
            mqtt.clone(),
            &[&address],
        )
        .await;
        let publishing = publish_maps(&edge);
        tokio::time::sleep(Duration::from_secs(2)).await;
        broker.freeze();
        let frozen = Instant::now();
        // The only event of the link so far is that it came up, which `join` consumed.
        let stalled = edge.next(|message| match message {
            Incoming::Link { state, .. } => Some(*state),
            _ => None,
        });
        assert_eq!(stalled.await, LinkState::Stalled);
        eprintln!("{version:?}: noticed after {:?}", frozen.elapsed());
        broker.thaw();
        edge.link(LinkState::Up).await;
        publishing.abort();
    }
}

/// Ten maps a second until aborted.
fn publish_maps(node: &Node) -> JoinHandle<()> {
    let gateway = node.gateway.clone();
    tokio::spawn(async move {
        let mut ticks = tokio::time::interval(Duration::from_millis(100));
        for round in 1.. {
            ticks.tick().await;
            gateway
                .cast(GatewayMessage::PublishMap {
                    map: map("edge", round),
                })
                .unwrap();
        }
    })
}
