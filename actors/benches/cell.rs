//! A whole cell on loopback: from the last report of a round to its map at every vehicle, beside the bare two hops
//! through the same broker.

#[path = "../../benches/figures.rs"]
mod figures;

use std::sync::Arc;
use std::time::Duration;

use anyhow::Context;
use ecod::landmark::LandmarkConfig;
use ecod::names::NodeName;
use ecod::wire::{GlobalMap, ObjectReport, PerceivedObject, Role, SCHEMA_VERSION};
use ecod_actors::bench::two_hop::{self, Load};
use ecod_actors::clock;
use ecod_actors::config::NodeConfig;
use ecod_actors::gateway::{BrokerAddress, GatewayMessage, ReportKind};
use ecod_actors::node::{self, NodeHandle};
use figures::Figures;
use hdrhistogram::Histogram;
use tokio::sync::mpsc;
use tokio::time::Instant;

const VEHICLES: usize = 4;
const LANDMARKS: usize = 10;
const ROUNDS: u32 = 400;
const INTERVAL: Duration = Duration::from_millis(50);
const PATIENCE: Duration = Duration::from_secs(10);
/// How far the objects move from round to round, in metres: the map's positions tell whose reports it rests on.
const STEP_M: f64 = 0.001;

#[tokio::main]
async fn main() -> anyhow::Result<()> {
    let edge = node::start(config("edge", Role::Edge, None)?).await?;
    let broker = BrokerAddress::from(edge.broker_address().context("the edge has a broker")?);
    let mut vehicles = Vec::new();
    for index in 0..VEHICLES {
        vehicles.push(node::start(config(&format!("v{index}"), Role::Cav, Some(broker.clone()))?).await?);
    }
    await_first_maps(&vehicles).await?;

    let load = Load { messages: ROUNDS / 2, interval: INTERVAL, ..Load::default() };
    let mut raw = two_hop::raw(&broker, load).await?;
    let cell = rounds(&vehicles).await?;
    raw.add(two_hop::raw(&broker, load).await?)?;

    let mut figures = Figures::new("cell");
    println!("{:<28} {:>8} {:>8} {:>6}", "path", "p50 µs", "p99 µs", "n");
    for (name, title, histogram) in
        [("two_hops", "two hops, bare clients", &raw), ("report_to_map", "last report to map received", &cell)]
    {
        let [p50, p99] = [0.5, 0.99].map(|quantile| micros(histogram, quantile));
        println!("{title:<28} {p50:>8.0} {p99:>8.0} {:>6}", histogram.len());
        figures.insert(name, serde_json::json!({ "p50_us": p50, "p99_us": p99, "n": histogram.len() }));
    }
    for (name, quantile) in [("report_to_map_over_two_hops_p50", 0.5), ("report_to_map_over_two_hops_p99", 0.99)] {
        figures.goal(name, micros(&cell, quantile) / micros(&raw, quantile), 1.5, "x");
    }
    figures.save();
    for vehicle in vehicles {
        vehicle.stop().await;
    }
    edge.stop().await;
    Ok(())
}

fn micros(histogram: &Histogram<u64>, quantile: f64) -> f64 {
    histogram.value_at_quantile(quantile) as f64 / 1000.0
}

fn config(name: &str, role: Role, broker: Option<BrokerAddress>) -> anyhow::Result<NodeConfig> {
    let landmark = |index: usize| LandmarkConfig {
        id: format!("slot-{index}").into(),
        x_m: index as f64 * 3.0,
        y_m: 0.0,
        facing_deg: None,
        vacancy: None,
        synonyms: Default::default(),
    };
    let mut config = NodeConfig {
        name: Some(NodeName::new(name)?),
        cell: NodeName::from_static("bench"),
        role,
        listen: Some(([127, 0, 0, 1], 0).into()),
        landmarks: (0..LANDMARKS).map(landmark).collect(),
        ..NodeConfig::default()
    };
    config.mqtt.broker = broker;
    config.membership.bind = Some(([127, 0, 0, 1], 0).into());
    config.membership.multicast.enabled = false;
    config.validate()?;
    Ok(config)
}

/// An edge closes rounds without reports too: a map at every vehicle says that every link is up and subscribed.
async fn await_first_maps(vehicles: &[NodeHandle]) -> anyhow::Result<()> {
    for vehicle in vehicles {
        let mut newest = vehicle.newest_map();
        tokio::time::timeout(PATIENCE, newest.wait_for(Option::is_some)).await.context("no map came")??;
    }
    Ok(())
}

/// Nanoseconds from the sending of each round's last report to its map at each vehicle; the first tenth warms up.
async fn rounds(vehicles: &[NodeHandle]) -> anyhow::Result<Histogram<u64>> {
    let (arrivals, mut arrived) = mpsc::unbounded_channel();
    let receivers: Vec<_> = vehicles.iter().map(|vehicle| tokio::spawn(receive(vehicle, arrivals.clone()))).collect();
    let mut histogram = two_hop::latencies();
    let mut ticks = tokio::time::interval(INTERVAL);
    for round in 1..=ROUNDS {
        ticks.tick().await;
        let mut sent = Instant::now();
        for (index, vehicle) in vehicles.iter().enumerate() {
            let report = Arc::new(report(index, round)?);
            sent = Instant::now();
            vehicle.seats().gateway.send(GatewayMessage::PublishReport { kind: ReportKind::Detections, report });
        }
        let mut missing = vehicles.len();
        while missing > 0 {
            let (map, at): (Arc<GlobalMap>, Instant) = tokio::time::timeout(PATIENCE, arrived.recv())
                .await
                .context("a round's map is missing")?
                .context("")?;
            if rests_on_all_of(&map, round) {
                missing -= 1;
                if round > ROUNDS / 10 {
                    histogram.saturating_record(u64::try_from((at - sent).as_nanos())?);
                }
            }
        }
    }
    receivers.iter().for_each(tokio::task::JoinHandle::abort);
    Ok(histogram)
}

/// Passes on every map with the time at which the vehicle had it.
fn receive(
    vehicle: &NodeHandle,
    arrivals: mpsc::UnboundedSender<(Arc<GlobalMap>, Instant)>,
) -> impl Future<Output = ()> + use<> {
    let mut newest = vehicle.newest_map();
    async move {
        while newest.changed().await.is_ok() {
            let at = Instant::now();
            let received = newest.borrow_and_update().clone();
            if received.is_none_or(|received| arrivals.send((received.map, at)).is_err()) {
                return;
            }
        }
    }
}

/// Every vehicle sees an object at every landmark, displaced by a round's own distance.
fn report(vehicle: usize, round: u32) -> anyhow::Result<ObjectReport> {
    let object = |index: usize| PerceivedObject {
        label: "ABCD123".into(),
        confidence: 0.93,
        x_m: index as f64 * 3.0 + displacement_m(round),
        y_m: 0.1,
        covariance_m2: Some([0.01, 0.0, 0.01]),
        landmark: None,
    };
    Ok(ObjectReport {
        schema: SCHEMA_VERSION,
        node: NodeName::new(format!("v{vehicle}"))?,
        seq: round.into(),
        captured_at_us: clock::now(),
        pose: None,
        objects: (0..LANDMARKS).map(object).collect(),
        seen: Some((0..LANDMARKS).map(|index| format!("slot-{index}").into()).collect()),
    })
}

fn displacement_m(round: u32) -> f64 {
    f64::from(round % 100) * STEP_M
}

/// The mean of the vehicles' positions is a round's own only when all of its reports went into it.
fn rests_on_all_of(map: &GlobalMap, round: u32) -> bool {
    map.landmarks.first().is_some_and(|first| {
        first.contributors.len() == VEHICLES && (first.x_m - displacement_m(round)).abs() < 0.1 * STEP_M
    })
}
