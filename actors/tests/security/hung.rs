//! A broker whose thread hangs.

use std::net::{Ipv4Addr, SocketAddr};
use std::sync::{Arc, Mutex, mpsc};
use std::time::{Duration, Instant};

use ecod::wire::{Role, Topics};
use ecod_actors::transport::broker::{
    AccessPolicy, BrokerConfig, BrokerHealth, EmbeddedBroker, MqttBroker,
};
use ecod_actors::transport::pki::Credentials;
use tokio::time::{sleep, timeout};

use crate::fixture::{Client, DAY, Pki, SOON, client_config, node};

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn hanging_broker_is_declared_dead() {
    let mut pki = Pki::new();
    let files = pki.issue("edge", Role::Edge, DAY);
    let (release, held) = mpsc::channel::<()>();
    let held = Mutex::new(held);
    let guard = AccessPolicy {
        credentials: Some(Arc::new(Credentials::load(&files, &node("edge")).unwrap())),
        topics: Topics::new(&node("lot")),
        limits: Default::default(),
        // A check on the broker's thread that does not return while the test runs.
        elected: Arc::new(move |_| held.lock().unwrap().recv().is_ok()),
        counters: Arc::default(),
    };
    let mut broker = EmbeddedBroker::protected(BrokerConfig::default(), guard);
    let address = broker
        .start(SocketAddr::from((Ipv4Addr::LOCALHOST, 0)))
        .unwrap();
    let mut edge = Client::new(address, "edge", &client_config("edge", &files));
    edge.log_in().await.unwrap();
    for _ in 0..10 {
        assert_eq!(broker.health(), BrokerHealth::Serving(address));
        sleep(Duration::from_millis(250)).await;
    }
    edge.publish("ecod/v1/lot/global_detections", b"map");
    let driving = tokio::spawn(async move { edge.drive().await });
    let found = async {
        while broker.health() != BrokerHealth::Dead {
            sleep(Duration::from_millis(250)).await;
        }
    };
    timeout(SOON, found).await.expect("still taken for well");
    let begun = Instant::now();
    broker.stop();
    assert!(
        begun.elapsed() < SOON / 2,
        "waited {:?} for a broker that hangs",
        begun.elapsed()
    );
    driving.abort();
    drop(release);
}
