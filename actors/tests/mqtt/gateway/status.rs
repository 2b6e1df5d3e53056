//! Statuses: retained, with a last will.

use ecod::wire::{Encoding, NodeState, NodeStatus, encode};
use ecod_actors::messages::gateway::GatewayMessage;
use ecod_actors::telemetry::counters::Event;
use ecod_actors::transport::broker::MqttBroker;
use ecod_actors::transport::mqtt::{
    BrokerAddress, Incoming, LinkState, MqttConfig, MqttVersion, SubscriptionRole,
};
use ecod_testkit::until;

use crate::gateway::cell::{LOOPBACK, Node, Stranger, embedded, topic};
use crate::mosquitto::Mosquitto;

async fn latecomers_see_the_living_and_the_dead(broker: &BrokerAddress, version: MqttVersion) {
    let mqtt = MqttConfig {
        version,
        ..MqttConfig::default()
    };
    let euclid = Node::join(
        "euclid",
        SubscriptionRole::Follower,
        mqtt.clone(),
        &[broker],
    )
    .await;
    euclid.send(GatewayMessage::PublishStatus {
        status: NodeStatus {
            state: NodeState::Aggregating,
            ..euclid.status.clone()
        },
    });
    let mut gauss = Node::join("gauss", SubscriptionRole::Follower, mqtt.clone(), &[broker]).await;
    while gauss.next_state_of("euclid").await != NodeState::Aggregating {}

    euclid.kill().await;
    assert_eq!(gauss.next_state_of("euclid").await, NodeState::Offline);
    let mut late = Node::join(
        "riemann",
        SubscriptionRole::Follower,
        mqtt.clone(),
        &[broker],
    )
    .await;
    assert_eq!(
        late.next_state_of("euclid").await,
        NodeState::Offline,
        "the will is retained"
    );

    gauss.stop().await;
    while late.next_state_of("gauss").await != NodeState::Offline {}
}

#[tokio::test]
async fn embedded_v311() {
    let (_broker, address) = embedded();
    latecomers_see_the_living_and_the_dead(&address, MqttVersion::V311).await;
}

#[tokio::test]
async fn embedded_v5() {
    let (_broker, address) = embedded();
    latecomers_see_the_living_and_the_dead(&address, MqttVersion::V5).await;
}

#[tokio::test]
async fn mosquitto_v311() {
    let broker = Mosquitto::start();
    latecomers_see_the_living_and_the_dead(&broker.address(), MqttVersion::V311).await;
}

#[tokio::test]
async fn mosquitto_v5() {
    let broker = Mosquitto::start();
    latecomers_see_the_living_and_the_dead(&broker.address(), MqttVersion::V5).await;
}

#[tokio::test]
async fn living_namesakes_are_reported() {
    let (_broker, address) = embedded();
    let first = Node::follower("euclid", &address).await;
    let mut watcher = Node::follower("gauss", &address).await;
    assert_eq!(watcher.next_state_of("euclid").await, NodeState::Following);
    assert_eq!(first.counters.events(Event::NameConflict), 0);
    let second = Node::follower("euclid", &address).await;
    for node in [&first, &second] {
        until("both know", || {
            node.counters.events(Event::NameConflict) > 0
        })
        .await;
    }
    // All messages of the meantime came before this message.
    watcher.send(GatewayMessage::PublishStatus {
        status: watcher.status.clone(),
    });
    let echoes = watcher.counters.events(Event::Echo);
    until("the broker is done", || {
        watcher.counters.events(Event::Echo) > echoes
    })
    .await;
    for node in [&first, &second] {
        assert!(
            node.counters.events(Event::NameConflict) <= 2,
            "each is answered once"
        );
    }
    second.stop().await;
    let restarted = Node::follower("riemann", &address).await;
    restarted.stop().await;
    let restarted = Node::follower("riemann", &address).await;
    until("the node receives its own message", || {
        restarted.counters.events(Event::Echo) > 0
    })
    .await;
    assert_eq!(
        restarted.counters.events(Event::NameConflict),
        0,
        "a run that is over is no conflict"
    );
}

#[tokio::test]
async fn last_will_keeps_connect_epoch() {
    let (mut broker, address) = embedded();
    let mut euclid = Node::follower("euclid", &address).await;
    euclid.send(GatewayMessage::PublishStatus {
        status: NodeStatus {
            epoch: 7,
            ..euclid.status.clone()
        },
    });
    broker.restart(LOOPBACK).unwrap();
    euclid.link(LinkState::Up).await;
    let mut watcher = Node::follower("gauss", &address).await;
    assert_eq!(watcher.next_state_of("euclid").await, NodeState::Following);
    euclid.kill().await;
    let epoch = watcher
        .next(|message| match message {
            Incoming::Status { status, .. } if status.state == NodeState::Offline => {
                Some(status.epoch)
            }
            _ => None,
        })
        .await;
    assert_eq!(epoch, 7);
}

#[tokio::test]
async fn late_will_is_corrected() {
    let (_broker, address) = embedded();
    let euclid = Node::follower("euclid", &address).await;
    let mut watcher = Node::follower("gauss", &address).await;
    assert_eq!(watcher.next_state_of("euclid").await, NodeState::Following);

    let will = NodeStatus {
        state: NodeState::Offline,
        ..euclid.status.clone()
    };
    let mut stranger = Stranger::connect(&address).await;
    assert!(
        stranger
            .publish(&topic("nodes/euclid"), true, encode(&will, Encoding::Json))
            .await
    );
    assert_eq!(watcher.next_state_of("euclid").await, NodeState::Offline);
    assert_eq!(watcher.next_state_of("euclid").await, NodeState::Following);
}
