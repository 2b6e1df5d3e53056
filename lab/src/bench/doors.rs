//! Figures of a node's local broker: the delay of maps for programs compared to the node, the
//! latency of programs' reports, and the cost of the broker.
//!
//! ```text
//! edge ── map ──> vehicle: its map log ──> door ── map ──> program
//! program ── report ──> door ──> edge's broker ──> edge ── map ──> watcher at the edge's broker
//! another ── report ───────────> edge's broker ──> edge ── map ──> the same watcher
//! ```
//!
//! Edge and vehicle are separate processes on loopback. Reports of the two paths take turns, so
//! that a round only waits for one of them.

use std::collections::HashMap;
use std::fs;
use std::net::{Ipv4Addr, SocketAddr};
use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use anyhow::{Context, ensure};
use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ecod::wire::{
    Encoding, GlobalMap, Limits, ObjectReport, ReportKind, Role, Topic, Topics, decode, encode,
};
use ecod_actors::messages::newest::ReceivedMap;
use ecod_actors::node::config::NodeConfig;
use ecod_actors::platform::clock;
use rumqttc::{AsyncClient, Event, EventLoop, Packet, QoS};
use serde::Serialize;
use tokio::task::AbortHandle;
use tokio::time::{Instant, MissedTickBehavior, sleep, timeout};

use super::access::BrokerAccess;
use super::latency::{Latencies, Quantiles};
use super::load;
use super::two_hop;
use super::usage::UsageMeter;
use crate::node_process::NodeProcess;

/// All figures of a local broker.
#[derive(Debug, Clone, Serialize)]
pub struct DoorFigures {
    /// From a map's arrival at the node to its arrival at a program.
    pub behind_node: Quantiles,
    /// From a report at the local broker of a following node to its map at a program of the leader.
    pub report_at_door: Quantiles,
    /// From a report at the leader's broker to its map at the same program.
    pub report_at_leader: Quantiles,
    /// One hop through the local broker, median in microseconds.
    pub hop_us: f64,
    /// Resident memory of the idle vehicle with a local broker, in megabytes.
    pub resident_mb: f64,
    /// Part of this memory that is due to the local broker.
    pub door_mb: f64,
}

impl DoorFigures {
    /// Names, figures and their maximum values.
    pub fn goals(&self) -> [(&'static str, f64, f64); 4] {
        let later_us = self.report_at_door.p50_us - self.report_at_leader.p50_us;
        let missing_percent = self
            .report_at_door
            .missing_percent()
            .max(self.report_at_leader.missing_percent());
        [
            (
                "door_behind_node_p99_ms",
                self.behind_node.p99_us / 1000.0,
                1.0,
            ),
            ("report_at_door_hops_more", later_us / self.hop_us, 1.0),
            ("reports_missing_percent", missing_percent, 1.0),
            ("door_mb", self.door_mb, 4.0),
        ]
    }
}

/// The vehicle, and a vehicle without a node at the leader's broker.
const VEHICLE: &str = "euclid";
const NODELESS: &str = "gauss";

/// Time between two reports of a program.
const PERIOD: Duration = Duration::from_millis(100);

/// Turns of each way.
const TURNS: u32 = 2;

/// Time at the beginning of a turn that is not counted, until the maps have dropped the other
/// path's reports.
const WARM_UP: Duration = Duration::from_secs(4);

/// Idle vehicles of each kind whose memory is read, and the time that each gets to settle.
const IDLE_RUNS: usize = 3;
const IDLE: Duration = Duration::from_secs(4);

/// Time for the first map, and for the last.
const PATIENCE: Duration = Duration::from_secs(20);
const LAST_MAP: Duration = Duration::from_secs(1);

/// Starts an edge and a vehicle, and measures each way for so long.
///
/// # Errors
/// Returns an error if a node cannot be started or ends, or no map comes.
pub async fn measure(program: &Path, duration: Duration) -> anyhow::Result<DoorFigures> {
    let directory = std::env::temp_dir().join(format!("ecod-doors-{}", std::process::id()));
    fs::create_dir_all(&directory)
        .with_context(|| format!("cannot make {}", directory.display()))?;
    let edge_config = NodeConfig {
        landmarks: load::landmarks(),
        ..configuration("edge", Role::Edge)
    };
    let mut edge = NodeProcess::start(program, &edge_config, &directory)?;
    let leader = serves(&mut edge).await?;
    let mut vehicle_config = configuration(VEHICLE, Role::Cav);
    vehicle_config.membership.seeds = vec![
        timeout(PATIENCE, edge.address("looking for nodes"))
            .await??
            .to_string(),
    ];
    let (resident_mb, door_mb) = idle_memory(program, &vehicle_config, &directory).await?;
    let map_log = directory.join("maps.jsonl");
    vehicle_config.map_log = Some(map_log.clone());
    let mut vehicle = NodeProcess::start(program, &vehicle_config, &directory)?;
    let door = serves(&mut vehicle).await?;

    let at_door = DoorWatcher::connect(door).await?;
    let at_leader = DoorWatcher::connect(leader).await?;
    at_door.first_map().await?;
    let mut report_at_door = Latencies::default();
    let mut report_at_leader = Latencies::default();
    for _ in 0..TURNS {
        let turn = duration / TURNS;
        report_at_leader.add(&report(leader, NODELESS, turn, &at_leader).await?);
        report_at_door.add(&report(door, &format!("{VEHICLE}--bench"), turn, &at_leader).await?);
    }
    let behind_node = behind_node(&map_log, &at_door)?;
    let load = two_hop::TwoHopLoad {
        messages: 500,
        ..two_hop::TwoHopLoad::default()
    };
    let hop_us = two_hop::raw(&door.into(), load)
        .await?
        .value_at_quantile(0.5) as f64
        / 2000.0;
    vehicle.stop().await;
    edge.stop().await;
    if let Err(error) = fs::remove_dir_all(&directory) {
        tracing::warn!(directory = %directory.display(), %error, "directory stays");
    }
    let [report_at_door, report_at_leader] =
        [report_at_door, report_at_leader].map(|way| way.quantiles());
    let behind_node = behind_node.quantiles();
    Ok(DoorFigures {
        behind_node,
        report_at_door,
        report_at_leader,
        hop_us,
        resident_mb,
        door_mb,
    })
}

fn configuration(name: &'static str, role: Role) -> NodeConfig {
    let free = SocketAddr::from((Ipv4Addr::LOCALHOST, 0));
    let mut config = NodeConfig {
        name: Some(NodeName::from_static(name)),
        cell: NodeName::from_static(CELL),
        role,
        listen: Some(free),
        ..NodeConfig::default()
    };
    config.dashboard.enabled = false;
    config.membership.bind = Some(free);
    config.membership.multicast.enabled = false;
    config
}

const CELL: &str = "bench";

/// Topic without publishers: a login is complete when its subscription is.
const QUIET: &str = "ecod/bench/quiet";

/// Address of a node's broker.
async fn serves(node: &mut NodeProcess) -> anyhow::Result<SocketAddr> {
    timeout(PATIENCE, node.address("broker serves"))
        .await
        .context("no broker listens by the node's log, or RUST_LOG hides it")?
}

/// Memory of an idle vehicle with a local broker, and the broker's part of it, in megabytes:
/// medians.
async fn idle_memory(
    program: &Path,
    vehicle: &NodeConfig,
    directory: &Path,
) -> anyhow::Result<(f64, f64)> {
    let mut resident = [Vec::new(), Vec::new()];
    for _ in 0..IDLE_RUNS {
        for (has_door, resident) in [true, false].into_iter().zip(&mut resident) {
            let mut config = vehicle.clone();
            config.broker.door = has_door;
            let mut node = NodeProcess::start(program, &config, directory)?;
            sleep(IDLE).await;
            node.check()?;
            let usage = UsageMeter::start(node.pid().context("the vehicle ended")?).stop()?;
            resident.push(usage.resident_bytes as f64 / 1e6);
            node.stop().await;
        }
    }
    let [with, without] = resident.map(|mut runs| {
        runs.sort_by(f64::total_cmp);
        runs.get(IDLE_RUNS / 2).copied().unwrap_or_default()
    });
    Ok((with, with - without))
}

/// A plain client that reads maps.
struct DoorWatcher {
    /// The connection ends with it.
    _client: AsyncClient,
    maps: Arc<Mutex<Vec<DoorArrival>>>,
    task: AbortHandle,
}

#[derive(Debug, Clone)]
struct DoorArrival {
    epoch: u64,
    round: u64,
    oldest_capture: Option<Timestamp>,
    at: Timestamp,
}

impl DoorWatcher {
    async fn connect(broker: SocketAddr) -> anyhow::Result<Self> {
        let topic = topics().path(&Topic::GlobalDetections);
        let id = format!("ecod-bench-watcher-{}", broker.port());
        let (client, events) = BrokerAccess::open(broker.into())
            .subscribed(&id, &[&topic])
            .await?;
        let maps = Arc::<Mutex<Vec<DoorArrival>>>::default();
        let task = tokio::spawn(watch(events, Arc::clone(&maps))).abort_handle();
        Ok(Self {
            _client: client,
            maps,
            task,
        })
    }

    async fn first_map(&self) -> anyhow::Result<()> {
        let begun = Instant::now();
        while self.maps().is_empty() {
            ensure!(begun.elapsed() < PATIENCE, "no map comes to the door");
            sleep(Duration::from_millis(20)).await;
        }
        Ok(())
    }

    fn maps(&self) -> Vec<DoorArrival> {
        self.maps
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .clone()
    }
}

impl Drop for DoorWatcher {
    fn drop(&mut self) {
        self.task.abort();
    }
}

async fn watch(mut events: EventLoop, maps: Arc<Mutex<Vec<DoorArrival>>>) {
    while let Ok(event) = events.poll().await {
        let at = clock::now();
        let Event::Incoming(Packet::Publish(publish)) = event else {
            continue;
        };
        if let Ok(map) = decode::<GlobalMap>(&publish.payload, &Limits::default()) {
            let GlobalMap {
                epoch,
                round,
                oldest_capture_us: oldest_capture,
                ..
            } = map;
            let arrival = DoorArrival {
                epoch,
                round,
                oldest_capture,
                at,
            };
            maps.lock()
                .unwrap_or_else(PoisonError::into_inner)
                .push(arrival);
        }
    }
}

fn topics() -> Topics {
    Topics::new(&NodeName::from_static(CELL))
}

/// Reports to a broker under a name for a time; returns the times until the watcher has the maps
/// that include the reports.
async fn report(
    broker: SocketAddr,
    name: &str,
    duration: Duration,
    watcher: &DoorWatcher,
) -> anyhow::Result<Latencies> {
    let name = NodeName::new(name)?;
    let topic = topics().path(&ReportKind::Detections.topic(name.clone()));
    let id = format!("ecod-bench-{name}");
    let (client, mut events) = BrokerAccess::open(broker.into())
        .subscribed(&id, &[QUIET])
        .await?;
    let poll = tokio::spawn(async move { while events.poll().await.is_ok() {} });
    let mut ticks = tokio::time::interval(PERIOD);
    ticks.set_missed_tick_behavior(MissedTickBehavior::Skip);
    let begun = Instant::now();
    let mut sent = Vec::new();
    let mut seq = 0;
    while begun.elapsed() < WARM_UP + duration {
        ticks.tick().await;
        seq += 1;
        let captured_at = clock::now();
        let report = ObjectReport {
            node: name.clone(),
            seq,
            captured_at_us: captured_at,
            ..load::report(0, &load::landmarks())
        };
        client.try_publish(
            &topic,
            QoS::AtMostOnce,
            false,
            encode(&report, Encoding::Json),
        )?;
        if begun.elapsed() > WARM_UP {
            sent.push(captured_at);
        }
    }
    sleep(LAST_MAP).await;
    poll.abort();
    let maps = watcher.maps();
    let mut latencies = Latencies::default();
    for captured_at in sent {
        // The leader's estimate of a clock is not exact to the microsecond.
        let rests_on = |map: &&DoorArrival| {
            map.oldest_capture
                .is_some_and(|oldest| oldest + PERIOD / 2 > captured_at)
        };
        let answer = maps
            .iter()
            .filter(|map| map.at >= captured_at)
            .find(rests_on);
        latencies.record_time(answer.map(|map| map.at.since(captured_at)), LAST_MAP);
    }
    Ok(latencies)
}

/// Delays of each map at the local program compared to its node.
fn behind_node(map_log: &Path, at_door: &DoorWatcher) -> anyhow::Result<Latencies> {
    // Before the log: the node writes a map there before its local broker forwards it.
    let at_door = at_door.maps();
    let text = fs::read_to_string(map_log)
        .with_context(|| format!("cannot read {}", map_log.display()))?;
    let received: HashMap<_, _> = text
        .lines()
        .filter_map(|line| serde_json::from_str::<ReceivedMap>(line).ok())
        .map(|map| ((map.map.epoch, map.map.round), map.received_at))
        .collect();
    let delay = |DoorArrival {
                     epoch, round, at, ..
                 }: &DoorArrival| {
        let received_at = received
            .get(&(*epoch, *round))
            .context("a program has a map that its node did not accept")?;
        Ok(at.micros_from(*received_at))
    };
    delays(
        &at_door
            .iter()
            .map(delay)
            .collect::<anyhow::Result<Vec<_>>>()?,
    )
}

/// These microseconds as times. Fails if too many of them are negative, because the cell's time, by
/// which the log is dated, is then ahead of this machine's clock.
fn delays(micros: &[i64]) -> anyhow::Result<Latencies> {
    let early = micros.iter().filter(|delay| **delay < 0).count();
    ensure!(
        100 * early <= micros.len(),
        "clocks differ: {early} of {} maps before the node had them",
        micros.len()
    );
    let mut latencies = Latencies::default();
    for delay in micros {
        latencies.record_time(
            Some(Duration::from_micros(
                (*delay).try_into().unwrap_or_default(),
            )),
            LAST_MAP,
        );
    }
    Ok(latencies)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fast_clock_delays_are_discarded() {
        let mut micros = vec![350; 99];
        micros.push(-1);
        assert!(delays(&micros).unwrap().quantiles().p50_us > 349.0);
        micros.push(-650);
        let error = delays(&micros).unwrap_err().to_string();
        assert!(error.contains("clocks differ: 2 of 101"), "{error}");
    }

    #[test]
    fn reports_missing_from_maps_miss_goal() {
        let missed = |missing| {
            let way = Quantiles {
                p50_us: 100.0,
                p99_us: 200.0,
                p999_us: 300.0,
                n: 200,
                missing: 0,
            };
            let report_at_door = Quantiles { missing, ..way };
            let behind_node = way;
            let report_at_leader = way;
            let figures = DoorFigures {
                behind_node,
                report_at_door,
                report_at_leader,
                hop_us: 50.0,
                resident_mb: 20.0,
                door_mb: 1.0,
            };
            let over = figures
                .goals()
                .into_iter()
                .filter(|(_, figure, goal)| figure > goal);
            over.map(|(name, ..)| name).collect::<Vec<_>>()
        };
        assert!(missed(2).is_empty());
        assert_eq!(missed(3), ["reports_missing_percent"]);
    }
}
