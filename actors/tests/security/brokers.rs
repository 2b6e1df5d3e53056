//! Brokers whose certificate was good when a vehicle connected.

use std::net::{Ipv4Addr, SocketAddr};
use std::sync::Arc;
use std::time::Duration;

use ecod::wire::{NodeStatus, Role, Topics};
use ecod_actors::actors::gateway::{Gateway, GatewayArguments};
use ecod_actors::messages::gateway::GatewayMessage;
use ecod_actors::node::config::NodeConfig;
use ecod_actors::telemetry::counters::{Counters, Event};
use ecod_actors::transport::broker::{AccessPolicy, BrokerConfig, EmbeddedBroker, MqttBroker};
use ecod_actors::transport::mqtt::{BrokerAddress, Incoming, LinkState, SubscriptionRole};
use ecod_actors::transport::pki::Credentials;
use ractor::Actor;
use tokio::sync::mpsc;
use tokio::time::timeout;
use uuid::Uuid;

use crate::fixture::{Cell, DAY, GONE_WITHIN, SOON, node};

/// A second broker of the cell.
fn stolen(cell: &mut Cell) -> (EmbeddedBroker, BrokerAddress) {
    let files = cell.pki.issue("stolen", Role::Auto, DAY);
    let guard = AccessPolicy {
        credentials: Some(Arc::new(
            Credentials::load(&files, &node("stolen")).unwrap(),
        )),
        topics: Topics::new(&node("lot")),
        limits: Default::default(),
        elected: Arc::new(|_| true),
        counters: Arc::default(),
    };
    let mut broker = EmbeddedBroker::protected(BrokerConfig::default(), guard);
    let address = broker
        .start(SocketAddr::from((Ipv4Addr::LOCALHOST, 0)))
        .unwrap();
    (broker, address.into())
}

#[tokio::test]
async fn vehicle_leaves_only_revoked_broker() {
    let mut cell = Cell::start().await;
    let (_broker, stolen) = stolen(&mut cell);
    let honest = BrokerAddress::from(cell.address);
    let tls = Some(cell.pki.issue("gauss", Role::Cav, DAY));
    let config = NodeConfig {
        name: Some(node("gauss")),
        cell: node("lot"),
        tls,
        ..NodeConfig::default()
    };
    let (sender, mut links) = mpsc::unbounded_channel();
    let counters = Arc::<Counters>::default();
    let arguments = GatewayArguments {
        cell: node("lot"),
        role: SubscriptionRole::Follower,
        status: NodeStatus::starting(node("gauss"), Uuid::now_v7(), Role::Cav, "0.1.0"),
        mqtt: config.mqtt.clone(),
        security: config.security().unwrap(),
        clock: Default::default(),
        counters: Arc::clone(&counters),
        subscriber: Arc::new(move |delivery| {
            if let Incoming::Link { broker, state } = delivery.message
                && let Err(error) = sender.send((broker, state))
            {
                eprintln!("after the test: {error}");
            }
        }),
        seed: 4,
        only_observes: false,
    };
    let (gateway, _) = Actor::spawn(None, Gateway, arguments).await.unwrap();
    gateway
        .cast(GatewayMessage::SetBrokers {
            addresses: vec![honest.clone(), stolen.clone()],
        })
        .unwrap();
    for _ in 0..2 {
        let (_, state) = timeout(SOON, links.recv()).await.unwrap().unwrap();
        assert_eq!(state, LinkState::Up);
    }

    cell.pki
        .authority
        .revoke(&node("stolen"), ecod_actors::platform::clock::now())
        .unwrap();
    let lost = timeout(GONE_WITHIN, links.recv())
        .await
        .expect("still connected");
    assert_eq!(lost, Some((stolen.clone(), LinkState::Down)));
    let refused = async {
        while counters.events(Event::ConnectFailed) < 2 {
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    };
    timeout(SOON, refused).await.unwrap();
    assert_eq!(
        (
            counters.events(Event::Connected),
            counters.events(Event::Disconnected)
        ),
        (2, 1)
    );
    let links = ractor::call_t!(gateway, |reply| GatewayMessage::Links { reply }, 5000).unwrap();
    assert_eq!(
        (links[&honest], links[&stolen]),
        (LinkState::Up, LinkState::Down)
    );
    gateway.stop(None);
}
