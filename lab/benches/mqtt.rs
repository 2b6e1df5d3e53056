//! Two hops through the embedded broker: bare clients, then gateways with decoding and encoding.

#[path = "../../benches/figures.rs"]
mod figures;

use std::sync::Arc;
use std::time::Duration;

use anyhow::Context;
use ecod::model::epoch::Epoch;
use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ecod::wire::{GlobalMap, NodeStatus, ObjectReport, PerceivedObject, Role};
use ecod_actors::actors::gateway::{Gateway, GatewayArguments, ReportKind};
use ecod_actors::messages::gateway::GatewayMessage;
use ecod_actors::platform::clock;
use ecod_actors::telemetry::counters::Counters;
use ecod_actors::transport::broker::{BrokerConfig, EmbeddedBroker, MqttBroker};
use ecod_actors::transport::mqtt::{
    BrokerAddress, Delivery, Incoming, LinkState, MqttConfig, MqttVersion, Security,
    SubscriptionRole,
};
use ecod_lab::bench::two_hop::{self, TwoHopLoad};
use hdrhistogram::Histogram;
use ractor::{Actor, ActorRef};
use tokio::sync::mpsc;
use uuid::Uuid;

use figures::Figures;

#[tokio::main]
async fn main() -> anyhow::Result<()> {
    let mut broker = EmbeddedBroker::new(BrokerConfig::default());
    let address = BrokerAddress::from(broker.start(([127, 0, 0, 1], 0).into())?);
    let load = TwoHopLoad {
        messages: 1000,
        interval: Duration::from_millis(10),
        payload_bytes: 1100,
    };
    let mut figures = Figures::new("mqtt");
    println!("{:<28} {:>8} {:>8} {:>6}", "path", "p50 µs", "p99 µs", "n");
    take(
        &mut figures,
        "two_hops",
        &two_hop::raw(&address, load).await?,
    );
    for (name, version) in [
        ("gateways_mqtt_3_1_1", MqttVersion::V311),
        ("gateways_mqtt_5", MqttVersion::V5),
    ] {
        take(
            &mut figures,
            name,
            &through_gateways(&address, version, load).await?,
        );
    }
    take(
        &mut figures,
        "two_hops_again",
        &two_hop::raw(&address, load).await?,
    );
    figures.save();
    Ok(())
}

fn take(figures: &mut Figures, path: &str, histogram: &Histogram<u64>) {
    let [p50, p99] =
        [0.5, 0.99].map(|quantile| histogram.value_at_quantile(quantile) as f64 / 1000.0);
    println!("{path:<28} {p50:>8.0} {p99:>8.0} {:>6}", histogram.len());
    figures.insert(
        path,
        serde_json::json!({ "p50_us": p50, "p99_us": p99, "n": histogram.len() }),
    );
}

/// Times from a report's publication to the arrival of the map that answers it, in nanoseconds.
async fn through_gateways(
    broker: &BrokerAddress,
    version: MqttVersion,
    load: TwoHopLoad,
) -> anyhow::Result<Histogram<u64>> {
    let (edge, mut reports) = join("edge", SubscriptionRole::Candidate, version, broker).await?;
    let (euclid, mut maps) = join("euclid", SubscriptionRole::Follower, version, broker).await?;
    let aggregator = edge.clone();
    let answer = tokio::spawn(async move {
        while let Some(delivery) = reports.recv().await {
            if let Incoming::Report { report, .. } = delivery.message {
                let map = Arc::new(answer_to(&report));
                if aggregator.cast(GatewayMessage::PublishMap { map }).is_err() {
                    return;
                }
            }
        }
    });
    let publisher = euclid.clone();
    let publish = tokio::spawn(async move {
        let mut ticks = tokio::time::interval(load.interval);
        for seq in 0..load.messages {
            ticks.tick().await;
            let report = Arc::new(report(seq.into()));
            if publisher
                .cast(GatewayMessage::PublishReport {
                    kind: ReportKind::Detections,
                    report,
                })
                .is_err()
            {
                return;
            }
        }
    });
    let mut histogram = two_hop::latencies();
    let mut back = 0;
    while back < load.messages {
        let delivery = tokio::time::timeout(Duration::from_secs(5), maps.recv())
            .await?
            .context("gateway ended")?;
        if let Incoming::Map(map) = delivery.message {
            back += 1;
            if map.round >= u64::from(load.messages / 10) {
                let taken = clock::now().since(map.oldest_capture_us.context("capture time")?);
                histogram.saturating_record(u64::try_from(taken.as_nanos())?);
            }
        }
    }
    publish.await?;
    answer.abort();
    edge.stop_and_wait(None, None).await?;
    euclid.stop_and_wait(None, None).await?;
    Ok(histogram)
}

async fn join(
    name: &str,
    role: SubscriptionRole,
    version: MqttVersion,
    broker: &BrokerAddress,
) -> anyhow::Result<(ActorRef<GatewayMessage>, mpsc::UnboundedReceiver<Delivery>)> {
    let (sender, mut deliveries) = mpsc::unbounded_channel();
    let status = NodeStatus::starting(
        NodeName::new(name)?,
        Uuid::new_v4(),
        Role::Auto,
        env!("CARGO_PKG_VERSION"),
    );
    let arguments = GatewayArguments {
        cell: NodeName::new("bench")?,
        role,
        status,
        mqtt: MqttConfig {
            version,
            ..MqttConfig::default()
        },
        security: Security::default(),
        clock: Default::default(),
        counters: Arc::new(Counters::default()),
        subscriber: Arc::new(move |delivery| sender.send(delivery).unwrap_or_default()),
        seed: 1,
        only_observes: false,
    };
    let (gateway, _) = Actor::spawn(None, Gateway, arguments).await?;
    gateway.cast(GatewayMessage::SetBrokers {
        addresses: vec![broker.clone()],
    })?;
    while let Some(delivery) = deliveries.recv().await {
        if matches!(
            delivery.message,
            Incoming::Link {
                state: LinkState::Up,
                ..
            }
        ) {
            break;
        }
    }
    // The subscription is in force a moment after the link is up.
    tokio::time::sleep(Duration::from_millis(200)).await;
    Ok((gateway, deliveries))
}

fn report(seq: u64) -> ObjectReport {
    let object = |index: u32| PerceivedObject {
        covariance_m2: Some([0.0004, 0.0, 0.0001]),
        ..PerceivedObject::new("ABCD123", 0.93, f64::from(index) * 0.25, 0.48)
    };
    ObjectReport {
        objects: (0..10).map(object).collect(),
        ..ObjectReport::new(
            NodeName::new("euclid").expect("a valid name"),
            seq,
            clock::now(),
        )
    }
}

fn answer_to(report: &ObjectReport) -> GlobalMap {
    let epoch = Epoch::new(1, NodeName::from_static("edge"));
    let oldest_capture_us = Some(report.captured_at_us);
    GlobalMap {
        oldest_capture_us,
        ..GlobalMap::new(&epoch, report.seq, Timestamp::default())
    }
}
