//! Messages arrive faster than they are processed: only their sender is affected. Alone in its process, whose memory is
//! measured.

#![allow(
    clippy::unwrap_used,
    reason = "a test that cannot continue panics at that line"
)]

use std::net::SocketAddr;
use std::num::NonZero;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use ecod::model::names::NodeName;
use ecod::perception::landmark::LandmarkConfig;
use ecod::wire::{Encoding, ObjectReport, PerceivedObject, Role, encode};
use ecod_actors::node::config::NodeConfig;
use ecod_actors::node::{self, NodeHandle};
use ecod_actors::platform::clock;
use ecod_actors::telemetry::counters::ShedReason;
use ecod_testkit::node_config;
use rumqttc::{AsyncClient, ClientError, MqttOptions, QoS};
use tokio::sync::Mutex;
use tokio::task::JoinSet;

const PATIENCE: Duration = Duration::from_secs(20);

/// Vehicles that all send too much.
const VEHICLES: usize = 32;

/// Times and memory are measured for the whole process, so only one test runs at a time.
static ALONE: Mutex<()> = Mutex::const_new(());

/// An edge with its broker and two locations three metres apart.
async fn edge(change: impl FnOnce(&mut NodeConfig)) -> (NodeHandle, SocketAddr) {
    let mut config = NodeConfig {
        landmarks: vec![
            LandmarkConfig::at("west", 0.0, 0.0),
            LandmarkConfig::at("east", 3.0, 0.0),
        ],
        ..node_config("edge", "lot", Role::Edge)
    };
    change(&mut config);
    config.validate().unwrap();
    let edge = node::start(config).await.unwrap();
    let mut maps = edge.newest_map();
    tokio::time::timeout(PATIENCE, maps.wait_for(Option::is_some))
        .await
        .unwrap()
        .unwrap();
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

async fn publish(
    client: &AsyncClient,
    vehicle: &str,
    seq: u64,
    x_m: f64,
) -> Result<(), ClientError> {
    let report = ObjectReport {
        objects: vec![PerceivedObject::new("car", 0.9, x_m, 0.0)],
        ..ObjectReport::new(NodeName::new(vehicle).unwrap(), seq, clock::now())
    };
    let topic = format!("ecod/v1/lot/detections/{vehicle}");
    client
        .publish(
            topic,
            QoS::AtMostOnce,
            false,
            encode(&report, Encoding::Json),
        )
        .await
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

/// From when to when something was waited for.
type Wait = (Instant, Instant);

fn sorted_times(waits: &[Wait]) -> Vec<Duration> {
    let mut times: Vec<_> = waits.iter().map(|(from, until)| *until - *from).collect();
    times.sort();
    times
}

/// From a vehicle's report to the map that shows the east where this report has it.
async fn answers(edge: &NodeHandle, client: &AsyncClient, first: u64) -> Vec<Wait> {
    let mut waits = Vec::new();
    for seq in first..first + 20 {
        let x_m = 3.0 + 0.001 * seq as f64;
        let mut maps = edge.newest_map();
        let sent = Instant::now();
        publish(client, "euclid", seq, x_m).await.unwrap();
        let shows = |received: &Option<ecod_actors::messages::newest::ReceivedMap>| {
            received
                .as_ref()
                .is_some_and(|received| (received.map.landmarks[1].x_m - x_m).abs() < 1e-4)
        };
        tokio::time::timeout(PATIENCE, maps.wait_for(shows))
            .await
            .expect("every report is answered")
            .unwrap();
        waits.push((sent, Instant::now()));
        tokio::time::sleep(Duration::from_millis(100).saturating_sub(sent.elapsed())).await;
    }
    waits
}

fn shed(edge: &NodeHandle, source: &str) -> u64 {
    edge.counters()
        .all_shed()
        .iter()
        .filter(|shed| shed.source == source)
        .map(|shed| shed.times)
        .sum()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn flood_delays_no_other_reports() {
    let _alone = ALONE.lock().await;
    let (edge, broker) = edge(|config| config.broker.max_messages_hz = 500).await;
    let mut tasks = JoinSet::new();
    let euclid = connect(broker, "euclid", &mut tasks);
    let quiet = sorted_times(&answers(&edge, &euclid, 0).await);

    let mallory = connect(broker, "mallory", &mut tasks);
    tasks.spawn(flood(
        mallory,
        "mallory".to_owned(),
        Duration::from_micros(10),
    ));
    let sleepers = Sleepers::start();
    let answers = answers(&edge, &euclid, 100).await;
    let longest = sleepers.wake().longest(&answers);
    let flooded = sorted_times(&answers);
    let [quiet_median, flooded_median] = [&quiet, &flooded].map(|times| times[times.len() / 2]);
    let left_out = shed(&edge, "mallory");
    println!("median {quiet_median:?}, during a flood {flooded_median:?}; {left_out} excluded");
    assert!(
        flooded_median < quiet_median + Duration::from_millis(50),
        "{quiet:?} {flooded:?}"
    );
    assert!(longest < Duration::from_secs(1), "{longest:?} {flooded:?}");
    assert!(
        left_out > 500,
        "the flood was {left_out} messages more than is taken"
    );
    assert!(
        edge.counters()
            .all_shed()
            .iter()
            .any(|shed| shed.reason == ShedReason::BrokerThrottled)
    );
    assert_eq!(shed(&edge, "euclid"), 0);
    tasks.shutdown().await;
    edge.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn tenfold_load_keeps_period() {
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
        received
            .as_ref()
            .is_some_and(|received| received.map.landmarks[0].contributors.len() == VEHICLES)
    });
    tokio::time::timeout(PATIENCE, all_report)
        .await
        .unwrap()
        .unwrap();
    tokio::time::sleep(Duration::from_secs(1)).await;

    let sleepers = Sleepers::start();
    let begun = Instant::now();
    let before = resident_bytes();
    let mut last = begun;
    let mut gaps = Vec::new();
    while begun.elapsed() < Duration::from_secs(3) {
        tokio::time::timeout(PATIENCE, maps.changed())
            .await
            .unwrap()
            .unwrap();
        let now = Instant::now();
        gaps.push((last, now));
        last = now;
    }
    let stood_still = sleepers.wake();
    let longest = stood_still.longest(&gaps);
    let gaps = sorted_times(&gaps);
    let grown_mb = resident_bytes().saturating_sub(before) as f64 / 1e6;
    let median = gaps[gaps.len() / 2];
    println!(
        "rounds {median:?} apart, at most {longest:?} while the machine ran; {grown_mb:.1} MB more"
    );
    assert!(median < Duration::from_millis(130), "{gaps:?}");
    assert!(
        longest < Duration::from_millis(500),
        "{gaps:?} {stood_still:?}"
    );
    assert!(grown_mb < 16.0, "{grown_mb}");
    for index in 0..VEHICLES {
        assert!(
            shed(&edge, &format!("v{index}")) > 100,
            "{:?}",
            edge.counters().all_shed()
        );
    }
    tasks.shutdown().await;
    edge.stop().await;
}

/// Threads that only sleep. A fair scheduler runs such a thread within milliseconds of its waking, however busy the
/// process is. A longer delay is a stall of the machine, for example of a virtual machine with a busy host.
struct Sleepers {
    wanted: Arc<AtomicBool>,
    threads: Vec<thread::JoinHandle<Vec<Wait>>>,
}

/// When sleepers were to wake and when they did, where that was late.
#[derive(Debug)]
struct StoodStill(Vec<Wait>);

impl Sleepers {
    const NAP: Duration = Duration::from_millis(5);

    /// Two for each processor.
    fn start() -> Self {
        let wanted = Arc::new(AtomicBool::new(true));
        let sleep = |_| {
            let wanted = Arc::clone(&wanted);
            thread::spawn(move || {
                let mut late = Vec::new();
                while wanted.load(Ordering::Relaxed) {
                    let due = Instant::now() + Self::NAP;
                    thread::sleep(Self::NAP);
                    let woke = Instant::now();
                    if woke - due > Self::NAP {
                        late.push((due, woke));
                    }
                }
                late
            })
        };
        let count = 2 * thread::available_parallelism().map_or(1, NonZero::get);
        Self {
            threads: (0..count).map(sleep).collect(),
            wanted,
        }
    }

    /// Ends the sleepers and returns the times at which they overslept.
    fn wake(self) -> StoodStill {
        self.wanted.store(false, Ordering::Relaxed);
        StoodStill(
            self.threads
                .into_iter()
                .flat_map(|thread| thread.join().unwrap())
                .collect(),
        )
    }
}

impl StoodStill {
    /// The longest wait, less the time that a sleeper overslept during it.
    fn longest(&self, waits: &[Wait]) -> Duration {
        let overslept = |(from, until): &Wait| {
            self.0
                .iter()
                .map(|(due, woke)| {
                    (*woke)
                        .min(*until)
                        .saturating_duration_since((*due).max(*from))
                })
                .max()
        };
        let running =
            |wait: &Wait| (wait.1 - wait.0).saturating_sub(overslept(wait).unwrap_or_default());
        waits.iter().map(running).max().unwrap_or_default()
    }
}

/// Memory of this process, node and vehicles together.
fn resident_bytes() -> u64 {
    let text = std::fs::read_to_string("/proc/self/status").unwrap();
    let line = text
        .lines()
        .find_map(|line| line.strip_prefix("VmRSS:"))
        .unwrap();
    line.trim().trim_end_matches(" kB").parse::<u64>().unwrap() * 1024
}
