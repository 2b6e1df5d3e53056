//! The measurement of two hops measures something.

use std::time::Duration;

use ecod_actors::bench::two_hop::{Load, TwoHopError, raw};
use ecod_actors::transport::broker::MqttBroker;

use crate::cell::embedded;

#[tokio::test]
async fn every_message_but_the_warm_up_is_timed() {
    let (mut broker, address) = embedded();
    let load = Load { messages: 20, interval: Duration::from_millis(2), payload_bytes: 100 };
    let latencies = raw(&address, load).await.unwrap();
    assert_eq!(latencies.len(), 18);
    assert!(latencies.min() > 1_000, "no broker answers within a microsecond: {} ns", latencies.min());
    assert!(latencies.max() < 20_000_000_000, "{} ns", latencies.max());

    broker.stop();
    assert!(matches!(raw(&address, load).await, Err(TwoHopError::Connection { broker, .. }) if broker == address));
}
