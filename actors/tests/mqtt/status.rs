//! Statuses: retained, with a last will.

use ecod::wire::{Encoding, NodeState, NodeStatus, encode};
use ecod_actors::gateway::{BrokerAddress, GatewayMessage, MqttConfig, MqttVersion, Part};

use crate::cell::{Node, Stranger, embedded, topic};
use crate::mosquitto::Mosquitto;

async fn latecomers_see_the_living_and_the_dead(broker: &BrokerAddress, version: MqttVersion) {
    let mqtt = MqttConfig { version, ..MqttConfig::default() };
    let euclid = Node::join("euclid", Part::Follower, mqtt.clone(), &[broker]).await;
    euclid.send(GatewayMessage::PublishStatus {
        status: NodeStatus { state: NodeState::Aggregating, ..euclid.status.clone() },
    });
    let mut gauss = Node::join("gauss", Part::Follower, mqtt.clone(), &[broker]).await;
    while gauss.next_state_of("euclid").await != NodeState::Aggregating {}

    euclid.kill().await;
    assert_eq!(gauss.next_state_of("euclid").await, NodeState::Offline);
    let mut late = Node::join("riemann", Part::Follower, mqtt.clone(), &[broker]).await;
    assert_eq!(late.next_state_of("euclid").await, NodeState::Offline, "the will is retained");

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
async fn a_will_that_fires_late_is_put_right() {
    let (_broker, address) = embedded();
    let euclid = Node::join("euclid", Part::Follower, MqttConfig::default(), &[&address]).await;
    let mut watcher = Node::join("gauss", Part::Follower, MqttConfig::default(), &[&address]).await;
    assert_eq!(watcher.next_state_of("euclid").await, NodeState::Following);

    let will = NodeStatus { state: NodeState::Offline, ..euclid.status.clone() };
    let mut stranger = Stranger::connect(&address).await;
    assert!(stranger.publish(&topic("nodes/euclid"), true, encode(&will, Encoding::Json)).await);
    assert_eq!(watcher.next_state_of("euclid").await, NodeState::Offline);
    assert_eq!(watcher.next_state_of("euclid").await, NodeState::Following);
}
