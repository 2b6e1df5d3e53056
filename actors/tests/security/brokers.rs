//! Brokers whose certificate was good when a vehicle connected.

use std::sync::Arc;

use ecod::wire::{NodeStatus, Role};
use ecod_actors::config::NodeConfig;
use ecod_actors::counters::{Counters, Event};
use ecod_actors::gateway::{Gateway, GatewayArguments, GatewayMessage, Incoming, LinkState, Part, Security};
use ractor::Actor;
use tokio::sync::mpsc;
use tokio::time::timeout;
use uuid::Uuid;

use crate::fixture::{Cell, DAY, SOON, node};

#[tokio::test]
async fn a_vehicle_leaves_a_broker_that_is_revoked_and_does_not_come_back() {
    let mut cell = Cell::start().await;
    let tls = Some(cell.pki.issue("gauss", Role::Cav, DAY));
    let config = NodeConfig { name: Some(node("gauss")), cell: node("lot"), tls, ..NodeConfig::default() };
    let (sender, mut links) = mpsc::unbounded_channel();
    let counters = Arc::<Counters>::default();
    let arguments = GatewayArguments {
        cell: node("lot"),
        part: Part::Follower,
        status: NodeStatus::starting(node("gauss"), Uuid::now_v7(), Role::Cav, "0.1.0"),
        mqtt: config.mqtt.clone(),
        security: Security::of(&config).unwrap(),
        counters: Arc::clone(&counters),
        subscriber: Arc::new(move |delivery| {
            if let Incoming::Link { state, .. } = delivery.message {
                sender.send(state).unwrap_or_default();
            }
        }),
        seed: 4,
    };
    let (gateway, _) = Actor::spawn(None, Gateway, arguments).await.unwrap();
    gateway.cast(GatewayMessage::SetBrokers { addresses: vec![cell.address.into()] }).unwrap();
    assert_eq!(timeout(SOON, links.recv()).await.unwrap(), Some(LinkState::Up));

    cell.pki.authority.revoke(&node("edge"), ecod_actors::clock::now()).unwrap();
    assert_eq!(timeout(SOON, links.recv()).await.expect("still connected"), Some(LinkState::Down));
    let refused = async {
        while counters.events(Event::ConnectFailed) < 2 {
            tokio::time::sleep(std::time::Duration::from_millis(20)).await;
        }
    };
    timeout(SOON, refused).await.unwrap();
    assert_eq!((counters.events(Event::Connected), counters.events(Event::Disconnected)), (1, 1));
    gateway.stop(None);
}
