//! The embedded broker's life, alone in its process so that its threads can be counted.

#![allow(
    clippy::unwrap_used,
    reason = "a test that cannot continue panics at that line"
)]

use std::net::{SocketAddr, TcpStream};

use ecod_actors::transport::broker::{
    BrokerConfig, BrokerError, BrokerHealth, EmbeddedBroker, MqttBroker,
};

const LOOPBACK: SocketAddr =
    SocketAddr::new(std::net::IpAddr::V4(std::net::Ipv4Addr::LOCALHOST), 0);

fn threads() -> usize {
    std::fs::read_dir("/proc/self/task").unwrap().count()
}

#[test]
fn restart_leaks_no_threads() {
    let mut broker = EmbeddedBroker::new(BrokerConfig::default());
    assert_eq!(broker.health(), BrokerHealth::Stopped);
    let idle = threads();
    let address = broker.start(LOOPBACK).unwrap();
    assert_ne!(address.port(), 0);
    for _ in 0..20 {
        let client = TcpStream::connect(address).unwrap();
        assert_eq!(broker.health(), BrokerHealth::Serving(address));
        assert_eq!(threads(), idle + 1);
        assert_eq!(broker.restart(LOOPBACK).unwrap(), address);
        drop(client);
    }
    assert!(matches!(broker.start(LOOPBACK), Err(BrokerError::Running(at)) if at == address));
    broker.stop();
    assert_eq!(broker.health(), BrokerHealth::Stopped);
    assert!(
        TcpStream::connect(address).is_err(),
        "the port is free again"
    );
    assert_eq!(threads(), idle);

    let taken = std::net::TcpListener::bind(address).unwrap();
    let error = broker.start(address).unwrap_err();
    assert!(matches!(error, BrokerError::Bind { address: at, .. } if at == address));
    assert!(error.to_string().contains(&address.to_string()), "{error}");
    assert_eq!((broker.health(), threads()), (BrokerHealth::Stopped, idle));
    drop(taken);
    assert_eq!(
        broker.start(address).unwrap(),
        address,
        "the same broker starts once the port is free"
    );
}
