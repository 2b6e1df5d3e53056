//! One load on one cell.

use std::sync::{Arc, OnceLock, PoisonError};
use std::thread;
use std::time::{Duration, Instant};

use anyhow::Context;
use ecod::wire::{ReportKind, Topics};
use tokio::sync::{oneshot, watch};

use super::driver::{Sender, Sent, drive};
use super::echo::{AnswerBytes, Echo, OUT};
use super::latency::Answers;
use super::load::{self, Load};
use super::schedule::Schedule;
use super::target::Target;
use super::usage::{Usage, UsageMeter};
use super::vehicle::{BenchVehicle, Came, Common};

/// Result of a load.
#[derive(Debug, Clone)]
pub struct BenchFigure {
    /// From the due time of a round's last report to the map that includes all reports, and to the
    /// verdicts of that round, at every vehicle.
    pub cell: Answers,
    /// The same latencies on the bare path; empty if it was not requested.
    pub bare: Answers,
    /// Bytes of a report.
    pub report_bytes: usize,
    /// Bytes of the last map.
    pub map_bytes: usize,
    /// Bytes of the last verdicts.
    pub verdict_bytes: usize,
    /// Reports that this process could not send.
    pub refused: u64,
    /// Most time by which sending began late; it is part of the latencies.
    pub latest: Duration,
    /// Usage of the aggregator's process, if it is watched.
    pub aggregator: Option<Usage>,
    /// Usage of this process, the vehicles'.
    pub vehicles: Usage,
}

/// For the first map, and for the last answers.
const PATIENCE: Duration = Duration::from_secs(20);
const LAST_ANSWERS: Duration = Duration::from_secs(1);

/// From the last connection to the first report.
const LEAD_IN: Duration = Duration::from_millis(300);

/// Connects the vehicles, sends the load and gathers the answers.
///
/// # Errors
/// Returns an error if the broker cannot be reached, no map comes or the aggregator ends.
pub async fn measure(target: &Target, load: Load) -> anyhow::Result<BenchFigure> {
    let load = Load {
        votes: load.votes && target.votes,
        ..load
    };
    let answer_bytes = Arc::new(AnswerBytes::default());
    let common = Arc::new(Common {
        access: target.access.clone(),
        topics: Topics::new(&target.cell),
        schedule: OnceLock::new(),
        answer_bytes: Arc::clone(&answer_bytes),
        has_map: watch::Sender::new(false),
    });
    let at_broker = || format!("broker {}", target.access.broker);
    let _echo = if load.bare {
        let packets = load.vehicles * (1 + usize::from(load.votes));
        let echo = Echo::start(
            target.access.clone(),
            packets,
            Arc::clone(&answer_bytes),
            load.votes,
        )
        .await;
        Some(echo.with_context(at_broker)?)
    } else {
        None
    };
    let mut vehicles = Vec::new();
    let mut senders = Vec::new();
    for index in 0..load.vehicles {
        let report = load::report(index, &target.landmarks);
        let id = format!("ecod-bench-{}", report.node);
        let connected = BenchVehicle::connect(&id, load.ticks() as usize, &common).await;
        let vehicle = connected
            .with_context(|| format!("vehicle {index} of {}", load.vehicles))
            .with_context(at_broker)?;
        let topic = |kind: ReportKind| common.topics.path(&kind.topic(report.node.clone()));
        let bare_topic = format!("{OUT}/{}", report.node);
        let vote = load.votes.then(|| {
            (
                load::vote(index, &target.landmarks),
                topic(ReportKind::VoteDetections),
            )
        });
        let topic = topic(ReportKind::Detections);
        let messages = vote.into_iter().chain([(report, topic)]).collect();
        senders.push(Sender {
            client: vehicle.client.clone(),
            messages,
            bare_topic,
        });
        vehicles.push(vehicle);
    }
    let mut has_map = common.has_map.subscribe();
    let first_map = tokio::time::timeout(PATIENCE, has_map.wait_for(|has_map| *has_map)).await;
    first_map.context("no map came: no node leads the cell, or the cell has another name")??;

    let schedule = *common
        .schedule
        .get_or_init(|| Schedule::starting_in(LEAD_IN, load.period));
    let meters =
        [target.aggregator, Some(std::process::id())].map(|pid| pid.map(UsageMeter::start));
    let sent = on_a_thread(schedule, load, target.clone(), senders).await?;
    let [aggregator, own] = meters.map(|meter| meter.map(UsageMeter::stop).transpose());
    let (cell, bare) = gather(&vehicles, schedule, load).await;
    let [map_bytes, verdict_bytes] = answer_bytes.all();
    Ok(BenchFigure {
        cell,
        bare,
        report_bytes: sent.report_bytes,
        map_bytes,
        verdict_bytes,
        refused: sent.refused,
        latest: sent.latest,
        aggregator: aggregator?,
        vehicles: own?.unwrap_or_default(),
    })
}

async fn on_a_thread(
    schedule: Schedule,
    load: Load,
    target: Target,
    senders: Vec<Sender>,
) -> anyhow::Result<Sent> {
    let (done, sent) = oneshot::channel();
    let drive = move || {
        let sent = drive(schedule, load, &target, senders);
        if done.send(sent).is_err() {
            tracing::debug!("the measurement ended before its sending thread");
        }
    };
    thread::Builder::new()
        .name("bench-driver".into())
        .spawn(drive)?;
    sent.await.context("the sending thread ended")
}

/// Waits for the last answers, and turns arrivals into times.
async fn gather(vehicles: &[BenchVehicle], schedule: Schedule, load: Load) -> (Answers, Answers) {
    let begun = Instant::now();
    while begun.elapsed() < LAST_ANSWERS && !vehicles.iter().all(|vehicle| is_done(vehicle, load)) {
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
    let waited_until = Instant::now();
    let mut cell = Answers::default();
    let mut bare = Answers::default();
    for vehicle in vehicles {
        let arrivals = vehicle
            .arrivals
            .lock()
            .unwrap_or_else(PoisonError::into_inner);
        let warm_up = load.warm_up();
        let take = |answers: &mut Answers, Came { map, verdict }: &Came, later: Duration| {
            for (tick, (map, verdict)) in (0..).zip(map.iter().zip(verdict)).skip(warm_up as usize)
            {
                let due = schedule.begin(tick) + load.spread + later;
                answers.map.record_arrival(due, *map, waited_until);
                if load.votes {
                    answers.verdict.record_arrival(due, *verdict, waited_until);
                }
            }
        };
        take(&mut cell, &arrivals.cell, Duration::ZERO);
        if load.bare {
            take(&mut bare, &arrivals.bare, load.period / 2);
        }
    }
    (cell, bare)
}

fn is_done(vehicle: &BenchVehicle, load: Load) -> bool {
    let arrivals = vehicle
        .arrivals
        .lock()
        .unwrap_or_else(PoisonError::into_inner);
    let came = |arrivals: &[Option<Instant>]| arrivals.last().is_some_and(Option::is_some);
    let all_came = |ways: &Came| came(&ways.map) && (!load.votes || came(&ways.verdict));
    all_came(&arrivals.cell) && (!load.bare || all_came(&arrivals.bare))
}
