//! A shared broker, such as a town's: every client of the broker can publish, only the cell's nodes can sign.

use std::net::{Ipv4Addr, SocketAddr};
use std::time::Duration;

use ecod::perception::landmark::LandmarkConfig;
use ecod::wire::{RejectReason, Role};
use ecod_actors::node::config::NodeConfig;
use ecod_actors::node::{self, NodeHandle};
use ecod_actors::platform::secret::Secret;
use ecod_actors::transport::broker::{BrokerConfig, EmbeddedBroker, MqttBroker};
use ecod_testkit::node_config;
use rumqttc::{AsyncClient, MqttOptions, QoS};
use tokio::time::{Instant, sleep, timeout};

use crate::fixture::SOON;

fn config(node: &str, role: Role, broker: SocketAddr, gossip: Option<SocketAddr>) -> NodeConfig {
    let mut config = NodeConfig {
        listen: None,
        landmarks: vec![LandmarkConfig::at("slot-0", 0.0, 0.0)],
        ..node_config(node, "lot", role)
    };
    config.mqtt.broker = Some(broker.into());
    config.mqtt.sign = true;
    config.membership.key = Some(Secret::new("5e".repeat(32)));
    config.membership.seeds = gossip.iter().map(ToString::to_string).collect();
    config.validate().unwrap();
    config
}

/// Waits for a map that is newer than the present map.
async fn takes_a_map(node: &NodeHandle) {
    let mut maps = node.newest_map();
    maps.mark_unchanged();
    let newer = timeout(SOON, maps.wait_for(Option::is_some)).await;
    let aggregator = newer
        .expect("no map")
        .unwrap()
        .as_ref()
        .map(|newest| newest.map.aggregator.to_string());
    assert_eq!(aggregator.as_deref(), Some("edge"));
    timeout(SOON, maps.changed())
        .await
        .expect("maps ended")
        .unwrap();
}

#[tokio::test]
async fn unsigned_payloads_are_counted() {
    let mut shared = EmbeddedBroker::new(BrokerConfig::default());
    let broker = shared
        .start(SocketAddr::from((Ipv4Addr::LOCALHOST, 0)))
        .unwrap();
    let edge = node::start(config("edge", Role::Edge, broker, None))
        .await
        .unwrap();
    let euclid = node::start(config("euclid", Role::Cav, broker, edge.gossip_address()))
        .await
        .unwrap();
    takes_a_map(&euclid).await;

    let (stranger, mut events) = AsyncClient::new(
        MqttOptions::new("stranger", "127.0.0.1", broker.port()),
        256,
    );
    stranger
        .try_subscribe("ecod/v1/lot/global_detections", QoS::AtMostOnce)
        .unwrap();
    let overheard = async {
        loop {
            if let rumqttc::Event::Incoming(rumqttc::Packet::Publish(publish)) =
                events.poll().await.unwrap()
            {
                return publish.payload;
            }
        }
    };
    let overheard = timeout(SOON, overheard).await.unwrap();
    assert_eq!(overheard[0], 0xec, "an envelope");
    let forged = br#"{"schema":1,"aggregator":"edge","epoch":9007199254740991,"round":1,"fused_at_us":1,"landmarks":[],"objects":[]}"#;
    stranger
        .try_publish(
            "ecod/v1/lot/global_detections",
            QoS::AtMostOnce,
            false,
            forged.as_slice(),
        )
        .unwrap();
    let offline = br#"{"schema":1,"node":"edge","state":"offline"}"#;
    stranger
        .try_publish(
            "ecod/v1/lot/nodes/edge",
            QoS::AtMostOnce,
            false,
            offline.as_slice(),
        )
        .unwrap();
    // Genuine, but of another topic.
    stranger
        .try_publish(
            "ecod/v1/lot/global_verdicts",
            QoS::AtMostOnce,
            false,
            overheard,
        )
        .unwrap();
    let until = Instant::now() + SOON;
    while euclid.counters().rejects(RejectReason::BadSignature) < 3 {
        assert!(
            Instant::now() < until,
            "{:?}",
            euclid.counters().snapshot().rejects
        );
        timeout(Duration::from_millis(20), events.poll()).await.ok();
        sleep(Duration::from_millis(5)).await;
    }
    takes_a_map(&euclid).await;
    euclid.stop().await;
    edge.stop().await;
}
