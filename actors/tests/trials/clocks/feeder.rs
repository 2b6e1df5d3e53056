//! A client without a node: it stamps its reports by its own wall clock only.

use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::{AtomicI64, Ordering};
use std::time::Duration;

use ecod::model::names::NodeName;
use ecod::wire::{Encoding, ObjectReport, PerceivedObject, encode};
use rumqttc::{AsyncClient, MqttOptions, QoS};
use tokio::runtime::{Builder, Runtime};

use crate::clocks::cell::true_time;

/// Publishes ten reports a second to every broker that is there.
pub(crate) struct Feeder {
    _runtime: Runtime,
}

impl Feeder {
    /// Starts the client; its clock is so many seconds ahead.
    pub(crate) fn start(brokers: Vec<SocketAddr>, ahead_s: Arc<AtomicI64>) -> Self {
        let runtime = Builder::new_multi_thread()
            .worker_threads(1)
            .enable_all()
            .build()
            .unwrap();
        let clients: Vec<_> = brokers
            .into_iter()
            .map(|broker| runtime.block_on(async { connect(broker) }))
            .collect();
        runtime.spawn(async move {
            let node = NodeName::from_static("feeder");
            for seq in 0.. {
                let captured_at = true_time().shifted(1_000_000 * ahead_s.load(Ordering::Relaxed));
                let car = PerceivedObject::new("car", 0.9, 6.6, 0.0);
                let report = ObjectReport {
                    objects: vec![car],
                    ..ObjectReport::new(node.clone(), seq, captured_at)
                };
                for client in &clients {
                    let payload = encode(&report, Encoding::Json);
                    client
                        .try_publish(
                            "ecod/v1/clocks/detections/feeder",
                            QoS::AtMostOnce,
                            false,
                            payload,
                        )
                        .ok();
                }
                tokio::time::sleep(Duration::from_millis(100)).await;
            }
        });
        Self { _runtime: runtime }
    }
}

fn connect(broker: SocketAddr) -> AsyncClient {
    let options = MqttOptions::new("feeder", broker.ip().to_string(), broker.port());
    let (client, mut events) = AsyncClient::new(options, 4);
    tokio::spawn(async move {
        loop {
            if events.poll().await.is_err() {
                tokio::time::sleep(Duration::from_millis(100)).await;
            }
        }
    });
    client
}
