//! The measurement of two hops measures something.

use std::time::Duration;

use ecod_actors::transport::broker::{BrokerConfig, EmbeddedBroker, MqttBroker};
use ecod_actors::transport::mqtt::BrokerAddress;
use ecod_lab::bench::two_hop::{TwoHopError, TwoHopLoad, raw};

#[tokio::test]
async fn messages_after_warmup_are_timed() {
    let mut broker = EmbeddedBroker::new(BrokerConfig::default());
    let address: BrokerAddress = broker.start("127.0.0.1:0".parse().unwrap()).unwrap().into();
    let load = TwoHopLoad {
        messages: 20,
        interval: Duration::from_millis(2),
        payload_bytes: 100,
    };
    let latencies = raw(&address, load).await.unwrap();
    assert_eq!(latencies.len(), 18);
    assert!(
        latencies.min() > 1_000,
        "no broker answers within a microsecond: {} ns",
        latencies.min()
    );
    assert!(latencies.max() < 20_000_000_000, "{} ns", latencies.max());

    broker.stop();
    assert!(
        matches!(raw(&address, load).await, Err(TwoHopError::Connection { broker, .. }) if broker == address)
    );
}
