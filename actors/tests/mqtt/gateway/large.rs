//! Maps of large cells.

use std::sync::Arc;

use ecod::wire::{Encoding, GlobalMap, LandmarkState, RejectReason};
use ecod_actors::messages::gateway::GatewayMessage;
use ecod_actors::telemetry::counters::Event;
use ecod_actors::transport::broker::{BrokerConfig, EmbeddedBroker, MqttBroker};
use ecod_actors::transport::mqtt::{BrokerAddress, Incoming, MqttConfig, SubscriptionRole};
use ecod_testkit::until;

use crate::gateway::cell::{
    LOOPBACK, Node, Stranger, edge_and_vehicle, embedded, map, name, topic,
};

/// A map in which four vehicles contribute to every landmark.
fn large_map(round: u64, landmarks: usize) -> Arc<GlobalMap> {
    let vehicles: Vec<_> = ["euclid", "gauss", "galileo", "riemann"].map(name).into();
    let state = |n: usize| LandmarkState {
        id: format!("level-3/row-{}/slot-{n}", n / 64).into(),
        label: Some(format!("B-CD {n:05}").into()),
        confidence: 0.959_422_334_534_984_5,
        x_m: n as f64 * 2.512_345_678_9,
        y_m: -(n as f64) / 3.0,
        contributors: vehicles.clone(),
        observers: vehicles.clone(),
        readings: Vec::new(),
    };
    Arc::new(GlobalMap {
        landmarks: (0..landmarks).map(state).collect(),
        ..GlobalMap::clone(&map("edge", round))
    })
}

async fn next_map(node: &mut Node) -> Arc<GlobalMap> {
    node.next(|message| match message {
        Incoming::Map(map) => Some(Arc::clone(map)),
        _ => None,
    })
    .await
}

#[tokio::test]
async fn map_with_16384_landmarks_arrives() {
    let (_broker, address) = embedded();
    for encoding in [Encoding::Json, Encoding::Cbor] {
        let mqtt = MqttConfig {
            encoding,
            ..MqttConfig::default()
        };
        let (edge, mut euclid) = edge_and_vehicle(&address, mqtt).await;
        euclid.next_state_of("edge").await;
        for (round, landmarks) in [(1, 4096), (2, 16_384)] {
            let sent = large_map(round, landmarks);
            edge.send(GatewayMessage::PublishMap {
                map: Arc::clone(&sent),
            });
            assert_eq!(next_map(&mut euclid).await, sent);
        }
        edge.stop().await;
        euclid.stop().await;
    }
}

#[tokio::test]
async fn oversized_map_is_reported() {
    let mqtt = MqttConfig {
        max_map_bytes: 4096,
        ..MqttConfig::default()
    };
    let (_broker, address) = embedded();
    let (edge, mut euclid) = edge_and_vehicle(&address, mqtt).await;
    euclid.next_state_of("edge").await;
    edge.send(GatewayMessage::PublishMap {
        map: large_map(1, 100),
    });
    edge.send(GatewayMessage::PublishMap {
        map: large_map(2, 1),
    });
    assert_eq!(euclid.next_map_round().await, 2);
    assert_eq!(edge.counters.events(Event::PublishTooLarge), 1);
    assert_eq!(euclid.counters.rejects(RejectReason::TooLarge), 0);
    assert_eq!(
        edge.counters.events(Event::Disconnected) + euclid.counters.events(Event::Disconnected),
        0
    );
}

#[tokio::test]
async fn oversized_packet_disconnects_client() {
    let mut broker = EmbeddedBroker::new(BrokerConfig {
        max_packet_bytes: Some(100_000),
        ..BrokerConfig::default()
    });
    let address = BrokerAddress::from(broker.start(LOOPBACK).unwrap());
    let mut stranger = Stranger::connect(&address).await;
    assert!(
        stranger
            .publish(&topic("detections/mallory"), false, vec![b' '; 90_000])
            .await
    );
    assert!(
        !stranger
            .publish(&topic("detections/mallory"), false, vec![b' '; 110_000])
            .await
    );
}

#[tokio::test]
async fn flawed_entry_is_dropped() {
    let (_broker, address) = embedded();
    let mqtt = MqttConfig {
        encoding: Encoding::Cbor,
        ..MqttConfig::default()
    };
    let mut euclid = Node::join(
        "euclid",
        SubscriptionRole::Follower,
        mqtt.clone(),
        &[&address],
    )
    .await;
    let edge = Node::join("edge", SubscriptionRole::Candidate, mqtt, &[&address]).await;
    euclid.next_state_of("edge").await;
    type Flaw = (fn(&mut GlobalMap), RejectReason);
    let flaws: [Flaw; 5] = [
        (|m| m.landmarks[0].x_m = f64::NAN, RejectReason::NotFinite),
        (
            |m| m.landmarks[0].confidence = 7.0,
            RejectReason::ConfidenceOutOfRange,
        ),
        (
            |m| m.landmarks[0].id = "".into(),
            RejectReason::InvalidLabel,
        ),
        (|m| m.epoch = u64::MAX, RejectReason::OutOfRange),
        (
            |m| m.fused_at_us.0 += 365 * 86_400_000_000,
            RejectReason::FromTheFuture,
        ),
    ];
    for (round, (spoil, reason)) in (1..).zip(flaws) {
        let mut spoiled = GlobalMap::clone(&large_map(round, 1));
        spoiled.fused_at_us = ecod_actors::platform::clock::now();
        spoil(&mut spoiled);
        edge.send(GatewayMessage::PublishMap {
            map: Arc::new(spoiled),
        });
        until(reason.as_str(), || euclid.counters.rejects(reason) == 1).await;
        // A flawed entry does not cost the map.
        let is_of_entry = euclid.counters.events(Event::EntryLeftOut) == round;
        assert_eq!(is_of_entry, round <= 3);
        if is_of_entry {
            assert_eq!(euclid.next_map_round().await, round);
        }
        edge.send(GatewayMessage::PublishMap {
            map: large_map(round + 1, 1),
        });
        assert_eq!(euclid.next_map_round().await, round + 1);
    }
}
