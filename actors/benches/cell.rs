//! A whole cell on loopback: from the last report of a round to its map at every vehicle, beside bare clients through the
//! same broker.

#[path = "../../benches/figures.rs"]
mod figures;

use std::sync::Arc;
use std::time::Duration;

use anyhow::Context;
use ecod::landmark::LandmarkConfig;
use ecod::names::NodeName;
use ecod::wire::{Encoding, GlobalMap, ObjectReport, PerceivedObject, Role, encode};
use ecod_actors::bench::rounds::{self, Traffic};
use ecod_actors::bench::two_hop::{self, Load};
use ecod_actors::broker::{BrokerConfig, EmbeddedBroker, Mqtt};
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
/// Every path is measured this many times in turn, so that whatever else the machine does falls on all of them.
const PASSES: u32 = 5;
const ROUNDS: u32 = 60;
const INTERVAL: Duration = Duration::from_millis(50);
const PATIENCE: Duration = Duration::from_secs(10);
/// How far the objects move from round to round, in metres: the map's positions tell whose reports it rests on.
const STEP_M: f64 = 0.001;

/// How the vehicles of a round report.
const ARRIVALS: [(&str, &str, Duration); 2] = [
    ("at_once", "all vehicles report at once", Duration::ZERO),
    ("staggered", "vehicles report 5 ms apart", Duration::from_millis(5)),
];

#[tokio::main]
async fn main() -> anyhow::Result<()> {
    let mut broker = EmbeddedBroker::new(BrokerConfig::default());
    let address = BrokerAddress::from(broker.start(([127, 0, 0, 1], 0).into())?);
    let (mut plain, mut bare, mut cell) = (two_hop::latencies(), ARRIVALS.map(none), ARRIVALS.map(none));
    for _ in 0..PASSES {
        let load = Load { messages: ROUNDS, interval: INTERVAL, ..Load::default() };
        plain.add(two_hop::raw(&address, load).await?)?;
        for (index, (_, _, stagger)) in ARRIVALS.into_iter().enumerate() {
            let (latencies, map_bytes) = cell_pass(&address, stagger).await?;
            cell[index].add(latencies)?;
            let traffic = Traffic {
                rounds: ROUNDS,
                interval: INTERVAL,
                vehicles: VEHICLES,
                stagger,
                message_bytes: encode(&report(0, 1)?, Encoding::Json).len(),
                answer_bytes: map_bytes,
            };
            bare[index].add(rounds::raw(&address, traffic).await?)?;
        }
    }

    let mut figures = Figures::new("cell");
    println!(
        "From the sending of the last report of {VEHICLES} vehicles to the map of that round at each vehicle, beside bare"
    );
    println!(
        "clients that send the same packets, and beside one bare message there and back; all through one broker.\n"
    );
    println!("{:<28} {:<26} {:>8} {:>8} {:>6}", "", "", "p50 µs", "p99 µs", "n");
    row(&mut figures, "two_hops", ["one message", "bare clients, two hops"], &plain);
    for (index, (name, arrivals, _)) in ARRIVALS.into_iter().enumerate() {
        row(&mut figures, &format!("bare_{name}"), [arrivals, "bare clients, same packets"], &bare[index]);
        row(&mut figures, &format!("cell_{name}"), [arrivals, "cell"], &cell[index]);
    }
    for (index, (name, _, _)) in ARRIVALS.into_iter().enumerate() {
        for (other, raw) in [("bare", &bare[index]), ("two_hops", &plain)] {
            for (percentile, quantile) in [("p50", 0.5), ("p99", 0.99)] {
                let ratio = micros(&cell[index], quantile) / micros(raw, quantile);
                figures.goal(&format!("cell_{name}_over_{other}_{percentile}"), ratio, 1.5, "x");
            }
        }
    }
    figures.save();
    Ok(())
}

fn none<T>(_: T) -> Histogram<u64> {
    two_hop::latencies()
}

fn row(figures: &mut Figures, name: &str, [load, path]: [&str; 2], histogram: &Histogram<u64>) {
    let [p50, p99] = [0.5, 0.99].map(|quantile| micros(histogram, quantile));
    println!("{load:<28} {path:<26} {p50:>8.0} {p99:>8.0} {:>6}", histogram.len());
    figures.insert(name, serde_json::json!({ "p50_us": p50, "p99_us": p99, "n": histogram.len() }));
}

fn micros(histogram: &Histogram<u64>, quantile: f64) -> f64 {
    histogram.value_at_quantile(quantile) as f64 / 1000.0
}

fn config(name: &str, role: Role, broker: &BrokerAddress) -> anyhow::Result<NodeConfig> {
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
    config.mqtt.broker = Some(broker.clone());
    config.membership.bind = Some(([127, 0, 0, 1], 0).into());
    config.membership.multicast.enabled = false;
    config.validate()?;
    Ok(config)
}

/// Latencies of a cell that is there for this pass only, so that it does not disturb the others, and its map's bytes.
async fn cell_pass(broker: &BrokerAddress, stagger: Duration) -> anyhow::Result<(Histogram<u64>, usize)> {
    let edge = node::start(config("edge", Role::Edge, broker)?).await?;
    let mut vehicles = Vec::new();
    for index in 0..VEHICLES {
        vehicles.push(node::start(config(&format!("v{index}"), Role::Cav, broker)?).await?);
    }
    await_first_maps(&vehicles).await?;
    let measured = measure(&vehicles, stagger).await?;
    for vehicle in vehicles {
        vehicle.stop().await;
    }
    edge.stop().await;
    Ok(measured)
}

/// An edge closes rounds without reports too: a map at every vehicle says that every link is up and subscribed.
async fn await_first_maps(vehicles: &[NodeHandle]) -> anyhow::Result<()> {
    for vehicle in vehicles {
        let mut newest = vehicle.newest_map();
        tokio::time::timeout(PATIENCE, newest.wait_for(Option::is_some)).await.context("no map came")??;
    }
    Ok(())
}

/// Nanoseconds from the sending of each round's last report to its map at each vehicle, the first tenth excepted, and
/// the bytes of the last map.
async fn measure(vehicles: &[NodeHandle], stagger: Duration) -> anyhow::Result<(Histogram<u64>, usize)> {
    let (arrivals, mut arrived) = mpsc::unbounded_channel();
    let receivers: Vec<_> = vehicles.iter().map(|vehicle| tokio::spawn(receive(vehicle, arrivals.clone()))).collect();
    let mut histogram = two_hop::latencies();
    let mut last_map = None;
    let mut ticks = tokio::time::interval(INTERVAL);
    for round in 0..ROUNDS {
        ticks.tick().await;
        let mut sent = Instant::now();
        for (index, vehicle) in vehicles.iter().enumerate() {
            if index > 0 && !stagger.is_zero() {
                tokio::time::sleep(stagger).await;
            }
            let report = Arc::new(report(index, round)?);
            sent = Instant::now();
            vehicle.seats().gateway.send(GatewayMessage::PublishReport { kind: ReportKind::Detections, report });
        }
        let mut missing = vehicles.len();
        while missing > 0 {
            let arrival = tokio::time::timeout(PATIENCE, arrived.recv()).await.context("a round's map is missing")?;
            let (map, at): (Arc<GlobalMap>, Instant) = arrival.context("no vehicle is left")?;
            if rests_on_all_of(&map, round) {
                missing -= 1;
                if round >= ROUNDS / 10 {
                    histogram.saturating_record(u64::try_from((at - sent).as_nanos())?);
                }
                last_map = Some(map);
            }
        }
    }
    receivers.iter().for_each(tokio::task::JoinHandle::abort);
    let map = last_map.context("there was no round")?;
    Ok((histogram, encode(&*map, Encoding::Json).len()))
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
        covariance_m2: Some([0.01, 0.0, 0.01]),
        ..PerceivedObject::new("ABCD123", 0.93, index as f64 * 3.0 + displacement_m(round), 0.1)
    };
    Ok(ObjectReport {
        objects: (0..LANDMARKS).map(object).collect(),
        seen: Some((0..LANDMARKS).map(|index| format!("slot-{index}").into()).collect()),
        ..ObjectReport::new(NodeName::new(format!("v{vehicle}"))?, round.into(), clock::now())
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
