//! Junk from the network: each kind is counted under its own reason, without further effects.

use std::collections::BTreeMap;

use ecod::wire::{Encoding, RejectReason, encode};
use ecod_actors::messages::gateway::GatewayMessage;
use ecod_actors::transport::mqtt::{LinkState, MqttConfig, MqttVersion};
use ecod_testkit::until;

use crate::gateway::cell::{Stranger, edge_and_vehicle, embedded, name, report, topic};
use crate::mosquitto::Mosquitto;

fn objects(count: usize) -> String {
    let object = r#"{"label":"car","confidence":0.5,"x_m":0.0,"y_m":0.0}"#;
    let objects = vec![object; count].join(",");
    format!(r#"{{"schema":1,"node":"mallory","seq":1,"captured_at_us":1,"objects":[{objects}]}}"#)
}

fn junk() -> Vec<(&'static str, Vec<u8>, RejectReason)> {
    let good = objects(1);
    let mut nan = report("mallory", 1);
    nan.objects[0].x_m = f64::NAN;
    let mut not_utf8 = good.clone().into_bytes();
    let letter = good.find("car").unwrap();
    not_utf8[letter] = 0xff;
    vec![
        (
            "detections/mallory",
            good.as_bytes()[..good.len() - 9].to_vec(),
            RejectReason::Malformed,
        ),
        ("detections/mallory", not_utf8, RejectReason::Malformed),
        ("detections/mallory", vec![], RejectReason::Malformed),
        (
            "detections/mallory",
            vec![0xff; 64],
            RejectReason::Malformed,
        ),
        (
            "detections/mallory",
            good.replace("\"schema\":1", "\"schema\":2").into(),
            RejectReason::UnknownSchema,
        ),
        (
            "detections/mallory",
            r#"{"schema":9,"new":true}"#.into(),
            RejectReason::UnknownSchema,
        ),
        (
            "detections/trent",
            good.clone().into(),
            RejectReason::NodeMismatch,
        ),
        (
            "detections/mallory",
            encode(&nan, Encoding::Cbor),
            RejectReason::NotFinite,
        ),
        (
            "detections/mallory",
            good.replace("\"x_m\":0.0", "\"x_m\":1e999").into(),
            RejectReason::NotFinite,
        ),
        (
            "detections/mallory",
            good.replace("\"x_m\":0.0", "\"x_m\": NaN").into(),
            RejectReason::NotFinite,
        ),
        (
            "detections/mallory",
            good.replace("0.5", "2").into(),
            RejectReason::ConfidenceOutOfRange,
        ),
        (
            "vote_detections/mallory",
            good.replace("0.5", "-0.1").into(),
            RejectReason::ConfidenceOutOfRange,
        ),
        (
            "detections/mallory",
            objects(2000).into(),
            RejectReason::TooManyObjects,
        ),
        (
            "detections/mallory",
            vec![b' '; 300 * 1024],
            RejectReason::TooLarge,
        ),
        (
            "detections/mallory",
            good.replace("car", "").into(),
            RejectReason::InvalidLabel,
        ),
        (
            "detections/no name",
            good.into(),
            RejectReason::UnknownTopic,
        ),
        ("global_detections", b"{}".to_vec(), RejectReason::Malformed),
        (
            "nodes/trent",
            b"{\"schema\":2}".to_vec(),
            RejectReason::UnknownSchema,
        ),
    ]
}

#[tokio::test]
async fn each_junk_kind_has_counter() {
    for version in [MqttVersion::V311, MqttVersion::V5] {
        let (_broker, address) = embedded();
        let mqtt = MqttConfig {
            version,
            ..MqttConfig::default()
        };
        let (mut edge, euclid) = edge_and_vehicle(&address, mqtt).await;
        edge.next_state_of("euclid").await;
        let mut mallory = Stranger::connect(&address).await;
        let mut expected = BTreeMap::new();
        for (seq, (level, payload, reason)) in (1..).zip(junk()) {
            assert!(mallory.publish(&topic(level), false, payload).await);
            *expected.entry(reason).or_insert(0) += 1;
            until(reason.as_str(), || {
                edge.counters.rejects(reason) == expected[&reason]
            })
            .await;
            euclid.report(seq);
            assert_eq!(edge.next_report().await, (name("euclid"), seq));
        }
        for reason in RejectReason::ALL {
            assert_eq!(
                edge.counters.rejects(reason),
                expected.get(&reason).copied().unwrap_or(0),
                "{reason}"
            );
        }
    }
}

#[tokio::test]
async fn million_object_sender_is_disconnected() {
    let (_broker, address) = embedded();
    let (mut edge, euclid) = edge_and_vehicle(&address, MqttConfig::default()).await;
    edge.next_state_of("euclid").await;
    let mut mallory = Stranger::connect(&address).await;
    assert!(
        !mallory
            .publish(&topic("detections/mallory"), false, objects(1_000_000))
            .await
    );
    euclid.report(1);
    assert_eq!(edge.next_report().await, (name("euclid"), 1));
}

#[tokio::test]
async fn million_objects_cost_one_reconnection() {
    let broker = Mosquitto::start();
    let address = broker.address();
    let (mut edge, euclid) = edge_and_vehicle(&address, MqttConfig::default()).await;
    edge.next_state_of("euclid").await;
    let mut mallory = Stranger::connect(&address).await;
    assert!(
        mallory
            .publish(&topic("detections/mallory"), false, objects(1_000_000))
            .await
    );
    until("too_large", || {
        edge.counters.rejects(RejectReason::TooLarge) == 1
    })
    .await;
    edge.link(LinkState::Up).await;
    euclid.send(GatewayMessage::PublishStatus {
        status: euclid.status.clone(),
    });
    edge.next_state_of("euclid").await;
    euclid.report(1);
    assert_eq!(edge.next_report().await, (name("euclid"), 1));
}
