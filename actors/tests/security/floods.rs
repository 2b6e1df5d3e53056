//! Clients that connect too often, wait too long, or send too much or malformed MQTT.

use std::collections::VecDeque;
use std::net::{Ipv4Addr, SocketAddr};
use std::sync::Arc;
use std::time::Duration;

use ecod::wire::Role;
use ecod_actors::node::config::NodeConfig;
use ecod_actors::telemetry::counters::Event;
use ecod_actors::transport::broker::BrokerConfig;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::time::timeout;

use crate::fixture::{
    Cell, Client, DAY, MAX_EACH, MAX_PACKET, MAX_REPORT, SOON, client_config, knock, knock_from,
    node, secure,
};

/// Waits until the other side has closed, whatever came before.
async fn closed(stream: &mut (impl AsyncReadExt + Unpin)) {
    let mut buffer = [0; 1024];
    let ended = async { while matches!(stream.read(&mut buffer).await, Ok(1..)) {} };
    timeout(SOON, ended)
        .await
        .expect("the connection stays open");
}

#[tokio::test]
async fn connection_flood_blocks_no_client() {
    let mut cell = Cell::start().await;
    for _ in 0..300 {
        drop(knock(cell.address).await);
    }
    cell.counted(Event::ClientThrottled, 100).await;
    let files = cell.pki.issue("gauss", Role::Auto, DAY);
    Client::new(cell.address, "gauss", &client_config("gauss", &files))
        .log_in()
        .await
        .unwrap();
    cell.honest_traffic_goes_on().await;
}

/// A flood from the address of an honest node, such as from behind the same address translation.
#[tokio::test]
async fn node_reconnects_during_flood() {
    let adjust = |config: &mut BrokerConfig| {
        config.connects_per_s = 20;
        config.handshake_timeout_ms = 5000;
    };
    let mut cell = Cell::start_with(adjust).await;
    let broker = cell.address;
    let flood = tokio::spawn(async move {
        let mut held = VecDeque::new();
        let mut ticks = tokio::time::interval(Duration::from_millis(20));
        loop {
            ticks.tick().await;
            held.push_back(knock_from(Ipv4Addr::LOCALHOST, broker).await);
            if held.len() > 200 {
                held.pop_front();
            }
        }
    });
    // By now a stranger's burst would be used up, and as many wait as may.
    cell.counted(Event::ClientThrottled, 60).await;
    let files = cell.pki.issue("gauss", Role::Auto, DAY);
    for _ in 0..5 {
        Client::new(cell.address, "gauss", &client_config("gauss", &files))
            .log_in()
            .await
            .expect("kept out");
        cell.honest_traffic_goes_on().await;
    }
    assert!(!flood.is_finished());
    flood.abort();
}

#[tokio::test]
async fn slow_login_loses_its_place() {
    let mut cell = Cell::start_with(|config| config.handshake_timeout_ms = 700).await;
    let mut silent = Vec::new();
    for _ in 0..20 {
        silent.push(knock(cell.address).await);
    }
    let mut halfway = knock(cell.address).await;
    // The beginning of a handshake without the rest.
    halfway.write_all(&[22, 3, 1, 2, 0, 1, 0]).await.unwrap();
    let mut slow = secure(&mut cell).await;
    slow.write_all(&[0x10, 60, 0, 4]).await.unwrap();
    cell.honest_traffic_goes_on().await;
    for stream in &mut silent {
        closed(stream).await;
    }
    closed(&mut halfway).await;
    closed(&mut slow).await;
    cell.counted(Event::ClientTimedOut, 22).await;
    cell.honest_traffic_goes_on().await;
}

#[tokio::test]
async fn foreign_protocol_ends_its_connection() {
    let mut cell = Cell::start().await;
    let mut rng = ChaCha8Rng::seed_from_u64(6);
    let login = [0x10, 12, 0, 4, b'M', b'Q', b'T', b'T', 4, 2, 0, 60, 0, 0];
    let openings: [Vec<u8>; 6] = [
        b"GET / HTTP/1.1\r\n\r\n".to_vec(),
        // A length that does not end, and one beyond any login.
        vec![0x10, 0xff, 0xff, 0xff, 0xff, 0xff],
        vec![0x10, 0xff, 0xff, 0x7f],
        // A login of an unknown protocol; two logins; a login and noise.
        vec![0x10, 12, 0, 4, b'M', b'Q', b'X', b'X', 9, 2, 0, 60, 0, 0],
        [login, login].concat(),
        login
            .into_iter()
            .chain((0..200).map(|_| rng.random()))
            .chain([0x30, 0xff, 0xff, 0xff, 0xff, 0xff])
            .collect(),
    ];
    for opening in openings {
        let mut stream = secure(&mut cell).await;
        stream.write_all(&opening).await.unwrap();
        closed(&mut stream).await;
        cell.honest_traffic_goes_on().await;
    }
    cell.counted(Event::ClientMalformed, 3).await;
}

#[tokio::test]
async fn port_probe_is_not_counted() {
    let mut cell = Cell::start().await;
    for _ in 0..3 {
        let mut stream = knock(cell.address).await;
        stream.shutdown().await.unwrap();
        closed(&mut stream).await;
    }
    cell.honest_traffic_goes_on().await;
    let counted =
        [Event::ClientUntrusted, Event::ClientMalformed].map(|event| cell.counters.events(event));
    assert_eq!(counted, [0, 0]);
}

#[tokio::test]
async fn oversized_packet_ends_its_connection() {
    let mut cell = Cell::start().await;
    let files = cell.pki.issue("gauss", Role::Auto, DAY);
    let mut gauss = Client::new(cell.address, "gauss", &client_config("gauss", &files));
    gauss.log_in().await.unwrap();
    gauss.publish("ecod/v1/lot/detections/gauss", &vec![b'x'; 2 * MAX_PACKET]);
    timeout(SOON, gauss.drive()).await.expect("still connected");
    cell.honest_traffic_goes_on().await;
}

#[tokio::test]
async fn map_sized_report_is_refused() {
    let mut cell = Cell::start().await;
    let files = cell.pki.issue("gauss", Role::Auto, DAY);
    let mut gauss = Client::new(cell.address, "gauss", &client_config("gauss", &files));
    gauss.log_in().await.unwrap();
    let large = vec![b'x'; 2 * MAX_REPORT];
    gauss
        .publish_all_and_wait("ecod/v1/lot/detections/gauss", false, &large)
        .await
        .unwrap();
    assert_eq!(cell.counters.events(Event::ClientDenied), 1);
    cell.honest_traffic_goes_on().await;
}

#[tokio::test]
async fn certificate_takes_no_foreign_places() {
    let mut cell = Cell::start().await;
    let files = cell.pki.issue("gauss", Role::Auto, DAY);
    let tls = client_config("gauss", &files);
    let mut held = Vec::new();
    for _ in 0..MAX_EACH {
        let mut client = Client::new(cell.address, "gauss", &tls);
        client.log_in().await.unwrap();
        held.push(client);
    }
    assert!(
        Client::new(cell.address, "gauss", &tls)
            .log_in()
            .await
            .is_err()
    );
    cell.counted(Event::ClientsFull, 1).await;
    cell.honest_traffic_goes_on().await;
    held.pop();
    let returned = async {
        while Client::new(cell.address, "gauss", &tls)
            .log_in()
            .await
            .is_err()
        {
            tokio::time::sleep(Duration::from_millis(100)).await;
        }
    };
    timeout(SOON, returned)
        .await
        .expect("who leaves makes room");
}

/// The broker of an unconfigured node: for this machine only, without certificates.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn limits_hold_on_default_loopback() {
    let mut config = NodeConfig {
        name: Some(node("edge")),
        role: Role::Edge,
        ..NodeConfig::default()
    };
    config.listen = Some(SocketAddr::from((Ipv4Addr::LOCALHOST, 0)));
    config.membership.bind = Some(SocketAddr::from((Ipv4Addr::LOCALHOST, 0)));
    config.membership.multicast.enabled = false;
    let edge = ecod_actors::node::start(config).await.unwrap();
    let address = edge.broker_address().unwrap();
    let mut silent = Vec::new();
    for _ in 0..20 {
        silent.push(knock_from(Ipv4Addr::LOCALHOST, address).await);
    }
    let mut dribbling = knock_from(Ipv4Addr::LOCALHOST, address).await;
    dribbling.write_all(&[0x10, 60, 0, 4]).await.unwrap();
    let mut options = rumqttc::MqttOptions::new("anyone", "127.0.0.1", address.port());
    options.set_keep_alive(Duration::from_secs(5));
    let (_client, mut events) = rumqttc::AsyncClient::new(options, 8);
    timeout(SOON, events.poll())
        .await
        .expect("kept out")
        .unwrap();
    closed(&mut dribbling).await;
    for stream in &mut silent {
        closed(stream).await;
    }
    let counted = async {
        while edge.counters().events(Event::ClientTimedOut) < 21 {
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
    };
    timeout(SOON, counted).await.expect("not counted");
    edge.stop().await;
}

/// A broker that is not behind TLS but open to others has the same limits.
#[tokio::test]
async fn limits_hold_without_certificates_too() {
    use ecod::wire::Topics;
    use ecod_actors::telemetry::counters::Counters;
    use ecod_actors::transport::broker::{AccessPolicy, EmbeddedBroker, MqttBroker};

    let counters = Arc::<Counters>::default();
    let guard = AccessPolicy {
        credentials: None,
        topics: Topics::new(&node("lot")),
        limits: Default::default(),
        elected: Arc::new(|_| true),
        counters: Arc::clone(&counters),
    };
    let config = BrokerConfig {
        handshake_timeout_ms: 300,
        ..BrokerConfig::default()
    };
    let mut broker = EmbeddedBroker::protected(config, guard);
    let address = broker
        .start(SocketAddr::from((Ipv4Addr::LOCALHOST, 0)))
        .unwrap();
    let mut silent = knock(address).await;
    closed(&mut silent).await;
    // Counted a moment after the connection is closed.
    let counted = async {
        while counters.events(Event::ClientTimedOut) < 1 {
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
    };
    timeout(SOON, counted).await.expect("not counted");
    let mut options = rumqttc::MqttOptions::new("anyone", "127.0.0.1", address.port());
    options.set_keep_alive(Duration::from_secs(5));
    let (_client, mut events) = rumqttc::AsyncClient::new(options, 8);
    timeout(SOON, events.poll()).await.unwrap().unwrap();
}
