//! More comes in than is taken: nobody pays for it but who sends it.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on says where")]

use std::net::SocketAddr;
use std::num::NonZero;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use ecod::landmark::LandmarkConfig;
use ecod::names::NodeName;
use ecod::wire::{Encoding, ObjectReport, PerceivedObject, Role, encode};
use ecod_actors::clock;
use ecod_actors::config::NodeConfig;
use ecod_actors::counters::ShedReason;
use ecod_actors::node::{self, NodeHandle};
use rumqttc::{AsyncClient, ClientError, MqttOptions, QoS};
use tokio::sync::Mutex;
use tokio::task::JoinSet;

const PATIENCE: Duration = Duration::from_secs(20);

/// Vehicles that all send too much.
const VEHICLES: usize = 32;

/// Times and memory are those of the whole process: one test at a time.
static ALONE: Mutex<()> = Mutex::const_new(());

/// An edge with its broker and two locations three metres apart.
async fn edge(change: impl FnOnce(&mut NodeConfig)) -> (NodeHandle, SocketAddr) {
    let mut config = NodeConfig {
        name: Some(NodeName::from_static("edge")),
        cell: NodeName::from_static("lot"),
        role: Role::Edge,
        listen: Some("127.0.0.1:0".parse().unwrap()),
        landmarks: vec![LandmarkConfig::at("west", 0.0, 0.0), LandmarkConfig::at("east", 3.0, 0.0)],
        ..NodeConfig::default()
    };
    config.membership.bind = Some("127.0.0.1:0".parse().unwrap());
    config.membership.multicast.enabled = false;
    config.dashboard.enabled = false;
    change(&mut config);
    config.validate().unwrap();
    let edge = node::start(config).await.unwrap();
    let mut maps = edge.newest_map();
    tokio::time::timeout(PATIENCE, maps.wait_for(Option::is_some)).await.unwrap().unwrap();
    let broker = edge.broker_address().unwrap();
    (edge, broker)
}

/// A bare client; its connection is served by `tasks`.
fn connect(broker: SocketAddr, vehicle: &str, tasks: &mut JoinSet<()>) -> AsyncClient {
    let mut options = MqttOptions::new(vehicle, broker.ip().to_string(), broker.port());
    options.set_keep_alive(Duration::from_secs(60));
    let (client, mut events) = AsyncClient::new(options, 64);
    tasks.spawn(async move { while events.poll().await.is_ok() {} });
    client
}

async fn publish(client: &AsyncClient, vehicle: &str, seq: u64, x_m: f64) -> Result<(), ClientError> {
    let report = ObjectReport {
        objects: vec![PerceivedObject::new("car", 0.9, x_m, 0.0)],
        ..ObjectReport::new(NodeName::new(vehicle).unwrap(), seq, clock::now())
    };
    let topic = format!("ecod/v1/lot/detections/{vehicle}");
    client.publish(topic, QoS::AtMostOnce, false, encode(&report, Encoding::Json)).await
}

/// A report every `period`, for as long as the connection is served.
async fn flood(client: AsyncClient, vehicle: String, period: Duration) {
    let mut ticks = tokio::time::interval(period);
    for seq in 0.. {
        ticks.tick().await;
        if publish(&client, &vehicle, seq, 0.0).await.is_err() {
            break;
        }
    }
}

/// Times from a vehicle's report to the map that shows the east where this report has it.
async fn answer_times(edge: &NodeHandle, client: &AsyncClient, first: u64) -> Vec<Duration> {
    let mut times = Vec::new();
    for seq in first..first + 20 {
        let x_m = 3.0 + 0.001 * seq as f64;
        let mut maps = edge.newest_map();
        let sent = Instant::now();
        publish(client, "euclid", seq, x_m).await.unwrap();
        let shows = |received: &Option<ecod_actors::follower::ReceivedMap>| {
            received.as_ref().is_some_and(|received| (received.map.landmarks[1].x_m - x_m).abs() < 1e-4)
        };
        tokio::time::timeout(PATIENCE, maps.wait_for(shows)).await.expect("every report is answered").unwrap();
        times.push(sent.elapsed());
        tokio::time::sleep(Duration::from_millis(100).saturating_sub(sent.elapsed())).await;
    }
    times.sort();
    times
}

fn shed(edge: &NodeHandle, source: &str) -> u64 {
    edge.counters().all_shed().iter().filter(|shed| shed.source == source).map(|shed| shed.times).sum()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn one_flooding_vehicle_does_not_delay_anothers_reports() {
    let _alone = ALONE.lock().await;
    let (edge, broker) = edge(|config| config.broker.max_messages_hz = 500).await;
    let mut tasks = JoinSet::new();
    let euclid = connect(broker, "euclid", &mut tasks);
    let quiet = answer_times(&edge, &euclid, 0).await;

    let mallory = connect(broker, "mallory", &mut tasks);
    tasks.spawn(flood(mallory, "mallory".to_owned(), Duration::from_micros(10)));
    let sleepers = Sleepers::start();
    let flooded = answer_times(&edge, &euclid, 100).await;
    let stood_still = sleepers.longest_delay();
    let [quiet_median, flooded_median] = [&quiet, &flooded].map(|times| times[times.len() / 2]);
    let left_out = shed(&edge, "mallory");
    println!("median {quiet_median:?}, beside a flood {flooded_median:?}; {left_out} left out");
    assert!(flooded_median < quiet_median + Duration::from_millis(50), "{quiet:?} {flooded:?}");
    assert!(*flooded.last().unwrap() < Duration::from_secs(1) + stood_still, "{stood_still:?} {flooded:?}");
    assert!(left_out > 500, "the flood was {left_out} messages more than is taken");
    assert!(edge.counters().all_shed().iter().any(|shed| shed.reason == ShedReason::BrokerThrottled));
    assert_eq!(shed(&edge, "euclid"), 0);
    tasks.shutdown().await;
    edge.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn ten_times_more_than_is_taken_leaves_period_and_memory_alone() {
    let _alone = ALONE.lock().await;
    let (edge, broker) = edge(|config| config.mqtt.max_report_hz = 10).await;
    let mut tasks = JoinSet::new();
    for index in 0..VEHICLES {
        let vehicle = format!("v{index}");
        let client = connect(broker, &vehicle, &mut tasks);
        tasks.spawn(flood(client, vehicle, Duration::from_millis(10)));
    }
    let mut maps = edge.newest_map();
    let all_report = maps.wait_for(|received| {
        received.as_ref().is_some_and(|received| received.map.landmarks[0].contributors.len() == VEHICLES)
    });
    tokio::time::timeout(PATIENCE, all_report).await.unwrap().unwrap();
    tokio::time::sleep(Duration::from_secs(1)).await;

    let sleepers = Sleepers::start();
    let (begun, before) = (Instant::now(), resident_bytes());
    let (mut last, mut gaps) = (begun, Vec::new());
    while begun.elapsed() < Duration::from_secs(3) {
        tokio::time::timeout(PATIENCE, maps.changed()).await.unwrap().unwrap();
        gaps.push(last.elapsed());
        last = Instant::now();
    }
    let stood_still = sleepers.longest_delay();
    gaps.sort();
    let grown_mb = resident_bytes().saturating_sub(before) as f64 / 1e6;
    let [median, longest] = [gaps[gaps.len() / 2], gaps[gaps.len() - 1]];
    println!(
        "rounds {median:?} apart, at most {longest:?}, the machine stood still for {stood_still:?}; {grown_mb:.1} MB more"
    );
    assert!(median < Duration::from_millis(130), "{gaps:?}");
    assert!(longest < Duration::from_millis(500) + stood_still, "{stood_still:?} {gaps:?}");
    assert!(grown_mb < 16.0, "{grown_mb}");
    for index in 0..VEHICLES {
        assert!(shed(&edge, &format!("v{index}")) > 100, "{:?}", edge.counters().all_shed());
    }
    tasks.shutdown().await;
    edge.stop().await;
}

/// Threads that do nothing but sleep. A scheduler that is fair lets such a thread run as soon as it wakes, however busy
/// the process is: what it waits for is a machine that stands still, as a virtual one does whose host is busy.
struct Sleepers {
    wanted: Arc<AtomicBool>,
    threads: Vec<thread::JoinHandle<Duration>>,
}

impl Sleepers {
    const NAP: Duration = Duration::from_millis(5);

    /// Two for each processor.
    fn start() -> Self {
        let wanted = Arc::new(AtomicBool::new(true));
        let sleep = |_| {
            let wanted = Arc::clone(&wanted);
            thread::spawn(move || {
                let mut longest = Duration::ZERO;
                while wanted.load(Ordering::Relaxed) {
                    let begun = Instant::now();
                    thread::sleep(Self::NAP);
                    longest = longest.max(begun.elapsed().saturating_sub(Self::NAP));
                }
                longest
            })
        };
        let count = 2 * thread::available_parallelism().map_or(1, NonZero::get);
        Self { threads: (0..count).map(sleep).collect(), wanted }
    }

    /// Ends them; by how much any of them woke too late.
    fn longest_delay(self) -> Duration {
        self.wanted.store(false, Ordering::Relaxed);
        self.threads.into_iter().map(|thread| thread.join().unwrap()).max().unwrap_or_default()
    }
}

/// Memory of this process, node and vehicles together.
fn resident_bytes() -> u64 {
    let text = std::fs::read_to_string("/proc/self/status").unwrap();
    let line = text.lines().find_map(|line| line.strip_prefix("VmRSS:")).unwrap();
    line.trim().trim_end_matches(" kB").parse::<u64>().unwrap() * 1024
}
