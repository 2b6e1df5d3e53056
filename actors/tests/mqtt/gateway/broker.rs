//! The broker's actor.

use std::net::{SocketAddr, TcpListener, TcpStream};

use ecod_actors::actors::broker::Broker;
use ecod_actors::messages::broker::BrokerMessage;
use ecod_actors::transport::broker::{BrokerConfig, BrokerError, BrokerHealth, EmbeddedBroker};
use ecod_testkit::until;
use ractor::{Actor, call};

#[tokio::test]
async fn busy_port_is_reported() {
    // A separate address: a released port of a shared address may be in use by another test at once.
    let own = SocketAddr::from(([127, 0, 21, 1], 0));
    let broker = Box::new(EmbeddedBroker::new(BrokerConfig::default()));
    let (actor, handle) = Actor::spawn(None, Broker, broker).await.unwrap();
    let taken = TcpListener::bind(own).unwrap();
    let busy = taken.local_addr().unwrap();
    let refused = call!(actor, |reply| BrokerMessage::Start {
        address: busy,
        reply
    })
    .unwrap();
    assert!(
        matches!(&refused, Err(BrokerError::Bind { address, .. }) if *address == busy),
        "{refused:?}"
    );
    assert_eq!(
        call!(actor, |reply| BrokerMessage::Health { reply }).unwrap(),
        BrokerHealth::Stopped
    );

    let bound = call!(actor, |reply| BrokerMessage::Start {
        address: own,
        reply
    })
    .unwrap()
    .unwrap();
    assert_eq!(
        call!(actor, |reply| BrokerMessage::Health { reply }).unwrap(),
        BrokerHealth::Serving(bound)
    );
    call!(actor, |reply| BrokerMessage::Stop { reply }).unwrap();
    // A program that another test begins holds copies of all sockets for a moment.
    until("the broker to be gone", || {
        TcpStream::connect(bound).is_err()
    })
    .await;

    let bound = call!(actor, |reply| BrokerMessage::Start {
        address: bound,
        reply
    })
    .unwrap()
    .unwrap();
    actor.kill();
    handle.await.unwrap();
    until("a killed actor's broker to be gone", || {
        TcpStream::connect(bound).is_err()
    })
    .await;
}
